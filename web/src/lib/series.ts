//! The rows of an answer as lines or bars, one for each value of a column.
import { cellText, type Answer } from './answer'

type Column = Answer['columns'][number]

/** More series than there are colours are no picture. */
export const MOST_SERIES = 8

/** Orders names: those that are numbers by these, as 2500 before 10000, then the others, as `total`. */
export function compareNames(a: string, b: string): number {
  const [x, y] = [a, b].map((name) => (name.trim() === '' ? NaN : Number(name)))
  if (Number.isNaN(x) || Number.isNaN(y))
    return Number(Number.isNaN(x)) - Number(Number.isNaN(y)) || (a < b ? -1 : Number(a > b))
  return x - y
}

export const toNumber = (value: unknown) => (value === null || value === undefined ? null : Number(value))

/** The values of a column as names in their order; undefined if there are more than `most`. */
export function distinctNames(column: Column, rows: number, most: number): string[] | undefined {
  const found = new Set<string>()
  for (let i = 0; i < rows; i += 1) {
    found.add(cellText(column.at(i)))
    if (found.size > most) return undefined
  }
  return [...found].sort(compareNames)
}

/** Values of several series over one axis; where a series has none, undefined. */
export interface SeriesRows<Key> {
  readonly keys: readonly Key[]
  readonly series: readonly { readonly label: string; readonly values: readonly (number | null | undefined)[] }[]
}

/** Puts values below each other: rows of one key share a line unless they are of one series, so that none is lost. */
export function seriesOf<Key>(
  rows: number,
  keyOf: (row: number) => Key,
  value: Column,
  names: readonly string[],
  nameOf: (row: number) => string,
  compare?: (a: Key, b: Key) => number,
): SeriesRows<Key> {
  const index = new Map(names.map((name, s) => [name, s]))
  const groups = new Map<Key, number[]>()
  for (let row = 0; row < rows; row += 1) {
    const key = keyOf(row)
    if (Number.isNaN(key)) continue
    const group = groups.get(key)
    if (group) group.push(row)
    else groups.set(key, [row])
  }
  const keys: Key[] = []
  const values = names.map(() => [] as (number | null | undefined)[])
  for (const key of compare ? [...groups.keys()].sort(compare) : groups.keys()) {
    const used = names.map(() => keys.length)
    for (const row of groups.get(key) ?? []) {
      const s = index.get(nameOf(row))
      if (s === undefined) continue
      const slot = used[s]
      used[s] += 1
      if (slot === keys.length) {
        keys.push(key)
        for (const list of values) list.push(undefined)
      }
      values[s][slot] = toNumber(value.at(row))
    }
  }
  return { keys, series: names.map((name, s) => ({ label: name || 'null', values: values[s] })) }
}
