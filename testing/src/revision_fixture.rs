//! Numbers that a revision stands for: what is derived once is derived again only if its revision is raised, so a test
//! computes a few of its numbers and compares them with those that were written at the same revision.

use std::cmp::Ordering;
use std::fmt::Write as _;
use std::path::Path;

/// Set to write the numbers of a raised revision.
const RENEW: &str = "ECHOLAKE_RENEW";
/// Difference from the greatest value of a line that is no change: other processors round otherwise.
const RELATIVE_TOLERANCE: f64 = 3e-4;
/// Beginning of the names of what the numbers are computed from.
const INPUT: &str = "input.";
/// Beginning of the fixture's first line.
const REVISION: &str = "revision ";
/// Changed lines that a message repeats.
const MOST_LINES: usize = 8;

/// A line of a fixture: a few values of one quantity.
#[derive(Debug, Clone, PartialEq)]
pub struct NumberLine {
    name: String,
    values: Vec<f64>,
    tolerance: f64,
}

/// A committed text of numbers, and the revision of the code that computed them. A number that changes needs a raised
/// revision, unless a line of its input changes, too.
#[derive(Debug, Clone, Copy)]
pub struct RevisionFixture<'a> {
    /// Its path in the member's folder.
    pub path: &'a str,
    /// Name of the constant that is to be raised.
    pub constant: &'a str,
    /// Value of the constant.
    pub revision: u32,
    /// Name of the test that compares it.
    pub test: &'a str,
}

impl NumberLine {
    /// A line of all values, whose differences up to `tolerance` are no change.
    pub fn from_values(name: impl Into<String>, values: Vec<f64>, tolerance: f64) -> Self {
        let name: String = name.into();
        Self { name: name.replace(char::is_whitespace, "_"), values, tolerance }
    }

    /// A line of the mean, the root of the mean square and two weighted means, which follow the order, of many values.
    /// Differences of 0.03 % of the greatest of these, or up to `least_tolerance`, are no change. Values that are not
    /// finite are left out; a line of no values has none.
    pub fn summarise_values(name: impl Into<String>, values: &[f64], least_tolerance: f64) -> Self {
        let known: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
        let mean = |term: &dyn Fn(f64, f64) -> f64| {
            let terms = known.iter().enumerate().map(|(at, value)| term(at as f64, *value));
            terms.sum::<f64>() / known.len() as f64
        };
        let summary = match known.is_empty() {
            true => Vec::new(),
            // The weights repeat after no whole number of values.
            false => vec![
                mean(&|_, value| value),
                mean(&|_, value| value * value).sqrt(),
                mean(&|at, value| value * (at * 0.7).cos()),
                mean(&|at, value| value * (at * 2.3).sin()),
            ],
        };
        let greatest = summary.iter().copied().map(f64::abs).fold(0.0, f64::max);
        Self::from_values(name, summary, (RELATIVE_TOLERANCE * greatest).max(least_tolerance))
    }

    /// The same line as one of what the numbers are computed from: if it changes, theirs may change with it.
    pub fn into_input(self) -> Self {
        Self { name: format!("{INPUT}{}", self.name), ..self }
    }

    fn is_input(&self) -> bool {
        self.name.starts_with(INPUT)
    }

    fn write_line(&self) -> String {
        self.values.iter().fold(self.name.clone(), |mut line, value| {
            let _ = write!(line, " {value:.5e}");
            line
        })
    }

    fn is_same(&self, written: &str) -> bool {
        let mut words = written.split(' ');
        if words.next() != Some(self.name.as_str()) {
            return false;
        }
        let values: Option<Vec<f64>> = words.map(|word| word.parse().ok()).collect();
        values.is_some_and(|values| {
            let is_near = |(written, value): (&f64, &f64)| (written - value).abs() <= self.tolerance;
            values.len() == self.values.len() && values.iter().zip(&self.values).all(is_near)
        })
    }
}

impl RevisionFixture<'_> {
    /// Compares the numbers with those of the fixture. With `ECHOLAKE_RENEW=1` it writes those of a raised revision, and
    /// refuses those of the same one.
    ///
    /// # Panics
    /// The numbers changed and the revision did not, or the fixture is not of this revision and not to be renewed.
    pub fn check_numbers(&self, numbers: &[NumberLine]) {
        let path = Path::new(self.path);
        let written = std::fs::read_to_string(path).ok();
        match self.judge_numbers(written.as_deref(), numbers, std::env::var_os(RENEW).is_some()) {
            Ok(None) => {}
            Ok(Some(text)) => {
                let folder = path.parent().expect("a fixture is in a folder");
                std::fs::create_dir_all(folder).expect("the fixture's folder is made");
                std::fs::write(path, text).expect("the fixture is written");
            }
            Err(reason) => panic!("{}: {reason}", self.path),
        }
    }

    // Returns the text to write; None if the fixture stays.
    fn judge_numbers(
        &self,
        written: Option<&str>,
        numbers: &[NumberLine],
        is_renewed: bool,
    ) -> Result<Option<String>, String> {
        let Self { constant, revision, test, .. } = *self;
        let hint = format!("hint: `{RENEW}=1 cargo test --profile quick --workspace --locked {test}` writes it");
        let renew = |reason: String| match is_renewed {
            true => Ok(Some(self.write_text(numbers))),
            false => Err(format!("{reason}; {hint}")),
        };
        let Some(written) = written else { return renew("there is no fixture".to_owned()) };
        let mut lines = written.lines();
        let first = lines.next().and_then(|line| line.strip_prefix(REVISION));
        let Some(known) = first.and_then(|known| known.parse::<u32>().ok()) else {
            return Err(format!("its first line is no `{REVISION}N`; hint: restore it with git"));
        };
        let lines: Vec<_> = lines.collect();
        let changed = changed_lines(&lines, numbers);
        let is_input_same = {
            let inputs: Vec<_> = lines.iter().copied().filter(|line| line.starts_with(INPUT)).collect();
            let now: Vec<_> = numbers.iter().filter(|line| line.is_input()).cloned().collect();
            changed_lines(&inputs, &now).is_empty()
        };
        match (revision.cmp(&known), changed.is_empty()) {
            (Ordering::Less, _) => {
                Err(format!("it is of revision {known}, and {constant} is {revision}: a revision is never lowered"))
            }
            (Ordering::Equal, true) => Ok(None),
            (Ordering::Equal, false) if is_input_same => {
                let changed = changed.join("\n");
                Err(format!("the numbers changed, and {constant} did not: raise it, then renew the fixture\n{changed}"))
            }
            // A commit that changes both shows nothing.
            (Ordering::Equal, false) => renew(format!(
                "the input of the numbers changed, so that they do not show whether {constant} must be raised: change \
                 the input and the code by two commits"
            )),
            (Ordering::Greater, _) => renew(format!("it is of revision {known}, and {constant} is {revision}")),
        }
    }

    fn write_text(&self, numbers: &[NumberLine]) -> String {
        let lines: String = numbers.iter().map(|line| format!("{}\n", line.write_line())).collect();
        format!("{REVISION}{}\n{lines}", self.revision)
    }
}

// Some of the lines that differ, as they were and as they are.
fn changed_lines(written: &[&str], numbers: &[NumberLine]) -> Vec<String> {
    let count = written.len().max(numbers.len());
    let pairs = (0..count).map(|at| (written.get(at), numbers.get(at)));
    let changed = pairs.filter(|(written, line)| match (written, line) {
        (Some(written), Some(line)) => !line.is_same(written),
        _ => true,
    });
    let describe = |(written, line): (Option<&&str>, Option<&NumberLine>)| {
        let written = written.map_or("nothing", |written| *written);
        let line = line.map_or_else(|| "nothing".to_owned(), NumberLine::write_line);
        format!("  was: {written}\n  is:  {line}")
    };
    changed.take(MOST_LINES).map(describe).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixture(revision: u32) -> RevisionFixture<'static> {
        RevisionFixture { path: "a/b.txt", constant: "SOME_REVISION", revision, test: "t" }
    }

    fn numbers(level_db: f64, input: f64) -> Vec<NumberLine> {
        vec![
            NumberLine::summarise_values("samples", &[input, -input, 2.0 * input], 0.0).into_input(),
            NumberLine::from_values("level of it", vec![level_db, -3.0], 1e-3),
        ]
    }

    /// E33: changed numbers pass with a raised revision alone, and are not renewed without it either.
    #[test]
    fn changed_numbers_need_a_raised_revision() {
        let text = fixture(3).judge_numbers(None, &numbers(-10.0, 0.5), true).expect("renewed").expect("a text");
        assert!(
            text.starts_with("revision 3\ninput.samples ") && text.contains("\nlevel_of_it -1.00000e1 -3.00000e0\n")
        );
        let judge = |revision: u32, numbers: &[NumberLine], is_renewed: bool| {
            fixture(revision).judge_numbers(Some(&text), numbers, is_renewed)
        };
        for is_renewed in [false, true] {
            assert_eq!(judge(3, &numbers(-10.0, 0.5), is_renewed), Ok(None));
            assert_eq!(judge(3, &numbers(-10.000_9, 0.500_01), is_renewed), Ok(None), "rounding is no change");
            let unraised = judge(3, &numbers(-10.002, 0.5), is_renewed).expect_err("the revision is the same");
            assert!(unraised.starts_with("the numbers changed, and SOME_REVISION did not: raise it"), "{unraised}");
            assert!(
                unraised.contains("was: level_of_it -1.00000e1") && unraised.contains("is:  level_of_it -1.00020e1")
            );
            let lacking = judge(3, &numbers(-10.0, 0.5)[..1], is_renewed).expect_err("a line is gone");
            assert!(lacking.contains("did not: raise it"), "{lacking}");
            assert!(judge(2, &numbers(-10.0, 0.5), is_renewed).expect_err("lowered").contains("never lowered"));
        }
        let stale = judge(4, &numbers(-11.0, 0.5), false).expect_err("stale");
        assert!(stale.contains("of revision 3, and SOME_REVISION is 4; hint: `ECHOLAKE_RENEW=1 "), "{stale}");
        let renewed = judge(4, &numbers(-11.0, 0.5), true).expect("raised").expect("a text");
        assert!(renewed.starts_with("revision 4\n"), "{renewed}");
        // Other input makes other numbers at the same revision.
        assert!(
            judge(3, &numbers(-11.0, 0.6), false)
                .expect_err("other input")
                .contains("the input of the numbers changed")
        );
        assert!(judge(3, &numbers(-11.0, 0.6), true).is_ok_and(|text| text.is_some()));
        let missing = fixture(3).judge_numbers(None, &numbers(-10.0, 0.5), false).expect_err("missing");
        assert!(missing.starts_with("there is no fixture; hint: `ECHOLAKE_RENEW=1 "), "{missing}");
    }

    #[test]
    fn summaries_follow_values_and_their_order() {
        let line = |values: &[f64]| NumberLine::summarise_values("x", values, 0.0);
        let written = line(&[1.0, 2.0, 3.0, f64::NAN]).write_line();
        assert!(line(&[1.0, 2.0, 3.0]).is_same(&written));
        for other in [&[1.0, 3.0, 2.0][..], &[1.0, 2.0, 3.01], &[]] {
            assert!(!line(other).is_same(&written), "{other:?}");
        }
        assert!(line(&[]).is_same("x") && line(&[0.0]).is_same(&line(&[0.0]).write_line()));
    }
}
