//! The `echolake` command: reads its arguments, runs one verb, and decides the exit code.
#![allow(clippy::print_stderr, reason = "this is the program that talks to people")]

mod cli;
mod commands;
#[cfg(feature = "lake")]
mod duration;
mod error_text;
mod logging;
mod processor;
mod progress;
mod signals;
#[cfg(feature = "otlp")]
mod span_export;
mod terminal_text;

use std::process::ExitCode;

use clap::Parser as _;

use error_text::describe_error;

// glibc keeps what each of many threads freed: a third more memory at the peak of an ingest.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// The result of a command that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum CommandOutcome {
    /// Everything was done.
    Whole,
    /// It was done, and data were lost on the way.
    WithLoss,
}

/// Arguments that a file contradicts, which clap cannot see.
#[derive(Debug)]
struct UsageError(String);

impl std::fmt::Display for UsageError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for UsageError {}

/// More would not make a disk faster, and each keeps memory.
const BLOCKING_THREADS: usize = 16;
/// The library's 61 makes a client wait for a quarter of a second beside others that send without end.
const TURNS_BETWEEN_EVENTS: u32 = 8;
const FAILED: u8 = 1;
const WRONG_USAGE: u8 = 2;
const DONE_WITH_LOSS: u8 = 3;

fn main() -> ExitCode {
    // Nothing that is compiled here stands before it: it could use the instructions.
    if !processor::has_instructions() {
        let _ = std::io::Write::write_all(&mut std::io::stderr(), processor::TOO_OLD.as_bytes());
        return ExitCode::from(FAILED);
    }
    run_program()
}

#[inline(never)]
fn run_program() -> ExitCode {
    // clap itself ends with 2 on wrong usage.
    let cli = cli::CliArguments::parse();
    #[cfg(feature = "lake")]
    cli.prepare_memory();
    let runtime = || {
        tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            // A client that keeps all threads busy must not delay that others are heard.
            .event_interval(TURNS_BETWEEN_EVENTS)
            // Files are read and written there; what computes has threads of its own.
            .max_blocking_threads(BLOCKING_THREADS)
            .build()
    };
    let outcome =
        cli.confine_process().and_then(|()| Ok(runtime()?)).and_then(|runtime| runtime.block_on(run_cli(cli)));
    match outcome {
        Ok(CommandOutcome::Whole) => ExitCode::SUCCESS,
        Ok(CommandOutcome::WithLoss) => ExitCode::from(DONE_WITH_LOSS),
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", describe_error(&error));
            ExitCode::from(if error.is::<UsageError>() { WRONG_USAGE } else { FAILED })
        }
    }
}

async fn run_cli(cli: cli::CliArguments) -> anyhow::Result<CommandOutcome> {
    #[cfg(feature = "otlp")]
    let export = if cli.answers_clients() { span_export::SpanExport::start()? } else { None };
    #[cfg(feature = "otlp")]
    let spans = export.as_ref().map(span_export::SpanExport::layer);
    #[cfg(not(feature = "otlp"))]
    let spans = None;
    logging::start_log(cli.log_format, spans);
    cli.run_command().await
}

// The reader that closed the pipe wants no more.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let io = |e: &(dyn std::error::Error + 'static)| {
        e.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
    };
    error.chain().any(io)
}
