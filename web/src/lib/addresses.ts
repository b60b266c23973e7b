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
  return changeSearch(apiHref('/surfaces'), '', { ...single, ...Object.fromEntries(repeated), limit })
}

export function runsHref(params: URLSearchParams): string {
  const limit = Math.min(MOST, Number(params.get('show') ?? 100))
  return changeSearch(apiHref('/runs'), '', { ...copied(params, ['q', 'sort', 'order']), limit })
}

export const surfacePath = (id: string) => `/surfaces/${encodeURIComponent(id)}`
export const detailHref = (id: string) => apiHref(surfacePath(id))
/** Mean curves over all pairs, or those of a microphone point. */
export const curvesHref = (id: string, microphone: number | null = null) =>
  apiHref(`${surfacePath(id)}/curves`, { points: CURVE_POINTS, microphone })

export const materialsHref = (id: string) => apiHref(`${surfacePath(id)}/materials`)
export const nearestSurfacesHref = (id: string) => apiHref(`${surfacePath(id)}/neighbours`)
export const measuredPairsHref = (id: string) => apiHref(`${surfacePath(id)}/pairs`)
export const pairPath = (id: string, pair: number | string) => `${surfacePath(id)}/pairs/${pair}`
export const pairDetailHref = (id: string, pair: number | string) => apiHref(pairPath(id, pair))
export const pairPredictionsHref = (id: string, pair: number | string) => apiHref(`${pairPath(id, pair)}/predictions`)
export const surfacePredictionsHref = (id: string) => apiHref(`${surfacePath(id)}/predictions`)
/** Annotations on a run, or on one of its measurements. */
export const annotationsHref = (run: string, pair?: number) =>
  apiHref(`/runs/${encodeURIComponent(run)}/annotations`, { pair })
export const nearestResponsesHref = (id: string, pair: number | string) => apiHref(`${pairPath(id, pair)}/neighbours`)
/** Fractions of an octave that levels and group delays are smoothed over. */
export const SMOOTHINGS = ['12', '6', '3', '1'] as const
/** What phase and group delay are less. */
export const DELAYS = { direct: 'direct sound', reflected: 'reflected path', none: 'nothing' } as const
export const smoothingOf = (params: URLSearchParams) => SMOOTHINGS.find((one) => one === params.get('octave')) ?? null
export const delayOf = (params: URLSearchParams) =>
  (Object.keys(DELAYS) as (keyof typeof DELAYS)[]).find((one) => one === params.get('delay')) ?? 'direct'
/** A pair's analysis as the page's parameters ask for it. */
export const analysisHref = (id: string, pair: number | string, params: URLSearchParams) =>
  apiHref(`${pairPath(id, pair)}/analysis`, { octave: smoothingOf(params), delay: delayOf(params) })
export const spectrogramHref = (id: string, pair: number | string, signal: string) =>
  apiHref(`${pairPath(id, pair)}/spectrogram`, { signal })

export const runPath = (id: string) => `/runs/${encodeURIComponent(id)}`
export const runDetailHref = (id: string) => apiHref(runPath(id))
export const environmentHref = (id: string) => apiHref(`${runPath(id)}/environment`, { points: 300 })

/** The surfaces that Compare shows. */
export const MOST_COMPARED = 8
export const comparedSurfaces = (params: URLSearchParams): string[] =>
  [...new Set((params.get('s') ?? '').split(',').filter(Boolean))].slice(0, MOST_COMPARED)
