//! Queries that a generator makes of the lake's own columns and values: filters, group-bys, joins, top-k, distinct,
//! windows and scans. The same seed makes the same queries of the same lake. Both engines run the same text.

use anyhow::{Result, ensure};
use arrow::datatypes::DataType;
use arrow::util::display::array_value_to_string;
use echolake_query::Session;
use echolake_schema::tables::Table;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::collect_batches;

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
pub(crate) struct SampledColumn {
    pub name: String,
    /// Its type.
    pub data_type: DataType,
    kind: ColumnKind,
    /// As they are written in SQL, ascending, each once; between two of the rows' values if those are floats, so that
    /// no rounding decides about a row.
    pub values: Vec<String>,
    is_nullable: bool,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum ColumnKind {
    /// Floats.
    Measure,
    /// Exact values that many rows share.
    Key,
    /// Exact values; almost every row has its own.
    Unique,
    Flag,
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

    /// Makes so many, of all kinds in turn: the kind and the text of each.
    pub fn generate_queries(&mut self, count: usize) -> Vec<(&'static str, String)> {
        TEMPLATES.iter().cycle().take(count).map(|(kind, template)| (*kind, template(self))).collect()
    }

    /// Makes one, which depends on its number and on the seed alone.
    pub fn generate_query(&mut self, seed: u64, number: u64) -> (&'static str, String) {
        self.random = ChaCha8Rng::seed_from_u64(seed);
        self.random.set_stream(number);
        let (kind, template) = self.pick(&TEMPLATES);
        (kind, template(self))
    }

    /// Returns the scalar columns of a table that was sampled.
    pub fn sampled_columns(&self, table: Table) -> &[SampledColumn] {
        let all = self.tables.iter().chain([&self.pairs, &self.surfaces]);
        all.into_iter().find(|sampled| sampled.table == table).map_or(&[], |sampled| &sampled.columns)
    }

    fn pick<T: Clone>(&mut self, options: &[T]) -> T {
        options[self.random.random_range(0..options.len())].clone()
    }

    fn pick_table(&mut self) -> SampledTable {
        let table = self.pick(&PAIR_TABLES);
        self.sampled_table(table)
    }

    fn sampled_table(&self, table: Table) -> SampledTable {
        self.tables.iter().find(|t| t.table == table).unwrap_or(&self.tables[0]).clone()
    }

    fn pick_column(&mut self, table: &SampledTable, kinds: &[ColumnKind]) -> SampledColumn {
        let wanted: Vec<_> = table.columns.iter().filter(|column| kinds.contains(&column.kind)).collect();
        self.pick(&wanted).clone()
    }

    fn pick_measure(&mut self, table: &SampledTable) -> String {
        self.pick_column(table, &[ColumnKind::Measure]).name
    }

    fn pick_aggregate(&mut self, table: &SampledTable, prefix: &str) -> String {
        let column = self.pick_measure(table);
        format!("{}({prefix}{column})", self.pick(&["avg", "min", "max", "sum", "count"]))
    }

    // A condition on any column: a range, or values if the column's are exact.
    fn pick_condition(&mut self, table: &SampledTable, prefix: &str) -> String {
        let SampledColumn { name, kind, values, is_nullable, .. } = self.pick(&table.columns);
        let name = format!("{prefix}{name}");
        if is_nullable && self.random.random_ratio(1, 6) {
            return format!("{name} {}", self.pick(&["IS NULL", "IS NOT NULL"]));
        }
        let first = self.random.random_range(0..values.len());
        let last = self.random.random_range(first..values.len());
        match self.random.random_range(0..if kind == ColumnKind::Measure { 3 } else { 6 }) {
            _ if kind == ColumnKind::Flag => self.pick(&["", "NOT "]).to_owned() + &name,
            0 => format!("{name} BETWEEN {} AND {}", values[first], values[last]),
            1 => format!("{name} > {}", values[first]),
            2 => format!("{name} <= {}", values[last]),
            3 => format!("{name} = {}", values[first]),
            4 => format!("{name} <> {}", values[first]),
            _ => {
                let listed: Vec<_> = (0..self.random.random_range(2..=8)).map(|_| self.pick(&values)).collect();
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
        let link = self.pick(&[" AND ", " AND ", " OR "]);
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
        let first = self.pick_column(table, &[ColumnKind::Key, ColumnKind::Flag]).name;
        let second = self.pick_column(table, &[ColumnKind::Key, ColumnKind::Flag]).name;
        if first == second || self.random.random_bool(0.5) { first } else { format!("{first}, {second}") }
    }

    fn join_pairs(&mut self) -> String {
        let table = self.pick_table();
        let pairs = self.pairs.clone();
        let SampledColumn { name, values, .. } = self.pick_column(&pairs, &[ColumnKind::Measure]);
        let range = parse_number(&values[values.len() - 1]) - parse_number(&values[0]);
        let width = round_digits(range / 12.0).max(1e-3);
        let aggregate = self.pick_aggregate(&table, "t.");
        let filter =
            if self.random.random_bool(0.5) { self.pick_filter(&pairs, "p.") } else { self.pick_filter(&table, "t.") };
        format!(
            "SELECT CAST(floor(p.{name} / {width}) AS INT) AS bin, count(*) AS n, {aggregate} AS a FROM {} t JOIN pairs p ON \
             p.pair_id = t.pair_id{filter} GROUP BY bin ORDER BY bin",
            table.name()
        )
    }

    fn join_surfaces(&mut self) -> String {
        let table = self.pick_table();
        let surfaces = self.surfaces.clone();
        let key = self.pick_column(&surfaces, &[ColumnKind::Key]).name;
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
        let direction = self.pick(&["DESC", "ASC"]);
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
            let column = self.pick(&table.columns).name;
            return format!("SELECT count(DISTINCT {column}) AS n FROM {}{filter}", table.name());
        }
        let keys = self.pick_keys(&table);
        format!("SELECT DISTINCT {keys} FROM {}{filter} ORDER BY {keys} LIMIT 1000", table.name())
    }

    fn rank_rows(&mut self) -> String {
        let table = self.pick(&[Table::Tnce, Table::Measurements]);
        let table = self.sampled_table(table);
        let measure = self.pick_measure(&table);
        let group = self.pick(&["surface_id", "pair_id", "microphone", "speaker"]);
        let key = table.row_key();
        let filter = self.pick_filter(&table, "");
        format!(
            "SELECT * FROM (SELECT {key}, {measure} AS a, row_number() OVER (PARTITION BY {group} ORDER BY {measure} DESC \
             NULLS LAST, {key}) AS place FROM {}{filter}) ranked WHERE place <= 3 ORDER BY {key} LIMIT 1000",
            table.name()
        )
    }

    fn compare_neighbours(&mut self) -> String {
        let table = self.pick(&[Table::Tnce, Table::Measurements]);
        let table = self.sampled_table(table);
        let measure = self.pick_measure(&table);
        let group = self.pick(&["surface_id", "microphone", "speaker"]);
        format!(
            "SELECT {group}, count(step) AS n, avg(step) AS mean, max(step) AS most FROM (SELECT {group}, abs({measure} - \
             lag({measure}) OVER (PARTITION BY surface_id ORDER BY run_id, pair_id)) AS step FROM {}) steps GROUP BY \
             {group} ORDER BY {group}",
            table.name()
        )
    }

    fn scan_symmetries(&mut self) -> String {
        let table = self.sampled_table(Table::TnceD4);
        let keys = self.pick(&["symmetry, swapped", "symmetry", "swapped", "d4_pair_id"]);
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
        let name = table.name();
        let sample = match table {
            Table::Surfaces => name.to_owned(),
            _ => {
                let every = format!("(SELECT max(pair_id) / {SAMPLED_PAIRS} + 1 FROM pairs)");
                format!("(SELECT * FROM {name} WHERE pair_id % {every} = 0)")
            }
        };
        let rows: usize = read_texts(session, &format!("SELECT count(*) FROM {sample} s")).await?.concat().parse()?;
        let answer = session.query(&format!("SELECT * FROM {name} LIMIT 0")).await?;
        let is_scalar = |kind: &DataType| kind.is_numeric() || kind.is_string() || *kind == DataType::Boolean;
        let mut columns = Vec::new();
        for field in answer.schema.fields().iter().filter(|field| is_scalar(field.data_type())) {
            let column = field.name();
            let sql = format!("SELECT DISTINCT {column} FROM {sample} s WHERE {column} IS NOT NULL ORDER BY {column}");
            let mut values = read_texts(session, &sql).await?;
            let is_unique = values.len() > 20 && values.len() * 5 > rows * 4;
            let kind = match field.data_type() {
                DataType::Boolean => ColumnKind::Flag,
                kind if kind.is_floating() => ColumnKind::Measure,
                _ if is_unique => ColumnKind::Unique,
                _ => ColumnKind::Key,
            };
            if field.data_type().is_string() {
                values = values.iter().map(|text| format!("'{}'", text.replace('\'', "''"))).collect();
            }
            if kind == ColumnKind::Measure && values.len() > 1 {
                let middle = |pair: &[String]| (parse_number(&pair[0]) + parse_number(&pair[1])) / 2.0;
                values = values.windows(2).map(|pair| round_digits(middle(pair)).to_string()).collect();
            }
            if !values.is_empty() {
                let data_type = field.data_type().clone();
                columns.push(SampledColumn {
                    name: column.clone(),
                    data_type,
                    kind,
                    values,
                    is_nullable: field.is_nullable(),
                });
            }
        }
        for kind in [ColumnKind::Measure, ColumnKind::Key] {
            ensure!(columns.iter().any(|column| column.kind == kind), "table `{name}` has not enough rows");
        }
        Ok(Self { table, columns })
    }

    fn name(&self) -> &'static str {
        self.table.name()
    }

    // Columns that order rows that are alike otherwise.
    fn row_key(&self) -> &'static str {
        if self.table == Table::TnceD4 {
            "surface_id, run_id, pair_id, symmetry"
        } else {
            "surface_id, run_id, pair_id"
        }
    }
}

// The first column of an answer.
async fn read_texts(session: &Session, sql: &str) -> Result<Vec<String>> {
    let mut texts = Vec::new();
    for batch in collect_batches(session, sql).await? {
        for row in 0..batch.num_rows() {
            texts.push(array_value_to_string(batch.column(0), row)?);
        }
    }
    Ok(texts)
}

fn parse_number(text: &str) -> f64 {
    text.parse().unwrap_or(0.0)
}

// Seven digits that count, as people write numbers.
fn round_digits(value: f64) -> f64 {
    parse_number(&format!("{value:.6e}"))
}
