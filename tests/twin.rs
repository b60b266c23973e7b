//! `echolake twin`: a run beside the one that is computed for its heights.

use echolake_acquisition::run::controller::RecordingMode;
use echolake_panel::paper_panel::PaperPanel;
use echolake_panel::relief::PanelRelief;
use echolake_testing::{SMALL_RIG, simulate_run};

use super::TestFolder;

mod slow {
    use super::*;

    #[test]
    fn a_twin_is_computed_once_labelled_and_near_to_its_surface() {
        let place = TestFolder::new();
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("stretcher_bond", "3"), ("wood", "4")] {
            place.acquire(surface, &["--seed", seed]);
        }
        // E33: a reference that an earlier revision computed, at 08:00, is removed, not averaged with the present one.
        simulate_run(&place.path("lake/inbox"), 0, "twin_flat", "flat", RecordingMode::ResponsesOnly);
        place.ok(&["ingest"]);
        assert_eq!(place.number("select count(*) from runs where surface_id = 'twin_flat'"), 1.0);
        // Levels have uncertainties; Flat's are those of the energy that the others are over.
        let uncertain = |surface: &str| {
            place.number(&format!("select max(tnce_band_10000_u_db) from tnce where surface_id = '{surface}'"))
        };
        assert!((1e-4..1.0).contains(&uncertain("stretcher_bond")), "{}", uncertain("stretcher_bond"));
        assert!((1e-4..0.1).contains(&uncertain("flat")), "{}", uncertain("flat"));

        let twin: serde_json::Value =
            serde_json::from_str(&place.ok(&["twin", "stretcher_bond", "--json"])).expect("JSON");
        assert_eq!((&twin["origin"], &twin["twin_origin"]), (&"simulated".into(), &"computed".into()));
        let bands = twin["bands"].as_array().expect("bands");
        assert_eq!(bands.len(), 6);
        for band in bands {
            // The measured one is simulated itself: what is between them is noise, drift and places.
            let rms = band["rms_db"].as_f64().expect("a difference");
            assert!((1e-4..1.0).contains(&rms) && band["pairs"] == 45, "{band}");
        }
        let pairs = twin["pairs"].as_array().expect("pairs");
        let apart = |pair: &serde_json::Value| pair["difference_db"].as_f64().expect("a difference").abs();
        assert!(pairs.len() == 10 && apart(&pairs[0]) >= apart(&pairs[9]), "{pairs:?}");
        let flats = place.sql("select run_id from runs where surface_id = 'twin_flat'");
        assert_eq!(flats.len(), 1, "{flats:?}");
        let id = flats[0]["run_id"].as_str().expect("a name");
        assert!(id.ends_with("-twin_flat-0000000000000000"), "{id}");
        let origins =
            place.sql("select surface_id, origin from surfaces where origin = 'computed' order by surface_id");
        let names: Vec<_> = origins.iter().map(|row| row["surface_id"].as_str().expect("a name")).collect();
        assert_eq!(names, ["twin_flat", "twin_foam", "twin_stretcher_bond"]);
        assert_eq!(
            place.sql(
                "select flat_reference from surfaces where surface_id = \
                'twin_stretcher_bond'"
            )[0]["flat_reference"],
            "twin_flat"
        );

        // The second time all is there.
        let runs = place.number("select count(*) from runs");
        let table = place.ok(&["twin", "stretcher_bond", "--pairs", "1"]);
        assert!(
            table.contains("stretcher_bond (simulated) less twin_stretcher_bond (computed)") && table.contains("10000"),
            "{table}"
        );
        assert_eq!(place.number("select count(*) from runs"), runs);

        place.fails(1, &["twin", "wood"], "the panel is of `MDF`; hint: twins are computed of `coated print` alone");
        place.fails(1, &["twin", "twin_flat"], "is computed itself");
        place.fails(1, &["twin", "marble"], "there is no run, surface or file `marble`");
    }

    // Both are simulated alike, without the chances of a measurement: no level may differ.
    #[test]
    fn the_twin_of_a_run_without_noise_is_the_run() {
        let place = TestFolder::new();
        let quiet = "[simulation]\nnoise_and_drift = false\nrepeatability_mm = 0.0\ncalibration_mm = 0.0\n";
        let rig = SMALL_RIG.replace("points_per_side = 3", "points_per_side = 2") + quiet;
        std::fs::write(place.path("rig.toml"), rig).expect("written");
        let of_paper = PaperPanel::ALL.map(|panel| panel.name);
        let reliefs = PanelRelief::NAMES.into_iter().chain(of_paper).filter(|name| *name != "wood");
        let surfaces: Vec<_> = reliefs.collect();
        surfaces.iter().for_each(|surface| drop(place.acquire(surface, &[])));
        // A foreign mesh is deeper than our reliefs are, and its zero is elsewhere.
        place.ok(&["panel", "river_rock", "--cells", "400", "-o", "printed.stl"]);
        place.acquire("printed", &["--mesh", "printed.stl"]);
        place.ok(&["ingest"]);
        for surface in surfaces.into_iter().filter(|name| *name != "foam").chain(["printed"]) {
            let twin: serde_json::Value = serde_json::from_str(&place.ok(&["twin", surface, "--json"])).expect("JSON");
            let bands = twin["bands"].as_array().expect("bands");
            assert_eq!(bands.len(), 6);
            for band in bands {
                let off = ["mean_db", "rms_db"].map(|value| band[value].as_f64().expect(surface).abs());
                assert!(off.iter().all(|db| *db <= 0.02) && band["pairs"] == 10, "{surface}: {band}");
            }
        }
    }
}
