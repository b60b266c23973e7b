//! `echolake twin`: a run beside the one that is computed for its mesh.

use super::TestFolder;

mod slow {
    use super::*;

    #[test]
    fn a_twin_is_computed_once_labelled_and_near_to_its_surface() {
        let place = TestFolder::new();
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("stretcher_bond", "3"), ("wood", "4")] {
            place.acquire(surface, &["--seed", seed]);
        }
        place.ok(&["ingest"]);
        // Levels have uncertainties, but Flat over itself has none.
        let uncertain = |surface: &str| {
            place.number(&format!("select max(tnce_band_10000_u_db) from tnce where surface_id = '{surface}'"))
        };
        assert!((1e-4..1.0).contains(&uncertain("stretcher_bond")), "{}", uncertain("stretcher_bond"));
        assert!(uncertain("flat") < 1e-4, "{}", uncertain("flat"));

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
}
