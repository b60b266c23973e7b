//! Ratios, amplitudes and pressures to decibels.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::level::{amplitude_to_db, power_to_db, sound_pressure_level_db};

use crate::adapters::answers::{append_defaults, build_lists, build_numbers};
use crate::adapters::arguments::{CallArguments, SampleElement, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::scalar::ScalarKernel;

/// `db`: the level of an energy ratio.
pub(crate) struct DbFunction;

/// `db_amplitude`: the level of an amplitude ratio.
pub(crate) struct DbAmplitudeFunction;

/// `spl`: sound pressure level.
pub(crate) struct SplFunction;

/// `list_db`: the levels of a list of energy ratios.
pub(crate) struct ListDbFunction;

static DB: FunctionDescription = FunctionDescription {
    name: "db",
    family: FunctionFamily::Levels,
    about: "Level of a ratio of energies or powers, 10 log10(x), in dB. What has no energy has no level: null for 0 \
            and less, so that averages and files meet no infinity.",
    parameters: &[FunctionParameter {
        name: "x",
        kind: ArgumentKind::Number,
        about: "ratio of energies, as tnce_total",
    }],
    optional: 0,
    example: "select round(db(0.5), 2) as half, db(0) as none",
    answer: "\
+-------+------+
| half  | none |
+-------+------+
| -3.01 |      |
+-------+------+",
    related: &["db_amplitude", "list_db", "p90_mean"],
};

static DB_AMPLITUDE: FunctionDescription = FunctionDescription {
    name: "db_amplitude",
    family: FunctionFamily::Levels,
    about: "Level of a ratio of amplitudes, 20 log10 |x|, in dB; null for 0.",
    parameters: &[FunctionParameter {
        name: "x",
        kind: ArgumentKind::Number,
        about: "ratio of amplitudes, of either sign",
    }],
    optional: 0,
    example: "select round(db_amplitude(-0.5), 2) as half",
    answer: "\
+-------+
| half  |
+-------+
| -6.02 |
+-------+",
    related: &["db", "spl"],
};

static SPL: FunctionDescription = FunctionDescription {
    name: "spl",
    family: FunctionFamily::Levels,
    about: "Sound pressure level, 20 log10(p / 20 uPa), in dB; null for 0 and less.",
    parameters: &[FunctionParameter {
        name: "rms_pa",
        kind: ArgumentKind::Number,
        about: "root mean square of the sound pressure, Pa",
    }],
    optional: 0,
    example: "select round(spl(1), 2) as one_pa",
    answer: "\
+--------+
| one_pa |
+--------+
| 93.98  |
+--------+",
    related: &["db_amplitude", "list_rms"],
};

static LIST_DB: FunctionDescription = FunctionDescription {
    name: "list_db",
    family: FunctionFamily::Levels,
    about: "Level of each element, 10 log10(x), in dB. Inside of a list, no energy is minus infinity.",
    parameters: &[FunctionParameter {
        name: "list",
        kind: ArgumentKind::Samples,
        about: "ratios of energies, as an NCE curve",
    }],
    optional: 0,
    example: "select list_db([1, 0.1, 0]) as levels",
    answer: "\
+--------------------+
| levels             |
+--------------------+
| [0.0, -10.0, -inf] |
+--------------------+",
    related: &["db", "nce"],
};

fn compute_levels(
    arguments: &CallArguments<'_>,
    level: impl Fn(f64) -> f64,
    there: impl Fn(f64) -> bool,
) -> Result<ArrayRef> {
    let x = arguments.number_values(0)?;
    build_numbers(arguments, |row| Ok(Some(x.value_at(row)).filter(|x| there(*x) || x.is_nan()).map(&level)))
}

impl ScalarKernel for DbFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DB
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        compute_levels(arguments, power_to_db, |x| x > 0.0)
    }
}

impl ScalarKernel for DbAmplitudeFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DB_AMPLITUDE
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        compute_levels(arguments, amplitude_to_db, |x| x != 0.0)
    }
}

impl ScalarKernel for SplFunction {
    fn description(&self) -> &'static FunctionDescription {
        &SPL
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        compute_levels(arguments, sound_pressure_level_db, |x| x > 0.0)
    }
}

impl ScalarKernel for ListDbFunction {
    fn description(&self) -> &'static FunctionDescription {
        &LIST_DB
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let list = arguments.sample_lists::<T>(0)?;
        build_lists::<T>(arguments, list.sample_capacity(arguments.row_count()), |row, out| {
            let list = list.samples_at(row)?;
            append_defaults(out, list.len())
                .iter_mut()
                .zip(list)
                .for_each(|(out, x)| *out = T::of(power_to_db(x.f64())));
            Ok(true)
        })
    }
}
