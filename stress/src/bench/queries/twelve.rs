//! The twelve queries, written down once in `twelve.sql`. Both engines get the same text, but for views that only
//! echolake has.

/// One query of the benchmark.
#[derive(Clone)]
pub(crate) struct BenchQuery {
    /// Short name.
    pub name: String,
    /// Kind of those that are alike.
    pub kind: &'static str,
    /// Query for echolake.
    pub sql: String,
    /// Query for DuckDB, if its tables need other words for the same rows.
    pub peer: Option<String>,
}

/// Kind of the twelve.
pub(crate) const TWELVE: &str = "twelve";

/// Kind of the joins of the air to the takes.
pub(crate) const TIME_JOIN: &str = "joins by time";

/// The air of the five seconds before each take, and the last reading before it.
pub(crate) fn time_joins() -> [BenchQuery; 2] {
    let query = |name: &str, join: &str| BenchQuery {
        name: name.to_owned(),
        kind: TIME_JOIN,
        sql: format!(
            "SELECT m.surface_id, count(e.temperature_c) AS readings, avg(e.temperature_c) AS mean_c FROM measurements m \
             {join} GROUP BY m.surface_id ORDER BY m.surface_id"
        ),
        peer: None,
    };
    [
        query(
            "range join",
            "JOIN environment e ON e.run_id = m.run_id \
             AND e.log_time BETWEEN m.log_time - INTERVAL '5 seconds' AND m.log_time",
        ),
        query("as-of join", "ASOF LEFT JOIN environment e ON m.run_id = e.run_id AND m.log_time >= e.log_time"),
    ]
}

/// The queries about a surface and a pair of the lake.
pub(crate) fn bench_queries(surface: &str, pair: i64) -> Vec<BenchQuery> {
    let mut queries: Vec<BenchQuery> = Vec::new();
    // Each text begins after its name, which ends at a colon or with its line.
    for part in include_str!("twelve.sql").split("\n\n-- ").skip(1) {
        let Some((title, text)) = part.split_once('\n') else { continue };
        let name = title.split(':').next().unwrap_or(title);
        let sql = text.trim_end().trim_end_matches(';');
        let sql = sql.replace("$SURFACE", surface).replace("$PAIR", &pair.to_string());
        match (name.strip_suffix("@peer"), queries.last_mut()) {
            (Some(_), Some(last)) => last.peer = Some(sql),
            _ => queries.push(BenchQuery { name: name.to_owned(), kind: TWELVE, sql, peer: None }),
        }
    }
    queries
}
