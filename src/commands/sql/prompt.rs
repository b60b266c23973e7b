//! The prompt: lines become queries at `;`, with history, completion, commands, timing and a pager.

pub(super) mod command;
mod pager;
mod words;

use std::io::Write as _;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use echolake_lake::Lake;
use echolake_query::Session;
use echolake_query::output::AnswerFormat;
use echolake_schema::tables::{COMMENT, UNIT};
use rustyline::config::Configurer as _;
use rustyline::error::ReadlineError;
use rustyline::history::DefaultHistory;
use rustyline::{CompletionType, Editor};

use super::script::{ScriptReader, ScriptStep};
use crate::error_text::describe_error;
use crate::signals::interrupt_signal;
use command::{HELP, PromptCommand};
use words::WordCompleter;

/// Lines of history that are kept.
const HISTORY: usize = 10_000;

/// The form of answers.
pub(super) struct PromptSettings {
    pub format: AnswerFormat,
    /// File for the next answer alone, instead of the terminal.
    pub output: Option<PathBuf>,
    pub timing: bool,
    pub pager: bool,
}

pub(super) async fn run_prompt(session: &Session, lake: &Lake) -> anyhow::Result<()> {
    let mut editor: Editor<WordCompleter, DefaultHistory> = Editor::new()?;
    editor.set_helper(Some(WordCompleter::from_session(session)));
    editor.set_completion_type(CompletionType::List);
    editor.set_max_history_size(HISTORY)?;
    editor.set_history_ignore_dups(true)?;
    let history = history_file();
    if let Some(file) = &history {
        // A first session has none.
        let _ = editor.load_history(file);
    }
    // Held from before the greeting on, so that Ctrl-C never ends the prompt.
    let _interrupts = interrupt_signal()?;
    eprintln!("lake {}; \\? for help", lake.location());
    let mut settings = PromptSettings { format: AnswerFormat::Table, output: None, timing: false, pager: true };
    let mut script = ScriptReader::default();
    loop {
        let line = match editor.readline(if script.is_blank() { "echolake> " } else { "      ..> " }) {
            Ok(line) => line,
            Err(ReadlineError::Interrupted) => {
                script.clear();
                continue;
            }
            Err(ReadlineError::Eof) => break,
            Err(e) => return Err(e.into()),
        };
        for step in script.push_line(&line) {
            match step {
                ScriptStep::Command(Ok(PromptCommand::Quit)) => return Ok(()),
                ScriptStep::Command(command) => {
                    editor.add_history_entry(line.trim_end())?;
                    let obeyed = command.map_err(anyhow::Error::msg);
                    if let Err(e) = obeyed.and_then(|command| obey_command(command, session, &mut settings)) {
                        eprintln!("error: {}", describe_error(&e));
                    }
                }
                ScriptStep::Statement { sql, .. } => {
                    editor.add_history_entry(format!("{};", sql.trim()))?;
                    answer_query(session, &sql, &mut settings).await;
                }
            }
        }
        // Kept at once: a closed terminal must not cost the history of a day.
        if let Some(file) = &history
            && let Err(e) = editor.append_history(file)
        {
            eprintln!("warning: the history is not kept: {e}");
        }
    }
    Ok(())
}

/// Changes the settings, or prints what a command asks for.
pub(super) fn obey_command(
    command: PromptCommand,
    session: &Session,
    settings: &mut PromptSettings,
) -> anyhow::Result<()> {
    match command {
        PromptCommand::Quit => {}
        PromptCommand::Help => eprintln!("{HELP}"),
        PromptCommand::Timing => {
            settings.timing = !settings.timing;
            eprintln!("timing is {}", on_or_off(settings.timing));
        }
        PromptCommand::Pager => {
            settings.pager = !settings.pager;
            eprintln!("the pager is {}", on_or_off(settings.pager));
        }
        PromptCommand::Format(format) => {
            settings.format = format;
            eprintln!("answers are {}", format.name());
        }
        PromptCommand::Output(path) => settings.output = path,
        PromptCommand::Tables => pager::show_text(settings.pager, &list_tables(session))?,
        PromptCommand::Columns(table) => pager::show_text(settings.pager, &list_columns(session, &table)?)?,
        PromptCommand::Functions(part) => {
            pager::show_text(settings.pager, &list_functions(session, part.as_deref())?)?;
        }
    }
    Ok(())
}

fn on_or_off(is_on: bool) -> &'static str {
    if is_on { "on" } else { "off" }
}

// An error or an interrupt ends the query, not the prompt.
async fn answer_query(session: &Session, sql: &str, settings: &mut PromptSettings) {
    let begun = Instant::now();
    let outcome = interrupted_or_given(session, sql, settings).await;
    settings.output = None;
    match outcome {
        Ok(rows) if settings.timing => eprintln!("{rows} rows, {:.3} s", begun.elapsed().as_secs_f64()),
        Ok(rows) => eprintln!("{rows} rows"),
        Err(e) => eprintln!("error: {}", describe_error(&e)),
    }
}

// A fresh listener hears no interrupt from before the query.
async fn interrupted_or_given(session: &Session, sql: &str, settings: &PromptSettings) -> anyhow::Result<usize> {
    let mut interrupts = interrupt_signal()?;
    tokio::select! {
        outcome = give_answer(session, sql, settings) => outcome,
        _ = interrupts.recv() => Err(anyhow::anyhow!("stopped")),
    }
}

async fn give_answer(session: &Session, sql: &str, settings: &PromptSettings) -> anyhow::Result<usize> {
    let answer = session.query(sql).await?;
    if let Some(path) = &settings.output {
        return super::to_file(answer, settings.format, path).await;
    }
    anyhow::ensure!(
        !settings.format.is_binary(),
        "{} is not for a terminal; hint: \\o FILE before the query",
        settings.format.name()
    );
    let mut page = pager::PageOutput::open(settings.pager);
    let rows = super::write_answer(answer, settings.format, &mut page).await?;
    page.flush().context("cannot write the answer")?;
    Ok(rows)
}

fn list_tables(session: &Session) -> String {
    session
        .all_tables()
        .into_iter()
        .map(|(name, schema)| format!("{name:<15} {} columns", schema.fields().len()))
        .collect::<Vec<_>>()
        .join("\n")
}

fn list_columns(session: &Session, table: &str) -> anyhow::Result<String> {
    let found = session.all_tables().into_iter().find(|(name, _)| *name == table);
    let (_, schema) = found.with_context(|| format!("no table `{table}`; hint: \\d lists them"))?;
    let line = |field: &arrow::datatypes::Field| {
        let of = |key| field.metadata().get(key).map_or("", String::as_str);
        let kind = match field.data_type() {
            arrow::datatypes::DataType::List(child) => format!("[{}]", child.data_type()),
            other => other.to_string(),
        };
        format!("{:<24} {kind:<28} {:<21} {}", field.name(), of(UNIT), of(COMMENT))
    };
    Ok(schema.fields().iter().map(|f| line(f)).collect::<Vec<_>>().join("\n"))
}

fn list_functions(session: &Session, part: Option<&str>) -> anyhow::Result<String> {
    let fits = |name: &str| part.is_none_or(|part| name.contains(part));
    let mut found: Vec<_> = session.sql_functions().into_iter().filter(|f| fits(&f.name)).collect();
    if let Some(whole) = found.iter().position(|f| part == Some(f.name.as_str())) {
        found = vec![found.swap_remove(whole)];
    }
    Ok(match found.as_slice() {
        [] => {
            anyhow::bail!("no function with `{}` in its name; hint: \\df lists all", part.unwrap_or_default())
        }
        [one] => format!("{}\n{}", one.syntax, one.description),
        many => many.iter().map(|f| format!("{:<24} {}", f.name, f.syntax)).collect::<Vec<_>>().join("\n"),
    })
}

fn history_file() -> Option<PathBuf> {
    let state = std::env::var_os("XDG_STATE_HOME").map(PathBuf::from);
    let folder =
        state.or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".local/state")))?.join("echolake");
    std::fs::create_dir_all(&folder).ok()?;
    Some(folder.join("history"))
}
