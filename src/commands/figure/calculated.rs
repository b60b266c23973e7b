//! Figures that follow from the rig, or from a relief's parameters, alone.

use anyhow::Context as _;
use echolake_acquisition::rig::robots::{Choreography, Tool};
use echolake_dsp::fresnel::first_fresnel_zone;
use echolake_dsp::heights::shade_heights;
use echolake_figures::{
    ArmLink, CoverageFigure, CoverageZone, FilterFigure, ReliefFigure, ReliefPanel, SetupArm, SetupFigure,
};
use echolake_panel::mesh::BACK_MM;
use echolake_panel::relief::{HeightField, PanelRelief};
use echolake_schema::{PairId, Point};

use super::source::FigureSource;
use super::{CoverageArgs, FiltersArgs, GenerationArgs, SetupArgs};

/// Cells along each side of a relief's picture.
const PICTURE_CELLS: usize = 400;
/// Speed of sound at 20 C, m/s, as of table `pairs`.
const SPEED_M_S: f64 = 343.0;

pub(super) fn write_filters(source: &FigureSource, args: &FiltersArgs) -> anyhow::Result<()> {
    let rig = source.lake.rig();
    let centres_hz = rig.bands.centres_hz.clone();
    let figure = FilterFigure { centres_hz, low_hz: rig.sweep.low_hz, high_hz: rig.sweep.high_hz, width_px: 620.0 };
    let title = args.output.title_or(|| "Filter bank".into());
    args.output.write_drawing(&figure.draw(&source.figure_notes(title, String::new(), &[])), &[])
}

pub(super) fn write_coverage(source: &FigureSource, args: &CoverageArgs) -> anyhow::Result<()> {
    let rig = source.lake.rig();
    let grid = source.lake.grid();
    let points: Vec<_> = grid.points().iter().filter(|point| point.layer == args.layer).collect();
    anyhow::ensure!(!points.is_empty(), "the grid has no layer {}; hint: the lowest is 0", args.layer);
    let point = |id| grid.point(id).filter(|point| point.layer == args.layer);
    let pairs = grid.pairs().iter().filter_map(|pair| Some((point(pair.microphone)?, point(pair.speaker)?)));
    let pairs: Vec<_> = pairs.collect();
    let frequencies = match args.frequencies.is_empty() {
        true => vec![rig.sweep.high_hz, rig.sweep.low_hz],
        false => args.frequencies.clone(),
    };
    anyhow::ensure!(frequencies.iter().all(|hz| *hz > 0.0 && hz.is_finite()), "`--frequencies` are Hz, above 0");
    let zones = |hz: f64| pairs.iter().map(|(microphone, speaker)| coverage_zone(microphone, speaker, hz)).collect();
    let figure = CoverageFigure {
        panel_mm: rig.panel.size_mm,
        points_mm: points.iter().map(|point| [point.position_mm[0], point.position_mm[1]]).collect(),
        frequencies: frequencies.iter().map(|hz| (*hz, zones(*hz))).collect(),
        panel_px: 300.0,
    };
    let title = args.output.title_or(|| format!("First Fresnel zones of the pairs of layer {}", args.layer));
    args.output.write_drawing(&figure.draw(&source.figure_notes(title, String::new(), &[])), &[])
}

fn coverage_zone(microphone: &Point, speaker: &Point, frequency_hz: f64) -> CoverageZone {
    let to = microphone.position_mm;
    let from = speaker.position_mm;
    let zone = first_fresnel_zone(to, from, frequency_hz, SPEED_M_S);
    CoverageZone {
        centre_mm: zone.centre_mm,
        radii_mm: [zone.semi_major_mm, zone.semi_minor_mm],
        angle_deg: (to[1] - from[1]).atan2(to[0] - from[0]).to_degrees(),
    }
}

pub(super) fn write_generation(source: &FigureSource, args: &GenerationArgs) -> anyhow::Result<()> {
    let mut relief = PanelRelief::by_name(&args.name)?;
    super::super::acquire::set_all(&mut relief, &args.set)?;
    let steps = relief.generation_steps();
    anyhow::ensure!(!steps.is_empty(), "`{}` has no stones with joints; hint: flemish_bond or river_rock", args.name);
    let mut panels = Vec::new();
    for step in steps {
        let heights = step.relief.height_field(PICTURE_CELLS);
        panels.push(generation_panel(step.caption, &heights)?);
    }
    let columns = panels.len();
    let figure = ReliefFigure { panels, panel_mm: source.lake.rig().panel.size_mm, panel_px: 200.0, columns };
    let title = args.output.title_or(|| format!("Generation of {}", args.name));
    args.output.write_drawing(&figure.draw(&source.figure_notes(title, String::new(), &[])), &[])
}

fn generation_panel(caption: &str, heights: &HeightField) -> anyhow::Result<ReliefPanel> {
    Ok(ReliefPanel {
        title: caption.to_owned(),
        shaded: shade_heights(heights.heights_mm(), heights.pitch_mm() as f32)?,
        cells: heights.cells(),
        extent_mm: heights.extent_mm().map(f64::from),
    })
}

pub(super) fn write_setup(source: &FigureSource, args: &SetupArgs) -> anyhow::Result<()> {
    let rig = source.lake.rig();
    let points = source.lake.grid().points();
    let arms = Choreography::new(rig)?;
    let pair = PairId(args.pair);
    let pairs = source.lake.grid().pairs().len();
    anyhow::ensure!((args.pair as usize) < pairs, "the grid has no pair {}; hint: 0 to {}", args.pair, pairs - 1);
    let pose = arms.pose_at(pair).map_err(|reason| anyhow::anyhow!("{}", reason.reason_text()));
    let pose = pose.with_context(|| format!("the arms cannot stand at pair {}", args.pair))?;
    let cell = arms.cell();
    let layers = points.iter().map(|point| point.layer).max().unwrap_or(0);
    let layer = |number| points.iter().filter(|p| p.layer == number).map(|p| p.position_mm).collect();
    let arm = |(tool, joints, name): (Tool, _, &str)| {
        let links = cell.arm_with_tool(tool).link_capsules(joints).map(|link| ArmLink {
            from_mm: (1e3 * link.from).to_array(),
            to_mm: (1e3 * link.to).to_array(),
            radius_mm: 1e3 * link.radius,
        });
        SetupArm { name: name.to_owned(), links: links.to_vec() }
    };
    let figure = SetupFigure {
        panel_mm: rig.panel.size_mm,
        bottom_mm: f64::from(BACK_MM),
        layers_mm: (0..=layers).map(layer).collect(),
        arms: [(Tool::Microphone, &pose.microphone, "microphone"), (Tool::Speaker, &pose.speaker, "speaker")]
            .map(arm)
            .to_vec(),
        width_px: 620.0,
    };
    let title = args.output.title_or(|| format!("Grid, arms and panel, pair {}", args.pair));
    args.output.write_drawing(&figure.draw(&source.figure_notes(title, String::new(), &[])), &[])
}
