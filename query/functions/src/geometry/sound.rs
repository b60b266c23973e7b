//! `speed_of_sound` in air.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::air::AirState;
use echolake_dsp::temperature::speed_of_sound;
use echolake_schema::AirTreatment;

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
    about: "Speed of sound in air, m/s: by Cramer's formula of 1993 from temperature, humidity and pressure; from the \
        temperature alone by the paper's, 331.3 sqrt(1 + T / 273.15). `impulse_response.air` of the rig says by which \
        the responses of a lake are corrected.",
    parameters: &[
        number_parameter("temperature_c", "temperature, C, -273.15 or more"),
        number_parameter("humidity_pct", "relative humidity, %, 0 to 100"),
        number_parameter("pressure_hpa", "pressure, hPa, 300 to 1100; 1013.25 if not given"),
    ],
    optional: 2,
    example: "select round(speed_of_sound(20), 2) as paper_m_s, round(speed_of_sound(20, 50), 2) as m_s",
    answer: "\
+-----------+--------+
| paper_m_s | m_s    |
+-----------+--------+
| 343.21    | 343.99 |
+-----------+--------+",
    related: &["fresnel", "arrival"],
};

const fn number_parameter(name: &'static str, about: &'static str) -> FunctionParameter {
    FunctionParameter { name, kind: ArgumentKind::Number, about }
}

impl ScalarKernel for SpeedOfSoundFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let given = (0..arguments.argument_count()).map(|i| arguments.number_values(i)).collect::<Result<Vec<_>>>()?;
        build_numbers(arguments, |row| {
            let celsius = given[0].value_at(row);
            if celsius < ABSOLUTE_ZERO {
                return Err(arguments.invalid_argument(0, row, celsius, "it is in degrees Celsius, -273.15 or more"));
            }
            let Some(humidity) = given.get(1) else { return Ok(Some(speed_of_sound(celsius))) };
            let pressure_hpa = given.get(2).map_or(AirState::REFERENCE_PRESSURE_HPA, |p| p.value_at(row));
            let air = AirState { temperature_c: celsius, humidity_pct: humidity.value_at(row), pressure_hpa };
            for (at, value, is_right, hint) in [
                (1, air.humidity_pct, (0.0..=100.0).contains(&air.humidity_pct), "it is in %, 0 to 100"),
                (2, pressure_hpa, (300.0..=1_100.0).contains(&pressure_hpa), "it is in hPa, 300 to 1100"),
            ] {
                if !is_right {
                    return Err(arguments.invalid_argument(at, row, value, hint));
                }
            }
            Ok(Some(air.speed_of_sound(AirTreatment::Complete)))
        })
    }
}
