//! The messages of one topic as a table, whose rows come from many files.

use std::collections::{BTreeSet, HashMap};
use std::ops::RangeInclusive;
use std::sync::Arc;

use arrow::array::{AsArray as _, StringArray};
use arrow::datatypes::{Field, Schema, SchemaRef};
use arrow::record_batch::RecordBatch;
use datafusion::catalog::{Session, TableProvider};
use datafusion::common::{DFSchema, ScalarValue};
use datafusion::datasource::TableType;
use datafusion::error::Result;
use datafusion::logical_expr::{BinaryExpr, Expr, Operator, TableProviderFilterPushDown};
use datafusion::physical_plan::ExecutionPlan;
use echolake_lake_tables::boxed_scan;
use futures::FutureExt as _;
use futures::future::ready;

use super::encodings::{MessageLayout, RawSchema, is_supported};
use super::error::Fault;
use super::file::{Channel, McapFile, McapFiles};
use super::rows::{Head, Mapping};
use super::scan::{McapExec, Parts, Scan, ScanPiece, Source};
use super::target::Target;

/// Topics that a hint lists.
const LISTED: usize = 20;
/// Largest schema that is looked into, in bytes; the descriptors of all messages of a large robot are a tenth of it.
const LARGEST_SCHEMA: usize = 4 << 20;
/// What a column of a message is called where one in front of it has its name already.
const PREFIX: &str = "message_";

/// Messages of some files.
#[derive(Debug)]
pub(super) struct McapTable {
    pub schema: SchemaRef,
    pub parts: Arc<Parts>,
}

/// The table of a topic's messages, a column a field.
pub(super) fn decoded_table(targets: Vec<Target>, topic: &str, files: &Arc<McapFiles>) -> Result<McapTable, Fault> {
    let channels_of = |target: &Target| -> Vec<(u16, Channel)> {
        let meant = target.file.channels.iter().filter(|(_, channel)| channel.topic == topic);
        meant.map(|(id, channel)| (*id, channel.clone())).collect()
    };
    let layouts = Layouts::of_channels(&targets, topic, channels_of)?;
    if layouts.all.is_empty() {
        return Err(no_topic(&targets, topic));
    }
    let source = |target: &Target| {
        let mapped =
            |(id, channel): (u16, Channel)| Some((id, (topic.to_owned(), *layouts.known.get(&channel.schema)?)));
        let channels = channels_of(target).into_iter().filter_map(mapped).collect();
        Source::new(target.run.clone(), target.file.clone(), channels)
    };
    let sources = targets.iter().map(source).collect();
    let heads = Head::OF_COLUMNS.to_vec();
    let (schema, mappings) = layouts.into_schema(&heads, topic)?;
    let parts = Parts { topic: Some(topic.to_owned()), files: files.clone(), heads, sources, mappings: Some(mappings) };
    Ok(McapTable { schema, parts: Arc::new(parts) })
}

/// The table of messages as they are, of one topic or of all.
pub(super) fn message_table(
    targets: Vec<Target>,
    topic: Option<&str>,
    files: &Arc<McapFiles>,
) -> Result<McapTable, Fault> {
    let known = |t: &Target| t.file.channels.values().any(|c| topic.is_none_or(|topic| c.topic == topic));
    if let Some(topic) = topic.filter(|_| !targets.iter().any(known)) {
        return Err(no_topic(&targets, topic));
    }
    let source = |target: Target| {
        let meant = target.file.channels.iter().filter(|(_, c)| topic.is_none_or(|topic| c.topic == topic));
        let channels = meant.map(|(id, c)| (*id, (c.topic.clone(), 0))).collect();
        Source::new(target.run, target.file, channels)
    };
    let heads = Head::OF_MESSAGES.to_vec();
    let schema = Arc::new(Schema::new(heads.iter().map(|h| h.column_field()).collect::<Vec<_>>()));
    let sources = targets.into_iter().map(source).collect();
    let topic = topic.map(str::to_owned);
    let parts = Parts { topic, files: files.clone(), heads, sources, mappings: None };
    Ok(McapTable { schema, parts: Arc::new(parts) })
}

fn no_topic(targets: &[Target], topic: &str) -> Fault {
    let topics: BTreeSet<_> = targets.iter().flat_map(|t| t.file.channels.values().map(|c| c.topic.as_str())).collect();
    let more = if topics.len() > LISTED { ", ...; mcap_topics lists all" } else { "" };
    let listed: Vec<_> = topics.into_iter().take(LISTED).collect();
    let hint = match listed.is_empty() {
        true => "there are no topics in it".to_owned(),
        false => format!("the topics are {}{more}", listed.join(", ")),
    };
    Fault::invalid_call(format!("no topic `{topic}`"), hint)
}

/// The different schemas that a topic has in the files, and the first file of each.
#[derive(Default)]
struct Layouts {
    known: HashMap<Arc<RawSchema>, usize>,
    all: Vec<SchemaLayout>,
}

/// The layout of a schema, and the first file that has it.
struct SchemaLayout {
    file: String,
    layout: Arc<MessageLayout>,
}

impl Layouts {
    // A channel without messages adds its columns if they are known and fit those of the others. One with messages in
    // an encoding that is not known has rows, if another channel of the topic has columns.
    fn of_channels(
        targets: &[Target],
        topic: &str,
        channels_of: impl Fn(&Target) -> Vec<(u16, Channel)>,
    ) -> Result<Self, Fault> {
        let mut layouts = Self::default();
        let mut refusals = Vec::new();
        let mut empty = Vec::new();
        for target in targets {
            for (_, channel) in channels_of(target) {
                if channel.messages == Some(0) {
                    empty.push((target, channel.schema));
                } else if !layouts.known.contains_key(&channel.schema) {
                    match layout_of(&target.file, topic, &channel.schema) {
                        Ok(layout) => layouts.add_layout(&target.file, &channel.schema, layout),
                        Err(refusal) => refusals.push((target, channel.schema, refusal)),
                    }
                }
            }
        }
        let mut refusal_of_empty = None;
        for (target, schema) in empty {
            if layouts.known.contains_key(&schema) {
                continue;
            }
            match layout_of(&target.file, topic, &schema) {
                Ok(layout) if layouts.fits_others(&layout) => layouts.add_layout(&target.file, &schema, layout),
                Ok(_) => {}
                Err(refusal) => refusal_of_empty = refusal_of_empty.or(Some(refusal)),
            }
        }
        for (target, schema, refusal) in refusals {
            if layouts.all.is_empty() || is_supported(&schema) {
                return Err(refusal);
            }
            layouts.add_layout(&target.file, &schema, MessageLayout::without_columns());
        }
        match refusal_of_empty {
            Some(refusal) if layouts.all.is_empty() => Err(refusal),
            _ => Ok(layouts),
        }
    }

    fn add_layout(&mut self, file: &McapFile, schema: &Arc<RawSchema>, layout: MessageLayout) {
        self.known.insert(schema.clone(), self.all.len());
        self.all.push(SchemaLayout { file: file.path.to_string(), layout: Arc::new(layout) });
    }

    // Whether no column has another type than one of its name in the others.
    fn fits_others(&self, layout: &MessageLayout) -> bool {
        let clashes = |field: &Arc<Field>| {
            let mut others = self.all.iter().filter_map(|other| other.layout.fields.find(field.name()));
            others.any(|(_, other)| other != field)
        };
        !layout.fields.iter().any(clashes)
    }

    // The columns of all schemas: those of one name are one column, which a schema may lack.
    fn into_schema(self, heads: &[Head], topic: &str) -> Result<(SchemaRef, Vec<Mapping>), Fault> {
        let mut fields: Vec<Field> = heads.iter().map(|h| h.column_field()).collect();
        let taken: BTreeSet<String> = fields.iter().map(|f| f.name().clone()).collect();
        let own_names: BTreeSet<String> =
            self.all.iter().flat_map(|one| one.layout.fields.iter().map(|f| f.name().clone())).collect();
        let mut places: Vec<HashMap<usize, usize>> = Vec::new();
        for SchemaLayout { file, layout } in &self.all {
            let mut of = HashMap::new();
            for (i, field) in layout.fields.iter().enumerate() {
                let mut name = field.name().clone();
                // Neither a column of every message nor another field of the messages.
                while taken.contains(&name) || (name != *field.name() && own_names.contains(&name)) {
                    name = format!("{PREFIX}{name}");
                }
                let field = field.as_ref().clone().with_name(name);
                let own = &fields[heads.len()..];
                match own.iter().position(|f| f.name() == field.name()) {
                    Some(known) if own[known] == field => drop(of.insert(known, i)),
                    Some(known) => {
                        return Err(Fault::Conflict {
                            file: file.clone(),
                            topic: topic.to_owned(),
                            column: field.name().clone(),
                            one: field.data_type().to_string(),
                            other: own[known].data_type().to_string(),
                        });
                    }
                    None => {
                        of.insert(own.len(), i);
                        fields.push(field);
                    }
                }
            }
            places.push(of);
        }
        let own = fields.len() - heads.len();
        let mapping = |(one, of): (SchemaLayout, HashMap<usize, usize>)| Mapping {
            layout: one.layout,
            columns: (0..own).map(|i| of.get(&i).copied()).collect(),
        };
        Ok((Arc::new(Schema::new(fields)), self.all.into_iter().zip(places).map(mapping).collect()))
    }
}

fn layout_of(file: &McapFile, topic: &str, schema: &RawSchema) -> Result<MessageLayout, Fault> {
    let layout = match schema.data.len() {
        ..=LARGEST_SCHEMA => MessageLayout::from_schema(schema),
        bytes => Err(format!("its schema has {bytes} bytes, more than {LARGEST_SCHEMA}")),
    };
    layout.map_err(|what| Fault::Schema { file: file.path.to_string(), topic: topic.to_owned(), what })
}

impl TableProvider for McapTable {
    fn schema(&self) -> SchemaRef {
        self.schema.clone()
    }

    fn table_type(&self) -> TableType {
        TableType::Temporary
    }

    fn supports_filters_pushdown(&self, filters: &[&Expr]) -> Result<Vec<TableProviderFilterPushDown>> {
        let one = |filter: &&Expr| match times_of(filter).is_some() || is_of_runs(filter) {
            true => TableProviderFilterPushDown::Exact,
            false => TableProviderFilterPushDown::Unsupported,
        };
        Ok(filters.iter().map(one).collect())
    }

    boxed_scan!(self, state, projection, filters, limit => {
        ready(self.scan_messages(state, projection, filters, limit)).boxed()
    });
}

impl McapTable {
    fn scan_messages(
        &self,
        state: &dyn Session,
        projection: Option<&Vec<usize>>,
        filters: &[Expr],
        limit: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let times = filters.iter().filter_map(times_of).reduce(intersect_ranges);
        let shown = self.shown_sources(filters.iter().filter(|f| is_of_runs(f)), state)?;
        let sources = &self.parts.sources;
        let shown = sources.iter().enumerate().filter(|(source, _)| shown[*source]);
        let pieces = shown.flat_map(|(source, of)| {
            of.pieces_within(times.as_ref()).map(move |piece| ScanPiece { source, piece: piece.clone() })
        });
        let pieces = pieces.collect();
        let projection = projection.cloned().unwrap_or_else(|| (0..self.schema.fields().len()).collect());
        let schema = Arc::new(self.schema.project(&projection)?);
        let scan = Scan { parts: self.parts.clone(), schema, projection, times, limit };
        Ok(Arc::new(McapExec::new(scan, pieces, state.config().target_partitions())))
    }

    // Which files pass the filters of surface and run.
    fn shown_sources<'a>(&self, filters: impl Iterator<Item = &'a Expr>, state: &dyn Session) -> Result<Vec<bool>> {
        let schema = Arc::new(Schema::new(vec![Head::Surface.column_field(), Head::Run.column_field()]));
        let of = |s: &Source| s.run.clone().unzip();
        let (surfaces, runs): (Vec<_>, Vec<_>) = self.parts.sources.iter().map(of).unzip();
        let columns: [StringArray; 2] = [surfaces.into_iter().collect(), runs.into_iter().collect()];
        let columns = columns.map(|c| Arc::new(c) as _).to_vec();
        let batch = RecordBatch::try_new(schema.clone(), columns)?;
        let named = DFSchema::try_from(schema)?;
        let mut shown = vec![true; batch.num_rows()];
        for filter in filters {
            let passes = state.create_physical_expr(filter.clone(), &named)?.evaluate(&batch)?;
            let passes = passes.into_array(batch.num_rows())?;
            let Some(passes) = passes.as_boolean_opt() else { continue };
            shown.iter_mut().zip(passes).for_each(|(shown, passes)| *shown &= passes == Some(true));
        }
        Ok(shown)
    }
}

// Whether a filter asks for nothing but surface and run, so that it tells which files to read.
fn is_of_runs(filter: &Expr) -> bool {
    let names = filter.column_refs();
    let later = |e: &Expr| {
        matches!(
            e,
            Expr::ScalarSubquery(_)
                | Expr::Exists(_)
                | Expr::InSubquery(_)
                | Expr::Placeholder(_)
                | Expr::OuterReferenceColumn(..)
        )
    };
    !names.is_empty()
        && names.iter().all(|c| matches!(c.name.as_str(), "surface_id" | "run_id"))
        && !filter.is_volatile()
        && !datafusion::common::tree_node::TreeNode::exists(filter, |e| Ok(later(e))).unwrap_or(true)
}

// The times, ns, that a comparison of `log_time` or `log_time_ns` with a number lets pass.
fn times_of(filter: &Expr) -> Option<RangeInclusive<i64>> {
    match filter {
        Expr::BinaryExpr(BinaryExpr { left, op: Operator::And, right }) => {
            Some(intersect_ranges(times_of(left)?, times_of(right)?))
        }
        Expr::BinaryExpr(BinaryExpr { left, op, right }) if is_time(left) => comparison_range(*op, nanos_of(right)?),
        Expr::BinaryExpr(BinaryExpr { left, op, right }) if is_time(right) => {
            comparison_range(op.swap()?, nanos_of(left)?)
        }
        Expr::Between(between) if !between.negated && is_time(&between.expr) => {
            Some(nanos_of(&between.low)?..=nanos_of(&between.high)?)
        }
        _ => None,
    }
}

// The times that are in both ranges.
fn intersect_ranges(one: RangeInclusive<i64>, other: RangeInclusive<i64>) -> RangeInclusive<i64> {
    *one.start().max(other.start())..=*one.end().min(other.end())
}

fn comparison_range(op: Operator, nanos: i64) -> Option<RangeInclusive<i64>> {
    // An empty range: nothing is below the least number.
    const NONE: RangeInclusive<i64> = RangeInclusive::new(1, 0);
    Some(match op {
        Operator::Eq => nanos..=nanos,
        Operator::Lt => nanos.checked_sub(1).map_or(NONE, |last| i64::MIN..=last),
        Operator::LtEq => i64::MIN..=nanos,
        Operator::Gt => nanos.checked_add(1).map_or(NONE, |first| first..=i64::MAX),
        Operator::GtEq => nanos..=i64::MAX,
        _ => return None,
    })
}

fn is_time(expr: &Expr) -> bool {
    matches!(expr, Expr::Column(c) if matches!(c.name.as_str(), "log_time" | "log_time_ns"))
}

fn nanos_of(expr: &Expr) -> Option<i64> {
    match expr {
        Expr::Literal(ScalarValue::Int64(nanos) | ScalarValue::TimestampNanosecond(nanos, _), _) => *nanos,
        _ => None,
    }
}
