//! E20: the pages behind a proxy that serves them below a path of its own, `/lake`, and takes it off:
//! `node tests/prefix.mjs http://127.0.0.1:8420`. Fails if a page asks for anything outside of that path, links there,
//! or reports an error.
import { createServer, request } from 'node:http'
import { contextOf, eventually, launch } from './browser.mjs'

const PREFIX = '/lake'
const target = new URL(process.argv[2])
const faults = []
const fail = (text) => {
  faults.push(text)
  process.stdout.write(`FAIL ${text}\n`)
}

const proxy = createServer((asked, answer) => {
  if (!asked.url.startsWith(`${PREFIX}/`)) {
    fail(`${asked.headers.referer ?? 'the browser'} asks for ${asked.url}`)
    answer.writeHead(404).end()
    return
  }
  const options = {
    host: target.hostname,
    port: target.port,
    path: asked.url.slice(PREFIX.length),
    method: asked.method,
    headers: { ...asked.headers, 'x-forwarded-prefix': PREFIX },
  }
  const passed = request(options, (got) => {
    answer.writeHead(got.statusCode, got.headers)
    got.pipe(answer)
  })
  passed.on('error', () => answer.destroy())
  answer.on('close', () => passed.destroy())
  asked.pipe(passed)
})
await new Promise((resolve) => proxy.listen(0, '127.0.0.1', resolve))
const origin = `http://127.0.0.1:${proxy.address().port}`
const site = origin + PREFIX

const get = async (path) => (await fetch(site + path)).json()
const { items } = await get('/api/v1/surfaces')
const { items: runs } = await get('/api/v1/runs?limit=1')
const id = items.find((one) => one.typology !== 'reference').surface_id
const { items: pairs } = await get(`/api/v1/surfaces/${id}/pairs`)
const { files } = await get('/api/v1/files?table=runs')
if (!files[0].url.startsWith(`${site}/api/`)) fail(`a file is at ${files[0].url}`)

const PAGES = [
  '/',
  `/surfaces/${id}`,
  `/surfaces/${id}/pairs/${pairs[0].pair_id}`,
  `/compare?s=${items.map((one) => one.surface_id).slice(0, 3)}`,
  '/map',
  '/runs',
  `/runs/${runs[0].run_id}`,
  `/sql?q=${encodeURIComponent('select surface_id from surfaces')}`,
  '/operations',
]

const browser = await launch()
const page = await (await contextOf(browser, { viewport: { width: 1400, height: 900 } })).newPage()
page.on('pageerror', (error) => fail(`${page.url()}: ${error.stack}`))
page.on('console', (message) => {
  if (message.type() === 'error') fail(`${page.url()}: ${message.text()}`)
})

/** Waits until the page is drawn, and looks at its links. */
async function check(what) {
  await eventually(async () => {
    const state = await page.evaluate(() => ({
      isDrawn: document.querySelector('main h1, main table, main a.surface') !== null,
      isBusy: document.querySelector('main .wait.busy') !== null,
    }))
    if (!state.isDrawn || state.isBusy) throw new Error(`${what} is not drawn`)
  })
  const links = await page.evaluate(() => Array.from(document.querySelectorAll('a[href]'), (link) => link.href))
  for (const link of links)
    if (link.startsWith(origin) && !link.startsWith(`${site}/`)) fail(`${what} links to ${link}`)
  if (await page.locator('[role=alert]').count()) fail(`${what}: ${await page.locator('[role=alert]').innerText()}`)
}

for (const path of PAGES) {
  await page.goto(site + path, { waitUntil: 'networkidle' })
  await check(path)
}
// Within the pages: the addresses that they make, Back, and a query.
await page.goto(`${site}/surfaces/${id}`, { waitUntil: 'networkidle' })
for (const name of ['Compare', 'Map', 'Runs', 'Operations', 'Wall']) {
  await page.getByRole('navigation').getByRole('link', { name }).click()
  await check(name)
  if (!page.url().startsWith(`${site}/`)) fail(`${name} leads to ${page.url()}`)
}
await page.locator('main a.surface').first().click()
await page.waitForURL(`${site}/surfaces/**`)
await page.goBack()
await check('the wall')
await page.goto(`${site}/sql?q=${encodeURIComponent('select 6 * 7 as answer')}`, { waitUntil: 'networkidle' })
await page.getByRole('button', { name: /^Run/ }).first().click()
await page.getByRole('cell', { name: '42' }).waitFor()

await browser.close()
proxy.close()
proxy.closeAllConnections()
process.stdout.write(faults.length ? `${faults.length} failures\n` : `${PAGES.length} pages below ${PREFIX}\n`)
process.exitCode = faults.length ? 1 : 0
