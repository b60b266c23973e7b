//! Addresses of the answers that a page asks for first. They follow from the page's own address alone, so that they can be
//! asked for while its code is still on its way.
import { apiHref } from './api'
import { changeSearch } from './search'

/** Surfaces of the wall that are shown at first. */
export const WALL_PAGE = 60
/** Names of filters by text, each of which may be repeated. */
export const WALL_FILTERS = [
  'typology',
  'macrostructure',
  'mesostructure',
  'material',
  'flat_reference',
  'origin',
] as const
/** Points of a curve. */
const CURVE_POINTS = 192
const MOST = 500

export const allSurfacesHref = apiHref('/surfaces', { limit: MOST })
export const diffusionHref = apiHref('/diffusion')
export const mapHref = apiHref('/map', { neighbours: 6 })

const copied = (params: URLSearchParams, names: readonly string[]) =>
  Object.fromEntries(names.map((name) => [name, params.get(name)]))

export function wallHref(params: URLSearchParams): string {
  const repeated = [...WALL_FILTERS, 'level'].map((name) => [name, params.getAll(name)] as const)
  const limit = Math.min(MOST, Number(params.get('show') ?? WALL_PAGE))
  const single = copied(params, ['q', 'started', 'relief', 'sort', 'order', 'sort_band'])
  return changeSearch('/api/v1/surfaces', '', { ...single, ...Object.fromEntries(repeated), limit })
}

export function runsHref(params: URLSearchParams): string {
  const limit = Math.min(MOST, Number(params.get('show') ?? 100))
  return changeSearch('/api/v1/runs', '', { ...copied(params, ['q', 'sort', 'order']), limit })
}

export const surfacePath = (id: string) => `/surfaces/${encodeURIComponent(id)}`
export const detailHref = (id: string) => apiHref(surfacePath(id))
/** Mean curves over all pairs, or those of a microphone point. */
export const curvesHref = (id: string, microphone: number | null = null) =>
  apiHref(`${surfacePath(id)}/curves`, { points: CURVE_POINTS, microphone })

export const nearestSurfacesHref = (id: string) => apiHref(`${surfacePath(id)}/neighbours`)
export const measuredPairsHref = (id: string) => apiHref(`${surfacePath(id)}/pairs`)
export const pairPath = (id: string, pair: number | string) => `${surfacePath(id)}/pairs/${pair}`
export const pairDetailHref = (id: string, pair: number | string) => apiHref(pairPath(id, pair))
export const nearestResponsesHref = (id: string, pair: number | string) => apiHref(`${pairPath(id, pair)}/neighbours`)
