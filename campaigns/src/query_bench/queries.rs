//! The twelve queries, written down once. Both engines get the same text, but for views that only echolake has.

/// One query of the benchmark.
pub(crate) struct BenchQuery {
    /// Short name.
    pub(crate) name: &'static str,
    /// Query for echolake.
    pub(crate) sql: String,
    /// Query for DuckDB, if its tables need other words for the same rows.
    pub(crate) peer: Option<String>,
}

/// The queries about a surface and a pair of the lake.
pub(crate) fn all(surface: &str, pair: i64) -> Vec<BenchQuery> {
    let query = |name, sql: &str| {
        let sql = sql.replace("$SURFACE", surface).replace("$PAIR", &pair.to_string());
        BenchQuery { name, sql, peer: None }
    };
    let mut augmented = query("augmented_surface", AUGMENTED);
    augmented.peer = Some(AUGMENTED_PEER.replace("$SURFACE", surface));
    vec![
        query("catalogue_page", CATALOGUE),
        query("facets", FACETS),
        query("histogram", HISTOGRAM),
        query("percentiles", PERCENTILES),
        query("one_ir", ONE_IR),
        query("surface_irs", SURFACE_IRS),
        augmented,
        query("by_incidence", BY_INCIDENCE),
        query("focusing_pairs", FOCUSING),
        query("scan_tnce_d4", SCAN_D4),
        query("band_energies", BAND_ENERGIES),
        query("text_search", TEXT_SEARCH),
    ]
}

const CATALOGUE: &str = "\
SELECT s.surface_id, s.typology, s.material, r.run_id, r.state, r.measurements, r.ended_ns,
  max(CASE WHEN t.band = 'total' THEN t.p90_mean_db END) AS level_total_db,
  max(CASE WHEN t.band = '10000' THEN t.p90_mean_db END) AS level_10000_db,
  max(CASE WHEN t.band = 'total' THEN t.spread_db END) AS spread_total_db
FROM surfaces s JOIN runs r ON r.run_id = s.run_id LEFT JOIN surface_stats t ON t.run_id = s.run_id
GROUP BY s.surface_id, s.typology, s.material, r.run_id, r.state, r.measurements, r.ended_ns
ORDER BY level_total_db, s.surface_id LIMIT 24";

const FACETS: &str = "\
SELECT s.typology, s.material, m.verdict, m.attempt, count(*) AS n, min(m.snr_db) AS least_snr_db
FROM measurements m JOIN surfaces s ON s.surface_id = m.surface_id
GROUP BY s.typology, s.material, m.verdict, m.attempt ORDER BY n DESC, s.typology";

const HISTOGRAM: &str = "\
SELECT CAST(floor(10 * log10(nullif(tnce_total, 0)) * 2) AS INT) AS half_db, count(*) AS n
FROM tnce GROUP BY half_db ORDER BY half_db";

const PERCENTILES: &str = "\
SELECT surface_id,
  percentile_cont(0.05) WITHIN GROUP (ORDER BY tnce_10000) AS p5,
  percentile_cont(0.5) WITHIN GROUP (ORDER BY tnce_10000) AS p50,
  percentile_cont(0.95) WITHIN GROUP (ORDER BY tnce_10000) AS p95
FROM tnce GROUP BY surface_id ORDER BY surface_id";

const ONE_IR: &str = "SELECT ir FROM measurements WHERE surface_id = '$SURFACE' AND pair_id = $PAIR";

const SURFACE_IRS: &str = "SELECT pair_id, ir FROM measurements WHERE surface_id = '$SURFACE' ORDER BY pair_id";

const AUGMENTED: &str = "\
SELECT pair_id, symmetry, d4_pair_id, swapped, microphone_x_mm, microphone_y_mm, speaker_x_mm, speaker_y_mm, ir
FROM augmented WHERE surface_id = '$SURFACE'";

// DuckDB has no such view; the stored table beside it has the same moved points.
const AUGMENTED_PEER: &str = "\
SELECT d.pair_id, d.symmetry, d.d4_pair_id, d.swapped, d.microphone_x_mm, d.microphone_y_mm, d.speaker_x_mm,
  d.speaker_y_mm, m.ir
FROM tnce_d4 d JOIN measurements m ON m.surface_id = d.surface_id AND m.run_id = d.run_id AND m.pair_id = d.pair_id
WHERE d.surface_id = '$SURFACE'";

const BY_INCIDENCE: &str = "\
SELECT CAST(floor(p.incidence_deg / 5) AS INT) * 5 AS degrees, count(*) AS n, avg(t.tnce_total) AS mean,
  avg(t.tnce_band_10000) AS mean_10000, max(t.tnce_total) AS most
FROM tnce t JOIN pairs p ON p.pair_id = t.pair_id GROUP BY degrees ORDER BY degrees";

const FOCUSING: &str = "\
SELECT surface_id, pair_id, microphone, speaker, tnce_total FROM tnce
ORDER BY tnce_total DESC, surface_id, pair_id LIMIT 50";

const SCAN_D4: &str = "\
SELECT symmetry, swapped, count(*) AS n, avg(tnce_total) AS mean, max(tnce_band_10000) AS most,
  avg(microphone_x_mm * speaker_x_mm + microphone_y_mm * speaker_y_mm) AS lean
FROM tnce_d4 GROUP BY symmetry, swapped ORDER BY symmetry, swapped";

const BAND_ENERGIES: &str = "\
SELECT pair_id, sum(x * x) AS energy FROM
  (SELECT pair_id, CAST(unnest(reflected_ir) AS DOUBLE) AS x FROM nce WHERE surface_id = '$SURFACE') samples
GROUP BY pair_id ORDER BY pair_id";

const TEXT_SEARCH: &str = "\
SELECT surface_id, log_time_ns, message FROM events
WHERE level = 'warning' AND message ILIKE '%retried%' AND message LIKE '%outside noise%' ORDER BY log_time_ns LIMIT 100";
