//! `echolake export`: training sets, slices of runs, and the formats of acousticians.

mod export_target;

use std::collections::HashSet;

use anyhow::Context as _;
use clap::{Args, Subcommand, ValueEnum};
use echolake_dsp::full_scale_octave::OctaveGap;
use echolake_export::{
    Check, ExportSummary, Layout, MaterialBand, MaterialFormat, PendingFile, ResponseFormat, RowSymmetries, Slice,
    SliceParams, SplitBy, SplitParams, SurfaceSelection, Taken, TrainingSet, WrittenFile, format_materials,
    write_responses, write_training_set, write_wav,
};
use echolake_lake::Lake;
use echolake_query::{PredicateForm, Session};
use echolake_schema::SurfaceId;
use serde::Deserialize;
use serde_json::json;

use export_target::{ExportTarget, PendingExport};

use crate::CommandOutcome;
use crate::progress::{CommandProgress, TaskProgress};

#[derive(Debug, Subcommand)]
pub(crate) enum ExportCommand {
    /// A training set: Parquet files split by physical panel, with a card, Croissant metadata and checksums.
    Ml(MlArgs),
    /// A slice: the messages of some measurements, as an MCAP file.
    Mcap(McapArgs),
    /// The responses of surfaces as SOFA, one file per surface (SingleRoomSRIR).
    Sofa(ResponseArgs),
    /// The responses of surfaces in the format of the GIR data set; `import gir` reads them.
    Npz(ResponseArgs),
    /// The recordings of some measurements as WAV files with a manifest; `import wav` reads them.
    Wav(WavArgs),
    /// Absorption and scattering of surfaces at full scale, for programs that simulate rooms: view `materials`.
    Materials(MaterialArgs),
}

#[derive(Debug, Args)]
pub(crate) struct MlArgs {
    /// The new folder, on this machine or as s3://bucket/prefix.
    #[arg(short, long, value_name = "DIR", value_parser = ExportTarget::parse)]
    output: ExportTarget,
    /// Rows as measured, or under all eight symmetries of the square.
    #[arg(long, value_enum, default_value_t = SymmetriesArg::None)]
    symmetries: SymmetriesArg,
    /// Unit that the validation and test sets hold out.
    #[arg(long, value_enum, default_value_t = SplitArg::ByPanel)]
    split: SplitArg,
    /// Surfaces: an SQL predicate over the columns of view catalogue; by default all.
    #[arg(long = "where", value_name = "PREDICATE")]
    predicate: Option<String>,
    /// Columns of measurements, nce and tnce, separated by commas; by default ir, temperature_c, snr_db and tnce_*.
    #[arg(long, value_delimiter = ',')]
    columns: Vec<String>,
    /// Minimum share of the surfaces in the test set.
    #[arg(long, default_value_t = 0.1)]
    test: f64,
    /// Minimum share of the surfaces in the validation set.
    #[arg(long, default_value_t = 0.1)]
    validation: f64,
    /// Seed of the split and of the order of surfaces.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Include references (Flat, Foam and other plain plates) as rows of split train.
    #[arg(long)]
    references: bool,
    /// Licence of the data for the card and the metadata, as hubs name it.
    #[arg(long, value_name = "NAME", value_parser = parse_license)]
    license: Option<String>,
    /// Print what was written as JSON.
    #[arg(long)]
    json: bool,
}

fn parse_license(text: &str) -> Result<String, String> {
    match !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || ".-+".contains(c)) {
        true => Ok(text.to_ascii_lowercase()),
        false => Err("letters, digits, `.`, `-` and `+` only; hint: a name such as cc-by-4.0 or other".into()),
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SymmetriesArg {
    None,
    All,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SplitArg {
    /// Physical panels.
    ByPanel,
    /// Typologies.
    ByTypology,
    /// Macrostructures.
    ByMacrostructure,
    /// Everything is for training.
    None,
}

/// A selection of measurements.
#[derive(Debug, Args)]
struct SelectionArgs {
    /// The measurements: an SQL predicate over the columns of table measurements.
    #[arg(long = "where", value_name = "PREDICATE")]
    predicate: String,
    /// Skip the comparison of whole run files by SHA-256; sizes, indexes and the CRCs of all that is read are still
    /// checked.
    #[arg(long)]
    quick: bool,
}

#[derive(Debug, Args)]
pub(crate) struct McapArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    /// Topics, separated by commas; by default all, and the attachments.
    #[arg(long, value_delimiter = ',')]
    topics: Vec<String>,
    /// Order of the messages in the file's chunks.
    #[arg(long, value_enum, default_value_t = LayoutArg::ByTopic)]
    layout: LayoutArg,
    /// The new file, on this machine or as s3://bucket/name.
    #[arg(short, long, value_name = "FILE", value_parser = ExportTarget::parse)]
    output: ExportTarget,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LayoutArg {
    /// Heavy topics in separate chunks: for viewers, which read by ranges.
    ByTopic,
    /// All messages by time: for readers of the file as a stream.
    InTime,
}

#[derive(Debug, Args)]
pub(crate) struct ResponseArgs {
    /// Surfaces, separated by commas; by default all.
    #[arg(long, value_delimiter = ',')]
    surfaces: Vec<SurfaceId>,
    /// The new folder, on this machine or as s3://bucket/prefix.
    #[arg(short, long, value_name = "DIR", value_parser = ExportTarget::parse)]
    output: ExportTarget,
}

#[derive(Debug, Args)]
pub(crate) struct WavArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    /// The new folder, on this machine or as s3://bucket/prefix.
    #[arg(short, long, value_name = "DIR", value_parser = ExportTarget::parse)]
    output: ExportTarget,
}

#[derive(Debug, Args)]
pub(crate) struct MaterialArgs {
    /// Surfaces, separated by commas; by default all.
    #[arg(long, value_delimiter = ',')]
    surfaces: Vec<SurfaceId>,
    /// Program that reads the file.
    #[arg(long, value_enum)]
    format: MaterialFormatArg,
    /// The new file, on this machine or as s3://bucket/name.
    #[arg(short, long, value_name = "FILE", value_parser = ExportTarget::parse)]
    output: ExportTarget,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum MaterialFormatArg {
    /// JSON with the arguments of pyroomacoustics' Material by surface.
    Pyroomacoustics,
    /// JSON with absorption_coefficients and frequencies, as CHORAS' input has them.
    Choras,
    /// A row per surface and band, with uncertainties and reasons.
    Csv,
}

pub(crate) async fn run_export(command: &ExportCommand, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    match command {
        ExportCommand::Ml(args) => export_ml(&lake, args).await?,
        ExportCommand::Mcap(args) => export_mcap(&lake, args).await?,
        ExportCommand::Sofa(args) => export_responses(&lake, args, ResponseFormat::Sofa).await?,
        ExportCommand::Npz(args) => export_responses(&lake, args, ResponseFormat::Npz).await?,
        ExportCommand::Wav(args) => export_wav(&lake, args).await?,
        ExportCommand::Materials(args) => export_materials(&lake, args).await?,
    }
    Ok(CommandOutcome::Whole)
}

async fn export_ml(lake: &Lake, args: &MlArgs) -> anyhow::Result<()> {
    let by = match args.split {
        SplitArg::ByPanel => SplitBy::Panel,
        SplitArg::ByTypology => SplitBy::Typology,
        SplitArg::ByMacrostructure => SplitBy::Macrostructure,
        SplitArg::None => SplitBy::Nothing,
    };
    let symmetries = match args.symmetries {
        SymmetriesArg::None => RowSymmetries::None,
        SymmetriesArg::All => RowSymmetries::All,
    };
    let split = SplitParams { by, test: args.test, validation: args.validation, seed: args.seed };
    let set = TrainingSet {
        symmetries,
        split,
        selection: match &args.predicate {
            Some(predicate) => Some(select_surfaces(lake, predicate).await?),
            None => None,
        },
        columns: args.columns.clone(),
        references: args.references,
        license: args.license.clone(),
    };
    let progress = CommandProgress::new();
    let mut task = None;
    let pending = PendingExport::prepare_folder(&args.output).await?;
    let exported = write_training_set(lake, pending.path(), &set, &mut |done, total| {
        show_progress(&progress, &mut task, "surfaces", done, total);
    })
    .await?;
    let bytes: u64 = exported.files.iter().map(|f| f.bytes).sum();
    finish_task(task, format!("{} files, {}", exported.files.len(), super::format_size(bytes)));
    pending.publish().await?;
    super::print_line(&if args.json { in_json(&exported)? } else { in_words(&exported) })?;
    Ok(())
}

fn in_words(exported: &ExportSummary) -> String {
    let mut lines = vec![format!("{:<12} {:>6} {:>7} {:>9} {:>10}", "split", "files", "panels", "surfaces", "rows")];
    lines.extend(
        exported
            .parts
            .iter()
            .map(|p| format!("{:<12} {:>6} {:>7} {:>9} {:>10}", p.part.name(), p.files, p.panels, p.surfaces, p.rows)),
    );
    if !exported.references.is_empty() {
        let names: Vec<_> = exported.references.iter().map(SurfaceId::as_str).collect();
        lines.push(format!("{} left out: references (--references includes them)", names.join(", ")));
    }
    if !exported.left_out.is_empty() {
        let count = exported.left_out.len();
        lines.push(format!("{count} surfaces left out: another side of their panel is in another split"));
    }
    if exported.rejected > 0 {
        lines.push(format!("{} measurements left out: the last verdict rejects them", exported.rejected));
    }
    if exported.waiting > 0 {
        lines.push(format!("{} runs left out: they wait for their references", exported.waiting));
    }
    lines.join("\n")
}

fn in_json(exported: &ExportSummary) -> serde_json::Result<String> {
    let parts: Vec<_> = exported
        .parts
        .iter()
        .map(|p| {
            json!({
                "split": p.part.name(), "files": p.files, "panels": p.panels, "surfaces": p.surfaces, "rows": p.rows,
                "height_maps": p.height_maps,
            })
        })
        .collect();
    let file = |f: &WrittenFile| json!({ "name": f.name, "bytes": f.bytes, "sha256": f.sha256 });
    serde_json::to_string_pretty(&json!({
        "splits": parts,
        "left_out": exported.left_out,
        "references_left_out": exported.references,
        "waiting": exported.waiting,
        "rejected": exported.rejected,
        "files": exported.files.iter().map(file).collect::<Vec<_>>(),
    }))
}

async fn export_mcap(lake: &Lake, args: &McapArgs) -> anyhow::Result<()> {
    let pending = PendingExport::prepare_file(&args.output).await?;
    let mut file = PendingFile::create(pending.path())?;
    let taken = select_measurements(lake, &args.selection).await?;
    let layout = match args.layout {
        LayoutArg::ByTopic => Layout::ByTopic,
        LayoutArg::InTime => Layout::InTime,
    };
    let count = taken.len();
    let params = SliceParams { taken, topics: args.topics.clone(), layout, check: wanted_check(&args.selection) };
    let mut slice = Slice::open(lake, &lake.whole_snapshot().await?, params).await?;
    let mut bytes = 0;
    while let Some(piece) = slice.next().await? {
        bytes += piece.len() as u64;
        file.write(&piece)?;
    }
    file.publish()?;
    pending.publish().await?;
    eprintln!("{}: {count} measurements, {}", args.output, super::format_size(bytes));
    Ok(())
}

async fn export_responses(lake: &Lake, args: &ResponseArgs, format: ResponseFormat) -> anyhow::Result<()> {
    let progress = CommandProgress::new();
    let mut task = None;
    let pending = PendingExport::prepare_folder(&args.output).await?;
    let files = write_responses(lake, pending.path(), format, &args.surfaces, &mut |done, total| {
        show_progress(&progress, &mut task, "surfaces", done, total);
    })
    .await?;
    let bytes: u64 = files.iter().map(|f| f.bytes).sum();
    finish_task(task, format!("{} files, {}", files.len(), super::format_size(bytes)));
    pending.publish().await
}

async fn export_wav(lake: &Lake, args: &WavArgs) -> anyhow::Result<()> {
    let taken = select_measurements(lake, &args.selection).await?;
    let progress = CommandProgress::new();
    let mut task = None;
    let pending = PendingExport::prepare_folder(&args.output).await?;
    let count = write_wav(lake, pending.path(), &taken, wanted_check(&args.selection), &mut |done, total| {
        show_progress(&progress, &mut task, "recordings", done, total);
    })
    .await?;
    finish_task(task, format!("{count} recordings"));
    pending.publish().await?;
    if let ExportTarget::Local(folder) = &args.output {
        eprintln!("next: echolake --lake NEW import wav {}", folder.join("manifest.csv").display());
    }
    Ok(())
}

async fn export_materials(lake: &Lake, args: &MaterialArgs) -> anyhow::Result<()> {
    let pending = PendingExport::prepare_file(&args.output).await?;
    let mut file = PendingFile::create(pending.path())?;
    lake.rig().known_scale().ok_or(OctaveGap::UnknownScale)?;
    let session = Session::new(lake)?;
    let sql = "select * from materials order by surface_id, full_scale_hz";
    let mut rows = super::sql::query_rows::<MaterialBand>(&session, sql).await?;
    if let Some(missing) =
        args.surfaces.iter().find(|surface| rows.iter().all(|row| row.surface_id != surface.as_str()))
    {
        let sql = format!("select surface_id from surfaces where surface_id = '{missing}'");
        let is_there = !super::sql::query_rows::<SelectedSurface>(&session, &sql).await?.is_empty();
        anyhow::ensure!(
            is_there,
            "surface `{missing}` is not in the lake; hint: echolake sql \"select surface_id from surfaces\""
        );
        anyhow::bail!("surface `{missing}` has no levels; hint: `echolake doctor` says which references are missing");
    }
    rows.retain(|row| {
        args.surfaces.is_empty() || args.surfaces.iter().any(|surface| surface.as_str() == row.surface_id)
    });
    let format = match args.format {
        MaterialFormatArg::Pyroomacoustics => MaterialFormat::Pyroomacoustics,
        MaterialFormatArg::Choras => MaterialFormat::Choras,
        MaterialFormatArg::Csv => MaterialFormat::Csv,
    };
    let (text, omitted) = format_materials(&rows, format)?;
    file.write(&text)?;
    file.publish()?;
    pending.publish().await?;
    let surfaces = rows.chunk_by(|a, b| a.surface_id == b.surface_id).count() - omitted.len();
    for surface in omitted {
        let lacks = |row: &MaterialBand| row.absorption.is_none() || row.scattering.is_none();
        let row = rows.iter().find(|row| row.surface_id == surface && lacks(row));
        let reason = row.and_then(|row| row.absorption_reason.as_ref().or(row.scattering_reason.as_ref()));
        eprintln!("{surface} left out: {}", reason.map_or("a band has no value", String::as_str));
    }
    eprintln!("{}: {surfaces} surfaces", args.output);
    Ok(())
}

fn show_progress(
    progress: &CommandProgress,
    task: &mut Option<TaskProgress>,
    unit: &'static str,
    done: usize,
    total: usize,
) {
    task.get_or_insert_with(|| progress.start_task("export", total as u64, unit)).set_done(done as u64);
}

fn finish_task(task: Option<TaskProgress>, what: String) {
    if let Some(task) = task {
        task.finish_with(what);
    }
}

fn wanted_check(selection: &SelectionArgs) -> Check {
    if selection.quick { Check::Ends } else { Check::Whole }
}

#[derive(Deserialize)]
struct SelectedSurface {
    surface_id: SurfaceId,
}

async fn select_surfaces(lake: &Lake, predicate: &str) -> anyhow::Result<SurfaceSelection> {
    let session = Session::new(lake)?;
    let select = "select surface_id from catalogue where";
    let sql = session.append_predicate(select, predicate, PredicateForm::AnyExpression).context("--where")?;
    let rows: Vec<SelectedSurface> = super::sql::query_rows(&session, &sql).await.context("--where")?;
    let surfaces: HashSet<_> = rows.into_iter().map(|row| row.surface_id).collect();
    anyhow::ensure!(!surfaces.is_empty(), "`{predicate}` selects no surface; hint: `echolake sql` tries predicates");
    Ok(SurfaceSelection { predicate: predicate.to_owned(), surfaces })
}

async fn select_measurements(lake: &Lake, selection: &SelectionArgs) -> anyhow::Result<Vec<Taken>> {
    let session = Session::new(lake)?;
    let select = format!("select {} from measurements where", Taken::COLUMNS.join(", "));
    let sql =
        session.append_predicate(&select, &selection.predicate, PredicateForm::AnyExpression).context("--where")?;
    let mut answer = session.query(&sql).await.context("--where")?;
    let mut taken = Vec::new();
    while let Some(batch) = answer.next().await? {
        taken.extend(Taken::of_batch(&batch)?);
    }
    anyhow::ensure!(
        !taken.is_empty(),
        "`{}` selects no measurement; hint: `echolake sql` tries predicates",
        selection.predicate
    );
    Ok(taken)
}
