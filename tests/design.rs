//! `echolake design`, on the paper's rig and on a lake.

use serde_json::Value;

use super::TestFolder;

const WAVES: &str = "about = \"Waves\"\nrelief = \"macrostructure\"\npairs = 40\ncandidates = 16\nbest = 1\n\
                     [ranges]\nmacro_depth_mm = [20, 300]\n[bands.10000]\nscattering = 0.8\n";

fn design(place: &TestFolder, folder: &str, more: &[&str]) -> Value {
    let text = place.ok(&[&["design", "waves.toml", "-o", folder, "--json"], more].concat());
    serde_json::from_str(&text).expect("JSON")
}

mod slow {
    use super::*;

    #[test]
    fn panels_for_a_target_resumed_and_measured() {
        let place = TestFolder::new();
        std::fs::write(place.path("waves.toml"), WAVES).expect("written");
        let found = design(&place, "waves", &[]);
        let panel = &found["panels"][0];
        assert_eq!((&found["origin"], &panel["origin"]), (&"simulated".into(), &"simulated".into()));
        let goal = &panel["goals"][0];
        assert_eq!((&goal["target"], &goal["figure"]), (&0.8.into(), &"scattering, 10000 Hz".into()));
        // A tenth counts as 1 dB.
        assert!(panel["misfit"].as_f64().is_some_and(|misfit| misfit < 1.0), "{panel}");
        let whole = std::fs::read_to_string(place.path("waves/candidates.csv")).expect("candidates");
        assert!(
            whole.lines().count() > 10 && whole.lines().skip(1).all(|line| line.contains(",simulated,")),
            "{whole}"
        );
        for (file, part) in [("search.svg", "simulated"), ("best_1.svg", "simulated"), ("campaign.toml", "simulated")] {
            let text = std::fs::read_to_string(place.path("waves").join(file)).expect(file);
            assert!(text.contains(part), "{file}");
        }

        // A search that was cut off in a line ends as the whole one.
        let lines: Vec<&str> = whole.lines().collect();
        let cut = format!("{}\n{}", lines[..8].join("\n"), &lines[8][..9]);
        std::fs::write(place.path("waves/candidates.csv"), cut).expect("written");
        let again = design(&place, "waves", &[]);
        assert_eq!(again["panels"], found["panels"]);

        // Gaps lie away from all that was simulated.
        let next: Vec<Value> =
            serde_json::from_str(&place.ok(&["design", "waves.toml", "-o", "waves", "--next", "2", "--json"]))
                .expect("JSON");
        let bits: Vec<f64> = next.iter().filter_map(|panel| panel["information_bits"].as_f64()).collect();
        assert!(bits.len() == 2 && bits[0] >= bits[1] && bits[1] > 0.0, "{bits:?}");
        place.ok(&["panel", "--parameters", "waves/next_1.json", "-o", "next.json"]);

        place.fails(1, &["design", "waves.toml", "-o", "rig.toml"], "cannot make `rig.toml`");
        std::fs::write(place.path("waves.toml"), WAVES.replace("0.8", "0.7")).expect("written");
        place.fails(1, &["design", "waves.toml", "-o", "waves"], "line 2 is of another target, levels or rig");
        std::fs::write(place.path("waves/candidates.csv"), "a,b\n1,2\n").expect("written");
        place.fails(1, &["design", "waves.toml", "-o", "waves"], "its columns are another search's");
        let worn = whole.replacen(",simulated", ",x,simulated", 1);
        std::fs::write(place.path("waves/candidates.csv"), worn).expect("written");
        place.fails(1, &["design", "waves.toml", "-o", "waves"], "line 2 has 20 fields, expected 19");
    }

    #[test]
    fn targets_that_cannot_be_met() {
        let place = TestFolder::new();
        let levels_of = WAVES.replace("[ranges]", "levels_of = \"prd\"\n[ranges]");
        let flat = WAVES.replace("[ranges]", "greatest_depth_mm = 0.5\n[ranges]");
        for (text, expected) in [
            (levels_of.as_str(), "`levels_of` names surface `prd`, which the lake has no levels over Flat of"),
            (&flat, "none of 16 candidates can be printed"),
            ("relief = \"macrostructure\"", "missing field `ranges`"),
            (&WAVES.replace("macrostructure", "sand"), "`sand` is no relief"),
        ] {
            std::fs::write(place.path("waves.toml"), text).expect("written");
            let folder = format!("folder_{}", expected.len());
            place.fails(1, &["design", "waves.toml", "-o", &folder], expected);
            assert!(!place.path(&folder).join("best.json").exists());
        }
        place.fails(1, &["design", "none.toml", "-o", "none"], "cannot read target `none.toml`");
        assert!(!place.path("none").exists());
    }
}
