//! Answers of an undisturbed server, and how many of later ones are equal to them.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Result, ensure};

use super::{QueryClient, QueryOutcome, QueryProtocol};

/// The answer of each query over each protocol.
pub(crate) type RightAnswers = BTreeMap<(QueryProtocol, &'static str), QueryOutcome>;

/// Asks each query over each protocol that answers with rows, twice: an answer that is not always the same compares
/// with nothing.
///
/// # Errors
/// A query fails, or has another answer the second time.
pub(crate) fn take_right_answers(client: &QueryClient, queries: &[&'static str]) -> Result<RightAnswers> {
    let mut right = RightAnswers::new();
    for sql in queries {
        for protocol in QueryProtocol::ROWS {
            let answer = client.query(protocol, sql);
            let name = protocol.name();
            ensure!(matches!(answer, QueryOutcome::Answer(_)), "{sql} over {name}: {answer}");
            let again = client.query(protocol, sql);
            ensure!(answer == again, "{sql} over {name} has two answers: {answer}, and {again}");
            right.insert((protocol, *sql), answer);
        }
    }
    Ok(right)
}

/// Answers and errors that clients got.
#[derive(Debug, Default)]
pub(crate) struct AnswerTally {
    /// Times of right answers.
    pub times: Vec<Duration>,
    /// Number of answers that look whole and are not the right ones.
    pub wrong: usize,
    /// Number of errors with a code, by protocol and code.
    pub refused: BTreeMap<String, usize>,
    /// Number of answers over HTTP that were broken off, which is how it shows an error after the first byte.
    pub broken_off: usize,
    /// Number of connections that ended without a code, by protocol and how.
    pub lost: BTreeMap<String, usize>,
}

impl AnswerTally {
    /// Returns whether each answer was right, or seen to be none.
    pub fn is_honest(&self) -> bool {
        self.wrong == 0 && self.lost.is_empty()
    }

    /// Returns whether each answer was right.
    pub fn is_right(&self) -> bool {
        self.is_honest() && self.refused.is_empty() && self.broken_off == 0
    }

    /// Returns how many queries failed because their engine ended.
    pub fn count_engine_ends(&self) -> usize {
        let counts = self.refused.iter().filter(|(error, _)| is_engine_end(error)).map(|(_, count)| count);
        counts.sum()
    }

    /// Returns whether there is an error that says something else than that an engine ended.
    pub fn has_other_errors(&self) -> bool {
        self.refused.keys().any(|error| !is_engine_end(error))
    }

    /// Counts the outcome of a query.
    pub fn add(&mut self, protocol: QueryProtocol, outcome: QueryOutcome, right: &QueryOutcome, took: Duration) {
        let name = || format!("{}: {outcome}", protocol.name());
        match &outcome {
            outcome if outcome == right => self.times.push(took),
            QueryOutcome::Answer(_) => self.wrong += 1,
            QueryOutcome::Refused(_) => *self.refused.entry(name()).or_default() += 1,
            QueryOutcome::Truncated if protocol == QueryProtocol::Http => self.broken_off += 1,
            _ => *self.lost.entry(name()).or_default() += 1,
        }
    }
}

fn is_engine_end(error: &str) -> bool {
    error.ends_with(": query_ended_engine") || error.ends_with(": 58000")
}
