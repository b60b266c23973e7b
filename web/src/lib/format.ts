//! Numbers and names as people read them.

import type { Lake } from './api'

const MINUS = '\u2212'

/** A number with fixed decimals and a true minus; a dash where there is none. */
export function fixed(value: number | null | undefined, digits = 1): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return '\u2013'
  const text = Math.abs(value).toFixed(digits)
  return value < 0 && Number(text) !== 0 ? MINUS + text : text
}

/** The same with a plus before what is over zero. */
export function signed(value: number | null | undefined, digits = 1): string {
  const text = fixed(value, digits)
  return typeof value === 'number' && value > 0 && Number(value.toFixed(digits)) > 0 ? `+${text}` : text
}

/** A standard uncertainty behind its value, dB. One that rounds to nothing is under the last decimal, and not nothing; a
band without energy has one beyond all bounds. */
export const plusMinus = (u: number | null | undefined) =>
  u === null || u === undefined ? '' : ` ± ${u < 0.005 ? '<0.01' : u > 99 ? '>99' : u.toFixed(2)}`

/** A number with as many digits as it needs, up to some; every minus is a true one, also an exponent's. */
export const plain = (value: number | bigint, digits = 7) =>
  (typeof value === 'bigint' || Number.isInteger(value)
    ? String(value)
    : String(Number(value.toPrecision(digits)))
  ).replaceAll('-', MINUS)

/** A whole number in groups of three digits. `toLocaleString` loads the browser's tables of languages first. */
export const count = (value: number) => String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, '\u202f')

/** A number's text with its thousands apart, from five digits before the point. */
export const grouped = (text: string) =>
  text.replace(
    /^(\D?)(\d{5,})/,
    (_, sign: string, digits: string) => sign + digits.replace(/\B(?=(\d{3})+$)/g, '\u202f'),
  )

/** A number of things with their name: `1 surface`, `6 surfaces`. */
export const counted = (value: number, name: string) => `${count(value)} ${name}${value === 1 ? '' : 's'}`

/** `stretcher_bond_bricks` as words. */
export const words = (name: string | null | undefined) => (name ? name.replaceAll('_', ' ') : '\u2013')

export function bytes(value: number | null): string {
  if (value === null) return '\u2013'
  const units = ['B', 'kB', 'MB', 'GB', 'TB']
  let power = 0
  while (value >= 1000 && power < units.length - 1) {
    value /= 1000
    power += 1
  }
  return `${value.toFixed(power === 0 || value >= 100 ? 0 : 1)} ${units[power]}`
}

/** A time as `2026-01-07 04:00` UTC. */
export const moment = (iso: string | null) => (iso ? `${iso.slice(0, 10)} ${iso.slice(11, 16)}` : '\u2013')
export const second = (iso: string) => iso.slice(11, 19)

export function duration(from: string, to: string): string {
  const minutes = Math.round((Date.parse(to) - Date.parse(from)) / 60000)
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, '0')} min`
}

/** A run's state. One that waits for references has its responses, and no levels. */
export const stateText = (run: { readonly state: string; readonly missing: string | null }) =>
  run.state === 'waiting'
    ? `waiting for ${run.missing ?? 'references'}, for levels`
    : run.state + (run.missing ? `, missing ${run.missing}` : '')

/** A parameter's name and unit from `joint_depth_mm`. */
export function parameter(name: string): { label: string; unit: string } {
  const found = /^(.*)_(mm|deg|c|pct|hpa|hz)$/.exec(name)
  const units: Record<string, string> = { deg: '°', c: '°C', pct: '%', hpa: 'hPa', hz: 'Hz' }
  return found
    ? { label: found[1].replaceAll('_', ' '), unit: units[found[2]] ?? found[2] }
    : { label: name.replaceAll('_', ' '), unit: '' }
}

/** A grid point as the paper names it: layer, then column and row. */
export const pointName = (p: { layer: number; gridx: number; gridy: number }) => `${p.layer}/${p.gridx}/${p.gridy}`

const hertz = (hz: number) =>
  hz >= 1000 ? `${Number((hz / 1000).toPrecision(3))} kHz` : `${Number(hz.toPrecision(3))} Hz`
const isModel = (lake: Lake) => lake.scale != null && lake.scale !== 1

/** A band's name, with its frequency at full scale where the lake is one of models: `2.5 kHz (250 Hz)`. */
export const bandName = (lake: Lake, band: { readonly label: string; readonly centre_hz?: number | null }) =>
  isModel(lake) && band.centre_hz != null ? `${band.label} (${hertz(band.centre_hz / (lake.scale ?? 1))})` : band.label

/** Lengths of a model at full scale, in cm, to stand behind those in mm; nothing where both are one. */
export const atFullScale = (lake: Lake, ...mm: readonly (number | null | undefined)[]) =>
  isModel(lake) && mm.every((one) => one != null)
    ? ` (${mm.map((one) => fixed(((one ?? 0) * (lake.scale ?? 1)) / 10, 1)).join(' to ')} cm at 1:1)`
    : ''
