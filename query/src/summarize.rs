//! `SUMMARIZE table` and `SUMMARIZE SELECT ...`: one row a column with its range, mean, quantiles and nulls.

use std::fmt::Write as _;

use arrow::datatypes::{DataType, Schema};

/// First words of what is a query and no table's name.
const QUERY_WORDS: [&str; 4] = ["SELECT", "WITH", "FROM", "VALUES"];

/// Returns what a statement summarises, as an item of `FROM`; None for all other statements.
pub(crate) fn source(sql: &str) -> Option<String> {
    let (word, rest) = sql.trim_start().split_once(char::is_whitespace)?;
    let rest = rest.trim().trim_end_matches(';');
    let first = rest.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
    let is_query = QUERY_WORDS.iter().any(|word| first.eq_ignore_ascii_case(word));
    word.eq_ignore_ascii_case("SUMMARIZE").then(|| if is_query { format!("({rest}\n)") } else { rest.to_owned() })
}

/// Returns the query that summarises a source of these columns in one scan.
pub(crate) fn query(source: &str, schema: &Schema) -> String {
    let mut columns: [Vec<String>; 11] = Default::default();
    for field in schema.fields() {
        let name = format!("\"{}\"", field.name().replace('"', "\"\""));
        let text = |text: &str| format!("'{}'", text.replace('\'', "''"));
        let is_nested = field.data_type().is_nested();
        let is_numeric = field.data_type().is_numeric();
        let when = |is_known: bool, expression: String| if is_known { expression } else { "null".to_owned() };
        let number = |call: String| when(is_numeric, format!("cast({call} as double)"));
        let quantile = |q: f64| number(format!("approx_percentile_cont({q}) within group (order by {name})"));
        let values = [
            text(field.name()),
            text(&type_name(field.data_type())),
            when(!is_nested, format!("cast(min({name}) as varchar)")),
            when(!is_nested, format!("cast(max({name}) as varchar)")),
            when(!is_nested, format!("approx_distinct(cast({name} as varchar))")),
            number(format!("avg({name})")),
            number(format!("stddev({name})")),
            quantile(0.25),
            quantile(0.5),
            quantile(0.75),
            format!("count(*) - count({name})"),
        ];
        columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
    }
    const NAMES: [(&str, &str); 11] = [
        ("column_name", "varchar[]"),
        ("column_type", "varchar[]"),
        ("min", "varchar[]"),
        ("max", "varchar[]"),
        ("approx_unique", "bigint[]"),
        ("avg", "double[]"),
        ("std", "double[]"),
        ("q25", "double[]"),
        ("q50", "double[]"),
        ("q75", "double[]"),
        ("nulls", "bigint[]"),
    ];
    let (mut outer, mut inner) = (String::new(), String::new());
    for ((name, list), values) in NAMES.into_iter().zip(columns) {
        let _ = write!(outer, "unnest(\"{name}\") as \"{name}\", ");
        let _ = write!(inner, "cast([{}] as {list}) as \"{name}\", ", values.join(", "));
    }
    format!("select {outer}count from (select {inner}count(*) as count from {source}) as summary")
}

fn type_name(data_type: &DataType) -> String {
    data_type.to_string().to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_summaries_have_a_source() {
        assert_eq!(source("summarize tnce;").as_deref(), Some("tnce"));
        assert_eq!(source(" SUMMARIZE select 1").as_deref(), Some("(select 1\n)"));
        assert_eq!(source("select summarize from t"), None);
        assert_eq!(source("summarize"), None);
    }
}
