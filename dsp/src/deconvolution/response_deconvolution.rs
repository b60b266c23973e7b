//! Deconvolution in the precision and length that its division asks for.

use crate::deconvolution::{
    DeconvolutionParams, DeconvolutionPlan, DeconvolutionScratch, JointSpectrum, SpectralDivision, TransformLength,
};
use crate::{Error, RealSample};

/// A [`DeconvolutionPlan`] whose numbers are those of its division's definition.
///
/// If nothing is left beyond the sweep's range, padding and single precision make no difference. With a floor, and more
/// so without one, bins in which the loopback has next to no power decide what is found there: the transforms have the
/// recording's own length, and literal division is done in double precision.
pub struct ResponseDeconvolution<T: RealSample>(Precision<T>);

enum Precision<T: RealSample> {
    Same(DeconvolutionPlan<T>),
    Double(DeconvolutionPlan<f64>),
}

/// Buffers of a [`ResponseDeconvolution`].
pub struct ResponseScratch<T: RealSample>(PrecisionScratch<T>);

enum PrecisionScratch<T: RealSample> {
    Same(DeconvolutionScratch<T>),
    Double { scratch: DeconvolutionScratch<f64>, recording: Vec<f64>, loopback: Vec<f64>, ir: Vec<f64> },
}

impl<T: RealSample> ResponseDeconvolution<T> {
    /// Plans the transforms; the settings' length counts for [`SpectralDivision::Tapered`] alone.
    ///
    /// # Errors
    /// As [`DeconvolutionPlan::new`].
    pub fn new(params: DeconvolutionParams) -> Result<Self, Error> {
        let exact = DeconvolutionParams { length: TransformLength::Exact, ..params };
        Ok(Self(match params.division {
            SpectralDivision::Tapered => Precision::Same(DeconvolutionPlan::new(params)?),
            SpectralDivision::Floored { .. } => Precision::Same(DeconvolutionPlan::new(exact)?),
            SpectralDivision::Literal => Precision::Double(DeconvolutionPlan::new(exact)?),
        }))
    }

    /// Buffers for [`Self::run_within`]; one per thread.
    pub fn make_scratch(&self) -> ResponseScratch<T> {
        ResponseScratch(match &self.0 {
            Precision::Same(plan) => PrecisionScratch::Same(plan.make_scratch()),
            Precision::Double(plan) => PrecisionScratch::Double {
                scratch: plan.make_scratch(),
                recording: Vec::new(),
                loopback: Vec::new(),
                ir: vec![0.0; plan.output_len()],
            },
        })
    }

    /// Samples of the response that a run gives.
    pub fn output_len(&self) -> usize {
        match &self.0 {
            Precision::Same(plan) => plan.output_len(),
            Precision::Double(plan) => plan.output_len(),
        }
    }

    /// Returns the spectrum of what was deconvolved last with these buffers; None of another precision.
    pub fn joint_spectrum<'a>(&self, scratch: &'a mut ResponseScratch<T>) -> Option<JointSpectrum<'a, T>> {
        match (&self.0, &mut scratch.0) {
            (Precision::Same(plan), PrecisionScratch::Same(scratch)) => Some(plan.joint_spectrum(scratch)),
            _ => None,
        }
    }

    /// Deconvolves one recording; tapered division tapers at these limits.
    ///
    /// # Errors
    /// As [`DeconvolutionPlan::run_within`].
    pub fn run_within(
        &self,
        limits_hz: [f64; 2],
        recording: &[T],
        loopback: &[T],
        ir: &mut [T],
        scratch: &mut ResponseScratch<T>,
    ) -> Result<(), Error> {
        match (&self.0, &mut scratch.0) {
            (Precision::Same(plan), PrecisionScratch::Same(scratch)) => {
                plan.run_within(limits_hz, recording, loopback, ir, scratch)
            }
            (Precision::Double(plan), PrecisionScratch::Double { scratch, recording: x, loopback: s, ir: wide }) => {
                for (to, from) in [(&mut *x, recording), (&mut *s, loopback)] {
                    to.clear();
                    to.extend(from.iter().map(|sample| sample.f64()));
                }
                crate::error::check_len("the response", ir.len(), wide.len())?;
                plan.run_within(limits_hz, x, s, wide, scratch)?;
                ir.iter_mut().zip(&*wide).for_each(|(to, from)| *to = T::of(*from));
                Ok(())
            }
            _ => Err(Error::Setting {
                what: "the buffers",
                actual: "those of another plan".into(),
                expected: "those of this plan",
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::{SineSweep, SweepShape};

    // A length with a large prime factor, so that padding would change it.
    const LEN: usize = 4_898;
    const RANGE_HZ: [f64; 2] = [2e3, 40e3];

    fn params(division: SpectralDivision) -> DeconvolutionParams {
        DeconvolutionParams {
            recording_len: LEN,
            output_len: 384,
            rate_hz: 96e3,
            low_hz: RANGE_HZ[0],
            high_hz: RANGE_HZ[1],
            division,
            taper_hz: 250.0,
            length: TransformLength::Exact,
        }
    }

    // The greatest difference between single precision and the definition in double precision, over the greatest
    // sample.
    fn difference(division: SpectralDivision) -> f64 {
        let sweep = SineSweep {
            shape: SweepShape::Linear,
            rate_hz: 96e3,
            duration_secs: 0.04,
            low_hz: 2e3,
            high_hz: 40e3,
            fade_secs: 0.001,
        };
        let mut loopback = sweep.samples();
        loopback.resize(LEN, 0.0);
        let noise = |n: usize| ((n * 7919) % 1013) as f64 / 1e6 - 5e-4;
        let heard = |n: usize| if n < 90 { 0.0 } else { 0.6 * loopback[n - 90] };
        let narrow = |x: &dyn Fn(usize) -> f64| (0..LEN).map(|n| x(n) as f32).collect::<Vec<_>>();
        let (recording, loopback) = (narrow(&|n| heard(n) + noise(n)), narrow(&|n| loopback[n] + noise(n + 17)));
        let wide = |x: &[f32]| x.iter().map(|x| f64::from(*x)).collect::<Vec<_>>();
        let exact = DeconvolutionPlan::<f64>::new(params(division)).expect("a plan");
        let mut expected = vec![f64::NAN; 384];
        exact
            .deconvolve_recording(&wide(&recording), &wide(&loopback), &mut expected, &mut exact.make_scratch())
            .expect("a response");
        let plan = ResponseDeconvolution::<f32>::new(params(division)).expect("a plan");
        let (mut found, mut scratch) = (vec![f32::NAN; plan.output_len()], plan.make_scratch());
        plan.run_within(RANGE_HZ, &recording, &loopback, &mut found, &mut scratch).expect("a response");
        let greatest = expected.iter().fold(0.0f64, |most, x| most.max(x.abs()));
        found.iter().zip(&expected).fold(0.0f64, |most, (a, b)| most.max((f64::from(*a) - b).abs())) / greatest
    }

    #[test]
    fn each_division_gives_the_numbers_of_its_definition() {
        for (division, limit) in [
            (SpectralDivision::Literal, 1e-6),
            (SpectralDivision::Floored { floor_db: SpectralDivision::FLOOR_DB }, 2e-5),
        ] {
            let difference = difference(division);
            assert!(difference < limit, "{division:?}: {difference}");
        }
    }

    #[test]
    fn buffers_of_another_plan_are_refused() {
        let [tapered, literal] = [SpectralDivision::Tapered, SpectralDivision::Literal]
            .map(|division| ResponseDeconvolution::<f32>::new(params(division)).expect("a plan"));
        let (samples, mut ir) = (vec![1.0; LEN], vec![0.0; 384]);
        let result = tapered.run_within(RANGE_HZ, &samples, &samples, &mut ir, &mut literal.make_scratch());
        assert!(matches!(result, Err(Error::Setting { .. })), "{result:?}");
        let result = literal.run_within(RANGE_HZ, &samples, &samples, &mut ir[1..], &mut literal.make_scratch());
        assert!(matches!(result, Err(Error::Length { .. })), "{result:?}");
    }
}
