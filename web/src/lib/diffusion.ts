//! How evenly surfaces spread what they reflect, and what that number is not.
import type { DiffusionTable, Lake } from './api'
import { fixed } from './format'

/** Coefficients by surface; undefined of those that have none. */
export const diffusionOf = (table: DiffusionTable | undefined, id: string) =>
  table?.items.find((item) => item.surface_id === id)?.diffusion

/** What the coefficient is, with Flat's own as the reason for the caveat. */
export function diffusionNote(lake: Lake, table: DiffusionTable | undefined, flat: string | null): string {
  const own = flat === null ? undefined : diffusionOf(table, flat)?.[0]
  const ofFlat = typeof own === 'number' ? ` (${flat}: ${fixed(own, 2)} at ${lake.bands[0].label})` : ''
  return `Diffusion: how evenly the pairs of a point share the reflected energy, a mean over the points; 1 if all are alike. It has the form of ISO 17497-2, but the grid is in the near field, where a plane is even, too${ofFlat}: compare designs that were measured alike, and no coefficient of the far field.`
}
