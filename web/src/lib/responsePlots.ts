//! Plots of responses: over time in three forms, level, phase and group delay over frequency.
import type { PlotSpec } from './plot'
import {
  envelope,
  frequencyResponse,
  levels_db,
  type AnalysisSettings,
  type FrequencyResponse,
} from './responseAnalysis'

/** A response as one line of each plot. */
export interface ResponseTrace {
  readonly label: string
  readonly samples: readonly number[]
  /** Delay that is taken off its phase and group delay. */
  readonly removed_s: number
  /** Highest value of the envelope at the direct sound of the same measurement. */
  readonly direct: () => number
  readonly colour: string
  readonly width: number
  readonly dash?: readonly number[]
}

export const TIME_FORMS = { linear: 'Linear', decibels: 'Decibels', etc: 'Energy-time curve' } as const
export type TimeForm = keyof typeof TIME_FORMS
export const LEVEL_REFERENCES = { direct: 'direct sound', maximum: 'maximum' } as const
export type LevelReference = keyof typeof LEVEL_REFERENCES
/** Fractions of an octave that levels and group delays are smoothed over. */
export const SMOOTHINGS = [12, 6, 3, 1] as const

/** Phase and group delay have no values so far below a trace's highest level. */
export const PHASE_FLOOR_DB = -30
/** What a plot of levels shows below its highest. */
const LEVELS_SHOWN_DB = 70

const highest = (values: Iterable<number | null>) => {
  let most = -Infinity
  for (const value of values) if (value !== null && value > most) most = value
  return most
}
const lineOf = ({ label, colour, width, dash }: ResponseTrace) => ({ label, colour, width, ...(dash ? { dash } : {}) })

/** The responses over time. */
export function timePlot(
  traces: readonly ResponseTrace[],
  rate_hz: number,
  form: TimeForm,
  reference: LevelReference,
): PlotSpec {
  const longest = Math.max(...traces.map((trace) => trace.samples.length))
  const x = { label: 'Time', unit: 'ms', values: Array.from({ length: longest }, (_, i) => (1000 * i) / rate_hz) }
  if (form === 'linear')
    return {
      x,
      y: { label: 'Response', unit: 'ratio' },
      lines: traces.map((trace) => ({ ...lineOf(trace), values: trace.samples })),
    }
  const lines = traces.map((trace) => {
    const magnitudes = envelope(trace.samples)
    const zero = reference === 'direct' ? trace.direct() : highest(magnitudes)
    return { ...lineOf(trace), values: levels_db(form === 'etc' ? magnitudes : trace.samples, zero) }
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

/** A trace and what it is over frequency. */
export interface AnalysedTrace {
  readonly trace: ResponseTrace
  readonly response: FrequencyResponse
}
/** The frequencies that are shown, and the smoothing. */
export type FrequencyRange = Pick<AnalysisSettings, 'low_hz' | 'high_hz' | 'octaves'>

/** Analyses traces between two frequencies. */
export const analyseTraces = (
  traces: readonly ResponseTrace[],
  rate_hz: number,
  range: FrequencyRange,
): AnalysedTrace[] =>
  traces.map((trace) => ({
    trace,
    response: frequencyResponse(trace.samples, rate_hz, { ...range, removed_s: trace.removed_s }),
  }))

const frequencyAxis = (analysed: readonly AnalysedTrace[], { low_hz, high_hz }: FrequencyRange) => ({
  label: 'Frequency',
  unit: 'kHz',
  values: analysed[0].response.frequency_hz.map((frequency) => frequency / 1000),
  low: low_hz / 1000,
  high: high_hz / 1000,
  log: true,
})

/** Levels over frequency: tens of dB around them, 30 at least, and 60 at most below the highest. */
export function levelPlot(analysed: readonly AnalysedTrace[], range: FrequencyRange): PlotSpec {
  const levels = analysed.flatMap(({ response }) => response.level_db)
  const high = Math.ceil(highest(levels) / 10) * 10
  const low = Math.floor(levels.reduce((a, b) => Math.min(a, b), high) / 10) * 10
  return {
    x: frequencyAxis(analysed, range),
    y: { label: 'Level re 1', unit: 'dB', low: Math.max(high - 60, Math.min(low, high - 30)), high },
    lines: analysed.map(({ trace, response }) => ({ ...lineOf(trace), values: response.level_db })),
  }
}

/** Phase, or group delay, over frequency, with gaps where a trace's level is too low to say. */
export function phasePlot(
  analysed: readonly AnalysedTrace[],
  range: FrequencyRange,
  what: 'phase' | 'groupDelay',
): PlotSpec {
  const lines = analysed.map(({ trace, response }) => {
    const floor = highest(response.level_db) + PHASE_FLOOR_DB
    const values = what === 'phase' ? response.phase_deg() : response.groupDelay_s().map((seconds) => 1000 * seconds)
    return { ...lineOf(trace), values: values.map((value, i) => (response.level_db[i] < floor ? null : value)) }
  })
  return {
    x: frequencyAxis(analysed, range),
    y:
      what === 'phase'
        ? { label: 'Phase, unwrapped', unit: '°' }
        : {
            label: 'Group delay',
            unit: 'ms',
            ...middleRange(
              lines.flatMap((line) => line.values),
              range.octaves === 0 ? NOTCH_SHARE : 0,
            ),
          },
    lines,
  }
}

/** Share of the group delays at either end that a plot leaves out: at notches they are of any size. */
const NOTCH_SHARE = 0.02

/** The range of values without a share at either end. */
function middleRange(values: readonly (number | null)[], share: number): { low: number; high: number } | undefined {
  const sorted = Float64Array.from(values.filter((value) => value !== null)).sort()
  if (sorted.length === 0) return undefined
  const [low, high] = [sorted[Math.floor(share * sorted.length)], sorted[Math.ceil((1 - share) * sorted.length) - 1]]
  const air = Math.max(0.1, 0.15 * (high - low))
  return { low: low - air, high: high + air }
}
