//! The queries behind the figures, as they can be run anywhere.
import type { Lake } from './api'

/** A string as an SQL literal. */
export const quoted = (text: string) => `'${text.replaceAll("'", "''")}'`
const centres = (lake: Lake) => lake.bands.filter((band) => band.centre_hz !== null).map((band) => band.key)

export const gridQuery = (lake: Lake, id: string, microphone: number, over: string) =>
  `select pair_id, microphone, speaker,\n${lake.bands
    .map((band) => {
      const column =
        band.key === 'total' ? 'tnce_total' : over === 'flat-band' ? `tnce_band_${band.key}` : `tnce_${band.key}`
      return `  10 * log10(${column}) as ${column}_db`
    })
    .join(
      ',\n',
    )}\nfrom tnce\nwhere surface_id = ${quoted(id)} and (microphone = ${microphone} or speaker = ${microphone})`

export const meanQuery = (lake: Lake, ids: readonly string[]) =>
  `select surface_id, count(*) as pairs,\n${lake.bands.map((band) => `  avg(tnce_${band.key}) as tnce_${band.key}`).join(',\n')}\nfrom tnce\nwhere surface_id in (${ids.map(quoted).join(', ')})\ngroup by surface_id order by surface_id`

export const statisticsQuery = (ids: readonly string[]) =>
  `select surface_id, band, p90_mean_db, p90_mean_u_db, unbiased_p90_mean_db, p5_db, p50_db, p95_db, min_db, max_db, spread_db\nfrom surface_stats\nwhere surface_id in (${ids.map(quoted).join(', ')})\norder by surface_id, band_hz`

export const curvesQuery = (lake: Lake, id: string, pair?: number) =>
  `select pair_id, ${centres(lake)
    .map((key) => `nce_${key}`)
    .join(', ')}\nfrom nce\nwhere surface_id = ${quoted(id)}${pair === undefined ? '' : ` and pair_id = ${pair}`}`

export const responseQuery = (id: string, pair: number) =>
  `select m.pair_id, m.ir, n.reflected_ir\nfrom measurements m left join nce n using (surface_id, pair_id)\nwhere m.surface_id = ${quoted(id)} and m.pair_id = ${pair}`

export const heightsQuery = (id: string) =>
  `select cells, size_mm, heights_mm from heightmaps where surface_id = ${quoted(id)} and symmetry = 'identity'`

export const environmentQuery = (run: string) =>
  `select log_time, temperature_c, humidity_pct, pressure_hpa, outside_level_db\nfrom environment\nwhere run_id = ${quoted(run)}\norder by log_time_ns`
