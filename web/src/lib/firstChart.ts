//! The chart of an answer that says something: curves of lists, bars of numbers over names, points of two quantities, a line
//! over time, each with a series for every value of another column if that makes its rows distinct.
import { cellText, type Answer } from './answer'
import { distinctNames, MOST_SERIES } from './series'

export const CHART_FORMS = {
  none: 'None',
  curves: 'Curves',
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
  /** The column whose values are series; ''. */
  readonly series: string
}

/** More bars than that are no picture. */
export const MOST_BARS = 60
/** Numbers that name something: nothing is drawn over them unless somebody asks. */
export const IDENTIFIER = /(^|_)(id|ns|offset|version)$|^(microphone|speaker|side|layer|gridx|gridy|d4_.*)$/
/** A look into a table, as the page's own previews. */
const PREVIEW = /^select \* from \S+ limit \d+$/i

export const isPreview = (query: string) => PREVIEW.test(query.trim())

type Column = Answer['columns'][number]

const isQuantity = (column: Column) => column.numeric && column.type !== 'time' && !IDENTIFIER.test(column.name)
/** What can be a series by itself. */
const isName = (column: Column) => column.type === 'text' || column.type === 'boolean'

/** Whether no two rows have the same values in these columns. */
function areDistinct(columns: readonly Column[], rows: number): boolean {
  const seen = new Set<string>()
  for (let i = 0; i < rows; i += 1) seen.add(JSON.stringify(columns.map((column) => cellText(column.at(i)))))
  return seen.size === rows
}

/** Chooses a chart; none if the rows are no picture of anything. */
export function chooseChart(answer: Answer, query: string): ChartChoice {
  const { columns, rows } = answer
  const quantities = columns.filter(isQuantity)
  const y = quantities[0]?.name ?? columns.find((column) => column.numeric)?.name ?? ''
  const none: ChartChoice = { form: 'none', x: '', y, series: '' }
  const list = columns.find((column) => column.isCurve)
  if (list && rows > 0) return { ...none, form: 'curves', y: list.name }
  if (rows < 2 || quantities.length === 0 || isPreview(query)) return none
  const names = columns.filter(isName)
  const single = names.find((column) => column.type === 'text' && areDistinct([column], rows))
  if (single) return rows <= MOST_BARS ? { ...none, form: 'bars', x: single.name } : none
  const series = names.filter((column) => (distinctNames(column, rows, MOST_SERIES)?.length ?? 0) > 1)
  const pairs = series.flatMap((one) =>
    names
      .filter((other) => other !== one && distinctNames(other, rows, MOST_BARS) && areDistinct([one, other], rows))
      .map((other) => ({ one: one.name, other: other.name })),
  )
  const pair = pairs.find(({ other }) => other === 'band') ?? pairs.at(-1)
  if (pair) return { ...none, form: 'bars', x: pair.other, series: pair.one }
  const time = columns.find((column) => column.type === 'time' && column.numeric)
  const ofTime = time && series.find((one) => areDistinct([time, one], rows))
  if (time && (ofTime || areDistinct([time], rows)))
    return { ...none, form: 'line', x: time.name, series: ofTime?.name ?? '' }
  if (quantities.length < 2) return none
  return { form: 'points', x: quantities[0].name, y: quantities[1].name, series: series[0]?.name ?? '' }
}
