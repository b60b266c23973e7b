//! A run from its URL in rerun's web viewer, on a page of elsewhere, as whoever embeds it would have it:
//! `node tests/rerun.mjs http://127.0.0.1:8080 shots [run [predicate]]`; with a predicate, the run's slice. Needs
//! `npm install --no-save @rerun-io/web-viewer`, which is no dependency because it weighs 47 MB. Keeps a picture of the
//! beginning, the middle and the end, and fails where the viewer complains, arms or panel are not in the picture, or the
//! arms do not move. The run needs arms (`docs/devices.md`).
import assert from 'node:assert/strict'
import { mkdir, readFile, writeFile } from 'node:fs/promises'
import { createServer } from 'node:http'
import { basename, dirname, extname, join } from 'node:path'
import { fileURLToPath } from 'node:url'
import { launch } from './browser.mjs'

const [base, folder = 'shots', wanted, predicate] = process.argv.slice(2)
const { items } = await (await fetch(`${base}/api/v1/runs?limit=1`)).json()
const run = wanted ?? items[0].run_id
const source =
  predicate === undefined
    ? `${base}/api/v1/runs/${encodeURIComponent(run)}/file.mcap`
    : `${base}/api/v1/slices.mcap?${new URLSearchParams({ run, where: predicate })}`
const viewer = dirname(fileURLToPath(import.meta.resolve('@rerun-io/web-viewer')))
const { version } = JSON.parse(await readFile(join(viewer, 'package.json'), 'utf8'))

/** Long for a machine without a graphics card, where the browser compiles and draws on its processor. */
const PATIENCE = { timeout: 60_000 }
const PAGE = `<!doctype html><meta charset="utf-8"><title>rerun</title><link rel="icon" href="data:,"><body style="margin:0"><script type="module">
  import { WebViewer } from '/index.js'
  globalThis.viewer = new WebViewer()
  globalThis.opened = []
  viewer.on('recording_open', (event) => opened.push(event.recording_id))
  viewer.start(new URLSearchParams(location.search).get('run'), document.body,
    { width: '1400px', height: '900px', render_backend: 'webgl', hide_welcome_screen: true, theme: 'light' })
</script>`
const TYPES = { '.js': 'text/javascript', '.wasm': 'application/wasm' }
const elsewhere = createServer(async (request, response) => {
  const { pathname } = new URL(request.url, 'http://elsewhere')
  if (pathname === '/') {
    response.setHeader('content-type', 'text/html').end(PAGE)
    return
  }
  // The package imports one of its own files without its ending, which bundlers add.
  const name = extname(pathname) === '' ? `${pathname}.js` : pathname
  const file = await readFile(join(viewer, basename(name))).catch(() => null)
  response.writeHead(file === null ? 404 : 200, { 'content-type': TYPES[extname(name)] ?? 'text/plain' }).end(file)
})
await new Promise((resolve) => elsewhere.listen(0, '127.0.0.1', resolve))

await mkdir(folder, { recursive: true })
const browser = await launch('--ignore-gpu-blocklist')
const page = await (await browser.newContext({ viewport: { width: 1400, height: 900 } })).newPage()
const said = []
/* global opened */
// What it says of this browser's graphics, and of windows that a page does not have.
const OF_THE_BROWSER = /GPU stall due to ReadPixels|Software rasterizer|not implemented in web backend/
page.on('console', (message) => {
  if (['error', 'warning'].includes(message.type()) && !OF_THE_BROWSER.test(message.text())) said.push(message.text())
})
page.on('pageerror', (error) => said.push(error.message))

const TIMELINE = 'message_log_time'
const begun = performance.now()
await page.goto(`http://127.0.0.1:${elsewhere.address().port}/?run=${encodeURIComponent(source)}`)
await page
  .waitForFunction(
    (timeline) => opened.length > 0 && viewer.get_time_range(opened[0], timeline) !== null,
    TIMELINE,
    PATIENCE,
  )
  .catch((error) => {
    throw new Error(`${error.message}; the console says: ${said.join('\n')}`)
  })
await page.evaluate((timeline) => {
  viewer.set_active_timeline(opened[0], timeline)
  viewer.set_playing(opened[0], false)
}, TIMELINE)
// The range grows while the file is read.
let range = null
for (let before = null; range === null || range.max !== before?.max; await page.waitForTimeout(2000))
  [before, range] = [range, await page.evaluate((timeline) => viewer.get_time_range(opened[0], timeline), TIMELINE)]
process.stdout.write(
  `rerun ${version}: ${run}, ${((range.max - range.min) / 1e9).toFixed(1)} s of recording, open after ${((performance.now() - begun) / 1000).toFixed(1)} s\n`,
)

/** The moment's picture is kept; which pixels of it are strongly coloured, and whether in the arms' yellow. */
async function at(name, share) {
  await page.evaluate(
    ([timeline, time]) => viewer.set_current_time(opened[0], timeline, time),
    [TIMELINE, range.min + share * (range.max - range.min)],
  )
  // Drawn when two pictures are the same.
  let [before, picture] = [null, await page.screenshot()]
  for (let i = 0; i < 20 && !(before?.equals(picture) ?? false); i++) {
    await page.waitForTimeout(2000)
    ;[before, picture] = [picture, await page.screenshot()]
  }
  await writeFile(join(folder, `rerun-${name}.png`), picture)
  return page.evaluate(async (base64) => {
    const image = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]))
    const context = new OffscreenCanvas(image.width, image.height).getContext('2d')
    context.drawImage(image, 0, 0)
    // Beside and above are rerun's own panels.
    const { data } = context.getImageData(200, 60, 450, 600)
    const kinds = []
    for (let i = 0; i < data.length; i += 4) {
      const [r, g, b] = data.slice(i, i + 3)
      const strength = Math.max(r, g, b) - Math.min(r, g, b)
      kinds.push(strength < 70 ? ' ' : b === Math.min(r, g, b) && r >= g ? 'a' : 'p')
    }
    return kinds.join('')
  }, picture.toString('base64'))
}

const count = (kinds, kind) => kinds.split(kind).length - 1
const moments = []
for (const [name, share] of [
  ['beginning', 0.1],
  ['middle', 0.5],
  ['end', 1],
])
  moments.push(await at(name, share))
for (const kinds of moments) {
  process.stdout.write(`arms ${count(kinds, 'a')} pixels, panel ${count(kinds, 'p')}\n`)
  assert.ok(count(kinds, 'a') > 2000, 'the arms are not in the picture')
  assert.ok(count(kinds, 'p') > 2000, 'the panel is not in the picture')
}
for (const [i, j] of [
  [0, 1],
  [1, 2],
  [0, 2],
]) {
  const moved = [...moments[i]].filter((kind, k) => (kind === 'a') !== (moments[j][k] === 'a')).length
  assert.ok(moved > 1000, `only ${moved} pixels of the arms differ between moments ${i} and ${j}`)
}
assert.deepEqual(said, [], 'the viewer complains')
await browser.close()
elsewhere.close()
