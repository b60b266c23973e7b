//! Arithmetic on lists that DataFusion lacks.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::energy::{energy, rms};
use echolake_dsp::mean::multiply;

use crate::adapters::answers::{grow, lists, numbers};
use crate::adapters::arguments::{CallArguments, SampleElement, like};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::scalar::ScalarKernel;

/// `list_multiply`.
pub(crate) struct ListMultiplyFunction;

/// `list_energy`.
pub(crate) struct ListEnergyFunction;

/// `list_rms`.
pub(crate) struct ListRmsFunction;

static MULTIPLY: FunctionDescription = FunctionDescription {
    name: "list_multiply",
    family: FunctionFamily::Lists,
    about: "Product of two equally long lists, element by element: a window on a response.",
    parameters: &[
        FunctionParameter { name: "x", kind: ArgumentKind::Samples, about: "the first list" },
        FunctionParameter { name: "y", kind: ArgumentKind::Samples, about: "the second list, as long as the first" },
    ],
    optional: 0,
    example: "select list_multiply([1, 2, 3], [2, 0, -1]) as product",
    answer: "\
+------------------+
| product          |
+------------------+
| [2.0, 0.0, -3.0] |
+------------------+",
    related: &["list_energy", "avg_list"],
};

static ENERGY: FunctionDescription = FunctionDescription {
    name: "list_energy",
    family: FunctionFamily::Lists,
    about: "Sum of the squares of a list, in f64: the energy of a response. 0 for a list without elements.",
    parameters: &[FunctionParameter { name: "list", kind: ArgumentKind::Samples, about: "the list, as reflected_ir" }],
    optional: 0,
    example: "select list_energy([3, -4]) as energy",
    answer: "\
+--------+
| energy |
+--------+
| 25.0   |
+--------+",
    related: &["list_rms", "band_energy"],
};

static RMS: FunctionDescription = FunctionDescription {
    name: "list_rms",
    family: FunctionFamily::Lists,
    about: "Root of the mean square of a list, in its unit. 0 for a list without elements.",
    parameters: &[FunctionParameter { name: "list", kind: ArgumentKind::Samples, about: "the list" }],
    optional: 0,
    example: "select round(list_rms([3, -4]), 4) as rms",
    answer: "\
+--------+
| rms    |
+--------+
| 3.5355 |
+--------+",
    related: &["list_energy", "spl"],
};

impl ScalarKernel for ListMultiplyFunction {
    fn description(&self) -> &'static FunctionDescription {
        &MULTIPLY
    }

    fn returns(&self, arguments: &[DataType]) -> DataType {
        like(&arguments[0])
    }

    fn call<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let (x, y) = (arguments.samples::<T>(0)?, arguments.samples::<T>(1)?);
        lists::<T>(arguments, x.room(arguments.rows()), |row, out| {
            let (x, y) = (x.at(row)?, y.at(row)?);
            multiply(x, y, grow(out, x.len())).map_err(|e| arguments.refused(row, &e))?;
            Ok(true)
        })
    }
}

impl ScalarKernel for ListEnergyFunction {
    fn description(&self) -> &'static FunctionDescription {
        &ENERGY
    }

    fn returns(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn call<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let list = arguments.samples::<T>(0)?;
        numbers(arguments, |row| Ok(Some(energy(list.at(row)?))))
    }
}

impl ScalarKernel for ListRmsFunction {
    fn description(&self) -> &'static FunctionDescription {
        &RMS
    }

    fn returns(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn call<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let list = arguments.samples::<T>(0)?;
        numbers(arguments, |row| Ok(Some(rms(list.at(row)?))))
    }
}
