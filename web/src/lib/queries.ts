//! The queries behind the figures, as they can be run anywhere.
import type { Lake } from './api'
import type { LevelReference } from './reference'

/** A string as an SQL literal. */
export const quoted = (text: string) => `'${text.replaceAll("'", "''")}'`

/** The measurements of a surface, of all its pairs, of a microphone's or of one, as a predicate for slices. */
export const sliceOf = (id: string, of: { readonly microphone?: number; readonly pair?: number } = {}) =>
  [
    `surface_id = ${quoted(id)}`,
    ...(of.microphone === undefined ? [] : [`(microphone = ${of.microphone} or speaker = ${of.microphone})`]),
    ...(of.pair === undefined ? [] : [`pair_id = ${of.pair}`]),
  ].join(' and ')

const centres = (lake: Lake) => lake.bands.filter((band) => band.centre_hz !== null).map((band) => band.key)

export const gridQuery = (lake: Lake, ids: readonly string[], microphone: number, over: string) =>
  `select surface_id, pair_id, microphone, speaker,\n${lake.bands
    .map((band) => {
      const column =
        band.key === 'total' ? 'tnce_total' : over === 'flat-band' ? `tnce_band_${band.key}` : `tnce_${band.key}`
      return `  10 * log10(${column}) as ${column}_db`
    })
    .join(
      ',\n',
    )}\nfrom tnce\nwhere surface_id in (${ids.map(quoted).join(', ')}) and (microphone = ${microphone} or speaker = ${microphone})`

export const meanQuery = (lake: Lake, ids: readonly string[]) =>
  `select surface_id, count(*) as pairs,\n${lake.bands.map((band) => `  avg(tnce_${band.key}) as tnce_${band.key}`).join(',\n')}\nfrom tnce\nwhere surface_id in (${ids.map(quoted).join(', ')})\ngroup by surface_id order by surface_id`

/** Diffusion coefficients: a mean over the points, each of which is a source with the points that it makes pairs with. */
export const diffusionQuery = (lake: Lake, ids: readonly string[]) =>
  `select surface_id,\n${lake.bands.map((band) => `  avg(d_${band.key}) as diffusion_${band.key}`).join(',\n')}\nfrom (\n  select surface_id, run_id, point,\n${lake.bands
    .map((band) => `    diffusion_coefficient(10 * log10(energy_${band.key})) as d_${band.key}`)
    .join(',\n')}\n  from (select *, unnest([microphone, speaker]) as point from tnce where surface_id in (${ids
    .map(quoted)
    .join(', ')}))\n  group by surface_id, run_id, point\n)\ngroup by surface_id order by surface_id`

/** Levels re Flat total, or less Flat's level in the same band. */
export function statisticsQuery(ids: readonly string[], over: LevelReference): string {
  const columns =
    over === 'flat-total'
      ? ['shown_db', 'level_db', 'unbiased_db']
      : ['shown_against_flat_db', 'against_flat_db', 'unbiased_against_flat_db']
  const overFlat = (name: string) => (over === 'flat-total' ? name : `${name} - level_db + against_flat_db as ${name}`)
  const percentiles = ['p5_db', 'p50_db', 'p95_db', 'min_db', 'max_db'].map(overFlat)
  return `select surface_id, band, ${columns.join(', ')}, shown_u_db, has_foam, runs, ${percentiles.join(', ')}, spread_db\nfrom levels\nwhere surface_id in (${ids.map(quoted).join(', ')})\norder by surface_id, band_hz`
}

export const curvesQuery = (lake: Lake, id: string, pair?: number) =>
  `select pair_id, ${centres(lake)
    .map((key) => `nce_${key}`)
    .join(', ')}\nfrom nce\nwhere surface_id = ${quoted(id)}${pair === undefined ? '' : ` and pair_id = ${pair}`}`

export const responseQuery = (measurements: readonly { readonly id: string; readonly pair: number }[]) =>
  `select m.surface_id, m.pair_id, m.ir, n.reflected_ir\nfrom measurements m left join nce n using (surface_id, pair_id)\nwhere ${measurements
    .map(({ id, pair }) => `m.surface_id = ${quoted(id)} and m.pair_id = ${pair}`)
    .join('\n  or ')}`

/** Responses of a pair on other surfaces, those first that are most like this one. */
export const nearestResponsesQuery = (id: string, pair: number) =>
  `select surface_id, run_id, pearson(reflected_ir, (\n  select avg_list(reflected_ir) from nce where surface_id = ${quoted(id)} and pair_id = ${pair}\n)) as correlation\nfrom nce where pair_id = ${pair} and surface_id <> ${quoted(id)}\norder by correlation desc nulls last limit 10`

export const heightsQuery = (id: string) =>
  `select cells, size_mm, heights_mm from heightmaps where surface_id = ${quoted(id)} and symmetry = 'identity'`

export const environmentQuery = (run: string) =>
  `select log_time, temperature_c, humidity_pct, pressure_hpa, outside_level_db\nfrom environment\nwhere run_id = ${quoted(run)}\norder by log_time_ns`
