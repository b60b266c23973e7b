//! Opens every page in both themes at three widths, keeps a screenshot of each, and fails where the console is not
//! empty or axe finds a violation: `node tests/pages.mjs http://127.0.0.1:8420 shots [only]`.
import { mkdir, readFile } from 'node:fs/promises'
import { createRequire } from 'node:module'
import { contextOf, launch } from './browser.mjs'

const [base, folder = 'shots', only = ''] = process.argv.slice(2)
const axe = await readFile(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8')
const get = async (path) => (await fetch(base + path)).json()
const { items } = await get('/api/v1/surfaces?limit=500')
const { items: runs } = await get('/api/v1/runs?limit=1')
const measured = items.filter((s) => s.typology !== 'reference')
const id = measured[0].surface_id
const query =
  "select p.incidence_deg, 10 * log10(t.tnce_10000) as level_db from tnce t join pairs p using (pair_id) where t.surface_id = '" +
  id +
  "' order by p.incidence_deg limit 400"

const PAGES = {
  wall: '/',
  filtered: `/?typology=${measured[0].typology}&sort=level&pick=${id}`,
  empty: '/?q=nothing-like-this',
  surface: `/surfaces/${id}?microphone=14&point=40&over=flat-band`,
  missing: '/surfaces/no%3Cb%3Esuch',
  ir: `/surfaces/${id}/pairs/159`,
  overlaid: `/surfaces/${id}/pairs/159?with=${measured[1].surface_id},${id}/160&form=etc&octave=3&show=group-delay&khz=4-20`,
  compare: `/compare?s=${items
    .slice(0, 4)
    .map((s) => s.surface_id)
    .join(',')}`,
  difference: `/compare?s=${measured
    .slice(0, 3)
    .map((s) => s.surface_id)
    .join(',')}&show=difference&band=10000`,
  nothing: '/compare',
  map: `/map?at=${id}`,
  som: '/map?axes=som&typology=all',
  runs: '/runs',
  run: `/runs/${runs[0].run_id}`,
  replay: `/runs/${runs[0].run_id}?at=600&speed=100`,
  log: `/runs/${runs[0].run_id}?log=all`,
  lost: '/nowhere',
  help: '/',
  finder: '/',
  sql: `/sql?q=${encodeURIComponent(query)}`,
  tables: `/sql?q=${encodeURIComponent("select surface_id, p90_mean_db from surface_stats where band = 'total'")}&tables=points&summary=points`,
  first: '/sql',
  lists: `/sql?q=${encodeURIComponent('\\d;select surface_id, run_id, band, band_hz, spread_db, mean_nce from surface_stats')}&statement=2&filter=band:0&sort=-band`,
  series: `/sql?q=${encodeURIComponent('select surface_id, band, p90_mean_db from surface_stats;select 1')}`,
  wrong: '/sql?q=select%20nope',
  operations: '/operations',
}

/** Of the screen, while a page comes up; browsers call up to 0.1 good. */
const MOST_JUMP = 0.1

await mkdir(folder, { recursive: true })
const browser = await launch()
let failures = 0
const fail = (text) => {
  failures += 1
  process.stdout.write(`FAIL ${text}\n`)
}
for (const theme of ['light', 'dark']) {
  for (const width of theme === 'light' ? [1400, 1024, 390] : [1400, 390]) {
    const context = await contextOf(browser, {
      viewport: { width, height: width === 390 ? 844 : 900 },
      colorScheme: theme,
      hasTouch: width === 390,
      bypassCSP: false,
    })
    const page = await context.newPage()
    await page.addInitScript(() => {
      globalThis.jumps = []
      new PerformanceObserver((list) => {
        for (const entry of list.getEntries())
          if (!entry.hadRecentInput) globalThis.jumps.push([entry.value, entry.sources?.[0]?.node?.className ?? ''])
      }).observe({ type: 'layout-shift', buffered: true })
    })
    for (const [name, path] of Object.entries(PAGES)) {
      if (only && !only.split(',').includes(name)) continue
      const expected = name === 'missing' ? 404 : name === 'wrong' ? 400 : 0
      const said = []
      page.removeAllListeners('console')
      page.removeAllListeners('pageerror')
      // Reading back a screenshot stalls the software renderer, which says so.
      page.on('console', (message) => {
        if (
          !message.text().includes('GPU stall due to ReadPixels') &&
          !(expected && message.text().includes(`status of ${expected}`))
        )
          said.push(`${message.type()}: ${message.text()}`)
      })
      page.on('pageerror', (error) => said.push(`error: ${error.stack.split('\n').slice(0, 3).join(' ')}`))
      const at = `${name}-${theme}-${width}`
      await page.goto(base + path, { waitUntil: 'networkidle' })
      await page.waitForTimeout(
        ['surface', 'sql', 'tables', 'first', 'lists', 'series', 'wrong'].includes(name) ? 900 : 250,
      )
      if (name === 'help') await page.keyboard.press('?')
      if (name === 'finder') await page.keyboard.press('Control+k')
      const jumps = await page.evaluate(() => globalThis.jumps)
      const jumped = jumps.reduce((sum, [value]) => sum + value, 0)
      if (jumped > MOST_JUMP)
        fail(
          `${at}: the layout jumped by ${jumped.toFixed(3)}: ${JSON.stringify(jumps.filter(([value]) => value > 0.01))}`,
        )
      const wide = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth)
      if (wide > 0) fail(`${at}: the page is ${wide} px too wide`)
      await page.screenshot({ path: `${folder}/${at}.png`, fullPage: true })
      await page.evaluate(axe)
      const { violations } = await page.evaluate(() => globalThis.axe.run(document, { resultTypes: ['violations'] }))
      for (const violation of violations)
        fail(
          `${at}: axe ${violation.id}: ${violation.help}\n  ${violation.nodes
            .slice(0, 3)
            .map((n) => `${n.html.slice(0, 160)} | ${n.failureSummary?.split('\n')[1] ?? ''}`)
            .join('\n  ')}`,
        )
      for (const line of said) fail(`${at}: console: ${line}`)
    }
    await context.close()
  }
}
await browser.close()
process.stdout.write(failures ? `${failures} failures\n` : 'no failures\n')
process.exitCode = failures ? 1 : 0
