//! Figures that follow from the rig alone.

use echolake_dsp::fresnel::first_fresnel_zone;
use echolake_figures::{CoverageFigure, CoverageZone, FilterFigure};
use echolake_schema::Point;

use super::source::FigureSource;
use super::{CoverageArgs, FiltersArgs};

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
