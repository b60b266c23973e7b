-- The twelve queries of `bench queries`, each below its name; $SURFACE and $PAIR are replaced by a surface of the lake and one
-- of its pairs. A name with `@peer` is the same for DuckDB, where it needs other words for the same rows.

-- catalogue_page
SELECT s.surface_id, s.typology, s.material, r.run_id, r.state, r.measurements, r.ended_ns,
  max(CASE WHEN t.band = 'total' THEN t.p90_mean_db END) AS level_total_db,
  max(CASE WHEN t.band = '10000' THEN t.p90_mean_db END) AS level_10000_db,
  max(CASE WHEN t.band = 'total' THEN t.spread_db END) AS spread_total_db
FROM surfaces s JOIN runs r ON r.run_id = s.run_id LEFT JOIN surface_stats t ON t.run_id = s.run_id
GROUP BY s.surface_id, s.typology, s.material, r.run_id, r.state, r.measurements, r.ended_ns
ORDER BY level_total_db, s.surface_id LIMIT 24;

-- facets
SELECT s.typology, s.material, m.verdict, m.attempt, count(*) AS n, min(m.snr_db) AS least_snr_db
FROM measurements m JOIN surfaces s ON s.surface_id = m.surface_id
GROUP BY s.typology, s.material, m.verdict, m.attempt ORDER BY n DESC, s.typology;

-- histogram
SELECT CAST(floor(10 * log10(nullif(tnce_total, 0)) * 2) AS INT) AS half_db, count(*) AS n
FROM tnce GROUP BY half_db ORDER BY half_db;

-- percentiles
SELECT surface_id,
  percentile_cont(0.05) WITHIN GROUP (ORDER BY tnce_10000) AS p5,
  percentile_cont(0.5) WITHIN GROUP (ORDER BY tnce_10000) AS p50,
  percentile_cont(0.95) WITHIN GROUP (ORDER BY tnce_10000) AS p95
FROM tnce GROUP BY surface_id ORDER BY surface_id;

-- one_ir
SELECT ir FROM measurements WHERE surface_id = '$SURFACE' AND pair_id = $PAIR;

-- surface_irs
SELECT pair_id, ir FROM measurements WHERE surface_id = '$SURFACE' ORDER BY pair_id;

-- augmented_surface
SELECT pair_id, symmetry, d4_pair_id, swapped, microphone_x_mm, microphone_y_mm, speaker_x_mm, speaker_y_mm, ir
FROM augmented WHERE surface_id = '$SURFACE';

-- augmented_surface@peer: DuckDB has no such view; the stored table beside it has the same moved points.
SELECT d.pair_id, d.symmetry, d.d4_pair_id, d.swapped, d.microphone_x_mm, d.microphone_y_mm, d.speaker_x_mm,
  d.speaker_y_mm, m.ir
FROM tnce_d4 d JOIN measurements m ON m.surface_id = d.surface_id AND m.run_id = d.run_id AND m.pair_id = d.pair_id
WHERE d.surface_id = '$SURFACE';

-- by_incidence
SELECT CAST(floor(p.incidence_deg / 5) AS INT) * 5 AS degrees, count(*) AS n, avg(t.tnce_total) AS mean,
  avg(t.tnce_band_10000) AS mean_10000, max(t.tnce_total) AS most
FROM tnce t JOIN pairs p ON p.pair_id = t.pair_id GROUP BY degrees ORDER BY degrees;

-- focusing_pairs
SELECT surface_id, pair_id, microphone, speaker, tnce_total FROM tnce
ORDER BY tnce_total DESC, surface_id, pair_id LIMIT 50;

-- scan_tnce_d4
SELECT symmetry, swapped, count(*) AS n, avg(tnce_total) AS mean, max(tnce_band_10000) AS most,
  avg(microphone_x_mm * speaker_x_mm + microphone_y_mm * speaker_y_mm) AS lean
FROM tnce_d4 GROUP BY symmetry, swapped ORDER BY symmetry, swapped;

-- band_energies
SELECT pair_id, sum(x * x) AS energy FROM
  (SELECT pair_id, CAST(unnest(reflected_ir) AS DOUBLE) AS x FROM nce WHERE surface_id = '$SURFACE') samples
GROUP BY pair_id ORDER BY pair_id;

-- text_search
SELECT surface_id, log_time_ns, message FROM events
WHERE level = 'warning' AND message ILIKE '%retried%' AND message LIKE '%outside noise%' ORDER BY log_time_ns LIMIT 100;
