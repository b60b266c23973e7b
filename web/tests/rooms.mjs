//! Every page of a lake of rooms, which came as WAV files and has few pairs, eight bands and no meshes:
//! `node tests/rooms.mjs http://127.0.0.1:8420 shots`. Fails where a page throws, asks for what is not there, shows a
//! broken picture or an error, waits for ever, is too wide, or has labels one over the other.
import { mkdir } from 'node:fs/promises'
import { contextOf, eventually, launch } from './browser.mjs'

const [base, folder] = process.argv.slice(2)
const get = async (path) => (await fetch(base + path)).json()
const { items } = await get('/api/v1/surfaces')
const { items: runs } = await get('/api/v1/runs')
const ids = items.map((one) => one.surface_id)
const [first] = ids
const pairs = `/surfaces/${first}/pairs`
const { items: measured } = await get(`/api/v1${pairs}`)

const PAGES = {
  wall: '/',
  sorted: '/?sort=started&order=desc',
  ...Object.fromEntries(ids.map((id) => [`surface-${id}`, `/surfaces/${id}`])),
  microphone: `/surfaces/${first}?mean=microphone&microphone=1&point=0`,
  ...Object.fromEntries(measured.map(({ pair_id }) => [`pair-${pair_id}`, `${pairs}/${pair_id}`])),
  decibels: `${pairs}/0?form=decibels&re=maximum&octave=3&show=group-delay&delay=none&axis=linear`,
  etc: `${pairs}/0?form=etc&show=group-delay&octave=1`,
  decay: `${pairs}/0?form=decay&signal=reflected`,
  waterfall: `${pairs}/0?as=waterfall`,
  overlaid: `${pairs}/0?with=${ids[1]},${first}/1`,
  compare: '/compare',
  alone: `/compare?s=${first}`,
  two: `/compare?s=${ids.join(',')}`,
  difference: `/compare?s=${ids.join(',')}&show=difference&band=1000`,
  map: '/map',
  third: '/map?axes=23',
  som: `/map?axes=som&at=${first}`,
  runs: '/runs',
  run: `/runs/${runs[0].run_id}`,
  sql: '/sql',
  query: `/sql?q=${encodeURIComponent('select surface_id, pair_id, snr_db from measurements order by 1, 2')}`,
  operations: '/operations',
}

/** What is wrong with the page as it is now. */
const findFaults = () => {
  const faults = []
  const text = document.body.innerText
  for (const word of ['NaN', 'undefined', 'Infinity', '[object']) if (text.includes(word)) faults.push(`shows ${word}`)
  for (const one of document.querySelectorAll('[role=alert]')) faults.push(`an error: ${one.textContent}`)
  for (const one of document.querySelectorAll('.busy')) faults.push(`${one.className} waits`)
  for (const image of document.images)
    if (!image.complete || image.naturalWidth === 0) faults.push(`broken picture ${image.src}`)
  for (const svg of document.querySelectorAll('main svg')) {
    const boxes = Array.from(svg.querySelectorAll('text'), (label) => [
      label.textContent,
      label.getBoundingClientRect(),
    ])
    for (const [i, [a, one]] of boxes.entries())
      for (const [b, other] of boxes.slice(i + 1)) {
        const across = Math.min(one.right, other.right) - Math.max(one.left, other.left)
        const down = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top)
        if (a.trim() && b.trim() && across > 1 && down > 2) faults.push(`labels ${a.trim()} and ${b.trim()} overlap`)
      }
    if (svg.clientWidth < 8) faults.push(`a drawing is ${svg.clientWidth} px wide`)
  }
  if (document.documentElement.scrollWidth > innerWidth) faults.push('the page is too wide')
  if (document.documentElement.scrollHeight > 6000) faults.push('the page is longer than 6000 px')
  return faults
}

await mkdir(folder, { recursive: true })
const browser = await launch()
let failures = 0
for (const width of [1400, 390]) {
  const context = await contextOf(browser, { viewport: { width, height: 900 } })
  const page = await context.newPage()
  let heard = []
  page.on('pageerror', (error) => heard.push(error.stack))
  page.on('console', (message) => {
    if (message.type() === 'error') heard.push(message.text())
  })
  page.on('response', (response) => {
    if (response.status() >= 400) heard.push(`${response.status()} ${response.url()}`)
  })
  for (const [name, path] of Object.entries(PAGES)) {
    heard = []
    await page.goto(base + path, { waitUntil: 'networkidle' })
    const found = await eventually(async () => {
      const faults = await page.evaluate(findFaults)
      if (faults.some((fault) => fault.includes('waits') || fault.includes('broken')))
        throw new Error(faults.join('; '))
      return faults
    })
    await page.screenshot({ path: `${folder}/${name}-${width}.png`, fullPage: true })
    for (const fault of [...found, ...heard]) {
      failures += 1
      process.stdout.write(`FAIL ${name} at ${width} px: ${fault}\n`)
    }
  }
  await context.close()
}
await browser.close()
process.stdout.write(failures ? `${failures} failures\n` : `${Object.keys(PAGES).length} pages, no failures\n`)
process.exitCode = failures ? 1 : 0
