//! Training sets: Parquet files of whole surfaces that each load independently, split by physical panel.

mod card;
mod columns;
mod croissant;
mod heights;
mod measurements;
mod shard;
mod split;
mod statistics;
mod surfaces;

use std::collections::HashSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use arrow::datatypes::SchemaRef;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::SurfaceId;
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::splits::order_digest;
pub use echolake_schema::splits::{SplitBy, SplitParams, SplitPart};
use futures::StreamExt as _;

use crate::error::{Error, Result};
use crate::output::{PendingFolder, WrittenFile};
use columns::TrainingColumns;
use measurements::SymmetryMoves;
use shard::WrittenShard;
use statistics::ColumnStatistics;
use surfaces::TrainingSurface;

/// Minimum number of files per split, if it has that many surfaces: loaders give whole files to their workers.
pub const SHARDS: usize = 32;
/// Maximum number of surfaces per file: at 5 MB per surface, files stay in the hundreds of MB.
const SURFACES_A_SHARD: usize = 64;

/// The D4 symmetries by which rows are repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RowSymmetries {
    /// Rows as they were measured; `echolake.torch` turns them while it loads.
    None,
    /// Every row eight times, as far as the grid has the symmetry.
    All,
}

/// Surfaces that a predicate selects.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceSelection {
    /// The predicate, for the card.
    pub predicate: String,
    /// The surfaces.
    pub surfaces: HashSet<SurfaceId>,
}

/// Parameters of a training set.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingSet {
    /// Its symmetries.
    pub symmetries: RowSymmetries,
    /// Its split into parts.
    pub split: SplitParams,
    /// Surfaces that it has; None for all.
    pub selection: Option<SurfaceSelection>,
    /// Columns of `measurements`, `nce` and `tnce`; the default columns if empty.
    pub columns: Vec<String>,
    /// True if surfaces that normalise others, and others of typology `reference`, are training rows, too.
    pub references: bool,
    /// Licence of the data for the card and the metadata, an SPDX name in lower case; None if it is not known.
    pub license: Option<String>,
}

impl Default for TrainingSet {
    fn default() -> Self {
        Self {
            symmetries: RowSymmetries::None,
            split: SplitParams::default(),
            selection: None,
            columns: Vec::new(),
            references: false,
            license: None,
        }
    }
}

/// Result of an export of a training set.
#[derive(Debug, Clone, PartialEq)]
pub struct ExportSummary {
    /// The parts, training first.
    pub parts: Vec<PartCounts>,
    /// Surfaces that are left out because another side of their panel is in another part.
    pub left_out: Vec<SurfaceId>,
    /// References that are left out, because only reliefs were asked for.
    pub references: Vec<SurfaceId>,
    /// Runs that are left out because they wait for references.
    pub waiting: usize,
    /// Measurements that are left out because the last verdict on them is a rejection.
    pub rejected: u64,
    /// All files with their checksums, by name.
    pub files: Vec<WrittenFile>,
}

/// Counts of one part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PartCounts {
    /// The part.
    pub part: SplitPart,
    /// Files of measurements.
    pub files: usize,
    /// Physical panels.
    pub panels: usize,
    /// Surfaces.
    pub surfaces: usize,
    /// Rows of measurements.
    pub rows: u64,
    /// Surfaces that have height maps.
    pub height_maps: usize,
}

/// The plan of an export, complete before the first row is read.
struct Plan {
    set: TrainingSet,
    columns: TrainingColumns,
    moves: SymmetryMoves,
    shards: Vec<Shard>,
    left_out: Vec<SurfaceId>,
    references: Vec<SurfaceId>,
    waiting: usize,
    rejected: RejectedMeasurements,
}

/// A file of measurements.
#[derive(Debug, Clone)]
struct Shard {
    part: SplitPart,
    name: String,
    surfaces: Vec<TrainingSurface>,
}

impl Plan {
    async fn new(lake: &Lake, snapshot: &LakeSnapshot, set: &TrainingSet) -> Result<Self> {
        let columns = TrainingColumns::choose(lake.rig(), &set.columns)?;
        let (mut surfaces, waiting) = surfaces::read_surfaces(lake, snapshot).await?;
        if let Some(selection) = &set.selection {
            surfaces.retain(|surface| selection.surfaces.contains(&surface.id));
        }
        let is_omitted = |surface: &TrainingSurface| surface.reference && !set.references;
        let references: Vec<_> = surfaces.iter().filter(|s| is_omitted(s)).map(|s| s.id.clone()).collect();
        if references.len() == surfaces.len() {
            let reason =
                format!("the lake has references only ({}); hint: --references", card::listed_names(&references));
            return Err(Error::Nothing { reason });
        }
        // Of all, so that a panel has the same part whether or not its reference is a row.
        let parts = split::assign_parts(&surfaces, set.split)?;
        let mut left_out = Vec::new();
        let mut of_part: [Vec<TrainingSurface>; 3] = Default::default();
        for (surface, part) in surfaces.into_iter().zip(parts).filter(|(surface, _)| !is_omitted(surface)) {
            match part.and_then(|part| SplitPart::ALL.iter().position(|p| *p == part)) {
                Some(at) => of_part[at].push(surface),
                None => left_out.push(surface.id),
            }
        }
        let shards = SplitPart::ALL
            .into_iter()
            .zip(of_part)
            .flat_map(|(part, of)| deal_shards(part, of, set.split.seed))
            .collect();
        let moves = SymmetryMoves::from_grid(lake.grid(), set.symmetries);
        let rejected = lake.read_rejections(snapshot).await?;
        Ok(Self { set: set.clone(), columns, moves, shards, left_out, references, waiting, rejected })
    }

    fn of_part(&self, part: SplitPart) -> impl Iterator<Item = &TrainingSurface> {
        self.shards.iter().filter(move |s| s.part == part).flat_map(|s| &s.surfaces)
    }

    fn schema(&self) -> &SchemaRef {
        self.columns.schema()
    }
}

// Dealt like cards in a drawn order, so that every file has surfaces of every kind.
fn deal_shards(part: SplitPart, mut surfaces: Vec<TrainingSurface>, seed: u64) -> Vec<Shard> {
    surfaces.sort_by_cached_key(|s| order_digest(seed, s.id.as_str()));
    let count = SHARDS.max(surfaces.len().div_ceil(SURFACES_A_SHARD)).min(surfaces.len());
    let mut shards: Vec<_> = (0..count)
        .map(|i| Shard {
            part,
            name: format!("data/{}-{i:05}-of-{count:05}.parquet", part.name()),
            surfaces: Vec::new(),
        })
        .collect();
    surfaces.into_iter().enumerate().for_each(|(i, surface)| shards[i % count].surfaces.push(surface));
    shards
}

/// Writes a training set into a new or empty folder; `progress` is called with the number of surfaces done and their
/// total. The same lake gives the same bytes.
///
/// # Errors
/// [`crate::Error`]; nothing is left behind.
pub async fn write_training_set(
    lake: &Lake,
    folder: &Path,
    set: &TrainingSet,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<ExportSummary> {
    let snapshot = lake.whole_snapshot().await?;
    let plan = Plan::new(lake, &snapshot, set).await?;
    let pending = PendingFolder::create(folder)?;
    let mut parts = Vec::new();
    let mut files = Vec::new();
    let mut statistics = ColumnStatistics::default();
    for part in SplitPart::ALL {
        if plan.of_part(part).next().is_some() {
            let mut of_part = ColumnStatistics::default();
            let (written, height_maps) =
                shard::write_height_maps(lake, &snapshot, &plan, part, &pending, &mut of_part).await?;
            files.extend(written);
            parts.push(part_counts(&plan, part, height_maps));
            if part == SplitPart::Train {
                statistics = of_part;
            }
        }
    }
    let job = Arc::new(ExportJob { lake: lake.clone(), snapshot, plan, folder: pending });
    let written = shards_of(&job, progress).await?;
    let ExportJob { plan, folder: pending, snapshot, .. } = &*job;
    let mut sources = Vec::new();
    let mut rejected = 0;
    for (one, written) in plan.shards.iter().zip(written) {
        rejected += written.rejected;
        if let Some(counts) = parts.iter_mut().find(|p| p.part == one.part) {
            counts.rows += written.surface_rows.iter().sum::<u64>();
        }
        if one.part == SplitPart::Train {
            statistics.merge_sums(written.statistics);
        }
        sources.push((one, written.surface_rows));
        files.push(written.file);
    }
    files.push(pending.write_file("statistics.json", statistics.to_json().as_bytes())?);
    files.push(pending.write_file("surfaces.csv", card::sources_csv(&sources)?.as_bytes())?);
    let left_out = plan.left_out.clone();
    let references = plan.references.clone();
    let mut exported = ExportSummary { parts, left_out, references, waiting: plan.waiting, rejected, files };
    let lake_version = snapshot.lake_version().unwrap_or(0);
    let tags = tags_of_version(lake, lake_version).await?;
    let about = card::CardContents { lake, lake_version, tags, plan, exported: &exported };
    let croissant = croissant::croissant_json(&about)?;
    let readme = card::card_text(&about);
    exported.files.push(pending.write_file("croissant.json", croissant.as_bytes())?);
    exported.files.push(pending.write_file("README.md", readme.as_bytes())?);
    exported.files.sort_by(|a, b| a.name.cmp(&b.name));
    let sums: String = exported.files.iter().map(|f| format!("{}  {}\n", f.sha256, f.name)).collect();
    pending.write_file("SHA256SUMS", sums.as_bytes())?;
    let job = Arc::into_inner(job).ok_or_else(|| Error::write(folder, "a part of the export is still at work"))?;
    job.folder.publish()?;
    Ok(exported)
}

// Names of the version, as the card and the description have them.
async fn tags_of_version(lake: &Lake, version: u64) -> Result<Vec<String>> {
    let versions = lake.list_versions().await?;
    let tags = lake.list_tags().await?.into_iter();
    let named = tags.filter(|tag| versions.iter().any(|known| known.version == version && tag.is_of(known)));
    Ok(named.map(|tag| tag.name.to_string()).collect())
}

/// State shared by the tasks that write files.
struct ExportJob {
    lake: Lake,
    snapshot: LakeSnapshot,
    plan: Plan,
    folder: PendingFolder,
}

// One file per core at a time.
async fn shards_of(job: &Arc<ExportJob>, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<WrittenShard>> {
    let surfaces = |of: &Shard| of.surfaces.len();
    let mut done = 0;
    let total = job.plan.shards.iter().map(surfaces).sum();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let spawn = |at: usize| {
        let job = job.clone();
        tokio::spawn(async move { shard::write_shard(&job, &job.plan.shards[at]).await })
    };
    let stop = AtomicBool::new(false);
    let wanted = (0..job.plan.shards.len()).take_while(|_| !stop.load(Ordering::Relaxed));
    let mut running = futures::stream::iter(wanted).map(spawn).buffered(cores);
    let mut written = Vec::new();
    let mut failed = None;
    // After a failure the running tasks are awaited, because they still write into the folder.
    while let Some(ended) = running.next().await {
        match ended.map_err(|e| Error::write(Path::new(&job.plan.shards[written.len()].name), e)).flatten() {
            Ok(file) if failed.is_none() => {
                done += surfaces(&job.plan.shards[written.len()]);
                progress(done, total);
                written.push(file);
            }
            Ok(_) => {}
            Err(e) => {
                stop.store(true, Ordering::Relaxed);
                failed.get_or_insert(e);
            }
        }
    }
    failed.map_or(Ok(written), Err)
}

fn part_counts(plan: &Plan, part: SplitPart, height_maps: usize) -> PartCounts {
    let panels: HashSet<_> = plan.of_part(part).map(|s| s.id.panel().to_owned()).collect();
    let files = plan.shards.iter().filter(|s| s.part == part).count();
    PartCounts { part, files, panels: panels.len(), surfaces: plan.of_part(part).count(), rows: 0, height_maps }
}
