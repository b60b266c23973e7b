//! Plots of responses: over time in three forms, level, phase and group delay over frequency. The server computes them.
import type { Lake, Schemas } from './api'
import type { PlotSpec } from './plot'

/** A response as one line of each plot. */
export interface ResponseTrace {
  readonly label: string
  readonly samples: readonly number[]
  readonly analysis: Schemas['ResponseAnalysis']
  /** Highest level of the envelope at the direct sound of the same measurement. */
  readonly direct_db: number
  readonly colour: string
  readonly width: number
  readonly dash?: readonly number[]
}

export const TIME_FORMS = {
  linear: 'Linear',
  decibels: 'Decibels',
  etc: 'Energy-time curve',
  decay: 'Energy decay',
} as const
export type TimeForm = keyof typeof TIME_FORMS
export const LEVEL_REFERENCES = { direct: 'direct sound', maximum: 'maximum' } as const
export type LevelReference = keyof typeof LEVEL_REFERENCES

/** Phase and group delay have no values so far below a trace's highest level. */
export const PHASE_FLOOR_DB = -30
/** What a plot of levels shows below its highest. */
const LEVELS_SHOWN_DB = 70
/** Part of a response that is shown before a late arrival. */
const SHOWN_BEFORE = 0.02

const highest = (values: readonly number[]) => values.reduce((most, value) => Math.max(most, value), -Infinity)
const lineOf = ({ label, colour, width, dash }: ResponseTrace) => ({ label, colour, width, ...(dash ? { dash } : {}) })

/** The responses over time. */
export function timePlot(
  traces: readonly ResponseTrace[],
  rate_hz: number,
  form: TimeForm,
  reference: LevelReference,
  arrival: { readonly arrival_s: number; readonly direct_s: number },
): PlotSpec {
  const longest = Math.max(...traces.map((trace) => trace.samples.length))
  const values = Array.from({ length: longest }, (_, i) => (1000 * i) / rate_hz)
  // What is before a late arrival is the delay of an audio interface.
  const low = 1000 * (arrival.arrival_s - SHOWN_BEFORE * (longest / rate_hz))
  const isLate = arrival.arrival_s > arrival.direct_s && low > 0
  const x = { label: 'Time', unit: 'ms', values, ...(isLate ? { low } : {}) }
  if (form === 'linear')
    return {
      x,
      y: { label: 'Response', unit: 'ratio' },
      lines: traces.map((trace) => ({ ...lineOf(trace), values: trace.samples })),
    }
  if (form === 'decay')
    return {
      x,
      y: { label: 'Energy left', unit: 'dB', low: -LEVELS_SHOWN_DB, high: 0 },
      lines: traces.map((trace) => ({ ...lineOf(trace), values: trace.analysis.decay_db })),
    }
  const lines = traces.map((trace) => {
    const { envelope_db, sample_db } = trace.analysis
    const zero_db = reference === 'direct' ? trace.direct_db : highest(envelope_db)
    return { ...lineOf(trace), values: (form === 'etc' ? envelope_db : sample_db).map((level) => level - zero_db) }
  })
  const top = Math.ceil(highest(lines.flatMap((line) => line.values)) / 10) * 10
  return {
    x,
    y: {
      label: `${form === 'etc' ? 'Energy-time curve' : 'Level'} re ${reference === 'direct' ? 'direct sound' : 'its maximum'}`,
      unit: 'dB',
      low: top - LEVELS_SHOWN_DB,
      high: top,
    },
    lines,
  }
}

const frequencyAxis = (lake: Lake, frequency_hz: readonly number[]) => ({
  label: 'Frequency',
  unit: 'kHz',
  values: frequency_hz.map((frequency) => frequency / 1000),
  low: lake.low_hz / 1000,
  high: lake.high_hz / 1000,
  log: true,
})

/** Levels over frequency: tens of dB around them, 30 at least, and 60 at most below the highest. */
export function levelPlot(lake: Lake, traces: readonly ResponseTrace[], frequency_hz: readonly number[]): PlotSpec {
  const levels = traces.flatMap((trace) => trace.analysis.level_db)
  const high = Math.ceil(highest(levels) / 10) * 10
  const low = Math.floor(levels.reduce((a, b) => Math.min(a, b), high) / 10) * 10
  return {
    x: frequencyAxis(lake, frequency_hz),
    y: { label: 'Level re 1', unit: 'dB', low: Math.max(high - 60, Math.min(low, high - 30)), high },
    lines: traces.map((trace) => ({ ...lineOf(trace), values: trace.analysis.level_db })),
  }
}

/** Phase, or group delay, over frequency, with gaps where a trace's level is too low to say. */
export function phasePlot(
  lake: Lake,
  traces: readonly ResponseTrace[],
  frequency_hz: readonly number[],
  what: 'phase' | 'groupDelay',
  isSmoothed: boolean,
): PlotSpec {
  const lines = traces.map((trace) => {
    const { level_db, phase_deg, group_delay_ms } = trace.analysis
    const floor = highest(level_db) + PHASE_FLOOR_DB
    const values = what === 'phase' ? phase_deg : group_delay_ms
    return { ...lineOf(trace), values: values.map((value, i) => (level_db[i] < floor ? null : value)) }
  })
  const delays = () => lines.flatMap((line) => line.values).filter((value) => value !== null)
  return {
    x: frequencyAxis(lake, frequency_hz),
    y:
      what === 'phase'
        ? { label: 'Phase, unwrapped', unit: '°' }
        : { label: 'Group delay', unit: 'ms', ...middleRange(delays(), isSmoothed ? 0 : NOTCH_SHARE) },
    lines,
  }
}

/** Share of the group delays at either end that a plot leaves out: at notches they are of any size. */
const NOTCH_SHARE = 0.02

/** The range of values without a share at either end. */
function middleRange(values: readonly number[], share: number): { low: number; high: number } | undefined {
  const sorted = Float64Array.from(values).sort()
  if (sorted.length === 0) return undefined
  const [low, high] = [sorted[Math.floor(share * sorted.length)], sorted[Math.ceil((1 - share) * sorted.length) - 1]]
  const air = Math.max(0.1, 0.15 * (high - low))
  return { low: low - air, high: high + air }
}
