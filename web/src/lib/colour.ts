//! Colours that carry numbers.
export type Rgb = readonly [number, number, number]

/** The paper's scale: white at -20 dB, black at 0 dB (equal to Flat), red at +6 dB. */
export const SCALE_DB = { low: -20, zero: 0, high: 6 } as const

/** How many dB the small bars reach up and down. */
export const BAR_REACH_DB = 4

/** A level's colour on the paper's scale; beyond the ends it stays at the ends. */
export function paperColour(level_db: number): Rgb {
  const { low, zero, high } = SCALE_DB
  if (level_db > zero) return [Math.round(255 * Math.min(1, level_db / high)), 0, 0]
  const grey = Math.round(255 * Math.min(1, (zero - level_db) / (zero - low)))
  return [grey, grey, grey]
}

/** A value's colour: grey at 0, blue and orange at both ends, `reach`, and beyond. */
export function divergingColour(value: number, reach: number): Rgb {
  const share = Math.max(-1, Math.min(1, value / reach))
  const end: Rgb = share < 0 ? [33, 102, 172] : [217, 95, 2]
  const mid = 236
  return end.map((c) => Math.round(mid + (c - mid) * Math.abs(share))) as unknown as Rgb
}

/** Ends of scales, dB. */
const REACHES_DB = [1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 40]
/** Share of the values that a scale holds; the others have the colours of its ends. */
const WITHIN = 0.98

/** The smallest round range around 0 dB that holds nearly all levels. */
export function fittingReach(levels_db: readonly number[]): number {
  const sizes = levels_db.map(Math.abs).sort((a, b) => a - b)
  const most = sizes[Math.ceil(WITHIN * sizes.length) - 1] ?? 0
  return REACHES_DB.find((reach) => reach >= most) ?? REACHES_DB[REACHES_DB.length - 1]
}

export const css = ([r, g, b]: Rgb) => `rgb(${r}, ${g}, ${b})`

/** Black or white, whichever is read better on a colour. */
export const inkOn = ([r, g, b]: Rgb): string =>
  0.2126 * (r / 255) ** 2.2 + 0.7152 * (g / 255) ** 2.2 + 0.0722 * (b / 255) ** 2.2 > 0.18 ? '#000' : '#fff'

/** The value of a custom property, for canvases. */
export const token = (name: string) => getComputedStyle(document.documentElement).getPropertyValue(name).trim()

/** Viridis by five stops, for spectrograms: readable without telling red from green, and in grey. */
const VIRIDIS: readonly Rgb[] = [
  [68, 1, 84],
  [59, 82, 139],
  [33, 145, 140],
  [94, 201, 98],
  [253, 231, 37],
]

/** 0..1 to viridis. */
export function viridis(share: number): Rgb {
  const at = Math.max(0, Math.min(1, share)) * (VIRIDIS.length - 1)
  const i = Math.min(VIRIDIS.length - 2, Math.floor(at))
  return VIRIDIS[i].map((c, k) => Math.round(c + (VIRIDIS[i + 1][k] - c) * (at - i))) as unknown as Rgb
}
