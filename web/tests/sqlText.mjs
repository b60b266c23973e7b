//! How the SQL page takes a text apart and orders rows, without a server: `node tests/sqlText.mjs`.
import assert from 'node:assert/strict'
import { createServer } from 'vite'

const vite = await createServer({ server: { middlewareMode: true, ws: false }, appType: 'custom', logLevel: 'error' })
const { placedError, queryOf, splitStatements, statementAt } = await vite.ssrLoadModule('/src/lib/statements.ts')
const { ApiError } = await vite.ssrLoadModule('/src/lib/api.ts')
const { nearestNames } = await vite.ssrLoadModule('/src/lib/suggest.ts')
const { chooseRows, numberFormat } = await vite.ssrLoadModule('/src/lib/resultRows.ts')
const { compareNames, seriesOf } = await vite.ssrLoadModule('/src/lib/series.ts')

for (const [text, expected] of [
  ['select 1', ['select 1']],
  ['select 1;\n select 2;', ['select 1', 'select 2']],
  [`select ';' as a, "b;c", 'it''s;' ; select 2`, [`select ';' as a, "b;c", 'it''s;'`, 'select 2']],
  ["select E'\\';' ; select 2", ["select E'\\';'", 'select 2']],
  ['select $t$a;$b$;$t$; select 2', ['select $t$a;$b$;$t$', 'select 2']],
  ['-- a; b\nselect 1 /* ; */; -- end', ['-- a; b\nselect 1 /* ; */']],
  ['\\d\n\\d pairs;\nselect 1', ['\\d', '\\d pairs', 'select 1']],
  ["select '\\d' as a", ["select '\\d' as a"]],
  ["select 'open; select 2", ["select 'open; select 2"]],
  [' ;; ', []],
])
  assert.deepEqual(
    splitStatements(text).map((one) => one.text),
    expected,
    text,
  )
assert.deepEqual(nearestNames('/nowhere', ['/compare', '/operations']), [])
assert.deepEqual(nearestNames('/compair', ['/compare', '/operations']), ['/compare'])
const wrong = 'select 1;\nselect 2; select\nx'
const placeOf = (index, place) =>
  placedError(new ApiError(400, 'query_invalid', `no column ${place}`, ''), wrong, splitStatements(wrong)[index])
    .message
assert.equal(placeOf(0, '(line 1, column 8)'), 'no column (line 1, column 8)')
assert.equal(placeOf(2, '(line 1, column 8)'), 'no column (line 2, column 18)')
assert.equal(placeOf(2, '(line 2, column 1)'), 'no column (line 3, column 1)')
const two = splitStatements('select 1;\nselect 2;\n')
assert.deepEqual(
  [0, 8, 9, 10, 18, 19, 20].map((position) => statementAt(two, position)),
  [0, 0, 0, 1, 1, 1, 1],
)

const tables = async () => [
  { name: 'pairs', columns: [{ name: 'direct_mm', type: 'Float64', unit: 'mm', comment: "it's" }] },
]
assert.equal(await queryOf('select 1', tables), 'select 1')
assert.match(await queryOf('\\d pairs', tables), /\('direct_mm', 'Float64', 'mm', 'it''s'\)/)
await assert.rejects(queryOf('\\d nosuch', tables), { message: 'no table `nosuch`' })
await assert.rejects(queryOf('\\x', tables), { message: '\\x is no command here' })

const bands = ['total', '10000', '2500', '5000']
assert.deepEqual([...bands].sort(compareNames), ['2500', '5000', '10000', 'total'])

const column = (name, values, more = {}) => ({
  name,
  type: typeof values[0] === 'number' ? 'number' : 'text',
  numeric: typeof values[0] === 'number',
  unit: '',
  isCurve: false,
  at: (row) => values[row],
  ...more,
})
const levels = column('level_db', [-4.49297e-7, -0.5, 12.25, null], { numeric: true, type: 'number', unit: 'dB' })
const answer = { rows: 4, bytes: 0, columns: [column('band', bands), levels] }
const rows = (filters, order) => [...chooseRows(answer, filters, order)]
assert.deepEqual(rows({}, { column: 'band', isDescending: false }), [2, 3, 1, 0])
assert.deepEqual(rows({}, { column: 'level_db', isDescending: true }), [2, 0, 1, 3], 'what has no value is last')
assert.deepEqual(rows({ level_db: '>= -0.5' }), [0, 1, 2])
assert.deepEqual(rows({ level_db: '-1..0' }), [0, 1])
assert.deepEqual(rows({ band: 'TOT' }), [0])
const written = (one) => {
  const write = numberFormat(one, Uint32Array.of(0, 1, 2))
  return [0, 1, 2].map((row) => write(one.at(row)))
}
assert.deepEqual(written(levels), ['0.00', '−0.50', '12.25'])
assert.deepEqual(written(column('p', [1e-9, 0.5, 0.25])), ['1e−9', '0.5000', '0.2500'])
assert.deepEqual(written(column('rows', [17706, 1, 141648])), ['17\u202f706', '1', '141\u202f648'])
assert.deepEqual(written(column('pair_id', [17706, 1, 2])), ['17706', '1', '2'])

// Rows of one key share a line; a second of the same series has its own.
const names = ['a', 'b', 'a', 'a']
const keys = [2, 1, 1, 1]
const value = column('v', [20, 11, 10, 12])
const put = seriesOf(
  4,
  (row) => keys[row],
  value,
  ['a', 'b'],
  (row) => names[row],
  (x, y) => x - y,
)
assert.deepEqual(put.keys, [1, 1, 2])
assert.deepEqual(
  put.series.map((one) => one.values),
  [
    [10, 12, 20],
    [11, undefined, undefined],
  ],
)
await vite.close()
process.stdout.write('ok texts of several statements, orders and filters of rows\n')
