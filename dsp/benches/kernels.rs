//! Cost of the chain against the transforms it cannot do without, side by side in one run:
//! `cargo bench -p echolake-dsp`.

use std::hint::black_box;
use std::io::Write as _;
use std::time::Instant;

use echolake_dsp::chain::{DerivationPlan, MeasurementParams, MeasurementPlan, raw_len};
use echolake_dsp::deconvolution::{DeconvolutionParams, DeconvolutionPlan, TransformLength};
use echolake_dsp::sweep::LinearSweep;
use echolake_dsp::temperature::{TemperatureCorrection, resampling_ratio};
use realfft::RealFftPlanner;
use realfft::num_complex::Complex;
use rustfft::FftPlanner;

const RATE_HZ: f64 = 96e3;
const IR_LEN: usize = 384;
const CENTRES_HZ: [f64; 5] = [2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0];
/// Rounds in which the candidates take turns, so that a slow moment of the machine meets them all.
const ROUNDS: usize = 300;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let sweep =
        LinearSweep { rate_hz: RATE_HZ, duration_secs: 0.5, low_hz: 2e3, high_hz: 40e3, fade_secs: 0.001 }.samples();
    let loopback: Vec<f32> = sweep.iter().map(|x| *x as f32).collect();
    let recording: Vec<f32> = (0..loopback.len()).map(|n| if n < 90 { 0.0 } else { 0.3 * loopback[n - 90] }).collect();
    let n = loopback.len();

    let forward = RealFftPlanner::<f32>::new().plan_fft_forward(n);
    let (mut input, mut spectrum) = (forward.make_input_vec(), forward.make_output_vec());
    let mut work = forward.make_scratch_vec();
    let measurement = MeasurementPlan::<f32>::new(&MeasurementParams {
        recording_len: n,
        ir_len: IR_LEN,
        rate_hz: RATE_HZ,
        low_hz: 2e3,
        high_hz: 40e3,
        floor_db: -60.0,
        reference_celsius: 20.0,
    })?;
    let mut measuring = measurement.scratch();
    let mut ir = vec![0.0f32; IR_LEN];
    let derivation = DerivationPlan::<f32>::new(IR_LEN, RATE_HZ, &CENTRES_HZ)?;
    let (mut deriving, mut derived) = (derivation.scratch(), derivation.derived());
    let (foam, flat) = (vec![0.0f32; IR_LEN], loopback[..IR_LEN].to_vec());
    let energies = derivation.flat_energies(&flat, &mut deriving)?;
    let correction = TemperatureCorrection::<f32>::new();
    let raw: Vec<f32> = loopback[..raw_len(IR_LEN, 20.0)].to_vec();
    let mut corrected = vec![0.0f32; IR_LEN];
    let deconvolution = DeconvolutionPlan::<f32>::new(DeconvolutionParams {
        recording_len: n,
        output_len: raw.len(),
        rate_hz: RATE_HZ,
        low_hz: 2e3,
        high_hz: 40e3,
        floor_db: -60.0,
        length: TransformLength::Fast,
    })?;
    let (mut deconvolving, mut deconvolved) = (deconvolution.scratch(), vec![0.0f32; raw.len()]);
    let joint = FftPlanner::<f32>::new().plan_fft_forward(n);
    let mut signals = vec![Complex::default(); n];
    let mut joint_work = vec![Complex::default(); joint.get_inplace_scratch_len()];

    let names = [
        "two bare forward transforms of the recording",
        "recording to response",
        "  joint transform of both signals alone",
        "  deconvolution, with that transform",
        "  temperature correction, air at 23.7 C",
        "  temperature correction, air at 15 C",
        "response to curves and energies",
        "  the same, Flat's energies known",
    ];
    let mut best = [f64::INFINITY; 8];
    for _ in 0..ROUNDS {
        let bare = micros(1, || {
            for signal in [&recording, &loopback] {
                input.copy_from_slice(signal);
                forward.process_with_scratch(&mut input, &mut spectrum, &mut work)?;
                black_box(&spectrum);
            }
            Ok(())
        })?;
        let response = micros(1, || Ok(measurement.ir(&recording, &loopback, 23.7, &mut ir, &mut measuring)?))?;
        let transform = micros(1, || {
            for (z, (x, s)) in signals.iter_mut().zip(recording.iter().zip(&loopback)) {
                *z = Complex::new(*x, *s);
            }
            joint.process_with_scratch(&mut signals, &mut joint_work);
            black_box(&signals);
            Ok(())
        })?;
        let deconvolve = micros(1, || {
            deconvolution.run(&recording, &loopback, &mut deconvolved, &mut deconvolving)?;
            black_box(&deconvolved);
            Ok(())
        })?;
        let [warm, cold] = [23.7, 15.0].map(|celsius| {
            let rho = resampling_ratio(celsius, 20.0);
            micros(50, || {
                correction.run(black_box(&raw), rho, &mut corrected);
                black_box(&corrected);
                Ok(())
            })
        });
        let derive = micros(50, || Ok(derivation.run(&ir, &foam, &flat, &mut derived, &mut deriving)?))?;
        let over = micros(50, || Ok(derivation.run_over(&ir, &foam, &energies, &mut derived, &mut deriving)?))?;
        for (best, now) in best.iter_mut().zip([bare, response, transform, deconvolve, warm?, cold?, derive, over]) {
            *best = best.min(now);
        }
    }

    let bare = best[0];
    let chain = best[1] + best[7];
    let mut out = std::io::stdout().lock();
    writeln!(out, "{n} samples at {RATE_HZ} Hz, f32, one core; best of {ROUNDS} rounds")?;
    for (name, micros) in names.into_iter().zip(best).chain([("whole chain, Flat's energies known", chain)]) {
        writeln!(out, "{name:<46} {micros:>9.1} us {:>7.3} x bare", micros / bare)?;
    }
    Ok(())
}

/// Microseconds that one of `times` runs takes.
fn micros(
    times: usize,
    mut run: impl FnMut() -> Result<(), Box<dyn std::error::Error>>,
) -> Result<f64, Box<dyn std::error::Error>> {
    let start = Instant::now();
    for _ in 0..times {
        run()?;
    }
    Ok(start.elapsed().as_secs_f64() * 1e6 / times as f64)
}
