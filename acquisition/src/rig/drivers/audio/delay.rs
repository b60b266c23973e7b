//! Delay of an output in a recording: the one of highest correlation.

use echolake_dsp::RealSample as _;
use realfft::num_complex::Complex;

/// Position of an output in a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LoopbackDelay {
    /// First sample of the output.
    pub at: usize,
    /// Correlation there, -1 to 1.
    pub likeness: f64,
}

/// Finds an output in a recording that is longer than it. A silent recording has a likeness of 0.
///
/// output     `[n]`      full scale 1.0
/// recording  `[n + m]`  any scale; delays 0 to m are tried
pub(super) fn locate_output(output: &[f32], recording: &[i32]) -> LoopbackDelay {
    let (Some(most), false) = (recording.len().checked_sub(output.len()), output.is_empty()) else {
        return LoopbackDelay { at: 0, likeness: 0.0 };
    };
    let len = (recording.len() + output.len()).next_power_of_two();
    let forward = f64::plan_real_forward(len);
    let inverse = f64::plan_real_inverse(len);
    let spectrum = |samples: &mut dyn Iterator<Item = f64>| -> Vec<Complex<f64>> {
        let mut signal: Vec<f64> = samples.collect();
        signal.resize(len, 0.0);
        let mut spectrum = forward.make_output_vec();
        // Lengths are the plan's own, so it cannot refuse.
        let _ = forward.process(&mut signal, &mut spectrum);
        spectrum
    };
    let sent = spectrum(&mut output.iter().map(|x| f64::from(*x)));
    let mut product = spectrum(&mut recording.iter().map(|x| f64::from(*x)));
    product.iter_mut().zip(&sent).for_each(|(x, sent)| *x *= sent.conj());
    let mut correlation = inverse.make_output_vec();
    let _ = inverse.process(&mut product, &mut correlation);

    let energy_sent: f64 = output.iter().map(|x| f64::from(*x).powi(2)).sum();
    let square = |n: usize| f64::from(recording[n]).powi(2);
    let mut energy: f64 = (0..output.len()).map(square).sum();
    let mut best = LoopbackDelay { at: 0, likeness: 0.0 };
    for (at, alike) in correlation.iter().enumerate().take(most + 1) {
        let norm = (energy * energy_sent).sqrt();
        let likeness = if norm > 0.0 { alike / len as f64 / norm } else { 0.0 };
        if likeness > best.likeness {
            best = LoopbackDelay { at, likeness };
        }
        if at < most {
            energy += square(at + output.len()) - square(at);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_are_found_to_the_sample() {
        let output: Vec<f32> = (0..3_000).map(|n| n as f32).map(|n| (n * (0.2 + n * 2e-4)).sin()).collect();
        for delay in [0, 1, 37, 499, 500] {
            let mut recording = vec![0; 3_500];
            for (n, x) in output.iter().enumerate() {
                recording[delay + n] = (-1e6 * x) as i32;
            }
            // Turned upside down it is not alike, whatever the delay.
            assert!(locate_output(&output, &recording).likeness < 0.5);
            recording.iter_mut().for_each(|x| *x = -*x);
            let found = locate_output(&output, &recording);
            assert!(found.at == delay && found.likeness > 0.999, "{delay}: {found:?}");
        }
    }

    #[test]
    fn nothing_is_like_silence() {
        for (output, recording) in [(vec![1.0; 10], vec![0; 20]), (vec![], vec![1; 5]), (vec![1.0; 10], vec![1; 5])] {
            assert_eq!(locate_output(&output, &recording), LoopbackDelay { at: 0, likeness: 0.0 });
        }
    }
}
