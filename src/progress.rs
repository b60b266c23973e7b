//! Progress of long work on stderr: a bar on a terminal, a plain line now and then elsewhere.

use std::fmt::Write as _;
use std::io::IsTerminal as _;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use chrono::{DateTime, Local, TimeDelta};
use echolake_schema::escape_controls;
use indicatif::{MultiProgress, ProgressBar, ProgressState, ProgressStyle};

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
    /// Rate and end time, as the bar shows them.
    pace: Arc<Mutex<String>>,
    /// Units that were done before the start: they do not count in the rate.
    done_before: u64,
    /// Time and number of the first units that were done since.
    first: Option<(Instant, u64)>,
    begun: Instant,
    last_line: Instant,
    /// A remark below the bar or in the line.
    note: String,
}

impl CommandProgress {
    pub fn new() -> Self {
        Self { bars: std::io::stderr().is_terminal().then(MultiProgress::new) }
    }

    /// A task of `total` units.
    pub fn start_task(&self, name: impl Into<String>, total: u64, unit: &'static str) -> TaskProgress {
        let name = name.into();
        let pace = Arc::<Mutex<String>>::default();
        let bar = self.bars.as_ref().map(|bars| {
            let style = bar_style(unit, BarLines::One, &pace);
            bars.add(ProgressBar::new(total).with_style(style).with_prefix(name.clone()))
        });
        let now = Instant::now();
        let note = String::new();
        let first = None;
        TaskProgress { name, unit, total, bar, pace, done_before: 0, first, begun: now, last_line: now, note }
    }

    /// Prints a line among the bars.
    pub fn print_message(&self, line: impl AsRef<str>) {
        match &self.bars {
            Some(bars) => bars.suspend(|| eprintln!("{}", escape_controls(line.as_ref()))),
            None => eprintln!("{}", escape_controls(line.as_ref())),
        }
    }
}

impl TaskProgress {
    /// Returns whether a number that is set now is shown.
    pub fn is_due(&self) -> bool {
        self.bar.is_some() || self.last_line.elapsed() >= LINE_EVERY
    }

    /// Sets the number of units that are done.
    pub fn set_done(&mut self, done: u64) {
        match &self.bar {
            Some(bar) => {
                let bar = bar.clone();
                let pace = self.describe_pace(done);
                *self.pace.lock().unwrap_or_else(PoisonError::into_inner) = pace;
                bar.set_position(done);
            }
            None if self.is_due() => {
                self.last_line = Instant::now();
                let note = if self.note.is_empty() { String::new() } else { format!("; {}", self.note) };
                let pace = self.describe_pace(done);
                eprintln!("{}: {done} of {} {}{pace}{note}", self.name, self.total, self.unit);
            }
            None => {}
        }
    }

    // The rate counts from the first unit on: what comes before it is preparation.
    fn describe_pace(&mut self, done: u64) -> String {
        if done <= self.done_before {
            return String::new();
        }
        let (since, before) = *self.first.get_or_insert((Instant::now(), done));
        describe_pace(done - before, self.total.saturating_sub(done), since.elapsed(), Local::now())
    }

    /// Prints a line that stays.
    pub fn print_message(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{}", escape_controls(line))),
            None => eprintln!("{}: {}", self.name, escape_controls(line)),
        }
    }

    /// Shows a remark below the bar, or in the line.
    pub fn set_note(&mut self, note: String) {
        let note = escape_controls(&note);
        if let Some(bar) = &self.bar {
            if self.note.is_empty() {
                bar.set_style(bar_style(self.unit, BarLines::Two, &self.pace));
            }
            bar.set_message(note.clone());
        }
        self.note = note;
    }

    /// Sets the number of units that were done before the start: they do not count in the rate.
    pub fn begin_at(&mut self, done: u64) {
        self.done_before = done;
        if let Some(bar) = &self.bar {
            bar.set_position(done);
        }
    }

    /// Ends the task without a line: there was nothing to do.
    pub fn dismiss(self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    /// Ends the task, with `what` as its result.
    pub fn finish_with(self, what: impl AsRef<str>) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        let what = escape_controls(what.as_ref());
        let line = format!("{}: {what} ({:.1} s)", self.name, self.begun.elapsed().as_secs_f64());
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
    }
}

/// Lines of a bar: the second one has the remark.
#[derive(Clone, Copy, PartialEq, Eq)]
enum BarLines {
    One,
    Two,
}

fn bar_style(unit: &'static str, lines: BarLines, pace: &Arc<Mutex<String>>) -> ProgressStyle {
    // A remark beside the bar would leave it no room.
    let remark = if lines == BarLines::Two { "\n  {wide_msg}" } else { "" };
    let template = format!("{{prefix:8}} {{wide_bar}} {{percent:>3}} % {{pos}}/{{len}} {unit}{{pace}}{remark}");
    let style = ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
    let pace = pace.clone();
    style.with_key("pace", move |_: &ProgressState, out: &mut dyn std::fmt::Write| {
        // The bar is drawn without it if it cannot be formatted.
        let _ = out.write_str(&pace.lock().unwrap_or_else(PoisonError::into_inner));
    })
}

/// Returns rate and end time of a task, each behind a comma; nothing while there is no rate.
fn describe_pace(done: u64, left: u64, elapsed: Duration, now: DateTime<Local>) -> String {
    if done == 0 || left == 0 || elapsed.is_zero() {
        return String::new();
    }
    let rate = done as f64 / elapsed.as_secs_f64();
    let mut text = match rate {
        1.0.. => format!(", {rate:.0}/s"),
        _ if rate >= 1.0 / 60.0 => format!(", {:.1}/min", rate * 60.0),
        _ => format!(", {:.1}/h", rate * 3600.0),
    };
    let end =
        TimeDelta::try_milliseconds((left as f64 / rate * 1e3) as i64).and_then(|more| now.checked_add_signed(more));
    if let Some(end) = end {
        let format = if end.date_naive() == now.date_naive() { "%H:%M" } else { "%b %d %H:%M" };
        let _ = write!(text, ", ends {}", end.format(format));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use chrono::TimeZone as _;
    use indicatif::{ProgressDrawTarget, TermLike};
    use std::io;

    /// A terminal of 80 columns that keeps what was drawn last.
    #[derive(Debug, Clone, Default)]
    struct LastDrawing(Arc<Mutex<String>>);

    impl LastDrawing {
        fn text(&self) -> String {
            self.0.lock().expect("a text").clone()
        }

        fn push(&self, text: &str) -> io::Result<()> {
            self.0.lock().expect("a text").push_str(text);
            Ok(())
        }
    }

    impl TermLike for LastDrawing {
        fn width(&self) -> u16 {
            80
        }

        fn move_cursor_up(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_down(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_right(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_left(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn write_line(&self, line: &str) -> io::Result<()> {
            self.push(&format!("{line}\n"))
        }

        fn write_str(&self, text: &str) -> io::Result<()> {
            self.push(text)
        }

        fn clear_line(&self) -> io::Result<()> {
            self.0.lock().expect("a text").clear();
            Ok(())
        }

        fn flush(&self) -> io::Result<()> {
            Ok(())
        }
    }

    fn noon() -> DateTime<Local> {
        Local.with_ymd_and_hms(2026, 1, 5, 12, 0, 0).single().expect("a time that is once")
    }

    #[test]
    fn an_end_is_told_only_when_there_is_a_rate() {
        let secs = Duration::from_secs;
        let check = |done, left, elapsed, expected: &str| {
            assert_eq!(describe_pace(done, left, secs(elapsed), noon()), expected, "{done} {left} {elapsed}");
        };
        check(0, 2951, 60, "");
        check(2951, 0, 60, "");
        check(200, 0, 0, "");
        check(200, 400, 2, ", 100/s, ends 12:00");
        check(5, 300, 60, ", 5.0/min, ends 13:00");
        check(10, 2941, 123, ", 4.9/min, ends 22:02");
        check(1, 48, 3600, ", 1.0/h, ends Jan 07 12:00");
        check(1, u64::MAX, 3600, ", 1.0/h");
    }

    // The bar of a real run, drawn at 80 columns.
    #[test]
    fn a_bar_has_room_at_80_columns() {
        let terminal = LastDrawing::default();
        let target = ProgressDrawTarget::term_like(Box::new(terminal.clone()));
        let progress = CommandProgress { bars: Some(MultiProgress::with_draw_target(target)) };
        let drawing = |task: &TaskProgress| {
            // Drawings are limited to 20 a second.
            std::thread::sleep(Duration::from_millis(60));
            task.bar.as_ref().expect("a bar").tick();
            // A line is filled up to the width.
            let text: Vec<char> = terminal.text().chars().filter(|c| *c != '\n').collect();
            text.chunks(80).map(|line| line.iter().collect::<String>().trim_end().to_owned()).collect::<Vec<_>>()
        };
        let mut task = progress.start_task("0015_0", 2951, "pairs");
        task.begin_at(413);
        task.set_note("pair 2102 (microphone 41, speaker 29), SNR 66.0 dB, 1 repeated, 0 given up".to_owned());
        let shown = drawing(&task);
        assert!(shown[0].ends_with("413/2951 pairs"), "{shown:?}");
        task.first = Some((Instant::now() - Duration::from_secs(100), 413));
        task.set_done(1413);
        let shown = drawing(&task);
        assert_eq!(shown.len(), 2, "{shown:?}");
        assert!(shown[0].contains("████") && shown[0].contains("48 % 1413/2951 pairs, 10/s, ends "), "{shown:?}");
        assert!(shown[1].contains("pair 2102") && shown[1].ends_with("given up"), "{shown:?}");
    }
}
