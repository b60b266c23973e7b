//! How both arms stand at every pair of a rig's grid, worked out once.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use echolake_schema::robots::VisitOrder;
use echolake_schema::{Error, Grid, Pair, PairId, Rig};

use super::arm::Joints;
use super::cell::{Cell, Standing, Unreachable};
use super::plan::{PlanParams, plan};

/// The last one that was worked out: a lake's runs have one rig, and working it out takes a second.
static LAST: Mutex<Option<(Key, Option<Arc<Choreography>>)>> = Mutex::new(None);

/// What a choreography depends on, as text.
type Key = String;

/// Standings of all pairs of a grid.
pub struct Choreography {
    cell: Arc<Cell>,
    standings: Vec<Standing>,
    /// Each pair's turn, where the rig wants its pairs in a planned order.
    turns: Option<HashMap<PairId, usize>>,
}

/// A pair that the arms cannot reach.
#[derive(Debug, Clone, PartialEq)]
pub struct Missing {
    /// The pair.
    pub pair: Pair,
    /// Why.
    pub why: Unreachable,
}

impl std::fmt::Debug for Choreography {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Choreography").field("pairs", &self.standings.len()).finish_non_exhaustive()
    }
}

impl Choreography {
    /// A rig's; none where the arms cannot reach all of its pairs, as on a grid that is no panel's.
    ///
    /// # Errors
    /// [`Error::Quantity`] where the grid is not valid.
    pub fn of(rig: &Rig) -> Result<Option<Arc<Self>>, Error> {
        let key = format!("{:?} {:?} {}", rig.robots, rig.grid, rig.panel.size_mm);
        let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, found)) = last.as_ref().filter(|(of, _)| *of == key) {
            return Ok(found.clone());
        }
        let found = Self::work_out(rig, &rig.grid()?).ok().map(Arc::new);
        *last = Some((key, found.clone()));
        Ok(found)
    }

    /// As [`Self::of`], without looking at what was worked out before.
    ///
    /// # Errors
    /// The pairs that cannot be reached.
    pub fn work_out(rig: &Rig, grid: &Grid) -> Result<Self, Vec<Missing>> {
        let cell = Cell::of(rig);
        let (mut standings, mut missing) = (Vec::new(), Vec::new());
        let mut ways: HashMap<_, _> = HashMap::new();
        for pair in grid.pairs() {
            let [microphone, speaker] = [pair.microphone, pair.speaker].map(|id| grid.points()[id.index()].position_mm);
            let ways = ways.entry(pair.microphone).or_insert_with(|| cell.microphone_ways(microphone));
            match cell.reach_with(ways, microphone, speaker) {
                Ok(standing) => standings.push(standing),
                Err(why) => missing.push(Missing { pair: *pair, why }),
            }
        }
        if !missing.is_empty() {
            return Err(missing);
        }
        let turns = (rig.robots.order == VisitOrder::Planned).then(|| {
            let order = plan(&standings, PlanParams::default());
            order.into_iter().map(|at| grid.pairs()[at].id).zip(0..).collect()
        });
        Ok(Self { cell: Arc::new(cell), standings, turns })
    }

    /// The arms.
    pub fn cell(&self) -> Arc<Cell> {
        self.cell.clone()
    }

    /// How the arms stand at a pair.
    pub fn standing(&self, pair: PairId) -> &Standing {
        &self.standings[pair.index()]
    }

    /// Joints of both arms at a pair.
    pub fn joints(&self, pair: PairId) -> [Joints; 2] {
        let standing = self.standing(pair);
        [standing.microphone, standing.speaker]
    }

    /// Brings pairs into the order that the rig wants them visited in.
    pub fn sort(&self, pairs: &mut [Pair]) {
        if let Some(turns) = &self.turns {
            pairs.sort_by_key(|pair| turns.get(&pair.id));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_whole_grid_of_the_paper_is_within_reach() {
        let rig = Rig::paper();
        let arms = Choreography::of(&rig).expect("a grid").expect("within reach");
        let grid = rig.grid().expect("a grid");
        for pair in grid.pairs() {
            let [microphone, speaker] = arms.joints(pair.id);
            assert!(arms.cell.is_clear(&microphone, &speaker), "{pair:?}");
            let wanted = [pair.microphone, pair.speaker].map(|id| grid.points()[id.index()].position_mm);
            for (wanted, reached) in wanted.iter().zip(arms.cell.positions_mm(&microphone, &speaker)) {
                assert!(wanted.iter().zip(reached).all(|(a, b)| (a - b).abs() < 1e-5), "{pair:?}: {reached:?}");
            }
        }
    }

    #[test]
    fn what_is_out_of_reach_is_named() {
        let mut rig = Rig::paper();
        rig.robots.speaker_foot_mm[0] = 900.0;
        let missing = Choreography::work_out(&rig, &rig.grid().expect("a grid")).err().expect("too far");
        assert!(missing.iter().all(|m| m.why.to_string().starts_with("speaker arm")), "{:?}", missing.first());
        assert!(missing.len() > 500 && Choreography::of(&rig).expect("a grid").is_none());
    }

    #[test]
    fn planned_pairs_are_all_there_in_another_order() {
        let rig = Rig::from_toml(
            "robots.order = \"planned\"\n[[grid.layers]]\npoints_per_side = 3\npitch_mm = 150\nheight_mm = 200",
        )
        .expect("a rig");
        let pairs = rig.grid().expect("a grid").pairs().to_vec();
        let mut sorted = pairs.clone();
        Choreography::of(&rig).expect("a grid").expect("within reach").sort(&mut sorted);
        assert_ne!(sorted, pairs);
        sorted.sort_by_key(|p| p.id);
        assert_eq!(sorted, pairs);
    }
}
