//! The log: lines of the libraries on stderr, with levels and spans, apart from what commands tell their user.

use tracing::Level;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{Layer, Registry, fmt};

/// The variable that sets the format; `serve` and `ingest` pass it to their child processes.
pub(crate) const FORMAT_VARIABLE: &str = "ECHOLAKE_LOG_FORMAT";
/// The variable that sets levels, by prefixes of crates and modules.
const LEVELS_VARIABLE: &str = "RUST_LOG";
/// The levels if it is not set; the prefix is that of all crates of echolake.
const DEFAULT_LEVELS: &str = "warn,echolake=info";

/// The format of this process's log, for its child processes.
#[cfg(feature = "lake")]
static FORMAT: std::sync::OnceLock<LogFormat> = std::sync::OnceLock::new();

/// Format of the log's lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum LogFormat {
    /// Lines for people.
    Text,
    /// A JSON object per line.
    Json,
}

/// A layer below the log's levels.
pub(crate) type LogLayer = Box<dyn Layer<Registry> + Send + Sync>;

/// Starts the log of this process, with another layer for its spans. To be called once.
pub(crate) fn start_log(format: LogFormat, spans: Option<LogLayer>) {
    #[cfg(feature = "lake")]
    let _ = FORMAT.set(format);
    let given = std::env::var(LEVELS_VARIABLE).unwrap_or_default();
    let parsed = if given.trim().is_empty() { DEFAULT_LEVELS.parse() } else { given.parse::<Targets>() };
    let refused = parsed.as_ref().err().map(ToString::to_string);
    let levels = parsed.unwrap_or_else(|_| Targets::new().with_default(Level::WARN));
    // Commands' own lines have no colours, and the log of a service is read from a file.
    let lines = fmt::layer().with_writer(std::io::stderr).with_ansi(false);
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    tracing_subscriber::registry().with(spans).with(levels).with(lines).init();
    if let Some(refused) = refused {
        tracing::warn!("{LEVELS_VARIABLE} is not as `{DEFAULT_LEVELS}`: {refused}");
    }
}

/// Returns the variable by which a child process writes the same format.
#[cfg(feature = "lake")]
pub(crate) fn child_variable() -> (&'static str, &'static str) {
    let format = match FORMAT.get() {
        Some(LogFormat::Json) => "json",
        Some(LogFormat::Text) | None => "text",
    };
    (FORMAT_VARIABLE, format)
}
