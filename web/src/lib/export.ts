//! Saves pictures and numbers.
import { sql } from './api'
import { token } from './colour'
import type { TableData } from './plot'

export function save(blob: Blob, name: string): void {
  const link = document.createElement('a')
  link.href = URL.createObjectURL(blob)
  link.download = name.replace(/[^\w.-]+/g, '_')
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000)
}

const cell = (value: unknown) => {
  const text = value === null || value === undefined ? '' : String(value)
  return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text
}

export const csvOf = (table: TableData) =>
  new Blob([[table.columns, ...table.rows].map((row) => row.map(cell).join(',')).join('\n') + '\n'], {
    type: 'text/csv',
  })

const LINE_PX = 22
const MARGIN_PX = 8

/** The first drawing of a figure, as something that a canvas takes. */
async function drawingOf(figure: Element): Promise<HTMLCanvasElement | HTMLImageElement> {
  const drawn = figure.querySelector('canvas, .drawing svg')
  if (drawn instanceof HTMLCanvasElement) return drawn
  if (!drawn) throw new Error('the picture is not drawn yet')
  const image = new Image()
  image.src = URL.createObjectURL(new Blob([new XMLSerializer().serializeToString(drawn)], { type: 'image/svg+xml' }))
  await image.decode()
  URL.revokeObjectURL(image.src)
  return image
}

/** The first drawing of a figure as it is on the screen, with its title, its plot's legend, and the data's origin. */
export async function pictureOf(figure: Element, title: string, origin: string): Promise<Blob> {
  const drawing = await drawingOf(figure)
  const scale = drawing instanceof HTMLCanvasElement ? devicePixelRatio || 1 : 1
  const canvas = document.createElement('canvas')
  const context = canvas.getContext('2d')
  if (!context) throw new Error('the picture could not be made')
  const legend = Array.from(figure.querySelectorAll('.legend .entry'), (entry) => ({
    name: entry.querySelector('.name')?.textContent ?? '',
    colour: getComputedStyle(entry.querySelector('line') ?? entry).stroke,
  }))
  const meaning = figure.querySelector('svg.scale')?.getAttribute('aria-label')
  const lines = legend.length || meaning ? 2 : 1
  canvas.width = drawing.width
  canvas.height = drawing.height + scale * LINE_PX * (lines + (origin ? 1 : 0))
  context.fillStyle = token('--paper')
  context.fillRect(0, 0, canvas.width, canvas.height)
  context.drawImage(drawing, 0, scale * LINE_PX * lines)
  context.scale(scale, scale)
  const font = getComputedStyle(document.body).fontFamily
  context.fillStyle = token('--ink')
  context.font = `600 12px ${font}`
  context.fillText(title, MARGIN_PX, 15)
  context.font = `12px ${font}`
  if (meaning) context.fillText(meaning, MARGIN_PX, LINE_PX + 15)
  let x = MARGIN_PX
  for (const { name, colour } of legend) {
    context.fillStyle = colour
    context.fillRect(x, LINE_PX + 9, 16, 3)
    context.fillStyle = token('--ink')
    context.fillText(name, x + 20, LINE_PX + 15)
    x += 36 + context.measureText(name).width
  }
  context.fillStyle = token('--mark')
  if (origin) context.fillText(origin, MARGIN_PX, canvas.height / scale - 7)
  return new Promise((resolve, reject) =>
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error('the picture could not be made'))), 'image/png'),
  )
}

export const FORMATS = {
  csv: 'text/csv',
  parquet: 'application/vnd.apache.parquet',
  arrow: 'application/vnd.apache.arrow.stream',
} as const

/** Runs a query and saves its answer. */
export async function saveQuery(query: string, format: keyof typeof FORMATS, name: string): Promise<void> {
  save(await (await sql(query, FORMATS[format])).blob(), `${name}.${format}`)
}
