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

const LABEL_HEIGHT = 22
const LABEL_FONT = "12px 'IBM Plex Sans', 'Helvetica Neue', Arial, sans-serif"

/** Adds the origin at the foot of a drawing, unless it says it already, as those of the server do. */
export function withOrigin(svg: string, word: string): string {
  const drawing = new DOMParser().parseFromString(svg, 'image/svg+xml')
  const root = drawing.documentElement
  const texts = Array.from(root.querySelectorAll('text'), (text) => text.textContent ?? '')
  if (!word || texts.some((text) => /^(partly )?(simulated|computed)\b/.test(text.trim()))) return svg
  const [width, height] = ['width', 'height'].map((name) => Number(root.getAttribute(name)))
  root.setAttribute('height', String(height + LABEL_HEIGHT))
  root.setAttribute('viewBox', `0 0 ${width} ${height + LABEL_HEIGHT}`)
  const label = drawing.createElementNS('http://www.w3.org/2000/svg', 'text')
  label.setAttribute('x', '8')
  label.setAttribute('y', String(height + LABEL_HEIGHT - 7))
  label.setAttribute('fill', token('--mark'))
  label.textContent = word
  root.append(label)
  return new XMLSerializer().serializeToString(root)
}

/** Adds the origin at the foot of a picture of pixels. */
export async function pngWithOrigin(png: Blob, word: string): Promise<Blob> {
  if (!word) return png
  const image = await createImageBitmap(png)
  const canvas = document.createElement('canvas')
  canvas.width = image.width
  canvas.height = image.height + LABEL_HEIGHT
  const context = canvas.getContext('2d')
  if (!context) throw new Error('the picture could not be made')
  context.fillStyle = token('--paper')
  context.fillRect(0, 0, canvas.width, canvas.height)
  context.drawImage(image, 0, 0)
  context.fillStyle = token('--mark')
  context.font = LABEL_FONT
  context.fillText(word, 8, canvas.height - 7)
  return blobOf(canvas)
}

/** An SVG drawn at twice its size. */
export async function pngOf(svg: string): Promise<Blob> {
  const image = new Image()
  const url = URL.createObjectURL(new Blob([svg], { type: 'image/svg+xml' }))
  try {
    image.src = url
    await image.decode()
    const canvas = document.createElement('canvas')
    canvas.width = image.naturalWidth * 2
    canvas.height = image.naturalHeight * 2
    canvas.getContext('2d')?.drawImage(image, 0, 0, canvas.width, canvas.height)
    return await blobOf(canvas)
  } finally {
    URL.revokeObjectURL(url)
  }
}

export const blobOf = (canvas: HTMLCanvasElement) =>
  new Promise<Blob>((resolve, reject) =>
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error('the picture could not be made'))), 'image/png'),
  )

export const FORMATS = {
  csv: 'text/csv',
  parquet: 'application/vnd.apache.parquet',
  arrow: 'application/vnd.apache.arrow.stream',
} as const

/** Runs a query and saves its answer. */
export async function saveQuery(query: string, format: keyof typeof FORMATS, name: string): Promise<void> {
  save(await (await sql(query, FORMATS[format])).blob(), `${name}.${format}`)
}
