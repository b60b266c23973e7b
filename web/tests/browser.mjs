//! The browser of these scripts: Chromium at `$CHROMIUM` or where Debian has it, drawing on the processor.
import { chromium } from 'playwright-core'

const ARGS = ['--no-sandbox', '--enable-unsafe-swiftshader', '--disable-dev-shm-usage']

/** Starts it, with more arguments where a script needs them. */
export const launch = (...more) => chromium.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: [...ARGS, ...more] })
