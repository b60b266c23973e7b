//! B14: what a page offers to a token: `node tests/scopes.mjs http://127.0.0.1:8420 READER WRITER`, two tokens, of
//! which only the second may annotate.
import { contextOf, launch } from './browser.mjs'

const [base, reader, writer] = process.argv.slice(2)
const browser = await launch()
for (const [token, mayAnnotate] of [
  [reader, false],
  [writer, true],
]) {
  const page = await (await contextOf(browser)).newPage()
  await page.goto(`${base}/runs`)
  await page.getByLabel('Token').fill(token)
  await page.keyboard.press('Enter')
  await page.locator('main table a').first().click()
  const section = page.getByRole('region', { name: 'Annotations' })
  await section.getByText('Nobody has annotated this run.').waitFor()
  const forms = await section.locator('form').count()
  const hints = await section.getByText('a token of the scope annotate').count()
  if (forms !== (mayAnnotate ? 1 : 0) || hints !== (mayAnnotate ? 0 : 1))
    throw new Error(`${forms} forms and ${hints} hints for a token that may ${mayAnnotate ? '' : 'not '}annotate`)
}
await browser.close()
process.stdout.write('a form for the token that may annotate alone\n')
