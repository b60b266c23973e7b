//! Statements that a generator makes of the lake's tables and of lists of values near bounds. A statement depends on the
//! seed and on its number alone. Both engines run the same text.
//!
//! An expression has a kind of value and a depth; its leaves are columns in scope, or literals. Only columns are compared
//! if they are floats, so that no rounding decides about a row. A part that picks rows (`LIMIT`, a frame of rows,
//! `DISTINCT ON`) has an order by the keys of all its sources.

use anyhow::Result;
use arrow::datatypes::DataType;
use echolake_query::Session;
use echolake_schema::tables::Table;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::answer_rows::RowOrder;
use super::query_generator::QueryGenerator;

/// A statement for both engines.
#[derive(Debug, Clone)]
pub(crate) struct DifferenceStatement {
    /// Kind of those that are alike.
    pub kind: &'static str,
    /// The text.
    pub sql: String,
    /// Whether its `ORDER BY` determines the place of each row.
    pub order: RowOrder,
}

/// Makes statements.
pub(crate) struct StatementGenerator {
    random: ChaCha8Rng,
    seed: u64,
    queries: QueryGenerator,
    tables: Vec<SourceTable>,
    aliases: usize,
}

/// What a value is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ValueKind {
    Integer,
    Float,
    Text,
    Flag,
    Time,
    Date,
    Decimal,
    List,
}

impl ValueKind {
    fn from_type(kind: &DataType) -> Option<Self> {
        match kind {
            DataType::Boolean => Some(Self::Flag),
            DataType::Timestamp(_, None) => Some(Self::Time),
            kind if kind.is_string() => Some(Self::Text),
            kind if kind.is_integer() => Some(Self::Integer),
            kind if kind.is_floating() => Some(Self::Float),
            _ => None,
        }
    }
}

/// A column of a table of the lake.
#[derive(Clone)]
struct SourceColumn {
    name: String,
    kind: ValueKind,
    values: Vec<String>,
}

/// A table of the lake.
struct SourceTable {
    name: &'static str,
    key: &'static [&'static str],
    columns: Vec<SourceColumn>,
}

/// A column that an expression may name.
#[derive(Debug, Clone)]
struct ScopeColumn {
    text: String,
    kind: ValueKind,
    values: Vec<String>,
}

/// Something to select from.
#[derive(Clone)]
struct RowSource {
    /// Text after FROM or JOIN.
    from: String,
    columns: Vec<ScopeColumn>,
    /// Columns that together are another in each row.
    key: Vec<String>,
}

type StatementTemplate = fn(&mut StatementGenerator) -> (String, RowOrder);

/// All kinds of statements.
const TEMPLATES: [(&str, StatementTemplate); 22] = [
    ("expressions", StatementGenerator::select_values),
    ("join", StatementGenerator::join_sources),
    ("join using", StatementGenerator::join_using),
    ("semi and anti join", StatementGenerator::join_half),
    ("subquery in SELECT", |g| g.place_subquery("select")),
    ("subquery in WHERE", |g| g.place_subquery("where")),
    ("subquery in HAVING", |g| g.place_subquery("having")),
    ("subquery in ON", |g| g.place_subquery("on")),
    ("subquery in CASE", |g| g.place_subquery("case")),
    ("subquery in ORDER BY", |g| g.place_subquery("order")),
    ("set operation", StatementGenerator::combine_queries),
    ("window", StatementGenerator::select_windows),
    ("qualify", StatementGenerator::qualify_rows),
    ("group by", StatementGenerator::group_rows),
    ("grouping sets", StatementGenerator::group_by_sets),
    ("common table expression", StatementGenerator::share_query),
    ("recursive query", StatementGenerator::count_recursively),
    ("distinct", StatementGenerator::select_distinct),
    ("order and limit", StatementGenerator::order_rows),
    ("lateral join", StatementGenerator::join_lateral),
    ("cast", StatementGenerator::cast_values),
    ("unnest", StatementGenerator::unnest_lists),
];

/// Tables that statements read, and the columns that are another in each row.
const TABLES: [(Table, &[&str]); 4] = [
    (Table::Surfaces, &["surface_id"]),
    (Table::Pairs, &["pair_id"]),
    (Table::Tnce, &["run_id", "pair_id"]),
    (Table::Measurements, &["run_id", "pair_id"]),
];
/// Views that statements read, and the columns that are another in each row.
pub(crate) const VIEWS: [(&str, &[&str]); 3] =
    [("tnce_db", &["run_id", "pair_id"]), ("levels", &["surface_id", "band"]), ("catalogue", &["surface_id"])];

/// Kind of the queries of `bench queries`, one of so many statements.
const QUERY_KIND: &str = "lake's query";
const QUERY_EVERY: u64 = 12;

const KINDS: [ValueKind; 8] = [
    ValueKind::Integer,
    ValueKind::Integer,
    ValueKind::Float,
    ValueKind::Text,
    ValueKind::Flag,
    ValueKind::Time,
    ValueKind::Decimal,
    ValueKind::Date,
];
/// Kinds whose values compare exactly.
const EXACT: [ValueKind; 5] =
    [ValueKind::Integer, ValueKind::Integer, ValueKind::Text, ValueKind::Time, ValueKind::Decimal];

const INTEGERS: [&str; 9] = ["0", "1", "2", "3", "7", "-1", "-2", "10", "null"];
const EDGE_INTEGERS: [&str; 12] = [
    "0::smallint",
    "1::smallint",
    "32767::smallint",
    "(-32768)::smallint",
    "2147483647::int",
    "(-2147483648)::int",
    "9223372036854775807::bigint",
    "(-9223372036854775807)::bigint",
    "9007199254740993::bigint",
    "null::int",
    "3::int",
    "5::bigint",
];
const FLOATS: [&str; 14] = [
    "0.0::double",
    "(-0.0)::double",
    "'nan'::double",
    "'inf'::double",
    "'-inf'::double",
    "1.5::double",
    "0.1::double",
    "(-2.5)::double",
    "1e308::double",
    "1e300::double",
    "0.1::real",
    "16777217::real",
    "'nan'::real",
    "null::double",
];
const TEXTS: [&str; 16] = [
    "''",
    "'a'",
    "'A'",
    "'b'",
    "'ä'",
    "'Ä'",
    "'ß'",
    "'😀x'",
    "'a b'",
    "' x '",
    "'%'",
    "'_'",
    "'10'",
    "'e\u{301}'",
    "'flat'",
    "null::text",
];
const TIMES: [&str; 8] = [
    "timestamp '2026-01-01 00:00:00'",
    "timestamp '2026-03-29 01:59:59.999999'",
    "timestamp '1969-12-31 23:59:59'",
    "timestamp '2024-02-29 12:30:00'",
    "timestamp '2026-01-31 10:00:00.5'",
    "timestamp '1900-01-01 00:00:00'",
    "timestamp '2200-12-31 23:59:59'",
    "null::timestamp",
];
const DATES: [&str; 5] =
    ["date '2026-01-01'", "date '2024-02-29'", "date '1969-12-31'", "date '2026-12-31'", "null::date"];
const DECIMALS: [&str; 7] = [
    "1.25::decimal(10, 2)",
    "0::decimal(10, 2)",
    "(-3.75)::decimal(10, 2)",
    "99999999.99::decimal(10, 2)",
    "0.005::decimal(10, 3)",
    "'12345678901234567.5'::decimal(20, 1)",
    "null::decimal(10, 2)",
];
const LISTS: [&str; 6] = ["[1, 2, 3]", "[1, null]", "[3, 1, 2, 1]", "[5]", "[2, 2]", "[-1, 0]"];

impl StatementGenerator {
    /// Samples the lake's values.
    ///
    /// # Errors
    /// A query fails, or a table is empty.
    pub async fn new(session: &Session, seed: u64) -> Result<Self> {
        let queries = QueryGenerator::new(session, seed).await?;
        let tables = TABLES.map(|(table, key)| {
            let column = |column: &super::query_generator::SampledColumn| {
                let kind = ValueKind::from_type(&column.data_type).unwrap_or(ValueKind::Float);
                SourceColumn { name: column.name.clone(), kind, values: column.values.clone() }
            };
            let mut columns: Vec<_> = queries.sampled_columns(table).iter().map(column).collect();
            if table == Table::Measurements {
                columns.push(SourceColumn { name: "log_time".to_owned(), kind: ValueKind::Time, values: Vec::new() });
            }
            SourceTable { name: table.name(), key, columns }
        });
        let mut tables = Vec::from(tables);
        for (name, key) in VIEWS {
            let answer = session.query(&format!("select * from {name} limit 0")).await?;
            let columns = answer.schema.fields().iter().filter_map(|field| {
                Some(SourceColumn {
                    name: field.name().clone(),
                    kind: ValueKind::from_type(field.data_type())?,
                    values: Vec::new(),
                })
            });
            tables.push(SourceTable { name, key, columns: columns.collect() });
        }
        let random = ChaCha8Rng::seed_from_u64(seed);
        Ok(Self { random, seed, queries, tables, aliases: 0 })
    }

    /// Makes the statement of this number.
    pub fn generate_statement(&mut self, number: u64) -> DifferenceStatement {
        self.random = ChaCha8Rng::seed_from_u64(self.seed);
        self.random.set_stream(number);
        self.aliases = 0;
        if number.is_multiple_of(QUERY_EVERY) {
            let (_, sql) = self.queries.generate_query(self.seed, number);
            return DifferenceStatement { kind: QUERY_KIND, sql, order: RowOrder::Free };
        }
        let (kind, template) = self.pick(&TEMPLATES);
        let (sql, order) = template(self);
        DifferenceStatement { kind, sql, order }
    }

    fn pick<T: Clone>(&mut self, options: &[T]) -> T {
        options[self.random.random_range(0..options.len())].clone()
    }

    fn chance(&mut self, of: u32) -> bool {
        self.random.random_ratio(1, of)
    }

    fn count(&mut self, least: usize, most: usize) -> usize {
        self.random.random_range(least..=most)
    }

    // ---- Sources ----

    fn new_alias(&mut self) -> String {
        self.aliases += 1;
        format!("t{}", self.aliases)
    }

    fn pick_source(&mut self, depth: usize) -> RowSource {
        match self.random.random_range(0..10) {
            0..5 => self.lake_source(),
            5..9 => self.value_source(),
            _ if depth > 0 => self.derived_source(depth - 1),
            _ => self.value_source(),
        }
    }

    // Without an alias names of columns may mean those of another level.
    fn pick_bare_source(&mut self) -> RowSource {
        let table = self.random.random_range(0..self.tables.len());
        self.source_of_table(table, None)
    }

    fn lake_source(&mut self) -> RowSource {
        let table = self.random.random_range(0..self.tables.len());
        let alias = self.new_alias();
        self.source_of_table(table, Some(alias))
    }

    fn source_of_table(&mut self, table: usize, alias: Option<String>) -> RowSource {
        let prefix = alias.as_ref().map_or_else(String::new, |alias| format!("{alias}."));
        let count = self.count(3, 6);
        let places: Vec<_> =
            (0..count).map(|_| self.random.random_range(0..self.tables[table].columns.len())).collect();
        let table = &self.tables[table];
        let keys = table.columns.iter().filter(|column| table.key.contains(&column.name.as_str()));
        let picked = places.iter().map(|place| &table.columns[*place]).chain(keys);
        let columns = picked.map(|column| ScopeColumn {
            text: format!("{prefix}{}", column.name),
            kind: column.kind,
            values: column.values.clone(),
        });
        RowSource {
            from: format!("{}{}", table.name, alias.map_or_else(String::new, |alias| format!(" {alias}"))),
            columns: columns.collect(),
            key: table.key.iter().map(|name| format!("{prefix}{name}")).collect(),
        }
    }

    // Rows of values near bounds, with a column `k` that numbers them.
    fn value_source(&mut self) -> RowSource {
        let alias = self.new_alias();
        let kinds: Vec<_> = (0..self.count(1, 4)).map(|_| self.pick(&KINDS)).collect();
        let names = ["a", "b", "c", "d"];
        let rows: Vec<_> = (0..self.count(2, 6))
            .map(|row| {
                let values = kinds.iter().map(|kind| self.edge_literal(*kind)).collect::<Vec<_>>().join(", ");
                format!("({row}, {values})")
            })
            .collect();
        let columns = kinds.iter().zip(names).map(|(kind, name)| ScopeColumn {
            text: format!("{alias}.{name}"),
            kind: *kind,
            values: Vec::new(),
        });
        let key = format!("{alias}.k");
        let number = ScopeColumn { text: key.clone(), kind: ValueKind::Integer, values: Vec::new() };
        RowSource {
            columns: [number].into_iter().chain(columns).collect(),
            key: vec![key],
            from: format!("(values {}) {alias}(k, {})", rows.join(", "), names[..kinds.len()].join(", ")),
        }
    }

    fn derived_source(&mut self, depth: usize) -> RowSource {
        let inner = self.pick_source(depth);
        let kinds: Vec<_> = (0..self.count(1, 3)).map(|_| self.pick(&KINDS)).collect();
        let alias = self.new_alias();
        let items: Vec<_> = kinds
            .iter()
            .enumerate()
            .map(|(number, kind)| format!("{} as e{number}", self.value(*kind, &inner.columns, depth)))
            .collect();
        let keys: Vec<_> = inner.key.iter().enumerate().map(|(number, key)| format!("{key} as k{number}")).collect();
        let filter = self.optional_where(&inner.columns, depth);
        let columns = kinds.iter().enumerate().map(|(number, kind)| ScopeColumn {
            text: format!("{alias}.e{number}"),
            kind: *kind,
            values: Vec::new(),
        });
        RowSource {
            from: format!("(select {}, {} from {}{filter}) {alias}", keys.join(", "), items.join(", "), inner.from),
            columns: columns.collect(),
            key: (0..inner.key.len()).map(|number| format!("{alias}.k{number}")).collect(),
        }
    }

    // ---- Values ----

    fn edge_literal(&mut self, kind: ValueKind) -> String {
        match kind {
            ValueKind::Integer => self.pick(&EDGE_INTEGERS),
            ValueKind::Float => self.pick(&FLOATS),
            ValueKind::Text => self.pick(&TEXTS),
            ValueKind::Flag => self.pick(&["true", "false", "null::boolean"]),
            ValueKind::Time => self.pick(&TIMES),
            ValueKind::Date => self.pick(&DATES),
            ValueKind::Decimal => self.pick(&DECIMALS),
            ValueKind::List => self.pick(&LISTS),
        }
        .to_owned()
    }

    fn literal(&mut self, kind: ValueKind) -> String {
        match kind {
            ValueKind::Integer => self.pick(&INTEGERS).to_owned(),
            _ => self.edge_literal(kind),
        }
    }

    // One of these kinds, and for most one that a column in scope has.
    fn pick_kind(&mut self, kinds: &[ValueKind], scope: &[ScopeColumn]) -> ValueKind {
        let columns: Vec<_> =
            kinds.iter().copied().filter(|kind| scope.iter().any(|column| column.kind == *kind)).collect();
        if columns.is_empty() || self.chance(8) { self.pick(kinds) } else { self.pick(&columns) }
    }

    // A column, if there is one of the kind.
    fn leaf(&mut self, kind: ValueKind, scope: &[ScopeColumn]) -> String {
        let columns: Vec<_> = scope.iter().filter(|column| column.kind == kind).collect();
        if columns.is_empty() || self.chance(10) { self.literal(kind) } else { self.pick(&columns).text.clone() }
    }

    fn value(&mut self, kind: ValueKind, scope: &[ScopeColumn], depth: usize) -> String {
        if depth == 0 || self.chance(3) {
            return self.leaf(kind, scope);
        }
        let depth = depth - 1;
        if self.chance(3) {
            return self.common_value(kind, scope, depth);
        }
        match kind {
            ValueKind::Integer => self.integer_value(scope, depth),
            ValueKind::Float => self.float_value(scope, depth),
            ValueKind::Text => self.text_value(scope, depth),
            ValueKind::Flag => format!("({})", self.condition(scope, depth)),
            ValueKind::Time => self.time_value(scope, depth),
            ValueKind::Date => self.date_value(scope, depth),
            ValueKind::Decimal => self.decimal_value(scope, depth),
            ValueKind::List => {
                format!("[{}, {}]", self.leaf(ValueKind::Integer, scope), self.leaf(ValueKind::Integer, scope))
            }
        }
    }

    // What every kind has.
    fn common_value(&mut self, kind: ValueKind, scope: &[ScopeColumn], depth: usize) -> String {
        let a = self.value(kind, scope, depth);
        let b = self.value(kind, scope, depth);
        match self.random.random_range(0..6) {
            0 => format!("coalesce({a}, {b})"),
            1 => format!("nullif({}, {})", self.leaf(kind, scope), self.leaf(kind, scope)),
            2 => format!("case when {} then {a} else {b} end", self.condition(scope, depth)),
            3 => format!("case when {} then {a} end", self.condition(scope, depth)),
            4 => {
                let tested = self.pick(&EXACT);
                let test = self.leaf(tested, scope);
                format!("case {test} when {} then {a} else {b} end", self.leaf(tested, scope))
            }
            _ => self.scalar_subquery(kind, scope, depth),
        }
    }

    fn integer_value(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        let a = self.value(ValueKind::Integer, scope, depth);
        let b = self.value(ValueKind::Integer, scope, depth);
        match self.random.random_range(0..17) {
            0 => format!("({a} + {b})"),
            1 => format!("({a} - {b})"),
            2 => format!("({a} * {b})"),
            3 => format!("({a} / {})", self.pick(&["2", "3", "-2", "7"])),
            4 => format!("({a} % {})", self.pick(&["2", "3", "-2", "7"])),
            5 => format!("abs({a})"),
            6 => format!("greatest({a}, {b})"),
            7 => format!("least({a}, {b})"),
            8 => format!("length({})", self.value(ValueKind::Text, scope, depth)),
            9 => format!("strpos({}, {})", self.leaf(ValueKind::Text, scope), self.pick(&["'a'", "'t'", "''", "'x'"])),
            10 => format!("cast({} as int)", self.leaf(ValueKind::Flag, scope)),
            11 => {
                let part = self.pick(&["year", "month", "day", "hour", "minute", "dow", "doy", "week", "quarter"]);
                format!("cast(extract({part} from {}) as int)", self.value(ValueKind::Time, scope, depth))
            }
            12 => format!("(- {a})"),
            13 => format!("({a} & {b})"),
            14 => format!("({a} | {b})"),
            15 => format!("cast(array_length({}) as int)", self.value(ValueKind::List, scope, depth)),
            _ => format!("({})[{}]", self.value(ValueKind::List, scope, depth), self.pick(&["1", "2", "-1", "4", "0"])),
        }
    }

    fn float_value(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        let a = self.value(ValueKind::Float, scope, depth);
        let b = self.value(ValueKind::Float, scope, depth);
        match self.random.random_range(0..13) {
            0 => format!("({a} + {b})"),
            1 => format!("({a} - {b})"),
            2 => format!("({a} * {b})"),
            3 => format!("({a} / {b})"),
            4 => format!("abs({a})"),
            5 => format!("greatest({a}, {b})"),
            6 => format!("least({a}, {b})"),
            7 => format!("floor({})", self.leaf(ValueKind::Float, scope)),
            8 => format!("ceil({})", self.leaf(ValueKind::Float, scope)),
            9 => format!("sqrt(abs({a}))"),
            10 => format!("cast({} as double)", self.value(ValueKind::Integer, scope, depth)),
            11 => format!("({a} * {})", self.value(ValueKind::Integer, scope, depth)),
            _ => format!("cast({} as double)", self.value(ValueKind::Decimal, scope, depth)),
        }
    }

    fn text_value(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        let a = self.value(ValueKind::Text, scope, depth);
        let b = self.leaf(ValueKind::Text, scope);
        match self.random.random_range(0..17) {
            0 => format!("upper({a})"),
            1 => format!("lower({a})"),
            2 => format!("trim({a})"),
            3 => format!("reverse({a})"),
            4 => format!("substr({a}, {}, {})", self.pick(&["1", "2", "0", "-1"]), self.pick(&["1", "3", "0"])),
            5 => format!("substr({a}, {})", self.pick(&["1", "2", "5"])),
            6 => format!("left({a}, {})", self.pick(&["1", "0", "-1", "9"])),
            7 => format!("right({a}, {})", self.pick(&["1", "0", "-1", "9"])),
            8 => format!("lpad({a}, 4, 'xy')"),
            9 => format!("replace({a}, 'a', {b})"),
            10 => format!("concat({a}, {b})"),
            11 => format!("({a} || {b})"),
            12 => format!("cast({} as varchar)", self.value(ValueKind::Integer, scope, depth)),
            13 => format!("repeat({a}, 2)"),
            14 => format!("split_part({a}, {}, 1)", self.pick(&["'a'", "' '", "'l'"])),
            15 => format!("concat_ws('-', {a}, {b})"),
            _ => format!("regexp_replace({a}, '[a-f]+', 'z', 'g')"),
        }
    }

    fn time_value(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        let a = self.value(ValueKind::Time, scope, depth);
        match self.random.random_range(0..8) {
            0 => format!("({a} + interval '{}')", self.pick(&["1 day", "90 minutes", "1 month", "1 year 2 hours"])),
            1 => format!("({a} - interval '{}')", self.pick(&["1 day", "30 seconds", "1 month"])),
            2 => {
                let part = self.pick(&["year", "quarter", "month", "week", "day", "hour", "minute", "second"]);
                format!("date_trunc('{part}', {a})")
            }
            3 => format!("cast({} as timestamp)", self.value(ValueKind::Date, scope, depth)),
            4 => format!("greatest({a}, {})", self.leaf(ValueKind::Time, scope)),
            5 => format!(
                "(({a} at time zone 'UTC') at time zone '{}')",
                self.pick(&["Europe/Berlin", "America/New_York"])
            ),
            6 => format!("(({a} at time zone '{}') at time zone 'UTC')", self.pick(&["Europe/Berlin", "Asia/Kolkata"])),
            _ => format!("cast(cast({a} as varchar) as timestamp)"),
        }
    }

    fn date_value(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        match self.random.random_range(0..3) {
            0 => format!("cast({} as date)", self.value(ValueKind::Time, scope, depth)),
            1 => format!("cast({} + interval '1 month' as date)", self.value(ValueKind::Date, scope, depth)),
            _ => format!("cast({} as date)", self.pick(&["'2026-02-28'", "'2000-01-01'"])),
        }
    }

    fn decimal_value(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        let a = self.value(ValueKind::Decimal, scope, depth);
        let b = self.leaf(ValueKind::Decimal, scope);
        match self.random.random_range(0..7) {
            0 => format!("({a} + {b})"),
            1 => format!("({a} - {b})"),
            2 => format!("({a} * {})", self.pick(&["2", "0.5::decimal(2, 1)", "-1"])),
            3 => format!("abs({a})"),
            4 => format!("cast({} as decimal(38, 2))", self.value(ValueKind::Integer, scope, depth)),
            5 => format!("round({a}, 1)"),
            _ => format!("greatest({a}, {b})"),
        }
    }

    // ---- Conditions ----

    fn optional_where(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        if self.chance(2) { format!(" where {}", self.condition(scope, depth)) } else { String::new() }
    }

    fn condition(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        if depth > 0 && self.chance(3) {
            let a = self.condition(scope, depth - 1);
            let b = self.condition(scope, depth - 1);
            return match self.random.random_range(0..5) {
                0 => format!("({a} and {b})"),
                1 => format!("({a} or {b})"),
                2 => format!("not ({a})"),
                3 => format!("({a}) is {}", self.pick(&["true", "not true", "false", "not false", "null", "not null"])),
                _ => format!("(({a}) is distinct from ({b}))"),
            };
        }
        if depth > 0 && self.chance(4) {
            return self.subquery_condition(scope, depth - 1);
        }
        let sampled: Vec<_> = scope.iter().filter(|column| !column.values.is_empty()).cloned().collect();
        if !sampled.is_empty() && self.chance(3) {
            let ScopeColumn { text, values, .. } = self.pick(&sampled);
            return format!("{text} {} {}", self.pick(&["<", "<=", ">", ">="]), self.pick(&values));
        }
        let kind = self.pick_kind(&KINDS, scope);
        if kind == ValueKind::Float {
            let a = self.leaf(kind, scope);
            let b = self.leaf(kind, scope);
            return self.compare_values(kind, &a, &b, scope);
        }
        let a = self.value(kind, scope, depth.min(1));
        let b = self.leaf(kind, scope);
        self.compare_values(kind, &a, &b, scope)
    }

    fn compare_values(&mut self, kind: ValueKind, a: &str, b: &str, scope: &[ScopeColumn]) -> String {
        let c = self.leaf(kind, scope);
        match self.random.random_range(0..12) {
            0..5 => format!("{a} {} {b}", self.pick(&["=", "<>", "<", "<=", ">", ">="])),
            5 => format!("{a} is {}", self.pick(&["null", "not null"])),
            6 => format!("{a} is {}distinct from {b}", self.pick(&["", "not "])),
            7 => format!("{a} {}between {b} and {c}", self.pick(&["", "not "])),
            8 | 9 => format!("{a} {}in ({b}, {c})", self.pick(&["", "not "])),
            _ if kind == ValueKind::Text => {
                let pattern = self.pick(&["'%a%'", "'_'", "'A%'", "'%\\%'", "''", "'%t'", "null"]);
                format!("{a} {}{} {pattern}", self.pick(&["", "not "]), self.pick(&["like", "ilike"]))
            }
            _ if kind == ValueKind::Flag => a.to_owned(),
            _ => format!("({a} = {b} or {a} < {c})"),
        }
    }

    // ---- Subqueries ----

    // The inner source, with what its expressions may name: the outer columns, too, for half of them.
    fn inner_source(&mut self, outer: &[ScopeColumn], depth: usize) -> (RowSource, Vec<ScopeColumn>) {
        let inner = if self.chance(3) { self.pick_bare_source() } else { self.pick_source(depth) };
        let mut scope = inner.columns.clone();
        if self.chance(2) {
            scope.extend_from_slice(outer);
        }
        (inner, scope)
    }

    // One value: an aggregate, or the first row of all.
    fn scalar_subquery(&mut self, kind: ValueKind, outer: &[ScopeColumn], depth: usize) -> String {
        let (inner, scope) = self.inner_source(outer, depth);
        let filter = self.optional_where(&scope, depth.min(1));
        let from = inner.from;
        if self.chance(5) {
            let value = self.value(kind, &inner.columns, 0);
            return format!("(select {value} from {from}{filter} order by {} limit 1)", inner.key.join(", "));
        }
        let aggregate = match kind {
            ValueKind::Integer if self.chance(2) => "count(*)".to_owned(),
            ValueKind::Flag => format!("bool_{}({})", self.pick(&["and", "or"]), self.leaf(kind, &inner.columns)),
            ValueKind::List => "array_agg(1)".to_owned(),
            _ => format!("{}({})", self.pick(&["max", "min"]), self.value(kind, &inner.columns, depth.min(1))),
        };
        format!("(select {aggregate} from {from}{filter})")
    }

    fn subquery_condition(&mut self, outer: &[ScopeColumn], depth: usize) -> String {
        let kind = self.pick_kind(&EXACT, outer);
        let (inner, scope) = self.inner_source(outer, depth);
        let filter = self.optional_where(&scope, depth.min(1));
        let from = inner.from;
        let left = self.leaf(kind, outer);
        let right = self.value(kind, &inner.columns, depth.min(1));
        match self.random.random_range(0..9) {
            0 => format!("exists (select 1 from {from}{filter})"),
            1 => format!("not exists (select 1 from {from}{filter})"),
            2 => format!("{left} in (select {right} from {from}{filter})"),
            3 => format!("{left} not in (select {right} from {from}{filter})"),
            4 | 5 => {
                let operator = self.pick(&["=", "<>", "<", "<=", ">", ">="]);
                format!("{left} {operator} {} (select {right} from {from}{filter})", self.pick(&["any", "all"]))
            }
            6 => {
                let second = self.pick(&EXACT);
                let a = self.leaf(second, outer);
                let b = self.leaf(second, &inner.columns);
                format!("({left}, {a}) in (select {right}, {b} from {from}{filter})")
            }
            _ => {
                let subquery = self.scalar_subquery(kind, outer, depth);
                format!("{left} {} {subquery}", self.pick(&["=", "<>", "<", ">="]))
            }
        }
    }

    fn place_subquery(&mut self, place: &str) -> (String, RowOrder) {
        let source = if self.chance(3) { self.pick_bare_source() } else { self.pick_source(1) };
        let RowSource { from, columns, key } = source;
        let key = key.join(", ");
        let kind = self.pick_kind(&EXACT, &columns);
        let condition = self.subquery_condition(&columns, 1);
        let sql = match place {
            "select" => match self.chance(2) {
                true => format!("select {key}, {condition} as v from {from}"),
                false => format!("select {key}, {} as v from {from}", self.scalar_subquery(kind, &columns, 1)),
            },
            "where" => format!("select {key} from {from} where {condition}"),
            "having" => {
                let group = format!("coalesce({}, null)", self.leaf(kind, &columns));
                let scalar = self.scalar_subquery(ValueKind::Integer, &[], 1);
                let group_scope = [ScopeColumn { text: group.clone(), kind, values: Vec::new() }];
                let having = match self.chance(2) {
                    true => format!("count(*) {} {scalar}", self.pick(&["<", ">", "<>"])),
                    false => self.subquery_condition(&group_scope, 1),
                };
                format!("select {group} as g, count(*) as n from {from} group by {group} having {having}")
            }
            "on" => {
                let other = self.pick_source(0);
                let link = self.equal_columns(&columns, &other.columns);
                let join = self.pick(&["join", "join", "join", "left join"]);
                let keys = [key, other.key.join(", ")].join(", ");
                format!("select {keys} from {from} {join} {} on {link} and {condition}", other.from)
            }
            "case" => {
                let value = self.value(kind, &columns, 1);
                let other = self.scalar_subquery(kind, &columns, 1);
                format!("select {key}, case when {condition} then {value} else {other} end as v from {from}")
            }
            _ => {
                let subquery = self.scalar_subquery(kind, &columns, 1);
                let direction = self.pick(&["asc", "desc"]);
                let sql = format!(
                    "select {key} from {from} order by {subquery} {direction} nulls last, {key} limit {}",
                    self.count(1, 9)
                );
                return (sql, RowOrder::Total);
            }
        };
        (sql, RowOrder::Free)
    }

    // ---- Kinds of statements ----

    fn select_values(&mut self) -> (String, RowOrder) {
        let source = self.pick_source(1);
        let items = self.select_items(&source.columns, 2);
        let filter = self.optional_where(&source.columns, 2);
        (format!("select {items} from {}{filter}", source.from), RowOrder::Free)
    }

    fn select_items(&mut self, scope: &[ScopeColumn], depth: usize) -> String {
        let items: Vec<_> = (0..self.count(1, 3))
            .map(|number| {
                let kind = self.pick_kind(&KINDS, scope);
                format!("{} as c{number}", self.value(kind, scope, depth))
            })
            .collect();
        items.join(", ")
    }

    // An equality of columns of one kind, if both sides have one.
    fn equal_columns(&mut self, a: &[ScopeColumn], b: &[ScopeColumn]) -> String {
        let kinds: Vec<_> = EXACT
            .into_iter()
            .filter(|kind| [a, b].iter().all(|scope| scope.iter().any(|column| column.kind == *kind)))
            .collect();
        let kind = if kinds.is_empty() { ValueKind::Integer } else { self.pick(&kinds) };
        let column = |g: &mut Self, scope: &[ScopeColumn]| {
            let columns: Vec<_> = scope.iter().filter(|column| column.kind == kind).collect();
            if columns.is_empty() { "1".to_owned() } else { g.pick(&columns).text.clone() }
        };
        let operator = self.pick(&["=", "=", "=", "=", "<", "<=", "is not distinct from"]);
        format!("{} {operator} {}", column(self, a), column(self, b))
    }

    fn joined_sources(&mut self) -> RowSource {
        let mut joined = self.pick_source(1);
        for _ in 0..self.count(1, 2) {
            let other = self.pick_source(0);
            let join = self.pick(&["join", "left join", "right join", "full join", "cross join"]);
            let mut on = String::new();
            if join != "cross join" {
                on = format!(" on {}", self.equal_columns(&joined.columns, &other.columns));
                if self.chance(3) {
                    let both = [&joined.columns[..], &other.columns].concat();
                    on += &format!(" and {}", self.condition(&both, 1));
                }
            }
            joined.from = format!("{} {join} {}{on}", joined.from, other.from);
            joined.columns.extend(other.columns);
            joined.key.extend(other.key);
        }
        joined
    }

    fn join_sources(&mut self) -> (String, RowOrder) {
        let joined = self.joined_sources();
        let filter = self.optional_where(&joined.columns, 1);
        let sql = match self.chance(2) {
            true => {
                let items = self.select_items(&joined.columns, 1);
                format!("select {}, {items} from {}{filter}", joined.key.join(", "), joined.from)
            }
            false => {
                let kind = self.pick_kind(&EXACT, &joined.columns);
                let value = self.leaf(kind, &joined.columns);
                format!("select count(*) as n, count({value}) as m, max({value}) as v from {}{filter}", joined.from)
            }
        };
        (sql, RowOrder::Free)
    }

    fn join_using(&mut self) -> (String, RowOrder) {
        let joins = ["join", "left join", "right join", "full join"];
        let join = self.pick(&joins);
        if self.chance(2) {
            let a = self.value_source();
            let b = self.value_source();
            let items = self.select_items(&[&a.columns[1..], &b.columns[1..]].concat(), 1);
            let second = match self.chance(3) {
                true => {
                    let c = self.value_source();
                    format!(" {} {} using (k)", self.pick(&["join", "left join"]), c.from)
                }
                false => String::new(),
            };
            let filter = if self.chance(3) { " where k > 0" } else { "" };
            return (
                format!("select k, {items} from {} {join} {} using (k){second}{filter}", a.from, b.from),
                RowOrder::Free,
            );
        }
        let [first, second] = self.pick(&[["tnce", "measurements"], ["measurements", "tnce"]]);
        let a = self.new_alias();
        let b = self.new_alias();
        let star = self.pick(&["run_id, pair_id", "pair_id, count(*) as n", "run_id, max(pair_id) as p"]);
        let group = if star.contains('(') {
            format!(" group by {}", star.split(',').next().unwrap_or(star))
        } else {
            String::new()
        };
        let limit = self.count(1, 40);
        let sql = format!(
            "select {star} from (select * from {first} where pair_id < {limit}) {a} {join} (select * from {second} where \
             pair_id > {}) {b} using (run_id, pair_id){group}",
            self.count(0, 30)
        );
        (sql, RowOrder::Free)
    }

    fn join_half(&mut self) -> (String, RowOrder) {
        let a = self.pick_source(0);
        let b = self.pick_source(0);
        let link = self.equal_columns(&a.columns, &b.columns);
        let more = match self.chance(2) {
            true => format!(" and {}", self.condition(&[&a.columns[..], &b.columns].concat(), 1)),
            false => String::new(),
        };
        let join = self.pick(&["semi join", "anti join"]);
        (format!("select {} from {} {join} {} on {link}{more}", a.key.join(", "), a.from, b.from), RowOrder::Free)
    }

    fn combine_queries(&mut self) -> (String, RowOrder) {
        let kinds: Vec<_> = (0..self.count(1, 2)).map(|_| self.pick(&KINDS)).collect();
        let mut sql = self.plain_query(&kinds);
        for _ in 0..self.count(1, 2) {
            let operator = self.pick(&["union", "union all", "intersect", "except", "intersect all", "except all"]);
            sql = format!("({sql}) {operator} ({})", self.plain_query(&kinds));
        }
        if self.chance(3) {
            return (format!("select c0, count(*) as n from ({sql}) u group by c0"), RowOrder::Free);
        }
        (sql, RowOrder::Free)
    }

    fn plain_query(&mut self, kinds: &[ValueKind]) -> String {
        let source = self.pick_source(0);
        let items: Vec<_> = kinds
            .iter()
            .enumerate()
            .map(|(number, kind)| format!("{} as c{number}", self.leaf(*kind, &source.columns)))
            .collect();
        format!("select {} from {}{}", items.join(", "), source.from, self.optional_where(&source.columns, 1))
    }

    fn window_call(&mut self, source: &RowSource) -> String {
        let scope = &source.columns;
        let kind = self.pick_kind(&EXACT, scope);
        let value = self.value(kind, scope, 1);
        let group = self.pick_kind(&EXACT, scope);
        let partition = match self.chance(2) {
            true => format!("partition by {} ", self.leaf(group, scope)),
            false => String::new(),
        };
        let sorted = self.pick_kind(&EXACT, scope);
        let first = self.leaf(sorted, scope);
        let order = format!(
            "order by {first} {} nulls {}, {}",
            self.pick(&["asc", "desc"]),
            self.pick(&["first", "last"]),
            source.key.join(", ")
        );
        let frame = self.pick(&[
            "",
            " rows between 1 preceding and 1 following",
            " rows between unbounded preceding and current row",
            " rows between current row and unbounded following",
            " rows between 2 following and 3 following",
            " range between unbounded preceding and unbounded following",
            " groups between 1 preceding and current row",
        ]);
        let integer = self.leaf(ValueKind::Integer, scope);
        let float = self.leaf(ValueKind::Float, scope);
        match self.random.random_range(0..16) {
            0 => format!("row_number() over ({partition}{order})"),
            1 => format!("rank() over ({partition}order by {first})"),
            2 => format!("dense_rank() over ({partition}order by {first} desc)"),
            3 => format!("percent_rank() over ({partition}order by {first})"),
            4 => format!("cume_dist() over ({partition}order by {first})"),
            5 => format!("ntile({}) over ({partition}{order})", self.pick(&["1", "2", "3", "7"])),
            6 => format!("lag({value}) over ({partition}{order})"),
            7 => format!("lead({value}, 2) over ({partition}{order})"),
            8 => format!("first_value({value}) over ({partition}{order}{frame})"),
            9 => format!("last_value({value}) over ({partition}{order}{frame})"),
            10 => format!("nth_value({value}, 2) over ({partition}{order}{frame})"),
            11 => format!("count({value}) over ({partition}{order}{frame})"),
            12 => format!("sum({integer}) over ({partition}{order}{frame})"),
            13 => format!("{}({value}) over ({partition}{order}{frame})", self.pick(&["min", "max"])),
            14 => format!("{}({float}) over ({partition}{order}{frame})", self.pick(&["min", "max", "avg"])),
            _ => {
                format!("count(*) over ({partition}order by {first} range between unbounded preceding and current row)")
            }
        }
    }

    fn select_windows(&mut self) -> (String, RowOrder) {
        let source = if self.chance(4) { self.joined_sources() } else { self.pick_source(1) };
        let calls: Vec<_> = (0..self.count(1, 2)).map(|n| format!("{} as w{n}", self.window_call(&source))).collect();
        let filter = self.optional_where(&source.columns, 1);
        let sql = format!("select {}, {} from {}{filter}", source.key.join(", "), calls.join(", "), source.from);
        (sql, RowOrder::Free)
    }

    fn qualify_rows(&mut self) -> (String, RowOrder) {
        let source = self.pick_source(1);
        let call = self.window_call(&source);
        let filter = self.optional_where(&source.columns, 1);
        let test = self.pick(&["= 1", "<= 2", "is null", "is not null"]);
        let call = if call.contains("row_number") || test.contains("null") {
            call
        } else {
            format!("row_number() over (order by {} desc)", source.key.join(" desc, "))
        };
        let key = source.key.join(", ");
        (format!("select {key} from {}{filter} qualify {call} {test}", source.from), RowOrder::Free)
    }

    fn aggregate_call(&mut self, source: &RowSource) -> String {
        let scope = &source.columns;
        let kind = self.pick_kind(&KINDS, scope);
        let value = self.value(kind, scope, 1);
        let exact_kind = self.pick_kind(&EXACT, scope);
        let exact = self.value(exact_kind, scope, 1);
        let integer = self.value(ValueKind::Integer, scope, 1);
        let float = self.leaf(ValueKind::Float, scope);
        let other = self.leaf(ValueKind::Float, scope);
        let text = self.value(ValueKind::Text, scope, 1);
        let flag = self.value(ValueKind::Flag, scope, 1);
        let key = source.key.join(", ");
        let call = match self.random.random_range(0..26) {
            0 => "count(*)".to_owned(),
            1 => format!("count({value})"),
            2 => format!("count(distinct {exact})"),
            3 | 4 => format!("sum({integer})"),
            5 => format!("sum(distinct {integer})"),
            6 => format!("avg({integer})"),
            7 => format!("sum({})", self.leaf(ValueKind::Decimal, scope)),
            8 => format!("avg({})", self.leaf(ValueKind::Decimal, scope)),
            9 => format!("sum({float})"),
            10 => format!("avg({float})"),
            11..14 => format!("max({value})"),
            14..17 => format!("min({value})"),
            17 => format!("{}({float})", self.pick(&["stddev", "stddev_pop", "var_samp", "var_pop"])),
            18 => format!("median({})", self.leaf(ValueKind::Integer, scope)),
            19 => format!("bool_{}({flag})", self.pick(&["and", "or"])),
            20 => format!("string_agg({text}, ',' order by {key})"),
            21 => format!("array_agg({exact} order by {key})"),
            22 => format!("array_agg(distinct {exact} order by {exact})"),
            23 => format!("{}({integer})", self.pick(&["bit_and", "bit_or", "bit_xor"])),
            24 => format!("{}({float}, {other})", self.pick(&["corr", "covar_pop", "regr_slope", "regr_count"])),
            _ => format!("count_if({flag})"),
        };
        if self.chance(5) && !call.contains("order by") {
            return format!("{call} filter (where {})", self.condition(scope, 1));
        }
        call
    }

    fn group_rows(&mut self) -> (String, RowOrder) {
        let source = if self.chance(3) { self.joined_sources() } else { self.pick_source(1) };
        let calls: Vec<_> =
            (0..self.count(1, 3)).map(|n| format!("{} as a{n}", self.aggregate_call(&source))).collect();
        let calls = calls.join(", ");
        let filter = self.optional_where(&source.columns, 1);
        let from = &source.from;
        if self.chance(3) {
            return (format!("select {calls} from {from}{filter}"), RowOrder::Free);
        }
        let kind = self.pick_kind(&KINDS, &source.columns);
        let group = match self.chance(2) || kind == ValueKind::Float {
            true => self.leaf(kind, &source.columns),
            false => self.value(kind, &source.columns, 1),
        };
        let by = self.pick(&["1", "g", group.as_str()]).to_owned();
        // A literal is no position.
        let by = if INTEGERS.contains(&by.as_str()) { "1".to_owned() } else { by };
        let having = match self.chance(3) {
            true => format!(" having {} {}", self.pick(&["count(*)", "max(1)"]), self.pick(&["> 1", "= 1", "< 5"])),
            false => String::new(),
        };
        (format!("select {group} as g, {calls} from {from}{filter} group by {by}{having}"), RowOrder::Free)
    }

    fn group_by_sets(&mut self) -> (String, RowOrder) {
        let source = self.pick_source(0);
        let columns: Vec<_> = source.columns.iter().filter(|column| EXACT.contains(&column.kind)).cloned().collect();
        if columns.is_empty() {
            return self.group_rows();
        }
        let a = self.pick(&columns).text;
        let b = self.pick(&columns).text;
        let call = self.aggregate_call(&source);
        let sets = match self.random.random_range(0..6) {
            0 => format!("rollup ({a}, {b})"),
            1 => format!("cube ({a}, {b})"),
            2 => format!("grouping sets (({a}, {b}), ({a}), ())"),
            3 => format!("grouping sets (({a}), ({b}))"),
            4 => format!("grouping sets (({a}, {b}), ())"),
            _ => "rollup (1, 2)".to_owned(),
        };
        let grouping = match self.chance(2) && !sets.contains("(1, 2)") {
            true => format!(", grouping({a}) as g"),
            false => String::new(),
        };
        let having = if self.chance(4) { " having count(*) > 1" } else { "" };
        let filter = self.optional_where(&source.columns, 1);
        let sql = format!(
            "select {a} as x, {b} as y{grouping}, {call} as v from {}{filter} group by {sets}{having}",
            source.from
        );
        (sql, RowOrder::Free)
    }

    fn share_query(&mut self) -> (String, RowOrder) {
        let source = self.pick_source(1);
        let kind = self.pick_kind(&EXACT, &source.columns);
        let value = self.value(kind, &source.columns, 1);
        let key = source.key.join(", ");
        let filter = self.optional_where(&source.columns, 1);
        let with = match self.chance(3) {
            true => format!("with w(x) as (select {value} from {}{filter})", source.from),
            false => format!(
                "with w as (select {value} as x, row_number() over (order by {key}) as n from {}{filter})",
                source.from
            ),
        };
        let condition = self.subquery_condition(&[ScopeColumn { text: "w.x".to_owned(), kind, values: Vec::new() }], 0);
        let body = match self.random.random_range(0..5) {
            0 => "select count(*) as n from w a join w b on a.x = b.x".to_owned(),
            1 => "select x, count(*) as n from w group by x".to_owned(),
            2 => "select x from w where x in (select max(x) from w) union all select min(x) from w".to_owned(),
            3 => format!("select x from w where {condition}"),
            _ => "select count(*) as n from w where x = any (select x from w where x is not null)".to_owned(),
        };
        (format!("{with} {body}"), RowOrder::Free)
    }

    fn count_recursively(&mut self) -> (String, RowOrder) {
        let names = self.pick(&["r", "r(n, f)"]);
        let start = if names == "r" { "1 as n, 1 as f" } else { "1, 1" };
        let step = self.pick(&["n + 1, f * 2", "n + 1, f + n", "n + 2, n"]);
        let union = self.pick(&["union all", "union all", "union"]);
        let limit = self.count(2, 9);
        let source = self.value_source();
        let body = match self.random.random_range(0..3) {
            0 => "select * from r".to_owned(),
            1 => "select max(n) as m, sum(f) as s from r".to_owned(),
            _ => format!("select r.n, {} from {} join r on r.n = {}", source.key[0], source.from, source.key[0]),
        };
        let sql =
            format!("with recursive {names} as (select {start} {union} select {step} from r where n < {limit}) {body}");
        (sql, RowOrder::Free)
    }

    fn select_distinct(&mut self) -> (String, RowOrder) {
        let source = self.pick_source(1);
        let filter = self.optional_where(&source.columns, 1);
        let from = source.from;
        let kind = self.pick_kind(&KINDS, &source.columns);
        let a = self.leaf(kind, &source.columns);
        match self.random.random_range(0..3) {
            0 => {
                let key = source.key.join(", ");
                let a = if source.columns.iter().any(|column| column.text == a) { a } else { key.clone() };
                let sql = format!("select distinct on ({a}) {a} as c0, {key} from {from}{filter} order by {a}, {key}");
                (sql, RowOrder::Free)
            }
            1 => (format!("select distinct {a} as c0 from {from}{filter}"), RowOrder::Free),
            _ => {
                let b = self.value(ValueKind::Integer, &source.columns, 1);
                (
                    format!("select count(*) as n from (select distinct {a} as c0, {b} as c1 from {from}{filter}) d"),
                    RowOrder::Free,
                )
            }
        }
    }

    fn order_rows(&mut self) -> (String, RowOrder) {
        let source = if self.chance(4) { self.joined_sources() } else { self.pick_source(1) };
        let filter = self.optional_where(&source.columns, 1);
        let kind = self.pick_kind(&KINDS, &source.columns);
        let value = if kind == ValueKind::Float {
            self.leaf(kind, &source.columns)
        } else {
            self.value(kind, &source.columns, 1)
        };
        let nulls = self.pick(&["", " nulls first", " nulls last"]);
        let keys: Vec<_> = source
            .key
            .iter()
            .map(|key| format!("{key} {}", self.pick(&["asc nulls last", "desc nulls first"])))
            .collect();
        let direction = self.pick(&["", " asc", " desc"]);
        let by = self.pick(&["v", "1", value.as_str()]).to_owned();
        let by = if INTEGERS.contains(&by.as_str()) { "1".to_owned() } else { by };
        let limit = match self.random.random_range(0..4) {
            0 => format!(" limit {}", self.count(0, 20)),
            1 => format!(" limit {} offset {}", self.count(1, 9), self.count(0, 9)),
            2 => format!(" offset {}", self.count(0, 9)),
            _ => String::new(),
        };
        let sql = format!(
            "select {value} as v, {} from {}{filter} order by {by}{direction}{nulls}, {}{limit}",
            source.key.join(", "),
            source.from,
            keys.join(", ")
        );
        (sql, RowOrder::Total)
    }

    fn join_lateral(&mut self) -> (String, RowOrder) {
        let outer = self.pick_source(0);
        let inner = self.pick_source(0);
        let both = [&outer.columns[..], &inner.columns].concat();
        let alias = self.new_alias();
        let link = self.equal_columns(&outer.columns, &inner.columns);
        let kind = self.pick_kind(&EXACT, &inner.columns);
        let value = self.leaf(kind, &inner.columns);
        let condition = if self.chance(2) { format!(" and {}", self.condition(&both, 0)) } else { String::new() };
        let key = outer.key.join(", ");
        let subquery = match self.random.random_range(0..3) {
            0 => format!("select count(*) as v from {} where {link}{condition}", inner.from),
            1 => format!("select max({value}) as v from {} where {link}{condition}", inner.from),
            _ => format!("select {value} as v from {} where {link}{condition}", inner.from),
        };
        let sql = match self.chance(2) {
            true => format!("select {key}, {alias}.v from {}, lateral ({subquery}) {alias}", outer.from),
            false => {
                format!("select {key}, {alias}.v from {} left join lateral ({subquery}) {alias} on true", outer.from)
            }
        };
        (sql, RowOrder::Free)
    }

    fn cast_values(&mut self) -> (String, RowOrder) {
        let source = self.value_source();
        let key = source.key.join(", ");
        let column = self.pick(&source.columns);
        let types: &[&str] = match column.kind {
            ValueKind::Integer => {
                &["smallint", "int", "bigint", "double", "real", "decimal(20, 2)", "varchar", "boolean"]
            }
            ValueKind::Float => &["smallint", "int", "bigint", "real", "decimal(12, 3)"],
            ValueKind::Text => &["int", "double", "varchar", "boolean", "timestamp", "date", "decimal(10, 2)"],
            ValueKind::Flag => &["int", "varchar", "bigint"],
            ValueKind::Time => &["date", "varchar", "timestamp", "time"],
            ValueKind::Date => &["timestamp", "varchar", "date"],
            ValueKind::Decimal | ValueKind::List => &["int", "double", "bigint", "decimal(8, 1)", "varchar"],
        };
        let to = self.pick(types);
        let cast = self.pick(&["cast", "try_cast", "try_cast"]);
        let value = self.value(column.kind, &source.columns, 1);
        (format!("select {key}, {cast}({value} as {to}) as v from {}", source.from), RowOrder::Free)
    }

    fn unnest_lists(&mut self) -> (String, RowOrder) {
        let source = self.pick_source(0);
        let list = self.value(ValueKind::List, &source.columns, 1);
        let key = source.key.join(", ");
        let from = source.from;
        let sql = match self.random.random_range(0..7) {
            0 => format!("select {key}, unnest({list}) as v from {from}"),
            1 => format!("select v, count(*) as n from (select unnest({list}) as v from {from}) u group by v"),
            2 => format!(
                "select {key}, array_has({list}, {}) as v from {from}",
                self.leaf(ValueKind::Integer, &source.columns)
            ),
            3 => format!("select {key}, array_to_string({list}, '-') as v from {from}"),
            4 => format!("select {key}, array_sort({list}) as v from {from}"),
            5 => format!("select {key}, array_length(array_distinct({list})) as v from {from}"),
            _ => format!(
                "select {key}, array_concat({list}, {}) as v, ({list})[1:2] as w from {from}",
                self.pick(&LISTS)
            ),
        };
        (sql, RowOrder::Free)
    }
}
