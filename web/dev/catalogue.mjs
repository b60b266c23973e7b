//! Surfaces with their summary, filtered, counted and sorted in memory.
import { text } from './lake.mjs'

export const db = (linear) => (linear > 0 ? 10 * Math.log10(linear) : null)
const DAY_NS = 86400e9

/** The rig's part of lake.toml that the pages need. */
export function rigOf(toml) {
  const number = (name) => Number(new RegExp(`^${name} = ([-0-9.e]+)`, 'm').exec(toml)?.[1])
  const centres = /^centres_hz = \[(.*)\]/m.exec(toml)[1].split(',').map(Number)
  const label = (hz) => (hz >= 1000 ? `${hz / 1000} kHz` : `${hz} Hz`)
  const bands = centres.map((hz) => ({ key: String(hz), centre_hz: hz, label: label(hz) }))
  return {
    name: /\[rig\]\nname = "(.*)"/.exec(toml)[1],
    bands: [...bands, { key: 'total', centre_hz: null, label: 'Total' }],
    rate_hz: number('rate_hz'), low_hz: number('low_hz'), high_hz: number('high_hz'), ir_length: number('length'),
    reference_temperature_c: number('reference_temperature_c'), panel_size_mm: number('size_mm'), panel_depth_mm: number('depth_mm'),
  }
}

/** One summary a surface. */
export async function summaries(lake, bands) {
  const [surfaces, stats] = await Promise.all([
    lake.rows('select s.*, r.started, r.started_ns from surfaces s left join runs r on r.run_id = s.run_id order by s.surface_id'),
    lake.rows('select surface_id, band, p90_mean_db, spread_db from surface_stats'),
  ])
  const levels = new Map()
  for (const row of stats) {
    if (!levels.has(row.surface_id)) levels.set(row.surface_id, {})
    levels.get(row.surface_id)[row.band] = row
  }
  const of = (id, field) => bands.map((band) => levels.get(id)?.[band.key]?.[field] ?? null)
  return surfaces.map((row) => {
    const level = of(row.surface_id, 'p90_mean_db')
    const flat = of(row.flat_reference, 'p90_mean_db')
    return {
      surface: {
        surface_id: row.surface_id, run_id: row.run_id, panel: row.panel, side: row.side, typology: row.typology,
        macrostructure: row.macrostructure, mesostructure: row.mesostructure, microstructure: row.microstructure, material: row.material,
        flat_reference: row.flat_reference, foam_reference: row.foam_reference, origin: row.origin, started: row.started,
        relief_min_mm: row.relief_min_mm, relief_max_mm: row.relief_max_mm, relief_rms_mm: row.relief_rms_mm,
        level_db: level, against_flat_db: level.map((value, i) => (value === null || flat[i] === null ? null : value - flat[i])),
        spread_db: of(row.surface_id, 'spread_db'),
      },
      row, day: row.started_ns === null ? null : Number(row.started_ns) / DAY_NS,
      words: [row.surface_id, row.panel, row.typology, row.macrostructure, row.mesostructure, row.microstructure, row.material, row.parameters].join(' ').toLowerCase(),
    }
  })
}

const FACETS = [['typology', 'Typology'], ['macrostructure', 'Macrostructure'], ['mesostructure', 'Mesostructure'], ['material', 'Material'], ['flat_reference', 'Flat reference'], ['origin', 'Origin']]

function filters(bands, params) {
  const tests = new Map()
  const words = (params.get('q') ?? '').toLowerCase().split(/\s+/).filter(Boolean)
  if (words.length) tests.set('q', (entry) => words.every((word) => entry.words.includes(word)))
  for (const [name] of FACETS) {
    const wanted = new Set(params.getAll(name))
    if (wanted.size) tests.set(name, (entry) => wanted.has(entry.surface[name] ?? '—'))
  }
  const range = (name, given, value) => {
    const [low, high] = given.split('..').map(Number)
    if (Number.isNaN(low) || Number.isNaN(high)) throw Object.assign(new Error(`${name} is not lo..hi: ${given}`), { status: 400, code: 'request_invalid' })
    tests.set(name, (entry) => value(entry) !== null && value(entry) >= low && value(entry) <= high)
  }
  if (params.get('started')) range('started', params.get('started'), (entry) => entry.day)
  if (params.get('relief')) range('relief', params.get('relief'), (entry) => entry.surface.relief_rms_mm)
  for (const given of params.getAll('level')) {
    const [band, span] = given.split(':')
    const index = bands.findIndex((one) => one.key === band)
    if (index < 0) throw Object.assign(new Error(`no band ${band}`), { status: 400, code: 'request_invalid' })
    range(`level:${band}`, span, (entry) => entry.surface.against_flat_db[index])
  }
  return tests
}

function histogram(name, label, unit, all, left, value, bins) {
  const known = all.map(value).filter((v) => v !== null && Number.isFinite(v))
  if (!known.length) return null
  const low = Math.min(...known)
  const width = Math.max((Math.max(...known) - low) / bins, 1e-9)
  const counts = new Array(bins).fill(0)
  for (const v of left.map(value)) if (v !== null && Number.isFinite(v)) counts[Math.min(bins - 1, Math.floor((v - low) / width))] += 1
  return { name, label, unit, bins: counts.map((count, i) => ({ from: low + i * width, to: low + (i + 1) * width, count })) }
}

/** The answer of /surfaces. */
export function page(entries, bands, params) {
  const tests = filters(bands, params)
  const passing = (without) => entries.filter((entry) => [...tests].every(([name, test]) => name === without || test(entry)))
  const left = passing()
  const facets = FACETS.map(([name, label]) => {
    const counts = new Map()
    for (const entry of entries) counts.set(entry.surface[name] ?? '—', 0)
    for (const entry of passing(name)) counts.set(entry.surface[name] ?? '—', counts.get(entry.surface[name] ?? '—') + 1)
    return { name, label, values: [...counts].map(([value, count]) => ({ value, count })).sort((a, b) => b.count - a.count || a.value.localeCompare(b.value)) }
  })
  const histograms = [
    ...bands.map((band, i) => histogram(`level:${band.key}`, `${band.label} against Flat`, 'dB', entries, passing(`level:${band.key}`), (entry) => entry.surface.against_flat_db[i], 24)),
    histogram('relief', 'Relief, rms', 'mm', entries, passing('relief'), (entry) => entry.surface.relief_rms_mm, 24),
    histogram('started', 'Measured', 'day', entries, passing('started'), (entry) => entry.day, 24),
  ].filter(Boolean)
  const band = Math.max(0, bands.findIndex((one) => one.key === (params.get('sort_band') ?? 'total')))
  const key = {
    started: (e) => e.day, relief: (e) => e.surface.relief_rms_mm, spread: (e) => e.surface.spread_db[band], level: (e) => e.surface.against_flat_db[band],
  }[params.get('sort')] ?? ((e) => e.surface.surface_id)
  const sign = params.get('order') === 'desc' ? -1 : 1
  left.sort((a, b) => {
    const [x, y] = [key(a), key(b)]
    if (x === null || y === null) return x === y ? 0 : x === null ? 1 : -1
    return sign * (typeof x === 'string' ? x.localeCompare(y, 'en', { numeric: true }) : x - y)
  })
  const offset = Number(params.get('offset') ?? 0)
  return { total: left.length, offset, items: left.slice(offset, offset + Number(params.get('limit') ?? 60)).map((e) => e.surface), facets, histograms, counts: 'exact' }
}

/** Pearson's r of parameters with levels. */
export function correlations(entries, bands, typologies) {
  const chosen = entries.filter((e) => e.row.typology !== 'reference' && (!typologies.length || typologies.includes(e.row.typology)))
  const columns = new Map()
  const put = (name, index, value) => {
    if (typeof value !== 'number' || !Number.isFinite(value) || name === 'seed') return
    if (!columns.has(name)) columns.set(name, new Array(chosen.length).fill(null))
    columns.get(name)[index] = value
  }
  chosen.forEach((e, i) => {
    put('relief_rms_mm', i, e.row.relief_rms_mm)
    put('relief_range_mm', i, e.row.relief_max_mm - e.row.relief_min_mm)
    put('reflection_factor', i, e.row.reflection_factor)
    for (const [name, value] of Object.entries(JSON.parse(e.row.parameters || '{}'))) put(name, i, value)
  })
  const items = []
  for (const [parameter, values] of [...columns].sort()) {
    bands.forEach((band, b) => {
      const pairs = values.map((v, i) => [v, chosen[i].surface.against_flat_db[b]]).filter(([x, y]) => x !== null && y !== null)
      items.push({ parameter, unit: /_(mm|deg)$/.exec(parameter)?.[1] ?? '1', band: band.key, r: pearson(pairs), n: pairs.length })
    })
  }
  return { method: 'pearson', items, surfaces: chosen.length }
}

function pearson(pairs) {
  if (pairs.length < 3) return null
  const mean = (k) => pairs.reduce((sum, p) => sum + p[k], 0) / pairs.length
  const [mx, my] = [mean(0), mean(1)]
  let [xx, yy, xy] = [0, 0, 0]
  for (const [x, y] of pairs) { xx += (x - mx) ** 2; yy += (y - my) ** 2; xy += (x - mx) * (y - my) }
  return xx > 1e-12 && yy > 1e-12 ? xy / Math.sqrt(xx * yy) : null
}

export { text }
