//! Takes of one pair, compared with its first: what changes between them is no property of a surface.

use std::collections::BTreeMap;

use echolake_acquisition::run::assessment::{RepeatDifference, TakeAssessor};
use echolake_schema::PairId;

/// Responses of pairs that have several takes.
pub(crate) struct TakeRepeats {
    /// Takes that are still to come, and the whole response of the first.
    pairs: BTreeMap<PairId, (usize, Vec<f32>)>,
}

impl TakeRepeats {
    /// Prepares for these pairs, one for each take.
    pub fn new(pairs: impl Iterator<Item = PairId>) -> Self {
        let mut takes: BTreeMap<_, (usize, _)> = BTreeMap::new();
        for pair in pairs {
            takes.entry(pair).or_insert((0, Vec::new())).0 += 1;
        }
        takes.retain(|_, (count, _)| *count > 1);
        Self { pairs: takes }
    }

    /// Compares the response that was assessed last with that of the pair's first take; None of the first, and of a
    /// pair with a single one.
    pub fn compare_take(&mut self, pair: PairId, assessor: &TakeAssessor) -> Option<RepeatDifference> {
        let (left, first) = self.pairs.get_mut(&pair)?;
        *left -= 1;
        if first.is_empty() {
            first.extend_from_slice(assessor.response());
            return None;
        }
        let found = assessor.compare_repeat(first);
        if *left == 0 {
            self.pairs.remove(&pair);
        }
        Some(found)
    }
}
