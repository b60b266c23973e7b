//! How fast and how heavy the pages are on a lake of any size: `node tests/figures.mjs http://127.0.0.1:8080 [rounds]`. It
//! prints and judges nothing, because times are those of a machine and of what else runs on it.
import { loadavg } from 'node:os'
import { gzipSync } from 'node:zlib'
import { launch } from './browser.mjs'

const [base, rounds = '3'] = process.argv.slice(2)
const CLICKS = 60
const get = async (path) => (await fetch(base + path)).json()
const { items, total } = await get('/api/v1/surfaces?limit=500')
const { items: runs } = await get('/api/v1/runs?limit=1')
const measured = items.filter((s) => s.typology !== 'reference')
const id = measured[0].surface_id
const VIEWS = {
  wall: '/',
  surface: `/surfaces/${id}?microphone=14&point=40`,
  response: `/surfaces/${id}/pairs/159`,
  compare: `/compare?s=${items
    .slice(0, 8)
    .map((s) => s.surface_id)
    .join(',')}`,
  map: `/map?at=${id}`,
  runs: '/runs',
  run: `/runs/${runs[0].run_id}`,
  sql: `/sql?q=${encodeURIComponent('select surface_id, microphone, speaker, tnce_total from tnce limit 5000')}`,
}

const browser = await launch()
const say = (text) => process.stdout.write(`${text}\n`)
const fresh = async () => (await browser.newContext({ viewport: { width: 1280, height: 900 } })).newPage()
const sorted = (times) => times.toSorted((a, b) => a - b)
const ms = (times) => `${sorted(times)[0].toFixed(0)} ms (${times.map((t) => t.toFixed(0)).join(', ')})`

/** From the navigation to the frame after `ready` holds, in the page's own time. */
async function opened(path, ready) {
  const page = await fresh()
  await page.addInitScript(() => {
    globalThis.shown = (holds) => {
      const look = () =>
        holds()
          ? requestAnimationFrame(() => {
              globalThis.shownAt = performance.now()
            })
          : requestAnimationFrame(look)
      look()
    }
  })
  await page.addInitScript(
    `document.addEventListener('readystatechange', () => { if (document.readyState === 'interactive') shown(${ready}) })`,
  )
  await page.goto(base + path)
  const handle = await page.waitForFunction(() => globalThis.shownAt)
  const time = await handle.jsonValue()
  return { page, time }
}

const CARDS = `() => document.querySelectorAll('.sheet li').length > 0`
const PICTURES = `() => { const seen = [...document.querySelectorAll('.sheet li img')].filter((i) => i.getBoundingClientRect().top < innerHeight); return seen.length > 0 && seen.every((i) => i.complete && i.naturalWidth > 0) }`
// The cells of the grid plot and the curves are drawn.
const SURFACE = `() => document.querySelectorAll('.cells [data-point]').length > 100 && document.querySelector('.uplot canvas')?.width > 10`

// The curves over time and over frequency are drawn.
const RESPONSE = `() => [...document.querySelectorAll('.uplot canvas')].filter((c) => c.width > 10).length >= 2`

/** Steps to the next pair by its key, from the key to the frame that shows the other pair's facts. */
async function nextPairs() {
  const page = await fresh()
  await page.goto(`${base}/surfaces/${id}/pairs/159`, { waitUntil: 'networkidle' })
  const times = []
  for (let i = 0; i < 5; i += 1) {
    // The page asks for the neighbours once it has come to rest.
    await page.waitForTimeout(1000)
    times.push(
      await page.evaluate(
        () =>
          new Promise((resolve) => {
            const facts = () => document.querySelector('.facts').textContent
            const [before, start] = [facts(), performance.now()]
            document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ']', bubbles: true }))
            const look = () =>
              facts() === before
                ? requestAnimationFrame(look)
                : requestAnimationFrame(() => resolve(performance.now() - start))
            look()
          }),
      ),
    )
  }
  await page.context().close()
  return times
}

async function firstView() {
  const scripts = new Map()
  const page = await fresh()
  const bodies = []
  page.on('response', (answer) => {
    if (answer.url().endsWith('.js')) bodies.push(answer.body().then((body) => scripts.set(answer.url(), body)))
  })
  await page.goto(base + '/', { waitUntil: 'networkidle' })
  await Promise.all(bodies)
  const gzipped = [...scripts.values()].reduce((sum, body) => sum + gzipSync(body, { level: 9 }).length, 0)
  await page.context().close()
  return { gzipped, count: scripts.size }
}

async function facetClicks() {
  const page = await fresh()
  await page.goto(base + '/', { waitUntil: 'networkidle' })
  const facets = page.locator('button.value')
  const count = await facets.count()
  const times = []
  for (let i = 0; i < CLICKS; i += 1) {
    times.push(
      await facets.nth((i * 7) % Math.min(count, await facets.count())).evaluate(
        (button) =>
          new Promise((resolve) => {
            const start = performance.now()
            button.click()
            const look = () =>
              document.querySelector('.sheet')?.ariaBusy !== 'true'
                ? resolve(performance.now() - start)
                : requestAnimationFrame(look)
            requestAnimationFrame(() => requestAnimationFrame(look))
          }),
      ),
    )
  }
  await page.context().close()
  return times
}

/** Scripts' heap, what Chromium's own objects hold, and buffers, MB, after a collection and at most while it comes up. */
async function weight(path) {
  const page = await fresh()
  const client = await page.context().newCDPSession(page)
  let most = 0
  const used = async () => {
    const { usedSize, embedderHeapUsedSize = 0, backingStorageSize = 0 } = await client.send('Runtime.getHeapUsage')
    return (usedSize + embedderHeapUsedSize + backingStorageSize) / 1e6
  }
  const watch = setInterval(
    () =>
      used().then(
        (now) => {
          most = Math.max(most, now)
        },
        () => {},
      ),
    50,
  )
  await page.goto(base + path, { waitUntil: 'networkidle' })
  await page.evaluate(async () => {
    for (let y = 0; y < document.body.scrollHeight; y += 600) {
      scrollTo(0, y)
      await new Promise((r) => setTimeout(r, 30))
    }
  })
  await page.waitForTimeout(1200)
  clearInterval(watch)
  await client.send('HeapProfiler.enable')
  await client.send('HeapProfiler.collectGarbage')
  const kept = await used()
  await page.context().close()
  return { kept, most: Math.max(most, kept) }
}

say(`${base}: ${total ?? items.length} surfaces; ${browser.version()}; load ${loadavg()[0].toFixed(1)}`)
const { gzipped, count } = await firstView()
say(`scripts of the first view: ${count} files, ${(gzipped / 1000).toFixed(1)} kB gzipped`)
const rows = {
  'first view, cards': [CARDS, '/'],
  'first view, with pictures': [PICTURES, '/'],
  'surface page': [SURFACE, `/surfaces/${id}`],
  'response page': [RESPONSE, `/surfaces/${id}/pairs/159`],
}
for (const [name, [ready, path]] of Object.entries(rows)) {
  const times = []
  for (let i = 0; i < Number(rounds); i += 1) {
    const other = name === 'surface page' ? `/surfaces/${measured[i % measured.length].surface_id}` : path
    const { page, time } = await opened(other, ready)
    times.push(time)
    await page.context().close()
  }
  say(`${name}: ${ms(times)}; load ${loadavg()[0].toFixed(1)}`)
}
say(`next pair: ${ms(await nextPairs())}; load ${loadavg()[0].toFixed(1)}`)
const p95s = []
for (let i = 0; i < Number(rounds); i += 1) p95s.push(sorted(await facetClicks())[Math.floor(CLICKS * 0.95)])
say(`facet click, p95 of ${CLICKS}: ${ms(p95s)}; load ${loadavg()[0].toFixed(1)}`)
for (const [name, path] of Object.entries(VIEWS)) {
  const { kept, most } = await weight(path)
  say(`heap of ${name}: ${kept.toFixed(1)} MB, at most ${most.toFixed(1)} MB`)
}
await browser.close()
