//! What the pages must do, tried in a browser: `node tests/behaviour.mjs http://127.0.0.1:8420`.
import assert from 'node:assert/strict'
import { contextOf, eventually, launch } from './browser.mjs'

const base = process.argv[2]
const get = async (path) => (await fetch(base + path)).json()
const sql = async (query) =>
  (
    await fetch(base + '/api/v1/sql', {
      method: 'POST',
      headers: { accept: 'application/json', 'content-type': 'application/json' },
      body: JSON.stringify({ query }),
    })
  ).json()
const lake = await get('/api/v1/lake')
const all = await get('/api/v1/surfaces?limit=500')
const id = all.items.find((s) => s.typology !== 'reference').surface_id
const browser = await launch()
const context = await contextOf(browser, {
  viewport: { width: 1280, height: 900 },
  deviceScaleFactor: 1,
  acceptDownloads: true,
})
const page = await context.newPage()
const said = []
page.on('console', (message) => {
  if (!message.text().includes('GPU stall due to ReadPixels')) said.push(message.text())
})
page.on('pageerror', (error) => said.push(error.message))
const open = (path) => page.goto(base + path, { waitUntil: 'networkidle' })
const settled = () => page.waitForLoadState('networkidle').then(() => page.waitForTimeout(150))
let done = 0
async function check(name, what) {
  const from = performance.now()
  await what()
  done += 1
  process.stdout.write(`ok ${name} (${(performance.now() - from).toFixed(0)} ms)\n`)
}

/** The paper's scale, written out once more so that the pages' own cannot agree with itself. */
function expected(db) {
  if (db >= 0) return [Math.round((255 * Math.min(6, db)) / 6), 0, 0]
  return Array(3).fill(Math.round((255 * Math.min(20, -db)) / 20))
}

await check('the grid plot’s cells have the colours that SQL says', async () => {
  const microphone = 14
  await open(`/surfaces/${id}?microphone=${microphone}`)
  await settled()
  const columns = lake.bands
    .map((b) => `10 * log10(${b.key === 'total' ? 'tnce_total' : `tnce_band_${b.key}`}) as "${b.key}"`)
    .join(', ')
  const rows = await sql(
    `select case when microphone = ${microphone} then speaker else microphone end as point, ${columns} from tnce where surface_id = '${id}' and (microphone = ${microphone} or speaker = ${microphone})`,
  )
  const drawn = () =>
    page.evaluate(() =>
      Object.fromEntries(
        [...document.querySelectorAll('.cells [data-point]')].map((cell) => [
          `${cell.dataset.row}/${cell.dataset.point}`,
          getComputedStyle(cell).fill.match(/\d+/g).map(Number),
        ]),
      ),
    )
  await eventually(async () => {
    const colours = await drawn()
    for (const row of rows)
      lake.bands.forEach((band, b) => {
        const what = `point ${row.point}, band ${band.key}, ${row[band.key]} dB`
        assert.deepEqual(colours[`${b}/${row.point}`], expected(row[band.key]), what)
      })
    assert.ok(Object.keys(colours).length > 300, `${Object.keys(colours).length} cells`)
  })
})

await check('grid plots of Flat are black, and Compare shows the same as Surface', async () => {
  const flat = all.items.find((s) => s.surface_id === id).flat_reference
  const fills = () =>
    page.evaluate(() => [...document.querySelectorAll('.cells [data-point]')].map((c) => getComputedStyle(c).fill))
  await open(`/surfaces/${flat}`)
  await eventually(async () => {
    const black = (await fills()).filter((fill) => /^rgb\([0-2], [0-2], [0-2]\)$/.test(fill)).length
    assert.ok(black > 300, `${black} black cells`)
  })
  await open(`/compare?s=${id}`)
  await eventually(async () => assert.ok((await fills()).length > 50))
  const compared = await fills()
  await open(`/surfaces/${id}`)
  await eventually(async () => assert.deepEqual((await fills()).slice(-compared.length), compared))
})

await check('a facet click changes the address and the counts, and a fresh link shows the same', async () => {
  await open('/')
  const before = await page.locator('h1').innerText()
  const facet = all.facets.find((f) => f.name === 'typology').values[0]
  await page
    .locator('button.value', { hasText: facet.value.replaceAll('_', ' ') })
    .first()
    .click()
  await page.waitForFunction((text) => document.querySelector('h1').innerText !== text, before)
  await page.waitForURL(new RegExp(`typology=${facet.value}`))
  await settled()
  const heading = () => page.locator('h1').innerText()
  await eventually(async () => assert.ok((await heading()).startsWith(String(facet.count)), await heading()))
  const shown = await heading()
  const sheet = () => page.locator('.sheet li').allInnerTexts()
  await page.waitForFunction(() => document.querySelector('.sheet').ariaBusy === 'false')
  const cards = await sheet()
  await open(page.url().slice(base.length))
  await eventually(async () => assert.equal(await heading(), shown))
  await eventually(async () => assert.deepEqual(await sheet(), cards))
  await page.goBack()
})

await check('the relief is not blank, and shows more once a pair is chosen', async () => {
  const kinds = async () =>
    page.evaluate(() => {
      const canvas = document.querySelector('.stage canvas')
      const copy = document.createElement('canvas')
      copy.width = canvas.width
      copy.height = canvas.height
      const context = copy.getContext('2d')
      context.drawImage(canvas, 0, 0)
      const { data } = context.getImageData(0, 0, copy.width, copy.height)
      const colours = new Set()
      let orange = 0
      for (let i = 0; i < data.length; i += 4) {
        colours.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2])
        if (data[i] > data[i + 2] + 60) orange += 1
      }
      return { colours: colours.size, orange }
    })
  await open(`/surfaces/${id}?microphone=14`)
  const alone = await eventually(async () => {
    const seen = await kinds()
    assert.ok(seen.colours > 50, `${seen.colours} colours`)
    return seen
  })
  await open(`/surfaces/${id}?microphone=14&point=40`)
  await eventually(async () => {
    const pair = await kinds()
    assert.ok(pair.orange > alone.orange + 50, `${pair.orange} pixels of the speaker and its path`)
  })
})

await check('a click makes a point the microphone, another chooses the pair', async () => {
  await open(`/surfaces/${id}`)
  await settled()
  const box = await page.locator('.cells').boundingBox()
  await page.mouse.click(box.x + 58 + 8, box.y + 22 + 8)
  await page.waitForURL(/microphone=5(&|$)/)
  await settled()
  await page.mouse.click(box.x + 58 + 60, box.y + 22 + 60)
  await page.waitForURL(/microphone=5&point=\d+/)
  await page.locator('a', { hasText: 'Open impulse response' }).waitFor()
})

await check('the keyboard alone reaches an impulse response from the wall', async () => {
  await open('/')
  await page.locator('.sheet li').first().waitFor()
  for (let i = 0; i < 120; i += 1) {
    await page.keyboard.press('Tab')
    if (await page.evaluate((wanted) => document.activeElement?.dataset?.id !== undefined && wanted !== '', id)) break
  }
  const isFocused = () => page.evaluate((wanted) => document.activeElement?.dataset?.id === wanted, id)
  for (let i = 0; i < all.items.length && !(await isFocused()); i += 1) await page.keyboard.press('ArrowRight')
  assert.ok(await isFocused(), 'the arrows reach the surface')
  await page.keyboard.press('Enter')
  await page.waitForURL(`**/surfaces/${id}`)
  await settled()
  for (let i = 0; i < 60; i += 1) {
    await page.keyboard.press('Tab')
    if (await page.evaluate(() => document.activeElement?.classList.contains('cells'))) break
  }
  await page.keyboard.press('ArrowRight')
  await page.keyboard.press('m')
  await page.keyboard.press('ArrowDown')
  await page.keyboard.press('Enter')
  await page.waitForURL(/microphone=\d+&point=\d+/)
  await page.locator('a', { hasText: 'Open impulse response' }).waitFor()
  for (let i = 0; i < 20; i += 1) {
    await page.keyboard.press('Tab')
    if (await page.evaluate(() => document.activeElement?.textContent?.includes('Open impulse response'))) break
  }
  await page.keyboard.press('Enter')
  await page.waitForURL(/\/pairs\/\d+$/)
  await page.getByRole('heading', { name: 'Spectrogram' }).waitFor()
})

await check('a WAV, a picture and numbers can be saved', async () => {
  const [wav] = await Promise.all([
    page.waitForEvent('download'),
    page.getByRole('link', { name: 'WAV, full scale' }).click(),
  ])
  assert.match(wav.suggestedFilename(), /\.wav$/)
  for (const [item, ending] of [
    ['Picture, PNG', 'png'],
    ['Picture, SVG', 'svg'],
    ['Numbers, CSV', 'csv'],
    ['Numbers, Parquet', 'parquet'],
    ['Numbers, Arrow', 'arrow'],
  ]) {
    await page.locator('section[aria-label="Spectrum"] summary').click()
    const [file] = await Promise.all([
      page.waitForEvent('download'),
      page.locator('details[open] .menu button', { hasText: item }).click(),
    ])
    assert.ok(file.suggestedFilename().endsWith(`.${ending}`), file.suggestedFilename())
    const stream = await file.createReadStream()
    let bytes = 0
    for await (const part of stream) bytes += part.length
    assert.ok(bytes > 500, `${ending}: ${bytes} bytes`)
  }
})

await check('the console shows rows of every table, integers of 64 bits to the last digit', async () => {
  const tables = await get('/api/v1/tables')
  assert.ok(tables.length > 10, `${tables.length} tables`)
  for (const { name } of tables) {
    await open(`/sql?q=${encodeURIComponent(`select * from ${name} limit 3`)}`)
    await page
      .locator('.rows tbody tr')
      .first()
      .waitFor()
      .catch(() => assert.fail(`no rows of ${name} are shown: ${said.join(' ')}`))
  }
  const odd =
    "select 1767718800000000001 as ns, arrow_cast(9007199254740993, 'UInt64') as large, [9007199254740993] as list, to_timestamp_seconds(9000000000000) as late, named_struct('n', -5) as s"
  await open(`/sql?q=${encodeURIComponent(odd)}`)
  await page.locator('.rows tbody td').first().waitFor()
  assert.deepEqual(await page.locator('.rows tbody td').allInnerTexts(), [
    '1767718800000000001',
    '9007199254740993',
    '9007199254740993',
    'out of range',
    '{"n":-5}',
  ])
})

await check('names from the lake stay text', async () => {
  await page.route('**/api/v1/surfaces?*', async (route) => {
    const answer = await (await route.fetch()).json()
    answer.items[0].surface_id = '<img src=x onerror="document.title=1">'
    await route.fulfill({ json: answer })
  })
  await open('/')
  assert.equal(await page.locator('.sheet .id').first().innerText(), '<img src=x onerror="document.title=1">')
  assert.match(await page.title(), /Wall/)
  await page.unroute('**/api/v1/surfaces?*')
  said.splice(0, said.length, ...said.filter((line) => !line.includes('404')))
})

await check('what the first view costs', async () => {
  const fresh = await contextOf(browser, { viewport: { width: 1280, height: 900 } })
  const first = await fresh.newPage()
  let script = 0
  first.on('response', async (response) => {
    if (response.url().endsWith('.js')) script += Number(response.headers()['content-length'] ?? 0)
  })
  const client = await fresh.newCDPSession(first)
  await first.goto(base + '/')
  await first.locator('.sheet li').first().waitFor()
  const shown = await first.evaluate(() => performance.now())
  const times = []
  const facets = first.locator('button.value')
  for (let i = 0; i < 20; i += 1) {
    // From the click to the frame that shows the answer, in the page's own time.
    times.push(
      await facets.nth(i % 4).evaluate(
        (button) =>
          new Promise((resolve) => {
            const start = performance.now()
            button.click()
            const look = () =>
              document.querySelector('.sheet').ariaBusy === 'false'
                ? resolve(performance.now() - start)
                : requestAnimationFrame(look)
            requestAnimationFrame(() => requestAnimationFrame(look))
          }),
      ),
    )
  }
  times.sort((a, b) => a - b)
  await client.send('HeapProfiler.enable')
  await client.send('HeapProfiler.collectGarbage')
  const { usedSize } = await client.send('Runtime.getHeapUsage')
  process.stdout.write(
    `  first cards after ${shown.toFixed(0)} ms, facet click p95 ${times[18].toFixed(0)} ms, scripts ${(script / 1000).toFixed(0)} kB as sent, heap ${(usedSize / 1e6).toFixed(1)} MB\n`,
  )
  assert.ok(script > 0 && script < 120_000, `${script} bytes of script`)
  await fresh.close()
})

assert.deepEqual(said, [], 'the console is not empty')
await browser.close()
process.stdout.write(`${done} checks\n`)
