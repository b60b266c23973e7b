//! The point at which a decay sinks into noise.

/// Longest block of the first average, s: Lundeby et al. take 10 to 50 ms.
const LONGEST_BLOCK_SECS: f64 = 0.03;
/// Blocks of the first average at least.
const LEAST_BLOCKS: usize = 50;
/// Blocks in 10 dB of decay once its rate is known.
const BLOCKS_PER_10_DB: f64 = 5.0;
/// The noise is in the last tenth of a response at least.
const NOISE_SHARE: f64 = 0.1;
/// Power over the noise at which the first line of the decay ends: 10 dB.
const FIRST_LINE_END: f64 = 10.0;
/// Powers over the noise between which the line of the late decay is: from 20 to 5 dB. Lundeby et al. end 5 to 10 dB
/// over the noise, and take 10 to 20 dB before.
const LINE_RANGE: [f64; 2] = [100.0, 3.162_277_660_168_379_5];
/// As [`LINE_RANGE`], of a response that ends before its noise: over the power at its end.
const CUT_LINE_RANGE: [f64; 2] = [10.0, 0.0];
/// Standard deviations by which the first half of the noise exceeds the second if it still decays.
const FALLING_DEVIATIONS: f64 = 4.0;
/// Iterations at most; Lundeby et al. need 5.
const MOST_ITERATIONS: usize = 30;
/// Change of the crossing that ends the iteration, relative.
const CONVERGED: f64 = 1e-3;

/// The point at which the line of a late decay meets the noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseCrossing {
    /// Samples from the first.
    pub samples: f64,
    /// Mean power of the noise; 0 if the response ends before its noise begins.
    pub noise: f64,
    /// Power of the late decay's line at the crossing.
    pub power: f64,
    /// Late decay: the power falls by a factor of e in 1 / `rate` samples.
    pub rate: f64,
}

/// The line `offset - rate n` through the logarithms of powers.
struct DecayLine {
    offset: f64,
    rate: f64,
}

/// Finds the crossing of a late decay and its noise. None if the powers do not fall by 10 dB and more on a line before
/// they do.
///
/// power  `[n]`, squared samples from the arrival on, the last of them above 0, of a band of this width, Hz
///
/// Source: Lundeby, Vigran, Bietz and Vorlaender 1995, Acustica 81:344-355.
pub fn find_noise_crossing(power: &[f64], rate_hz: f64, width_hz: f64) -> Option<NoiseCrossing> {
    if power.len() < LEAST_BLOCKS {
        return None;
    }
    let tail = power.len() - (power.len() as f64 * NOISE_SHARE) as usize;
    let mut block = ((LONGEST_BLOCK_SECS * rate_hz) as usize).min(power.len() / LEAST_BLOCKS).max(1);
    let mut noise = mean(&power[tail..])?;
    let mut line = fit_late_decay(power, block, noise, [f64::INFINITY, FIRST_LINE_END], 0.0)?;
    let mut crossing = line.crossing(noise);
    // What ends before its noise has none that could be taken away; what still falls is no noise.
    let mut is_seen = false;
    for _ in 0..MOST_ITERATIONS {
        let ten_db = 10f64.ln() / line.rate;
        block = ((ten_db / BLOCKS_PER_10_DB) as usize).clamp(1, power.len() / LEAST_BLOCKS);
        let mut quiet = ((crossing + ten_db).max(0.0) as usize).min(tail);
        let falls = |quiet: usize| is_falling(&power[quiet..], width_hz / rate_hz);
        while quiet < tail && falls(quiet) {
            quiet = usize::midpoint(quiet, power.len()).min(tail);
        }
        noise = mean(&power[quiet..])?;
        is_seen = crossing < tail as f64 && !falls(quiet);
        line = match is_seen {
            true => fit_late_decay(power, block, noise, LINE_RANGE, noise)?,
            false => fit_late_decay(power, block, noise, CUT_LINE_RANGE, 0.0)?,
        };
        let before = std::mem::replace(&mut crossing, line.crossing(noise));
        if (crossing - before).abs() < CONVERGED * crossing {
            break;
        }
    }
    if !(crossing > 0.0) {
        return None;
    }
    let samples = if is_seen { crossing.min(power.len() as f64) } else { power.len() as f64 };
    let power = (line.offset - line.rate * samples).exp();
    Some(NoiseCrossing { samples, noise: if is_seen { noise } else { 0.0 }, power, rate: line.rate })
}

// The line through the blocks from the greatest on whose power is within a range over the noise's, without some of it.
fn fit_late_decay(
    power: &[f64],
    block: usize,
    noise: f64,
    [begin, end]: [f64; 2],
    taken_away: f64,
) -> Option<DecayLine> {
    let blocks: Vec<f64> = power.chunks_exact(block).map(|block| mean(block).unwrap_or(0.0)).collect();
    let peak = (0..blocks.len()).max_by(|a, b| blocks[*a].total_cmp(&blocks[*b]))?;
    let first = peak + blocks[peak..].iter().position(|x| *x < noise * begin)?;
    let last = blocks[first..].iter().position(|x| *x < noise * end).map_or(blocks.len(), |count| first + count);
    let sounding = (first..last).filter(|i| blocks[*i] > taken_away);
    let points = sounding.map(|i| ((i as f64 + 0.5) * block as f64 - 0.5, (blocks[i] - taken_away).ln()));
    let FittedLine { offset, slope, .. } = fit_line(points)?;
    (slope < 0.0).then_some(DecayLine { offset, rate: -slope })
}

// Whether the mean power of the first half is greater than that of the second, of so many independent values a sample.
fn is_falling(power: &[f64], independent: f64) -> bool {
    let (first, second) = power.split_at(power.len() / 2);
    let deviation = (2.0 / (independent * first.len() as f64).max(1.0)).sqrt();
    let means = mean(first).zip(mean(second));
    means.is_some_and(|(first, second)| first / second - 1.0 > FALLING_DEVIATIONS * deviation)
}

impl DecayLine {
    fn crossing(&self, noise: f64) -> f64 {
        (self.offset - noise.ln()) / self.rate
    }
}

/// A line of least squares.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FittedLine {
    pub offset: f64,
    pub slope: f64,
    /// Share of the values' variance that is not on the line: 1 - r^2.
    pub unexplained: f64,
}

/// Fits a line; None through fewer than two points.
pub(super) fn fit_line(points: impl Iterator<Item = (f64, f64)> + Clone) -> Option<FittedLine> {
    let sums = points.clone().fold([0.0; 3], |[n, x, y], point| [n + 1.0, x + point.0, y + point.1]);
    let centre = [sums[1] / sums[0], sums[2] / sums[0]];
    let moments = points.fold([0.0; 3], |[xx, xy, yy], (x, y)| {
        let apart = [x - centre[0], y - centre[1]];
        [xx + apart[0] * apart[0], xy + apart[0] * apart[1], yy + apart[1] * apart[1]]
    });
    let [xx, xy, yy] = moments;
    let slope = xy / xx;
    let unexplained = (1.0 - xy * slope / yy).max(0.0);
    slope.is_finite().then(|| FittedLine { offset: centre[1] - slope * centre[0], slope, unexplained })
}

fn mean(values: &[f64]) -> Option<f64> {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (mean > 0.0 && mean.is_finite()).then_some(mean)
}

#[cfg(test)]
mod tests {
    use super::*;

    // e^(-n / 1000) meets 10^-4 at 1000 ln(10^4) samples, and a floor of no noise never.
    #[test]
    fn an_exponential_meets_its_noise() {
        let decay = |n: i32| (-f64::from(n) / 1000.0).exp();
        let noisy: Vec<f64> = (0..20_000).map(|n| decay(n) + 1e-4).collect();
        let found = find_noise_crossing(&noisy, 48e3, 24e3).expect("a crossing");
        assert!((found.samples / (1000.0 * 1e4f64.ln()) - 1.0).abs() < 0.02, "{found:?}");
        assert!((found.noise / 1e-4 - 1.0).abs() < 0.02, "{found:?}");
        let cut: Vec<f64> = (0..9_000).map(decay).collect();
        let found = find_noise_crossing(&cut, 48e3, 24e3).expect("a crossing");
        assert_eq!(found.noise, 0.0);
        assert!(found.samples > 8_100.0 && (found.rate - 1e-3).abs() < 1e-9, "{found:?}");
        assert!((found.power / (-found.samples / 1000.0).exp() - 1.0).abs() < 2e-3, "{found:?}");
    }

    #[test]
    fn what_does_not_decay_has_no_crossing() {
        for power in [vec![1.0; 5_000], (1..5_000).map(f64::from).collect(), vec![1.0], vec![]] {
            assert_eq!(find_noise_crossing(&power, 48e3, 24e3), None, "{} samples", power.len());
        }
    }
}
