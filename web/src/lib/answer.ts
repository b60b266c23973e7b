//! The rows of a query, from an Arrow stream.
import { tableFromIPC, type ListType } from '@uwdata/flechette'
import { plain } from './format'

export interface Answer {
  readonly columns: readonly {
    readonly name: string
    readonly type: string
    readonly numeric: boolean
    /** Its unit, or '': what the lake's tables say of it, else what its name ends with. */
    readonly unit: string
    /** Whether its values are lists of numbers. */
    readonly isCurve: boolean
    at(i: number): unknown
  }[]
  readonly rows: number
  readonly bytes: number
  /** Whether there are more rows than these. */
  readonly isCut: boolean
}

/** What a page takes in; the rows after that are left out. */
const MOST_BYTES = 48_000_000
const NUMERIC = new Set([2, 3, 7])
const NAMES: Record<number, string> = {
  1: 'null',
  2: 'integer',
  3: 'number',
  4: 'binary',
  5: 'text',
  6: 'boolean',
  7: 'decimal',
  8: 'date',
  9: 'time',
  10: 'time',
  11: 'interval',
  12: 'list',
  13: 'struct',
  16: 'list',
  17: 'map',
  20: 'text',
  21: 'list',
  24: 'text',
}
const TIMESTAMP = 10
const LISTS = new Set([12, 16, 21])

/** The end of the last whole message of an Arrow stream: each has a mark, its length, metadata that say how long its body is,
 * and the body (Arrow's columnar format, "Encapsulated message format"). */
function endOfMessages(stream: Uint8Array): number {
  const view = new DataView(stream.buffer)
  for (let at = 0; ;) {
    if (at + 8 > stream.length) return at
    const metadata = view.getInt32(at + 4, true)
    if (metadata === 0 || at + 8 + metadata > stream.length) return at
    const root = at + 8 + view.getInt32(at + 8, true)
    const fields = root - view.getInt32(root, true)
    const bodyField = view.getInt16(fields, true) > 10 ? view.getInt16(fields + 10, true) : 0
    const next = at + 8 + metadata + (bodyField ? Number(view.getBigInt64(root + bodyField, true)) : 0)
    if (next > stream.length) return at
    at = next
  }
}

/** Reads an answer; of one that is too much, the rows that came first. */
export async function readAnswer(response: Response): Promise<Answer> {
  const parts: Uint8Array[] = []
  let bytes = 0
  const reader = (response.body as ReadableStream<Uint8Array>).getReader()
  while (bytes <= MOST_BYTES) {
    const { done, value } = await reader.read()
    if (done) break
    bytes += value.length
    parts.push(value)
  }
  const isCut = bytes > MOST_BYTES
  if (isCut) await reader.cancel()
  let whole = new Uint8Array(bytes)
  let at = 0
  for (const part of parts) {
    whole.set(part, at)
    at += part.length
  }
  if (isCut) whole = whole.subarray(0, endOfMessages(whole))
  if (bytes === 0) return { columns: [], rows: 0, bytes, isCut }
  // Times in ns are larger than a number holds exactly: integers of 64 bits come as BigInt.
  const table = tableFromIPC(whole, { useBigInt: true })
  return {
    rows: table.numRows,
    bytes,
    isCut,
    columns: table.schema.fields.map((field, i) => {
      const column = table.getChildAt(i)
      const typeId = field.type.typeId as number
      return {
        name: field.name,
        type: NAMES[typeId] ?? 'value',
        numeric: NUMERIC.has(typeId) || typeId === TIMESTAMP,
        unit: unitOf(field.name, field.metadata?.get('unit')),
        isCurve: LISTS.has(typeId) && NUMERIC.has((field.type as ListType).children[0].type.typeId as number),
        at: (row: number) => (typeId === TIMESTAMP ? when(column.at(row) as number | null) : column.at(row)),
      }
    }),
  }
}

/** Units that names of columns end with. */
const UNITS: Record<string, string> = { db: 'dB', c: '°C', pct: '%', hpa: 'hPa', hz: 'Hz', bytes: 'B' }
/** A column, or a function of it that keeps its unit. */
const WITH_UNIT = /^(?:(?:min|max|avg|median|sum)\((?:\w+\.)*)?\w+_(db|mm|deg|c|pct|hpa|hz|s|ms|us|ns|ppm|bytes)\)?$/

/** The unit of a column of an answer. What is computed has none of its own: the lake's names end with theirs. */
function unitOf(name: string, given: string | undefined): string {
  if (given !== undefined) return given === '1' ? '' : given === 'C' ? '°C' : given
  const ending = WITH_UNIT.exec(name)?.[1] ?? ''
  return UNITS[ending] ?? ending
}

const when = (ms: number | null) => (ms === null ? null : new Date(ms))

const LONG = 6

/** A value as a cell shows it. */
export function cellText(value: unknown): string {
  if (value === null || value === undefined) return ''
  if (value instanceof Date)
    return Number.isNaN(value.getTime())
      ? 'out of range'
      : value
          .toISOString()
          .replace('T', ' ')
          .replace(/\.?0*Z$/, '')
  if (typeof value === 'bigint' || typeof value === 'number') return plain(value)
  if (ArrayBuffer.isView(value) || Array.isArray(value)) {
    const list = Array.from(value as ArrayLike<unknown>)
    return `${list.slice(0, LONG).map(cellText).join(', ')}${list.length > LONG ? `, … ${list.length} values` : ''}`
  }
  if (typeof value === 'object')
    return JSON.stringify(value, (_, inner: unknown) => (typeof inner === 'bigint' ? Number(inner) : inner))
  return String(value)
}
