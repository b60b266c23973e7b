//! The pages' code for other programs, run as it is against a server:
//! `node tests/snippets.mjs http://127.0.0.1:8420 FOLDER`. FOLDER/bin has `python` with pyarrow, polars, and what
//! `echolake.rerun` needs, and `duckdb`.
import assert from 'node:assert/strict'
import { execFile } from 'node:child_process'
import { mkdtemp, readFile, stat, writeFile } from 'node:fs/promises'
import { tmpdir } from 'node:os'
import { join, resolve } from 'node:path'
import { promisify } from 'node:util'
import { createServer } from 'vite'

const [base, tools] = process.argv.slice(2)
const LIMIT_MS = 240_000
const vite = await createServer({ server: { middlewareMode: true }, appType: 'custom', logLevel: 'error' })
const { EXAMPLES, LANGUAGES, rerunCommand, snippet } = await vite.ssrLoadModule('/src/lib/snippets.ts')
const folder = await mkdtemp(join(tmpdir(), 'snippets-'))
const run = async (program, ...args) =>
  (
    await promisify(execFile)(program, args, {
      cwd: folder,
      timeout: LIMIT_MS,
      maxBuffer: 1 << 28,
      env: { ...process.env, PATH: `${join(tools, 'bin')}:${process.env.PATH}`, PYTHONPATH: resolve('../python/src') },
    })
  ).stdout
const get = async (path) => (await fetch(base + path)).json()
const sql = async (body) =>
  fetch(`${base}/api/v1/sql`, {
    method: 'POST',
    headers: { 'content-type': 'application/json' },
    body: JSON.stringify(body),
  })
/** Rows that the server has for a query. */
const rowsOf = async (query) => (await (await sql({ query })).json()).length

const lake = await get('/api/v1/lake')
const queries = [
  ...EXAMPLES.map((one) => one.query(lake)),
  // What would end a text of one of the languages.
  `select 'it''s' as "a", '"""' as b, '\\n"##' as c, '\\' as "d"`,
  'select 1 as "a"',
  `select '""' as """"`,
  `select count(*) as n -- a comment\nfrom system.versions`,
]
/** Rows of the table that a snippet in Python has read. */
const rowsOfScript = async (text, count) => {
  await writeFile(join(folder, 'snippet.py'), `${text}\nprint("rows:", ${count})\n`)
  return Number(/rows: (\d+)/.exec(await run('python', 'snippet.py'))[1])
}
const ways = {
  // Lines of an answer without line breaks in its texts, and the header.
  curl: async (text) => (await run('sh', '-c', text)).trimEnd().split('\n').length - 1,
  Python: (text) => rowsOfScript(text, 'table.num_rows'),
  polars: (text) => rowsOfScript(text, 'table.height'),
  DuckDB: async (text) => {
    await run('sh', '-c', text)
    const count = ['duckdb', '-csv', '-noheader', '-c', "select count(*) from 'answer.parquet'"]
    return Number((await run(...count)).trim())
  },
}
assert.deepEqual(Object.keys(ways), [...LANGUAGES])
for (const query of queries) {
  const expected = await rowsOf(query)
  for (const language of LANGUAGES) {
    const found = await ways[language](snippet(language, query, base))
    assert.equal(found, expected, `${language}: ${query}`)
  }
  process.stdout.write(`ok ${query.slice(0, 60).replaceAll('\n', ' ')}: ${expected} rows\n`)
}
const { items } = await get('/api/v1/runs?limit=1')
const url = `${base}/api/v1/runs/${encodeURIComponent(items[0].run_id)}/file.mcap`
await run('sh', '-c', `${rerunCommand(url)} --save run.rrd`)
const saved = join(folder, 'run.rrd')
assert.ok((await stat(saved)).size > 100_000, 'rerun read the run')
assert.equal((await readFile(saved)).subarray(0, 3).toString(), 'RRF')
process.stdout.write('ok rerun\n')
await vite.close()
