//! Joints of both arms at every pair of a rig's grid, each solved once.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use echolake_schema::robots::VisitOrder;
use echolake_schema::{Error, Grid, Pair, PairId, Rig};

use super::cell::{ArmPose, ArmSolutions, Cell, UnreachableReason};
use super::plan::{PlanParams, plan_visit_order};

/// The last one that was computed: a lake's runs have one rig, and computing it takes a second.
static LAST: Mutex<Option<(RigKey, Option<Arc<Choreography>>)>> = Mutex::new(None);

/// All settings that a choreography depends on, as text.
type RigKey = String;

/// Joints of both arms at all pairs of a grid, each solved when it is first needed.
pub struct Choreography {
    cell: Arc<Cell>,
    grid: Grid,
    ways: Vec<OnceLock<ArmSolutions>>,
    standings: Vec<OnceLock<Result<ArmPose, UnreachableReason>>>,
    /// Each pair's turn, if the rig visits its pairs in a planned order.
    turns: Option<HashMap<PairId, usize>>,
}

/// A pair that the arms cannot reach.
#[derive(Debug, Clone, PartialEq)]
pub struct MissingPair {
    /// The pair.
    pub pair: Pair,
    /// The reason.
    pub why: UnreachableReason,
}

fn rig_key(rig: &Rig) -> RigKey {
    format!("{:?} {:?} {}", rig.robots, rig.grid, rig.panel.size_mm)
}

impl std::fmt::Debug for Choreography {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Choreography").field("pairs", &self.standings.len()).finish_non_exhaustive()
    }
}

impl Choreography {
    /// Returns a rig's; None if the arms cannot reach all of its pairs, as on a grid that is no panel's.
    ///
    /// # Errors
    /// [`Error::Quantity`] if the grid is not valid.
    pub fn for_rig(rig: &Rig) -> Result<Option<Arc<Self>>, Error> {
        let key = rig_key(rig);
        let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, found)) = last.as_ref().filter(|(of, _)| *of == key) {
            return Ok(found.clone());
        }
        let mut arms = Self::new(rig)?;
        // The paper's whole grid is within reach: a test checks it, and runs need not wait for it.
        let found = if key == self::rig_key(&Rig::paper()) || arms.missing_pairs().is_empty() {
            arms.turns = (rig.robots.order == VisitOrder::Planned).then(|| arms.planned_turns());
            Some(Arc::new(arms))
        } else {
            None
        };
        *last = Some((key, found.clone()));
        Ok(found)
    }

    /// Makes a rig's, even if the arms do not reach all of its pairs, and in the order of their numbers.
    ///
    /// # Errors
    /// [`Error::Quantity`] if the grid is not valid.
    pub fn new(rig: &Rig) -> Result<Self, Error> {
        let grid = rig.build_grid()?;
        Ok(Self {
            cell: Arc::new(Cell::from_rig(rig)),
            ways: vec![OnceLock::new(); grid.points().len()],
            standings: vec![OnceLock::new(); grid.pairs().len()],
            grid,
            turns: None,
        })
    }

    /// Returns the pairs that the arms cannot reach, with the reasons.
    pub fn missing_pairs(&self) -> Vec<MissingPair> {
        let missing = |pair: &Pair| self.pose_at(pair.id).err().map(|why| MissingPair { pair: *pair, why });
        self.grid.pairs().iter().filter_map(missing).collect()
    }

    fn planned_turns(&self) -> HashMap<PairId, usize> {
        let reached = |pair: &Pair| Some((pair.id, self.pose_at(pair.id).ok()?));
        let (pairs, standings): (Vec<_>, Vec<_>) = self.grid.pairs().iter().filter_map(reached).unzip();
        plan_visit_order(&standings, PlanParams::default()).into_iter().map(|at| pairs[at]).zip(0..).collect()
    }

    /// Returns the model of the arms.
    pub fn cell(&self) -> Arc<Cell> {
        self.cell.clone()
    }

    /// Returns the joints of both arms at a pair of the grid.
    ///
    /// # Errors
    /// [`UnreachableReason`].
    pub fn pose_at(&self, pair: PairId) -> Result<ArmPose, UnreachableReason> {
        let (Some(lock), Some(pair)) = (self.standings.get(pair.index()), self.grid.pair(pair)) else {
            return Err(UnreachableReason::NoPosition);
        };
        *lock.get_or_init(|| {
            let [microphone, speaker] =
                [pair.microphone, pair.speaker].map(|id| self.grid.points()[id.index()].position_mm);
            let ways = self.ways[pair.microphone.index()].get_or_init(|| self.cell.microphone_ways(microphone));
            self.cell.reach_with(ways, microphone, speaker)
        })
    }

    /// Sorts pairs into the rig's visiting order.
    pub fn sort_pairs(&self, pairs: &mut [Pair]) {
        if let Some(turns) = &self.turns {
            pairs.sort_by_key(|pair| turns.get(&pair.id));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::robots::SpeakerAim;

    #[test]
    fn the_whole_grid_of_the_paper_is_within_reach() {
        let rig = Rig::paper();
        let arms = Choreography::for_rig(&rig).expect("a grid").expect("within reach");
        let grid = rig.build_grid().expect("a grid");
        for pair in grid.pairs() {
            let ArmPose { microphone, speaker, aim } = arms.pose_at(pair.id).expect("within reach");
            assert_eq!(aim, SpeakerAim::Specular);
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
        let missing = Choreography::new(&rig).expect("a grid").missing_pairs();
        assert!(missing.iter().all(|m| m.why.to_string().starts_with("speaker arm")), "{:?}", missing.first());
        assert!(missing.len() > 500 && Choreography::for_rig(&rig).expect("a grid").is_none());
    }

    mod slow {
        use super::*;

        #[test]
        fn planned_pairs_are_all_there_in_another_order() {
            let rig = Rig::from_toml(
                "robots.order = \"planned\"\n[[grid.layers]]\npoints_per_side = 3\npitch_mm = 150\nheight_mm = 200",
            )
            .expect("a rig");
            let pairs = rig.build_grid().expect("a grid").pairs().to_vec();
            let mut sorted = pairs.clone();
            Choreography::for_rig(&rig).expect("a grid").expect("within reach").sort_pairs(&mut sorted);
            assert_ne!(sorted, pairs);
            sorted.sort_by_key(|p| p.id);
            assert_eq!(sorted, pairs);
        }
    }
}
