//! The arms' way through a grid: the published visiting order, the grid's own and the planned one side by side, and
//! what the model says of the pairs that the grid leaves out.
//!
//! ```text
//! cargo run --release -p echolake-acquisition --example motion -- ../shared/data/gir/combinations.csv
//! ```

use std::collections::BTreeMap;
use std::error::Error;
use std::time::Instant;

use echolake_acquisition::robots::{Cell, Course, PlanParams, Standing, Unreachable, course, length_secs, plan};
use echolake_schema::robots::{RobotCell, Rod};
use echolake_schema::{Grid, Rig};

fn main() -> Result<(), Box<dyn Error>> {
    let rig = Rig::paper();
    let grid = rig.grid()?;
    for rod in [Rod::Leaning, Rod::Upright] {
        println!("microphone's rod {rod:?}:");
        who_reaches_what(&grid, &Cell::new(&RobotCell { rod, ..rig.robots.clone() }, rig.panel.size_mm));
    }
    let cell = Cell::of(&rig);
    let standings = standings(&grid, &cell)?;
    let own: Vec<usize> = (0..standings.len()).collect();
    if let Some(path) = std::env::args().nth(1) {
        report("published", &cell, &standings, &published(&grid, &path)?);
    }
    report("by number", &cell, &standings, &own);
    for seed in 1..=3 {
        let began = Instant::now();
        let order = plan(&standings, PlanParams { seed, ..PlanParams::default() });
        let took = began.elapsed().as_secs_f64();
        report(&format!("planned, seed {seed} ({took:.1} s)"), &cell, &standings, &order);
    }
    Ok(())
}

// Every two points of the grid, lower number first, whether the grid pairs them or not.
fn who_reaches_what(grid: &Grid, cell: &Cell) {
    let began = Instant::now();
    let mut tally: BTreeMap<String, [usize; 2]> = BTreeMap::new();
    for a in grid.points() {
        let ways = cell.microphone_ways(a.position_mm);
        for b in grid.points().iter().filter(|b| b.id > a.id) {
            let paired = grid.pair_id(a.id, b.id).is_some();
            let found = cell.reach_with(&ways, a.position_mm, b.position_mm);
            let what = found.map_or_else(named, |s| format!("reached, speaker aims: {:?}", s.aim));
            tally.entry(what).or_default()[usize::from(!paired)] += 1;
        }
    }
    println!("  {:>6} {:>9}  ({:.2} s)", "paired", "left out", began.elapsed().as_secs_f64());
    tally.iter().for_each(|(what, [paired, left_out])| println!("  {paired:>6} {left_out:>9}  {what}"));
}

fn named(why: Unreachable) -> String {
    format!("NOT reached: {why}")
}

fn standings(grid: &Grid, cell: &Cell) -> Result<Vec<Standing>, Unreachable> {
    let at = |id: echolake_schema::PointId| grid.points()[id.index()].position_mm;
    grid.pairs().iter().map(|p| cell.reach(at(p.microphone), at(p.speaker))).collect()
}

// The order of the published data set's file.
fn published(grid: &Grid, path: &str) -> Result<Vec<usize>, Box<dyn Error>> {
    let mut order = Vec::new();
    for row in csv::Reader::from_path(path)?.records() {
        let row = row?;
        let point = |from: usize| grid.parse_point(&format!("{}/{}/{}", &row[from], &row[from + 1], &row[from + 2]));
        order.push(grid.parse_pair(point(1)?, point(4)?)?.index());
    }
    Ok(order)
}

fn report(name: &str, cell: &Cell, standings: &[Standing], order: &[usize]) {
    let mut courses: BTreeMap<String, usize> = BTreeMap::new();
    let (mut secs, mut turned, mut last) = (0.0, 0.0, Standing::home());
    for next in order.iter().map(|i| standings[*i]) {
        match course(cell, &last, &next) {
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
    println!("{name}: {} pairs", order.len());
    println!(
        "  straight {:.0} s; without touching {secs:.0} s; joints turn {:.0} turns",
        length_secs(standings, order),
        turned / std::f64::consts::TAU
    );
    let together = courses.remove(&format!("{:?}", Course::Together)).unwrap_or(0);
    println!("  moves: {together} both arms at once; else {courses:?}");
}
