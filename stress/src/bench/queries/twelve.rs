//! The twelve queries, written down once in `twelve.sql`. Both engines get the same text, but for views that only
//! echolake has.

/// One query of the benchmark.
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
