//! `spectrum` and `spectrum_frequencies`: levels of a response over frequency.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::spectrum::{SpectrumPlan, bin_count, bin_hz};

use crate::adapters::answers::{append_defaults, build_lists};
use crate::adapters::arguments::{CallArguments, SampleElement, list_of, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::per_length::PerLength;
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// Maximum number of samples for `spectrum_frequencies`, more than `spectrum` accepts.
const MOST: i64 = 1 << 20;

/// `spectrum`.
pub(crate) struct SpectrumFunction;

/// `spectrum_frequencies`.
pub(crate) struct SpectrumFrequenciesFunction(pub Arc<RigFacts>);

static SPECTRUM: FunctionDescription = FunctionDescription {
    name: "spectrum",
    family: FunctionFamily::Responses,
    about: "Levels of a response over frequency, 20 log10 of the magnitude of its discrete Fourier transform, in dB: \
            n/2 + 1 values for n samples, at the frequencies that spectrum_frequencies(n) lists. Not scaled: a \
            response is a gain, and a single sample of 1 is 0 dB throughout. Nothing is minus infinity.",
    parameters: &[FunctionParameter { name: "ir", kind: ArgumentKind::Samples, about: "the response" }],
    optional: 0,
    example: "select spectrum([0, 10, 0, 0]) as levels",
    answer: "\
+--------------------+
| levels             |
+--------------------+
| [20.0, 20.0, 20.0] |
+--------------------+",
    related: &["spectrum_frequencies", "band_energy"],
};

static FREQUENCIES: FunctionDescription = FunctionDescription {
    name: "spectrum_frequencies",
    family: FunctionFamily::Responses,
    about: "Frequencies of the values of spectrum() for n samples at the lake's sampling rate, in Hz.",
    parameters: &[FunctionParameter {
        name: "n",
        kind: ArgumentKind::Integer,
        about: "samples of the response, 0 to 1048576",
    }],
    optional: 0,
    example: "select spectrum_frequencies(4) as hz",
    answer: "\
+-------------------------+
| hz                      |
+-------------------------+
| [0.0, 24000.0, 48000.0] |
+-------------------------+",
    related: &["spectrum"],
};

impl ScalarKernel for SpectrumFunction {
    fn description(&self) -> &'static FunctionDescription {
        &SPECTRUM
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.sample_lists::<T>(0)?;
        let mut plans = PerLength::new(SPECTRUM.name);
        let room = bin_count(ir.sample_capacity(arguments.row_count())) + arguments.row_count();
        build_lists::<T>(arguments, room, |row, out| {
            let ir = ir.samples_at(row)?;
            if ir.is_empty() {
                return Ok(true);
            }
            let (plan, scratch) = plans.plan_for(ir.len(), |len| {
                let plan = SpectrumPlan::<T>::new(len)?;
                let scratch = plan.make_scratch();
                Ok((plan, scratch))
            })?;
            let levels = append_defaults(out, bin_count(ir.len()));
            plan.levels_db(ir, levels, scratch).map_err(|e| arguments.refused_row(row, &e))?;
            Ok(true)
        })
    }
}

impl ScalarKernel for SpectrumFrequenciesFunction {
    fn description(&self) -> &'static FunctionDescription {
        &FREQUENCIES
    }

    fn answer_type(&self, _: &[DataType]) -> DataType {
        list_of(DataType::Float64)
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let lengths = arguments.integer_values(0)?;
        build_lists::<f64>(arguments, 0, |row, out| {
            let given = lengths.value_at(row);
            let Some(len) = usize::try_from(given).ok().filter(|_| given <= MOST) else {
                return Err(arguments.invalid_argument(
                    0,
                    row,
                    given,
                    "it is the number of samples, as array_length(ir)",
                ));
            };
            out.extend((0..bin_count(len)).map(|bin| bin_hz(bin, len, self.0.rate_hz)));
            Ok(true)
        })
    }
}
