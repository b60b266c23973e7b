//! Levels without Foam's reflection, beside those over Foam that reflects nothing.

mod slow {
    use serde_json::Value;

    use crate::TestFolder;

    const RIG: &str = "[sweep]\nduration_secs = 0.03\n\
        [[grid.layers]]\npoints_per_side = 5\npitch_mm = 75.0\nheight_mm = 124.0\n\
        [[grid.layers]]\npoints_per_side = 4\npitch_mm = 75.0\nheight_mm = 214.0\n\
        [[grid.layers]]\npoints_per_side = 2\npitch_mm = 75.0\nheight_mm = 304.0\n[simulation]\n";

    // The levels of Flat and of a dome by band: as subtracted, without Foam's reflection, and the latter's uncertainty.
    fn levels_over(foam: &str) -> Vec<[f64; 3]> {
        let place = TestFolder::new();
        std::fs::write(place.path("rig.toml"), format!("{RIG}{foam}\n")).expect("written");
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("0015_0", "3")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        place.ok(&["ingest"]);
        let rows = place.sql(
            "select p90_mean_db, unbiased_p90_mean_db, unbiased_p90_mean_u_db from surface_stats \
             where surface_id <> 'foam' order by surface_id, band",
        );
        let level = |row: &serde_json::Map<String, Value>, name| row[name].as_f64().expect("a level");
        let names = ["p90_mean_db", "unbiased_p90_mean_db", "unbiased_p90_mean_u_db"];
        rows.iter().map(|row| names.map(|name| level(row, name))).collect()
    }

    // The truth has the same noise and places, as they follow from the seeds.
    #[test]
    fn levels_without_foams_reflection_hold_the_truth() {
        let truth = levels_over("foam_reflection = false");
        assert_eq!(truth.len(), 12);
        for foam in ["foam_reflection = false", "foam_thickness_mm = 25.0", "foam_thickness_mm = 50.0"] {
            for ([_, level, u], [true_db, ..]) in levels_over(foam).iter().zip(&truth) {
                let error = level - true_db;
                assert!(error.abs() <= 1.96 * u + 1e-6 && *u < 0.25, "{foam}: {level} is off by {error}, u {u}");
            }
        }
    }
}
