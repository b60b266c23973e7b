//! What pages of elsewhere can do to a server without tokens, tried in a browser:
//! `node tests/foreign.mjs http://127.0.0.1:8420 FLIGHT_SQL POSTGRES VIEWER`, each HOST:PORT. None may begin a query, read
//! anything of the lake, or open a viewer's connection.
import assert from 'node:assert/strict'
import { createServer } from 'node:http'
import { contextOf, launch } from './browser.mjs'

const [base, flightSql, postgres, viewer] = process.argv.slice(2)
const { port } = new URL(base)
const SQL = 'select surface_id, run_id from runs'
/** How long a try may take, ms, in which it can still have an effect. */
const TRY_LIMIT = 3000
/** How long one that must succeed may take, ms; on a busy machine a slice takes seconds. */
const SUCCESS_LIMIT = 60_000

/** Queries that the server has begun, rows that it has sent, and slices that it has cut. */
async function counters() {
  const text = await (await fetch(`${base}/metrics`)).text()
  const sum = (name) =>
    [...text.matchAll(new RegExp(`^${name}(?:\\{.*\\})? (\\d+)$`, 'gm'))].reduce(
      (all, found) => all + Number(found[1]),
      0,
    )
  return { queries: sum('echolake_queries_total'), rows: sum('echolake_rows_total') }
}

const own = async (path, init) => (await fetch(base + path, init)).json()
const json = { 'content-type': 'application/json', accept: 'application/json' }
const asked = await own('/api/v1/sql', { method: 'POST', headers: json, body: JSON.stringify({ query: SQL }) })
const { run_id: known, surface_id: surface } = asked[0]
// All that a page can know of a run's name without having seen it: everything before the random end.
const guessed = known.replace(/[^-]*$/, '0123456789abcdef')
assert.notEqual(guessed, known)

/** What a page tries: it is run there, with these settings, and returns what it could read. */
const attempts = {
  'SQL as text that needs no preflight': ({ base, sql }) =>
    fetch(`${base}/api/v1/sql`, { method: 'POST', mode: 'no-cors', body: JSON.stringify({ query: sql }) }).then((r) =>
      r.text(),
    ),
  'SQL as JSON': ({ base, sql, json }) =>
    fetch(`${base}/api/v1/sql`, { method: 'POST', headers: json, body: JSON.stringify({ query: sql }) }).then((r) =>
      r.text(),
    ),
  'SQL as JSON with cookies': ({ base, sql, json }) =>
    fetch(`${base}/api/v1/sql`, {
      method: 'POST',
      credentials: 'include',
      headers: json,
      body: JSON.stringify({ query: sql }),
    }).then((r) => r.text()),
  'SQL by GET': ({ base, sql }) => fetch(`${base}/api/v1/sql?query=${encodeURIComponent(sql)}`).then((r) => r.text()),
  'SQL by XMLHttpRequest': ({ base, sql }) =>
    new Promise((done, fail) => {
      const request = new XMLHttpRequest()
      request.open('POST', `${base}/api/v1/sql`)
      request.onload = () => done(request.responseText)
      request.onerror = fail
      request.send(JSON.stringify({ query: sql }))
    }),
  'SQL by a beacon': ({ base, sql }) => {
    navigator.sendBeacon(`${base}/api/v1/sql`, JSON.stringify({ query: sql }))
  },
  'SQL by a form into a frame': ({ base, sql }) =>
    new Promise((done, fail) => {
      document.body.innerHTML = `<iframe name=f></iframe><form method=post enctype="text/plain" target=f action="${base}/api/v1/sql"><input name='{"query":"${sql}","x":"' value='"}'></form>`
      document.querySelector('iframe').onload = () => {
        try {
          done(document.querySelector('iframe').contentDocument.body.innerText)
        } catch (e) {
          fail(e)
        }
      }
      document.querySelector('form').submit()
    }),
  'SQL by an urlencoded form': ({ base, sql }) => {
    document.body.innerHTML = `<iframe name=f></iframe><form method=post target=f action="${base}/api/v1/sql"><input name=query value="${sql}"></form>`
    document.querySelector('form').submit()
  },
  'SQL from a sandboxed frame, whose origin is null': ({ base, sql, json }) =>
    new Promise((done) => {
      window.onmessage = (message) => done(message.data)
      document.body.innerHTML = '<iframe sandbox="allow-scripts"></iframe>'
      document.querySelector('iframe').srcdoc =
        `<script>fetch('${base}/api/v1/sql', { method: 'POST', headers: ${JSON.stringify(json)}, body: '${JSON.stringify({ query: sql })}' }).then((r) => r.text()).then((t) => parent.postMessage(t, '*'), () => parent.postMessage('', '*'))</script>`
    }),
  'SQL from a worker': ({ base, sql }) =>
    new Promise((done) => {
      const script = `fetch('${base}/api/v1/sql', { method: 'POST', body: '${JSON.stringify({ query: sql })}' }).then((r) => r.text()).then(postMessage, () => postMessage(''))`
      new Worker(URL.createObjectURL(new Blob([script]))).onmessage = (message) => done(message.data)
    }),
  'SQL under a name that was pointed here': ({ port, sql, json }) =>
    fetch(`http://rebound.example:${port}/api/v1/sql`, {
      method: 'POST',
      headers: json,
      body: JSON.stringify({ query: sql }),
    }).then((r) => r.text()),
  'runs under a name that was pointed here': ({ port }) =>
    fetch(`http://rebound.example:${port}/api/v1/runs`).then((r) => r.text()),
  'an image of a slice whose name was guessed': ({ base, guessed }) =>
    new Promise((done, fail) =>
      Object.assign(new Image(), {
        onload: () => done('an image'),
        onerror: fail,
        src: `${base}/api/v1/slices.mcap?run=${guessed}&where=pair_id%3C10`,
      }),
    ),
  'an image of a slice of all runs': ({ base }) =>
    new Promise((done, fail) =>
      Object.assign(new Image(), {
        onload: () => done('an image'),
        onerror: fail,
        src: `${base}/api/v1/slices.mcap?where=pair_id%3C10`,
      }),
    ),
  'a slice of all runs': ({ base }) =>
    fetch(`${base}/api/v1/slices.mcap?where=pair_id%3C10`).then((r) => r.ok && r.text()),
  'a slice of a run whose name was guessed': ({ base, guessed }) =>
    fetch(`${base}/api/v1/slices.mcap?run=${guessed}`).then((r) => r.ok && r.text()),
  'a slice by calls of functions': ({ base, known }) =>
    fetch(
      `${base}/api/v1/slices.mcap?run=${known}&where=${encodeURIComponent('cardinality(array_repeat(make_array(range(0,30000000)),3000000))>pair_id')}`,
    ).then((r) => r.ok && r.text()),
  'a slice by a long chain': ({ base, known }) =>
    fetch(
      `${base}/api/v1/slices.mcap?run=${known}&where=${encodeURIComponent(`pair_id = 1${' or pair_id = 1'.repeat(2000)}`)}`,
    ).then((r) => r.ok && r.text()),
  'a slice by a cast to a deep type': ({ base, known }) =>
    fetch(
      `${base}/api/v1/slices.mcap?run=${known}&where=${encodeURIComponent(`pair_id = cast(null as int${'[]'.repeat(3000)})`)}`,
    ).then((r) => r.ok && r.text()),
  'a slice by a query in the predicate': ({ base, known, sql }) =>
    fetch(`${base}/api/v1/slices.mcap?run=${known}&where=${encodeURIComponent(`surface_id in (${sql})`)}`).then(
      (r) => r.ok && r.text(),
    ),
  'a manifest of a run whose name was guessed': ({ base, guessed }) =>
    fetch(`${base}/api/v1/foxglove/manifest?run=${guessed}`).then((r) => r.ok && r.text()),
  'a manifest of all runs': ({ base }) => fetch(`${base}/api/v1/foxglove/manifest`).then((r) => r.ok && r.text()),
  'the list of runs': ({ base }) => fetch(`${base}/api/v1/runs`).then((r) => r.text()),
  'the list of runs as a script': ({ base }) =>
    new Promise((done, fail) =>
      document.head.append(
        Object.assign(document.createElement('script'), {
          src: `${base}/api/v1/runs`,
          onload: () => done(''),
          onerror: fail,
        }),
      ),
    ),
  'the list of runs as a style sheet': ({ base }) =>
    new Promise((done, fail) =>
      document.head.append(
        Object.assign(document.createElement('link'), {
          rel: 'stylesheet',
          href: `${base}/api/v1/runs`,
          onload: () => done([...document.styleSheets].map((s) => [...s.cssRules].map((r) => r.cssText)).join('')),
          onerror: fail,
        }),
      ),
    ),
  'the list of runs as events': ({ base }) =>
    new Promise((done, fail) =>
      Object.assign(new EventSource(`${base}/api/v1/runs`), { onmessage: (m) => done(m.data), onerror: fail }),
    ),
  'the list of files': ({ base }) => fetch(`${base}/api/v1/files`).then((r) => r.text()),
  'a table': ({ base }) =>
    fetch(`${base}/api/v1/tables/tnce`, { headers: { range: 'bytes=0-99' } }).then((r) => r.text()),
  'the figures of the server': ({ base }) => fetch(`${base}/metrics`).then((r) => r.text()),
  'a page in a frame': ({ base }) =>
    new Promise((done, fail) => {
      document.body.innerHTML = `<iframe src="${base}/"></iframe>`
      document.querySelector('iframe').onload = () => {
        try {
          done(document.querySelector('iframe').contentDocument.body.innerText)
        } catch (e) {
          fail(e)
        }
      }
    }),
  'a picture on a canvas': ({ base, surface }) =>
    new Promise((done, fail) =>
      Object.assign(new Image(), {
        crossOrigin: 'anonymous',
        onerror: fail,
        src: `${base}/api/v1/surfaces/${surface}/thumbnail.png`,
        onload() {
          const canvas = document.createElement('canvas')
          canvas.getContext('2d').drawImage(this, 0, 0)
          done(canvas.toDataURL())
        },
      }),
    ),
  sound: ({ base, surface }) =>
    new Promise((done, fail) =>
      Object.assign(new Audio(), {
        crossOrigin: 'anonymous',
        onloadeddata: () => done('sound'),
        onerror: fail,
        src: `${base}/api/v1/surfaces/${surface}/pairs/1/ir.wav`,
      }),
    ),
  'a session': ({ base }) =>
    fetch(`${base}/api/v1/session`, { method: 'POST', credentials: 'include', body: '{"token":""}' }).then((r) =>
      r.text(),
    ),
  'a WebSocket of the catalogue': ({ base }) =>
    new Promise((done, fail) =>
      Object.assign(new WebSocket(base.replace('http', 'ws')), { onopen: () => done('open'), onerror: fail }),
    ),
  'a WebSocket of a viewer': ({ viewer }) =>
    new Promise((done, fail) =>
      Object.assign(new WebSocket(`ws://${viewer}`, ['foxglove.sdk.v1']), {
        onopen: () => done('open'),
        onerror: fail,
      }),
    ),
  'a WebSocket of a viewer under a name that was pointed here': ({ viewer }) =>
    new Promise((done, fail) =>
      Object.assign(new WebSocket(`ws://rebound.example:${viewer.split(':')[1]}`, ['foxglove.sdk.v1']), {
        onopen: () => done('open'),
        onerror: fail,
      }),
    ),
  'SQL to the port of Flight SQL': ({ flightSql, sql }) =>
    fetch(`http://${flightSql}/arrow.flight.protocol.FlightService/DoGet`, {
      method: 'POST',
      mode: 'no-cors',
      body: sql,
    }).then((r) => r.text()),
  'SQL to the port of Postgres': ({ postgres, sql }) =>
    fetch(`http://${postgres}/`, {
      method: 'POST',
      mode: 'no-cors',
      body: `\0\0\0\u0008\u0004\u00d2\u0016/Q\0\0\0\u0030${sql}\0`,
    }).then((r) => r.text()),
}

const pages = createServer((_, response) =>
  response.setHeader('content-type', 'text/html').end('<title>A page of elsewhere</title><body></body>'),
)
await new Promise((listening) => pages.listen(0, '127.0.0.1', listening))
const elsewhere = pages.address().port
// A name whose owner points it here only once its page is loaded looks like this to the server.
const browser = await launch('--host-resolver-rules=MAP *.example 127.0.0.1')
const context = await contextOf(browser)
const settings = { base, port, sql: SQL, json, known, guessed, surface, flightSql, postgres, viewer }
// What a page returns; empty where it was refused, or nothing came.
const tried = async (page, attempt, time = TRY_LIMIT) => {
  const limit = new Promise((done) => setTimeout(done, time, '').unref())
  return (await Promise.race([page.evaluate(attempt, settings).catch(() => ''), limit])) || ''
}

// That the tries can succeed: a page of the server itself, and a page of elsewhere that was told a run's name.
{
  const succeeded = (page, attempt) => tried(page, attempt, SUCCESS_LIMIT)
  const page = await context.newPage()
  await page.goto(base)
  const before = await counters()
  assert.match(await succeeded(page, attempts['SQL as JSON']), new RegExp(known), 'a page of the server may ask')
  assert.match(await succeeded(page, attempts['the list of runs']), new RegExp(known))
  assert.equal((await counters()).queries > before.queries, true, 'queries are counted')
  await page.goto(`http://attacker.example:${elsewhere}/`)
  const slice = await succeeded(page, ({ base, known }) =>
    fetch(`${base}/api/v1/slices.mcap?run=${known}&where=pair_id%3C10`).then((r) => r.ok && r.text()),
  )
  assert.match(slice, /MCAP/, 'who was told a name may read the run')
}

let effects = 0
let read = 0
let tries = 0
// Pages of another site, and of another port of this machine.
for (const origin of [`http://attacker.example:${elsewhere}`, `http://127.0.0.1:${elsewhere}`]) {
  for (const [name, attempt] of Object.entries(attempts)) {
    // A viewer may be served on this machine, so its connections are open to all of its pages.
    if (name.includes('viewer') && origin.includes('127.0.0.1')) continue
    const page = await context.newPage()
    await page.goto(origin)
    const before = await counters()
    const text = await tried(page, attempt)
    // A form or a beacon is still on its way when the try is over.
    await page.waitForTimeout(100)
    const after = await counters()
    await page.close()
    const isEffect = after.queries !== before.queries || after.rows !== before.rows
    tries += 1
    effects += isEffect
    read += text !== ''
    process.stdout.write(
      `${isEffect || text !== '' ? 'NOT OK' : 'ok'} ${name}, from ${origin}${text === '' ? '' : `: ${text.slice(0, 80)}`}\n`,
    )
  }
}
await browser.close()
pages.close()
process.stdout.write(`${tries} tries, ${effects} effects, ${read} answers read\n`)
assert.equal(effects + read, 0)
