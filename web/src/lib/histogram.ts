//! How often the values of a column fall into ranges of equal width, as bars.
import type { BarSpec } from './barChart'
import { plain } from './format'
import { ticks } from './plot'

const ABOUT = 24

/** Counts the values in ranges between round numbers; those that are no numbers are left out. */
export function histogramBars(label: string, values: readonly (number | null)[]): BarSpec {
  const numbers = values.filter((value): value is number => value !== null && Number.isFinite(value))
  const low = numbers.reduce((least, value) => Math.min(least, value), Infinity)
  const high = numbers.reduce((most, value) => Math.max(most, value), -Infinity)
  if (low >= high) return counted(label, numbers.length ? [plain(low, 4)] : [], numbers.length ? [numbers.length] : [])
  const marks = ticks(low, high, ABOUT)
  const width = marks.length > 1 ? marks[1] - marks[0] : high - low
  const first = Math.floor(low / width + 1e-9) * width
  const counts = new Array<number>(Math.floor((high - first) / width + 1e-9) + 1).fill(0)
  for (const value of numbers) counts[Math.min(counts.length - 1, Math.floor((value - first) / width + 1e-9))] += 1
  const edge = (i: number) => plain(first + i * width, 4)
  return counted(
    label,
    counts.map((_, i) => `${edge(i)} to ${edge(i + 1)}`),
    counts,
  )
}

const counted = (label: string, ranges: readonly string[], counts: readonly number[]): BarSpec => ({
  names: { label, values: ranges },
  value: 'rows',
  series: [{ label: 'rows', values: counts }],
})
