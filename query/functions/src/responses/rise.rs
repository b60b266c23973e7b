//! `rise_time`, `nce_centre` and `nce_slope`: the shape of a cumulative energy curve.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::rise::{CurveShape, curve_shape};

use super::decay::require_finite;
use crate::adapters::answers::build_numbers;
use crate::adapters::arguments::{CallArguments, SampleElement};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// One number of a curve's shape.
pub(crate) struct CurveShapeFunction {
    facts: Arc<RigFacts>,
    description: &'static FunctionDescription,
    /// The number, from the shape and the samples per millisecond.
    value: fn(&CurveShape, f64) -> f64,
}

impl CurveShapeFunction {
    /// All functions of this file.
    pub fn all(facts: &Arc<RigFacts>) -> [Self; 3] {
        let function = |description, value| Self { facts: facts.clone(), description, value };
        [
            function(&RISE, |shape: &CurveShape, per_ms| shape.rise / per_ms),
            function(&CENTRE, |shape, per_ms| shape.centre / per_ms),
            function(&SLOPE, |shape, per_ms| shape.slope * per_ms),
        ]
    }
}

// An impulse response has a shape of this kind, too, which means nothing.
fn require_rising<T: SampleElement>(arguments: &CallArguments<'_>, row: usize, curve: &[T]) -> Result<()> {
    let Some(at) = curve.windows(2).position(|pair| pair[1].f64() < pair[0].f64()) else { return Ok(()) };
    let falls = format_args!("less in sample {} than in the one before", at + 2);
    Err(arguments.invalid_argument(0, row, falls, "a cumulative curve does not fall; nce() makes one of a response"))
}

const CURVE: &[FunctionParameter] = &[FunctionParameter {
    name: "curve",
    kind: ArgumentKind::Samples,
    about: "a cumulative energy curve, as nce_10000",
}];

static RISE: FunctionDescription = FunctionDescription {
    name: "rise_time",
    family: FunctionFamily::Responses,
    about: "Time in which a cumulative energy curve rises from 10 % to 90 % of its last value, in ms, interpolated \
            linearly; null without energy. A surface that spreads a reflection in time has a longer one. Columns \
            rise_*_ms of table tnce hold it for each band.",
    parameters: CURVE,
    optional: 0,
    example: "select round(rise_time([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]), 4) as ms",
    answer: "\
+--------+
| ms     |
+--------+
| 0.0833 |
+--------+",
    related: &["nce_centre", "nce_slope", "nce"],
};

static CENTRE: FunctionDescription = FunctionDescription {
    name: "nce_centre",
    family: FunctionFamily::Responses,
    about: "Centre of gravity of the energy of a cumulative curve, in ms from its first sample, not from the arrival \
            as Ts of room_parameters; null without energy. Columns centre_*_ms of table tnce hold it for each band.",
    parameters: CURVE,
    optional: 0,
    example: "select nce_centre([0.0, 1.0, 1.0, 1.0, 2.0]) * 96 as samples",
    answer: "\
+---------+
| samples |
+---------+
| 2.5     |
+---------+",
    related: &["rise_time", "room_parameters"],
};

static SLOPE: FunctionDescription = FunctionDescription {
    name: "nce_slope",
    family: FunctionFamily::Responses,
    about: "Mean slope of a cumulative energy curve between 10 % and 90 % of its last value, per ms: 0.8 of that value \
            over rise_time; null without energy. Rust et al. 2021 read how diffuse a reflection is from this slope. \
            Columns slope_*_per_ms of table tnce hold it for each band.",
    parameters: CURVE,
    optional: 0,
    example: "select round(nce_slope([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]), 4) as per_ms",
    answer: "\
+--------+
| per_ms |
+--------+
| 9.6    |
+--------+",
    related: &["rise_time", "nce"],
};

impl ScalarKernel for CurveShapeFunction {
    fn description(&self) -> &'static FunctionDescription {
        self.description
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let curves = arguments.sample_lists::<T>(0)?;
        let per_ms = self.facts.rate_hz / 1e3;
        build_numbers(arguments, |row| {
            let curve = curves.samples_at(row)?;
            require_rising(arguments, row, curve)?;
            match curve_shape(curve) {
                Some(shape) => Ok(Some((self.value)(&shape, per_ms))),
                None => require_finite(arguments, row, curve).map(|()| None),
            }
        })
    }
}
