//! The commands as they are typed: their tree, and which function runs each.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::{CommandFactory as _, Parser, Subcommand};
#[cfg(feature = "lake")]
use echolake_schema::ProjectName;
#[cfg(feature = "lake")]
use echolake_server::tokens::TokenScope;

use crate::CommandOutcome;
use crate::commands::acquire::{self, AcquireArgs};
#[cfg(feature = "lake")]
use crate::commands::campaign::{self, CampaignSubcommand};
#[cfg(feature = "lake")]
use crate::commands::demo::{self, DemoArgs};
#[cfg(feature = "lake")]
use crate::commands::design::{self, DesignArgs};
use crate::commands::doctor::{self, DoctorArgs};
#[cfg(feature = "lake")]
use crate::commands::export::{self, ExportCommand};
#[cfg(feature = "lake")]
use crate::commands::figure::{self, FigureCommand};
#[cfg(feature = "lake")]
use crate::commands::import::{self, ImportArgs};
#[cfg(feature = "lake")]
use crate::commands::ingest::{self, IngestArgs};
#[cfg(feature = "lake")]
use crate::commands::listen::{self, ListenArgs};
#[cfg(feature = "lake")]
use crate::commands::mcp::{self, McpArgs};
use crate::commands::panel::{self, PanelArgs};
use crate::commands::recover::{self, RecoverArgs};
use crate::commands::replay::{self, ReplayArgs};
#[cfg(feature = "lake")]
use crate::commands::serve::{self, CertificateArgs, EngineArgs, ServeArgs};
#[cfg(feature = "lake")]
use crate::commands::sql::{self, SqlArgs};
#[cfg(feature = "lake")]
use crate::commands::twin::{self, TwinArgs};
#[cfg(feature = "lake")]
use crate::commands::upkeep::optimize::{self, OptimizeArgs};
#[cfg(feature = "lake")]
use crate::commands::upkeep::rebuild::{self, RebuildArgs};
#[cfg(feature = "lake")]
use crate::commands::upkeep::remove::{self, RemoveArgs};
#[cfg(feature = "lake")]
use crate::commands::upkeep::tag::{self, TagArgs};
#[cfg(feature = "lake")]
use crate::commands::upkeep::vacuum::{self, VacuumArgs};
#[cfg(feature = "upload")]
use crate::commands::upload::{self, UploadArgs};
use crate::logging::{FORMAT_VARIABLE, LogFormat};

/// The commands to try first, in the help of the program, which a call without a command prints.
#[cfg(feature = "lake")]
const FIRST: &str = "Try first: `echolake demo` measures six surfaces with the simulated rig and serves the catalogue \
                     of them; then `echolake sql` and `echolake doctor`.";

/// A data lake and catalogue for sweep measurements.
#[derive(Debug, Parser)]
#[command(version, max_term_width = 100)]
#[cfg_attr(feature = "lake", command(after_help = FIRST))]
pub(crate) struct CliArguments {
    /// The lake: a folder, a file:// URL or s3://bucket/prefix.
    #[arg(long, global = true, env = "ECHOLAKE_LAKE", default_value = "lake", value_name = "URL")]
    pub lake: String,
    /// Format of the log on stderr; RUST_LOG sets its levels.
    #[arg(long, global = true, env = FORMAT_VARIABLE, default_value = "text", value_name = "FORMAT")]
    pub log_format: LogFormat,
    #[command(subcommand)]
    pub command: CliCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum CliCommand {
    #[cfg(feature = "lake")]
    #[command(flatten)]
    Lake(LakeCommand),
    /// Measure one surface: one run, one MCAP file. Devices are simulated unless the rig file names them.
    Acquire(Box<AcquireArgs>),
    /// Write a generated relief as a mesh, heights or a picture; make groups of them.
    Panel(PanelArgs),
    /// Replay runs to Foxglove (play, pause, seek) and Lichtblick (view only).
    Replay(ReplayArgs),
    /// Make a run of a recording that was stopped, cut off or damaged, as far as every checksum is right.
    Recover(RecoverArgs),
    /// Upload closed runs to the lake's inbox, in a folder or an object store; continues after any cut.
    #[cfg(feature = "upload")]
    Upload(UploadArgs),
    /// Report what is in the lake, what is missing and what is damaged.
    Doctor(DoctorArgs),
    /// Print a completion script for a shell.
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
    /// Write the man pages, one per command.
    #[command(hide = true)]
    Man {
        /// Folder for them.
        folder: PathBuf,
    },
}

/// The commands that need the lake's tables.
#[cfg(feature = "lake")]
#[derive(Debug, Subcommand)]
pub(crate) enum LakeCommand {
    /// Measure a few surfaces with the simulated rig, ingest them, print the paper's tables and serve the catalogue.
    Demo(DemoArgs),
    /// Measure the surfaces of a file with the simulated rig, and print the paper's tables beside the expected levels.
    #[command(subcommand)]
    Campaign(CampaignSubcommand),
    /// Find panels for a target by simulating candidates: their meshes, expected levels, and a campaign for them.
    Design(DesignArgs),
    /// Turn existing measurements into runs.
    Import(ImportArgs),
    /// Turn runs into rows.
    Ingest(IngestArgs),
    /// Take runs out of the lake: their rows, and rows that rest on them, and their files.
    Remove(RemoveArgs),
    /// Empty a table that is damaged, or all, and derive the rows again from the run files.
    Rebuild(RebuildArgs),
    /// Query the lake in SQL; without a query, a prompt.
    Sql(SqlArgs),
    /// Export data: training sets, slices of runs, SOFA, WAV, npz.
    #[command(subcommand)]
    Export(ExportCommand),
    /// Hear a recording as a surface and its Flat would reflect it at full scale.
    Listen(ListenArgs),
    /// Draw the paper's pictures and tables of surfaces, as SVG, PDF, PNG, LaTeX, CSV or Markdown.
    #[command(subcommand)]
    Figure(FigureCommand),
    /// Serve the catalogue, and read access to the lake over HTTP, Arrow Flight SQL and Postgres' protocol.
    Serve(Box<ServeArgs>),
    /// Let an agent on this machine ask the lake, by the Model Context Protocol on standard input and output.
    Mcp(McpArgs),
    /// Answer queries of all clients, as a child of `serve`.
    #[command(hide = true)]
    Engine(EngineArgs),
    /// Make a self-signed certificate for `serve --certificate`, for a lab without a certificate authority.
    Certificate(CertificateArgs),
    /// Make a token for `serve --tokens`.
    Token {
        /// Name of the token's owner.
        name: String,
        /// Days until it expires; by default it does not.
        #[arg(long, value_name = "N")]
        days: Option<u32>,
        /// Project that the token may see, and no other; repeatable. By default it sees all.
        #[arg(long, value_name = "NAME")]
        project: Vec<ProjectName>,
        /// What it is for: sql (queries), files (run files, Parquet files, meshes), metrics (the server's own figures),
        /// annotate (adding annotations and predictions), annotate-references (beside it: verdicts on runs of Flat,
        /// Foam and others that levels of other surfaces rest on).
        #[arg(long, value_name = "SCOPE,...", value_delimiter = ',', default_value = "sql,files")]
        scopes: Vec<TokenScope>,
    },
    /// Merge the tables' small files into large ones; ingest and queries may continue meanwhile.
    Optimize(OptimizeArgs),
    /// Name a version of the lake, for `AS OF`, and keep its files; without a name, list the tags.
    Tag(TagArgs),
    /// Simulate a measured panel's heights, and report the differences to the measurement by pair and band.
    Twin(TwinArgs),
    /// Delete files that no table needs any more, and what crashes left behind.
    Vacuum(VacuumArgs),
}

impl CliArguments {
    /// Starts the program again, with other settings of its allocator, if the command ingests runs. To be called
    /// before there are threads.
    #[cfg(feature = "lake")]
    pub fn prepare_memory(&self) {
        if let CliCommand::Lake(LakeCommand::Demo(_) | LakeCommand::Ingest(_) | LakeCommand::Twin(_)) = &self.command {
            echolake_ingest::keep_freed_memory();
        }
    }

    /// Gives up what the command does not need. To be called before there are threads.
    pub fn confine_process(&self) -> anyhow::Result<()> {
        match &self.command {
            #[cfg(feature = "lake")]
            CliCommand::Lake(LakeCommand::Engine(args)) => args.confine_process(&self.lake),
            #[cfg(feature = "lake")]
            CliCommand::Lake(LakeCommand::Serve(args)) => args.confine_process(&self.lake),
            _ => Ok(()),
        }
    }

    /// Returns whether the command has clients of its own, whose requests are spans.
    #[cfg(feature = "otlp")]
    pub fn answers_clients(&self) -> bool {
        matches!(&self.command, CliCommand::Lake(LakeCommand::Serve(args)) if !args.is_worker())
    }

    /// Runs the command.
    pub async fn run_command(self) -> anyhow::Result<CommandOutcome> {
        let lake = &self.lake;
        match &self.command {
            #[cfg(feature = "lake")]
            CliCommand::Lake(command) => command.run_command(lake).await,
            CliCommand::Acquire(args) => acquire::run_acquire(args, lake).await,
            CliCommand::Panel(args) => panel::run_panel(args),
            CliCommand::Replay(args) => replay::run_replay(args, lake).await,
            CliCommand::Recover(args) => recover::run_recover(args),
            #[cfg(feature = "upload")]
            CliCommand::Upload(args) => upload::run_upload(args, lake).await,
            CliCommand::Doctor(args) => doctor::run_doctor(args, lake).await,
            CliCommand::Completions { shell } => {
                clap_complete::generate(*shell, &mut Self::command(), "echolake", &mut std::io::stdout());
                Ok(CommandOutcome::Whole)
            }
            CliCommand::Man { folder } => {
                let written =
                    std::fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(Self::command(), folder));
                written.with_context(|| format!("cannot write man pages to `{}`", folder.display()))?;
                Ok(CommandOutcome::Whole)
            }
        }
    }
}

#[cfg(feature = "lake")]
impl LakeCommand {
    async fn run_command(&self, lake: &str) -> anyhow::Result<CommandOutcome> {
        match self {
            Self::Demo(args) => demo::run_demo(args, lake).await,
            Self::Campaign(command) => campaign::run_campaign(command, lake).await,
            Self::Design(args) => design::run_design(args, lake).await,
            Self::Import(args) => import::run_import(args, lake).await,
            Self::Ingest(args) => ingest::run_ingest(args, lake).await,
            Self::Remove(args) => remove::run_remove(args, lake).await,
            Self::Rebuild(args) => rebuild::run_rebuild(args, lake).await,
            Self::Sql(args) => sql::run_sql(args, lake).await.map(|()| CommandOutcome::Whole),
            Self::Export(args) => export::run_export(args, lake).await,
            Self::Listen(args) => listen::run_listen(args, lake).await,
            Self::Figure(args) => figure::run_figure(args, lake).await,
            Self::Serve(args) => serve::run_serve(args, lake).await,
            Self::Mcp(args) => mcp::run_mcp(args, lake).await,
            Self::Engine(args) => serve::serve_engine(args, lake).await,
            Self::Certificate(args) => serve::write_certificate(args),
            Self::Token { name, days, project, scopes } => serve::print_token(name, *days, project, scopes),
            Self::Optimize(args) => optimize::run_optimize(args, lake).await,
            Self::Twin(args) => twin::run_twin(args, lake).await,
            Self::Tag(args) => tag::run_tag(args, lake).await,
            Self::Vacuum(args) => vacuum::run_vacuum(args, lake).await,
        }
    }
}

#[cfg(all(test, feature = "lake"))]
mod tests {
    use super::*;

    /// The manual's page of commands, which is generated from their help.
    const PAGE: &str = "docs/commands.md";
    /// Set to write the page.
    const RENEW: &str = "ECHOLAKE_RENEW";

    #[test]
    fn page_of_commands_is_fresh() {
        let options = clap_markdown::MarkdownOptions::new().title("Commands".to_owned()).show_footer(false);
        let page = clap_markdown::help_markdown_custom::<CliArguments>(&options);
        if std::env::var_os(RENEW).is_some() {
            std::fs::write(PAGE, &page).expect("the page is written");
        }
        let written = std::fs::read_to_string(PAGE).unwrap_or_default();
        let command = format!("{RENEW}=1 cargo test --profile quick --locked page_of_commands");
        assert!(written == page, "{PAGE} is stale; `{command}` renews it");
    }
}
