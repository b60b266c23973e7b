//! Queries that a generator makes of the lake's own columns and values: filters, group-bys, joins, top-k, distinct,
//! windows and scans. The same seed makes the same queries of the same lake. Both engines run the same text.

use anyhow::{Context as _, Result};
use arrow::array::{Array as _, AsArray as _};
use arrow::compute::{cast, concat_batches};
use arrow::datatypes::{DataType, Float64Type, Int64Type};
use echolake_query::Session;
use echolake_schema::tables::Table;
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::collect_batches;
use super::twelve::BenchQuery;

/// Tables with rows of pairs, and how many queries of ten read them.
const PAIR_TABLES: [Table; 5] = [Table::Tnce, Table::Tnce, Table::Measurements, Table::Measurements, Table::TnceD4];
/// Pairs of each surface whose values are sampled, about.
const SAMPLED_PAIRS: i64 = 50;

/// Makes queries.
pub(crate) struct QueryGenerator {
    random: ChaCha8Rng,
    /// By pair.
    tables: Vec<SampledTable>,
    pairs: SampledTable,
    surfaces: SampledTable,
}

/// Scalar columns of a table.
#[derive(Clone)]
struct SampledTable {
    table: Table,
    columns: Vec<SampledColumn>,
}

/// A column, and values of it.
#[derive(Clone)]
struct SampledColumn {
    name: String,
    values: SampledValues,
    is_nullable: bool,
    /// Almost every row has a value of its own.
    is_unique: bool,
}

/// Sorted, each once.
#[derive(Clone)]
enum SampledValues {
    Floats(Vec<f64>),
    Integers(Vec<i64>),
    Texts(Vec<String>),
    Flags,
}

type QueryTemplate = fn(&mut QueryGenerator) -> String;

/// All kinds of queries.
const TEMPLATES: [(&str, QueryTemplate); 10] = [
    ("filter by one column", |g| g.filter_rows(1)),
    ("filter by two columns", |g| g.filter_rows(2)),
    ("group-by", QueryGenerator::group_rows),
    ("join with pairs", QueryGenerator::join_pairs),
    ("join with surfaces", QueryGenerator::join_surfaces),
    ("top-k", QueryGenerator::find_highest),
    ("distinct", QueryGenerator::find_distinct),
    ("window, ranks", QueryGenerator::rank_rows),
    ("window, steps", QueryGenerator::compare_neighbours),
    ("scan of D4", QueryGenerator::scan_symmetries),
];

impl QueryGenerator {
    /// Samples the lake's values.
    ///
    /// # Errors
    /// A query fails, or a table is empty.
    pub async fn new(session: &Session, seed: u64) -> Result<Self> {
        let mut tables = Vec::new();
        for table in [Table::Tnce, Table::Measurements, Table::TnceD4] {
            tables.push(SampledTable::read(session, table).await?);
        }
        let pairs = SampledTable::read(session, Table::Pairs).await?;
        let surfaces = SampledTable::read(session, Table::Surfaces).await?;
        Ok(Self { random: ChaCha8Rng::seed_from_u64(seed), tables, pairs, surfaces })
    }

    /// Makes so many, of all kinds in turn.
    pub fn generate_queries(mut self, count: usize) -> Vec<BenchQuery> {
        let kinds = TEMPLATES.iter().cycle().take(count).enumerate();
        let query = |(number, (kind, template)): (usize, &(&'static str, QueryTemplate))| BenchQuery {
            name: format!("{kind} #{number}"),
            kind,
            sql: template(&mut self),
            peer: None,
        };
        kinds.map(query).collect()
    }

    fn pick_table(&mut self) -> SampledTable {
        let table = PAIR_TABLES[self.random.random_range(0..PAIR_TABLES.len())];
        self.sampled_table(table)
    }

    fn sampled_table(&self, table: Table) -> SampledTable {
        self.tables.iter().find(|t| t.table == table).unwrap_or(&self.tables[0]).clone()
    }

    fn pick_column(&mut self, table: &SampledTable, is_wanted: fn(&SampledColumn) -> bool) -> SampledColumn {
        let wanted: Vec<_> = table.columns.iter().filter(|column| is_wanted(column)).collect();
        wanted.choose(&mut self.random).map_or_else(|| table.columns[0].clone(), |column| (*column).clone())
    }

    fn pick_measure(&mut self, table: &SampledTable) -> String {
        self.pick_column(table, SampledColumn::is_measure).name
    }

    fn pick_aggregate(&mut self, table: &SampledTable, prefix: &str) -> String {
        let column = self.pick_measure(table);
        let function = ["avg", "min", "max", "sum", "count"].choose(&mut self.random).unwrap_or(&"avg");
        format!("{function}({prefix}{column})")
    }

    // A condition on any column.
    fn pick_condition(&mut self, table: &SampledTable, prefix: &str) -> String {
        let column = self.pick_column(table, |_| true);
        let name = format!("{prefix}{}", column.name);
        if column.is_nullable && self.random.random_ratio(1, 6) {
            return format!("{name} {}", ["IS NULL", "IS NOT NULL"].choose(&mut self.random).unwrap_or(&"IS NULL"));
        }
        match &column.values {
            SampledValues::Flags => ["", "NOT "].choose(&mut self.random).unwrap_or(&"").to_string() + &name,
            SampledValues::Floats(values) => {
                // Between two values, so that no rounding of the text decides about a row.
                let between: Vec<_> = values.windows(2).map(|pair| round_digits((pair[0] + pair[1]) / 2.0)).collect();
                self.compare_column(
                    &name,
                    &if between.is_empty() { vec![round_digits(values[0])] } else { between },
                    false,
                )
            }
            SampledValues::Integers(values) => self.compare_column(&name, values, true),
            SampledValues::Texts(values) => {
                let quoted: Vec<_> = values.iter().map(|text| format!("'{}'", text.replace('\'', "''"))).collect();
                self.compare_column(&name, &quoted, true)
            }
        }
    }

    // A range, or values if the column's are exact.
    fn compare_column<T: ToString>(&mut self, name: &str, values: &[T], is_exact: bool) -> String {
        let at = |place: usize| values[place].to_string();
        let first = self.random.random_range(0..values.len());
        let last = self.random.random_range(first..values.len());
        match self.random.random_range(0..if is_exact { 6 } else { 3 }) {
            0 => format!("{name} BETWEEN {} AND {}", at(first), at(last)),
            1 => format!("{name} > {}", at(first)),
            2 => format!("{name} <= {}", at(last)),
            3 => format!("{name} = {}", at(first)),
            4 => format!("{name} <> {}", at(first)),
            _ => {
                let count = self.random.random_range(2..=8);
                let listed: Vec<_> = (0..count).map(|_| at(self.random.random_range(0..values.len()))).collect();
                format!("{name} IN ({})", listed.join(", "))
            }
        }
    }

    // A filter for about half of the queries.
    fn pick_filter(&mut self, table: &SampledTable, prefix: &str) -> String {
        match self.random.random_bool(0.5) {
            true => format!(" WHERE {}", self.pick_condition(table, prefix)),
            false => String::new(),
        }
    }

    fn filter_rows(&mut self, columns: usize) -> String {
        let table = self.pick_table();
        let conditions: Vec<_> = (0..columns).map(|_| self.pick_condition(&table, "")).collect();
        let link = [" AND ", " AND ", " OR "].choose(&mut self.random).unwrap_or(&" AND ");
        let aggregate = self.pick_aggregate(&table, "");
        format!("SELECT count(*) AS n, {aggregate} AS a FROM {} WHERE {}", table.name(), conditions.join(link))
    }

    fn group_rows(&mut self) -> String {
        let table = self.pick_table();
        let keys = self.pick_keys(&table);
        let first = self.pick_aggregate(&table, "");
        let second = self.pick_aggregate(&table, "");
        let filter = self.pick_filter(&table, "");
        format!(
            "SELECT {keys}, count(*) AS n, {first} AS a, {second} AS b FROM {}{filter} GROUP BY {keys} ORDER BY {keys} \
             LIMIT 1000",
            table.name()
        )
    }

    // One column or two by which rows are alike.
    fn pick_keys(&mut self, table: &SampledTable) -> String {
        let first = self.pick_column(table, SampledColumn::is_key).name;
        let second = self.pick_column(table, SampledColumn::is_key).name;
        if first == second || self.random.random_bool(0.5) { first } else { format!("{first}, {second}") }
    }

    fn join_pairs(&mut self) -> String {
        let table = self.pick_table();
        let pairs = self.pairs.clone();
        let column = self.pick_column(&pairs, SampledColumn::is_measure);
        let SampledValues::Floats(values) = &column.values else { return self.group_rows() };
        let width = round_digits((values[values.len() - 1] - values[0]) / 12.0).max(1e-3);
        let aggregate = self.pick_aggregate(&table, "t.");
        let filter =
            if self.random.random_bool(0.5) { self.pick_filter(&pairs, "p.") } else { self.pick_filter(&table, "t.") };
        format!(
            "SELECT CAST(floor(p.{} / {width}) AS INT) AS bin, count(*) AS n, {aggregate} AS a FROM {} t JOIN pairs p ON \
             p.pair_id = t.pair_id{filter} GROUP BY bin ORDER BY bin",
            column.name,
            table.name()
        )
    }

    fn join_surfaces(&mut self) -> String {
        let table = self.pick_table();
        let surfaces = self.surfaces.clone();
        let key = self.pick_column(&surfaces, SampledColumn::is_key).name;
        let aggregate = self.pick_aggregate(&table, "t.");
        let filter = self.pick_filter(&table, "t.");
        format!(
            "SELECT s.{key} AS k, count(*) AS n, {aggregate} AS a FROM {} t JOIN surfaces s ON s.surface_id = \
             t.surface_id{filter} GROUP BY k ORDER BY k LIMIT 1000",
            table.name()
        )
    }

    fn find_highest(&mut self) -> String {
        let table = self.pick_table();
        let measure = self.pick_measure(&table);
        let other = self.pick_measure(&table);
        let direction = ["DESC", "ASC"].choose(&mut self.random).unwrap_or(&"ASC");
        let filter = self.pick_filter(&table, "");
        let key = table.row_key();
        let count = self.random.random_range(5..=200);
        format!(
            "SELECT {key}, {measure} AS a, {other} AS b FROM {}{filter} ORDER BY {measure} {direction} NULLS LAST, {key} \
             LIMIT {count}",
            table.name()
        )
    }

    fn find_distinct(&mut self) -> String {
        let table = self.pick_table();
        let filter = self.pick_filter(&table, "");
        if self.random.random_bool(0.5) {
            let column = self.pick_column(&table, |_| true).name;
            return format!("SELECT count(DISTINCT {column}) AS n FROM {}{filter}", table.name());
        }
        let keys = self.pick_keys(&table);
        format!("SELECT DISTINCT {keys} FROM {}{filter} ORDER BY {keys} LIMIT 1000", table.name())
    }

    fn rank_rows(&mut self) -> String {
        let table = *[Table::Tnce, Table::Measurements].choose(&mut self.random).unwrap_or(&Table::Tnce);
        let table = self.sampled_table(table);
        let measure = self.pick_measure(&table);
        let group = ["surface_id", "pair_id", "microphone", "speaker"].choose(&mut self.random).unwrap_or(&"pair_id");
        let key = table.row_key();
        let filter = self.pick_filter(&table, "");
        format!(
            "SELECT * FROM (SELECT {key}, {measure} AS a, row_number() OVER (PARTITION BY {group} ORDER BY {measure} DESC \
             NULLS LAST, {key}) AS place FROM {}{filter}) ranked WHERE place <= 3 ORDER BY {key} LIMIT 1000",
            table.name()
        )
    }

    fn compare_neighbours(&mut self) -> String {
        let table = *[Table::Tnce, Table::Measurements].choose(&mut self.random).unwrap_or(&Table::Tnce);
        let table = self.sampled_table(table);
        let measure = self.pick_measure(&table);
        let group = ["surface_id", "microphone", "speaker"].choose(&mut self.random).unwrap_or(&"surface_id");
        format!(
            "SELECT {group}, count(step) AS n, avg(step) AS mean, max(step) AS most FROM (SELECT {group}, abs({measure} - \
             lag({measure}) OVER (PARTITION BY surface_id ORDER BY run_id, pair_id)) AS step FROM {}) steps GROUP BY \
             {group} ORDER BY {group}",
            table.name()
        )
    }

    fn scan_symmetries(&mut self) -> String {
        let table = self.sampled_table(Table::TnceD4);
        let keys =
            ["symmetry, swapped", "symmetry", "swapped", "d4_pair_id"].choose(&mut self.random).unwrap_or(&"symmetry");
        let aggregates: Vec<_> = (0..3).map(|_| self.pick_aggregate(&table, "")).collect();
        let filter = self.pick_filter(&table, "");
        format!(
            "SELECT {keys}, count(*) AS n, {} AS a, {} AS b, {} AS c FROM tnce_d4{filter} GROUP BY {keys} ORDER BY {keys}",
            aggregates[0], aggregates[1], aggregates[2]
        )
    }
}

impl SampledTable {
    async fn read(session: &Session, table: Table) -> Result<Self> {
        let filter = match table {
            Table::Surfaces => String::new(),
            _ => format!("WHERE pair_id % (SELECT max(pair_id) / {SAMPLED_PAIRS} + 1 FROM pairs) = 0"),
        };
        let empty = session.query(&format!("SELECT * FROM {} LIMIT 0", table.name())).await?;
        let is_scalar = |kind: &DataType| kind.is_numeric() || kind.is_string() || *kind == DataType::Boolean;
        let names: Vec<_> =
            empty.schema.fields().iter().filter(|f| is_scalar(f.data_type())).map(|f| f.name()).collect();
        let listed: Vec<_> = names.iter().map(|name| name.as_str()).collect();
        let batches =
            collect_batches(session, &format!("SELECT {} FROM {} {filter}", listed.join(", "), table.name())).await?;
        let first = batches.first().with_context(|| format!("table {} is empty", table.name()))?;
        let rows = concat_batches(&first.schema(), &batches)?;
        let mut columns = Vec::new();
        for (field, column) in rows.schema().fields().iter().zip(rows.columns()) {
            let values = match column.data_type() {
                DataType::Boolean => SampledValues::Flags,
                kind if kind.is_floating() => {
                    let plain = cast(column, &DataType::Float64)?;
                    let mut values: Vec<_> = plain.as_primitive::<Float64Type>().iter().flatten().collect();
                    values.retain(|value| value.is_finite());
                    values.sort_by(f64::total_cmp);
                    values.dedup();
                    SampledValues::Floats(values)
                }
                kind if kind.is_integer() => {
                    let plain = cast(column, &DataType::Int64)?;
                    SampledValues::Integers(sort_distinct(plain.as_primitive::<Int64Type>().iter().flatten().collect()))
                }
                _ => {
                    let plain = cast(column, &DataType::Utf8)?;
                    let texts = plain.as_string::<i32>().iter().flatten().map(str::to_owned);
                    SampledValues::Texts(sort_distinct(texts.collect()))
                }
            };
            let distinct = values.count();
            if distinct > 0 {
                columns.push(SampledColumn {
                    name: field.name().clone(),
                    is_nullable: field.is_nullable(),
                    is_unique: distinct > 20 && distinct * 5 > rows.num_rows() * 4,
                    values,
                });
            }
        }
        Ok(Self { table, columns })
    }

    fn name(&self) -> &'static str {
        self.table.name()
    }

    // What orders rows that are alike otherwise.
    fn row_key(&self) -> &'static str {
        if self.table == Table::TnceD4 {
            "surface_id, run_id, pair_id, symmetry"
        } else {
            "surface_id, run_id, pair_id"
        }
    }
}

impl SampledColumn {
    fn is_measure(&self) -> bool {
        matches!(self.values, SampledValues::Floats(_))
    }

    fn is_key(&self) -> bool {
        !self.is_measure() && !self.is_unique
    }
}

impl SampledValues {
    fn count(&self) -> usize {
        match self {
            Self::Floats(values) => values.len(),
            Self::Integers(values) => values.len(),
            Self::Texts(values) => values.len(),
            Self::Flags => 2,
        }
    }
}

fn sort_distinct<T: Ord>(mut values: Vec<T>) -> Vec<T> {
    values.sort_unstable();
    values.dedup();
    values
}

// Seven digits that count, as people write numbers.
fn round_digits(value: f64) -> f64 {
    format!("{value:.6e}").parse().unwrap_or(value)
}
