//! Bug 3: Compare of rooms whose surfaces have no measured pair in common: `node tests/apart.mjs http://127.0.0.1:8420`,
//! a lake of the rooms `attic` (pair 0), `cellar` (pair 1) and `hall` (both). Fails unless each room's own response is
//! drawn, by its first pair or by the one that is chosen.
import { contextOf, launch } from './browser.mjs'

const base = process.argv[2]
const browser = await launch()
const page = await (await contextOf(browser, { viewport: { width: 1400, height: 900 } })).newPage()
page.on('pageerror', (error) => {
  throw error
})

/** Waits until all three plots have these lines. */
const seeLines = async (...names) => {
  for (const name of names) await page.locator('main .legend .name', { hasText: name }).nth(2).waitFor()
  await page.locator('main canvas').nth(2).waitFor()
}

await page.goto(`${base}/compare?s=attic,cellar`)
await seeLines('attic 0', 'cellar 1')
await page.getByText('No pair is measured on all of them').waitFor()
// The hall's pair 0 is the attic's, too; any other can be laid over it.
await page.goto(`${base}/compare?s=attic,hall`)
await seeLines('attic 0', 'hall 0')
await page.getByLabel('pair').nth(1).selectOption('1')
await seeLines('attic 0', 'hall 1')
if (!page.url().endsWith('pairs=,1')) throw new Error(`the choice is not in the address ${page.url()}`)
await browser.close()
process.stdout.write('rooms are compared by pairs of their own\n')
