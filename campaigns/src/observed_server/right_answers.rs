//! Answers of an undisturbed server, with which later ones are compared.

use std::collections::BTreeMap;

use anyhow::{Result, ensure};

use super::{QueryClient, QueryOutcome, QueryProtocol};

/// The answer of each query over each protocol.
pub(crate) type RightAnswers = BTreeMap<(QueryProtocol, &'static str), QueryOutcome>;

/// Asks each query over each protocol that answers with rows, twice: an answer that is not always the same compares with
/// nothing.
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
            ensure!(answer == client.query(protocol, sql), "{sql} over {name} has two answers");
            right.insert((protocol, *sql), answer);
        }
    }
    Ok(right)
}
