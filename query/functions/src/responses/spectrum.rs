//! `spectrum` and `spectrum_frequencies`: levels of a response over frequency.

use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::spectrum::{SpectrumPlan, bin_hz, bins};

use crate::adapters::answers::{grow, lists};
use crate::adapters::arguments::{CallArguments, SampleElement, like, list_of};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::per_length::PerLength;
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// Maximum number of samples for `spectrum_frequencies`, more than `spectrum` accepts.
const MOST: i64 = 1 << 20;

/// `spectrum`.
pub(crate) struct SpectrumFunction;

/// `spectrum_frequencies`.
pub(crate) struct SpectrumFrequenciesFunction(pub(crate) Arc<RigFacts>);

static SPECTRUM: FunctionDescription = FunctionDescription {
    name: "spectrum",
    family: FunctionFamily::Responses,
    about: "Levels of a response over frequency, 20 log10 of the magnitude of its discrete Fourier transform, in dB: n/2 + 1 \
            values for n samples, at the frequencies that spectrum_frequencies(n) lists. Not scaled: a response is a gain, \
            and a single sample of 1 is 0 dB throughout. Nothing is minus infinity.",
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

    fn returns(&self, arguments: &[DataType]) -> DataType {
        like(&arguments[0])
    }

    fn call<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.samples::<T>(0)?;
        let mut plans = PerLength::new(SPECTRUM.name);
        let room = bins(ir.room(arguments.rows())) + arguments.rows();
        lists::<T>(arguments, room, |row, out| {
            let ir = ir.at(row)?;
            if ir.is_empty() {
                return Ok(true);
            }
            let (plan, scratch) = plans.get(ir.len(), |len| {
                let plan = SpectrumPlan::<T>::new(len)?;
                let scratch = plan.scratch();
                Ok((plan, scratch))
            })?;
            let levels = grow(out, bins(ir.len()));
            plan.levels_db(ir, levels, scratch).map_err(|e| arguments.refused(row, &e))?;
            Ok(true)
        })
    }
}

impl ScalarKernel for SpectrumFrequenciesFunction {
    fn description(&self) -> &'static FunctionDescription {
        &FREQUENCIES
    }

    fn returns(&self, _: &[DataType]) -> DataType {
        list_of(DataType::Float64)
    }

    fn call<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let lengths = arguments.integers(0)?;
        lists::<f64>(arguments, 0, |row, out| {
            let given = lengths.at(row);
            let Some(len) = usize::try_from(given).ok().filter(|_| given <= MOST) else {
                return Err(arguments.wrong(0, row, given, "it is the number of samples, as array_length(ir)"));
            };
            out.extend((0..bins(len)).map(|bin| bin_hz(bin, len, self.0.rate_hz)));
            Ok(true)
        })
    }
}
