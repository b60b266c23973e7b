//! NCE curves as a stack.
import type { CurveSet, Lake, Schemas } from './api'
import type { PlotSpec } from './plot'

/** Colours of bands in the styles; more bands begin anew. */
const BAND_COLOURS = 12

/** Bands stacked upon each other, lowest first; the top is the whole energy. Flat's whole is a dashed line. */
export function stacked(lake: Lake, set: CurveSet, which: 'surface' | 'flat' = 'surface', high?: number): PlotSpec {
  const bands = lake.bands.filter((band) => band.centre_hz !== null)
  const own = set[which]
  const sums: number[][] = []
  own.bands.forEach((values, b) => sums.push(values.map((value, i) => value + (sums[b - 1]?.[i] ?? 0))))
  const flat = total(set.flat)
  return {
    x: { label: 'Time', unit: 'ms', values: set.time_ms },
    y: { label: 'NCE over Flat’s total', unit: 'ratio', low: 0, ...(high === undefined ? {} : { high }) },
    lines: [
      ...bands.map((band, b) => ({
        label: band.label,
        values: sums[b] ?? [],
        colour: `--band-${b % BAND_COLOURS}`,
        width: 0.5,
        fillTo: b === 0 ? ('zero' as const) : b - 1,
        parts: own.bands[b] ?? [],
      })),
      ...(which === 'surface'
        ? [{ label: 'Flat, total', values: flat, colour: '--ink', width: 1.6, dash: [5, 4] }]
        : []),
    ],
  }
}

/** The sum over the bands. */
export const total = (curves: Schemas['Curves']): number[] =>
  curves.bands[0]?.map((_, i) => curves.bands.reduce((sum, band) => sum + band[i], 0)) ?? []
