//! The paper's three experiments on simulated panels: what mortar joints, the large shape, and stones in place of
//! bricks do to each band.
//!
//! Levels are means of the TNCE values up to their 90th percentile over Flat's same band, in dB, as in the paper's tables
//! but for the normalisation: over Flat's same band, because that is how a band's own change reads. Simulated: the
//! Kirchhoff approximation knows no multiple reflections, no shadows, and no air in the joints.
//!
//! Not converged in CELLS: coarse cells round off joints that are not much wider. Joints 10 mm deep are at 0.00, -0.01,
//! -0.04, -0.15, -0.20 dB with 512 cells, at 0.00, -0.01, -0.06, -0.21, -0.30 dB with 1024. What joints do at 20 and
//! 40 kHz has the wrong sign beside a boundary-element method (docs/devices.md).

use std::io::Write as _;

use anyhow::Result;
use echolake_acquisition::panel::relief::{HeightField, PANEL_SIZE_MM, PanelRelief};
use echolake_dsp::filter_bank::gain;
use echolake_dsp::kirchhoff::{KirchhoffPlan, SoundPath, TransducerPose};
use echolake_dsp::level::{p90_mean, power_to_db};
use echolake_schema::{Grid, Rig};
use realfft::RealFftPlanner;

/// The paper's chain: 96 kHz, 4 ms, a sweep from 2 to 40 kHz, bands an octave apart.
const RATE_HZ: f64 = 96e3;
const SAMPLES: usize = 384;
const SWEEP_HZ: [f64; 2] = [2e3, 40e3];
const CENTRES_HZ: [f64; 5] = [2.5e3, 5e3, 10e3, 20e3, 40e3];
/// The response is computed longer than it is evaluated, so that its end does not ring into it.
const COMPUTED: usize = 1024;
const SPEED_M_S: f64 = 343.0;

/// Levels of the five bands and of their total.
const COLUMNS: usize = CENTRES_HZ.len() + 1;

/// Published results for comparison (Rust et al. 2021).
const PAPER: &str = "The paper's tables give totals of -0.4, -2.3 and +1.6 dB over Flat for its measured 0015_1, 0013_1 \
    and 0005_1.\nTheir parameters are not known here: what can be compared is which bands change, not by how much.";

/// Panels that are compared with the first of them.
struct ReliefExperiment {
    title: &'static str,
    claim: &'static str,
    panels: &'static [ExperimentPanel],
}

/// A name, a relief, and what is set of it.
type ExperimentPanel = (&'static str, &'static str, &'static [(&'static str, &'static str)]);

const BARE: [(&str, &str); 2] = [("projection_mm", "0"), ("lean_mm", "0")];

const EXPERIMENTS: [ReliefExperiment; 3] = [
    ReliefExperiment {
        title: "mortar joints of bricks in stretcher bond, 10 mm wide (full scale)",
        claim: "the paper: joints change only the two upper bands",
        panels: &[
            ("joints 0 mm deep", "stretcher_bond", &[BARE[0], BARE[1], ("joint_depth_mm", "0")]),
            ("joints 5 mm deep", "stretcher_bond", &[BARE[0], BARE[1], ("joint_depth_mm", "5")]),
            ("joints 10 mm deep", "stretcher_bond", &[BARE[0], BARE[1], ("joint_depth_mm", "10")]),
            ("joints 20 mm deep", "stretcher_bond", &[BARE[0], BARE[1], ("joint_depth_mm", "20")]),
        ],
    },
    ReliefExperiment {
        title: "the same bricks, joints 10 mm deep, on large shapes 150 mm deep",
        claim: "the paper: the large shape shows in all bands",
        panels: &[
            ("flat", "stretcher_bond", &BARE),
            (
                "wavy in x",
                "stretcher_bond",
                &[BARE[0], BARE[1], ("macrostructure", "wavy_x"), ("macro_depth_mm", "150")],
            ),
            (
                "wavy in x and y",
                "stretcher_bond",
                &[BARE[0], BARE[1], ("macrostructure", "wavy_xy"), ("macro_depth_mm", "150")],
            ),
            ("convex", "stretcher_bond", &[BARE[0], BARE[1], ("macrostructure", "convex"), ("macro_depth_mm", "150")]),
            (
                "concave",
                "stretcher_bond",
                &[BARE[0], BARE[1], ("macrostructure", "concave"), ("macro_depth_mm", "150")],
            ),
        ],
    },
    ReliefExperiment {
        title: "stone in place of brick, on a flat wall",
        claim: "the paper compares stones with bricks too; its values by band are not known here",
        panels: &[
            ("stretcher bond", "stretcher_bond", &[]),
            ("coursed ashlar", "coursed_ashlar", &[]),
            ("polygonal rubble", "polygonal_rubble", &[]),
            ("river rock", "river_rock", &[]),
            ("slated stone", "slated_stone", &[]),
        ],
    },
];

#[derive(Debug, clap::Args)]
pub(crate) struct ExperimentsArgs {
    /// Facets along each side of a panel.
    #[arg(default_value_t = 512)]
    cells: usize,
    /// Every which of the 2951 pairs; 1 is the whole grid.
    #[arg(default_value_t = 4)]
    every: usize,
}

pub(crate) fn run(args: &ExperimentsArgs) -> Result<()> {
    let (cells, every) = (args.cells, args.every.max(1));
    let lab = ExperimentGrid::new(Rig::paper().grid()?, every);
    let flat = lab.energies(&HeightField::from_fn(PANEL_SIZE_MM, cells, |_, _| 0.0))?;
    let mut out = std::io::stdout().lock();
    writeln!(out, "{} pairs, {cells} x {cells} facets; dB over Flat's same band", lab.pairs.len())?;
    for experiment in &EXPERIMENTS {
        writeln!(out, "\n{}\n({})", experiment.title, experiment.claim)?;
        writeln!(out, "{:<20}   2.5k     5k    10k    20k    40k  total | against the first", "")?;
        let mut first = None;
        for (label, name, settings) in experiment.panels {
            let mut relief = PanelRelief::by_name(name)?;
            settings.iter().try_for_each(|(key, value)| relief.set(key, value))?;
            let levels = levels_db(&lab.energies(&relief.height_field(cells))?, &flat);
            let against = *first.get_or_insert(levels);
            write!(out, "{label:<20}")?;
            levels.iter().try_for_each(|level| write!(out, " {level:6.2}"))?;
            write!(out, " |")?;
            levels.iter().zip(against).try_for_each(|(level, other)| write!(out, " {:6.2}", level - other))?;
            writeln!(out)?;
            out.flush()?;
        }
    }
    writeln!(out, "\n{PAPER}")?;
    Ok(())
}

/// The grid, and the weights of the bands.
struct ExperimentGrid {
    points_mm: Vec<[f64; 3]>,
    pairs: Vec<[usize; 2]>,
    /// Weight of each bin in each band's energy.
    weights: Vec<[f64; COLUMNS]>,
}

impl ExperimentGrid {
    fn new(grid: Grid, every: usize) -> Self {
        let points_mm: Vec<_> = grid.points().iter().map(|p| p.position_mm).collect();
        let pairs = grid.pairs().iter().step_by(every).map(|p| [p.microphone.index(), p.speaker.index()]).collect();
        Self { points_mm, pairs, weights: (0..SAMPLES / 2 + 1).map(weights).collect() }
    }

    /// Energy of the reflection in each band and in all, of each pair.
    fn energies(&self, heights: &HeightField) -> Result<Vec<[f64; COLUMNS]>, echolake_dsp::Error> {
        let plan = KirchhoffPlan::new(heights, RATE_HZ, COMPUTED);
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let share = self.pairs.len().div_ceil(threads);
        std::thread::scope(|scope| {
            let plan = &plan;
            let work = |pairs| scope.spawn(move || self.measured(plan, pairs));
            let workers: Vec<_> = self.pairs.chunks(share).map(work).collect();
            let mut energies = Vec::with_capacity(self.pairs.len());
            for worker in workers {
                energies.extend(worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?);
            }
            Ok(energies)
        })
    }

    fn measured(&self, plan: &KirchhoffPlan, pairs: &[[usize; 2]]) -> Result<Vec<[f64; COLUMNS]>, echolake_dsp::Error> {
        let (mut scratch, mut response) = (plan.scratch(), vec![0.0; COMPUTED]);
        let (silence, rigid) = (plan.filter(|_| 0.0.into()), plan.filter(|_| 1.0.into()));
        let forward = RealFftPlanner::<f32>::new().plan_fft_forward(SAMPLES);
        let (mut ir, mut spectrum) = (forward.make_input_vec(), forward.make_output_vec());
        let mut energies = Vec::with_capacity(pairs.len());
        for pair in pairs {
            let [microphone, speaker] =
                pair.map(|point| TransducerPose { position_mm: self.points_mm[point], axis: [0.0, 0.0, -1.0] });
            let path = SoundPath {
                microphone,
                speaker,
                speed_of_sound_m_s: SPEED_M_S,
                absorption_db_per_m: &|_| 0.0,
                direct: &silence,
                reflection: &rigid,
            };
            plan.response(&path, &mut scratch, &mut response)?;
            ir.copy_from_slice(&response[..SAMPLES]);
            // The buffers are the plan's own.
            let _ = forward.process(&mut ir, &mut spectrum);
            let mut energy = [0.0; COLUMNS];
            for (bin, weights) in spectrum.iter().zip(&self.weights) {
                energy.iter_mut().zip(weights).for_each(|(e, w)| *e += w * f64::from(bin.norm_sqr()));
            }
            energies.push(energy);
        }
        Ok(energies)
    }
}

// The squared gains of the bank within the sweep's range; their sum for the total.
fn weights(bin: usize) -> [f64; COLUMNS] {
    let frequency_hz = bin as f64 * RATE_HZ / SAMPLES as f64;
    let mut weights = [0.0; COLUMNS];
    if (SWEEP_HZ[0]..=SWEEP_HZ[1]).contains(&frequency_hz) {
        for (band, weight) in weights[..CENTRES_HZ.len()].iter_mut().enumerate() {
            *weight = gain(&CENTRES_HZ, band, frequency_hz).powi(2);
        }
        weights[COLUMNS - 1] = weights.iter().sum();
    }
    weights
}

fn levels_db(energies: &[[f64; COLUMNS]], flat: &[[f64; COLUMNS]]) -> [f64; COLUMNS] {
    let mut scratch = Vec::new();
    std::array::from_fn(|band| {
        let ratios: Vec<_> = energies.iter().zip(flat).map(|(e, flat)| e[band] / flat[band]).collect();
        p90_mean(&ratios, &mut scratch).map_or(f64::NAN, power_to_db)
    })
}
