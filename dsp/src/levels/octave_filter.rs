//! Octave and third-octave filters of IEC 61260-1:2014, class 1.

use std::f64::consts::{PI, TAU};

use realfft::num_complex::Complex;

use crate::arrival::first_arrival;
use crate::error::check_len;
use crate::spectrum::bin_count;
use crate::{Error, RealSample};

/// An octave is a frequency ratio of 10^(3/10), IEC 61260-1:2014, 5.2.
const OCTAVE_DECADES: f64 = 0.3;
/// Midband frequency that all others follow from, Hz.
const REFERENCE_HZ: f64 = 1000.0;
/// Greatest distance of a nominal frequency from the exact one: 1.25 kHz stands for 1258.9 Hz.
const NOMINAL_TOLERANCE: f64 = 0.02;
/// Least upper edge of a band, Hz: a filter rings for seconds below it.
const LEAST_EDGE_HZ: f64 = 10.0;
/// Order of the Butterworth low-pass filter behind the band-pass: as many sections of second order.
const ORDER: usize = 6;
/// Level of an arrival re the greatest sample, dB: ISO 3382-1:2009 looks for it at least 20 dB below.
pub const ARRIVAL_DB: f64 = -20.0;

/// Width of a band.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BandWidth {
    /// One octave.
    Octave,
    /// A third of an octave.
    ThirdOctave,
}

/// The frequencies of a band, exact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OctaveBand {
    /// Midband frequency, Hz.
    pub midband_hz: f64,
    /// Lower band-edge frequency, Hz.
    pub low_hz: f64,
    /// Upper band-edge frequency, Hz.
    pub high_hz: f64,
}

/// A band-pass filter: Butterworth, of 6 sections, minimum phase, in f64. Its samples are advanced by a whole number of
/// samples, so that the arrival of a click, 20 dB below its greatest sample, stays where it was within one sample.
///
/// Source: IEC 61260-1:2014; the bilinear transform with both band edges prewarped.
///
/// ```
/// use echolake_dsp::octave_filter::{BandWidth, OctaveBand, OctaveFilter};
///
/// let band = OctaveBand::from_nominal(1000.0, BandWidth::Octave).ok_or("no such band")?;
/// let filter = OctaveFilter::new(&band, 48e3)?;
/// let mut click = vec![0.0; 2000];
/// click[300] = 1.0;
/// let mut filtered = vec![0.0; 2000];
/// filter.filter_samples(&click, &mut filtered)?;
/// let arrival = echolake_dsp::arrival::first_arrival(&filtered, -20.0).ok_or("no arrival")?;
/// assert!((arrival - 300.0).abs() < 1.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct OctaveFilter {
    sections: [FilterSection; ORDER],
    delay: usize,
}

/// gain (1 - z^-2) / (1 + first z^-1 + second z^-2).
#[derive(Debug, Clone, Copy, Default)]
struct FilterSection {
    gain: f64,
    first: f64,
    second: f64,
}

impl BandWidth {
    /// Returns the width of `1 / denominator` octave: of 1 and 3.
    pub fn from_denominator(denominator: i64) -> Option<Self> {
        match denominator {
            1 => Some(Self::Octave),
            3 => Some(Self::ThirdOctave),
            _ => None,
        }
    }

    fn decades(self) -> f64 {
        match self {
            Self::Octave => OCTAVE_DECADES,
            Self::ThirdOctave => OCTAVE_DECADES / 3.0,
        }
    }
}

impl OctaveBand {
    /// Returns the band with this midband frequency, nominal (31.5, 63, 125 Hz) or exact (31.62, 63.10, 125.89 Hz).
    /// None if there is none within 2 %.
    pub fn from_nominal(nominal_hz: f64, width: BandWidth) -> Option<Self> {
        let steps = ((nominal_hz / REFERENCE_HZ).log10() / width.decades()).round();
        let midband_hz = REFERENCE_HZ * 10f64.powf(steps * width.decades());
        let is_near = (nominal_hz / midband_hz - 1.0).abs() < NOMINAL_TOLERANCE;
        is_near.then(|| Self::from_midband(midband_hz, width))
    }

    /// Returns the band with this midband frequency, exact or not, Hz.
    pub fn from_midband(midband_hz: f64, width: BandWidth) -> Self {
        let half = 10f64.powf(width.decades() / 2.0);
        Self { midband_hz, low_hz: midband_hz / half, high_hz: midband_hz * half }
    }

    /// Returns the bandwidth, Hz.
    pub fn width_hz(&self) -> f64 {
        self.high_hz - self.low_hz
    }
}

impl OctaveFilter {
    /// Designs the filter of a band for a sampling rate.
    ///
    /// # Errors
    /// [`Error::Setting`] if the band does not end between 10 Hz and half of the rate.
    pub fn new(band: &OctaveBand, rate_hz: f64) -> Result<Self, Error> {
        if !(band.high_hz > LEAST_EDGE_HZ && band.high_hz < rate_hz / 2.0) {
            let actual = format!("{:.1} Hz at a sampling rate of {rate_hz} Hz", band.high_hz);
            let expected = "over 10 Hz and below half of the rate";
            return Err(Error::Setting { what: "the band's upper edge", actual, expected });
        }
        let angle = TAU * band.midband_hz / rate_hz;
        let low = (PI * band.low_hz / rate_hz).tan();
        let high = (PI * band.high_hz / rate_hz).tan();
        let mut sections = [FilterSection::default(); ORDER];
        for (k, pair) in sections.chunks_exact_mut(2).enumerate() {
            // A pole of the low-pass filter of bandwidth 1, in the left upper quarter.
            let prototype = Complex::from_polar(1.0, PI * (2 * k + 1 + ORDER) as f64 / (2 * ORDER) as f64);
            let middle = prototype * (high - low) / 2.0;
            let root = (middle * middle - low * high).sqrt();
            for (section, pole) in pair.iter_mut().zip([middle + root, middle - root]) {
                *section = FilterSection::from_analogue_pole(pole, angle);
            }
        }
        let mut filter = Self { sections, delay: 0 };
        // The click's response is over its maximum by then: its group delay is 1.23 over the bandwidth.
        let mut click = vec![0.0; 64.max((4.0 * rate_hz / band.width_hz()).ceil() as usize)];
        let mut response = vec![0.0; click.len()];
        click[0] = 1.0;
        filter.filter_samples(&click, &mut response)?;
        filter.delay = first_arrival(&response, ARRIVAL_DB).map_or(0, |samples| samples.round() as usize);
        Ok(filter)
    }

    /// Returns the samples by which the response is advanced. As many at its end are the filter's ringing alone.
    pub fn delay(&self) -> usize {
        self.delay
    }

    /// Filters a response.
    ///
    /// ir, filtered  `[n]`, the unit of `ir`
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn filter_samples<T: RealSample>(&self, ir: &[T], filtered: &mut [T]) -> Result<(), Error> {
        check_len("the filtered response", filtered.len(), ir.len())?;
        let mut states = [[0.0; 2]; ORDER];
        let input = ir.iter().map(|x| x.f64()).chain(std::iter::repeat_n(0.0, self.delay));
        for (n, x) in input.enumerate() {
            let mut signal = x;
            for (section, [near, far]) in self.sections.iter().zip(&mut states) {
                let scaled = section.gain * signal;
                signal = scaled + *near;
                *near = *far - section.first * signal;
                *far = -scaled - section.second * signal;
            }
            if let Some(at) = n.checked_sub(self.delay) {
                filtered[at] = T::of(signal);
            }
        }
        Ok(())
    }

    /// Returns the share of the energy of each bin that passes, of a transform of `len` samples: `[len / 2 + 1]`.
    pub fn bin_shares(&self, len: usize) -> Vec<f64> {
        let gain = |angle: f64| self.sections.iter().map(|section| section.magnitude(angle)).product::<f64>();
        (0..bin_count(len)).map(|bin| gain(TAU * bin as f64 / len as f64).powi(2)).collect()
    }

    #[cfg(test)]
    fn attenuation_db(&self, angle: f64) -> f64 {
        -20.0 * self.sections.iter().map(|section| section.magnitude(angle)).product::<f64>().log10()
    }
}

impl FilterSection {
    /// A section with the pole and its conjugate, of gain 1 at an angle.
    fn from_analogue_pole(pole: Complex<f64>, angle: f64) -> Self {
        let digital = (1.0 + pole) / (1.0 - pole);
        let unscaled = Self { gain: 1.0, first: -2.0 * digital.re, second: digital.norm_sqr() };
        Self { gain: 1.0 / unscaled.magnitude(angle), ..unscaled }
    }

    fn magnitude(&self, angle: f64) -> f64 {
        let delayed = Complex::from_polar(1.0, -angle);
        let numerator = 1.0 - delayed * delayed;
        let denominator = 1.0 + delayed * (self.first + delayed * self.second);
        self.gain * numerator.norm() / denominator.norm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Octaves from the midband frequency, least and greatest relative attenuation (dB) of class 1 from there on.
    /// IEC 61260-1:2014, Table 1. Limits between are linear in the logarithm of frequency.
    const MASK: [(f64, f64, f64); 10] = [
        (0.0, -0.4, 0.4),
        (0.125, -0.4, 0.5),
        (0.25, -0.4, 0.7),
        (0.375, -0.4, 1.4),
        (0.5 - 1e-9, -0.4, 5.3),
        (0.5 + 1e-9, 1.2, f64::INFINITY),
        (1.0, 16.6, f64::INFINITY),
        (2.0, 40.5, f64::INFINITY),
        (3.0, 60.0, f64::INFINITY),
        (4.0, 70.0, f64::INFINITY),
    ];

    /// Frequency over the midband frequency at a number of octaves, which thirds compress: Formula (9).
    fn mask_ratio(octaves: f64, width: BandWidth) -> f64 {
        let edge = |width: BandWidth| 10f64.powf(width.decades() / 2.0) - 1.0;
        1.0 + edge(width) / edge(BandWidth::Octave) * (10f64.powf(octaves * OCTAVE_DECADES) - 1.0)
    }

    fn check_mask(nominal_hz: f64, width: BandWidth, rate_hz: f64) {
        let band = OctaveBand::from_nominal(nominal_hz, width).expect("a band");
        let filter = OctaveFilter::new(&band, rate_hz).expect("a filter");
        let attenuation = |hz: f64| filter.attenuation_db(TAU * hz / rate_hz);
        assert!(attenuation(band.midband_hz).abs() < 1e-9);
        for pair in MASK.windows(2) {
            let (from, least_from, most_from) = pair[0];
            let (to, least_to, most_to) = pair[1];
            let ends = [from, to].map(|octaves| mask_ratio(octaves, width).ln());
            for share in (0..=20).map(|i| f64::from(i) / 20.0) {
                let ratio = (ends[0] + share * (ends[1] - ends[0])).exp();
                let least = least_from + share * (least_to - least_from);
                let most = if most_to.is_finite() { most_from + share * (most_to - most_from) } else { f64::INFINITY };
                for hz in [band.midband_hz * ratio, band.midband_hz / ratio] {
                    let actual = if hz < rate_hz / 2.0 { attenuation(hz) } else { continue };
                    let is_met = (least..=most).contains(&actual);
                    assert!(is_met || to < 0.5 + 2e-9 && from > 0.4, "{nominal_hz} {width:?} {hz} Hz: {actual} dB");
                }
            }
        }
    }

    fn all_bands() -> impl Iterator<Item = (f64, BandWidth, f64)> {
        let thirds = (-10..=16).map(|i| (1000.0 * 10f64.powf(f64::from(i) / 10.0), BandWidth::ThirdOctave));
        let octaves = [63.0, 125.0, 250.0, 500.0, 1e3, 2e3, 4e3, 8e3, 16e3, 31.5e3].map(|hz| (hz, BandWidth::Octave));
        let bands = octaves.into_iter().chain(thirds);
        bands.flat_map(|(hz, width)| [48e3, 96e3].map(|rate| (hz, width, rate))).filter(|(hz, width, rate)| {
            OctaveBand::from_nominal(*hz, *width).is_some_and(|band| band.high_hz < rate / 2.0)
        })
    }

    #[test]
    fn every_band_is_of_class_1() {
        assert!(all_bands().count() > 60);
        all_bands().for_each(|(hz, width, rate)| check_mask(hz, width, rate));
    }

    // Resonalyze's issue 22: a click through a zero-phase filter of 1 kHz arrived 2.1 ms early.
    #[test]
    fn a_click_arrives_within_a_sample_in_every_band() {
        for (hz, width, rate_hz) in all_bands() {
            let filter = OctaveFilter::new(&OctaveBand::from_nominal(hz, width).expect("a band"), rate_hz);
            let mut ir = vec![0.0f32; 40_000];
            ir[300] = -0.5;
            let mut filtered = ir.clone();
            filter.expect("a filter").filter_samples(&ir, &mut filtered).expect("filtered");
            let arrival = first_arrival(&filtered, ARRIVAL_DB).expect("an arrival");
            assert!((arrival - 300.0).abs() <= 1.0, "{hz} {width:?} at {rate_hz}: {arrival}");
        }
    }

    // A tone at the midband frequency keeps its amplitude; the samples agree with the transfer function.
    #[test]
    fn tones_in_the_band_pass() {
        let band = OctaveBand::from_nominal(500.0, BandWidth::ThirdOctave).expect("a band");
        assert!((band.midband_hz - 501.187).abs() < 1e-3 && (band.width_hz() - 115.658).abs() < 1e-3);
        let filter = OctaveFilter::new(&band, 48e3).expect("a filter");
        for (hz, expected) in [(band.midband_hz, 0.0), (band.low_hz, 3.0103), (band.high_hz, 3.0103)] {
            let tone: Vec<f64> = (0..48_000).map(|n| (TAU * hz * f64::from(n) / 48e3).sin()).collect();
            let mut filtered = vec![0.0; tone.len()];
            filter.filter_samples(&tone, &mut filtered).expect("filtered");
            let peak = filtered[20_000..40_000].iter().fold(0.0f64, |most, x| most.max(x.abs()));
            assert!((20.0 * peak.log10() + expected).abs() < 2e-3, "{hz}: {peak}");
        }
    }

    #[test]
    fn bands_that_are_none_are_refused() {
        for nominal_hz in [1500.0, 2500.0, 0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(OctaveBand::from_nominal(nominal_hz, BandWidth::Octave), None, "{nominal_hz}");
        }
        for (nominal_hz, edge) in [(16e3, "22387.2 Hz"), (10f64.powi(-300), "0.0 Hz")] {
            let band = OctaveBand::from_nominal(nominal_hz, BandWidth::Octave).expect("a band");
            let refused = OctaveFilter::new(&band, 44.1e3).expect_err("no such filter").to_string();
            assert!(refused.starts_with(&format!("the band's upper edge is {edge}")), "{refused}");
        }
    }
}
