//! `band_filter`: a response in one octave or third of an octave.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::DataType;
use datafusion::error::Result;
use echolake_dsp::octave_filter::{BandWidth, OctaveBand, OctaveFilter};

use super::decay::require_finite;
use crate::adapters::answers::{append_defaults, build_lists};
use crate::adapters::arguments::{CallArguments, NumberValues, SampleElement, same_list_type};
use crate::adapters::description::{ArgumentKind, FunctionDescription, FunctionFamily, FunctionParameter};
use crate::adapters::rig::RigFacts;
use crate::adapters::scalar::ScalarKernel;

/// `band_filter`.
pub(crate) struct BandFilterFunction(pub Arc<RigFacts>);

/// First argument of a band, after the response.
pub(crate) const MIDBAND: FunctionParameter = FunctionParameter {
    name: "midband_hz",
    kind: ArgumentKind::Number,
    about: "midband frequency of the band, nominal or exact, Hz",
};

/// Second argument of a band.
pub(crate) const FRACTION: FunctionParameter = FunctionParameter {
    name: "fraction",
    kind: ArgumentKind::Integer,
    about: "1 for an octave, which is the default, 3 for a third of an octave",
};

/// Filters of the bands that the rows of one batch name.
pub(crate) struct BandFilters<'a> {
    arguments: &'a CallArguments<'a>,
    midband_hz: NumberValues<'a, f64>,
    fraction: Option<NumberValues<'a, i64>>,
    rate_hz: f64,
    designed: HashMap<(u64, i64), (OctaveBand, OctaveFilter)>,
}

static DESCRIPTION: FunctionDescription = FunctionDescription {
    name: "band_filter",
    family: FunctionFamily::Responses,
    about: "Samples of a response in one octave or third of an octave, in its unit: Butterworth of 6 sections, class 1 \
            of IEC 61260-1:2014, with its exact frequencies, at the lake's sampling rate. The filter has minimum \
            phase, and its samples are advanced so that the arrival, 20 dB below the greatest sample, stays where it \
            was within one sample.",
    parameters: &[
        FunctionParameter { name: "ir", kind: ArgumentKind::Samples, about: "the response" },
        MIDBAND,
        FRACTION,
    ],
    optional: 1,
    example: "select round(arrival(list) * 96, 1) as before, round(arrival(band_filter(list, 4000)) * 96, 1) as after \
              from (select array_concat(array_repeat(0, 100), [1], array_repeat(0, 100)) as list)",
    answer: "\
+--------+-------+
| before | after |
+--------+-------+
| 99.1   | 99.6  |
+--------+-------+",
    related: &["room_parameters", "band_energy", "arrival"],
};

impl<'a> BandFilters<'a> {
    /// The band's arguments begin at 1.
    pub fn new(arguments: &'a CallArguments<'a>, rate_hz: f64) -> Result<Self> {
        let fraction = (arguments.argument_count() > 2).then(|| arguments.integer_values(2)).transpose()?;
        let midband_hz = arguments.number_values(1)?;
        Ok(Self { arguments, midband_hz, fraction, rate_hz, designed: HashMap::new() })
    }

    /// Returns the band of a row and its filter.
    pub fn filter_at(&mut self, row: usize) -> Result<&(OctaveBand, OctaveFilter)> {
        let hz = self.midband_hz.value_at(row);
        let fraction = self.fraction.as_ref().map_or(1, |fraction| fraction.value_at(row));
        if !self.designed.contains_key(&(hz.to_bits(), fraction)) {
            let invalid =
                |at, given: &dyn std::fmt::Debug, hint: &str| self.arguments.invalid_argument(at, row, given, hint);
            let width = BandWidth::from_denominator(fraction)
                .ok_or_else(|| invalid(2, &fraction, "1 is an octave, 3 a third of an octave"))?;
            let band = OctaveBand::from_nominal(hz, width).ok_or_else(|| {
                let thirds = "thirds of an octave are at 1000, 1250, 1600, 2000, 2500, 3150 Hz and so on";
                let octaves = "octaves are at 500, 1000, 2000, 4000 Hz and so on; thirds of an octave have a third \
                               argument, 3";
                invalid(1, &hz, if fraction == 3 { thirds } else { octaves })
            })?;
            let filter = OctaveFilter::new(&band, self.rate_hz).map_err(|e| invalid(1, &hz, &e.to_string()))?;
            self.designed.insert((hz.to_bits(), fraction), (band, filter));
        }
        Ok(&self.designed[&(hz.to_bits(), fraction)])
    }
}

impl ScalarKernel for BandFilterFunction {
    fn description(&self) -> &'static FunctionDescription {
        &DESCRIPTION
    }

    fn answer_type(&self, arguments: &[DataType]) -> DataType {
        same_list_type(&arguments[0])
    }

    fn compute_answers<T: SampleElement>(&self, arguments: &CallArguments<'_>) -> Result<ArrayRef> {
        let ir = arguments.sample_lists::<T>(0)?;
        let mut filters = BandFilters::new(arguments, self.0.rate_hz)?;
        build_lists::<T>(arguments, ir.sample_capacity(arguments.row_count()), |row, out| {
            let ir = ir.samples_at(row)?;
            require_finite(arguments, row, ir)?;
            let (_, filter) = filters.filter_at(row)?;
            filter.filter_samples(ir, append_defaults(out, ir.len())).map_err(|e| arguments.refused_row(row, &e))?;
            Ok(true)
        })
    }
}
