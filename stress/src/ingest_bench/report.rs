//! The lines that are printed: figures, and goals with whether they are met.

use std::io::Write as _;

use anyhow::Result;

/// Limit that a figure should meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FigureGoal {
    AtLeast(f64),
    AtMost(f64),
}

/// Prints as it goes, because the whole takes minutes.
pub(crate) struct FigureReport {
    missed: Vec<String>,
    goals: usize,
}

impl FigureGoal {
    fn is_met(self, figure: f64) -> bool {
        match self {
            Self::AtLeast(least) => figure >= least,
            Self::AtMost(most) => figure <= most,
        }
    }

    fn text(self, unit: &str) -> String {
        match self {
            Self::AtLeast(least) => format!(">= {least:.1} {unit}"),
            Self::AtMost(most) => format!("<= {most:.1} {unit}"),
        }
    }
}

impl FigureReport {
    pub fn new() -> Self {
        Self { missed: Vec::new(), goals: 0 }
    }

    pub fn title(&mut self, text: &str) -> Result<()> {
        Ok(writeln!(std::io::stdout().lock(), "\n{text}")?)
    }

    pub fn line(&mut self, text: &str) -> Result<()> {
        Ok(writeln!(std::io::stdout().lock(), "  {text}")?)
    }

    pub fn figure(&mut self, name: &str, figure: f64, unit: &str) -> Result<()> {
        self.line(&format!("{name:<66} {figure:>10.3} {unit}"))
    }

    pub fn goal(&mut self, name: &str, figure: f64, unit: &str, goal: FigureGoal) -> Result<()> {
        self.goals += 1;
        let outcome = match goal.is_met(figure) {
            true => "met",
            false => {
                self.missed.push(name.to_owned());
                "MISSED"
            }
        };
        self.line(&format!("{name:<66} {figure:>10.3} {unit}, goal {}: {outcome}", goal.text(unit)))
    }

    /// Says how many goals were met; a missed one is no failure of the benchmark.
    pub fn finish(self) -> Result<()> {
        let met = self.goals - self.missed.len();
        let missed =
            if self.missed.is_empty() { String::new() } else { format!("; missed: {}", self.missed.join(", ")) };
        Ok(writeln!(std::io::stdout().lock(), "\n{met} of {} goals met{missed}", self.goals)?)
    }
}
