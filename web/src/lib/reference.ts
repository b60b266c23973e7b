//! The two parts of Flat that levels are over. "Against Flat" is over the same band, on every page; the other one is always
//! named in full.
import type { Surface, SurfaceDetail } from './api'
import { place } from './router.svelte'

export type LevelReference = 'flat-band' | 'flat-total'

export const REFERENCES: readonly { key: LevelReference; label: string; unit: string }[] = [
  { key: 'flat-band', label: 'Against Flat, same band', unit: 'dB re Flat, same band' },
  { key: 'flat-total', label: 're Flat total', unit: 'dB re Flat total' },
]

/** The one that the address names. */
export const chosenReference = (): LevelReference =>
  place.params.get('over') === 'flat-total' ? 'flat-total' : 'flat-band'

export const unitOf = (over: LevelReference) => REFERENCES.find(({ key }) => key === over)!.unit

/** A level less another; null if one is not known. */
export const difference = (level: number | null | undefined, less: number | null | undefined) =>
  level === null || level === undefined || less === null || less === undefined ? null : level - less

/** The level of the mean over all pairs, which a few loud pairs raise. */
export function plainMeanLevel(over: LevelReference, d: SurfaceDetail, band: number): number | null {
  const [own, flat] = [d.mean[band], over === 'flat-total' ? 1 : d.flat_mean[band]]
  return own && flat ? 10 * Math.log10(own / flat) : null
}

/** Flat over itself is 0 dB by definition: pages write `reference` in place of a number that looks measured. */
export const isItsReference = (surface: Surface) => surface.surface_id === surface.flat_reference

/** The standard uncertainty of a surface's level in a band. It holds Flat's share; Flat over itself has none. */
export const uncertaintyOf = (surface: Surface, band: number) =>
  isItsReference(surface) ? null : surface.level_u_db[band]

/** The class of a difference that is over or under nothing. */
export const tone = (value: number | null) =>
  value === null || Math.abs(value) < 0.05 ? undefined : value > 0 ? 'over' : 'under'

/** The level of a surface that all pages show. */
export const shownLevel = (over: LevelReference, surface: Surface, band: number) =>
  over === 'flat-total' ? surface.level_db[band] : surface.against_flat_db[band]
