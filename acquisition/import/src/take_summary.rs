//! What the takes of one import have in common, in words.

use echolake_dsp::take_analysis::TakeAnalysis;
use echolake_schema::SweepShape;
use echolake_schema::messages::Verdict;

/// Summary of a run's takes.
pub(crate) struct TakeSummary {
    shape: SweepShape,
    takes: u64,
    rejected: u64,
    clock_ppm: Option<[f64; 2]>,
    /// Order and its greatest level, dB.
    harmonics: Vec<(usize, f64)>,
    noise_db: f64,
}

impl TakeSummary {
    /// Begins a summary of takes of such sweeps.
    pub fn new(shape: SweepShape) -> Self {
        Self { shape, takes: 0, rejected: 0, clock_ppm: None, harmonics: Vec::new(), noise_db: f64::NEG_INFINITY }
    }

    /// Adds a take.
    pub fn add_take(&mut self, analysis: &TakeAnalysis, verdict: Verdict) {
        self.takes += 1;
        self.rejected += u64::from(verdict == Verdict::Rejected);
        let ppm = analysis.clock_ratio_ppm;
        if ppm.is_finite() {
            let [least, most] = self.clock_ppm.unwrap_or([ppm; 2]);
            self.clock_ppm = Some([least.min(ppm), most.max(ppm)]);
        }
        if let Some(distortion) = &analysis.distortion {
            self.noise_db = self.noise_db.max(distortion.noise_db);
            for (order, level) in &distortion.harmonics {
                match self.harmonics.iter_mut().find(|(known, _)| known == order) {
                    Some((_, most)) => *most = most.max(*level),
                    None => self.harmonics.push((*order, *level)),
                }
            }
        }
    }

    /// Returns the number of rejected takes.
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// Describes the takes, one fact a text.
    pub fn describe_takes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if self.rejected > 0 {
            notes.push(format!("{} of {} takes rejected; they get no rows in the tables", self.rejected, self.takes));
        }
        if let Some([least, most]) = self.clock_ppm {
            // No -0.0.
            let [least, most] = [least, most].map(|ppm| (10.0 * ppm).round() / 10.0 + 0.0);
            notes.push(format!("clock ratio, playing over recording: {least:+.1} to {most:+.1} ppm"));
            notes.push(match (self.shape, self.harmonics.is_empty()) {
                (SweepShape::Exponential, false) => {
                    let levels = self.harmonics.iter().map(|(order, level)| format!("order {order}: {level:.1} dB"));
                    let levels = levels.collect::<Vec<_>>().join(", ");
                    format!(
                        "distortion re the response, greatest of all takes: {levels} (noise {:.1} dB)",
                        self.noise_db
                    )
                }
                (SweepShape::Exponential, true) => "distortion: no harmonic within the sweep's range".to_owned(),
                (SweepShape::Linear, _) => "distortion by order: not separable, the sweep is linear".to_owned(),
            });
        }
        notes
    }
}
