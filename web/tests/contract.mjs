//! Asks a server every GET of openapi.json and checks its answers against it: `node tests/contract.mjs http://127.0.0.1:8420`.
import { readFile } from 'node:fs/promises'
import Ajv from 'ajv/dist/2020.js'
import formats from 'ajv-formats'

const base = process.argv[2]
const api = JSON.parse(await readFile(new URL('../openapi.json', import.meta.url), 'utf8'))
const ajv = new Ajv({ strict: false, allErrors: true })
formats(ajv)
ajv.addSchema(api, 'api')
const get = async (path) => (await fetch(base + path)).json()
const post = (query, accept) =>
  fetch(`${base}/api/v1/sql`, {
    method: 'POST',
    headers: { 'content-type': 'application/json', accept },
    body: JSON.stringify({ query }),
  })
const surfaces = (await get('/api/v1/surfaces?limit=500')).items
const runs = (await get('/api/v1/runs?limit=1')).items
const measured = surfaces.find((s) => s.typology !== 'reference')
/** Servers for developing pages leave these out. */
const OPTIONAL = new Set([
  '/api/v1/files',
  '/api/v1/foxglove/manifest',
  '/api/v1/layouts/echolake.json',
  '/api/v1/slices.mcap',
  '/api/v1/slices.sofa',
  '/api/v1/tables/{table}',
  '/api/v1/tables/{table}/{file}',
  '/metrics',
])

let failures = 0
let asked = 0
async function check(path, template, expected = 200) {
  asked += 1
  const response = await fetch(base + path, { headers: template.endsWith('file.mcap') ? { range: 'bytes=0-99' } : {} })
  const answer = api.paths[template].get.responses[response.status] ?? api.paths[template].get.responses.default
  const fail = (why) => {
    failures += 1
    process.stdout.write(`FAIL ${path}: ${why}\n`)
  }
  const type = response.headers.get('content-type')?.split(';')[0] ?? ''
  const ranged = template.endsWith('file.mcap') && response.status === 206
  if (response.status !== expected && !ranged) {
    if (!(response.status === 404 && OPTIONAL.has(template))) fail(`status ${response.status}, not ${expected}`)
    return
  }
  const content = answer.$ref
    ? { 'application/problem+json': { schema: { $ref: '#/components/schemas/Problem' } } }
    : answer.content
  if (!content?.[type]) {
    fail(`type ${type}, not ${Object.keys(content ?? {})}`)
    return
  }
  if (!type.endsWith('json')) {
    await response.arrayBuffer()
    return
  }
  const schema = JSON.parse(JSON.stringify(content[type].schema).replaceAll('"#/', '"api#/'))
  const valid = ajv.compile(schema)
  if (!valid(await response.json()))
    fail(
      valid.errors
        .slice(0, 4)
        .map((e) => `${e.instancePath} ${e.message} ${JSON.stringify(e.params)}`)
        .join('; '),
    )
}

for (const [template, { get: operation }] of Object.entries(api.paths)) {
  if (!operation) continue
  const query = (operation.parameters ?? [])
    .filter((p) => p.in === 'query' && (p.required || p.example))
    .map((p) => `${p.name}=${encodeURIComponent(p.example ?? p.schema.minimum ?? 0)}`)
    .join('&')
  const fill = (surface) =>
    template
      .replace('{surface_id}', encodeURIComponent(surface))
      .replace('{pair_id}', '159')
      .replace('{run_id}', runs[0].run_id)
      .replace('{table}', 'points')
      .replace('{file}', 'none.parquet') + (query ? `?${query}` : '')
  await check(fill(measured.surface_id), template)
  if (template.includes('{surface_id}'))
    for (const reference of surfaces.filter((s) => s.typology === 'reference'))
      if (!/wav|spectrogram/.test(template)) await check(fill(reference.surface_id), template)
  if (template.includes('{surface_id}')) await check(fill('no such surface'), template, 404)
  if (template.includes('{run_id}')) await check(template.replace('{run_id}', 'none'), template, 404)
}
await check('/api/v1/surfaces?level=nonsense:1..2', '/api/v1/surfaces', 400)
await check('/api/v1/surfaces?relief=a..b', '/api/v1/surfaces', 400)
await check(`/api/v1/surfaces/${measured.surface_id}/grid?microphone=x`, '/api/v1/surfaces/{surface_id}/grid', 400)
for (const [type, opening] of [
  ['application/vnd.apache.arrow.stream', '\xff\xff\xff\xff'],
  ['application/vnd.apache.parquet', 'PAR1'],
  ['text/csv', 'n'],
  ['application/json', '['],
]) {
  asked += 1
  const response = await post('select 1 as n', type)
  const bytes = Buffer.from(await response.arrayBuffer()).toString('latin1')
  // The command writes Arrow files where the server writes streams.
  if (response.status !== 200 || !(bytes.startsWith(opening) || bytes.startsWith('ARROW1'))) {
    failures += 1
    process.stdout.write(`FAIL sql as ${type}: ${response.status}, ${JSON.stringify(bytes.slice(0, 40))}\n`)
  }
}
for (const [query, code] of [
  ['select nope', 'query_invalid'],
  ['delete from points', 'read_only'],
]) {
  asked += 1
  const problem = await (await post(query, 'application/json')).json()
  if (problem.code !== code) process.stdout.write(`note: ${query}: ${problem.code}, not ${code}\n`)
  if (!problem.detail || !(problem.status >= 400 && problem.status < 500)) {
    failures += 1
    process.stdout.write(`FAIL ${query}: ${JSON.stringify(problem)}\n`)
  }
}
process.stdout.write(failures ? `${failures} failures of ${asked}\n` : `${asked} answers as in openapi.json\n`)
process.exitCode = failures ? 1 : 0
