//! Octaves at full scale around the bands of a rig, for coefficients of materials.

use echolake_schema::Rig;

use crate::Error;
use crate::octave_filter::{BandWidth, OctaveBand, OctaveFilter};

/// Reason for which a band has no measured octave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum OctaveGap {
    /// [`Rig::known_scale`] is none.
    #[error("the rig does not say its scale; hint: `scale` in the rig file, and under [rig] in lake.toml")]
    UnknownScale,
    /// IEC 61260-1 has no octave with this midband frequency.
    #[error("the band is no octave at full scale")]
    NoOctave,
    /// The sweep has a part of the octave alone.
    #[error("the sweep begins or ends within the octave")]
    PartOfSweep,
}

/// Returns the octave of IEC 61260-1 at full scale around a band of a rig, by its frequencies in the measurement.
///
/// # Errors
/// [`OctaveGap::UnknownScale`] and [`OctaveGap::NoOctave`].
///
/// ```
/// use echolake_dsp::full_scale_octave::{OctaveGap, measured_octave, octave_around};
/// use echolake_schema::Rig;
///
/// let rig = Rig::paper();
/// let octave = octave_around(&rig, 40e3)?;
/// assert_eq!((octave.low_hz.round(), octave.high_hz.round()), (28_184.0, 56_234.0));
/// assert_eq!(measured_octave(&rig, 40e3), Err(OctaveGap::PartOfSweep));
/// assert_eq!(octave_around(&rig, 30e3), Err(OctaveGap::NoOctave));
/// # Ok::<(), OctaveGap>(())
/// ```
pub fn octave_around(rig: &Rig, centre_hz: f64) -> Result<OctaveBand, OctaveGap> {
    let scale = rig.known_scale().ok_or(OctaveGap::UnknownScale)?;
    let octave = OctaveBand::from_nominal(centre_hz / scale, BandWidth::Octave).ok_or(OctaveGap::NoOctave)?;
    Ok(OctaveBand::from_midband(octave.midband_hz * scale, BandWidth::Octave))
}

/// Returns the same octave if a rig's sweep has all of it.
///
/// # Errors
/// [`OctaveGap`].
pub fn measured_octave(rig: &Rig, centre_hz: f64) -> Result<OctaveBand, OctaveGap> {
    let octave = octave_around(rig, centre_hz)?;
    let is_whole = rig.sweep.low_hz <= octave.low_hz && octave.high_hz <= rig.sweep.high_hz;
    if is_whole { Ok(octave) } else { Err(OctaveGap::PartOfSweep) }
}

/// Returns what of each bin's energy is in the octave around each band, by [`OctaveFilter`]; None where a rig's sweep
/// has no whole octave.
///
/// # Errors
/// [`Error::Setting`] of a filter.
pub fn bin_shares_of_octaves(rig: &Rig) -> Result<Vec<Option<Vec<f64>>>, Error> {
    let rate_hz = rig.sweep.rate_hz.get();
    let shares = |centre_hz: &f64| {
        let octave = measured_octave(rig, *centre_hz).ok();
        let filter = octave.filter(|octave| octave.high_hz < rate_hz / 2.0).map(|o| OctaveFilter::new(&o, rate_hz));
        Ok(filter.transpose()?.map(|filter| filter.bin_shares(rig.impulse_response.length)))
    };
    rig.bands.centres_hz.iter().map(shares).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn octaves_follow_the_scale() {
        let octaves = |toml: &str| {
            let rig = Rig::from_toml(toml).expect("a rig");
            let centres = rig.bands.centres_hz.clone();
            centres.iter().map(|hz| measured_octave(&rig, *hz).map(|o| o.midband_hz.round())).collect::<Vec<_>>()
        };
        use OctaveGap::*;
        assert_eq!(octaves(""), [Err(PartOfSweep), Ok(5_012.0), Ok(10_000.0), Ok(19_953.0), Err(PartOfSweep)]);
        assert_eq!(octaves("panel.size_mm = 600"), [Err(UnknownScale); 5]);
        let wall = "scale = 1\nbands.centres_hz = [125, 250, 500]\nsweep = { low_hz = 80, high_hz = 20000 }";
        assert_eq!(octaves(wall), [Ok(126.0), Ok(251.0), Ok(501.0)]);
        let wall = "scale = 1\nbands.centres_hz = [150, 300, 600]\nsweep = { low_hz = 80, high_hz = 20000 }";
        assert_eq!(octaves(wall), [Err(NoOctave); 3]);
    }

    // A band-pass filter of octaves halves the energy at its edges, 1.5 dB within them nothing is lost.
    #[test]
    fn shares_are_those_of_the_filter() {
        let shares = bin_shares_of_octaves(&Rig::paper()).expect("filters");
        let of_10k = shares[2].as_ref().expect("whole");
        assert_eq!((shares[0].is_none(), shares[4].is_none(), of_10k.len()), (true, true, 193));
        let at = |hz: f64| of_10k[(hz / 250.0).round() as usize];
        assert!((at(10e3) - 1.0).abs() < 0.01 && (at(7e3) - 0.5).abs() < 0.1 && at(5e3) < 1e-3 && at(20e3) < 1e-3);
    }
}
