//! `fresnel`: the first Fresnel zone of a reflection.

use std::sync::LazyLock;

use arrow::array::ArrayRef;
use arrow::datatypes::{DataType, Fields};
use datafusion::error::Result;
use echolake_dsp::fresnel::first_fresnel_zone;

use crate::adapters::answers::{build_structs, number_fields};
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::scalar::ScalarKernel;

/// Default speed of sound, m/s: that of table `pairs`.
const SPEED_OF_SOUND: f64 = 343.0;

/// `fresnel`.
pub(crate) struct FresnelFunction;

static FIELDS: LazyLock<Fields> =
    LazyLock::new(|| number_fields(["centre_x_mm", "centre_y_mm", "major_mm", "minor_mm"]));

const fn number_parameter(name: &'static str, about: &'static str) -> FunctionParameter {
    FunctionParameter { name, kind: ArgumentKind::Number, about }
}

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "fresnel",
    family: FunctionFamily::Geometry,
    about: "First Fresnel zone of the reflection in the panel's reference plane, z = 0: the ellipse within which a \
            path is at most half a wavelength longer. A struct of its centre, `centre_x_mm` and `centre_y_mm`, and its \
            diameters in the plane of incidence, `major_mm`, and across it, `minor_mm`, in mm.",
    parameters: &[
        number_parameter("mic_x", "x of the microphone, mm"),
        number_parameter("mic_y", "y of the microphone, mm"),
        number_parameter("mic_z", "height of the microphone over the plane, mm, above 0"),
        number_parameter("speaker_x", "x of the speaker, mm"),
        number_parameter("speaker_y", "y of the speaker, mm"),
        number_parameter("speaker_z", "height of the speaker over the plane, mm, above 0"),
        number_parameter("frequency_hz", "frequency, Hz, above 0"),
        number_parameter("speed_m_s", "speed of sound, m/s, above 0; 343 if not given"),
    ],
    optional: 1,
    example: "select round(max(fresnel(m.x_mm, m.y_mm, m.z_mm, s.x_mm, s.y_mm, s.z_mm, 2000)['major_mm']), 1) as \
              largest_mm from pairs join points m on m.point_id = microphone join points s on s.point_id = speaker",
    answer: "\
+------------+
| largest_mm |
+------------+
| 535.5      |
+------------+",
    related: &["speed_of_sound"],
};

impl ScalarKernel for FresnelFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Struct(FIELDS.clone())
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let given = (0..arguments.argument_count()).map(|i| arguments.number_values(i)).collect::<Result<Vec<_>>>()?;
        build_structs(arguments, &FIELDS, |row, out| {
            let mut values = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, SPEED_OF_SOUND];
            for (i, (value, given)) in values.iter_mut().zip(&given).enumerate() {
                *value = given.value_at(row);
                let positive = matches!(i, 2 | 5 | 6 | 7);
                if !value.is_finite() || (positive && *value <= 0.0) {
                    return Err(arguments.invalid_argument(i, row, *value, DESCRIPTION.parameters[i].about));
                }
            }
            let [mx, my, mz, sx, sy, sz, hz, speed] = values;
            let zone = first_fresnel_zone([mx, my, mz], [sx, sy, sz], hz, speed);
            let [x, y] = zone.centre_mm;
            out.copy_from_slice(&[x, y, 2.0 * zone.semi_major_mm, 2.0 * zone.semi_minor_mm]);
            Ok(true)
        })
    }
}
