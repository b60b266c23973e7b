//! Arithmetic on lists that DataFusion lacks.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::energy::{energy, rms};
use echolake_dsp::mean::multiply_samples;

use crate::adapters::answers::{append_defaults, build_lists, build_numbers};
use crate::adapters::arguments::{CallArguments, SampleElement, same_list_type};
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

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let x = arguments.sample_lists::<T>(0)?;
        let y = arguments.sample_lists::<T>(1)?;
        build_lists::<T>(arguments, x.sample_capacity(arguments.row_count()), |row, out| {
            let x = x.samples_at(row)?;
            let y = y.samples_at(row)?;
            multiply_samples(x, y, append_defaults(out, x.len())).map_err(|e| arguments.refused_row(row, &e))?;
            Ok(true)
        })
    }
}

impl ScalarKernel for ListEnergyFunction {
    fn description(&self) -> &'static FunctionDescription {
        &ENERGY
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let list = arguments.sample_lists::<T>(0)?;
        build_numbers(arguments, |row| Ok(Some(energy(list.samples_at(row)?))))
    }
}

impl ScalarKernel for ListRmsFunction {
    fn description(&self) -> &'static FunctionDescription {
        &RMS
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let list = arguments.sample_lists::<T>(0)?;
        build_numbers(arguments, |row| Ok(Some(rms(list.samples_at(row)?))))
    }
}
