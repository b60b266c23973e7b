//! One surface and one of its pairs.
import { db } from './catalogue.mjs'
import { text } from './lake.mjs'

const missing = (what) => Object.assign(new Error(what), { status: 404, code: 'not_found' })
const tnce = (bands, prefix = 'tnce_', table = '') => bands.map((b) => `${table}${b.key === 'total' ? 'tnce_total' : prefix + b.key} as "${b.key}"`).join(', ')
const inBands = (bands, row, level = db) => bands.map((b) => (row?.[b.key] == null ? null : level(row[b.key])))

/** The answer of /surfaces/{id}. */
export async function detail(lake, bands, entries, id) {
  const entry = entries.find((e) => e.surface.surface_id === id)
  if (!entry) throw missing(`there is no surface ${id}`)
  const means = bands.map((b) => `avg(tnce_${b.key}) as "${b.key}"`).join(', ')
  const [statistics, rows, runs] = await Promise.all([
    lake.rows(`select band, measurements, p90_mean_db, p5_db, p50_db, p95_db, min_db, max_db, spread_db from surface_stats where surface_id = ${text(id)}`),
    lake.rows(`select surface_id, ${means} from tnce where surface_id in (${text(id)}, ${text(entry.row.flat_reference)}) group by surface_id`),
    lake.rows(`select run_id from runs where surface_id = ${text(id)} order by started_ns`),
  ])
  const linear = (surface) => inBands(bands, rows.find((r) => r.surface_id === surface), (v) => v)
  return {
    surface: entry.surface, parameters: JSON.parse(entry.row.parameters || '{}'), mesh_triangles: entry.row.mesh_triangles, mesh_watertight: entry.row.mesh_watertight,
    reflection_factor: entry.row.reflection_factor, runs: runs.map((r) => r.run_id),
    statistics: bands.map((b) => statistics.find((s) => s.band === b.key)).filter(Boolean),
    flat_mean: linear(entry.row.flat_reference), mean: linear(id),
  }
}

/** The answer of /surfaces/{id}/grid. */
export async function grid(lake, bands, points, id, microphone, over) {
  const rows = await lake.rows(`select pair_id, microphone, speaker, ${tnce(bands, over === 'flat-band' ? 'tnce_band_' : 'tnce_')} from tnce where surface_id = ${text(id)} and (microphone = ${microphone} or speaker = ${microphone})`)
  const empty = (value) => new Array(points.length).fill(value)
  const answer = { surface_id: id, microphone, over, pairs: empty(null), swapped: empty(false), bands: bands.map(() => empty(null)) }
  for (const row of rows) {
    const other = row.microphone === microphone ? row.speaker : row.microphone
    answer.pairs[other] = row.pair_id
    answer.swapped[other] = row.speaker === microphone
    inBands(bands, row).forEach((value, b) => { answer.bands[b][other] = value })
  }
  return answer
}

/** Mean curves of one surface, decimated. */
async function meanCurves(lake, bands, id, where, points) {
  const keys = bands.filter((b) => b.centre_hz !== null).map((b) => `nce_${b.key}`)
  const table = await lake.once(`curves ${id} ${where}`, async () => {
    const data = await lake.table(`select ${keys.join(', ')} from nce where surface_id = ${text(id)}${where}`)
    return { pairs: data.numRows, sums: keys.map((key) => sums(data.getChild(key))) }
  })
  const length = table.sums[0]?.length ?? 0
  const kept = indices(length, points)
  return { surface_id: id, pairs: table.pairs, bands: table.sums.map((s) => kept.map((i) => s[i] / table.pairs)) }
}

function sums(column) {
  let out = null
  for (let i = 0; i < column.length; i += 1) {
    const list = column.at(i)
    if (!list) continue
    out ??= new Float64Array(list.length)
    for (let k = 0; k < list.length; k += 1) out[k] += list[k]
  }
  return out ?? []
}

const indices = (length, points) => (length <= points ? Array.from({ length }, (_, i) => i) : Array.from({ length: points }, (_, i) => Math.round((i * (length - 1)) / (points - 1))))

/** The answer of /surfaces/{id}/curves; `where` narrows the pairs. */
export async function curves(lake, rig, entries, id, where, points) {
  const entry = entries.find((e) => e.surface.surface_id === id)
  if (!entry) throw missing(`there is no surface ${id}`)
  const [surface, flat] = await Promise.all([meanCurves(lake, rig.bands, id, where, points), meanCurves(lake, rig.bands, entry.row.flat_reference, where, points)])
  return { time_ms: indices(rig.ir_length, points).map((i) => (1000 * i) / rig.rate_hz), surface, flat }
}

/** Heights of a surface. */
export async function heights(lake, id) {
  const [row] = await lake.rows(`select cells, size_mm, heights_mm from heightmaps where surface_id = ${text(id)} and symmetry = 'identity'`)
  if (!row) throw Object.assign(missing(`surface ${id} has no height map`), { code: 'no_data' })
  return { cells: row.cells, size_mm: row.size_mm, heights: Float32Array.from(row.heights_mm) }
}

export const seriesOf = (rows, start_ns) => ({
  start: new Date(Number(start_ns) / 1e6).toISOString(),
  time_s: rows.map((r) => (Number(r.ns) - Number(start_ns)) / 1e9),
  temperature_c: rows.map((r) => r.temperature_c), humidity_pct: rows.map((r) => r.humidity_pct),
  pressure_hpa: rows.map((r) => r.pressure_hpa), outside_level_db: rows.map((r) => r.outside_level_db),
})

/** The answer of /surfaces/{id}/pairs/{pair}. */
export async function pair(lake, rig, entries, id, pairId) {
  const entry = entries.find((e) => e.surface.surface_id === id)
  if (!entry) throw missing(`there is no surface ${id}`)
  const one = `surface_id = ${text(id)} and pair_id = ${pairId}`
  const [[m], [geometry], nce, [level], d4] = await Promise.all([
    lake.rows(`select * from measurements where ${one}`), lake.rows(`select * from pairs where pair_id = ${pairId}`),
    lake.rows(`select surface_id, reflected_ir from nce where surface_id in (${text(id)}, ${text(entry.row.flat_reference)}) and pair_id = ${pairId}`),
    lake.rows(`select * from tnce where ${one}`),
    lake.rows(`select d.symmetry, d.d4_pair_id, d.d4_microphone, d.d4_speaker, d.swapped, ${tnce(rig.bands, 'tnce_', 't.')} from tnce_d4 d join tnce t on t.surface_id = d.surface_id and t.pair_id = d.d4_pair_id where d.surface_id = ${text(id)} and d.pair_id = ${pairId} order by d.symmetry`),
  ])
  if (!m) throw missing(`surface ${id} has no measurement of pair ${pairId}`)
  const t = m.log_time_ns
  const [attempts, around] = await Promise.all([
    lake.rows(`select log_time, level, name, message from events where run_id = ${text(m.run_id)} and message like 'pair ${pairId},%' order by log_time_ns`),
    lake.rows(`select log_time_ns as ns, temperature_c, humidity_pct, pressure_hpa, outside_level_db from environment where run_id = ${text(m.run_id)} and log_time_ns between ${BigInt(t) - 900000000000n} and ${BigInt(t) + 900000000000n} order by log_time_ns`),
  ])
  const reflected = (surface) => nce.find((r) => r.surface_id === surface)?.reflected_ir ?? null
  const at = (field) => rig.bands.map((b) => (level?.[b.key === 'total' ? 'tnce_total' : field + b.key] == null ? null : db(level[b.key === 'total' ? 'tnce_total' : field + b.key])))
  const { ir, surface_id, pair_id, microphone, speaker, log_time_ns, code_version, ...measurement } = m
  return {
    surface_id: id, rate_hz: rig.rate_hz, measured: ir, reflected: reflected(id), flat_reflected: reflected(entry.row.flat_reference), measurement,
    pair: {
      pair_id: pairId, microphone: geometry.microphone, speaker: geometry.speaker,
      microphone_mm: [geometry.microphone_x_mm, geometry.microphone_y_mm, geometry.microphone_z_mm], speaker_mm: [geometry.speaker_x_mm, geometry.speaker_y_mm, geometry.speaker_z_mm],
      direct_mm: geometry.direct_mm, image_mm: geometry.image_mm, incidence_deg: geometry.incidence_deg, specular_mm: [geometry.specular_x_mm, geometry.specular_y_mm],
      fresnel: [2000, 40000].map((hz) => ({ frequency_hz: hz, major_mm: geometry[`fresnel_major_${hz}_mm`], minor_mm: geometry[`fresnel_minor_${hz}_mm`] })).filter((f) => f.major_mm != null),
    },
    tnce_db: at('tnce_'), tnce_band_db: at('tnce_band_'),
    curves: reflected(id) ? await curves(lake, rig, entries, id, ` and pair_id = ${pairId}`, rig.ir_length) : null,
    symmetries: d4.map((r) => ({ symmetry: r.symmetry, pair_id: r.d4_pair_id, microphone: r.d4_microphone, speaker: r.d4_speaker, swapped: r.swapped, tnce_db: inBands(rig.bands, r) })),
    attempts, environment: seriesOf(around, t),
  }
}

/** 32-bit float WAV. */
export function wav(samples, rate) {
  const out = Buffer.alloc(58 + samples.length * 4)
  out.write('RIFF', 0); out.writeUInt32LE(out.length - 8, 4); out.write('WAVEfmt ', 8); out.writeUInt32LE(18, 16)
  out.writeUInt16LE(3, 20); out.writeUInt16LE(1, 22); out.writeUInt32LE(rate, 24); out.writeUInt32LE(rate * 4, 28)
  out.writeUInt16LE(4, 32); out.writeUInt16LE(32, 34); out.writeUInt16LE(0, 36)
  out.write('fact', 38); out.writeUInt32LE(4, 42); out.writeUInt32LE(samples.length, 46)
  out.write('data', 50); out.writeUInt32LE(samples.length * 4, 54)
  samples.forEach((value, i) => out.writeFloatLE(value, 58 + 4 * i))
  return out
}
