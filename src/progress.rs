//! Progress of long work on stderr: a bar on a terminal, a plain line now and then elsewhere.

use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

/// Time between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// The progress of all of a command's tasks.
pub(crate) struct Progress {
    bars: Option<MultiProgress>,
}

/// The progress of one task.
pub(crate) struct Task {
    name: String,
    unit: &'static str,
    total: u64,
    bar: Option<ProgressBar>,
    begun: Instant,
    last_line: Instant,
}

impl Progress {
    pub(crate) fn new() -> Self {
        Self { bars: std::io::stderr().is_terminal().then(MultiProgress::new) }
    }

    /// A task of `total` units.
    pub(crate) fn task(&self, name: impl Into<String>, total: u64, unit: &'static str) -> Task {
        let name = name.into();
        let bar = self.bars.as_ref().map(|bars| bars.add(bar(&name, total, unit)));
        Task { name, unit, total, bar, begun: Instant::now(), last_line: Instant::now() }
    }

    /// A line among the bars.
    pub(crate) fn say(&self, line: impl AsRef<str>) {
        match &self.bars {
            Some(bars) => bars.suspend(|| eprintln!("{}", line.as_ref())),
            None => eprintln!("{}", line.as_ref()),
        }
    }
}

impl Task {
    /// `done` units are done.
    pub(crate) fn at(&mut self, done: u64) {
        match &self.bar {
            Some(bar) => bar.set_position(done),
            None if self.last_line.elapsed() >= LINE_EVERY => {
                self.last_line = Instant::now();
                eprintln!("{}: {done} of {} {}", self.name, self.total, self.unit);
            }
            None => {}
        }
    }

    /// The task is over; `what` came of it.
    pub(crate) fn done(self, what: impl AsRef<str>) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        let line = format!("{}: {} ({:.1} s)", self.name, what.as_ref(), self.begun.elapsed().as_secs_f64());
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
    }
}

fn bar(name: &str, total: u64, unit: &'static str) -> ProgressBar {
    let template = format!("{{prefix:24}} {{wide_bar}} {{pos}}/{{len}} {unit}, {{eta}} left");
    let style = ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(total).with_style(style).with_prefix(name.to_owned())
}
