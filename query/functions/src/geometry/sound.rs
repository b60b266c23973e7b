//! `speed_of_sound` in air.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::temperature::speed_of_sound;

use crate::adapters::answers::build_numbers;
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::scalar::ScalarKernel;

/// 0 K, C.
const ABSOLUTE_ZERO: f64 = -273.15;

/// `speed_of_sound`.
pub(crate) struct SpeedOfSoundFunction;

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "speed_of_sound",
    family: FunctionFamily::Geometry,
    about: "Speed of sound in dry air, 331.3 sqrt(1 + T / 273.15), in m/s: what the responses of the lake are \
        corrected by.",
    parameters: &[FunctionParameter {
        name: "temperature_c",
        kind: ArgumentKind::Number,
        about: "temperature, C, -273.15 or more",
    }],
    optional: 0,
    example: "select round(speed_of_sound(20), 2) as m_s",
    answer: "\
+--------+
| m_s    |
+--------+
| 343.21 |
+--------+",
    related: &["fresnel", "arrival"],
};

impl ScalarKernel for SpeedOfSoundFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let celsius = arguments.number_values(0)?;
        build_numbers(arguments, |row| match celsius.value_at(row) {
            celsius if celsius < ABSOLUTE_ZERO => {
                Err(arguments.invalid_argument(0, row, celsius, "it is in degrees Celsius, -273.15 or more"))
            }
            celsius => Ok(Some(speed_of_sound(celsius))),
        })
    }
}
