//! Serves the pages and the API of openapi.json from a lake, for developing and trying the pages:
//! `node dev/server.mjs --lake FOLDER --echolake BINARY [--port 8420] [--built]`. With `--built` it serves dist/
//! with the headers of the real server, without it Vite serves the sources. With `--token T` only who knows it is answered.
import { createServer } from 'node:http'
import { createReadStream } from 'node:fs'
import { readFile, stat } from 'node:fs/promises'
import { createHash } from 'node:crypto'
import { gzipSync } from 'node:zlib'
import { extname, join, normalize } from 'node:path'
import { fileURLToPath } from 'node:url'
import { parseArgs } from 'node:util'
import { openLake, QueryError, text } from './lake.mjs'
import { correlations, page, rigOf, summaries } from './catalogue.mjs'
import { curves, detail, grid, heights, pair, seriesOf, wav } from './surface.mjs'
import { attachment, summary } from './mcap.mjs'
import { map } from './map.mjs'
import { hillshade } from './png.mjs'

const { values: options } = parseArgs({ options: { lake: { type: 'string' }, echolake: { type: 'string', default: 'echolake' }, port: { type: 'string', default: '8420' }, built: { type: 'boolean', default: false }, token: { type: 'string' } } })
const web = fileURLToPath(new URL('..', import.meta.url))
const lake = openLake(options.echolake, options.lake)
const rig = rigOf(await readFile(join(options.lake, 'lake.toml'), 'utf8'))
const points = await lake.rows('select point_id, layer, gridx, gridy, x_mm, y_mm, z_mm from points order by point_id')
const entries = await summaries(lake, rig.bands)
const [totals] = await lake.rows('select count(*) as runs, sum(measurements) as measurements, (select count(*) from pairs) as pairs from runs')
const version = createHash('sha256').update(JSON.stringify([entries.map((e) => e.row.run_id), totals])).digest('hex').slice(0, 12)

const CSP = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; font-src 'self'; media-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
const fail = (status, code, detail, hint) => Object.assign(new Error(detail), { status, code, hint })
const whole = (value, name) => {
  if (!/^\d+$/.test(value ?? '')) throw fail(400, 'request_invalid', `${name} is not a whole number: ${value}`)
  return Number(value)
}
const runFile = async (id) => {
  const [row] = await lake.rows(`select file, file_sha256 from runs where run_id = ${text(id)}`)
  if (!row) throw fail(404, 'not_found', `there is no run ${id}`)
  return { path: join(options.lake, row.file), sha: row.file_sha256 }
}
const runOfSurface = (id) => {
  const entry = entries.find((e) => e.surface.surface_id === id)
  if (!entry) throw fail(404, 'not_found', `there is no surface ${id}`)
  return entry.surface.run_id
}
const json = (value) => ({ type: 'application/json', body: Buffer.from(JSON.stringify(value)) })
const binary = (type, body, name) => ({ type, body: Buffer.from(body.buffer ?? body, body.byteOffset ?? 0, body.byteLength ?? body.length), name })

const RUN_COLUMNS = 'surface_id, run_id, state, missing, origin, rig, started, ended, measurements, rejected, attempts, damaged, temperature_min_c, temperature_max_c, humidity_min_pct, humidity_max_pct, pressure_min_hpa, pressure_max_hpa, file, file_bytes, file_sha256, recorded_by, flat_version, foam_version, code_version'

const routes = [
  [/^\/lake$/, async () => json({ ...rig, name: options.lake.split('/').filter(Boolean).at(-1), version, software: 'echolake', layers: 1 + Math.max(...points.map((p) => p.layer)), points, counts: { surfaces: entries.length, ...totals }, simulated: entries.every((e) => e.surface.origin === 'simulated') })],
  [/^\/surfaces$/, async (_, q) => json(page(entries, rig.bands, q))],
  [/^\/surfaces\/([^/]+)$/, async ([id]) => json(await detail(lake, rig.bands, entries, id))],
  [/^\/surfaces\/([^/]+)\/grid$/, async ([id], q) => {
    runOfSurface(id)
    const microphone = whole(q.get('microphone'), 'microphone')
    if (microphone >= points.length) throw fail(400, 'request_invalid', `there is no point ${microphone}`, `Points run from 0 to ${points.length - 1}.`)
    return json(await grid(lake, rig.bands, points, id, microphone, q.get('over') ?? 'flat-total'))
  }],
  [/^\/surfaces\/([^/]+)\/curves$/, async ([id], q) => {
    const microphone = q.get('microphone')
    const where = microphone === null ? '' : ` and (microphone = ${whole(microphone, 'microphone')} or speaker = ${microphone})`
    return json(await curves(lake, rig, entries, id, where, whole(q.get('points') ?? '192', 'points')))
  }],
  [/^\/surfaces\/([^/]+)\/heightmap$/, async ([id]) => binary('application/octet-stream', (await heights(lake, id)).heights)],
  [/^\/surfaces\/([^/]+)\/thumbnail\.png$/, async ([id]) => { const h = await heights(lake, id); return binary('image/png', hillshade(h.heights, h.cells, h.size_mm)) }],
  [/^\/surfaces\/([^/]+)\/mesh\.glb$/, async ([id]) => {
    const mesh = await attachment((await runFile(runOfSurface(id))).path, '.glb')
    if (!mesh) throw fail(404, 'no_data', `the run of surface ${id} has no GLB`)
    return binary('model/gltf-binary', mesh, `${id}.glb`)
  }],
  [/^\/surfaces\/([^/]+)\/pairs\/(\d+)$/, async ([id, p]) => json(await pair(lake, rig, entries, id, whole(p, 'pair')))],
  [/^\/surfaces\/([^/]+)\/pairs\/(\d+)\/ir\.wav$/, async ([id, p], q) => {
    const data = await pair(lake, rig, entries, id, whole(p, 'pair'))
    const signal = q.get('signal') ?? 'reflected'
    const samples = signal === 'measured' ? data.measured : data.reflected
    if (!samples) throw fail(404, 'no_data', `pair ${p} of ${id} has no reflected response`, 'Its Foam reference is missing; ask for signal=measured.')
    return binary('audio/wav', wav(samples, Math.round(rig.rate_hz / whole(q.get('slowdown') ?? '10', 'slowdown'))), `${id}-${p}-${signal}.wav`)
  }],
  [/^\/map$/, async (_, q) => json(await map(lake, rig.bands, entries, whole(q.get('neighbours') ?? '6', 'neighbours')))],
  [/^\/correlations$/, async (_, q) => json(correlations(entries, rig.bands, q.getAll('typology')))],
  [/^\/runs$/, async (_, q) => {
    const words = (q.get('q') ?? '').toLowerCase()
    const column = { surface_id: 'surface_id', attempts: 'attempts', file_bytes: 'file_bytes' }[q.get('sort')] ?? 'started_ns'
    const rows = await lake.rows(`select ${RUN_COLUMNS} from runs where (${text(words)} = '' or position(${text(words)} in lower(run_id || ' ' || surface_id || ' ' || state)) > 0)${q.get('surface_id') ? ` and surface_id = ${text(q.get('surface_id'))}` : ''} order by ${column} ${q.get('order') === 'asc' ? 'asc' : 'desc'}`)
    const offset = whole(q.get('offset') ?? '0', 'offset')
    return json({ total: rows.length, offset, items: rows.slice(offset, offset + whole(q.get('limit') ?? '100', 'limit')) })
  }],
  [/^\/runs\/([^/]+)$/, async ([id]) => {
    const { path } = await runFile(id)
    const at = `run_id = ${text(id)}`
    const [file, [run], repeats, [flags], events] = await Promise.all([
      summary(path), lake.rows(`select ${RUN_COLUMNS} from runs where ${at}`), lake.rows(`select attempt, count(*) as measurements from measurements where ${at} group by attempt order by attempt`),
      lake.rows(`select count(*) filter (where clipped_samples > 0) as clipped, count(*) filter (where snr_db < 30) as snr, count(*) filter (where abs(arrival_error_us) > 20) as arrival, count(*) filter (where outside_level_db > 65) as outside from measurements where ${at}`),
      lake.rows(`select log_time, level, name, message from events where ${at} order by level = 'info', log_time_ns limit 200`),
    ])
    const labels = { clipped: 'clipped samples', snr: 'signal to noise below 30 dB', arrival: 'arrival off by more than 20 µs', outside: 'over 65 dB outside' }
    return json({ run, topics: file.topics, attachments: file.attachments.map(({ name, media_type, bytes }) => ({ name, media_type, bytes })), quality: Object.entries(flags).map(([flag, measurements]) => ({ flag, label: labels[flag], measurements })), repeats, events })
  }],
  [/^\/runs\/([^/]+)\/environment$/, async ([id], q) => {
    const [span] = await lake.rows(`select min(log_time_ns) as first, max(log_time_ns) as last from environment where run_id = ${text(id)}`)
    if (span?.first == null) throw fail(404, 'no_data', `run ${id} has no readings of the air`)
    const width = Math.max(1, Math.ceil((span.last - span.first) / whole(q.get('points') ?? '300', 'points')))
    const rows = await lake.rows(`select min(log_time_ns) as ns, avg(temperature_c) as temperature_c, avg(humidity_pct) as humidity_pct, avg(pressure_hpa) as pressure_hpa, max(outside_level_db) as outside_level_db from environment where run_id = ${text(id)} group by (log_time_ns - ${span.first}) / ${width} order by 1`)
    return json(seriesOf(rows, span.first))
  }],
  [/^\/tables$/, async () => json(await schema())],
  [/^\/openapi\.json$/, async () => ({ type: 'application/json', body: await readFile(join(web, 'openapi.json')) })],
]

async function schema() {
  const rows = await lake.rows("select table_name, column_name, data_type, is_nullable from information_schema.columns where table_schema = 'public' order by table_name, ordinal_position")
  const tables = []
  for (const name of [...new Set(rows.map((r) => r.table_name))]) {
    const log = await readFile(join(options.lake, 'tables', name, '_delta_log', '00000000000000000000.json'), 'utf8')
    const meta = log.split('\n').filter(Boolean).map((line) => JSON.parse(line).metaData).find(Boolean)
    const fields = new Map(JSON.parse(meta.schemaString).fields.map((f) => [f.name, f.metadata]))
    tables.push({ name, columns: rows.filter((r) => r.table_name === name).map((r) => ({ name: r.column_name, type: r.data_type, nullable: r.is_nullable === 'YES', unit: fields.get(r.column_name)?.unit || null, comment: fields.get(r.column_name)?.comment || null })) })
  }
  return tables
}

const FORMATS = { 'text/csv': 'csv', 'application/json': 'json', 'application/vnd.apache.parquet': 'parquet', 'application/vnd.apache.arrow.stream': 'arrow' }

async function bodyOf(request) {
  const parts = []
  for await (const part of request) parts.push(part)
  try { return JSON.parse(Buffer.concat(parts).toString()) } catch { throw fail(400, 'request_invalid', 'the body is not JSON', 'Send {"query": "select 1"}.') }
}

async function sql(request, response) {
  const { query } = await bodyOf(request)
  if (typeof query !== 'string' || !query.trim()) throw fail(400, 'request_invalid', 'there is no query in the body')
  const accepted = (request.headers.accept ?? '').split(',').map((one) => one.split(';')[0].trim()).find((one) => FORMATS[one]) ?? 'application/json'
  const stop = new AbortController()
  response.on('close', () => stop.abort())
  try { return { type: accepted, body: await lake.bytes(query, FORMATS[accepted], stop.signal) } } catch (error) {
    if (error instanceof QueryError) throw fail(400, 'query_invalid', error.message.replace(/^error: /, ''))
    throw error
  }
}

async function sendFile(request, response, path, etag, type) {
  const { size } = await stat(path)
  const headers = { 'content-type': type, 'accept-ranges': 'bytes', etag: `"${etag}"`, 'access-control-allow-origin': '*', 'access-control-expose-headers': 'Accept-Ranges, Content-Length, Content-Range, ETag', 'cache-control': 'no-transform' }
  const range = /^bytes=(\d*)-(\d*)$/.exec(request.headers.range ?? '')
  let [from, to] = [0, size - 1]
  if (range) {
    from = range[1] ? Number(range[1]) : size - Number(range[2])
    to = range[1] && range[2] ? Math.min(size - 1, Number(range[2])) : size - 1
    headers['content-range'] = `bytes ${from}-${to}/${size}`
  }
  response.writeHead(range ? 206 : 200, { ...headers, 'content-length': to - from + 1 })
  if (request.method === 'HEAD') response.end()
  else createReadStream(path, { start: from, end: to }).pipe(response)
}

/** Cookie of this process, once somebody showed the token. */
const session = createHash('sha256').update(`${process.pid} ${Date.now()} ${Math.random()}`).digest('hex')

async function login(request, response) {
  const { token } = await bodyOf(request)
  if (!options.token || token !== options.token) throw fail(401, 'unauthenticated', 'this token is not known')
  response.writeHead(204, { 'set-cookie': `echolake=${session}; HttpOnly; SameSite=Strict; Path=/` })
  response.end()
}

async function api(request, response, url) {
  const path = url.pathname.slice('/api/v1'.length)
  if (path === '/session' && request.method === 'POST') return login(request, response)
  if (options.token && request.headers.authorization !== `Bearer ${options.token}` && !request.headers.cookie?.includes(`echolake=${session}`)) throw fail(401, 'unauthenticated', 'a token is needed')
  const file = /^\/runs\/([^/]+)\/file\.mcap$/.exec(path)
  if (file) { const found = await runFile(decodeURIComponent(file[1])); return sendFile(request, response, found.path, found.sha, 'application/octet-stream') }
  if (path === '/sql' && request.method === 'POST') return send(request, response, await sql(request, response))
  for (const [pattern, answer] of routes) {
    const found = pattern.exec(path)
    if (!found) continue
    const etag = `"${version}"`
    if (request.headers['if-none-match'] === etag) { response.writeHead(304, { etag }); return response.end() }
    return send(request, response, await answer(found.slice(1).map(decodeURIComponent), url.searchParams), { etag, 'cache-control': 'no-cache' })
  }
  throw fail(404, 'not_found', `nothing is served at ${url.pathname}`)
}

function send(request, response, { type, body, name }, headers = {}) {
  const packed = body.length > 1000 && /json|csv|octet|javascript|css|html|svg/.test(type) && /gzip/.test(request.headers['accept-encoding'] ?? '')
  const sent = packed ? gzipSync(body, { level: 5 }) : body
  response.writeHead(200, { 'content-type': type, 'content-length': sent.length, 'x-content-type-options': 'nosniff', ...(packed ? { 'content-encoding': 'gzip' } : {}), ...(name ? { 'content-disposition': `attachment; filename="${name.replace(/[^\w.-]/g, '_')}"` } : {}), ...headers })
  response.end(sent)
}

function problem(response, error) {
  const status = error.status ?? 500
  if (status === 500) process.stderr.write(`${error.stack}\n`)
  if (response.headersSent || response.destroyed) return response.destroy()
  const code = error.code && typeof error.code === 'string' && error.status ? error.code : 'internal'
  response.writeHead(status, { 'content-type': 'application/problem+json' })
  response.end(JSON.stringify({ type: `urn:echolake:problem:${code}`, title: code.replaceAll('_', ' '), status, code, detail: error.message + (error.hint ? `; hint: ${error.hint}` : '') }))
}

const TYPES = { '.html': 'text/html; charset=utf-8', '.js': 'text/javascript', '.css': 'text/css', '.woff2': 'font/woff2', '.svg': 'image/svg+xml', '.json': 'application/json' }

async function built(request, response, url) {
  const asset = /^\/(assets|fonts)\//.test(url.pathname) || /^\/[\w-]+\.(svg|txt|js)$/.test(url.pathname)
  const path = normalize(join(web, 'dist', asset ? url.pathname : 'index.html'))
  const body = await readFile(path).catch(() => { throw fail(404, 'not_found', `nothing is served at ${url.pathname}`) })
  send(request, response, { type: TYPES[extname(path)] ?? 'application/octet-stream', body }, { 'content-security-policy': CSP, 'cache-control': asset ? 'public, max-age=31536000, immutable' : 'no-cache' })
}

const vite = options.built ? null : await (await import('vite')).createServer({ root: web, server: { middlewareMode: true }, appType: 'spa' })

createServer((request, response) => {
  const url = new URL(request.url, 'http://localhost')
  if (url.pathname.startsWith('/api/v1/')) api(request, response, url).catch((error) => problem(response, error))
  else if (url.pathname === '/health') send(request, response, { type: 'application/json', body: Buffer.from(JSON.stringify({ status: 'ok', version: 'development' })) })
  else if (url.pathname === '/metrics') problem(response, fail(404, 'not_found', 'this server counts nothing'))
  else if (vite) vite.middlewares(request, response)
  else built(request, response, url).catch((error) => problem(response, error))
}).listen(Number(options.port), '127.0.0.1', () => process.stderr.write(`http://127.0.0.1:${options.port}/\n`))
