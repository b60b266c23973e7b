//! Cost of each kernel, and of the transforms it cannot do without: `just bench kernels`, or `just bench kernels NCE`
//! for those whose name contains it.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use echolake_dsp::air::AirState;
use echolake_dsp::air_correction::{AirCorrectionFit, PairAir, TransformedResponse};
use echolake_dsp::chain::{DerivationPlan, MeasurementParams, MeasurementPlan, raw_len};
use echolake_dsp::deconvolution::{DeconvolutionParams, DeconvolutionPlan, SpectralDivision, TransformLength};
use echolake_dsp::energy::{cumulative_energy, nce, tnce};
use echolake_dsp::far_field::FarFieldPlan;
use echolake_dsp::filter_bank::FilterBankPlan;
use echolake_dsp::height_field::HeightField;
use echolake_dsp::kirchhoff::{KirchhoffPlan, SoundPath, TransducerPose};
use echolake_dsp::rounding::{CURVE_BITS, round_samples};
use echolake_dsp::sweep::{SineSweep, SweepShape};
use echolake_dsp::temperature::{ReferenceAir, TemperatureCorrection};
use echolake_dsp::uncertainty::{EnergyChanges, EnergySensitivity, ResidualFit};
use echolake_dsp::{Error, RealSample as _};
use echolake_schema::Rig;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::{decode_samples, split_24};
use rustfft::FftDirection;
use rustfft::num_complex::Complex;

const RATE_HZ: f64 = 96e3;
const LOW_HZ: f64 = 2e3;
const HIGH_HZ: f64 = 40e3;
const IR_LEN: usize = 384;
const CENTRES_HZ: [f64; 5] = [2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0];

criterion_group!(
    kernels,
    samples,
    transforms,
    deconvolution,
    temperature,
    measurement,
    filter_bank,
    energy,
    derivation,
    air,
    far_field,
    reflection
);
criterion_main!(kernels);

/// The sweep, and what a microphone hears of it 90 samples later.
fn recordings() -> [Vec<f32>; 2] {
    let sweep = SineSweep {
        shape: SweepShape::Linear,
        rate_hz: RATE_HZ,
        duration_secs: 0.5,
        low_hz: LOW_HZ,
        high_hz: HIGH_HZ,
        fade_secs: 0.001,
    };
    let loopback: Vec<f32> = sweep.samples().into_iter().map(|x| x as f32).collect();
    let recording = (0..loopback.len()).map(|n| if n < 90 { 0.0 } else { 0.3 * loopback[n - 90] }).collect();
    [recording, loopback]
}

/// A response as long as the paper's.
fn response() -> Vec<f32> {
    let [_, loopback] = recordings();
    loopback[..IR_LEN].to_vec()
}

/// Samples as a run's file has them.
fn samples(criterion: &mut Criterion) {
    let [recording, _] = recordings();
    let mut out = vec![0.0; recording.len()];
    let stored = split_24(&recording.iter().map(|x| (x * 8_388_607.0) as i32).collect::<Vec<_>>());
    let mut group = criterion.benchmark_group("samples");
    group.throughput(Throughput::Elements(out.len() as u64));
    group.bench_function(BenchmarkId::new("decode", out.len()), |bencher| {
        bencher.iter(|| decode_samples(SampleFormat::S24Split, black_box(&stored), &mut out));
    });
}

/// What the chain has to be compared with: transforms of recording and loopback, one by one and as one.
fn transforms(criterion: &mut Criterion) {
    let [recording, loopback] = recordings();
    let n = recording.len();
    let mut group = criterion.benchmark_group("transform");
    group.throughput(Throughput::Elements(n as u64));
    let forward = f32::plan_real_forward(n);
    let mut input = forward.make_input_vec();
    let mut spectrum = forward.make_output_vec();
    let mut work = forward.make_scratch_vec();
    group.bench_function(BenchmarkId::new("two_real", n), |bencher| {
        bencher.iter(|| {
            for signal in [&recording, &loopback] {
                input.copy_from_slice(signal);
                forward.process_with_scratch(&mut input, &mut spectrum, &mut work).expect("lengths are the plan's");
                black_box(&spectrum);
            }
        });
    });
    let joint = f32::plan_fft(n, FftDirection::Forward);
    let mut signals = vec![Complex::default(); n];
    let mut work = vec![Complex::default(); joint.get_inplace_scratch_len()];
    group.bench_function(BenchmarkId::new("one_complex", n), |bencher| {
        bencher.iter(|| {
            for (z, (x, s)) in signals.iter_mut().zip(recording.iter().zip(&loopback)) {
                *z = Complex::new(*x, *s);
            }
            joint.process_with_scratch(&mut signals, &mut work);
            black_box(&signals);
        });
    });
}

fn deconvolution(criterion: &mut Criterion) {
    let [recording, loopback] = recordings();
    let n = recording.len();
    let params = |length, division| DeconvolutionParams {
        recording_len: n,
        output_len: raw_len(IR_LEN, &reference_air()),
        rate_hz: RATE_HZ,
        low_hz: LOW_HZ,
        high_hz: HIGH_HZ,
        division,
        taper_hz: RATE_HZ / IR_LEN as f64,
        length,
    };
    let mut group = criterion.benchmark_group("deconvolution");
    group.throughput(Throughput::Elements(n as u64));
    let floored = SpectralDivision::Floored { floor_db: SpectralDivision::FLOOR_DB };
    for (name, length, division) in [
        ("fast", TransformLength::Fast, SpectralDivision::Tapered),
        ("fast, floored", TransformLength::Fast, floored),
        ("exact", TransformLength::Exact, SpectralDivision::Tapered),
    ] {
        let plan = DeconvolutionPlan::<f32>::new(params(length, division)).expect("settings of the paper");
        let mut scratch = plan.make_scratch();
        let mut ir = vec![0.0; plan.output_len()];
        group.bench_function(BenchmarkId::new(name, n), |bencher| {
            bencher.iter(|| plan.deconvolve_recording(black_box(&recording), &loopback, &mut ir, &mut scratch));
        });
    }
}

fn reference_air() -> ReferenceAir {
    ReferenceAir::from_response(&Rig::paper().impulse_response)
}

fn temperature(criterion: &mut Criterion) {
    let [_, loopback] = recordings();
    let correction = TemperatureCorrection::<f32>::new();
    let mut corrected = vec![0.0; IR_LEN];
    let mut group = criterion.benchmark_group("temperature");
    group.throughput(Throughput::Elements(IR_LEN as u64));
    // Warmer than the reference, outputs gather inputs; colder, inputs scatter.
    for (name, celsius) in [("gather", 23.7), ("scatter", 15.0)] {
        let rho = reference_air().time_ratio(&AirState::with_known(celsius, None, None));
        let raw = &loopback[..raw_len(IR_LEN, &reference_air())];
        group.bench_function(BenchmarkId::new(name, IR_LEN), |bencher| {
            bencher.iter(|| correction.correct_response(black_box(raw), rho, &mut corrected));
        });
    }
}

fn measurement(criterion: &mut Criterion) {
    let [recording, loopback] = recordings();
    let n = recording.len();
    let plan = MeasurementPlan::<f32>::new(&MeasurementParams {
        recording_len: n,
        ir_len: IR_LEN,
        rate_hz: RATE_HZ,
        low_hz: LOW_HZ,
        high_hz: HIGH_HZ,
        division: SpectralDivision::Tapered,
        reference: reference_air(),
    })
    .expect("settings of the paper");
    let air = AirState::with_known(23.7, None, None);
    let mut scratch = plan.make_scratch();
    let mut ir = vec![0.0; IR_LEN];
    let mut group = criterion.benchmark_group("measurement");
    group.throughput(Throughput::Elements(n as u64));
    group.bench_function(BenchmarkId::new("recording_to_response", n), |bencher| {
        bencher.iter(|| plan.compute_ir(black_box(&recording), &loopback, &air, &mut ir, &mut scratch));
    });
}

fn filter_bank(criterion: &mut Criterion) {
    let ir = response();
    let plan = FilterBankPlan::<f32>::new(IR_LEN, RATE_HZ, &CENTRES_HZ).expect("bands of the paper");
    let mut scratch = plan.make_scratch();
    let mut bands = vec![0.0; plan.band_count() * IR_LEN];
    let mut energies = vec![0.0; plan.band_count()];
    let mut group = criterion.benchmark_group("filter_bank");
    group.throughput(Throughput::Elements(IR_LEN as u64));
    group.bench_function(BenchmarkId::new("bands", IR_LEN), |bencher| {
        bencher.iter(|| plan.split_bands(black_box(&ir), &mut bands, &mut scratch));
    });
    group.bench_function(BenchmarkId::new("energies", IR_LEN), |bencher| {
        bencher.iter(|| plan.compute_energies(black_box(&ir), &mut energies, &mut scratch));
    });
}

fn energy(criterion: &mut Criterion) {
    let bands = response().repeat(CENTRES_HZ.len());
    let mut curves = vec![0.0; bands.len()];
    let mut per_band = [0.0; CENTRES_HZ.len()];
    let mut group = criterion.benchmark_group("energy");
    group.throughput(Throughput::Elements(bands.len() as u64));
    group.bench_function(BenchmarkId::new("nce", IR_LEN), |bencher| {
        bencher.iter(|| {
            cumulative_energy(black_box(&bands), &mut curves, IR_LEN);
            nce(&mut curves, 3.0);
            tnce(&curves, IR_LEN, &mut per_band)
        });
    });
}

fn derivation(criterion: &mut Criterion) {
    let ir = response();
    let foam = vec![0.0; IR_LEN];
    let plan = DerivationPlan::<f32>::new(IR_LEN, RATE_HZ, &CENTRES_HZ).expect("bands of the paper");
    let mut scratch = plan.make_scratch();
    let mut derived = plan.make_derived();
    let energies = plan.flat_energies(&ir, &mut scratch).expect("a response");
    let transformed = transform_response(&ir);
    let mut group = criterion.benchmark_group("derivation");
    group.throughput(Throughput::Elements(IR_LEN as u64));
    group.bench_function(BenchmarkId::new("response_to_curves", IR_LEN), |bencher| {
        bencher.iter(|| -> Result<(), Error> {
            plan.derive_response(black_box(&ir), &foam, &ir, &mut derived, &mut scratch)
        });
    });
    group.bench_function(BenchmarkId::new("with_known_flat", IR_LEN), |bencher| {
        bencher.iter(|| plan.run_over(black_box(&transformed), &energies, &mut derived, &mut scratch));
    });
    let mut sensitivities = [EnergySensitivity::default(); CENTRES_HZ.len()];
    group.bench_function(BenchmarkId::new("sensitivities", IR_LEN), |bencher| {
        let TransformedResponse { spectrum, .. } = &transformed;
        bencher.iter(|| {
            let by_air = |_| EnergyChanges::default();
            plan.compute_sensitivities(black_box(spectrum), spectrum, by_air, &mut sensitivities, &mut scratch)
        });
    });
    let mut residual = ResidualFit::<f32>::new(IR_LEN, RATE_HZ, [LOW_HZ, HIGH_HZ]).expect("settings of the paper");
    let waveform = residual.prepare_direct(&transformed.spectrum, 0.5e-3, 2e-3).expect("a response");
    group.bench_function(BenchmarkId::new("residual", IR_LEN), |bencher| {
        bencher.iter(|| residual.add_pair(black_box(&transformed.spectrum), &waveform));
    });
    let mut rounded = ir.clone();
    group.bench_function(BenchmarkId::new("rounding", IR_LEN), |bencher| {
        bencher.iter(|| round_samples(black_box(&mut rounded), CURVE_BITS));
    });
}

fn transform_response(samples: &[f32]) -> TransformedResponse<f32> {
    let forward = f32::plan_real_forward(samples.len());
    let mut spectrum = forward.make_output_vec();
    forward.process(&mut samples.to_vec(), &mut spectrum).expect("the plan's length");
    TransformedResponse { samples: samples.to_vec(), spectrum }
}

/// Subtraction of the direct sound in the air of a response.
fn air(criterion: &mut Criterion) {
    let ir = response();
    let mut fit = AirCorrectionFit::<f32>::new(IR_LEN, RATE_HZ, [LOW_HZ, HIGH_HZ], reference_air());
    fit.add_pair(&ir, &ir, [0.3, 0.7]).expect("a response");
    let correction = fit.finish();
    let [response, direct] = [21.9, 22.4].map(|celsius| AirState::with_known(celsius, None, None));
    let pair = PairAir { response, direct, direct_m: 0.3, reflected_m: 0.7 };
    let direct = transform_response(&ir);
    let mut reflected = correction.make_reflected();
    let mut scratch = correction.make_scratch();
    let mut group = criterion.benchmark_group("air");
    group.throughput(Throughput::Elements(IR_LEN as u64));
    group.bench_function(BenchmarkId::new("subtract_direct", IR_LEN), |bencher| {
        bencher.iter(|| correction.subtract_direct(black_box(&ir), &direct, &pair, &mut reflected, &mut scratch));
    });
}

/// Far field of a relief in the bands of the paper, three frequencies each.
fn far_field(criterion: &mut Criterion) {
    let relief = HeightField::from_fn(585.0, 274, |x, y| 15.0 * (x / 30.0).sin() + 10.0 * (y / 25.0).cos());
    let waves = |hz: f64| [0.84, 1.0, 1.19].map(|ratio| std::f64::consts::TAU * hz * ratio / 343.0).to_vec();
    let plan = FarFieldPlan::new(&relief, CENTRES_HZ.map(|hz| waves(0.8 * hz)).to_vec());
    let mut group = criterion.benchmark_group("far_field");
    group.throughput(Throughput::Elements((relief.cells() * relief.cells()) as u64));
    group.bench_function(BenchmarkId::new("five_bands", relief.cells()), |bencher| {
        bencher.iter(|| plan.compute_coefficients(black_box(&relief)));
    });
}

/// The simulation of a relief with facets of the size that the rig's simulation has.
fn reflection(criterion: &mut Criterion) {
    const CELLS: usize = 274;
    let relief = HeightField::from_fn(585.0, CELLS, |x, y| 5.0 * (x / 60.0).sin() + 3.0 * (y / 45.0).cos());
    let plan = KirchhoffPlan::new(&relief, RATE_HZ, IR_LEN).with_directivity(|cosine, _| cosine, |cosine, _| cosine);
    let pose = |x| TransducerPose { position_mm: [x, 37.5, 124.0], axis: [0.0, 0.0, -1.0] };
    let one = plan.spectrum_at_bins(|_| 1.0.into());
    let path = SoundPath {
        microphone: pose(-187.5),
        speaker: pose(112.5),
        speed_of_sound_m_s: 343.0,
        absorption_db_per_m: &|_| 1.0,
        direct: &one,
        reflection: &one,
    };
    let mut scratch = plan.make_scratch();
    let mut ir = vec![0.0; IR_LEN];
    let mut group = criterion.benchmark_group("kirchhoff");
    group.throughput(Throughput::Elements((CELLS * CELLS) as u64));
    group.bench_function(BenchmarkId::new("response", CELLS), |bencher| {
        bencher.iter(|| plan.compute_response(black_box(&path), &mut scratch, &mut ir));
    });
}
