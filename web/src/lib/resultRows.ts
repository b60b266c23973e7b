//! Which rows of an answer a table shows, in which order, and how it writes their numbers.
import { cellText, type Answer } from './answer'
import { IDENTIFIER } from './firstChart'
import { fixed, grouped, plain } from './format'
import { compareNames } from './series'

type Column = Answer['columns'][number]

const COMPARISON = /^\s*(>=|<=|<>|!=|>|<|=)\s*(-?[\d.]+(?:e-?\d+)?)\s*$/i
const RANGE = /^\s*(-?[\d.]+)\s*\.\.\s*(-?[\d.]+)\s*$/
const COMPARED: Record<string, (value: number, limit: number) => boolean> = {
  '>': (value, limit) => value > limit,
  '<': (value, limit) => value < limit,
  '>=': (value, limit) => value >= limit,
  '<=': (value, limit) => value <= limit,
  '=': (value, limit) => value === limit,
  '<>': (value, limit) => value !== limit,
  '!=': (value, limit) => value !== limit,
}

/** Whether a value passes what was typed above its column: `> 3`, `2..5`, or a part of the text. */
function filterOf(column: Column, typed: string): (row: number) => boolean {
  const [, operator, limit] = COMPARISON.exec(typed) ?? []
  const [, low, high] = RANGE.exec(typed) ?? []
  if (column.type !== 'time' && column.numeric && (operator || low)) {
    return (row) => {
      const value = column.at(row)
      if (value === null || value === undefined) return false
      const number = Number(value)
      return operator ? COMPARED[operator](number, Number(limit)) : number >= Number(low) && number <= Number(high)
    }
  }
  const part = typed.trim().toLowerCase()
  return (row) =>
    cellText(column.at(row)).replaceAll('\u2212', '-').toLowerCase().includes(part.replaceAll('\u2212', '-'))
}

export interface RowOrder {
  readonly column: string
  readonly isDescending: boolean
}

/** A column's order as an address has it: its name, after a minus if it descends. */
export const parseOrder = (text: string | null): RowOrder | undefined =>
  text ? { column: text.replace(/^-/, ''), isDescending: text.startsWith('-') } : undefined

/** The indices of the rows that pass all filters, in order; without a value is last. */
export function chooseRows(answer: Answer, filters: Readonly<Record<string, string>>, order?: RowOrder): Uint32Array {
  let rows = Uint32Array.from({ length: answer.rows }, (_, row) => row)
  for (const column of answer.columns) {
    if (filters[column.name]?.trim()) rows = rows.filter(filterOf(column, filters[column.name]))
  }
  const column = answer.columns.find((one) => one.name === order?.column)
  if (!column) return rows
  const isText = !column.numeric && column.type !== 'boolean'
  const values = Array.from({ length: answer.rows }, (_, row) => {
    const value = column.at(row)
    return value === null || value === undefined ? null : isText ? cellText(value) : (value as number)
  })
  const sign = order?.isDescending ? -1 : 1
  return rows.sort((a, b) => {
    const [x, y] = [values[a], values[b]]
    if (x === null || y === null) return Number(x === null) - Number(y === null) || a - b
    const by = isText ? compareNames(x as string, y as string) : x < y ? -1 : Number(x > y)
    return sign * by || a - b
  })
}

/** Digits that the largest number of a column has; the others have as many decimals. */
const DIGITS = 4
const MOST_DECIMALS = 6

/** Writes the numbers of a column alike: as many decimals each, thousands apart; names that are numbers as they are. */
export function numberFormat(column: Column, rows: Uint32Array): (value: unknown) => string {
  if (!column.numeric || column.type === 'time' || IDENTIFIER.test(column.name)) return cellText
  let largest = 0
  let isWhole = true
  for (const row of rows) {
    const value = column.at(row)
    if (typeof value !== 'number' || !Number.isFinite(value)) continue
    largest = Math.max(largest, Math.abs(value))
    isWhole &&= Number.isInteger(value)
  }
  const decimals = isWhole ? 0 : Math.max(1, DIGITS - 1 - Math.floor(Math.log10(largest)))
  return (value) => {
    if (typeof value === 'bigint') return grouped(plain(value))
    if (typeof value !== 'number' || !Number.isFinite(value)) return cellText(value)
    if (isWhole) return grouped(plain(value))
    // What is no more than rounding in dB is 0; other small numbers keep their digits.
    const isLost = value !== 0 && Math.abs(value) < 0.5 * 10 ** -decimals && !column.unit.startsWith('dB')
    return decimals > MOST_DECIMALS || isLost ? plain(value, DIGITS) : grouped(fixed(value, decimals))
  }
}
