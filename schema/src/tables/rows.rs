//! Rows that are written and read as structs. Their fields have the names of the table's columns.

use serde::{Deserialize, Serialize};

/// A row of table `surface_stats`: statistics of one band's TNCE values over the pairs.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the table's definition describes each column")]
pub struct BandStatistics {
    pub band: String,
    pub measurements: i32,
    pub p90_mean_db: Option<f64>,
    pub p5_db: Option<f64>,
    pub p50_db: Option<f64>,
    pub p95_db: Option<f64>,
    pub min_db: Option<f64>,
    pub max_db: Option<f64>,
    pub spread_db: Option<f64>,
    #[serde(default)]
    pub p90_mean_u_db: Option<f64>,
    #[serde(default)]
    pub unbiased_p90_mean_db: Option<f64>,
    #[serde(default)]
    pub unbiased_p90_mean_u_db: Option<f64>,
}
