//! Several statements in one text, as psql takes them: each ends by `;`, a line that begins with `\` is one of its own.
import { ApiError, type Schemas } from './api'
import { quoted } from './queries'

export interface Statement {
  /** Where its part of the text begins and ends; the next one's follows. */
  readonly from: number
  readonly to: number
  readonly text: string
}

/** Texts, quoted names and comments, in which `;` ends nothing; then what ends a statement, or is a whole one. */
const PART =
  /\b[eE]'(?:[^'\\]|\\[^]|'')*(?:'|$)|'(?:[^']|'')*(?:'|$)|"(?:[^"]|"")*(?:"|$)|\$(\w*)\$[^]*?(?:\$\1\$|$)|--[^\n]*|\/\*[^]*?(?:\*\/|$)|;|\\[^\n;]*/g
const COMMENT = /^(?:--|\/\*)/

/** The statements of a text; parts of nothing but comments belong to the statement after them. */
export function splitStatements(text: string): Statement[] {
  const found: Statement[] = []
  let [from, begins] = [0, 0]
  /** Whether the statement has begun: something else than space and comments. */
  const hasBegun = (to: number) => text.slice(begins, to).trim() !== ''
  function end(to: number, next: number) {
    const own = text.slice(from, to).trim()
    if (own) found.push({ from, to: next, text: own })
    from = begins = next
  }
  for (const { 0: part, index } of text.matchAll(PART)) {
    const after = index + part.length
    if (COMMENT.test(part)) {
      if (!hasBegun(index)) begins = after
    } else if (part === ';') {
      if (hasBegun(index)) end(index, after)
      else begins = after
    } else if (part.startsWith('\\') && !hasBegun(index)) {
      from = index
      end(after, text[after] === ';' ? after + 1 : after)
    }
  }
  if (hasBegun(text.length)) end(text.length, text.length)
  return found
}

/** An error of a statement, its place counted from the beginning of the text that the statement is in. */
export function placedError(error: ApiError, text: string, { from, text: own }: Statement): ApiError {
  const before = text.slice(0, text.indexOf(own, from)).split('\n')
  const message = error.message.replace(/\(line (\d+), column (\d+)\)/, (_, line: string, column: string) => {
    const first = line === '1' ? [...before[before.length - 1]].length : 0
    return `(line ${Number(line) + before.length - 1}, column ${Number(column) + first})`
  })
  return new ApiError(error.status, error.code, message, error.hint)
}

/** The index of the statement that a cursor is in, or behind. */
export function statementAt(statements: readonly Statement[], position: number): number {
  const at = statements.findIndex(({ to }) => position <= to)
  return at < 0 ? statements.length - 1 : at
}

/** The query that answers a statement: itself, or for `\d` the lake's tables, for `\d TABLE` its columns with units. */
export async function queryOf(statement: string, tables: () => Promise<readonly Schemas['Table'][]>): Promise<string> {
  if (!statement.startsWith('\\')) return statement
  const [, command, name = ''] = /^(\\\S*)\s*(.*?)\s*$/.exec(statement) as RegExpExecArray
  if (!/^\\d[t+]*$/.test(command))
    throw new ApiError(
      0,
      'query_invalid',
      `${command} is no command here`,
      '\\d lists the tables, \\d TABLE the columns of one. `echolake sql` and psql know more.',
    )
  if (!name)
    return (
      "select case table_schema when 'public' then table_name else concat(table_schema, '.', table_name) end as table_name, " +
      "table_type from information_schema.tables where table_schema in ('public', 'system') order by table_schema, table_name"
    )
  const table = (await tables()).find((one) => one.name === name.replaceAll('"', '').toLowerCase())
  if (!table) throw new ApiError(0, 'query_invalid', `no table \`${name}\``, '\\d lists the tables.')
  const rows = table.columns.map((column) =>
    [column.name, column.type, column.unit ?? '', column.comment ?? ''].map(quoted).join(', '),
  )
  return `select * from (values (${rows.join('), (')})) as columns(column_name, type, unit, meaning)`
}
