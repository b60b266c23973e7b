//! The parameters of a slice request: a predicate over measurements, and the wanted topics and layout.

use axum::http::Uri;
use echolake_export::{Layout, Taken};
use echolake_query::PredicateForm;
use echolake_schema::RunId;

use super::super::catalogue::RequestParams;
use crate::fault::RequestFault;

/// Runs that may be named, and sources of a manifest.
pub(super) const MOST_RUNS: usize = 100;
/// Parameters that are allowed after the path's `?`.
const NAMES: [&str; 5] = ["where", "run", "topics", "layout", "id"];

/// A question.
pub(super) struct SliceQuery {
    /// The predicate; None if all measurements of the runs are wanted.
    predicate: Option<String>,
    /// None, or the runs that the measurements are of.
    pub(super) runs: Vec<RunId>,
    /// The topics, sorted; all if there are none.
    pub(super) topics: Vec<String>,
    /// The distribution of messages over chunks.
    pub(super) layout: Layout,
    /// The slice that is expected.
    pub(super) id: Option<String>,
    /// The syntax that is allowed in the predicate.
    pub(super) form: PredicateForm,
}

impl SliceQuery {
    /// # Errors
    /// [`RequestFault::Request`] if it is not right.
    pub(super) fn of(uri: &Uri) -> Result<Self, RequestFault> {
        let params = RequestParams::of(uri)?;
        if let Some(unknown) = params.names().find(|name| !NAMES.contains(name)) {
            return Err(RequestFault::request(format!(
                "there is no parameter `{unknown}`; hint: {}",
                NAMES.join(", ")
            )));
        }
        let mut runs = Vec::new();
        for name in params.all("run") {
            let hint = "GET /api/v1/runs lists what there is";
            runs.push(name.parse().map_err(|_| RequestFault::NotFound { what: format!("run `{name}`"), hint })?);
        }
        let mut topics: Vec<_> = params.all("topics").flat_map(|t| t.split(',')).map(str::to_owned).collect();
        topics.retain(|topic| !topic.is_empty());
        topics.sort();
        topics.dedup();
        runs.sort();
        runs.dedup();
        if runs.len() > MOST_RUNS {
            return Err(RequestFault::request(format!("{} runs are named, {MOST_RUNS} may be", runs.len())));
        }
        let predicate = params.one("where")?.map(str::to_owned);
        if predicate.is_none() && runs.is_empty() {
            return Err(RequestFault::request("`where` is missing; hint: where=surface_id='flat' and pair_id<100"));
        }
        let layout = match params.choice("layout", &["by-topic", "in-time"])? {
            "in-time" => Layout::InTime,
            _ => Layout::ByTopic,
        };
        let id = params.one("id")?.map(str::to_owned);
        Ok(Self { predicate, runs, topics, layout, id, form: PredicateForm::AnyExpression })
    }

    /// The predicate; a true one if none was given.
    pub(super) fn predicate(&self) -> &str {
        self.predicate.as_deref().unwrap_or("true")
    }

    /// The beginning of the query, which the predicate completes.
    pub(super) fn select(&self) -> String {
        // Names of runs have letters, digits, `_` and `-` alone.
        let named: Vec<_> = self.runs.iter().map(|run| format!("'{run}'")).collect();
        let runs = if named.is_empty() { String::new() } else { format!(" run_id in ({}) and", named.join(", ")) };
        format!("select {} from measurements where{runs}", Taken::COLUMNS.join(", "))
    }

    /// Returns whether it selects all of the runs that it names.
    pub(super) fn is_of_whole_runs(&self) -> bool {
        self.predicate.is_none() && self.topics.is_empty()
    }

    /// Returns its parameters for one run, as the query part of a URL.
    pub(super) fn query_of(&self, run: &RunId) -> String {
        let mut pairs = vec![("layout", self.layout_name())];
        pairs.extend(self.predicate.as_deref().map(|predicate| ("where", predicate)));
        pairs.push(("run", run.as_str()));
        pairs.extend(self.topics.iter().map(|topic| ("topics", topic.as_str())));
        pairs.iter().map(|(name, value)| format!("{name}={}", encoded(value))).collect::<Vec<_>>().join("&")
    }

    /// The name of its layout.
    pub(super) fn layout_name(&self) -> &'static str {
        match self.layout {
            Layout::ByTopic => "by-topic",
            Layout::InTime => "in-time",
        }
    }
}

// RFC 3986: what is not unreserved is encoded.
fn encoded(text: &str) -> String {
    text.bytes().fold(String::new(), |mut encoded, byte| {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => encoded.push(byte as char),
            other => encoded.push_str(&format!("%{other:02X}")),
        }
        encoded
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn question(query: &str) -> Result<SliceQuery, RequestFault> {
        SliceQuery::of(&format!("/x?{query}").parse().expect("a path"))
    }

    #[test]
    fn a_question_comes_back_as_it_was() {
        let asked =
            question("where=snr_db%20%3C%2035%20and%20'%C3%A9%26'%3D'%2B'&topics=/tf,/ir&topics=/tf&run=b&run=a");
        let asked = asked.unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(asked.predicate.as_deref(), Some("snr_db < 35 and '\u{e9}&'='+'"));
        assert_eq!((&asked.topics[..], asked.layout), (&["/ir".to_owned(), "/tf".to_owned()][..], Layout::ByTopic));
        assert!(asked.select().ends_with("where run_id in ('a', 'b') and"), "{}", asked.select());
        let again = question(&asked.query_of(&asked.runs[1])).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(
            (&again.predicate, &again.topics, &again.runs[..]),
            (&asked.predicate, &asked.topics, &asked.runs[1..])
        );
    }

    #[test]
    fn what_is_not_right_is_refused() {
        for wrong in
            ["", "where=a&where=b", "topic=/tf&where=a", "where=a&layout=x", "run=a'b", "run=..%2f", "topics=/tf"]
        {
            assert!(question(wrong).is_err(), "{wrong}");
        }
        let many: String = (0..=MOST_RUNS).map(|i| format!("&run=r{i}")).collect();
        assert!(question(&many).is_err());
    }
}
