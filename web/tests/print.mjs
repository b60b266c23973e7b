//! Bug 6: a surface's page on A4: `node tests/print.mjs http://127.0.0.1:8420 folder`. Prints it in both themes and
//! keeps the PDFs. Fails if the first page is blank, if a figure reaches into another or out of the paper, or if
//! what is to be pressed is printed.
import { mkdir } from 'node:fs/promises'
import { inflateSync } from 'node:zlib'
import { contextOf, launch } from './browser.mjs'

const [base, folder] = process.argv.slice(2)
const faults = []
const { items } = await (await fetch(`${base}/api/v1/surfaces`)).json()
const id = items.find((one) => one.typology !== 'reference').surface_id

/** What the pages of a PDF draw: the number of texts and of filled shapes of each. Chromium writes one object after another. */
function readPages(pdf) {
  const text = pdf.toString('latin1')
  const objects = new Map(Array.from(text.matchAll(/\n(\d+) 0 obj\b/g), (found) => [found[1], found.index]))
  return Array.from(text.matchAll(/\/Type \/Page\b[^]*?endobj/g), ([page]) => {
    const from = objects.get(/\/Contents (\d+) 0 R/.exec(page)[1])
    const begin = text.indexOf('stream\n', from) + 'stream\n'.length
    const drawn = inflateSync(pdf.subarray(begin, text.indexOf('endstream', begin))).toString('latin1')
    return { texts: drawn.match(/T[jJ]\b/g)?.length ?? 0, shapes: drawn.match(/\bf\*?\n/g)?.length ?? 0 }
  })
}

/** What is wrong with the page as it lies on paper. */
const findFaults = () => {
  const found = []
  const isShown = (node) => node.getClientRects().length > 0 && getComputedStyle(node).visibility !== 'hidden'
  for (const node of document.querySelectorAll('#app > header, #app > footer, .page button, .page select, summary'))
    if (isShown(node)) found.push(`${node.tagName} ${node.textContent.trim().slice(0, 30)} is printed`)
  const figures = Array.from(document.querySelectorAll('.figure'), (node) => [node, node.getBoundingClientRect()])
  for (const [figure, box] of figures) {
    const name = figure.getAttribute('aria-label')
    if (getComputedStyle(figure).breakInside !== 'avoid') found.push(`${name} may be parted from its title`)
    for (const part of figure.querySelectorAll('canvas, svg, img, table')) {
      if (!isShown(part)) continue
      const { left, right, top, bottom } = part.getBoundingClientRect()
      if (left < box.left - 1 || right > box.right + 1 || top < box.top - 1 || bottom > box.bottom + 1)
        found.push(`${name}: its ${part.tagName} reaches out of it`)
    }
  }
  for (const [i, [one, a]] of figures.entries())
    for (const [other, b] of figures.slice(i + 1))
      if (!one.contains(other) && a.bottom > b.top + 1 && b.bottom > a.top + 1 && a.right > b.left && b.right > a.left)
        found.push(`${one.getAttribute('aria-label')} lies over ${other.getAttribute('aria-label')}`)
  return found
}

await mkdir(folder, { recursive: true })
const browser = await launch()
for (const colorScheme of ['light', 'dark']) {
  const context = await contextOf(browser, { viewport: { width: 1400, height: 900 }, colorScheme })
  const page = await context.newPage()
  await page.goto(`${base}/surfaces/${id}`, { waitUntil: 'networkidle' })
  await page.locator('.figure canvas').first().waitFor()
  await page.waitForFunction(() => document.querySelectorAll('.busy').length === 0)
  const pdf = await page.pdf({ format: 'A4', path: `${folder}/surface-${colorScheme}.pdf`, preferCSSPageSize: true })
  const pages = readPages(pdf)
  // The grid plot has more.
  if (!(pages[0]?.texts > 10 && pages[0].shapes > 40))
    faults.push(`${colorScheme}: page 1 has ${JSON.stringify(pages[0])}`)
  if (pages.length > 6) faults.push(`${colorScheme}: ${pages.length} pages`)
  // As wide as A4 less its margins.
  await page.emulateMedia({ media: 'print' })
  await page.evaluate(() => dispatchEvent(new Event('beforeprint')))
  await page.evaluate(() => document.documentElement.style.setProperty('width', '186mm'))
  faults.push(...(await page.evaluate(findFaults)).map((fault) => `${colorScheme}: ${fault}`))
  const theme = await page.evaluate(() => document.documentElement.dataset.theme)
  if (theme !== 'light') faults.push(`paper is ${theme}`)
  await page.screenshot({ path: `${folder}/print-${colorScheme}.png`, fullPage: true })
  await context.close()
}
await browser.close()
for (const fault of faults) process.stdout.write(`FAIL ${fault}\n`)
process.stdout.write(faults.length ? `${faults.length} failures\n` : 'two themes on A4, no failures\n')
process.exitCode = faults.length ? 1 : 0
