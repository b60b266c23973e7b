//! `edc` and `arrival`: the energy decay curve of a response, and its onset.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::arrival::first_arrival;
use echolake_dsp::decay::energy_decay_db;
use echolake_dsp::octave_filter::ARRIVAL_DB;

use crate::adapters::answers::{append_defaults, build_lists, build_numbers};
use crate::adapters::arguments::{CallArguments, SampleElement, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// `edc`.
pub(crate) struct EdcFunction;

/// `arrival`.
pub(crate) struct ArrivalFunction(pub Arc<RigFacts>);

static EDC: FunctionDescription = FunctionDescription {
    name: "edc",
    family: FunctionFamily::Responses,
    about: "Energy decay curve by Schroeder's backward integration: the energy from each sample to the end over all of \
            it, in dB. It starts at 0 dB; where nothing is left it is minus infinity; noise is not \
            taken out of it. Null for a response without energy.",
    parameters: &[FunctionParameter { name: "ir", kind: ArgumentKind::Samples, about: "the response" }],
    optional: 0,
    example: "select edc([3, 0, 1, 0]) as levels",
    answer: "\
+---------------------------+
| levels                    |
+---------------------------+
| [0.0, -10.0, -10.0, -inf] |
+---------------------------+",
    related: &["room_parameters", "nce", "arrival"],
};

static ARRIVAL: FunctionDescription = FunctionDescription {
    name: "arrival",
    family: FunctionFamily::Responses,
    about: "Time of the first arrival after the first sample, in ms at the lake's sampling rate: where the magnitude \
            first reaches a level relative to its greatest, -20 dB if none is given, linearly interpolated between \
            samples. Null for a response without sound.",
    parameters: &[
        FunctionParameter {
            name: "ir",
            kind: ArgumentKind::Samples,
            about: "the response, its direct sound still in it, as ir",
        },
        FunctionParameter { name: "threshold_db", kind: ArgumentKind::Number, about: "the level, dB, 0 or less" },
    ],
    optional: 1,
    example: "select arrival([0, 0, 0, 1, 0.5], 0) as ms",
    answer: "\
+---------+
| ms      |
+---------+
| 0.03125 |
+---------+",
    related: &["edc", "speed_of_sound"],
};

impl ScalarKernel for EdcFunction {
    fn description(&self) -> &'static FunctionDescription {
        &EDC
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.sample_lists::<T>(0)?;
        build_lists::<T>(arguments, ir.sample_capacity(arguments.row_count()), |row, out| {
            let ir = ir.samples_at(row)?;
            let there = energy_decay_db(ir, append_defaults(out, ir.len()));
            if there { Ok(true) } else { require_finite(arguments, row, ir).map(|()| false) }
        })
    }
}

impl ScalarKernel for ArrivalFunction {
    fn description(&self) -> &'static FunctionDescription {
        &ARRIVAL
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        DataType::Float64
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.sample_lists::<T>(0)?;
        let threshold = if arguments.argument_count() > 1 { Some(arguments.number_values(1)?) } else { None };
        build_numbers(arguments, |row| {
            let (ir, threshold) = (ir.samples_at(row)?, threshold.as_ref().map_or(ARRIVAL_DB, |t| t.value_at(row)));
            if !(threshold <= 0.0) {
                return Err(arguments.invalid_argument(
                    1,
                    row,
                    threshold,
                    "it is relative to the greatest sample: 0 dB or less",
                ));
            }
            match first_arrival(ir, threshold) {
                Some(samples) => Ok(Some(samples / self.0.rate_hz * 1e3)),
                None => require_finite(arguments, row, ir).map(|()| None),
            }
        })
    }
}

// A silent response has no answer; one with NaN would have a wrong answer, and is an error.
pub(crate) fn require_finite<T: SampleElement>(arguments: &CallArguments<'_>, row: usize, ir: &[T]) -> Result<()> {
    if ir.iter().all(|x| x.f64().is_finite()) {
        return Ok(());
    }
    Err(arguments.refused_row(row, &echolake_dsp::Error::NotFinite { what: "the response" }))
}
