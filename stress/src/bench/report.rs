//! Figures of benchmarks, with the peer or the limit that stands beside them and their goals: as a table, as JSON, and
//! as a page of Markdown.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use serde_json::{Value, json};

/// Form in which figures are printed.
#[derive(Debug, clap::Args)]
pub(crate) struct ReportOutput {
    /// Print JSON instead of a table.
    #[arg(long, global = true)]
    json: bool,
    /// Write the figures as a page of Markdown, too, and beside it as JSON. What stands there before, if it is of a
    /// machine of the same kind, is what the figures are compared with.
    #[arg(long, global = true, value_name = "FILE")]
    pub document: Option<PathBuf>,
}

/// Limit that a figure should meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FigureGoal {
    AtLeast(f64),
    AtMost(f64),
}

/// Figures in the order in which they were measured.
pub(crate) struct BenchReport {
    groups: Vec<FigureGroup>,
    failures: Vec<String>,
}

/// Figures under one title.
struct FigureGroup {
    title: String,
    notes: Vec<String>,
    /// Name and SVG.
    picture: Option<(&'static str, String)>,
    figures: Vec<BenchFigure>,
}

/// A measured value.
pub(crate) struct BenchFigure {
    name: String,
    value: f64,
    unit: &'static str,
    /// A peer or a limit, and its value in the same unit.
    beside: Option<(String, f64)>,
    goal: Option<FigureGoal>,
    /// Value of the last run that was written down.
    before: Option<f64>,
}

impl FigureGoal {
    fn is_met(self, value: f64) -> bool {
        match self {
            Self::AtLeast(least) => value >= least,
            Self::AtMost(most) => value <= most,
        }
    }

    fn text(self) -> String {
        match self {
            Self::AtLeast(least) => format!(">= {}", number_text(least)),
            Self::AtMost(most) => format!("<= {}", number_text(most)),
        }
    }

    fn json(self) -> Value {
        match self {
            Self::AtLeast(least) => json!({ "at_least": least }),
            Self::AtMost(most) => json!({ "at_most": most }),
        }
    }
}

impl BenchFigure {
    /// Puts a peer or a limit beside it, in the same unit.
    pub fn beside(&mut self, name: impl Into<String>, value: f64) -> &mut Self {
        self.beside = Some((name.into(), value));
        self
    }

    pub fn goal(&mut self, goal: FigureGoal) -> &mut Self {
        self.goal = Some(goal);
        self
    }

    fn is_missed(&self) -> bool {
        self.goal.is_some_and(|goal| !goal.is_met(self.value))
    }

    /// Name, value, what stands beside it, the ratio of both, the goal, and the value of the last run.
    fn cells(&self) -> [String; 6] {
        let value = format!("{} {}", number_text(self.value), self.unit).trim_end().to_owned();
        let beside = self.beside.as_ref().map(|(name, value)| format!("{name}: {}", number_text(*value)));
        let ratio = self.beside.as_ref().map(|(_, beside)| number_text(self.value / beside));
        let goal = self.goal.map(|g| format!("{} {}", g.text(), if self.is_missed() { "MISSED" } else { "met" }));
        let before = self.before.map(number_text);
        [Some(self.name.clone()), Some(value), beside, ratio, goal, before].map(Option::unwrap_or_default)
    }

    fn json(&self, group: &str) -> Value {
        json!({
            "group": group,
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "beside": self.beside.as_ref().map(|(name, value)| json!({ "name": name, "value": value })),
            "goal": self.goal.map(FigureGoal::json),
            "met": self.goal.map(|_| !self.is_missed()),
        })
    }
}

/// Longer names than this push their line's other cells to the right.
const NAME_WIDTH: usize = 72;
const HEADINGS: [&str; 6] = ["figure", "value", "beside", "ratio", "goal", "before"];

impl BenchReport {
    pub fn new() -> Self {
        Self { groups: Vec::new(), failures: Vec::new() }
    }

    /// Begins figures under a title.
    pub fn group(&mut self, title: impl Into<String>) {
        let title = title.into();
        eprintln!("{title}");
        self.groups.push(FigureGroup { title, notes: Vec::new(), picture: None, figures: Vec::new() });
    }

    /// Adds a sentence to the group.
    pub fn note(&mut self, text: impl Into<String>) {
        let text = text.into();
        eprintln!("  {text}");
        self.last_group().notes.push(text);
    }

    /// Adds a picture to the group, which is written beside the page.
    pub fn picture(&mut self, name: &'static str, svg: String) {
        self.last_group().picture = Some((name, svg));
    }

    /// Adds a figure to the group, and prints it to stderr, because the whole takes minutes.
    pub fn figure(&mut self, name: impl Into<String>, value: f64, unit: &'static str) -> &mut BenchFigure {
        let name = name.into();
        eprintln!("  {name}: {} {unit}", number_text(value));
        let figures = &mut self.last_group().figures;
        let place = figures.len();
        figures.push(BenchFigure { name, value, unit, beside: None, goal: None, before: None });
        &mut figures[place]
    }

    /// Notes that something is wrong, which makes the benchmark fail at its end; a missed goal does not.
    pub fn fail(&mut self, text: impl Into<String>) {
        let text = text.into();
        eprintln!("  FAILED: {text}");
        self.failures.push(text);
    }

    fn last_group(&mut self) -> &mut FigureGroup {
        if self.groups.is_empty() {
            self.group("Figures");
        }
        let last = self.groups.len() - 1;
        &mut self.groups[last]
    }

    /// Prints all figures, and writes the page.
    ///
    /// # Errors
    /// Something was wrong.
    pub fn finish(mut self, output: &ReportOutput) -> Result<()> {
        let machine = machine_facts();
        if let Some(file) = &output.document {
            self.set_before(&read_figures(&file.with_extension("json"), &machine)?);
        }
        let mut out = std::io::stdout().lock();
        if output.json {
            writeln!(out, "{:#}", self.json(&machine))?;
        } else if !self.groups.is_empty() {
            write!(out, "{}", self.text(&machine))?;
        }
        if let Some(file) = &output.document {
            std::fs::write(file, self.markdown(&machine)).with_context(|| format!("cannot write {file:?}"))?;
            std::fs::write(file.with_extension("json"), format!("{:#}\n", self.json(&machine)))?;
            for (name, svg) in self.groups.iter().filter_map(|group| group.picture.as_ref()) {
                std::fs::write(file.with_file_name(format!("{name}.svg")), svg)?;
            }
        }
        ensure!(self.failures.is_empty(), "{}", self.failures.join("\n"));
        Ok(())
    }

    fn set_before(&mut self, figures: &HashMap<[String; 2], f64>) {
        for group in &mut self.groups {
            for figure in &mut group.figures {
                figure.before = figures.get(&[group.title.clone(), figure.name.clone()]).copied();
            }
        }
    }

    fn json(&self, machine: &[(&str, String)]) -> Value {
        let figures = self.groups.iter().flat_map(|group| group.figures.iter().map(|f| f.json(&group.title)));
        let notes = self.groups.iter().flat_map(|group| group.notes.iter().map(|n| json!([group.title, n])));
        let machine: serde_json::Map<_, _> = machine.iter().map(|(k, v)| ((*k).to_owned(), json!(v))).collect();
        json!({
            "machine": machine,
            "figures": figures.collect::<Vec<_>>(),
            "notes": notes.collect::<Vec<_>>(),
            "failures": self.failures,
        })
    }

    fn text(&self, machine: &[(&str, String)]) -> String {
        let mut text = facts_line(machine) + "\n";
        for group in &self.groups {
            text += &format!("\n{}\n", group.title);
            for note in &group.notes {
                text += &format!("  {note}\n");
            }
            let rows: Vec<_> = group.figures.iter().map(BenchFigure::cells).collect();
            let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
            let widths = [width(0).min(NAME_WIDTH), width(1), width(2), width(3)];
            for [name, value, beside, ratio, goal, before] in &rows {
                let before = if before.is_empty() { String::new() } else { format!("  before: {before}") };
                let line = format!(
                    "  {name:<0$}  {value:>1$}  {beside:<2$}  {ratio:>3$}  {goal}{before}",
                    widths[0], widths[1], widths[2], widths[3]
                );
                text += line.trim_end();
                text.push('\n');
            }
        }
        text + "\n" + &self.goals_line() + "\n"
    }

    fn markdown(&self, machine: &[(&str, String)]) -> String {
        let args: Vec<_> = std::env::args().skip(1).collect();
        let is_path = |place: usize| args.get(place).is_some_and(|arg| arg.contains('/'));
        let kept = (0..args.len()).filter(|place| !is_path(*place) && !is_path(place + 1));
        let command: Vec<_> = kept.map(|place| args[place].as_str()).collect();
        let mut text = format!(
            "# Performance\n\n`stress {}` wrote this page. All its figures were measured in one run, on one machine:\n\
             {}. A ratio is a figure over what stands beside it; \"before\" is the value of the run that this page had \
             before, if its machine was of the same kind.\n\n{}.\n",
            command.join(" "),
            facts_line(machine),
            self.goals_line()
        );
        if command.contains(&"--quick") {
            text += "\nThis is the quick form: small runs and few repeats. Its figures are rough.\n";
        }
        for group in &self.groups {
            let _ = writeln!(text, "\n## {}\n", group.title);
            if !group.notes.is_empty() {
                text += &(group.notes.join("\n") + "\n\n");
            }
            if let Some((name, _)) = group.picture {
                let _ = writeln!(text, "![{}]({name}.svg)\n", group.title);
            }
            if group.figures.is_empty() {
                continue;
            }
            let _ = writeln!(text, "| {} |\n| --- | ---: | --- | ---: | --- | ---: |", HEADINGS.join(" | "));
            for figure in &group.figures {
                let _ = writeln!(text, "| {} |", figure.cells().map(|cell| cell.replace('|', "\\|")).join(" | "));
            }
        }
        text
    }

    fn goals_line(&self) -> String {
        let figures: Vec<_> = self.groups.iter().flat_map(|g| &g.figures).filter(|f| f.goal.is_some()).collect();
        let missed: Vec<_> = figures.iter().filter(|f| f.is_missed()).map(|f| f.name.as_str()).collect();
        let met = figures.len() - missed.len();
        let list = if missed.is_empty() { String::new() } else { format!("; missed: {}", missed.join("; ")) };
        format!("{met} of {} goals are met{list}", figures.len())
    }
}

// The figures of the last run that was written down, by group and name; none if it was on another kind of machine.
fn read_figures(file: &Path, machine: &[(&str, String)]) -> Result<HashMap<[String; 2], f64>> {
    let Ok(text) = std::fs::read_to_string(file) else { return Ok(HashMap::new()) };
    let last: Value = serde_json::from_str(&text).with_context(|| format!("in {file:?}"))?;
    if !machine.iter().all(|(name, fact)| last["machine"][*name] == json!(fact)) {
        return Ok(HashMap::new());
    }
    let figures = last["figures"].as_array().into_iter().flatten().filter_map(|figure| {
        let [group, name] = ["group", "name"].map(|key| figure[key].as_str().unwrap_or_default().to_owned());
        Some(([group, name], figure["value"].as_f64()?))
    });
    Ok(figures.collect())
}

/// Returns a number with three or four digits that count.
fn number_text(value: f64) -> String {
    match value.abs() {
        size if size >= 1000.0 => format!("{value:.0}"),
        size if size >= 100.0 => format!("{value:.1}"),
        size if size >= 1.0 || size == 0.0 => format!("{value:.2}"),
        _ => format!("{value:.4}"),
    }
}

fn facts_line(machine: &[(&str, String)]) -> String {
    machine.iter().map(|(name, text)| format!("{name} {text}")).collect::<Vec<_>>().join(", ")
}

// The program and the machine that were measured.
fn machine_facts() -> [(&'static str, String); 6] {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let read_value = |file: &str, key: &str| {
        let text = std::fs::read_to_string(file).unwrap_or_default();
        let line = text.lines().find(|line| line.starts_with(key)).unwrap_or_default();
        line.split_once(':').map_or("", |(_, value)| value.trim()).to_owned()
    };
    let kib: f64 = read_value("/proc/meminfo", "MemTotal").trim_end_matches(" kB").parse().unwrap_or(0.0);
    let this = std::env::current_exe().unwrap_or_default();
    let profile = this.parent().and_then(Path::file_name).map_or_else(String::new, |name| name.display().to_string());
    [
        ("program", concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("profile", profile),
        ("built for", if cfg!(target_feature = "avx2") { "x86-64-v3" } else { std::env::consts::ARCH }.to_owned()),
        ("processor", read_value("/proc/cpuinfo", "model name")),
        ("cores", cores.to_string()),
        ("memory", format!("{:.0} GiB", kib / 1024.0 / 1024.0)),
    ]
}
