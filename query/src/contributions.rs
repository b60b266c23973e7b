//! What follows from annotations of users in SQL: the function `is_rejected`, and views without the measurements that
//! the last verdict rejects. Rows of users that are still objects of the lake's earlier form stand beside their
//! table's.

use std::collections::{HashMap, HashSet};
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{AsArray as _, BooleanArray};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Int32Type, SchemaRef};
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::datasource::{MemTable, TableProvider, TableType, ViewTable, provider_as_source};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{
    ColumnarValue, Expr, LogicalPlanBuilder, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature,
    Volatility, lit, not,
};
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::empty::EmptyExec;
use datafusion::prelude::col;
use echolake_lake::{DataFile, Error as LakeError, Lake, LakeSnapshot};
use echolake_schema::RunId;
use echolake_schema::annotations::{Annotation, RejectedMeasurements};
use echolake_schema::tables::Table;
use object_store::path::Path;
use tokio::sync::Mutex;

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
        match self.find_rejected(lake, snapshot).await {
            Ok(rejected) => Ok(KnownVerdicts { rejected: Arc::new(rejected), fault: None }),
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
        let pending = lake.pending_annotations(snapshot).await?;
        let all = versioned_annotations(&files).chain(&pending);
        Ok(all.filter(|annotation| runs.contains(&annotation.run_id)).cloned().collect())
    }

    async fn find_rejected(&self, lake: &Lake, snapshot: &LakeSnapshot) -> Result<RejectedMeasurements, LakeError> {
        let files = self.read_files(lake, snapshot, |_| true).await?;
        let pending = lake.pending_annotations(snapshot).await?;
        Ok(RejectedMeasurements::from_annotations(versioned_annotations(&files).chain(&pending)))
    }

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
        let files = read.values().cloned().collect();
        // Snapshots of the past are read beside the present one.
        if known.len() > 2 * snapshot.files(Table::Annotations).len() + UNUSED_FILES {
            known.clear();
        }
        known.extend(read);
        Ok(files)
    }
}

// The annotations of files in the order in which they were added.
fn versioned_annotations(files: &[VersionedAnnotations]) -> impl Iterator<Item = &Annotation> {
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
        let Some(fault) = &self.fault else { return Ok(()) };
        let fault = match fault.as_ref() {
            LakeError::Incomplete { table, found } => LakeError::Incomplete { table, found: found.clone() },
            LakeError::Log { table, action, source } => {
                LakeError::Log { table, action, source: source.to_string().into() }
            }
            LakeError::DataFile { file, source } => {
                LakeError::DataFile { file: file.clone(), source: source.to_string().into() }
            }
            other => LakeError::Incomplete { table: Table::Annotations.name(), found: other.to_string() },
        };
        Err(DataFusionError::External(fault.into()))
    }

    /// Returns the function that tells whether a measurement is rejected.
    pub fn rejection_function(&self) -> ScalarUDF {
        let pair_types = [DataType::Int32, DataType::Int64];
        let exact = pair_types.map(|pair| TypeSignature::Exact(vec![DataType::Utf8, pair]));
        let signature = Signature::one_of(exact.to_vec(), Volatility::Immutable);
        ScalarUDF::from(IsRejected { verdicts: self.clone(), signature })
    }
}

/// A table whose rows cannot be given, because it is not known which of them are rejected.
#[derive(Debug)]
struct RefusedTable {
    schema: SchemaRef,
    verdicts: KnownVerdicts,
}

#[async_trait]
impl TableProvider for RefusedTable {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    fn table_type(&self) -> TableType {
        TableType::Base
    }

    async fn scan(
        &self,
        _: &dyn Session,
        _: Option<&Vec<usize>>,
        _: &[Expr],
        _: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        self.verdicts.check_fault()?;
        Ok(Arc::new(EmptyExec::new(self.schema.clone())))
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
            return Ok(Arc::new(RefusedTable { schema: provider.schema(), verdicts: verdicts.clone() }));
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
    filter_table(table.name(), provider, |plan| plan.filter(keep))
}

fn filter_table(
    name: &str,
    provider: Arc<dyn TableProvider>,
    filter: impl FnOnce(LogicalPlanBuilder) -> Result<LogicalPlanBuilder>,
) -> Result<Arc<dyn TableProvider>> {
    let plan = filter(LogicalPlanBuilder::scan(name, provider_as_source(provider), None)?)?.build()?;
    Ok(Arc::new(ViewTable::new(plan, None)))
}

/// `is_rejected(run_id, pair_id)`.
#[derive(Debug)]
struct IsRejected {
    verdicts: KnownVerdicts,
    signature: Signature,
}

// The same name with other verdicts belongs to another snapshot.
impl PartialEq for IsRejected {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.verdicts.rejected, &other.verdicts.rejected)
    }
}

impl Eq for IsRejected {}

impl Hash for IsRejected {
    fn hash<H: Hasher>(&self, state: &mut H) {
        IS_REJECTED.hash(state);
    }
}

impl ScalarUDFImpl for IsRejected {
    fn name(&self) -> &str {
        IS_REJECTED
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn return_type(&self, _arguments: &[DataType]) -> Result<DataType> {
        Ok(DataType::Boolean)
    }

    fn invoke_with_args(&self, args: ScalarFunctionArgs) -> Result<ColumnarValue> {
        self.verdicts.check_fault()?;
        let columns = args.args.iter().map(|a| a.to_array(args.number_rows)).collect::<Result<Vec<_>>>()?;
        let pairs = cast(&columns[1], &DataType::Int32)?;
        let pairs = pairs.as_primitive::<Int32Type>();
        let is_rejected = |(run, pair): (Option<&str>, Option<i32>)| {
            Some(self.verdicts.rejected.is_rejected(run?, u32::try_from(pair?).ok()?))
        };
        let rows: BooleanArray = columns[0].as_string::<i32>().iter().zip(pairs).map(is_rejected).collect();
        Ok(ColumnarValue::Array(Arc::new(rows)))
    }
}
