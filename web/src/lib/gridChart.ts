//! A column's mean over two others, as a grid of colours.
import { cellText, type Answer } from './answer'
import { css, inkOn, viridis } from './colour'
import { plain } from './format'
import type { TableData } from './plot'
import { compareNames } from './series'
import { escape, label, picture, shortened as shortenedTo } from './svg'

/** More names than that across or up are no picture. */
export const MOST_NAMES = 120

type Column = Answer['columns'][number]

export interface GridSpec {
  readonly across: { readonly label: string; readonly names: readonly string[] }
  readonly up: { readonly label: string; readonly names: readonly string[] }
  readonly value: string
  /** Means of the cells, row by row; null for a cell without rows. */
  readonly means: readonly (number | null)[]
}

const LETTER = 6.8
const LONGEST_NAME = 18
const shortened = (text: string) => shortenedTo(text, LONGEST_NAME)

/** The names of a column in their order, and for each row the index of its own; undefined if there are too many. */
function namesOf(column: Column, rows: number) {
  const found = new Map<string, unknown>()
  for (let i = 0; i < rows; i += 1) {
    const value = column.at(i)
    found.set(cellText(value), value)
    if (found.size > MOST_NAMES) return undefined
  }
  const isNumber = column.numeric
  const names = [...found].sort(([a, x], [b, y]) => (isNumber ? Number(x) - Number(y) : compareNames(a, b)))
  const index = new Map(names.map(([name], i) => [name, i]))
  return { names: names.map(([name]) => name), at: (i: number) => index.get(cellText(column.at(i))) ?? 0 }
}

/** Takes the means; undefined if a column has too many names. */
export function gridOf(rows: number, across: Column, up: Column, value: Column): GridSpec | undefined {
  const columns = namesOf(across, rows)
  const lines = columns && namesOf(up, rows)
  if (!columns || !lines) return undefined
  const cells = columns.names.length * lines.names.length
  const sums = new Array<number>(cells).fill(0)
  const counts = new Array<number>(cells).fill(0)
  for (let i = 0; i < rows; i += 1) {
    const found = value.at(i)
    const number = found === null || found === undefined ? NaN : Number(found)
    if (!Number.isFinite(number)) continue
    const cell = lines.at(i) * columns.names.length + columns.at(i)
    sums[cell] += number
    counts[cell] += 1
  }
  return {
    across: { label: across.name, names: columns.names },
    up: { label: up.name, names: lines.names },
    value: value.name,
    means: sums.map((sum, cell) => (counts[cell] ? sum / counts[cell] : null)),
  }
}

/** Draws the cells, the first row at the bottom, and the numbers where there is room. */
export function gridSvg(spec: GridSpec, width: number): string {
  const [columns, rows] = [spec.across.names.length, spec.up.names.length]
  const left = 30 + LETTER * Math.max(4, ...spec.up.names.map((name) => shortened(name).length))
  const top = 8
  const cellWidth = Math.max(2, (width - left - 12) / columns)
  const cellHeight = Math.max(4, Math.min(28, 480 / rows))
  const bottom = top + cellHeight * rows
  const numbers = spec.means.filter((mean) => mean !== null)
  const low = numbers.reduce((least, mean) => Math.min(least, mean), Infinity)
  const high = numbers.reduce((most, mean) => Math.max(most, mean), -Infinity)
  const every = (room: number, size: number) => Math.max(1, Math.ceil(room / size))
  let body = ''
  spec.means.forEach((mean, cell) => {
    if (mean === null) return
    const [x, y] = [left + (cell % columns) * cellWidth, bottom - (Math.floor(cell / columns) + 1) * cellHeight]
    const colour = viridis(high > low ? (mean - low) / (high - low) : 0.5)
    const text = plain(mean, 3)
    body += `<rect x="${x}" y="${y}" width="${cellWidth}" height="${cellHeight}" fill="${css(colour)}"/>`
    if (cellHeight >= 16 && cellWidth > LETTER * text.length + 4)
      body += `<text x="${x + cellWidth / 2}" y="${y + cellHeight / 2 + 4}" text-anchor="middle" fill="${inkOn(colour)}">${escape(text)}</text>`
  })
  const stepUp = every(14, cellHeight)
  spec.up.names.forEach((name, i) => {
    if (i % stepUp === 0) body += label(left - 6, bottom - (i + 0.5) * cellHeight + 4, shortened(name), 'end')
  })
  const widest = LETTER * Math.max(3, ...spec.across.names.map((name) => shortened(name).length)) + 6
  const stepAcross = every(widest, cellWidth)
  spec.across.names.forEach((name, i) => {
    if (i % stepAcross === 0) body += label(left + (i + 0.5) * cellWidth, bottom + 15, shortened(name), 'middle')
  })
  const range = numbers.length ? `, ${plain(low, 4)} (dark) to ${plain(high, 4)} (bright)` : ''
  body += label(left, bottom + 34, `${spec.up.label} over ${spec.across.label}; mean of ${spec.value}${range}`)
  return picture(width, bottom + 44, body)
}

/** The grid's numbers as a table, one row per cell. */
export const gridTable = (spec: GridSpec): TableData => ({
  columns: [spec.across.label, spec.up.label, `mean of ${spec.value}`],
  rows: spec.means.map((mean, cell) => [
    spec.across.names[cell % spec.across.names.length],
    spec.up.names[Math.floor(cell / spec.across.names.length)],
    mean,
  ]),
})
