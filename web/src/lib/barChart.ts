//! Bars over names, as a picture.
import { token } from './colour'
import { plain } from './format'
import { ticks, type TableData } from './plot'
import { label, picture, shortened } from './svg'

export interface BarSpec {
  readonly names: { readonly label: string; readonly values: readonly string[] }
  readonly bars: { readonly label: string; readonly values: readonly (number | null)[] }
}

const ROW = 20
const LETTER = 6.8
const PAD = { right: 70, bottom: 42 } as const
const LONGEST_NAME = 28

/** Draws one bar a name, from zero. */
export function barsSvg(spec: BarSpec, width: number): string {
  const names = spec.names.values.map((name) => shortened(name, LONGEST_NAME))
  const left = 12 + LETTER * Math.max(...names.map((name) => name.length), 4)
  const top = 8
  const values = spec.bars.values.map((value) => (value !== null && Number.isFinite(value) ? value : null))
  const numbers = values.filter((value) => value !== null)
  const [low, high] = [Math.min(0, ...numbers), Math.max(0, ...numbers)]
  const reach = high - low || 1
  // A value stands beyond its bar, to either side.
  const [first, last] = [low < 0 ? left + PAD.right : left, width - PAD.right]
  const px = (value: number) => first + ((value - low) / reach) * Math.max(10, last - first)
  const bottom = top + ROW * names.length
  let body = ''
  for (const tick of ticks(low, low + reach, Math.max(2, (last - first) / 90)))
    body +=
      `<path d="M${px(tick)} ${top}V${bottom}" stroke="${token('--rule')}"/>` +
      label(px(tick), bottom + 15, plain(tick), 'middle')
  values.forEach((value, i) => {
    const y = top + ROW * i
    body += label(left - 6, y + 14, names[i], 'end')
    if (value === null) return
    const [from, to] = [Math.min(px(0), px(value)), Math.max(px(0), px(value))]
    body +=
      `<rect x="${from}" y="${y + 4}" width="${Math.max(1, to - from)}" height="${ROW - 8}" fill="${token('--accent')}"/>` +
      label(value < 0 ? from - 4 : to + 4, y + 14, plain(value, 4), value < 0 ? 'end' : 'start')
  })
  body += `<path d="M${px(0)} ${top}V${bottom}" stroke="${token('--ink')}"/>`
  body += label((first + last) / 2, bottom + 34, spec.bars.label, 'middle')
  return picture(width, bottom + PAD.bottom, body)
}

/** The bars' numbers as a table. */
export const barTable = (spec: BarSpec): TableData => ({
  columns: [spec.names.label, spec.bars.label],
  rows: spec.names.values.map((name, i) => [name, spec.bars.values[i]]),
})
