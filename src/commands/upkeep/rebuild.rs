//! `echolake rebuild`: rows of damaged tables are derived again.

use std::collections::HashSet;

use clap::Args;
use clap::builder::PossibleValuesParser;
use echolake_lake::{Error as LakeError, GivenUpRows, Lake};
use echolake_schema::tables::{Source, Table};
use futures::TryStreamExt as _;
use object_store::ObjectStore as _;

use crate::CommandOutcome;
use crate::commands::ingest::{self, IngestArgs};

#[derive(Debug, Args)]
pub(crate) struct RebuildArgs {
    /// The table; by default all but annotations and predictions. Until its rows are there again, queries of it are
    /// refused. Of annotations and predictions, which are in no run, the rows of lost and damaged files are given up.
    #[arg(value_parser = PossibleValuesParser::new(Table::ALL.map(Table::name)))]
    pub table: Option<String>,
}

pub(crate) async fn run_rebuild(args: &RebuildArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    let named = args.table.as_deref().and_then(Table::by_name);
    if let Some(table) = named.filter(|table| table.source() == Source::Users) {
        return give_up_rows(&lake, table).await;
    }
    let of_runs = Table::ALL.into_iter().filter(|table| table.source() != Source::Users);
    let tables = named.map_or_else(|| of_runs.collect(), |table| vec![table]);
    if tables.iter().any(|table| matches!(table.source(), Source::Run | Source::Pointer)) {
        ensure_run_files(&lake).await?;
    }
    lake.begin_rebuild(&tables).await?;
    let args = IngestArgs { runs: Vec::new(), watch: false, json: false, suspect: None };
    ingest::run_ingest(&args, lake_url).await
}

// What users added is in no run file.
async fn give_up_rows(lake: &Lake, table: Table) -> anyhow::Result<CommandOutcome> {
    let given_up = lake.give_up_lost(table).await?;
    let name = table.name();
    for file in &given_up.files {
        eprintln!("{file}: gave up its rows");
    }
    match (given_up.is_whole_log, given_up.files.len()) {
        (true, _) => eprintln!("the log of table `{name}` was lost: it begins again, without rows"),
        (false, 0) => eprintln!("table `{name}` is whole: nothing is given up, and nothing can make its rows again"),
        (false, files) => eprintln!("gave up {} rows of table `{name}` in {files} files", given_up.rows),
    }
    Ok(if given_up == GivenUpRows::default() { CommandOutcome::Whole } else { CommandOutcome::WithLoss })
}

// What has no run file is in the tables alone.
async fn ensure_run_files(lake: &Lake) -> anyhow::Result<()> {
    let snapshot = match lake.snapshot().await {
        // Nothing says which runs there were.
        Err(LakeError::Log { .. }) => return Ok(()),
        snapshot => snapshot?,
    };
    let listed: Vec<_> = lake.store().list(Some(&"runs".into())).try_collect().await?;
    let there: HashSet<_> = listed.into_iter().map(|object| object.location).collect();
    let missing: Vec<_> = snapshot.runs().map(|run| Lake::run_path(&run.surface, &run.run)).collect();
    let missing: Vec<_> = missing.into_iter().filter(|path| !there.contains(path)).collect();
    anyhow::ensure!(
        missing.is_empty(),
        "`{}` is not there, from which rows would be derived again, and {} run files more; hint: bring them back from \
         a copy, or rebuild tables that need no run file: nce, tnce, tnce_d4, surface_stats",
        missing[0],
        missing.len() - 1
    );
    Ok(())
}
