//! Progress of long work on stderr: a bar on a terminal, a plain line now and then elsewhere.

use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

/// Time between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// The progress of all of a command's tasks.
pub(crate) struct CommandProgress {
    bars: Option<MultiProgress>,
}

/// The progress of one task.
pub(crate) struct TaskProgress {
    name: String,
    unit: &'static str,
    total: u64,
    bar: Option<ProgressBar>,
    begun: Instant,
    last_line: Instant,
    /// A remark behind the bar or in the line.
    note: String,
}

impl CommandProgress {
    pub(crate) fn new() -> Self {
        Self { bars: std::io::stderr().is_terminal().then(MultiProgress::new) }
    }

    /// A task of `total` units.
    pub(crate) fn task(&self, name: impl Into<String>, total: u64, unit: &'static str) -> TaskProgress {
        let name = name.into();
        let bar = self.bars.as_ref().map(|bars| bars.add(bar(&name, total, unit)));
        TaskProgress { name, unit, total, bar, begun: Instant::now(), last_line: Instant::now(), note: String::new() }
    }

    /// Prints a line among the bars.
    pub(crate) fn say(&self, line: impl AsRef<str>) {
        match &self.bars {
            Some(bars) => bars.suspend(|| eprintln!("{}", line.as_ref())),
            None => eprintln!("{}", line.as_ref()),
        }
    }
}

impl TaskProgress {
    /// Sets the number of units that are done.
    pub(crate) fn at(&mut self, done: u64) {
        match &self.bar {
            Some(bar) => bar.set_position(done),
            None if self.last_line.elapsed() >= LINE_EVERY => {
                self.last_line = Instant::now();
                let note = if self.note.is_empty() { String::new() } else { format!("; {}", self.note) };
                eprintln!("{}: {done} of {} {}{note}", self.name, self.total, self.unit);
            }
            None => {}
        }
    }

    /// Prints a line that stays.
    pub(crate) fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{}: {line}", self.name),
        }
    }

    /// Shows a remark beside the numbers.
    pub(crate) fn note(&mut self, note: String) {
        if let Some(bar) = &self.bar {
            bar.set_message(note.clone());
        }
        self.note = note;
    }

    /// Sets the number of units that were done before the start: they do not count in the estimate of the time left.
    pub(crate) fn begin_at(&mut self, done: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(done);
            bar.reset_eta();
        }
    }

    /// Ends the task, with `what` as its result.
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
    let template = format!("{{prefix:24}} {{wide_bar}} {{pos}}/{{len}} {unit}, {{eta}} left {{msg}}");
    let style = ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(total).with_style(style).with_prefix(name.to_owned())
}
