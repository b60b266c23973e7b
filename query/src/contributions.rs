//! What follows from annotations of users in SQL: the function `is_rejected`, and views without the measurements that
//! the last verdict rejects. Rows of users that are still objects of the lake's earlier form stand beside their
//! table's.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::common::utils::take_function_args;
use datafusion::datasource::{MemTable, TableProvider, ViewTable, provider_as_source};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::simplify::{ExprSimplifyResult, SimplifyContext};
use datafusion::logical_expr::{
    ColumnarValue, Expr, LogicalPlanBuilder, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature,
    Volatility, lit, not,
};
use datafusion::prelude::col;
use echolake_lake::{DataFile, Error as LakeError, Lake, LakeSnapshot};
use echolake_schema::RunId;
use echolake_schema::annotations::{Annotation, RejectedMeasurements};
use echolake_schema::tables::Table;
use object_store::path::Path;
use tokio::sync::Mutex;

use crate::error::repeat_table_fault;
use crate::listed_verdicts::ListedVerdicts;
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
            Ok(files) => Ok(KnownVerdicts::from_annotations(&sorted_annotations(&files).collect::<Vec<_>>())),
            Err(fault) if fault.is_table_fault() => {
                Ok(KnownVerdicts { fault: Some(Arc::new(fault)), ..KnownVerdicts::from_annotations(&[]) })
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
#[derive(Debug, Clone)]
pub(crate) struct KnownVerdicts {
    rejected: Arc<RejectedMeasurements>,
    listed: Arc<ListedVerdicts>,
    /// Rows of annotations are lost or cannot be read: nobody knows what is rejected.
    fault: Option<Arc<LakeError>>,
}

impl KnownVerdicts {
    fn from_annotations(annotations: &[&Annotation]) -> Self {
        let rejected = RejectedMeasurements::from_annotations(annotations.iter().copied());
        let runs: BTreeSet<_> = annotations.iter().map(|annotation| annotation.run_id.as_str()).collect();
        let rejection = |run: &str| Some((run.to_owned(), rejected.rejection_text(run)?));
        let listed = ListedVerdicts::from_rejections(runs.into_iter().filter_map(rejection));
        Self { rejected: Arc::new(rejected), listed: Arc::new(listed), fault: None }
    }

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
        ScalarUDF::new_from_impl(RejectionFunction { verdicts: self.clone(), signature })
    }
}

/// `is_rejected(run_id, pair_id)`, as statements name it. The optimizer puts a function in its place whose arguments
/// are the verdicts, or that nothing is rejected, so that no physical plan has it.
#[derive(Debug)]
struct RejectionFunction {
    verdicts: KnownVerdicts,
    signature: Signature,
}

// The same name with other verdicts belongs to another snapshot.
impl PartialEq for RejectionFunction {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.verdicts.listed, &other.verdicts.listed)
    }
}

impl Eq for RejectionFunction {}

impl Hash for RejectionFunction {
    fn hash<H: Hasher>(&self, state: &mut H) {
        IS_REJECTED.hash(state);
    }
}

impl ScalarUDFImpl for RejectionFunction {
    fn name(&self) -> &str {
        IS_REJECTED
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, _: &[DataType]) -> Result<DataType> {
        Ok(DataType::Boolean)
    }

    fn simplify(&self, args: Vec<Expr>, context: &SimplifyContext) -> Result<ExprSimplifyResult> {
        self.verdicts.check_fault()?;
        let [run, pair] = take_function_args(IS_REJECTED, args)?;
        let is_null = context.nullable(&run)? || context.nullable(&pair)?;
        Ok(ExprSimplifyResult::Simplified(match self.verdicts.listed.is_empty() && !is_null {
            true => lit(false),
            false => self.verdicts.listed.rejection_expr(run, pair),
        }))
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        self.verdicts.check_fault()?;
        let rows = args.number_rows;
        let [run, pair] = take_function_args(IS_REJECTED, args.args)?;
        let judged = self.verdicts.listed.judge_measurements(&run.into_array(rows)?, &pair.into_array(rows)?)?;
        Ok(ColumnarValue::Array(Arc::new(judged)))
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
            not(verdicts.listed.rejection_expr(col("run_id"), col("pair_id")))
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
