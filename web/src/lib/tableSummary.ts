//! What the columns of a table hold: rows, gaps, distinct values, ends and a histogram, all by one query.
import { sql, type Schemas } from './api'
import { plain } from './format'

type Column = Schemas['Column']

export const HISTOGRAM_BINS = 12
/** The bounds of finite numbers: a histogram has no place for others. */
const FINITE = 'between -1.7e308 and 1.7e308'

/** What a column holds. */
export interface ColumnSummary {
  readonly rows: number
  readonly nulls: number
  /** About how many different values. */
  readonly distinct: number
  readonly low: string
  readonly high: string
  /** Numbers of rows from the lowest to the highest value; null for texts, times and a single value. */
  readonly bins: readonly number[] | null
}

const identifier = (name: string) => `"${name.replaceAll('"', '""')}"`
/** A table's name, with its schema before a dot unless it is the lake's. */
const tableName = (name: string) => name.split('.').map(identifier).join('.')
const literal = (text: string) => `'${text.replaceAll("'", "''")}'`
const isNumber = ({ type }: Column) => /^(U?Int|Float)\d+$/.test(type)
const isText = ({ type }: Column) => type === 'Utf8' || type === 'Boolean' || type.startsWith('Timestamp')

/** Columns below each other, as names and values of one type. */
const unpivoted = (table: string, columns: readonly Column[], type: string) =>
  `select unnest([${columns.map(({ name }) => literal(name)).join(', ')}]) as name, ` +
  `unnest([${columns.map(({ name }) => `cast(${identifier(name)} as ${type})`).join(', ')}]) as value from ${tableName(table)}`

/** The query that summarises a table's numbers, texts and times; lists are left out. Undefined if it has nothing else. */
export function summaryQuery(table: string, columns: readonly Column[]): string | undefined {
  const [numbers, texts] = [columns.filter(isNumber), columns.filter(isText)]
  const parts: string[] = []
  if (numbers.length) {
    const values = unpivoted(table, numbers, 'double')
    const place = `least(${HISTOGRAM_BINS - 1}, floor(${HISTOGRAM_BINS} * (value - low) / nullif(high - low, 0)))`
    parts.push(
      `select name, case when value ${FINITE} and low < high then cast(${place} as int) end as bin, ` +
        'count(*) as rows, count(value) as filled, approx_distinct(cast(value as varchar)) as distinct_values, ' +
        'cast(min(value) as varchar) as low, cast(max(value) as varchar) as high\n' +
        `from (${values})\n  join (select name as of_column, min(value) as low, max(value) as high from (${values}) ` +
        `where value ${FINITE} or value is null group by name) on name = of_column\ngroup by 1, 2`,
    )
  }
  if (texts.length)
    parts.push(
      'select name, null as bin, count(*) as rows, count(value) as filled, ' +
        'approx_distinct(value) as distinct_values, min(value) as low, max(value) as high\n' +
        `from (${unpivoted(table, texts, 'varchar')})\ngroup by name`,
    )
  return parts.length ? parts.join('\nunion all\n') : undefined
}

/** A row of that query. */
export interface SummaryRow {
  readonly name: string
  readonly bin: number | null
  readonly rows: number
  readonly filled: number
  readonly distinct_values: number
  readonly low: string | null
  readonly high: string | null
}

/** Puts the rows of each column together. */
export function summariesOf(rows: readonly SummaryRow[], columns: readonly Column[]): Map<string, ColumnSummary> {
  const summaries = new Map<string, ColumnSummary>()
  for (const column of columns) {
    const own = rows.filter((row) => row.name === column.name)
    if (own.length === 0) continue
    const sum = (value: (row: SummaryRow) => number) => own.reduce((total, row) => total + value(row), 0)
    const counts = Array.from({ length: HISTOGRAM_BINS }, (_, bin) =>
      own.reduce((total, row) => (row.bin === bin ? total + row.filled : total), 0),
    )
    const all = sum((row) => row.rows)
    summaries.set(column.name, {
      rows: all,
      nulls: all - sum((row) => row.filled),
      distinct: sum((row) => row.distinct_values),
      ...endsOf(own, isNumber(column)),
      bins: counts.some((one) => one > 0) ? counts : null,
    })
  }
  return summaries
}

function endsOf(rows: readonly SummaryRow[], isNumeric: boolean): { low: string; high: string } {
  const [lows, highs] = [rows.map((row) => row.low), rows.map((row) => row.high)].map((list) =>
    list.filter((value) => value !== null),
  )
  if (!isNumeric) return { low: lows[0] ?? '', high: highs[0] ?? '' }
  const toNumber = (text: string) => Number(text.replace('inf', 'Infinity'))
  const [low, high] = [Math.min(...lows.map(toNumber)), Math.max(...highs.map(toNumber))]
  return lows.length ? { low: plain(low, 5), high: plain(high, 5) } : { low: '', high: '' }
}

/** Asks for a table's summary. */
export async function loadSummary(table: string, columns: readonly Column[]): Promise<Map<string, ColumnSummary>> {
  const query = summaryQuery(table, columns)
  if (!query) return new Map()
  return summariesOf((await (await sql(query, 'application/json')).json()) as SummaryRow[], columns)
}

/** Asks how many rows the stored tables have. A view may be computed, and the log of a large lake takes long to read. */
export async function loadRowCounts(): Promise<Map<string, number>> {
  const stored = "select table_name from information_schema.tables where table_type = 'BASE TABLE'"
  const tables = (await (await sql(stored, 'application/json')).json()) as { table_name: string }[]
  return countRows(tables.map((table) => table.table_name))
}

/** Counts the rows of tables by one query. */
export async function countRows(tables: readonly string[]): Promise<Map<string, number>> {
  if (tables.length === 0) return new Map()
  const query = tables.map((name) => `select ${literal(name)} as name, count(*) as rows from ${tableName(name)}`)
  const rows = (await (await sql(query.join(' union all '), 'application/json')).json()) as {
    name: string
    rows: number
  }[]
  return new Map(rows.map((row) => [row.name, row.rows]))
}
