//! Ratios, amplitudes and pressures to decibels.

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::level::{amplitude_to_db, power_to_db, sound_pressure_level_db};

use super::answers::{grow, lists, numbers};
use super::arguments::{Arguments, Element};
use super::description::{Description, Family, Kind, Parameter};
use super::scalar::Scalar;

/// `db`: the level of an energy ratio.
pub(super) struct Db;

/// `db_amplitude`: the level of an amplitude ratio.
pub(super) struct DbAmplitude;

/// `spl`: sound pressure level.
pub(super) struct Spl;

/// `list_db`: the levels of a list of energy ratios.
pub(super) struct ListDb;

static DB: Description = Description {
    name: "db",
    family: Family::Levels,
    about: "Level of a ratio of energies or powers, 10 log10(x), in dB. What has no energy has no level: null for 0 and \
            less, so that averages and files meet no infinity.",
    parameters: &[Parameter { name: "x", kind: Kind::Number, about: "ratio of energies, as tnce_total" }],
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

static DB_AMPLITUDE: Description = Description {
    name: "db_amplitude",
    family: Family::Levels,
    about: "Level of a ratio of amplitudes, 20 log10 |x|, in dB; null for 0.",
    parameters: &[Parameter { name: "x", kind: Kind::Number, about: "ratio of amplitudes, of either sign" }],
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

static SPL: Description = Description {
    name: "spl",
    family: Family::Levels,
    about: "Sound pressure level, 20 log10(p / 20 uPa), in dB; null for 0 and less.",
    parameters: &[Parameter {
        name: "rms_pa",
        kind: Kind::Number,
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

static LIST_DB: Description = Description {
    name: "list_db",
    family: Family::Levels,
    about: "Level of each element, 10 log10(x), in dB. Inside of a list, no energy is minus infinity.",
    parameters: &[Parameter { name: "list", kind: Kind::Samples, about: "ratios of energies, as an NCE curve" }],
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

fn level(arguments: &Arguments<'_>, level: impl Fn(f64) -> f64, there: impl Fn(f64) -> bool) -> Result<ArrayRef> {
    let x = arguments.numbers(0)?;
    numbers(arguments, |row| Ok(Some(x.at(row)).filter(|x| there(*x) || x.is_nan()).map(&level)))
}

impl Scalar for Db {
    fn description(&self) -> &'static Description {
        &DB
    }

    fn returns(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn call<T: Element>(&self, arguments: &Arguments<'_>) -> Result<ArrayRef> {
        level(arguments, power_to_db, |x| x > 0.0)
    }
}

impl Scalar for DbAmplitude {
    fn description(&self) -> &'static Description {
        &DB_AMPLITUDE
    }

    fn returns(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn call<T: Element>(&self, arguments: &Arguments<'_>) -> Result<ArrayRef> {
        level(arguments, amplitude_to_db, |x| x != 0.0)
    }
}

impl Scalar for Spl {
    fn description(&self) -> &'static Description {
        &SPL
    }

    fn returns(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn call<T: Element>(&self, arguments: &Arguments<'_>) -> Result<ArrayRef> {
        level(arguments, sound_pressure_level_db, |x| x > 0.0)
    }
}

impl Scalar for ListDb {
    fn description(&self) -> &'static Description {
        &LIST_DB
    }

    fn returns(&self, arguments: &[DataType]) -> DataType {
        super::lists::like(&arguments[0])
    }

    fn call<T: Element>(&self, arguments: &Arguments<'_>) -> Result<ArrayRef> {
        let list = arguments.samples::<T>(0)?;
        lists::<T>(arguments, list.room(arguments.rows()), |row, out| {
            let list = list.at(row)?;
            grow(out, list.len()).iter_mut().zip(list).for_each(|(out, x)| *out = T::of(power_to_db(x.f64())));
            Ok(true)
        })
    }
}
