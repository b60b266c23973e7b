//! The prompt: lines become queries at `;`, with history, completion, `\d` and timing.

use std::path::PathBuf;
use std::time::Instant;

use echolake_lake::Lake;
use echolake_query::Session;
use echolake_query::output::Format;
use echolake_schema::tables::{COMMENT, UNIT};
use rustyline::completion::{Completer, Pair};
use rustyline::error::ReadlineError;
use rustyline::history::DefaultHistory;
use rustyline::{Context, Editor, Helper, Highlighter, Hinter, Validator};

const HELP: &str = "\
a query ends with ;
\\d          the tables          \\d TABLE   its columns, with units
\\timing     how long it took    \\q         leave
Tab completes, Ctrl-C stops a query or clears the line, Ctrl-D leaves";

/// Words that are completed besides the names of tables and columns.
const KEYWORDS: [&str; 20] = [
    "select", "from", "where", "group by", "order by", "limit", "join", "on", "and", "or", "not", "as", "count", "avg",
    "min", "max", "sum", "distinct", "explain", "desc",
];

/// Completes table names, columns and keywords.
#[derive(Helper, Highlighter, Hinter, Validator)]
struct Words(Vec<String>);

impl Completer for Words {
    type Candidate = Pair;

    fn complete(&self, line: &str, pos: usize, _: &Context<'_>) -> rustyline::Result<(usize, Vec<Pair>)> {
        let is_word = |c: char| c.is_alphanumeric() || c == '_';
        let start =
            line[..pos].rfind(|c| !is_word(c)).map_or(0, |i| i + line[i..].chars().next().map_or(1, char::len_utf8));
        let begun = &line[start..pos];
        let fits = self.0.iter().filter(|w| !begun.is_empty() && w.starts_with(begun));
        Ok((start, fits.map(|w| Pair { display: w.clone(), replacement: w.clone() }).collect()))
    }
}

/// What a line asks for.
enum Line {
    Quit,
    Help,
    Timing,
    Tables,
    Columns(String),
    Sql,
}

pub(super) async fn run(session: &Session, lake: &Lake) -> anyhow::Result<()> {
    let mut editor: Editor<Words, DefaultHistory> = Editor::new()?;
    editor.set_helper(Some(Words(words(session))));
    let history = history_file();
    if let Some(file) = &history {
        // A first session has none.
        let _ = editor.load_history(file);
    }
    eprintln!("lake {}; \\? for help", lake.location());
    let (mut begun, mut timing) = (String::new(), false);
    loop {
        let line = match editor.readline(if begun.is_empty() { "echolake> " } else { "      ..> " }) {
            Ok(line) => line,
            Err(ReadlineError::Interrupted) => {
                begun.clear();
                continue;
            }
            Err(ReadlineError::Eof) => break,
            Err(e) => return Err(e.into()),
        };
        match if begun.is_empty() { parse(&line) } else { Line::Sql } {
            Line::Quit => break,
            Line::Help => eprintln!("{HELP}"),
            Line::Timing => {
                timing = !timing;
                eprintln!("timing is {}", if timing { "on" } else { "off" });
            }
            Line::Tables => super::super::print(&tables(session))?,
            Line::Columns(table) => super::super::print(&columns(session, &table))?,
            Line::Sql => {
                begun.push_str(&line);
                begun.push('\n');
                if !line.trim_end().ends_with(';') {
                    continue;
                }
                let sql = std::mem::take(&mut begun);
                editor.add_history_entry(sql.trim_end())?;
                answer(session, sql.trim_end().trim_end_matches(';'), timing).await;
            }
        }
    }
    if let Some(file) = &history
        && let Err(e) = editor.save_history(file)
    {
        eprintln!("warning: the history is not kept: {e}");
    }
    Ok(())
}

fn parse(line: &str) -> Line {
    let mut words = line.split_whitespace();
    match (words.next(), words.next()) {
        (Some("\\q" | "exit" | "quit"), None) => Line::Quit,
        (Some("\\?"), _) => Line::Help,
        (Some("\\timing"), _) => Line::Timing,
        (Some("\\d"), None) => Line::Tables,
        (Some("\\d"), Some(table)) => Line::Columns(table.trim_end_matches(';').to_owned()),
        _ => Line::Sql,
    }
}

// An error or an interrupt ends the query, not the prompt.
async fn answer(session: &Session, sql: &str, timing: bool) {
    let begun = Instant::now();
    let work = async {
        let answer = session.query(sql).await?;
        super::write(answer, Format::Table, std::io::stdout()).await
    };
    let outcome = tokio::select! {
        outcome = work => outcome,
        _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("stopped")),
    };
    match outcome {
        Ok(rows) if timing => eprintln!("{rows} rows, {:.3} s", begun.elapsed().as_secs_f64()),
        Ok(rows) => eprintln!("{rows} rows"),
        Err(e) => eprintln!("error: {e:#}"),
    }
}

fn tables(session: &Session) -> String {
    session
        .tables()
        .map(|(name, schema)| format!("{name:<14} {} columns", schema.fields().len()))
        .collect::<Vec<_>>()
        .join("\n")
}

fn columns(session: &Session, table: &str) -> String {
    let Some((_, schema)) = session.tables().find(|(name, _)| *name == table) else {
        return format!("no table `{table}`; \\d lists them");
    };
    let line = |field: &arrow::datatypes::Field| {
        let of = |key| field.metadata().get(key).map_or("", String::as_str);
        let kind = match field.data_type() {
            arrow::datatypes::DataType::List(child) => format!("[{}]", child.data_type()),
            other => other.to_string(),
        };
        format!("{:<24} {kind:<28} {:<12} {}", field.name(), of(UNIT), of(COMMENT))
    };
    schema.fields().iter().map(|f| line(f)).collect::<Vec<_>>().join("\n")
}

fn words(session: &Session) -> Vec<String> {
    let mut words: Vec<String> = KEYWORDS.map(str::to_owned).into();
    for (name, schema) in session.tables() {
        words.push(name.to_owned());
        words.extend(schema.fields().iter().map(|f| f.name().clone()));
    }
    words.sort();
    words.dedup();
    words
}

fn history_file() -> Option<PathBuf> {
    let state = std::env::var_os("XDG_STATE_HOME").map(PathBuf::from);
    let folder =
        state.or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".local/state")))?.join("echolake");
    std::fs::create_dir_all(&folder).ok()?;
    Some(folder.join("history"))
}
