//! `echolake sql`: queries, a script of them, or a prompt.

mod prompt;
mod script;

use std::fs::{File, OpenOptions};
use std::io::{BufWriter, IsTerminal as _, Read as _, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use clap::ValueEnum;
use echolake_acquisition::disk::read_text_file;
use echolake_query::output::{AnswerFormat, AnswerWriter, TABLE_ROWS};
use echolake_query::{Error, QueryAnswer, Session};
use serde::de::DeserializeOwned;

use super::cache::CacheArgs;
use crate::terminal_text::text_output;
use prompt::PromptSettings;
use prompt::command::PromptCommand;
use script::{ScriptStep, read_script};

#[derive(Debug, clap::Args)]
pub(crate) struct SqlArgs {
    /// The query, several with `;` between them, or `-` for standard input; by default a prompt, or standard input if
    /// that is no terminal. The first error ends a script. `\d` lists tables, `\d TABLE` columns with units, `\df`
    /// functions; a command has a line of its own.
    query: Option<String>,
    /// Script of queries and commands.
    #[arg(short, long, conflicts_with = "query")]
    file: Option<PathBuf>,
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
    let script = match (args.query.as_deref(), &args.file) {
        (_, Some(file)) => read_text_file(file).with_context(|| format!("cannot read `{}`", file.display()))?,
        (Some("-"), None) => from_stdin()?,
        (Some(query), None) => query.to_owned(),
        (None, None) if std::io::stdin().is_terminal() => return prompt::run_prompt(&session, &lake).await,
        (None, None) => from_stdin()?,
    };
    let format = match (args.json, args.format, args.escape_formulas) {
        (true, ..) => AnswerFormat::Json,
        (false, FormatArg::Csv, true) => AnswerFormat::SpreadsheetCsv,
        (false, _, true) => anyhow::bail!("--escape-formulas is for CSV; hint: --format csv"),
        (false, format, false) => format.into(),
    };
    let settings = PromptSettings { format, output: args.output.clone(), timing: false, pager: false };
    run_script(&session, read_script(&script), settings).await
}

async fn run_script(session: &Session, steps: Vec<ScriptStep>, mut settings: PromptSettings) -> anyhow::Result<()> {
    let is_one = matches!(steps.as_slice(), [ScriptStep::Statement { .. }]);
    let statements = steps.iter().filter(|step| matches!(step, ScriptStep::Statement { .. })).count();
    anyhow::ensure!(!steps.is_empty(), "no statement; hint: select * from surfaces");
    anyhow::ensure!(
        statements < 2 || settings.output.is_none() && !settings.format.is_binary(),
        "one answer fits into a file of {}, and the script has {statements}; hint: \\f FORMAT and \\o FILE in lines of \
         their own before each statement",
        settings.format.name()
    );
    let is_plain = settings.output.is_none() && settings.format == AnswerFormat::Table;
    let mut number = 0;
    for step in steps {
        match step {
            ScriptStep::Command(Ok(PromptCommand::Quit)) => break,
            ScriptStep::Command(command) => {
                let command = command.map_err(anyhow::Error::msg)?;
                anyhow::ensure!(
                    is_plain || !command.prints_text(),
                    "\\d and \\df answer as text; hint: leave --format, --json and -o out"
                );
                prompt::obey_command(command, session, &mut settings)?;
            }
            ScriptStep::Statement { sql, lines_before } => {
                number += 1;
                let answered = answer_statement(session, &sql, lines_before, &mut settings).await;
                let place = || format!("statement {number} of {statements}");
                if is_one { answered? } else { answered.with_context(place)? }
            }
        }
    }
    Ok(())
}

// Places of errors count the lines of the whole script.
async fn start_query(session: &Session, sql: &str, lines_before: u64) -> anyhow::Result<QueryAnswer> {
    let mut answered = session.query(sql).await;
    if let Err(Error::Query { place: Some(place), .. }) = &mut answered {
        place.line += lines_before;
    }
    Ok(answered?)
}

async fn answer_statement(
    session: &Session,
    sql: &str,
    lines_before: u64,
    settings: &mut PromptSettings,
) -> anyhow::Result<()> {
    let begun = Instant::now();
    let rows = match settings.output.take() {
        Some(path) => to_file(start_query(session, sql, lines_before).await?, settings.format, &path).await?,
        None => {
            anyhow::ensure!(
                !(settings.format.is_binary() && std::io::stdout().is_terminal()),
                "{} is not for a terminal; hint: -o FILE",
                settings.format.name()
            );
            let answer = start_query(session, sql, lines_before).await?;
            write_answer(answer, settings.format, BufWriter::new(text_output())).await?
        }
    };
    if settings.timing {
        eprintln!("{rows} rows, {:.3} s", begun.elapsed().as_secs_f64());
    }
    Ok(())
}

fn from_stdin() -> anyhow::Result<String> {
    let mut text = String::new();
    std::io::stdin().read_to_string(&mut text).context("cannot read the query from standard input")?;
    Ok(text)
}

/// Prints an answer for people.
pub(super) async fn print_table(session: &Session, sql: &str) -> anyhow::Result<()> {
    write_answer(session.query(sql).await?, AnswerFormat::Table, text_output()).await.map(drop)
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
