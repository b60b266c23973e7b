//! The parameters of a slice request: a predicate over measurements, and the wanted topics and layout.

use echolake_export::{Layout, Taken};
use echolake_query::PredicateForm;
use echolake_schema::{RunId, quoted_text};
use echolake_service::RequestFault;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde::Deserialize;
use utoipa::{IntoParams, ToSchema};

/// Runs that may be named, and sources of a manifest.
pub(super) const MOST_RUNS: usize = 100;
/// Characters that are encoded in a URL: all that RFC 3986 does not call unreserved.
const RESERVED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

/// The parameters after the path's `?`.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(crate) struct SliceParameters {
    /// An SQL predicate over the columns of table measurements; all measurements of the runs if there is none.
    #[serde(rename = "where")]
    #[param(example = "pair_id < 5")]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    predicate: Option<String>,
    /// The runs that the measurements are of; a page of elsewhere has to name them.
    #[param(style = Form, explode)]
    run: Vec<String>,
    /// Topics, separated by commas; all, and the attachments, if there are none.
    #[param(value_type = String, required = false)]
    topics: Vec<String>,
    /// Heavy topics in chunks of their own, or all messages in the order of time.
    #[param(inline)]
    layout: SliceLayout,
    /// The slice's ETag without quotes; if it is another by now, 410.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    id: Option<String>,
}

#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
#[schema(default = "by-topic")]
enum SliceLayout {
    #[default]
    ByTopic,
    InTime,
}

impl SliceParameters {
    /// A slice by topic.
    pub fn new(predicate: Option<String>, run: Vec<String>, topics: Vec<String>) -> Self {
        Self { predicate, run, topics, layout: SliceLayout::ByTopic, id: None }
    }
}

/// The slice that is requested.
pub(super) struct SliceQuery {
    /// The predicate; None if all measurements of the runs are wanted.
    predicate: Option<String>,
    /// None, or the runs that the measurements are of.
    pub runs: Vec<RunId>,
    /// The topics, sorted; all if there are none.
    pub topics: Vec<String>,
    /// The distribution of messages over chunks.
    pub layout: Layout,
    /// The slice that is expected.
    pub id: Option<String>,
    /// The syntax that is allowed in the predicate.
    pub form: PredicateForm,
}

impl SliceQuery {
    /// # Errors
    /// [`RequestFault::Request`] if it is not right.
    pub fn new(params: SliceParameters) -> Result<Self, RequestFault> {
        let mut runs = Vec::new();
        for name in &params.run {
            let hint = "GET /api/v1/runs lists what there is";
            runs.push(
                name.parse()
                    .map_err(|_| RequestFault::NotFound { what: format!("run `{}`", quoted_text(name)), hint })?,
            );
        }
        let mut topics: Vec<_> = params.topics.iter().flat_map(|t| t.split(',')).map(str::to_owned).collect();
        topics.retain(|topic| !topic.is_empty());
        topics.sort();
        topics.dedup();
        runs.sort();
        runs.dedup();
        if runs.len() > MOST_RUNS {
            return Err(RequestFault::bad_request(format!("{} runs are named, {MOST_RUNS} may be", runs.len())));
        }
        let predicate = params.predicate;
        if predicate.is_none() && runs.is_empty() {
            return Err(RequestFault::bad_request("`where` is missing; hint: where=surface_id='flat' and pair_id<100"));
        }
        let layout = match params.layout {
            SliceLayout::ByTopic => Layout::ByTopic,
            SliceLayout::InTime => Layout::InTime,
        };
        Ok(Self { predicate, runs, topics, layout, id: params.id, form: PredicateForm::AnyExpression })
    }

    /// The predicate; a true one if none was given.
    pub fn predicate(&self) -> &str {
        self.predicate.as_deref().unwrap_or("true")
    }

    /// The beginning of the query, which the predicate completes.
    pub fn select_clause(&self) -> String {
        self.select_of(&Taken::COLUMNS.join(", "))
    }

    /// The same with other columns.
    pub fn select_of(&self, columns: &str) -> String {
        // Names of runs have letters, digits, `_` and `-` alone.
        let named: Vec<_> = self.runs.iter().map(|run| format!("'{run}'")).collect();
        let runs = if named.is_empty() { String::new() } else { format!(" run_id in ({}) and", named.join(", ")) };
        format!("select {columns} from measurements where{runs}")
    }

    /// Returns whether it selects all of the runs that it names.
    pub fn is_of_whole_runs(&self) -> bool {
        self.predicate.is_none() && self.topics.is_empty()
    }

    /// Returns its parameters for some runs, as the query part of a URL.
    pub fn query_of<'a>(&'a self, runs: impl IntoIterator<Item = &'a RunId>) -> String {
        let mut pairs = vec![("layout", self.layout_name())];
        pairs.extend(self.predicate.as_deref().map(|predicate| ("where", predicate)));
        pairs.extend(runs.into_iter().map(|run| ("run", run.as_str())));
        pairs.extend(self.topics.iter().map(|topic| ("topics", topic.as_str())));
        let params = pairs.iter().map(|(name, value)| format!("{name}={}", utf8_percent_encode(value, RESERVED)));
        params.collect::<Vec<_>>().join("&")
    }

    /// The name of its layout.
    pub fn layout_name(&self) -> &'static str {
        match self.layout {
            Layout::ByTopic => "by-topic",
            Layout::InTime => "in-time",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::extract::parse_query;
    use super::*;

    fn question(query: &str) -> Result<SliceQuery, RequestFault> {
        SliceQuery::new(parse_query(&format!("/x?{query}").parse().expect("a path"))?)
    }

    #[test]
    fn a_question_comes_back_as_it_was() {
        let asked =
            question("where=snr_db%20%3C%2035%20and%20'%C3%A9%26'%3D'%2B'&topics=/tf,/ir&topics=/tf&run=b&run=a");
        let asked = asked.unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(asked.predicate.as_deref(), Some("snr_db < 35 and '\u{e9}&'='+'"));
        assert_eq!((&asked.topics[..], asked.layout), (&["/ir".to_owned(), "/tf".to_owned()][..], Layout::ByTopic));
        assert!(asked.select_clause().ends_with("where run_id in ('a', 'b') and"), "{}", asked.select_clause());
        let again = question(&asked.query_of(&asked.runs[1..])).unwrap_or_else(|e| panic!("{e}"));
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
        let unknown = question("topic=/tf&where=a").err().expect("a fault").to_string();
        assert_eq!(unknown, "`topic`: unknown field `topic`, expected one of `where`, `run`, `topics`, `layout`, `id`");
        let many: String = (0..=MOST_RUNS).map(|i| format!("&run=r{i}")).collect();
        assert!(question(&many).is_err());
    }
}
