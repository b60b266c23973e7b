//! Contributions of users in SQL: the tables `annotations` and `predictions`, and the views without the
//! measurements that the last verdict rejects.

use std::collections::HashSet;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

use arrow::array::{
    AsArray as _, BooleanArray, BooleanBuilder, Int32Builder, Int64Array, ListBuilder, RecordBatch, StringArray,
    TimestampMicrosecondArray,
};
use arrow::compute::{cast, filter_record_batch};
use arrow::datatypes::{DataType, Field, Int32Type, SchemaRef};
use bytes::Bytes;
use datafusion::datasource::{MemTable, TableProvider, ViewTable, provider_as_source};
use datafusion::error::Result;
use datafusion::logical_expr::{
    ColumnarValue, LogicalPlanBuilder, ScalarFunctionArgs, ScalarUDF, ScalarUDFImpl, Signature, TypeSignature,
    Volatility, lit, not,
};
use datafusion::prelude::col;
use echolake_lake::{ContributionCounts, ContributionLog, Lake, LakeSnapshot};
use echolake_lake_tables::{FileReaders, ParquetFiles};
use echolake_schema::annotations::{Annotation, RejectedMeasurements};
use echolake_schema::tables::{LIST_CHILD, Table, annotation_schema, prediction_schema};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use tokio::sync::Mutex;

/// The function that tells whether a measurement is rejected.
const IS_REJECTED: &str = "is_rejected";

/// Annotations of a lake, read once: objects of the log never change.
#[derive(Debug, Default)]
pub(crate) struct AnnotationCache(Mutex<KnownAnnotations>);

#[derive(Debug, Default, Clone)]
struct KnownAnnotations {
    /// The highest number that was read.
    up_to: u64,
    all: Arc<Vec<Arc<Annotation>>>,
}

impl AnnotationCache {
    /// The annotations up to a number, by number.
    pub async fn read_up_to(&self, lake: &Lake, number: u64) -> echolake_lake::Result<Arc<Vec<Arc<Annotation>>>> {
        let mut known = self.0.lock().await;
        if number > known.up_to {
            let new = lake.read_annotations(known.up_to, number).await?;
            let mut all = known.all.as_ref().clone();
            all.extend(new.into_iter().map(Arc::new));
            *known = KnownAnnotations { up_to: number, all: Arc::new(all) };
        }
        if number == known.up_to {
            return Ok(known.all.clone());
        }
        let end = known.all.partition_point(|annotation| annotation.number <= number);
        Ok(Arc::new(known.all[..end].to_vec()))
    }
}

/// The contributions of one snapshot.
pub(crate) struct SeenContributions {
    /// Measurements that are rejected.
    pub rejected: Arc<RejectedMeasurements>,
    /// The tables by name.
    pub tables: [(&'static str, Arc<dyn TableProvider>); 2],
}

impl SeenContributions {
    /// Reads those of these numbers, on the runs and surfaces that it shows.
    ///
    /// # Errors
    /// Those of the store, and [`echolake_lake::Error::LostContribution`].
    pub async fn read_from(
        lake: &Lake,
        cache: &AnnotationCache,
        snapshot: &LakeSnapshot,
        counts: ContributionCounts,
        source: &FileReaders,
    ) -> std::result::Result<Self, crate::Error> {
        let annotations = cache.read_up_to(lake, counts.annotations).await?;
        let failed = |e| crate::Error::from_execution("", &e);
        let rejected = RejectedMeasurements::from_annotations(annotations.iter().map(AsRef::as_ref));
        let annotated = annotation_table(lake, &annotations, snapshot).map_err(failed)?;
        let mut files = lake.list_contributions(ContributionLog::Predictions, counts.predictions).await?;
        // One that was lost may have an empty file in its place.
        files.retain(|file| file.bytes > 0);
        let schema = prediction_schema(lake.rig());
        let predicted: Arc<dyn TableProvider> = match lake.is_restricted() {
            false => {
                let files = files.into_iter().map(|file| (file.path, file.bytes));
                Arc::new(ParquetFiles::new(schema, files, source.clone()))
            }
            true => {
                let mut rows = Vec::new();
                for file in files {
                    let bytes = lake.read_contribution(ContributionLog::Predictions, file.number).await?;
                    rows.extend(visible_predictions(bytes, &schema, snapshot).map_err(failed)?);
                }
                Arc::new(MemTable::try_new(schema, vec![rows]).map_err(failed)?)
            }
        };
        let tables =
            [(ContributionLog::Annotations.name(), annotated), (ContributionLog::Predictions.name(), predicted)];
        Ok(Self { rejected: Arc::new(rejected), tables })
    }

    /// Returns the function that tells whether a measurement is rejected.
    pub fn rejection_function(&self) -> ScalarUDF {
        rejection_function(&self.rejected)
    }
}

fn annotation_table(
    lake: &Lake,
    annotations: &[Arc<Annotation>],
    snapshot: &LakeSnapshot,
) -> Result<Arc<dyn TableProvider>> {
    let seen: Vec<_> = annotations.iter().filter_map(|a| Some((a, snapshot.run(&a.run_id)?))).collect();
    let mut pairs = ListBuilder::new(Int32Builder::new()).with_field(Field::new(LIST_CHILD, DataType::Int32, false));
    for (annotation, _) in &seen {
        match &annotation.pair_ids {
            Some(ids) => {
                pairs.values().append_slice(&ids.iter().map(|id| *id as i32).collect::<Vec<_>>());
                pairs.append(true);
            }
            None => pairs.append(false),
        }
    }
    let times = TimestampMicrosecondArray::from_iter_values(seen.iter().map(|(a, _)| a.time.timestamp_micros()));
    let texts = |text: fn(&Annotation) -> &str| {
        Arc::new(StringArray::from_iter_values(seen.iter().map(|(annotation, _)| text(annotation))))
    };
    // How many versions others add is none of the business of a reader of some projects.
    let version = |a: &Annotation| (!lake.is_restricted()).then_some(a.lake_version as i64);
    let versions: Int64Array = seen.iter().map(|(annotation, _)| version(annotation)).collect();
    let schema = annotation_schema();
    let batch = RecordBatch::try_new(
        schema.clone(),
        vec![
            Arc::new(StringArray::from_iter_values(seen.iter().map(|(_, run)| run.surface.as_str()))),
            texts(|annotation| annotation.run_id.as_str()),
            Arc::new(pairs.finish()),
            texts(|annotation| annotation.kind.name()),
            texts(|annotation| &annotation.value),
            texts(|annotation| &annotation.comment),
            texts(|annotation| &annotation.author),
            Arc::new(times.with_timezone("UTC")),
            Arc::new(versions),
            texts(|annotation| &annotation.annotation_id),
        ],
    )?;
    Ok(Arc::new(MemTable::try_new(schema, vec![vec![batch]])?))
}

// A reader of some projects sees predictions of their surfaces alone, and no plan that counts others.
fn visible_predictions(bytes: Bytes, schema: &SchemaRef, snapshot: &LakeSnapshot) -> Result<Vec<RecordBatch>> {
    let surfaces: HashSet<&str> = snapshot.runs().map(|run| run.surface.as_str()).collect();
    let column = schema.index_of("surface_id")?;
    let mut visible = Vec::new();
    for batch in ParquetRecordBatchReaderBuilder::try_new(bytes)?.build()? {
        let batch = batch?.with_schema(schema.clone())?;
        let mut is_visible = BooleanBuilder::new();
        let named = batch.column(column).as_string::<i32>().iter();
        named.for_each(|surface| is_visible.append_value(surface.is_some_and(|id| surfaces.contains(id))));
        let rows = filter_record_batch(&batch, &is_visible.finish())?;
        visible.push(rows);
    }
    Ok(visible)
}

/// Leaves the rows of rejected measurements out of a table, and rejected runs out of those with a row per run.
pub(crate) fn without_rejected(
    table: Table,
    provider: Arc<dyn TableProvider>,
    rejected: &Arc<RejectedMeasurements>,
    snapshot: &LakeSnapshot,
) -> Result<Arc<dyn TableProvider>> {
    if rejected.is_empty() {
        return Ok(provider);
    }
    let keep = match table {
        Table::Measurements | Table::Nce | Table::Tnce | Table::TnceD4 => {
            not(rejection_function(rejected).call(vec![col("run_id"), col("pair_id")]))
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

fn rejection_function(rejected: &Arc<RejectedMeasurements>) -> ScalarUDF {
    let pair_types = [DataType::Int32, DataType::Int64];
    let exact = pair_types.map(|pair| TypeSignature::Exact(vec![DataType::Utf8, pair]));
    let signature = Signature::one_of(exact.to_vec(), Volatility::Immutable);
    ScalarUDF::from(IsRejected { rejected: rejected.clone(), signature })
}

/// `is_rejected(run_id, pair_id)`.
#[derive(Debug)]
struct IsRejected {
    rejected: Arc<RejectedMeasurements>,
    signature: Signature,
}

// The same name with other verdicts belongs to another snapshot.
impl PartialEq for IsRejected {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.rejected, &other.rejected)
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
        let columns = args.args.iter().map(|a| a.to_array(args.number_rows)).collect::<Result<Vec<_>>>()?;
        let pairs = cast(&columns[1], &DataType::Int32)?;
        let pairs = pairs.as_primitive::<Int32Type>();
        let is_rejected = |(run, pair): (Option<&str>, Option<i32>)| {
            Some(self.rejected.is_rejected(run?, u32::try_from(pair?).ok()?))
        };
        let rows: BooleanArray = columns[0].as_string::<i32>().iter().zip(pairs).map(is_rejected).collect();
        Ok(ColumnarValue::Array(Arc::new(rows)))
    }
}
