//! Lists of an answer as curves.
import { cellText, type Answer } from './answer'
import type { Lake } from './api'
import { seriesColour } from './barChart'
import { IDENTIFIER } from './firstChart'
import type { PlotSpec } from './plot'
import { toNumber } from './series'

type Column = Answer['columns'][number]

/** Whether a column has responses, by the lake's names: samples of pressure, which can be heard. */
export const isResponse = (column: Column) => /(^|_)ir$/.test(column.name)
/** Whether its lists have a value for each sample of a response. */
const isOverTime = (column: Column) => isResponse(column) || /(^|_)nce(_|$)/.test(column.name)

/** A list's numbers. */
export const numbersOf = (column: Column, row: number) =>
  Array.from((column.at(row) ?? []) as ArrayLike<unknown>, toNumber)

/** What a row is of: its texts and numbers that name something. */
export function rowName(answer: Answer, row: number): string {
  const names = answer.columns.filter(
    (column) => !column.isCurve && (column.type === 'text' || (column.numeric && IDENTIFIER.test(column.name))),
  )
  const isTold = names.filter((column) => !/^(run_id|.*_version|.*_ns|microphone|speaker)$/.test(column.name))
  return isTold.length
    ? isTold
        .slice(0, 3)
        .map((column) => cellText(column.at(row)))
        .join(' ')
    : `row ${row + 1}`
}

/** The lists of some rows over their index, or over time. */
export function curvesOf(lake: Lake, answer: Answer, column: Column, rows: readonly number[]): PlotSpec {
  const lists = rows.map((row) => numbersOf(column, row))
  const longest = Math.max(0, ...lists.map((list) => list.length))
  const isTimed = isOverTime(column)
  return {
    x: {
      label: isTimed ? 'Time' : 'index',
      unit: isTimed ? 'ms' : '',
      values: Array.from({ length: longest }, (_, i) => (isTimed ? (1000 * i) / lake.rate_hz : i)),
    },
    y: { label: column.name, unit: column.unit },
    lines: lists.map((values, i) => ({
      label: rowName(answer, rows[i]),
      values: [...values, ...new Array<undefined>(longest - values.length)],
      colour: lists.length > 1 ? seriesColour(i) : '--accent',
    })),
  }
}
