//! Statements on a small lake: every statement of `statements.txt` answers as its plain form, or is refused with a
//! hint. The manual's page is made of them.

use std::fmt::Write as _;

use arrow::util::pretty::pretty_format_batches;

use crate::Error;
use crate::session::function_tests::SmallLake;

const STATEMENTS: &str = include_str!("statements.txt");
/// Path of the page; tests run in their package's folder.
const PAGE: &str = "../docs/friendly_sql.md";
/// Set to write the page.
const RENEW: &str = "ECHOLAKE_RENEW";
/// Minimum number of statements.
const LEAST: usize = 66;

const HEAD: &str = "# Friendly SQL

What `echolake sql`, HTTP and Flight SQL take beside plain SQL, most of it as DuckDB writes it. A statement answers as
the plain one beside it, or is refused with the hint beside it; none answers something else. Postgres' protocol reads
statements as Postgres does, and only what Postgres' grammar does not know as here.

This page is generated from the statements that a test tries;
`ECHOLAKE_RENEW=1 cargo test --profile quick --workspace friendly` writes it.
";

/// A statement of the list.
struct FriendlyStatement {
    chapter: &'static str,
    sql: &'static str,
    expected: Expected,
}

enum Expected {
    /// The same answer as this statement's.
    Plain(&'static str),
    /// A refusal whose hint has this part.
    Hint(&'static str),
}

fn statements() -> Vec<FriendlyStatement> {
    let mut statements = Vec::new();
    let (mut chapter, mut sql) = ("", "");
    for line in STATEMENTS.lines().filter(|line| !line.is_empty()) {
        if let Some(title) = line.strip_prefix("## ") {
            chapter = title;
        } else if let Some(plain) = line.strip_prefix("= ") {
            statements.push(FriendlyStatement { chapter, sql, expected: Expected::Plain(plain) });
        } else if let Some(hint) = line.strip_prefix("! ") {
            statements.push(FriendlyStatement { chapter, sql, expected: Expected::Hint(hint) });
        } else if !line.starts_with("# ") {
            sql = line;
        }
    }
    statements
}

// The answer as text; its rows are sorted by the statement, or here.
async fn answer(lake: &SmallLake, sql: &str, is_sorted: bool) -> Result<Vec<String>, Error> {
    let table = pretty_format_batches(&lake.batches(sql).await?).expect("a table").to_string();
    let mut lines: Vec<_> = table.lines().filter(|line| line.starts_with('|')).map(str::to_owned).collect();
    if !is_sorted {
        lines[1..].sort();
    }
    Ok(lines)
}

async fn page(lake: &SmallLake) -> String {
    let mut page = HEAD.to_owned();
    let mut chapter = "";
    for statement in statements() {
        if statement.chapter != chapter {
            chapter = statement.chapter;
            let _ =
                write!(page, "\n## {chapter}\n\n| statement | the same in plain SQL, or the hint |\n| --- | --- |\n");
        }
        let code = |sql: &str| format!("`{}`", sql.replace('|', "\\|"));
        let beside = match statement.expected {
            Expected::Plain(plain) => code(plain),
            Expected::Hint(_) => {
                let error = lake.batches(statement.sql).await.map(drop).expect_err(statement.sql).to_string();
                let (_, hint) = error.split_once("hint: ").expect("a hint");
                format!("refused: {}", hint.replace('|', "\\|"))
            }
        };
        let _ = writeln!(page, "| {} | {beside} |", code(statement.sql));
    }
    page
}

#[tokio::test]
async fn friendly_page_is_fresh() {
    assert!(statements().len() >= LEAST, "{} statements", statements().len());
    let page = page(&SmallLake::new().await).await;
    if std::env::var_os(RENEW).is_some() {
        std::fs::write(PAGE, &page).expect("the page is written");
    }
    let command = format!("{RENEW}=1 cargo test --profile quick --workspace friendly");
    let written = std::fs::read_to_string(PAGE).unwrap_or_default();
    assert!(written == page, "docs/friendly_sql.md is stale; `{command}` renews it");
}

mod slow {
    use super::*;

    // Short statements that would become long ones, or would be planned again and again.
    #[tokio::test]
    async fn rewriting_is_bounded() {
        let lake = SmallLake::new().await;
        let literal = "x".repeat(50_000);
        let lookups = "select columns('.*') from points union all ".repeat(150);
        let nested = format!("select {}1{}", "arg_max(1, ".repeat(60), ")".repeat(60));
        let multiplied = "select columns('.*') || (".repeat(30);
        for sql in [
            format!("select concat(columns('.*'), '{literal}') as \"\\0\" from measurements"),
            format!("select columns('{}') from points", "(a{1,100}){1,100}".repeat(20)),
            format!("select * from points{}", " pivot (count(*) for layer in (0))".repeat(21)),
            format!("{lookups} select * from points"),
            format!("select concat({} 1) from points", "columns('.*'), ".repeat(20_000)),
            format!("{multiplied} select 1 {}", ") from points".repeat(30)),
            nested,
        ] {
            let started = std::time::Instant::now();
            let error = lake.batches(&sql).await.map(drop).expect_err(&sql[..60]).to_string();
            assert!(error.contains("hint: "), "{}: {error}", &sql[..60]);
            assert!(started.elapsed().as_secs() < 60, "{}: {:?}", &sql[..60], started.elapsed());
        }
    }

    #[tokio::test]
    async fn friendly_statements_answer_as_plain_ones_or_are_refused() {
        let lake = SmallLake::new().await;
        let mut wrong = String::new();
        for statement in statements() {
            let sql = statement.sql;
            let is_sorted = sql.contains("order by all") || sql.contains(" limit ");
            let given = answer(&lake, sql, is_sorted).await;
            let complaint = match (statement.expected, given) {
                (Expected::Plain(plain), Ok(given)) => match answer(&lake, plain, is_sorted).await {
                    Ok(expected) if expected == given && given.len() > 1 => continue,
                    Ok(expected) => format!("{given:.3?}\nexpected {expected:.3?}"),
                    Err(error) => format!("the plain form fails: {error}"),
                },
                (Expected::Plain(_), Err(error)) => error.to_string(),
                (Expected::Hint(hint), Err(error)) => {
                    let text = error.to_string();
                    match text.split_once("hint: ") {
                        Some((_, given)) if given.contains(hint) => continue,
                        _ => format!("the hint lacks `{hint}`: {text}"),
                    }
                }
                (Expected::Hint(_), Ok(given)) => format!("answered {given:.3?}"),
            };
            let _ = writeln!(wrong, "== {sql}\n{complaint}");
        }
        assert!(wrong.is_empty(), "{wrong}");
    }
}
