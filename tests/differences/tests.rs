//! The short form: what is written down, some generated statements, and the page of what differs by design.

use std::path::{Path, PathBuf};

use crate::web::or_skip;

use super::*;

/// Generated statements of the short form.
const STATEMENTS: u64 = 250;
const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/duckdb.md");
const RENEW: &str = "ECHOLAKE_RENEW";
const PAGE_HEAD: &str = "# Beside DuckDB

DuckDB reads the lake's files, and knows most of the same SQL. These statements it answers otherwise, by design. What
`stress sql-differences` finds beyond them is a defect: [Tests](testing.md#stress).

This page is generated from the answers of both; `ECHOLAKE_RENEW=1 cargo test --profile quick --workspace differences`
writes it.

| | statement | echolake | DuckDB | reason |
| --- | --- | --- | --- | --- |
";

fn python() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("duckdb");
    or_skip("SQL beside DuckDB", install_duckdb(&folder).map_err(|why| format!("{why:#}")))
}

// W1 to W7, R1 to R7, E18 and what stands near them.
#[test]
fn answers_are_as_they_are_written_down() {
    let mut campaign = DifferenceCampaign::new(None).expect("a lake");
    report_wrong(&check_written(&mut campaign));
}

mod slow {
    use super::*;

    // The long form is `stress sql-differences`.
    #[test]
    fn there_are_no_differences_to_duckdb_but_the_documented() {
        let Some(python) = python() else { return };
        let mut campaign = DifferenceCampaign::new(Some(python)).expect("a lake and DuckDB");
        let mut wrong = check_written(&mut campaign);
        wrong.extend(check_generated(&mut campaign));
        wrong.extend(check_page(&mut campaign));
        report_wrong(&wrong);
    }
}

fn report_wrong(wrong: &[String]) {
    assert!(wrong.is_empty(), "{} are wrong:\n\n{}", wrong.len(), wrong.join("\n\n"));
}

fn check_written(campaign: &mut DifferenceCampaign) -> Vec<String> {
    let statements = hand_written_statements().expect("statements");
    statements
        .iter()
        .filter_map(|statement| {
            let title = statement.title;
            let sql = statement.sql;
            let show = |answer: Result<AnswerRows, String>| answer.map(|rows| rows.show_rows(statement.order));
            let own = show(campaign.own_answer(sql).unwrap_or_else(|e| panic!("{sql}: {e:#}")));
            let is_plain = own.as_ref().err().is_none_or(|message| find_debug_text(message).is_none());
            if !is_plain || !statement.expected.allows(&own) {
                return Some(format!("{title}: {sql}\nexpected {:?}\nactual   {own:?}", statement.expected));
            }
            let peer = campaign.peer_answer(sql).unwrap_or_else(|e| panic!("{sql}: {e:#}"));
            let peer = peer.map(show).filter(|_| !sql.contains("information_schema"));
            let peer_is_right = peer.as_ref().is_none_or(|answer| statement.expected.allows_peer(answer));
            (!peer_is_right).then(|| format!("{title}: {sql}\nexpected {:?}\nDuckDB   {peer:?}", statement.expected))
        })
        .collect()
}

fn check_generated(campaign: &mut DifferenceCampaign) -> Vec<String> {
    let mut counts = DifferenceCounts::default();
    let mut generator = campaign.create_generator(1).expect("a generator");
    for number in 0..STATEMENTS {
        let statement = generator.generate_statement(number);
        let counted = campaign.count_statement(number, &statement, 0, &mut counts);
        counted.unwrap_or_else(|e| panic!("{}: {e:#}", statement.sql));
    }
    let is_same = |(_, name): &(&str, &str)| name.starts_with("same");
    let same: usize = counts.outcomes.iter().filter(|(key, _)| is_same(key)).map(|(_, count)| count).sum();
    assert!(same as u64 > STATEMENTS / 2, "most statements compare: {:?}", counts.outcomes);
    counts.wrong().map(|finding| format!("{finding:?}")).collect()
}

fn check_page(campaign: &mut DifferenceCampaign) -> Option<String> {
    let mut plain = campaign.start_plain_peer().expect("it starts").expect("DuckDB");
    let mut page = PAGE_HEAD.to_owned();
    for DocumentedDifference { name, sql, reason, .. } in &DOCUMENTED {
        let show = |answer: Result<AnswerRows, String>| match answer {
            Ok(rows) => format!("`{}`", rows.show_rows(RowOrder::Total).join(" ")),
            Err(_) => "an error".to_owned(),
        };
        let own = show(campaign.own_answer(sql).expect("an answer"));
        let peer = plain.ask_rows(sql).expect("an answer").map(|rows| AnswerRows::read(&rows).expect("rows"));
        let peer = show(peer);
        assert_ne!(own, peer, "{sql}");
        page += &format!("| {name} | `{}` | {own} | {peer} | {reason} |\n", sql.replace('|', "\\|"));
    }
    if std::env::var_os(RENEW).is_some() {
        std::fs::write(PAGE, &page).expect("written");
    }
    (std::fs::read_to_string(PAGE).ok().as_ref() != Some(&page))
        .then(|| format!("docs/duckdb.md is stale; hint: {RENEW}=1"))
}

impl ExpectedAnswer {
    fn allows(&self, answer: &Result<Vec<String>, String>) -> bool {
        match (self, answer) {
            (Self::Rows(rows), Ok(answer)) => answer == rows,
            (Self::Refusal(text), Err(message)) => message.contains(text),
            (Self::Rows(_), Err(_)) | (Self::Refusal(_), Ok(_)) => false,
        }
    }

    // DuckDB refuses in words of its own, or answers what is refused here.
    fn allows_peer(&self, answer: &Result<Vec<String>, String>) -> bool {
        matches!(self, Self::Refusal(_)) || self.allows(answer)
    }
}
