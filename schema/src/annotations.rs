//! Annotations: what users say of a run, or of some of its measurements, and the verdicts that follow from them.

use std::collections::{HashMap, HashSet};

use chrono::{DateTime, Utc};
use serde::{Deserialize, Serialize};

use crate::RunId;

/// Longest label or comment, in characters.
const LONGEST_VALUE: usize = 100;
const LONGEST_COMMENT: usize = 2_000;
/// Longest id, in characters.
const LONGEST_ID: usize = 64;

/// One annotation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Annotation {
    /// Its name, which its author may choose: the same annotation sent again is stored once.
    pub annotation_id: String,
    /// The run.
    pub run_id: RunId,
    /// The pairs whose measurements are meant, ascending; None: the whole run.
    pub pair_ids: Option<Vec<u32>>,
    /// Its kind.
    pub kind: AnnotationKind,
    /// The label, or `accepted` or `rejected`; empty for a note.
    pub value: String,
    /// Free text: the reason.
    pub comment: String,
    /// The author, as the server knows the client.
    pub author: String,
    /// Time at which the server took it.
    pub time: DateTime<Utc>,
    /// Version of the lake that the author saw; None if it is not told.
    pub lake_version: Option<u64>,
}

/// The kind of an annotation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AnnotationKind {
    /// A word to find measurements by.
    Label,
    /// A judgement of measurements, good or bad: the last verdict on a measurement counts.
    Verdict,
    /// A comment alone.
    Note,
}

impl AnnotationKind {
    /// The kind of a name.
    pub fn by_name(name: &str) -> Option<Self> {
        [Self::Label, Self::Verdict, Self::Note].into_iter().find(|kind| kind.name() == name)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Label => "label",
            Self::Verdict => "verdict",
            Self::Note => "note",
        }
    }
}

impl Annotation {
    /// Checks its texts and its pairs.
    ///
    /// # Errors
    /// The field, its value, and the expected one.
    pub fn check_texts(&self, pairs: usize) -> Result<(), String> {
        let is_id = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        if self.annotation_id.is_empty()
            || self.annotation_id.len() > LONGEST_ID
            || !self.annotation_id.chars().all(is_id)
        {
            let id = &self.annotation_id;
            return Err(format!("`annotation_id` is `{id}`, expected 1 to {LONGEST_ID} of A-Z a-z 0-9 _ - ."));
        }
        for (name, text, longest) in
            [("value", &self.value, LONGEST_VALUE), ("comment", &self.comment, LONGEST_COMMENT)]
        {
            let length = text.chars().count();
            if length > longest {
                return Err(format!("`{name}` has {length} characters, expected {longest} at most"));
            }
        }
        let expected = match self.kind {
            AnnotationKind::Verdict if !matches!(self.value.as_str(), "accepted" | "rejected") => {
                Some("`accepted` or `rejected` for a verdict")
            }
            AnnotationKind::Label if self.value.trim().is_empty() => Some("a word for a label"),
            AnnotationKind::Note if !self.value.is_empty() => Some("none for a note, whose text is its comment"),
            _ => None,
        };
        if let Some(expected) = expected {
            return Err(format!("`value` is `{}`, expected {expected}", self.value));
        }
        if self.kind == AnnotationKind::Note && self.comment.trim().is_empty() {
            return Err("`comment` is empty, expected the text of the note".to_owned());
        }
        match &self.pair_ids {
            Some(ids) if ids.is_empty() => {
                Err("no pair is meant; hint: leave all pairs out to mean the run".to_owned())
            }
            Some(ids) => match ids.iter().find(|id| **id as usize >= pairs) {
                Some(id) => Err(format!("pair {id} is not one of the rig's, 0 to {}", pairs.saturating_sub(1))),
                None => Ok(()),
            },
            None => Ok(()),
        }
    }

    /// Returns whether another says the same under the same id.
    pub fn is_same(&self, other: &Self) -> bool {
        let meant = |a: &Self| (a.annotation_id.clone(), a.run_id.clone(), a.pair_ids.clone(), a.kind);
        meant(self) == meant(other)
            && (&self.value, &self.comment, &self.author) == (&other.value, &other.comment, &other.author)
    }
}

/// The measurements that the last verdict on each rejects.
///
/// ```
/// use echolake_schema::annotations::RejectedMeasurements;
///
/// assert!(RejectedMeasurements::default().is_empty());
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RejectedMeasurements {
    runs: HashMap<String, RunVerdicts>,
}

/// The verdicts on the measurements of a run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct RunVerdicts {
    /// The last verdict on the whole run is a rejection.
    is_rejected: bool,
    /// Pairs with another verdict than the whole run.
    others: HashSet<u32>,
}

impl RejectedMeasurements {
    /// Applies annotations in the order of their numbers.
    pub fn from_annotations<'a>(annotations: impl IntoIterator<Item = &'a Annotation>) -> Self {
        let mut rejected = Self::default();
        for annotation in annotations.into_iter().filter(|a| a.kind == AnnotationKind::Verdict) {
            let verdicts = rejected.runs.entry(annotation.run_id.as_str().to_owned()).or_default();
            verdicts.apply_verdict(annotation);
        }
        rejected.runs.retain(|_, verdicts| verdicts.is_rejected || !verdicts.others.is_empty());
        rejected
    }

    /// Returns whether nothing is rejected.
    pub fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    /// Returns whether a measurement is rejected.
    pub fn is_rejected(&self, run: &str, pair: u32) -> bool {
        self.runs.get(run).is_some_and(|verdicts| verdicts.is_rejected != verdicts.others.contains(&pair))
    }

    /// Returns whether all measurements of a run are rejected.
    pub fn is_run_rejected(&self, run: &str) -> bool {
        self.runs.get(run).is_some_and(|verdicts| verdicts.is_rejected && verdicts.others.is_empty())
    }

    /// Describes the rejections of a run, in one way for the same measurements: `all`, `all but 3 7`, or `3 7`. None if
    /// none is rejected.
    pub fn rejection_text(&self, run: &str) -> Option<String> {
        let RunVerdicts { is_rejected, others } = self.runs.get(run)?;
        let mut pairs: Vec<u32> = others.iter().copied().collect();
        pairs.sort_unstable();
        let pairs = pairs.iter().map(u32::to_string).collect::<Vec<_>>().join(" ");
        Some(match (is_rejected, pairs.as_str()) {
            (true, "") => "all".to_owned(),
            (true, pairs) => format!("all but {pairs}"),
            (false, pairs) => pairs.to_owned(),
        })
    }

    /// Returns whether some measurement of a run is rejected.
    pub fn has_run(&self, run: &str) -> bool {
        self.runs.contains_key(run)
    }
}

impl RunVerdicts {
    fn apply_verdict(&mut self, annotation: &Annotation) {
        let is_rejected = annotation.value == "rejected";
        match &annotation.pair_ids {
            None => *self = Self { is_rejected, others: HashSet::new() },
            Some(pairs) if is_rejected == self.is_rejected => pairs.iter().for_each(|pair| {
                self.others.remove(pair);
            }),
            Some(pairs) => self.others.extend(pairs),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn annotation(run: &str, pairs: Option<&[u32]>, kind: AnnotationKind, value: &str) -> Annotation {
        Annotation {
            annotation_id: "a-1".to_owned(),
            run_id: run.parse().expect("an id"),
            pair_ids: pairs.map(<[u32]>::to_vec),
            kind,
            value: value.to_owned(),
            comment: "because".to_owned(),
            author: "ann".to_owned(),
            time: DateTime::UNIX_EPOCH,
            lake_version: Some(3),
        }
    }

    fn verdict(run: &str, pairs: Option<&[u32]>, value: &str) -> Annotation {
        annotation(run, pairs, AnnotationKind::Verdict, value)
    }

    #[test]
    fn the_last_verdict_on_a_measurement_counts() {
        let check = |verdicts: &[Annotation], rejected: &[u32], is_whole: bool| {
            let found = RejectedMeasurements::from_annotations(verdicts);
            assert_eq!(
                (0..4).filter(|pair| found.is_rejected("r", *pair)).collect::<Vec<_>>(),
                rejected,
                "{verdicts:?}"
            );
            assert_eq!(found.is_run_rejected("r"), is_whole, "{verdicts:?}");
            assert!(!found.is_rejected("other", 1));
        };
        let [some, all, one] = [Some(&[1u32, 2][..]), None, Some(&[2u32][..])];
        check(&[], &[], false);
        check(&[verdict("r", some, "rejected")], &[1, 2], false);
        check(&[verdict("r", some, "rejected"), verdict("r", one, "accepted")], &[1], false);
        check(&[verdict("r", all, "rejected"), verdict("r", one, "accepted")], &[0, 1, 3], false);
        check(&[verdict("r", one, "accepted"), verdict("r", all, "rejected")], &[0, 1, 2, 3], true);
        check(&[verdict("r", all, "rejected"), verdict("r", all, "accepted")], &[], false);
        check(&[annotation("r", all, AnnotationKind::Label, "rejected")], &[], false);
        let undone = [verdict("r", one, "rejected"), verdict("r", one, "accepted")];
        assert!(RejectedMeasurements::from_annotations(&undone).is_empty());
        let text = |verdicts: &[Annotation]| RejectedMeasurements::from_annotations(verdicts).rejection_text("r");
        assert_eq!(text(&undone), None);
        assert_eq!(text(&[verdict("r", one, "rejected"), verdict("r", some, "rejected")]).as_deref(), Some("1 2"));
        assert_eq!(text(&[verdict("r", all, "rejected")]).as_deref(), Some("all"));
        assert_eq!(text(&[verdict("r", all, "rejected"), verdict("r", one, "accepted")]).as_deref(), Some("all but 2"));
    }

    #[test]
    fn what_is_no_annotation_is_refused_with_the_field() {
        let check = |change: fn(&mut Annotation), expected: &str| {
            let mut changed = verdict("r", Some(&[1]), "rejected");
            change(&mut changed);
            let found = changed.check_texts(3).expect_err(expected);
            assert!(found.contains(expected), "{found}");
        };
        assert_eq!(verdict("r", Some(&[2]), "accepted").check_texts(3), Ok(()));
        check(|a| a.value = "bad".to_owned(), "`accepted` or `rejected`");
        check(|a| a.kind = AnnotationKind::Note, "none for a note");
        check(|a| (a.kind, a.value) = (AnnotationKind::Label, " ".to_owned()), "a word for a label");
        check(|a| a.pair_ids = Some(vec![0, 3]), "pair 3 is not one of the rig's, 0 to 2");
        check(|a| a.pair_ids = Some(Vec::new()), "no pair is meant");
        check(|a| a.annotation_id = "a b".to_owned(), "`annotation_id` is `a b`");
        check(|a| a.comment = "x".repeat(2_001), "`comment` has 2001 characters");
    }
}
