//! The arms' way through a grid: the published visiting order, the grid's own and the planned one side by side, and
//! what the model says of the pairs that the grid leaves out.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Result;
use echolake_acquisition::rig::robots::{
    ArmPose, Cell, MotionCourse, PlanParams, UnreachableReason, length_secs, plan_motion, plan_visit_order,
};
use echolake_schema::robots::{RobotCell, Rod};
use echolake_schema::{Grid, Rig};

#[derive(Debug, clap::Args)]
pub(crate) struct MotionArgs {
    /// The published order: `combinations.csv` of the GIR data set.
    published: Option<PathBuf>,
}

pub(crate) fn run_motion(args: &MotionArgs) -> Result<()> {
    let mut out = io::stdout();
    let rig = Rig::paper();
    let grid = rig.build_grid()?;
    for rod in [Rod::Leaning, Rod::Upright] {
        writeln!(out, "microphone's rod {rod:?}:")?;
        who_reaches_what(&mut out, &grid, &Cell::new(&RobotCell { rod, ..rig.robots.clone() }, rig.panel.size_mm))?;
    }
    who_shades_whom(&mut out, &grid)?;
    let cell = Cell::from_rig(&rig);
    let standings = pair_poses(&grid, &cell)?;
    let own: Vec<usize> = (0..standings.len()).collect();
    if let Some(path) = &args.published {
        report_order(&mut out, "published", &cell, &standings, &published_order(&grid, path)?)?;
    }
    report_order(&mut out, "by number", &cell, &standings, &own)?;
    for seed in 1..=3 {
        let began = Instant::now();
        let order = plan_visit_order(&standings, PlanParams { seed, ..PlanParams::default() });
        let took = began.elapsed().as_secs_f64();
        report_order(&mut out, &format!("planned, seed {seed} ({took:.1} s)"), &cell, &standings, &order)?;
    }
    Ok(())
}

// Every two points of the grid, lower number first, whether the grid pairs them or not.
fn who_reaches_what(out: &mut dyn Write, grid: &Grid, cell: &Cell) -> io::Result<()> {
    let began = Instant::now();
    let mut tally: BTreeMap<String, [usize; 2]> = BTreeMap::new();
    for a in grid.points() {
        let ways = cell.microphone_ways(a.position_mm);
        for b in grid.points().iter().filter(|b| b.id > a.id) {
            let paired = grid.pair_id(a.id, b.id).is_some();
            let found = cell.reach_with(&ways, a.position_mm, b.position_mm);
            let what = found.map_or_else(describe_unreached, |s| format!("reached, speaker aims: {:?}", s.aim));
            tally.entry(what).or_default()[usize::from(!paired)] += 1;
        }
    }
    writeln!(out, "  {:>6} {:>9}  ({:.2} s)", "paired", "left out", began.elapsed().as_secs_f64())?;
    tally.iter().try_for_each(|(what, [paired, left_out])| writeln!(out, "  {paired:>6} {left_out:>9}  {what}"))
}

// How near the microphone is to the way from the speaker to the mirror point: what the pairs that the grid leaves out
// have in common, whether or not the arms get there.
fn who_shades_whom(out: &mut dyn Write, grid: &Grid) -> io::Result<()> {
    let mut distances = [Vec::new(), Vec::new()];
    for a in grid.points() {
        for b in grid.points().iter().filter(|b| b.id > a.id) {
            let paired = grid.pair_id(a.id, b.id).is_some();
            distances[usize::from(!paired)].push(off_axis_mm(a.position_mm, b.position_mm));
        }
    }
    let farthest = distances[1].iter().copied().fold(0.0, f64::max);
    let near = distances[0].iter().filter(|d| **d <= farthest).count();
    writeln!(
        out,
        "microphone beside the way from speaker to mirror point: {} pairs that are left out at most {farthest:.1} mm, \
         {near} of {} that are measured as near",
        distances[1].len(),
        distances[0].len()
    )
}

fn off_axis_mm(microphone: [f64; 3], speaker: [f64; 3]) -> f64 {
    let axis = [0, 1, 2].map(|i| if i == 2 { -microphone[2] } else { microphone[i] } - speaker[i]);
    let to = [0, 1, 2].map(|i| microphone[i] - speaker[i]);
    let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    (dot(to, to) - dot(to, axis).powi(2) / dot(axis, axis)).max(0.0).sqrt()
}

fn describe_unreached(why: UnreachableReason) -> String {
    format!("NOT reached: {why}")
}

fn pair_poses(grid: &Grid, cell: &Cell) -> Result<Vec<ArmPose>, UnreachableReason> {
    let at = |id: echolake_schema::PointId| grid.points()[id.index()].position_mm;
    grid.pairs().iter().map(|p| cell.reach_positions(at(p.microphone), at(p.speaker))).collect()
}

// The order of the published data set's file.
fn published_order(grid: &Grid, path: &Path) -> Result<Vec<usize>> {
    let mut order = Vec::new();
    for row in csv::Reader::from_path(path)?.records() {
        let row = row?;
        let point = |from: usize| grid.parse_point(&format!("{}/{}/{}", &row[from], &row[from + 1], &row[from + 2]));
        order.push(grid.parse_pair(point(1)?, point(4)?)?.index());
    }
    Ok(order)
}

fn report_order(
    out: &mut dyn Write,
    name: &str,
    cell: &Cell,
    standings: &[ArmPose],
    order: &[usize],
) -> io::Result<()> {
    let mut courses: BTreeMap<String, usize> = BTreeMap::new();
    let mut secs = 0.0;
    let mut turned = 0.0;
    let mut last = ArmPose::at_home();
    for next in order.iter().map(|i| standings[*i]) {
        match plan_motion(cell, &last, &next) {
            Some(motion) => {
                secs += motion.secs;
                let mut from = [last.microphone, last.speaker];
                for stop in motion.stops {
                    turned += from.iter().flatten().zip(stop.iter().flatten()).map(|(a, b)| (a - b).abs()).sum::<f64>();
                    from = stop;
                }
                *courses.entry(format!("{:?}", motion.course)).or_default() += 1;
            }
            None => *courses.entry("no course found".into()).or_default() += 1,
        }
        last = next;
    }
    writeln!(out, "{name}: {} pairs", order.len())?;
    writeln!(
        out,
        "  straight {:.0} s; without touching {secs:.0} s; joints turn {:.0} turns",
        length_secs(standings, order),
        turned / std::f64::consts::TAU
    )?;
    let together = courses.remove(&format!("{:?}", MotionCourse::Together)).unwrap_or(0);
    writeln!(out, "  moves: {together} both arms at once; else {courses:?}")
}
