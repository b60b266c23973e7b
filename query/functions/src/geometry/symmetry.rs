//! `d4` and related functions: positions, points, pairs and height maps under the symmetries of the square.

use std::sync::{Arc, LazyLock};

use arrow::array::{ArrayRef, BooleanArray, Int32Array, StructArray};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field, Fields};
use datafusion::error::{DataFusionError, Result};
use echolake_dsp::heights::move_heights;
use echolake_schema::Symmetry;

use crate::adapters::answers::{append_defaults, build_lists, build_structs, number_fields};
use crate::adapters::arguments::{CallArguments, SampleElement, TextValues, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// `d4`: a position.
pub(crate) struct D4PositionFunction;

/// `d4_point`: a point of the grid.
pub(crate) struct D4PointFunction(pub Arc<RigFacts>);

/// `d4_pair`: a pair.
pub(crate) struct D4PairFunction(pub Arc<RigFacts>);

/// `d4_heightmap`: a height map.
pub(crate) struct D4HeightmapFunction;

const SYMMETRY: FunctionParameter = FunctionParameter {
    name: "symmetry",
    kind: ArgumentKind::Text,
    about: "one of identity, rot90, rot180, rot270, mirror_x, mirror_y, mirror_diag, mirror_anti",
};

static POSITION_FIELDS: LazyLock<Fields> = LazyLock::new(|| number_fields(["x", "y"]));

static PAIR_FIELDS: LazyLock<Fields> = LazyLock::new(|| {
    Fields::from(vec![Field::new("pair_id", DataType::Int32, true), Field::new("swapped", DataType::Boolean, true)])
});

static D4_POSITION: FunctionDescription = FunctionDescription {
    name: "d4",
    family: FunctionFamily::Geometry,
    about: "A position under one of the eight symmetries of the square (D4) about the panel's centre: a struct of `x` \
            and `y` in the unit of the arguments. rot90 turns counter-clockwise seen from above, mirror_x changes the \
            sign of x, mirror_diag exchanges x and y.",
    parameters: &[
        FunctionParameter { name: "x", kind: ArgumentKind::Number, about: "x from the panel's centre, mm" },
        FunctionParameter { name: "y", kind: ArgumentKind::Number, about: "y from the panel's centre, mm" },
        SYMMETRY,
    ],
    optional: 0,
    example: "select d4(100, 20, 'rot90') as moved",
    answer: "\
+----------------------+
| moved                |
+----------------------+
| {x: -20.0, y: 100.0} |
+----------------------+",
    related: &["d4_point", "d4_pair", "d4_heightmap"],
};

static D4_POINT: FunctionDescription = FunctionDescription {
    name: "d4_point",
    family: FunctionFamily::Geometry,
    about: "The point of the lake's grid that a point becomes under a symmetry.",
    parameters: &[
        FunctionParameter { name: "point_id", kind: ArgumentKind::Integer, about: "a point of table points" },
        SYMMETRY,
    ],
    optional: 0,
    example: "select d4_point(0, 'rot180') as point",
    answer: "\
+-------+
| point |
+-------+
| 35    |
+-------+",
    related: &["d4", "d4_pair"],
};

static D4_PAIR: FunctionDescription = FunctionDescription {
    name: "d4_pair",
    family: FunctionFamily::Geometry,
    about: "The pair that a pair becomes under a symmetry: a struct of `pair_id` and `swapped`, which tells that \
            microphone and speaker change places, so that the measurement stands for the other by reciprocity.",
    parameters: &[
        FunctionParameter { name: "pair_id", kind: ArgumentKind::Integer, about: "a pair of table pairs" },
        SYMMETRY,
    ],
    optional: 0,
    example: "select d4_pair(0, 'rot180') as moved",
    answer: "\
+--------------------------------+
| moved                          |
+--------------------------------+
| {pair_id: 2020, swapped: true} |
+--------------------------------+",
    related: &["d4", "d4_point"],
};

static D4_HEIGHTMAP: FunctionDescription = FunctionDescription {
    name: "d4_heightmap",
    family: FunctionFamily::Geometry,
    about: "A square map under a symmetry about its centre, in the unit of its values: what stood at p stands where p \
        goes.",
    parameters: &[
        FunctionParameter {
            name: "list",
            kind: ArgumentKind::Samples,
            about: "n x n values, row by row along x, y ascending, as heights_mm",
        },
        SYMMETRY,
    ],
    optional: 0,
    example: "select d4_heightmap([1, 2, 3, 4], 'mirror_x') as moved",
    answer: "\
+----------------------+
| moved                |
+----------------------+
| [2.0, 1.0, 4.0, 3.0] |
+----------------------+",
    related: &["d4"],
};

/// Returns the symmetry of a row.
fn row_symmetry(
    arguments: &CallArguments<'_>,
    texts: &TextValues<'_>,
    argument: usize,
    row: usize,
) -> Result<Symmetry> {
    let name = texts.text_at(row);
    let found = Symmetry::ALL.into_iter().find(|s| s.name() == name);
    found.ok_or_else(|| arguments.invalid_argument(argument, row, name, SYMMETRY.about))
}

/// Returns the image of a row's point or pair, out of the images of all.
fn of_all<'a, M>(arguments: &CallArguments<'_>, row: usize, id: i64, all: Option<&'a [M]>) -> Result<&'a M> {
    let Some(all) = all else {
        return Err(arguments.invalid_argument(
            1,
            row,
            "no symmetry of the lake's grid",
            "table points lists the grid",
        ));
    };
    let found = usize::try_from(id).ok().and_then(|id| all.get(id));
    found.ok_or_else(|| {
        arguments.invalid_argument(0, row, id, &format!("the lake has 0 to {}", all.len().saturating_sub(1)))
    })
}

impl ScalarKernel for D4PositionFunction {
    fn description(&self) -> &'static FunctionDescription {
        &D4_POSITION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Struct(POSITION_FIELDS.clone())
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let x = arguments.number_values(0)?;
        let y = arguments.number_values(1)?;
        let names = arguments.text_values(2)?;
        build_structs(arguments, &POSITION_FIELDS, |row, out| {
            let [x, y, _] =
                row_symmetry(arguments, &names, 2, row)?.move_position([x.value_at(row), y.value_at(row), 0.0]);
            // 0 x -5 is -0, which reads oddly.
            out.copy_from_slice(&[x + 0.0, y + 0.0]);
            Ok(true)
        })
    }
}

impl ScalarKernel for D4PointFunction {
    fn description(&self) -> &'static FunctionDescription {
        &D4_POINT
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Int32
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ids = arguments.integer_values(0)?;
        let names = arguments.text_values(1)?;
        let point = |row| {
            if arguments.is_null(row) {
                return Ok(None);
            }
            let symmetry = row_symmetry(arguments, &names, 1, row)?;
            of_all(arguments, row, ids.value_at(row), self.0.moved_points(symmetry)).map(|p| Some(p.0 as i32))
        };
        Ok(Arc::new((0..arguments.row_count()).map(point).collect::<Result<Int32Array>>()?))
    }
}

impl ScalarKernel for D4PairFunction {
    fn description(&self) -> &'static FunctionDescription {
        &D4_PAIR
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Struct(PAIR_FIELDS.clone())
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ids = arguments.integer_values(0)?;
        let names = arguments.text_values(1)?;
        let pair = |row| {
            if arguments.is_null(row) {
                return Ok(None);
            }
            let symmetry = row_symmetry(arguments, &names, 1, row)?;
            of_all(arguments, row, ids.value_at(row), self.0.moved_pairs(symmetry)).map(Some)
        };
        let moved = (0..arguments.row_count()).map(pair).collect::<Result<Vec<_>, DataFusionError>>()?;
        let pairs: Int32Array = moved.iter().map(|m| m.map(|m| m.pair.id.0 as i32)).collect();
        let swapped: BooleanArray = moved.iter().map(|m| m.map(|m| m.swapped)).collect();
        let nulls = NullBuffer::from_iter(moved.iter().map(Option::is_some));
        let columns: Vec<ArrayRef> = vec![Arc::new(pairs), Arc::new(swapped)];
        Ok(Arc::new(StructArray::try_new_with_length(PAIR_FIELDS.clone(), columns, Some(nulls), moved.len())?))
    }
}

impl ScalarKernel for D4HeightmapFunction {
    fn description(&self) -> &'static FunctionDescription {
        &D4_HEIGHTMAP
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let maps = arguments.sample_lists::<T>(0)?;
        let names = arguments.text_values(1)?;
        build_lists::<T>(arguments, maps.sample_capacity(arguments.row_count()), |row, out| {
            let map = maps.samples_at(row)?;
            let symmetry = row_symmetry(arguments, &names, 1, row)?;
            move_heights(map, symmetry, append_defaults(out, map.len())).map_err(|e| arguments.refused_row(row, &e))?;
            Ok(true)
        })
    }
}
