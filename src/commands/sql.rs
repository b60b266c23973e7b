//! `echolake sql`: one query, or a prompt.

mod prompt;

use std::fs::{File, OpenOptions};
use std::io::{BufWriter, IsTerminal as _, Read as _, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::ValueEnum;
use echolake_query::output::{AnswerFormat, AnswerWriter, TABLE_ROWS};
use echolake_query::{QueryAnswer, Session};
use serde::de::DeserializeOwned;

use super::cache::CacheArgs;

#[derive(Debug, clap::Args)]
pub(crate) struct SqlArgs {
    /// The query, or `-` for standard input; by default a prompt, or standard input if that is no terminal. `\d` lists
    /// tables, `\d TABLE` columns with units, `\df` functions.
    query: Option<String>,
    /// Format of the answer.
    #[arg(long, value_enum, default_value_t = FormatArg::Table)]
    format: FormatArg,
    /// The same as --format json.
    #[arg(long, conflicts_with = "format")]
    json: bool,
    /// Put `'` before texts that a spreadsheet would take for formulas: those that begin with =, +, -, @, a tab or a
    /// carriage return; with --format csv.
    #[arg(long, requires = "format")]
    escape_formulas: bool,
    /// File for the answer.
    #[arg(short, long)]
    output: Option<PathBuf>,
    #[command(flatten)]
    cache: CacheArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum FormatArg {
    Table,
    Csv,
    Json,
    Parquet,
    Arrow,
}

impl From<FormatArg> for AnswerFormat {
    fn from(arg: FormatArg) -> Self {
        match arg {
            FormatArg::Table => Self::Table,
            FormatArg::Csv => Self::Csv,
            FormatArg::Json => Self::Json,
            FormatArg::Parquet => Self::Parquet,
            FormatArg::Arrow => Self::Arrow,
        }
    }
}

pub(crate) async fn run_sql(args: &SqlArgs, lake_url: &str) -> anyhow::Result<()> {
    let lake = args.cache.open_lake(lake_url).await?;
    let session = Session::new(&lake)?;
    let query = match args.query.as_deref() {
        Some("-") => from_stdin()?,
        Some(query) => query.to_owned(),
        None if std::io::stdin().is_terminal() => return prompt::run_prompt(&session, &lake).await,
        None => from_stdin()?,
    };
    if let Some(text) = prompt::command_answer(&session, &query) {
        let is_plain = args.output.is_none() && !args.json && args.format == FormatArg::Table;
        anyhow::ensure!(is_plain, "`{query}` answers as text; hint: leave --format, --json and -o out");
        return Ok(super::print_line(&text?)?);
    }
    let format = match (args.json, args.format, args.escape_formulas) {
        (true, ..) => AnswerFormat::Json,
        (false, FormatArg::Csv, true) => AnswerFormat::SpreadsheetCsv,
        (false, _, true) => anyhow::bail!("--escape-formulas is for CSV; hint: --format csv"),
        (false, format, false) => format.into(),
    };
    let answer = session.query(&query).await?;
    match &args.output {
        Some(path) => to_file(answer, format, path).await.map(drop),
        None => {
            anyhow::ensure!(
                !(format.is_binary() && std::io::stdout().is_terminal()),
                "{} is not for a terminal; hint: -o FILE",
                format.name()
            );
            write_answer(answer, format, BufWriter::new(std::io::stdout())).await.map(drop)
        }
    }
}

fn from_stdin() -> anyhow::Result<String> {
    let mut text = String::new();
    std::io::stdin().read_to_string(&mut text).context("cannot read the query from standard input")?;
    Ok(text)
}

/// Prints an answer for people.
pub(super) async fn print_table(session: &Session, sql: &str) -> anyhow::Result<()> {
    write_answer(session.query(sql).await?, AnswerFormat::Table, std::io::stdout()).await.map(drop)
}

/// Returns the rows of a query.
pub(super) async fn query_rows<T: DeserializeOwned>(session: &Session, sql: &str) -> anyhow::Result<Vec<T>> {
    let mut answer = session.query(sql).await?;
    let mut rows = Vec::new();
    while let Some(batch) = answer.next().await? {
        let part: Vec<T> = serde_arrow::from_record_batch(&batch).context("rows are not as expected")?;
        rows.extend(part);
    }
    Ok(rows)
}

async fn write_answer(mut answer: QueryAnswer, format: AnswerFormat, to: impl Write + Send) -> anyhow::Result<usize> {
    let mut writer = AnswerWriter::new(format, &answer.schema, to)?;
    while let Some(batch) = answer.next().await? {
        writer.write(&batch)?;
    }
    let rows = writer.finish()?;
    if format == AnswerFormat::Table && rows > TABLE_ROWS {
        eprintln!("the first {TABLE_ROWS} of {rows} rows; hint: --format csv prints all");
    }
    Ok(rows)
}

// Written beside its path first, so that a file is whole or not there. A device or a pipe is written directly.
async fn to_file(answer: QueryAnswer, format: AnswerFormat, path: &Path) -> anyhow::Result<usize> {
    let failed = || format!("cannot write `{}`", path.display());
    if path.metadata().is_ok_and(|m| !m.is_file()) {
        let special = OpenOptions::new().write(true).open(path).with_context(failed)?;
        return write_answer(answer, format, BufWriter::new(special)).await;
    }
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let partial = PathBuf::from(partial);
    let file = File::create(&partial).with_context(failed)?;
    let written = write_answer(answer, format, BufWriter::new(file)).await;
    let named = written.and_then(|rows| {
        std::fs::rename(&partial, path).with_context(failed)?;
        eprintln!("{}: {rows} rows", path.display());
        Ok(rows)
    });
    if named.is_err() {
        // The first error is the one to report.
        let _ = std::fs::remove_file(&partial);
    }
    named
}
