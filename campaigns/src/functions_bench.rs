//! Cost of the list functions through SQL's machinery against a plain loop over the same samples, side by side in one
//! run.

use std::hint::black_box;
use std::io::Write as _;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, Result};
use arrow::array::{ArrayRef, Float32Array, ListArray};
use arrow::buffer::OffsetBuffer;
use arrow::datatypes::{DataType, Field};
use datafusion::common::ScalarValue;
use datafusion::config::ConfigOptions;
use datafusion::logical_expr::{ColumnarValue, ReturnFieldArgs, ScalarFunctionArgs, ScalarUDF};
use echolake_dsp::arrival::first_arrival;
use echolake_dsp::correlation::{CorrelationPlan, pearson};
use echolake_dsp::decay::energy_decay_db;
use echolake_dsp::diffusion::diffusion;
use echolake_dsp::filter_bank::FilterBankPlan;
use echolake_dsp::heights::moved;
use echolake_dsp::spectrum::SpectrumPlan;
use echolake_query::FunctionSet;
use echolake_schema::{Rig, Symmetry};

/// Responses, as many as a surface has.
const ROWS: usize = 2951;
const LEN: usize = 384;
const RATE_HZ: f64 = 96e3;
const CENTRES_HZ: [f64; 5] = [2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0];
/// Rounds in which function and loop take turns; the best of each counts.
const ROUNDS: usize = 15;

/// The functions, and their input.
struct FunctionsBench {
    functions: FunctionSet,
    samples: Vec<f32>,
    lists: ArrayRef,
    out: std::io::StdoutLock<'static>,
}

pub(crate) fn run() -> Result<()> {
    // Decaying noise of a fixed seed: like responses, and without the zeros that some loops would be fast on.
    let mut state = 1u32;
    let samples: Vec<f32> = (0..ROWS * LEN)
        .map(|i| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            ((state >> 8) as f32 / 8_388_608.0 - 1.0) * (-((i % LEN) as f32) / 60.0).exp()
        })
        .collect();
    let lists = lists(&samples, LEN)?;
    let functions = FunctionSet::all(&Rig::paper())?;
    let mut bench = FunctionsBench { functions, samples, lists, out: std::io::stdout().lock() };
    writeln!(bench.out, "{ROWS} lists of {LEN} f32, one core; best of {ROUNDS} rounds")?;
    writeln!(bench.out, "{:<24} {:>12} {:>12} {:>7}", "function", "rows/s", "loop rows/s", "ratio")?;
    bench.arithmetic()?;
    bench.responses()?;
    bench.transforms()
}

fn lists(samples: &[f32], len: usize) -> Result<ArrayRef> {
    let offsets = OffsetBuffer::from_lengths(std::iter::repeat_n(len, samples.len() / len));
    let field = Arc::new(Field::new("element", DataType::Float32, false));
    Ok(Arc::new(ListArray::try_new(field, offsets, Arc::new(Float32Array::from(samples.to_vec())), None)?))
}

fn rows(samples: &[f32]) -> impl Iterator<Item = &[f32]> {
    samples.chunks_exact(LEN)
}

fn invoke(function: &ScalarUDF, args: &[ColumnarValue], number_rows: usize) -> Result<ColumnarValue> {
    let field = |value: &ColumnarValue| Arc::new(Field::new("x", value.data_type(), true));
    let arg_fields: Vec<_> = args.iter().map(field).collect();
    let constants = vec![None; args.len()];
    let return_field =
        function.return_field_from_args(ReturnFieldArgs { arg_fields: &arg_fields, scalar_arguments: &constants })?;
    let config_options = Arc::new(ConfigOptions::default());
    let args = ScalarFunctionArgs { args: args.to_vec(), arg_fields, number_rows, return_field, config_options };
    Ok(function.invoke_with_args(args)?)
}

impl FunctionsBench {
    fn arithmetic(&mut self) -> Result<()> {
        let samples = std::mem::take(&mut self.samples);
        let both = [self.column(), self.column()];
        self.against("list_energy", &both[..1], ROWS, || {
            rows(&samples).map(|x| x.iter().map(|x| f64::from(*x) * f64::from(*x)).sum()).collect::<Vec<f64>>()
        })?;
        self.against("list_multiply", &both, ROWS, || {
            let mut out = Vec::with_capacity(samples.len());
            rows(&samples).for_each(|x| out.extend(x.iter().zip(x).map(|(x, y)| x * y)));
            out
        })?;
        self.against("list_db", &both[..1], ROWS, || {
            let mut out = Vec::with_capacity(samples.len());
            rows(&samples).for_each(|x| out.extend(x.iter().map(|x| (10.0 * f64::from(*x).log10()) as f32)));
            out
        })?;
        self.against("diffusion", &both[..1], ROWS, || rows(&samples).map(diffusion).collect::<Vec<_>>())?;
        self.against("pearson", &both, ROWS, || rows(&samples).map(|x| pearson(x, x)).collect::<Vec<_>>())?;
        self.samples = samples;
        Ok(())
    }

    fn responses(&mut self) -> Result<()> {
        let samples = std::mem::take(&mut self.samples);
        let ir = [self.column()];
        self.against("edc", &ir, ROWS, || {
            let mut out = vec![0.0; samples.len()];
            for (x, out) in rows(&samples).zip(out.chunks_exact_mut(LEN)) {
                black_box(energy_decay_db(x, out));
            }
            out
        })?;
        self.against("arrival", &ir, ROWS, || rows(&samples).map(|x| first_arrival(x, -20.0)).collect::<Vec<_>>())?;
        let with_flat = [self.column(), ColumnarValue::Scalar(ScalarValue::Float64(Some(2.0)))];
        self.against("nce, whole", &with_flat, ROWS, || {
            let mut out = vec![0.0; samples.len()];
            for (x, out) in rows(&samples).zip(out.chunks_exact_mut(LEN)) {
                echolake_dsp::energy::cumulate_whole(x, 2.0, out);
            }
            out
        })?;
        let maps = lists(&samples[..64 * 16_384], 16_384)?;
        let turned = [ColumnarValue::Array(maps), ColumnarValue::Scalar(ScalarValue::Utf8(Some("rot90".into())))];
        self.against("d4_heightmap, 128 x 128", &turned, 64, || {
            let mut out = vec![0.0; 64 * 16_384];
            for (x, out) in samples.chunks_exact(16_384).zip(out.chunks_exact_mut(16_384)) {
                black_box(moved(x, Symmetry::Rot90, out).is_ok());
            }
            out
        })?;
        self.samples = samples;
        Ok(())
    }

    fn transforms(&mut self) -> Result<()> {
        let samples = std::mem::take(&mut self.samples);
        let both = [self.column(), self.column()];
        let bank = FilterBankPlan::<f32>::new(LEN, RATE_HZ, &CENTRES_HZ)?;
        let (mut scratch, mut energies) = (bank.scratch(), [0.0; 5]);
        self.against("band_energy", &both[..1], ROWS, || {
            let energies = rows(&samples).map(|x| bank.energies(x, &mut energies, &mut scratch).map(|()| energies));
            energies.collect::<Vec<_>>()
        })?;
        let one_band = [
            self.column(),
            ColumnarValue::Scalar(ScalarValue::Float64(Some(2.0))),
            ColumnarValue::Scalar(ScalarValue::Float64(Some(5_000.0))),
        ];
        let mut bands = vec![0.0; 5 * LEN];
        self.against("nce, one band", &one_band, ROWS, || {
            let mut out = vec![0.0; samples.len()];
            for (x, out) in rows(&samples).zip(out.chunks_exact_mut(LEN)) {
                black_box(bank.run(x, &mut bands, &mut scratch).is_ok());
                echolake_dsp::energy::cumulate_whole(&bands[LEN..2 * LEN], 2.0, out);
            }
            out
        })?;
        let spectrum = SpectrumPlan::<f32>::new(LEN)?;
        let mut scratch = spectrum.scratch();
        self.against("spectrum", &both[..1], ROWS, || {
            let mut out = vec![0.0; ROWS * (LEN / 2 + 1)];
            for (x, out) in rows(&samples).zip(out.chunks_exact_mut(LEN / 2 + 1)) {
                black_box(spectrum.levels_db(x, out, &mut scratch).is_ok());
            }
            out
        })?;
        let correlation = CorrelationPlan::<f32>::new(LEN)?;
        let mut scratch = correlation.scratch();
        self.against("similarity", &both, ROWS, || {
            rows(&samples).map(|x| correlation.similarity(x, x, &mut scratch)).collect::<Vec<_>>()
        })?;
        self.samples = samples;
        Ok(())
    }

    fn column(&self) -> ColumnarValue {
        ColumnarValue::Array(self.lists.clone())
    }

    fn against<O>(
        &mut self,
        label: &str,
        args: &[ColumnarValue],
        count: usize,
        mut plain: impl FnMut() -> O,
    ) -> Result<()> {
        let name = label.split(',').next().unwrap_or(label);
        let found = self.functions.scalar().iter().find(|f| f.name() == name);
        let function = found.with_context(|| format!("no function `{name}`"))?;
        let (mut ours, mut theirs) = (f64::INFINITY, f64::INFINITY);
        for _ in 0..ROUNDS {
            let start = Instant::now();
            black_box(invoke(function, args, count)?);
            ours = ours.min(start.elapsed().as_secs_f64());
            let start = Instant::now();
            black_box(plain());
            theirs = theirs.min(start.elapsed().as_secs_f64());
        }
        let rate = |secs: f64| count as f64 / secs;
        writeln!(self.out, "{label:<24} {:>12.0} {:>12.0} {:>7.2}", rate(ours), rate(theirs), ours / theirs)?;
        Ok(())
    }
}
