//! The tools: names, descriptions, arguments.

use echolake_service::{RequestFault, TokenScope};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};

use super::AgentService;

/// Rows of an answer if the call does not say, and at most.
pub(super) const USUAL_ROWS: u64 = 100;
pub(super) const MOST_ROWS: u64 = 1000;
/// Bytes of an answer's rows as JSON: some 25,000 words.
pub(super) const MOST_BYTES: usize = 100_000;
/// A tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AgentTool {
    ListTables,
    DescribeTable,
    Query,
    ListFunctions,
    SurfaceSummary,
    RunSummary,
    SliceUrl,
}

/// A call of a tool.
pub(super) struct ToolCall<'a> {
    pub agents: &'a AgentService,
    /// Of the server's pages, for links.
    pub origin: &'a str,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoArguments {}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TableArguments {
    table: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct QueryArguments {
    sql: String,
    max_rows: Option<u64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FunctionArguments {
    search: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SurfaceArguments {
    surface_id: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RunArguments {
    run_id: String,
}

/// The slice that is wanted.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SliceArguments {
    #[serde(default)]
    pub runs: Vec<String>,
    #[serde(rename = "where")]
    pub predicate: Option<String>,
    #[serde(default)]
    pub topics: Vec<String>,
}

impl AgentTool {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::ListTables,
        Self::DescribeTable,
        Self::Query,
        Self::ListFunctions,
        Self::SurfaceSummary,
        Self::RunSummary,
        Self::SliceUrl,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::ListTables => "list_tables",
            Self::DescribeTable => "describe_table",
            Self::Query => "query",
            Self::ListFunctions => "list_functions",
            Self::SurfaceSummary => "surface_summary",
            Self::RunSummary => "run_summary",
            Self::SliceUrl => "slice_url",
        }
    }

    fn description_text(self) -> String {
        match self {
            Self::ListTables => "Lists the tables and views of the lake, and what a row of each is.".to_owned(),
            Self::DescribeTable => {
                "Describes a table or view: its columns with types, units and meanings, and a view's definition."
                    .to_owned()
            }
            Self::Query => format!(
                "Runs one read-only SQL query (DataFusion's dialect) and returns rows as lists in the order of the \
                 columns: at most max_rows and {} kB of them; `truncated` says if there were more. Lists of samples \
                 are long: aggregate or slice them.",
                MOST_BYTES / 1000
            ),
            Self::ListFunctions => {
                "Lists the SQL functions of the field (levels, responses, geometry, lists) with their \
                 syntax and an example; with `search` DataFusion's functions, too."
                    .to_owned()
            }
            Self::SurfaceSummary => {
                "Summarises a surface: parameters of its relief, runs, statistics of its levels by band, \
                 means against Flat, and links to its pages."
                    .to_owned()
            }
            Self::RunSummary => {
                "Summarises a run: state, counts, air, quality, topics of its file, the last lines of its log, \
                 and links to its page, its file and viewers."
                    .to_owned()
            }
            Self::SliceUrl => {
                "Makes the URL of a slice: an MCAP file with the messages of chosen measurements, for Foxglove, \
                 Lichtblick or rerun. Names runs, or chooses measurements by an SQL predicate over `measurements`."
                    .to_owned()
            }
        }
    }

    fn input_schema(self) -> Value {
        let text = |about: &str| json!({ "type": "string", "description": about });
        let texts = |about: &str| json!({ "type": "array", "items": { "type": "string" }, "description": about });
        let (properties, required): (Value, &[&str]) = match self {
            Self::ListTables => (json!({}), &[]),
            Self::DescribeTable => (json!({ "table": text("name of a table or view") }), &["table"]),
            Self::Query => {
                let rows = json!({
                    "type": "integer", "minimum": 1, "maximum": MOST_ROWS, "default": USUAL_ROWS,
                    "description": "rows that are returned at most"
                });
                (json!({ "sql": text("one query"), "max_rows": rows }), &["sql"])
            }
            Self::ListFunctions => (json!({ "search": text("part of a name or a description") }), &[]),
            Self::SurfaceSummary => {
                (json!({ "surface_id": text("as in table surfaces, for example flat") }), &["surface_id"])
            }
            Self::RunSummary => (json!({ "run_id": text("as in table runs") }), &["run_id"]),
            Self::SliceUrl => (
                json!({
                    "runs": texts("runs whose measurements are wanted"),
                    "where": text("an SQL predicate over the columns of measurements, as: snr_db < 35 and pair_id < \
                        100"),
                    "topics": texts("topics that are wanted; all if there are none"),
                }),
                &[],
            ),
        };
        json!({ "type": "object", "properties": properties, "required": required, "additionalProperties": false })
    }

    /// Its description for clients.
    pub fn description(self) -> Value {
        json!({
            "name": self.name(),
            "description": self.description_text(),
            "inputSchema": self.input_schema(),
            "annotations": { "readOnlyHint": true, "openWorldHint": false },
        })
    }

    fn parse_arguments<T: DeserializeOwned>(self, arguments: Map<String, Value>) -> Result<T, RequestFault> {
        serde_json::from_value(Value::Object(arguments)).map_err(|e| {
            let properties = self.input_schema()["properties"].take();
            let known: Vec<_> = properties.as_object().into_iter().flat_map(Map::keys).map(String::as_str).collect();
            let hint = if known.is_empty() { "it takes none".to_owned() } else { known.join(", ") };
            RequestFault::bad_request(format!("the arguments of `{}` are not right: {e}; hint: {hint}", self.name()))
        })
    }
}

impl ToolCall<'_> {
    /// The answer to a call.
    ///
    /// # Errors
    /// A defect of the arguments, a missing scope, or what ended the work.
    pub async fn answer_call(&self, tool: AgentTool, arguments: Map<String, Value>) -> Result<Value, RequestFault> {
        let client = self.agents.catalogue.service().authorised_client(TokenScope::Sql)?;
        match tool {
            AgentTool::ListTables => {
                let NoArguments {} = tool.parse_arguments(arguments)?;
                Ok(self.list_tables())
            }
            AgentTool::DescribeTable => {
                let TableArguments { table } = tool.parse_arguments(arguments)?;
                self.describe_table(&table)
            }
            AgentTool::Query => {
                let QueryArguments { sql, max_rows } = tool.parse_arguments(arguments)?;
                Box::pin(self.run_query(&client, sql, max_rows)).await
            }
            AgentTool::ListFunctions => {
                let FunctionArguments { search } = tool.parse_arguments(arguments)?;
                Ok(self.list_functions(search.as_deref()))
            }
            AgentTool::SurfaceSummary => {
                let SurfaceArguments { surface_id } = tool.parse_arguments(arguments)?;
                Box::pin(self.surface_summary(&surface_id)).await
            }
            AgentTool::RunSummary => {
                let RunArguments { run_id } = tool.parse_arguments(arguments)?;
                Box::pin(self.run_summary(&run_id)).await
            }
            AgentTool::SliceUrl => self.slice_url(tool.parse_arguments::<SliceArguments>(arguments)?).await,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tool_says_what_it_takes() {
        for tool in AgentTool::ALL {
            let description = tool.description();
            let schema = &description["inputSchema"];
            assert!(!description["description"].as_str().unwrap_or_default().contains("  "), "{description}");
            for name in schema["required"].as_array().expect("a list") {
                assert!(schema["properties"][name.as_str().unwrap_or_default()].is_object(), "{description}");
            }
        }
    }

    #[test]
    fn arguments_that_are_not_right_are_refused_with_those_that_are() {
        let parse = |arguments: Value| {
            let arguments = arguments.as_object().cloned().unwrap_or_default();
            AgentTool::Query.parse_arguments::<QueryArguments>(arguments).map(|a| a.sql).map_err(|e| e.to_string())
        };
        assert_eq!(parse(json!({ "sql": "select 1", "max_rows": 3 })), Ok("select 1".to_owned()));
        for wrong in [
            json!({}),
            json!({ "sql": 1 }),
            json!({ "sql": "x", "max_rows": -1 }),
            json!({ "sql": "x", "max_rows": 1.5 }),
            json!({ "sql": "x", "format": "csv" }),
        ] {
            let fault = parse(wrong).expect_err("a defect");
            assert!(fault.ends_with("hint: max_rows, sql"), "{fault}");
        }
    }
}
