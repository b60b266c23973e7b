//! The browser of these scripts: Chromium at `$CHROMIUM` or where Debian has it, drawing on the processor.
import { chromium } from 'playwright-core'

const ARGS = ['--no-sandbox', '--enable-unsafe-swiftshader', '--disable-dev-shm-usage']

/** How long anything is waited for, ms: a busy machine needs some of it. */
export const LIMIT = 120_000

/** Tries a check again and again until it holds; fails as the check does once the limit is reached. */
export async function eventually(check) {
  const end = Date.now() + LIMIT
  for (;;) {
    try {
      return await check()
    } catch (error) {
      if (Date.now() > end) throw error
      await new Promise((resolve) => setTimeout(resolve, 100))
    }
  }
}

/** A context of a browser in which nothing is waited for without that limit. */
export async function contextOf(browser, options) {
  const context = await browser.newContext(options)
  context.setDefaultTimeout(LIMIT)
  return context
}

/** Starts it, with more arguments where a script needs them. */
export const launch = (...more) =>
  chromium.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: [...ARGS, ...more] })
