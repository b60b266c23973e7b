//! `campaign run`: files of surfaces that become runs, rows and tables; the paper's panels.

use std::collections::BTreeSet;

use serde_json::Value;

use super::TestFolder;

const CAMPAIGN: &str = "name = \"joints\"\nabout = \"Joints on one shape.\"\nrig = \"rig.toml\"\n\
    [[surfaces]]\nname = \"0015_1\"\n[[surfaces]]\nname = \"0012_1\"\n\
    [[surfaces]]\nname = \"deep\"\nrelief = \"0012_1\"\nparameters = { joint_depth_mm = 40 }\nruns = 2\n\
    [[expected]]\nsurface = \"deep\"\nrelative_to = \"0015_1\"\nlevels_db = { 40000 = -1.84, total = -0.62 }\n\
    source = \"a guess\"\n";

#[test]
fn campaigns_that_cannot_be_run_are_refused_before_there_is_a_lake() {
    let place = TestFolder::new();
    place.fails(2, &["campaign", "run"], "<FILE>");
    place.fails(1, &["campaign", "run", "none.toml"], "cannot read campaign `none.toml`");
    for (from, to, expected) in [
        ("runs = 2", "rnus = 2", "campaign `joints.toml`: TOML parse error"),
        ("runs = 2", "rnus = 2", "unknown field `rnus`"),
        ("relief = \"0012_1\"", "relief = \"marble\"", "`relief` of surface `deep`: `marble` is no relief; hint: flat"),
        ("40000 =", "80000 =", "has a band `80000`, expected one of the rig's; hint: 2500"),
        ("rig.toml", "rag.toml", "cannot read rig file `rag.toml`"),
    ] {
        std::fs::write(place.path("joints.toml"), CAMPAIGN.replace(from, to)).expect("written");
        place.fails(1, &["campaign", "run", "joints.toml"], expected);
        assert!(!place.path("lake").exists(), "{to}");
    }
}

mod slow {
    use super::*;

    // On a small rig: that they can be run, and have what they compare.
    #[test]
    fn the_papers_experiments_can_be_run() {
        let place = TestFolder::new();
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/campaigns");
        let mut compared = BTreeSet::new();
        for (name, tables) in [("mortar", 2), ("macrostructure", 1), ("stone_and_brick", 2)] {
            let file = format!("{folder}/{name}.toml");
            let json = place.ok(&["campaign", "run", &file, "--rig", "rig.toml", "--ir-only", "--json"]);
            let report: Value = serde_json::from_str(&json).expect("JSON");
            let found = report["tables"].as_array().expect("tables");
            assert_eq!(found.len(), tables, "{name}: {report}");
            let rows = found.iter().flat_map(|table| table["rows"].as_array().expect("rows"));
            compared.extend(rows.map(|row| row["surface"].as_str().expect("text").to_owned()));
        }
        let compared: Vec<_> = compared.iter().map(String::as_str).collect();
        assert_eq!(compared, ["0005_1", "0011_1", "0012_1", "0013_1", "0015_0", "0015_1", "0031_0", "flat"]);
    }

    #[test]
    fn a_campaign_measures_what_is_missing_and_prints_tables() {
        let place = TestFolder::new();
        std::fs::write(place.path("joints.toml"), CAMPAIGN).expect("written");
        let run = ["campaign", "run", "joints.toml", "--ir-only"];
        let printed = place.ok(&run);
        assert!(printed.starts_with("joints\nJoints on one shape.\n"), "{printed}");
        let [over_flat, over_shape] = ["dB re Flat total\n", "dB relative to 0015_1, expected in brackets\n"];
        assert!(
            printed.contains(over_flat) && printed.contains(over_shape) && printed.contains("expected: a guess"),
            "{printed}"
        );
        assert!(!printed.contains('\x1b'), "no colours where nobody sees them");
        let runs = place.sql("select surface_id, count(*) as runs from runs group by 1 order by 1");
        let runs: Vec<_> =
            runs.iter().map(|r| format!("{} {}", r["surface_id"].as_str().expect("text"), r["runs"])).collect();
        assert_eq!(runs, ["0012_1 1", "0015_1 1", "deep 2", "flat 1", "foam 1"]);
        let references = place.sql("select surface_id, macro_reference from surfaces order by 1");
        let references: Vec<_> = references.iter().map(|r| r["macro_reference"].as_str()).collect();
        assert_eq!(references, [Some("0015_1"), None, Some("0015_1"), None, None]);

        // The second time there is nothing to measure, and the numbers are those of the documented query.
        let report: Value = serde_json::from_str(&place.ok(&[&run[..], &["--json"]].concat())).expect("JSON");
        assert_eq!(place.number("select count(*) from runs"), 6.0);
        let tables = report["tables"].as_array().expect("tables");
        let named: Vec<_> = tables.iter().map(|table| table["relative_to"].as_str()).collect();
        assert_eq!(named, [None, Some("0015_1")]);
        let rows = tables[1]["rows"].as_array().expect("rows");
        let surfaces: Vec<_> = rows.iter().map(|row| row["surface"].as_str().expect("text")).collect();
        assert_eq!(surfaces, ["0012_1", "deep"]);
        assert_eq!(rows[1]["expected_db"]["total"], -0.62);
        let expected = place.number(
            "select s.p90_mean_db - m.p90_mean_db from surface_stats s join surfaces u on u.surface_id = s.surface_id \
             join surface_stats m on m.surface_id = u.macro_reference and m.band = s.band \
             where s.surface_id = '0012_1' and s.band = 'total'",
        );
        let level = rows[0]["levels_db"]["total"].as_f64().expect("a level");
        assert!((level - expected).abs() < 1e-9, "{level} {expected}");

        // Of another campaign only what is new is measured.
        std::fs::write(place.path("more.toml"), CAMPAIGN.replace("name = \"deep\"", "name = \"deeper\""))
            .expect("written");
        place.fails(1, &["campaign", "run", "more.toml"], "expected a surface of the campaign");
        std::fs::write(place.path("more.toml"), CAMPAIGN.replace("\"deep\"", "\"deeper\"")).expect("written");
        place.ok(&["campaign", "run", "more.toml", "--ir-only"]);
        assert_eq!(place.number("select count(*) from runs"), 8.0);
    }

    #[test]
    fn panels_of_the_paper_are_made_by_name() {
        let place = TestFolder::new();
        let listed = place.ok(&["panel", "0012_1", "--list"]);
        assert!(listed.starts_with("0012_1 (panel of the paper: flemish_bond)\n  printed: Flemish bond"), "{listed}");
        assert!(listed.contains("\n  assumed: ") && listed.contains("\n  large shape alone: 0015_1"), "{listed}");
        assert!(place.ok(&["panel", "--list"]).contains("\n\n0072_0 (panel of the paper"));
        let list: Value = serde_json::from_str(&place.ok(&["panel", "--list", "--json"])).expect("JSON");
        let panels: Vec<_> =
            list.as_array().expect("a list").iter().filter_map(|r| r["panel"]["name"].as_str()).collect();
        assert_eq!(panels.len(), 8, "{panels:?}");
        place.ok(&["panel", "0012_1", "-o", "0012_1.json"]);
        let written: Value =
            serde_json::from_slice(&std::fs::read(place.path("0012_1.json")).expect("read")).expect("JSON");
        assert_eq!(
            (&written["relief"], &written["parameters"]["joint_width_mm"]),
            (&"flemish_bond".into(), &6.0.into())
        );

        place.acquire("0012_1", &["--ir-only"]);
        place.acquire("mine", &["--ir-only", "--panel", "flat", "--macro-reference", "0015_1"]);
        place.ok(&["ingest"]);
        let rows = place.sql("select typology, macro_reference from surfaces order by surface_id");
        assert_eq!(
            (&rows[0]["typology"], &rows[0]["macro_reference"]),
            (&"flemish_bond_bricks".into(), &"0015_1".into())
        );
        assert_eq!(rows[1]["macro_reference"], "0015_1");
    }
}
