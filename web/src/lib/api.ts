//! The API's client: types from the contract, one kept answer an address.
import { siteHref } from './base'
import type { components } from './contract'

export type Schemas = components['schemas']
export type Lake = Schemas['Lake']
export type Surface = Schemas['Surface']
export type SurfacePage = Schemas['SurfacePage']
export type SurfaceDetail = Schemas['SurfaceDetail']
export type Grid = Schemas['Grid']
export type CurveSet = Schemas['CurveSet']
export type PairDetail = Schemas['PairDetail']
export type PairAnalysis = Schemas['PairAnalysis']
/** A pair, and what the server reads off its responses. */
export interface PairResponse {
  readonly detail: PairDetail
  readonly analysis: PairAnalysis
}
export type Run = Schemas['Run']
export type RunDetail = Schemas['RunDetail']
export type SurfaceMap = Schemas['SurfaceMap']
export type Correlations = Schemas['Correlations']
export type DiffusionTable = Schemas['DiffusionTable']
export type EnvironmentSeries = Schemas['EnvironmentSeries']
export type Point = Schemas['Point']

/** An answer that says what went wrong. */
export class ApiError extends Error {
  readonly code: string
  readonly hint: string
  readonly status: number
  constructor(status: number, code: string, detail: string, hint: string) {
    super(detail)
    this.status = status
    this.code = code
    this.hint = hint
  }
}

const KEPT = 120
/** Older answers are asked for again, because the lake may have grown; the browser's own cache answers by ETag. */
const FRESH_MS = 30_000
const kept = new Map<string, { readonly since: number; readonly answer: Promise<unknown> }>()

type Param = string | number | null | undefined

/** Builds an address of the API. A list is a parameter several times. */
export function apiHref(path: string, params: Record<string, Param | readonly string[]> = {}): string {
  const search = new URLSearchParams()
  for (const [name, value] of Object.entries(params))
    for (const one of Array.isArray(value) ? (value as readonly string[]) : [value as Param])
      if (one !== null && one !== undefined) search.append(name, String(one))
  const text = search.toString()
  return siteHref(`/api/v1${path}${text ? `?${text}` : ''}`)
}

async function refusal(response: Response): Promise<ApiError> {
  try {
    const problem = (await response.json()) as Schemas['Problem']
    const [detail = '', hint = ''] = (problem.detail ?? problem.title).split(/(?:; |\n)hint: /)
    return new ApiError(problem.status, problem.code, detail, hint)
  } catch {
    return new ApiError(response.status, 'internal', `the server answered ${response.status}`, '')
  }
}

async function ask(href: string, init?: RequestInit): Promise<Response> {
  let response: Response
  try {
    response = await fetch(href, init)
  } catch (error) {
    if (error instanceof DOMException && error.name === 'AbortError') throw error
    throw new ApiError(
      0,
      'lake_unreadable',
      'the server does not answer',
      'See whether echolake serve still runs, then try again.',
    )
  }
  if (!response.ok) throw await refusal(response)
  return response
}

function remember<T>(href: string, make: () => Promise<T>): Promise<T> {
  const found = kept.get(href)
  if (found && performance.now() - found.since < FRESH_MS) return found.answer as Promise<T>
  const answer = make()
  kept.delete(href)
  kept.set(href, { since: performance.now(), answer })
  answer.catch(() => {
    // A later answer of the same address stays.
    if (kept.get(href)?.answer === answer) kept.delete(href)
  })
  if (kept.size > KEPT) kept.delete(kept.keys().next().value as string)
  return answer
}

/** Forgets all answers: the lake has changed by what this page sent. */
export const forgetAnswers = (): void => kept.clear()

/** A JSON answer. */
export const get = <T>(href: string): Promise<T> => remember(href, async () => (await ask(href)).json() as Promise<T>)

/** A figure that the server draws, as SVG. */
export const figure = (href: string): Promise<string> => remember(href, async () => (await ask(href)).text())

/** A surface's heights in mm. */
export const heightmap = (id: string): Promise<Float32Array> =>
  remember(
    `heights ${id}`,
    async () =>
      new Float32Array(await (await ask(apiHref(`/surfaces/${encodeURIComponent(id)}/heightmap`))).arrayBuffer()),
  )

/** Runs a query; closing by `signal` cancels it. */
export const sql = (query: string, accept: string, signal?: AbortSignal): Promise<Response> =>
  ask(apiHref('/sql'), {
    method: 'POST',
    headers: { 'content-type': 'application/json', accept },
    body: JSON.stringify({ query }),
    ...(signal ? { signal } : {}),
  })

/** The server's figures in Prometheus' format, as they are now. */
export const figures = async (): Promise<string> => (await ask(siteHref('/metrics'))).text()

/** Ends a query that runs, by its number in `system.queries`. */
export const cancelQuery = (id: number): Promise<Response> => ask(apiHref(`/queries/${id}/cancel`), { method: 'POST' })

/** Stores an annotation; it is seen by the next request. */
export const annotate = (annotation: Schemas['NewAnnotation'], isConfirmed: boolean): Promise<Response> =>
  ask(apiHref('/annotations'), {
    method: 'POST',
    headers: { 'content-type': 'application/json' },
    body: JSON.stringify({ annotations: [annotation], confirm_rederivation: isConfirmed }),
  })

/** Shows the server a token; it answers with a cookie, which pictures and downloads send too. */
export const login = (token: string): Promise<Response> =>
  ask(apiHref('/session'), {
    method: 'POST',
    headers: { 'content-type': 'application/json' },
    body: JSON.stringify({ token }),
  })

export const thumbnailHref = (id: string) => apiHref(`/surfaces/${encodeURIComponent(id)}/thumbnail.png`)
