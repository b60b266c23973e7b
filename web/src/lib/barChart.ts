//! Bars over names, as a picture.
import { token } from './colour'
import { plain } from './format'
import { ticks, type TableData } from './plot'
import { label, picture, shortened } from './svg'

export interface BarSpec {
  readonly names: { readonly label: string; readonly values: readonly string[] }
  /** What the bars' lengths are. */
  readonly value: string
  /** One bar a name, or as many as there are series. */
  readonly series: readonly { readonly label: string; readonly values: readonly (number | null | undefined)[] }[]
}

const ROW = 20
/** The height of one of several bars of a name. */
const THIN = 9
const LETTER = 6.8
const PAD = { right: 70, bottom: 42 } as const
const LONGEST_NAME = 28

/** The colour of one of several series. */
export const seriesColour = (index: number) => `--cat-${index % 8}`

/** Draws the bars of each name, from zero; those of several series in their colours, which a legend names. */
export function barsSvg(spec: BarSpec, width: number): string {
  const names = spec.names.values.map((name) => shortened(name, LONGEST_NAME))
  const left = 12 + LETTER * Math.max(...names.map((name) => name.length), 4)
  const isSingle = spec.series.length === 1
  const [bar, row] = isSingle ? [ROW - 8, ROW] : [THIN, THIN * spec.series.length + 8]
  const colourOf = (index: number) => token(isSingle ? '--accent' : seriesColour(index))
  let body = ''
  let top = 8
  if (!isSingle) {
    let x = left
    spec.series.forEach((series, s) => {
      const name = shortened(series.label, LONGEST_NAME)
      const wide = 24 + LETTER * name.length
      if (x > left && x + wide > width) [x, top] = [left, top + ROW]
      body +=
        `<rect x="${x}" y="${top + 3}" width="12" height="${THIN}" fill="${colourOf(s)}"/>` +
        label(x + 16, top + 12, name)
      x += wide + 8
    })
    top += ROW + 4
  }
  const numbers = spec.series.flatMap((series) => series.values).filter((value) => Number.isFinite(value)) as number[]
  const [low, high] = numbers.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [0, 0])
  const reach = high - low || 1
  const decimals = Math.min(12, Math.max(0, 3 - Math.floor(Math.log10(reach))))
  const rounded = (value: number) => plain(Number(value.toFixed(decimals)), 4)
  // A value stands beyond its bar, to either side.
  const [first, last] = [low < 0 && isSingle ? left + PAD.right : left, width - PAD.right]
  const px = (value: number) => first + ((value - low) / reach) * Math.max(10, last - first)
  const bottom = top + row * names.length
  for (const tick of ticks(low, low + reach, Math.max(2, (last - first) / 90)))
    body +=
      `<path d="M${px(tick)} ${top}V${bottom}" stroke="${token('--rule')}"/>` +
      label(px(tick), bottom + 15, plain(tick), 'middle')
  names.forEach((name, i) => {
    const y = top + row * i
    body += label(left - 6, y + row / 2 + 4, name, 'end')
    spec.series.forEach((series, s) => {
      const value = series.values[i]
      if (typeof value !== 'number' || !Number.isFinite(value)) return
      const [from, to] = [Math.min(px(0), px(value)), Math.max(px(0), px(value))]
      body += `<rect x="${from}" y="${y + 4 + THIN * s}" width="${Math.max(1, to - from)}" height="${bar}" fill="${colourOf(s)}"/>`
      if (isSingle) body += label(value < 0 ? from - 4 : to + 4, y + 14, rounded(value), value < 0 ? 'end' : 'start')
    })
  })
  body += `<path d="M${px(0)} ${top}V${bottom}" stroke="${token('--ink')}"/>`
  body += label((first + last) / 2, bottom + 34, spec.value, 'middle')
  return picture(width, bottom + PAD.bottom, body)
}

/** The bars' numbers as a table. */
export const barTable = (spec: BarSpec): TableData => ({
  columns: [spec.names.label, ...spec.series.map((one) => one.label)],
  rows: spec.names.values.map((name, i) => [name, ...spec.series.map((one) => one.values[i] ?? null)]),
})
