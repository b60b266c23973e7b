//! The chart of an answer that says something: bars of numbers over names, points of two quantities, a line over time.
import type { Answer } from './answer'

export const CHART_FORMS = {
  none: 'None',
  bars: 'Bars',
  histogram: 'Histogram',
  points: 'Points',
  line: 'Line',
  grid: 'Grid',
} as const
export type ChartForm = keyof typeof CHART_FORMS

export interface ChartChoice {
  readonly form: ChartForm
  /** Columns across and up; '' across: the row's number. */
  readonly x: string
  readonly y: string
}

/** More bars than that are no picture. */
export const MOST_BARS = 60
/** Numbers that name something: nothing is drawn over them unless somebody asks. */
const IDENTIFIER = /(^|_)(id|ns|offset|version)$|^(microphone|speaker|side|d4_.*)$/
/** A look into a table, as the page's own previews. */
const PREVIEW = /^select \* from \S+ limit \d+$/i

export const isPreview = (query: string) => PREVIEW.test(query.trim())

type Column = Answer['columns'][number]

const isQuantity = (column: Column) => column.numeric && column.type !== 'time' && !IDENTIFIER.test(column.name)

function hasDistinctValues(column: Column, rows: number): boolean {
  const seen = new Set<unknown>()
  for (let i = 0; i < rows; i += 1) {
    const value = column.at(i)
    seen.add(value instanceof Date ? value.getTime() : value)
  }
  return seen.size === rows
}

/** Chooses a chart; none if the rows are no picture of anything. */
export function chooseChart(answer: Answer, query: string): ChartChoice {
  const quantities = answer.columns.filter(isQuantity)
  const y = quantities[0]?.name ?? answer.columns.find((column) => column.numeric)?.name ?? ''
  const none: ChartChoice = { form: 'none', x: '', y }
  if (answer.rows < 2 || quantities.length === 0 || isPreview(query)) return none
  const names = answer.columns.find((column) => column.type === 'text')
  if (names && answer.rows <= MOST_BARS && hasDistinctValues(names, answer.rows))
    return { form: 'bars', x: names.name, y }
  const time = answer.columns.find((column) => column.type === 'time' && column.numeric)
  if (time && hasDistinctValues(time, answer.rows)) return { form: 'line', x: time.name, y }
  if (quantities.length >= 2) return { form: 'points', x: quantities[0].name, y: quantities[1].name }
  return none
}
