//! The data files of a table as scans name them, with their statistics: those of files that later snapshots have, too,
//! are made once.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::SystemTime;

use arrow::datatypes::{DataType, SchemaRef};
use datafusion::common::stats::Precision;
use datafusion::common::{ScalarValue, Statistics};
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::parquet::ParquetRowSelection;
use datafusion::error::Result;
use echolake_lake::{DataFile, FileName, VisibleRun};
use echolake_schema::{RunId, SurfaceId};
use object_store::ObjectMeta;
use parquet::arrow::arrow_reader::{RowSelection, RowSelector};

/// The column that tells the runs of a merged file apart.
pub(crate) const RUN: &str = "run_id";
const SURFACE: &str = "surface_id";
/// Delta writers truncate texts in statistics to 32 characters; a shorter text is complete.
const WHOLE_TEXT: usize = 32;
/// Maximum number of files whose statistics are merged for each plan; those of all files are merged once.
const FEW: usize = 8;

/// All files of a table.
#[derive(Debug)]
pub(crate) struct ScanFiles {
    pub files: Vec<Arc<ScanFile>>,
    /// Statistics of all files.
    pub all: Statistics,
}

/// A file with its entry in a scan and its statistics. The tables of later snapshots share it.
#[derive(Debug)]
pub(crate) struct ScanFile {
    pub file: Arc<DataFile>,
    pub part: PartitionedFile,
    pub known: Arc<Statistics>,
}

impl ScanFiles {
    /// Makes the entries of these files of a table with this schema. Those that an earlier snapshot of the same reader
    /// has are kept.
    ///
    /// # Errors
    /// If statistics do not have the schema's columns.
    pub fn new(
        files: &[Arc<DataFile>],
        schema: &SchemaRef,
        is_restricted: bool,
        before: Option<&Self>,
    ) -> Result<Self> {
        // Both are in the order of paths, as snapshots have files; what stands elsewhere is made again.
        let mut known = before.map_or(&[] as &[Arc<ScanFile>], |before| before.files.as_slice()).iter().peekable();
        let mut kept = 0;
        let mut added = Vec::new();
        let mut entries = Vec::with_capacity(files.len());
        for file in files {
            while known.next_if(|known| known.file.path < file.path).is_some() {}
            match known.next_if(|known| is_same_file(&known.file, file)) {
                Some(known) => {
                    kept += 1;
                    entries.push(known.clone());
                }
                None => {
                    let entry = Arc::new(ScanFile::new(file.clone(), schema, is_restricted));
                    added.push(entry.known.clone());
                    entries.push(entry);
                }
            }
        }
        // Statistics are merged one after the other, so that those of files that come can be added to those of all
        // files before, if all of these stay.
        let all = match before.filter(|before| kept > 0 && kept == before.files.len()) {
            Some(before) => {
                let added = added.iter().map(|known| &**known);
                Statistics::try_merge_iter(std::iter::once(&before.all).chain(added), schema)?
            }
            None => Statistics::try_merge_iter(entries.iter().map(|entry| &*entry.known), schema)?,
        };
        Ok(Self { files: entries, all })
    }

    /// Returns whether these are exactly the files.
    pub fn is_of(&self, files: &[Arc<DataFile>]) -> bool {
        self.files.len() == files.len() && self.files.iter().zip(files).all(|(a, b)| is_same_file(&a.file, b))
    }

    /// Returns what is known of some of the files together.
    ///
    /// # Errors
    /// As [`ScanFiles::new`].
    pub fn statistics_of(&self, files: &[&ScanFile], schema: &SchemaRef) -> Result<Statistics> {
        if files.len() == self.files.len() {
            return Ok(self.all.clone());
        }
        if files.len() <= FEW {
            return Statistics::try_merge_iter(files.iter().map(|f| f.known.as_ref()), schema);
        }
        let mut known = Statistics::new_unknown(schema);
        known.num_rows = Precision::Exact(files.iter().map(|f| f.file.rows as usize).sum());
        Ok(known)
    }
}

// Snapshots of one log share what they have in common; those of a file that hides rows are made for each.
fn is_same_file(a: &Arc<DataFile>, b: &Arc<DataFile>) -> bool {
    Arc::ptr_eq(a, b) || a == b
}

impl ScanFile {
    fn new(file: Arc<DataFile>, schema: &SchemaRef, is_restricted: bool) -> Self {
        let part = partitioned_file(&file);
        if !is_restricted || file.hidden.is_empty() {
            let known = Arc::new(file_statistics(&file, schema));
            let part = part.with_statistics(known.clone());
            return Self { file, part, known };
        }
        // The scan's predicate leaves out the hidden rows. Here they are not even read, so that no other predicate
        // meets them and nothing counts them. The selection does not cross the wire. Exact statistics would be taken
        // for those of all rows: a column with one value is not read.
        let known = known_of_parts(&file, schema);
        let part = part.with_statistics(Arc::new(known.clone().to_inexact()));
        let part = part.with_extension(ParquetRowSelection::from(visible_selection(&file)));
        Self { file, part, known: Arc::new(known) }
    }
}

/// Merged files that one filter on runs can read: none of them shows a run that another one hides.
#[derive(Default)]
pub(crate) struct PartlyHidden<'a> {
    pub files: Vec<&'a ScanFile>,
    pub shown: BTreeSet<&'a str>,
    pub hidden: BTreeSet<&'a str>,
}

impl<'a> PartlyHidden<'a> {
    // As few as possible: mostly one.
    pub fn from_files(files: Vec<&'a ScanFile>) -> Vec<Self> {
        let mut all: Vec<Self> = Vec::new();
        for file in files {
            let shown: BTreeSet<_> = file.file.visible_parts().map(|(part, _)| part.run.as_str()).collect();
            let hidden: BTreeSet<_> = file.file.hidden.iter().map(|run| run.as_str()).collect();
            let fits = |parts: &Self| parts.shown.is_disjoint(&hidden) && parts.hidden.is_disjoint(&shown);
            let place = all.iter().position(fits).unwrap_or_else(|| {
                all.push(Self::default());
                all.len() - 1
            });
            let parts = &mut all[place];
            parts.files.push(file);
            parts.shown.extend(shown);
            parts.hidden.extend(hidden);
        }
        all
    }
}

/// Returns a file's entry in a scan, without statistics.
pub(crate) fn partitioned_file(file: &DataFile) -> PartitionedFile {
    PartitionedFile::new_from_meta(ObjectMeta {
        location: file.path.clone(),
        // A name stands for its content, so that what is cached of a file stays valid.
        last_modified: SystemTime::UNIX_EPOCH.into(),
        size: file.bytes,
        e_tag: None,
        version: None,
    })
}

fn visible_selection(file: &DataFile) -> RowSelection {
    let mut selectors = Vec::new();
    let mut end = 0;
    for range in file.visible_ranges() {
        selectors.push(RowSelector::skip(range.start.saturating_sub(end) as usize));
        selectors.push(RowSelector::select(range.end.saturating_sub(range.start) as usize));
        end = range.end;
    }
    selectors.push(RowSelector::skip(file.rows.saturating_sub(end) as usize));
    RowSelection::from(selectors)
}

// Statistics of a file from the log, so that a query for one surface does not open the files of others.
fn file_statistics(file: &DataFile, schema: &SchemaRef) -> Statistics {
    let mut known = Statistics::new_unknown(schema);
    known.num_rows = Precision::Exact(file.rows as usize);
    for (field, column) in schema.fields().iter().zip(&mut known.column_statistics) {
        if !field.is_nullable() {
            column.null_count = Precision::Exact(0);
        }
        let Some(stats) = &file.stats else { continue };
        let kind = field.data_type();
        let least = stats.min.get(field.name()).and_then(|v| scalar_bound(kind, v.as_str(), v.as_i64()));
        let greatest = stats.max.get(field.name()).and_then(|v| scalar_bound(kind, v.as_str(), v.as_i64()));
        if let (Some(least), Some(greatest)) = (least, greatest) {
            column.min_value = Precision::Exact(least);
            column.max_value = Precision::Exact(greatest);
        }
    }
    // Names of runs are too long for the log's extremes.
    let named = if file.hidden.is_empty() { named_runs(file) } else { Vec::new() };
    let surfaces = named.iter().map(|(surface, _)| surface.as_str());
    let runs = named.iter().map(|(_, run)| run.as_str());
    for (name, extremes) in [(SURFACE, text_range(surfaces)), (RUN, text_range(runs))] {
        let Some((column, (least, greatest))) = schema.index_of(name).ok().zip(extremes) else { continue };
        let column = &mut known.column_statistics[column];
        if column.min_value == Precision::Absent {
            column.min_value = Precision::Exact(least);
            column.max_value = Precision::Exact(greatest);
        }
    }
    known
}

// The surfaces and runs with rows, as a file's name or its parts tell.
fn named_runs(file: &DataFile) -> Vec<(SurfaceId, RunId)> {
    match &file.name {
        Some(FileName::Rows { surface, run, .. } | FileName::Pointer(VisibleRun { surface, run, .. }))
            if file.rows > 0 =>
        {
            vec![(surface.clone(), run.clone())]
        }
        Some(FileName::Merged { .. }) => {
            let parts = file.visible_parts().map(|(part, _)| part).filter(|part| part.rows > 0);
            parts.map(|part| (part.surface.clone(), part.run.clone())).collect()
        }
        _ => Vec::new(),
    }
}

fn text_range<'a>(texts: impl Iterator<Item = &'a str>) -> Option<(ScalarValue, ScalarValue)> {
    let texts: BTreeSet<_> = texts.collect();
    Some((ScalarValue::from(*texts.first()?), ScalarValue::from(*texts.last()?)))
}

// The log's extremes are those of hidden rows, too; of the rows that are seen, the parts tell surfaces and runs.
fn known_of_parts(file: &DataFile, schema: &SchemaRef) -> Statistics {
    let mut known = Statistics::new_unknown(schema);
    known.num_rows = Precision::Exact(file.visible_rows() as usize);
    let surfaces = file.visible_parts().map(|(part, _)| part.surface.as_str());
    let runs = file.visible_parts().map(|(part, _)| part.run.as_str());
    for (name, extremes) in [(SURFACE, text_range(surfaces)), (RUN, text_range(runs))] {
        let Some((column, (least, greatest))) = schema.index_of(name).ok().zip(extremes) else { continue };
        let column = &mut known.column_statistics[column];
        column.null_count = Precision::Exact(0);
        column.min_value = Precision::Exact(least);
        column.max_value = Precision::Exact(greatest);
    }
    known
}

// Only for integers and texts, as keys are. JSON does not represent every float exactly, so the file's own statistics
// serve for those.
fn scalar_bound(kind: &DataType, text: Option<&str>, int: Option<i64>) -> Option<ScalarValue> {
    match kind {
        DataType::Utf8 => text.filter(|t| t.chars().count() < WHOLE_TEXT).map(ScalarValue::from),
        DataType::Int32 => int.and_then(|v| i32::try_from(v).ok()).map(ScalarValue::from),
        DataType::Int64 => int.map(ScalarValue::from),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use arrow::datatypes::{Field, Schema};
    use echolake_lake::RunPart;
    use object_store::path::Path;

    use super::*;

    // A file of one row for each of these runs.
    fn data_file(name: &str, runs: &[&str], hidden: &[&str]) -> Arc<DataFile> {
        let id = |run: &&str| -> RunId { run.parse().expect("an id") };
        let part = |run: &&str| RunPart {
            surface: "flat".parse().expect("an id"),
            run: id(run),
            derivation: "ab".to_owned(),
            rows: 1,
            row_version: None,
            row_counts: None,
        };
        let path = Path::from(format!("tables/events/merged.{name}.parquet"));
        Arc::new(DataFile {
            name: FileName::parse(&path),
            path,
            bytes: 1,
            rows: runs.len() as u64,
            log_version: 0,
            seen_runs: 0,
            stats: None,
            parts: runs.iter().map(part).collect(),
            hidden: hidden.iter().map(id).collect(),
            row_counts: None,
        })
    }

    fn merged_file(runs: &[&str], hidden: &[&str]) -> ScanFile {
        ScanFile::new(data_file("ab", runs, hidden), &Arc::new(Schema::empty()), true)
    }

    #[test]
    fn what_an_earlier_snapshot_knows_of_files_is_kept_and_equals_what_is_made_of_all() {
        let column = |name| Field::new(name, DataType::Utf8, false);
        let schema: SchemaRef = Arc::new(Schema::new(vec![column(SURFACE), column(RUN)]));
        let check = |before: &ScanFiles, files: &[Arc<DataFile>], kept: usize| {
            let after = ScanFiles::new(files, &schema, true, Some(before)).expect("entries");
            let of_all = ScanFiles::new(files, &schema, true, None).expect("entries");
            assert_eq!(after.all, of_all.all);
            let is_kept = |file: &&Arc<ScanFile>| before.files.iter().any(|known| Arc::ptr_eq(known, file));
            assert_eq!(after.files.iter().filter(is_kept).count(), kept);
            assert!(after.is_of(files));
            after
        };
        let none = ScanFiles::new(&[], &schema, true, None).expect("entries");
        let b = || data_file("b", &["r3"], &[]);
        let files = [data_file("a", &["r1", "r5"], &[]), b(), data_file("c", &["r2", "r7"], &["r2"])];
        let first = check(&none, &files[..2], 0);
        let all = check(&first, &files, 2);
        check(&all, &[files[0].clone(), b(), files[2].clone()], 3);
        check(&all, &[files[0].clone(), data_file("c", &["r2", "r7"], &[])], 1);
        check(&all, &files[1..], 2);
        check(&all, &[], 0);
    }

    #[test]
    fn one_filter_reads_files_that_agree_on_what_is_hidden() {
        let files = [
            merged_file(&["a", "b", "c"], &["b"]),
            merged_file(&["d", "e"], &["e"]),
            merged_file(&["b", "f"], &["f"]),
            merged_file(&["g", "b"], &["b"]),
        ];
        let groups = PartlyHidden::from_files(files.iter().collect());
        let runs: Vec<_> = groups.iter().map(|parts| parts.shown.iter().copied().collect::<String>()).collect();
        assert_eq!(runs, ["acdg", "b"]);
        assert_eq!(groups.iter().map(|parts| parts.files.len()).collect::<Vec<_>>(), [3, 1]);
    }

    #[test]
    fn hidden_rows_are_neither_selected_nor_known() {
        let file = merged_file(&["a", "b", "c", "d"], &["a", "c"]);
        let selectors: Vec<RowSelector> = visible_selection(&file.file).into();
        let rows: Vec<_> = selectors.iter().map(|s| (s.skip, s.row_count)).collect();
        assert_eq!(rows, [(true, 1), (false, 1), (true, 1), (false, 1)]);
        assert!(file.part.extension::<ParquetRowSelection>().is_some());
        assert_eq!(file.part.statistics.expect("known").num_rows, Precision::Inexact(2));
    }
}
