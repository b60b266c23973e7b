//! Principal components of the surfaces' TNCE vectors.

/** The answer of /map. */
export async function map(lake, bands, entries, neighbours) {
  const solved = await lake.once('map', () => solve(lake, bands, entries))
  return {
    features: solved.features, explained: solved.explained, left_out: solved.leftOut,
    points: solved.ids.map((id, i) => ({
      surface_id: id, typology: entries.find((e) => e.surface.surface_id === id).row.typology, position: solved.positions[i],
      neighbours: solved.ids.map((other, j) => ({ surface_id: other, distance_db: Math.sqrt(Math.max(0, solved.gram[i][i] + solved.gram[j][j] - 2 * solved.gram[i][j]) / solved.features) }))
        .filter((n) => n.surface_id !== id).sort((a, b) => a.distance_db - b.distance_db).slice(0, neighbours),
    })),
  }
}

async function solve(lake, bands, entries) {
  const keys = bands.filter((b) => b.centre_hz !== null).map((b) => b.key)
  const table = await lake.table(`select surface_id, pair_id, ${keys.map((k) => `cast(10 * log10(tnce_band_${k}) as float) as "${k}"`).join(', ')} from tnce where surface_id in (select surface_id from surface_stats where band = 'total' and p90_mean_db is not null)`)
  const vectors = new Map()
  const pairs = 1 + table.getChild('pair_id').toArray().reduce((a, b) => Math.max(a, b), 0)
  const ids = table.getChild('surface_id').toArray()
  const pair = table.getChild('pair_id').toArray()
  keys.forEach((key, k) => {
    const values = table.getChild(key).toArray()
    for (let i = 0; i < values.length; i += 1) {
      if (!vectors.has(ids[i])) vectors.set(ids[i], new Float64Array(pairs * keys.length).fill(NaN))
      vectors.get(ids[i])[pair[i] * keys.length + k] = values[i]
    }
  })
  const names = [...vectors.keys()].sort()
  const rows = names.map((id) => vectors.get(id))
  let features = 0
  for (let f = 0; f < pairs * keys.length; f += 1) {
    let sum = 0
    for (const row of rows) sum += row[f]
    if (Number.isFinite(sum)) features += 1
    for (const row of rows) row[f] = Number.isFinite(sum) ? row[f] - sum / rows.length : 0
  }
  const gram = rows.map(() => new Float64Array(rows.length))
  for (let i = 0; i < rows.length; i += 1) {
    for (let j = 0; j <= i; j += 1) {
      let sum = 0
      for (let f = 0; f < rows[i].length; f += 1) sum += rows[i][f] * rows[j][f]
      gram[i][j] = gram[j][i] = sum
    }
  }
  const trace = gram.reduce((sum, row, i) => sum + row[i], 0)
  const left = gram.map((row) => Float64Array.from(row))
  const components = [0, 1, 2].map((k) => leading(left, k))
  return {
    ids: names, gram, features, explained: components.map((c) => c.value / trace), leftOut: entries.map((e) => e.surface.surface_id).filter((id) => !vectors.has(id)),
    positions: names.map((_, i) => components.map((c) => (c.vector[i] * Math.sqrt(Math.max(0, c.value))) / Math.sqrt(features))),
  }
}

/** Power iteration, then deflation. */
function leading(matrix, seed) {
  const n = matrix.length
  let vector = Float64Array.from({ length: n }, (_, i) => Math.sin(1 + seed + i * 1.7))
  let value = 0
  for (let step = 0; step < 300; step += 1) {
    const next = new Float64Array(n)
    for (let i = 0; i < n; i += 1) for (let j = 0; j < n; j += 1) next[i] += matrix[i][j] * vector[j]
    value = Math.hypot(...next)
    if (value === 0) break
    vector = next.map((v) => v / value)
  }
  for (let i = 0; i < n; i += 1) for (let j = 0; j < n; j += 1) matrix[i][j] -= value * vector[i] * vector[j]
  return { value, vector }
}
