//! `panel_splits`: the split of training sets, for loaders that read a lake without an export.

use std::collections::BTreeMap;
use std::sync::Arc;

use arrow::array::builder::{BooleanBuilder, ListBuilder, MapBuilder, StringBuilder};
use arrow::array::{Array as _, ArrayRef, AsArray as _, Int64Array};
use arrow::datatypes::{DataType, Field, Fields, Int64Type};
use datafusion::error::{DataFusionError, Result};
use echolake_schema::SurfaceId;
use echolake_schema::splits::{SplitParams, SplitPart, SplitSurface, assign_parts};

use crate::adapters::aggregate::{AggregateKernel, GroupStates};
use crate::adapters::arguments::{CallArguments, list_of};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};

/// `panel_splits`.
#[derive(Clone)]
pub(crate) struct PanelSplitsFunction;

/// Maximum number of surfaces in all groups of a batch: their names have one Arrow array.
const SURFACES: usize = i32::MAX as usize / SurfaceId::LONGEST;

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "panel_splits",
    family: FunctionFamily::Aggregates,
    about: "A map of each surface to `train`, `validation` or `test`, drawn by panel as `echolake export ml` does, with \
            its shares of 0.1. All sides of a panel are in one split; a reference is in train with its panel. map_keys() \
            and map_values() make lists of it. Rows with a null do not count; null of none.",
    parameters: &[
        FunctionParameter { name: "surface_id", kind: ArgumentKind::Text, about: "the surfaces" },
        FunctionParameter {
            name: "is_reference",
            kind: ArgumentKind::Flag,
            about: "true if the surface's typology is `reference`, or it is the flat_reference or foam_reference of any",
        },
        FunctionParameter {
            name: "seed",
            kind: ArgumentKind::Integer,
            about: "seed of the draw, the same in all rows; 1 is that of `echolake export ml`",
        },
    ],
    optional: 0,
    example: "select panel_splits(id, is_reference, 2) as splits from (values ('0001_0', false), ('0002_0', false), \
              ('0003_0', false), ('0004_0', false), ('flat', true)) as t(id, is_reference)",
    answer: "\
+-------------------------------------------------------------------------------+
| splits                                                                        |
+-------------------------------------------------------------------------------+
| {0001_0: validation, 0002_0: train, 0003_0: train, 0004_0: test, flat: train} |
+-------------------------------------------------------------------------------+",
    related: &["histogram"],
};

/// The surfaces of one draw.
#[derive(Debug, Default)]
pub(crate) struct DrawnSurfaces {
    /// None if there are no surfaces.
    seed: Option<i64>,
    /// Each with true if it is a reference.
    surfaces: BTreeMap<SurfaceId, bool>,
}

impl DrawnSurfaces {
    fn add_surface(&mut self, id: SurfaceId, is_reference: bool, seed: i64) -> Result<()> {
        let known = *self.seed.get_or_insert(seed);
        if known != seed {
            return Err(DataFusionError::Execution(format!(
                "`panel_splits`: the seed is {known} and {seed}; hint: all rows of a group have one seed"
            )));
        }
        *self.surfaces.entry(id).or_default() |= is_reference;
        Ok(())
    }

    fn assign_splits(&self) -> impl Iterator<Item = (&SurfaceId, Option<SplitPart>)> {
        let split = SplitParams { seed: self.seed.unwrap_or_default().cast_unsigned(), ..SplitParams::default() };
        let surface = |(id, is_reference): (_, &bool)| SplitSurface {
            id,
            typology: "",
            macrostructure: None,
            is_reference: *is_reference,
        };
        let surfaces: Vec<_> = self.surfaces.iter().map(surface).collect();
        self.surfaces.keys().zip(assign_parts(&surfaces, split))
    }
}

impl AggregateKernel for PanelSplitsFunction {
    type Group = DrawnSurfaces;

    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        let entries =
            Fields::from(vec![Field::new("keys", DataType::Utf8, false), Field::new("values", DataType::Utf8, true)]);
        DataType::Map(Arc::new(Field::new("entries", DataType::Struct(entries), false)), false)
    }

    fn state_columns(&self) -> Vec<(&'static str, DataType)> {
        vec![
            ("surfaces", list_of(DataType::Utf8)),
            ("references", list_of(DataType::Boolean)),
            ("seed", DataType::Int64),
        ]
    }

    fn update_groups(&self, arguments: &CallArguments<'_>, groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let names = arguments.text_values(0)?;
        let references = arguments.flag_values(1)?;
        let seeds = arguments.integer_values(2)?;
        for row in (0..arguments.row_count()).filter(|row| !arguments.is_null(*row)) {
            let name = names.text_at(row);
            groups.update_at(row, |group| {
                let invalid = |_| arguments.invalid_argument(0, row, name, "names are as in surfaces.surface_id");
                let id = name.parse::<SurfaceId>().map_err(invalid)?;
                group.add_surface(id, references.value(row), seeds.value_at(row))
            })?;
        }
        Ok(())
    }

    fn merge_states(&self, states: &[ArrayRef], groups: &mut GroupStates<'_, Self>) -> Result<()> {
        let names = states[0].as_list::<i32>();
        let references = states[1].as_list::<i32>();
        let seeds = states[2].as_primitive::<Int64Type>();
        for row in 0..names.len() {
            let names = names.value(row);
            let references = references.value(row);
            groups.update_at(row, |group| {
                for (name, is_reference) in names.as_string::<i32>().iter().zip(references.as_boolean().values()) {
                    let id = name.unwrap_or_default().parse::<SurfaceId>();
                    let id = id.map_err(|e| DataFusionError::External(Box::new(e)))?;
                    group.add_surface(id, is_reference, seeds.value(row))?;
                }
                Ok(())
            })?;
        }
        Ok(())
    }

    fn group_states(&self, groups: &[DrawnSurfaces]) -> Result<Vec<ArrayRef>> {
        check_size(groups)?;
        let mut names = ListBuilder::new(StringBuilder::new());
        let mut references = ListBuilder::new(BooleanBuilder::new());
        for group in groups {
            for (id, is_reference) in &group.surfaces {
                names.values().append_value(id.as_str());
                references.values().append_value(*is_reference);
            }
            names.append(true);
            references.append(true);
        }
        let seeds: Int64Array = groups.iter().map(|group| group.seed).collect();
        Ok(vec![Arc::new(names.finish()), Arc::new(references.finish()), Arc::new(seeds)])
    }

    fn group_answers(&self, groups: &[DrawnSurfaces], _: &DataType) -> Result<ArrayRef> {
        check_size(groups)?;
        let mut maps = MapBuilder::new(None, StringBuilder::new(), StringBuilder::new());
        for group in groups {
            for (id, part) in group.assign_splits() {
                maps.keys().append_value(id.as_str());
                maps.values().append_option(part.map(SplitPart::name));
            }
            maps.append(group.seed.is_some())?;
        }
        Ok(Arc::new(maps.finish()))
    }

    fn heap_bytes(group: &DrawnSurfaces) -> usize {
        group.surfaces.len() * (size_of::<(SurfaceId, bool)>() + SurfaceId::LONGEST)
    }
}

fn check_size(groups: &[DrawnSurfaces]) -> Result<()> {
    match groups.iter().map(|group| group.surfaces.len()).sum::<usize>() {
        0..=SURFACES => Ok(()),
        _ => Err(DataFusionError::Execution(format!(
            "`panel_splits`: more than {SURFACES} surfaces in a batch; hint: group by less"
        ))),
    }
}
