//! The README's pictures: `node tests/pictures.mjs http://127.0.0.1:8080 ../docs`. JPEG, because PNG of shaded reliefs is
//! four times as large.
import { mkdir, stat } from 'node:fs/promises'
import { launch } from './browser.mjs'

const [base, folder = '../docs'] = process.argv.slice(2)
const MOST_BYTES = 200_000
const get = async (path) => (await fetch(base + path)).json()
const { items } = await get('/api/v1/surfaces?limit=500')
const id = items.findLast((s) => s.typology !== 'reference').surface_id
const PICTURES = [
  ['wall', '/'],
  ['surface', `/surfaces/${id}?microphone=14&point=40&over=flat-band`],
  ['response', `/surfaces/${id}/pairs/159`],
]

await mkdir(folder, { recursive: true })
const browser = await launch()
const page = await (
  await browser.newContext({ viewport: { width: 1200, height: 720 }, colorScheme: 'light' })
).newPage()
for (const [name, path] of PICTURES) {
  await page.goto(base + path, { waitUntil: 'networkidle' })
  await page.waitForTimeout(1200)
  const file = `${folder}/${name}.jpg`
  await page.screenshot({ path: file, type: 'jpeg', quality: 72 })
  const { size } = await stat(file)
  process.stdout.write(`${file} ${size} bytes\n`)
  if (size > MOST_BYTES) throw new Error(`${file} has more than ${MOST_BYTES} bytes`)
}
await browser.close()
