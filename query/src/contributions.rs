//! What follows from annotations of users in SQL: the function `is_rejected`, and views without the measurements that
//! the last verdict rejects. Rows of users that are still objects of the lake's earlier form stand beside their
//! table's.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use arrow::array::{ArrayRef, AsArray as _, BooleanArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Int32Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::datasource::{MemTable, TableProvider, ViewTable, provider_as_source};
use datafusion::error::{DataFusionError, Result};
use datafusion::functions::utils::make_scalar_function;
use datafusion::logical_expr::expr_fn::SimpleScalarUDF;
use datafusion::logical_expr::{LogicalPlanBuilder, ScalarUDF, Signature, TypeSignature, Volatility, lit, not};
use datafusion::prelude::col;
use echolake_lake::{DataFile, Error as LakeError, Lake, LakeSnapshot};
use echolake_schema::RunId;
use echolake_schema::annotations::{Annotation, RejectedMeasurements};
use echolake_schema::tables::Table;
use object_store::path::Path;
use tokio::sync::Mutex;

use crate::error::repeat_table_fault;
use crate::system::{SystemRows, SystemTable};

/// The function that tells whether a measurement is rejected.
const IS_REJECTED: &str = "is_rejected";

/// Cached files of annotations beyond twice those of a snapshot.
const UNUSED_FILES: usize = 64;

/// A file of annotations, and the runs whose rows are hidden from the reader.
type AnnotationFile = (Path, Vec<RunId>);
/// Annotations in the order of a file, each with the version of the table that added it.
type VersionedAnnotations = Arc<Vec<(u64, Annotation)>>;

/// Annotations by file: files never change, so each is read once.
#[derive(Debug, Default)]
pub(crate) struct AnnotationCache(Mutex<HashMap<AnnotationFile, VersionedAnnotations>>);

impl AnnotationCache {
    /// The verdicts of a snapshot. A fault of the table is kept, for whatever needs them.
    ///
    /// # Errors
    /// What the store says.
    pub async fn find_verdicts(&self, lake: &Lake, snapshot: &LakeSnapshot) -> Result<KnownVerdicts, LakeError> {
        match self.read_files(lake, snapshot, |_| true).await {
            Ok(files) => {
                let rejected = RejectedMeasurements::from_annotations(sorted_annotations(&files));
                Ok(KnownVerdicts { rejected: Arc::new(rejected), fault: None })
            }
            Err(fault) if fault.is_table_fault() => {
                Ok(KnownVerdicts { rejected: Arc::default(), fault: Some(Arc::new(fault)) })
            }
            Err(error) => Err(error),
        }
    }

    /// The annotations on some runs that a snapshot shows, in the order in which they were added.
    ///
    /// # Errors
    /// The table's fault, or what the store says.
    pub async fn read_annotations(
        &self,
        lake: &Lake,
        snapshot: &LakeSnapshot,
        runs: &HashSet<RunId>,
    ) -> Result<Vec<Annotation>, LakeError> {
        let files = self.read_files(lake, snapshot, |file| file.shown_runs().iter().any(|run| runs.contains(run)));
        let files = files.await?;
        let wanted = sorted_annotations(&files).filter(|annotation| runs.contains(&annotation.run_id));
        Ok(wanted.cloned().collect())
    }

    // Those of the lake's earlier form that are no file yet come last.
    async fn read_files(
        &self,
        lake: &Lake,
        snapshot: &LakeSnapshot,
        is_wanted: impl Fn(&DataFile) -> bool,
    ) -> Result<Vec<VersionedAnnotations>, LakeError> {
        snapshot.check_table(Table::Annotations)?;
        let mut known = self.0.lock().await;
        let mut read = HashMap::new();
        for file in snapshot.files(Table::Annotations).iter().filter(|file| is_wanted(file)) {
            let key = (file.path.clone(), file.hidden.clone());
            let annotations = match known.get(&key) {
                Some(known) => known.clone(),
                None => Arc::new(lake.read_annotation_file(file).await?),
            };
            read.insert(key, annotations);
        }
        let pending = lake.pending_annotations(snapshot).await?.into_iter();
        let pending = Arc::new(pending.map(|annotation| (u64::MAX, annotation)).collect());
        let files = read.values().cloned().chain([pending]).collect();
        // Snapshots of the past are read beside the present one.
        if known.len() > 2 * snapshot.files(Table::Annotations).len() + UNUSED_FILES {
            known.clear();
        }
        known.extend(read);
        Ok(files)
    }
}

// The annotations of files in the order in which they were added.
fn sorted_annotations(files: &[VersionedAnnotations]) -> impl Iterator<Item = &Annotation> {
    let mut all: Vec<_> = files.iter().flat_map(|annotations| annotations.iter()).collect();
    all.sort_by_key(|(version, _)| *version);
    all.into_iter().map(|(_, annotation)| annotation)
}

/// The verdicts of a snapshot.
#[derive(Debug, Clone, Default)]
pub(crate) struct KnownVerdicts {
    rejected: Arc<RejectedMeasurements>,
    /// Rows of annotations are lost or cannot be read: nobody knows what is rejected.
    fault: Option<Arc<LakeError>>,
}

impl KnownVerdicts {
    /// Returns whether they cannot be known.
    pub fn is_faulty(&self) -> bool {
        self.fault.is_some()
    }

    fn check_fault(&self) -> Result<()> {
        match self.fault.as_deref().and_then(repeat_table_fault) {
            Some(fault) => Err(DataFusionError::External(fault.into())),
            None => Ok(()),
        }
    }

    /// Returns the function that tells whether a measurement is rejected. That of another snapshot is another one.
    pub fn rejection_function(&self) -> ScalarUDF {
        let pair_types = [DataType::Int32, DataType::Int64];
        let exact = pair_types.map(|pair| TypeSignature::Exact(vec![DataType::Utf8, pair]));
        let signature = Signature::one_of(exact.to_vec(), Volatility::Immutable);
        let verdicts = self.clone();
        let judge = make_scalar_function(move |columns| verdicts.judge_measurements(columns), Vec::new());
        let function = SimpleScalarUDF::new_with_signature(IS_REJECTED, signature, DataType::Boolean, Arc::new(judge));
        ScalarUDF::from(function)
    }

    // Runs and pairs.
    fn judge_measurements(&self, columns: &[ArrayRef]) -> Result<ArrayRef> {
        self.check_fault()?;
        let pairs = cast(&columns[1], &DataType::Int32)?;
        let is_rejected = |(run, pair): (Option<&str>, Option<i32>)| {
            Some(self.rejected.is_rejected(run?, u32::try_from(pair?).ok()?))
        };
        let rows = columns[0].as_string::<i32>().iter().zip(pairs.as_primitive::<Int32Type>()).map(is_rejected);
        Ok(Arc::new(rows.collect::<BooleanArray>()))
    }
}

/// A table whose rows cannot be given, because it is not known which of them are rejected.
#[derive(Debug)]
struct RefusedRows {
    schema: SchemaRef,
    verdicts: KnownVerdicts,
}

#[async_trait]
impl SystemRows for RefusedRows {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    async fn read_rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        self.verdicts.check_fault()?;
        Ok(RecordBatch::new_empty(self.schema.clone()))
    }
}

/// A table of users with its rows that are still objects of the lake's earlier form.
///
/// # Errors
/// [`echolake_lake::Error::DataFile`] if an object is missing or damaged.
pub(crate) async fn with_pending_rows(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    table: Table,
    provider: Arc<dyn TableProvider>,
) -> std::result::Result<Arc<dyn TableProvider>, crate::Error> {
    let Some(rows) = lake.read_pending_rows(snapshot, table).await? else { return Ok(provider) };
    let union = || {
        let pending: Arc<dyn TableProvider> = Arc::new(MemTable::try_new(rows.schema(), vec![vec![rows.clone()]])?);
        let scan = |provider| LogicalPlanBuilder::scan(table.name(), provider_as_source(provider), None);
        scan(provider)?.union(scan(pending)?.build()?)?.build()
    };
    let plan = union().map_err(|e| crate::Error::from_execution("", &e))?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}

/// Leaves the rows of rejected measurements out of a table, and rejected runs out of those with a row per run.
pub(crate) fn without_rejected(
    table: Table,
    provider: Arc<dyn TableProvider>,
    verdicts: &KnownVerdicts,
    snapshot: &LakeSnapshot,
) -> Result<Arc<dyn TableProvider>> {
    let rejected = &verdicts.rejected;
    if rejected.is_empty() && !verdicts.is_faulty() {
        return Ok(provider);
    }
    let keep = match table {
        Table::Measurements | Table::Nce | Table::Tnce | Table::TnceD4 | Table::Runs | Table::SurfaceStats
            if verdicts.is_faulty() =>
        {
            let refused = RefusedRows { schema: provider.schema(), verdicts: verdicts.clone() };
            return Ok(Arc::new(SystemTable(Box::new(refused))));
        }
        Table::Measurements | Table::Nce | Table::Tnce | Table::TnceD4 => {
            not(verdicts.rejection_function().call(vec![col("run_id"), col("pair_id")]))
        }
        Table::Runs | Table::SurfaceStats => {
            let runs = snapshot.runs().filter(|run| rejected.is_run_rejected(run.run.as_str()));
            col("run_id").in_list(runs.map(|run| lit(run.run.as_str())).collect(), true)
        }
        _ => return Ok(provider),
    };
    let plan = LogicalPlanBuilder::scan(table.name(), provider_as_source(provider), None)?.filter(keep)?.build()?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}
