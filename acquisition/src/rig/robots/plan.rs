//! An order of poses that shortens travel: nearest neighbour, 2-opt, then swaps of neighbouring stretches that are kept
//! if they help (iterated local search). Same seed, same order.

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::cell::ArmPose;
use super::motion::as_secs;

/// Nearest poses that 2-opt tries for each one.
const NEIGHBOURS: usize = 10;
/// Longest stretch that is swapped.
const STRETCH: usize = 40;

/// Effort of the search.
#[derive(Debug, Clone, Copy)]
pub struct PlanParams {
    /// Swaps that are tried; 100,000 take about a second.
    pub swaps: usize,
    /// Seed of the random swaps.
    pub seed: u64,
}

impl Default for PlanParams {
    fn default() -> Self {
        Self { swaps: 100_000, seed: 1 }
    }
}

/// Returns indices of `standings`, in the order in which they are best visited, beginning at home.
pub fn plan_visit_order(standings: &[ArmPose], params: PlanParams) -> Vec<usize> {
    let mut tour = Tour::from_nearest(standings);
    tour.run_two_opt((0..tour.places.len()).collect());
    let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
    for _ in 0..params.swaps {
        tour.try_swap(&mut rng);
    }
    tour.order[1..].iter().map(|at| at - 1).collect()
}

/// Time of travel in an order, from home, s: the data sheet's speeds, straight from each to the next.
pub fn length_secs(standings: &[ArmPose], order: &[usize]) -> f64 {
    let home = as_secs(&ArmPose::at_home());
    let stops: Vec<_> = std::iter::once(home).chain(order.iter().map(|i| as_secs(&standings[*i]))).collect();
    stops.windows(2).map(|w| f64::from(secs_between(&w[0], &w[1]))).sum()
}

fn secs_between(a: &[f32; 12], b: &[f32; 12]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// A path from home (place 0) through all places; its end is free.
struct Tour {
    places: Vec<[f32; 12]>,
    near: Vec<Vec<usize>>,
    order: Vec<usize>,
    at: Vec<usize>,
    /// Stretches that were turned since the last swap was kept, to take it back.
    turned: Vec<[usize; 2]>,
}

impl Tour {
    fn from_nearest(standings: &[ArmPose]) -> Self {
        let places: Vec<_> = std::iter::once(&ArmPose::at_home()).chain(standings).map(as_secs).collect();
        let mut left: Vec<usize> = (1..places.len()).collect();
        let mut order = vec![0];
        while let Some((k, _)) = left
            .iter()
            .map(|i| secs_between(&places[*i], &places[order[order.len() - 1]]))
            .enumerate()
            .min_by(|a, b| a.1.total_cmp(&b.1))
        {
            order.push(left.swap_remove(k));
        }
        let mut at = vec![0; order.len()];
        order.iter().enumerate().for_each(|(k, i)| at[*i] = k);
        let near = (0..places.len()).map(|i| nearest_neighbours(&places, i)).collect();
        Self { places, near, order, at, turned: Vec::new() }
    }

    fn leg_secs(&self, a: usize, b: usize) -> f32 {
        secs_between(&self.places[a], &self.places[b])
    }

    // Between two neighbours in the order; behind the end there is nothing to travel to.
    fn edge_secs(&self, k: usize) -> f32 {
        if k + 1 < self.order.len() { self.leg_secs(self.order[k], self.order[k + 1]) } else { 0.0 }
    }

    fn reverse_stretch(&mut self, from: usize, to: usize) {
        if from < to {
            self.order[from..=to].reverse();
            for k in from..=to {
                self.at[self.order[k]] = k;
            }
            self.turned.push([from, to]);
        }
    }

    // What is saved by turning the stretch [from, to].
    fn saved_secs(&self, from: usize, to: usize) -> f32 {
        let before = self.edge_secs(from - 1) + self.edge_secs(to);
        let after = if to + 1 < self.order.len() { self.leg_secs(self.order[from], self.order[to + 1]) } else { 0.0 };
        before - self.leg_secs(self.order[from - 1], self.order[to]) - after
    }

    // The best turn that brings one of its neighbours beside a place.
    fn best_turn(&self, place: usize) -> Option<[usize; 2]> {
        let k = self.at[place];
        let mut best = (1e-6, None);
        for near in &self.near[place] {
            let l = self.at[*near];
            let low = k.min(l);
            let high = k.max(l);
            for [from, to] in [[low + 1, high], [low, high.saturating_sub(1)]] {
                if from >= 1 && from < to {
                    let saved = self.saved_secs(from, to);
                    if saved > best.0 {
                        best = (saved, Some([from, to]));
                    }
                }
            }
        }
        best.1
    }

    // 2-opt from these places on until nothing helps; returns what it saved.
    fn run_two_opt(&mut self, mut places: Vec<usize>) -> f32 {
        let mut saved = 0.0;
        while let Some(place) = places.pop() {
            while let Some([from, to]) = self.best_turn(place) {
                saved += self.saved_secs(from, to);
                places.extend([from - 1, from, to, (to + 1).min(self.order.len() - 1)].map(|k| self.order[k]));
                self.reverse_stretch(from, to);
            }
        }
        saved
    }

    // Exchanges two neighbouring stretches, lets 2-opt settle, and takes all of it back where it did not help.
    fn try_swap(&mut self, rng: &mut ChaCha8Rng) {
        let count = self.order.len();
        if count < 4 {
            return;
        }
        let from = rng.random_range(1..count - 1);
        let middle = rng.random_range(from..(from + STRETCH).min(count - 1));
        let to = rng.random_range(middle + 1..(middle + 1 + STRETCH).min(count));
        self.turned.clear();
        let before = self.edge_secs(from - 1) + self.edge_secs(middle) + self.edge_secs(to);
        self.reverse_stretch(from, to);
        let split = from + to - middle;
        self.reverse_stretch(from, split - 1);
        self.reverse_stretch(split, to);
        let swapped = before - self.edge_secs(from - 1) - self.edge_secs(split - 1) - self.edge_secs(to);
        let around = [from - 1, from, split - 1, split, to, (to + 1).min(count - 1)].map(|k| self.order[k]);
        if swapped + self.run_two_opt(around.to_vec()) < 0.0 {
            for [from, to] in std::mem::take(&mut self.turned).into_iter().rev() {
                self.reverse_stretch(from, to);
            }
        }
    }
}

fn nearest_neighbours(places: &[[f32; 12]], of: usize) -> Vec<usize> {
    let mut near: Vec<(f32, usize)> = places.iter().map(|p| secs_between(p, &places[of])).zip(0..).collect();
    near.remove(of);
    let kept = NEIGHBOURS.min(near.len());
    if kept < near.len() {
        near.select_nth_unstable_by(kept, |a, b| a.0.total_cmp(&b.0));
    }
    near.truncate(kept);
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.into_iter().map(|(_, i)| i).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::robots::SpeakerAim;

    // Standings along a line, in a shuffled order: the best path is known.
    fn line(count: usize) -> Vec<ArmPose> {
        let at = |i: usize| {
            let mut standing = ArmPose { aim: SpeakerAim::Down, ..ArmPose::at_home() };
            standing.speaker[0] += 0.01 * ((i * 7) % count + 1) as f64;
            standing
        };
        (0..count).map(at).collect()
    }

    #[test]
    fn a_line_is_walked_along() {
        let standings = line(200);
        let order = plan_visit_order(&standings, PlanParams { swaps: 100, seed: 3 });
        let expected = 200.0 * 0.01f64.to_degrees() / 435.0;
        assert!((length_secs(&standings, &order) - expected).abs() < 1e-4, "{}", length_secs(&standings, &order));
    }

    #[test]
    fn every_place_is_visited_once_and_seeds_repeat() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut standing = || {
            let mut standing = ArmPose::at_home();
            standing.microphone.iter_mut().chain(&mut standing.speaker).for_each(|q| *q += rng.random_range(-1.0..1.0));
            standing
        };
        let standings: Vec<_> = (0..300).map(|_| standing()).collect();
        let params = PlanParams { swaps: 2_000, seed: 9 };
        let order = plan_visit_order(&standings, params);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..300).collect::<Vec<_>>());
        assert_eq!(order, plan_visit_order(&standings, params));
        let straight: Vec<_> = (0..300).collect();
        assert!(length_secs(&standings, &order) < 0.75 * length_secs(&standings, &straight));
    }

    mod slow {
        use super::*;

        #[test]
        fn few_standings_are_no_trouble() {
            for count in 0..5 {
                assert_eq!(plan_visit_order(&line(count), PlanParams::default()).len(), count);
            }
        }
    }
}
