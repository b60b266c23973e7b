//! From the simulated rig to answers, and what the physics must be.

use super::TestFolder;

const PAIRS: f64 = 45.0;

// In a build with debug assertions, clap looks over the arguments of each.
#[test]
fn every_command_explains_itself() {
    let place = TestFolder::new();
    let help = place.ok(&["--help"]);
    let commands = |help: &str| -> Vec<String> {
        let listed = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
        let entries = listed.filter(|line| !line.starts_with("   "));
        entries.filter_map(|line| line.split_whitespace().next().map(str::to_owned)).collect()
    };
    let all = commands(&help);
    assert!(all.len() > 14 && all.iter().any(|name| name == "serve"), "{help}");
    for name in all.iter().filter(|name| *name != "help") {
        let own = place.ok(&[name, "--help"]);
        assert!(own.contains("Usage: echolake"), "{name}: {own}");
        for part in commands(&own).iter().filter(|part| *part != "help") {
            assert!(place.ok(&[name, part, "--help"]).contains("Usage: echolake"), "{name} {part}");
        }
    }
}

// A folder as the published data set has them, of the small rig's size.
#[test]
fn a_gir_folder_becomes_runs_with_references_of_their_own() {
    let place = TestFolder::new();
    let folder = place.path("gir");
    std::fs::create_dir(&folder).expect("made");
    let write = |surface: &str, gain: f64, rows: usize, columns: usize| {
        let matrix = ndarray::Array2::from_shape_fn((rows, columns), |(r, n)| {
            let direct = if n == 20 { 1.0 } else { 0.0 };
            let echo = if n == 60 + r % 7 { gain } else { 0.0 };
            (direct + echo) as f32
        });
        let file = std::fs::File::create(folder.join(format!("{surface}.npz"))).expect("a file");
        let mut npz = ndarray_npy::NpzWriter::new(file);
        npz.add_array("matrix", &matrix).expect("written");
        npz.add_array("temperatures", &ndarray::Array1::from_elem(rows, 21.5)).expect("written");
        npz.finish().expect("closed");
    };
    write("mean_flat_rfl_1", 0.5, 45, 400);
    write("mean_foam_1", 0.0, 45, 400);
    write("panel_0016_r180_0", 0.25, 45, 400);
    let info = "panel id,flat reference,foam reference,macrostructure reference,mesostructure reference,sand \
                type,binder type\npanel_0016_r180_0,mean_flat_rfl_1,mean_foam_1,mean_flat_rfl_1,Primitives,GS14,Furan\n\
                mean_flat_rfl_1,mean_flat_rfl_1,mean_foam_1,flat,Baseline_mean,GS14,Furan\n";
    std::fs::write(folder.join("panel_info.csv"), info).expect("written");
    place.ok(&["import", "gir", "gir", "--rig", "rig.toml"]);
    place.ok(&["ingest"]);
    let query =
        "select panel, side, flat_reference, macro_reference from surfaces where surface_id = 'panel_0016_r180_0'";
    let row = &place.sql(query)[0];
    assert_eq!(
        (&row["panel"], &row["side"], &row["flat_reference"]),
        (&"0016".into(), &0.into(), &"mean_flat_rfl_1".into())
    );
    assert_eq!(row["macro_reference"], "mean_flat_rfl_1");
    // Of what has no run nothing can be the difference.
    assert_eq!(place.number("select count(*) from surfaces where macro_reference is not null"), 1.0);
    // Half of Flat's amplitude is a quarter of its energy.
    let total = place.number("select avg(tnce_total) from tnce where surface_id = 'panel_0016_r180_0'");
    assert!((total - 0.25).abs() < 1e-4, "{total}");
    assert_eq!(place.number("select count(*) from measurements where source = 'corrected'"), 3.0 * PAIRS);

    write("panel_0001_0", 0.1, 44, 400);
    place.fails(1, &["import", "gir", "gir", "--rig", "rig.toml"], "matrix: 44 x 400, expected 45 rows");
    write("panel_0001_0", 0.1, 45, 383);
    place.fails(1, &["import", "gir", "gir", "--rig", "rig.toml"], "expected 45 rows of at least 384 samples");
    assert_eq!(
        std::fs::read_dir(place.path("lake/inbox")).expect("the inbox").count(),
        0,
        "nothing half-written stays"
    );
}

mod slow {
    use super::*;
    use std::path::Path;

    use crate::ECHOLAKE;
    use crate::acquire_kills::{self, AcquireKillCampaign, AcquireKillCounts};
    use crate::kills::KillCampaign;
    use crate::operators::OperatorCampaign;

    // The long form is the campaign `kills`.
    #[test]
    fn a_killed_ingest_is_repaired_by_running_it_again() {
        let outcome = KillCampaign::new(Path::new(ECHOLAKE), 1).rounds(4, &mut |_, _| {});
        assert!(outcome.killed > 0, "{outcome:?}");
    }

    // Its long form is the same campaign with `halves`.
    #[test]
    fn two_processes_ingest_half_of_the_runs_each() {
        KillCampaign::of(Path::new(ECHOLAKE), 1, 12).halves(2, &mut |_, _| {});
    }

    // The long form is the campaign `operators`.
    #[test]
    fn answers_after_what_people_do_to_a_lake_are_whole_or_errors() {
        let failures = OperatorCampaign::new(Path::new(ECHOLAKE), 1, None).rounds(5, &mut |_, _| {});
        let told: Vec<_> = failures.iter().map(ToString::to_string).collect();
        assert!(told.is_empty(), "{}", told.join("\n"));
    }

    #[test]
    fn acquires_whose_power_is_cut_lose_nothing_acknowledged() {
        let echolake = Path::new(ECHOLAKE);
        let Some(mut campaign) = AcquireKillCampaign::with_power_cuts(echolake, 7) else {
            return;
        };
        let outcome = campaign.kills(6, &mut |_| {});
        check_acknowledged(&outcome);
    }

    #[test]
    fn acquires_that_are_killed_lose_nothing_acknowledged() {
        let mut campaign = AcquireKillCampaign::new(Path::new(ECHOLAKE), 7);
        let outcome = campaign.kills(6, &mut |_| {});
        check_acknowledged(&outcome);
    }

    // A kill between a pair's checkpoint and its line keeps the pair and loses the line.
    fn check_acknowledged(outcome: &AcquireKillCounts) {
        assert_eq!(outcome.killed, 6);
        assert!(outcome.acknowledged + outcome.killed >= acquire_kills::PAIRS, "{outcome:?}");
    }

    #[test]
    fn references_complete_what_waits_and_the_physics_holds() {
        let place = TestFolder::new();
        place.acquire("wood", &["--seed", "3"]);
        place.fails(0, &["ingest"], "waits for reference flat, foam");
        assert_eq!(place.number("select count(*) from measurements"), PAIRS);
        assert_eq!(place.number("select count(*) from tnce"), 0.0);
        assert_eq!(place.sql("select state, missing from runs")[0]["state"], "waiting");

        place.acquire("flat", &["--seed", "1"]);
        place.acquire("foam", &["--seed", "2"]);
        // A second Foam run under a name of its own: what the first one does not explain is noise and drift.
        place.acquire("foam_2", &["--seed", "4"]);
        place.ok(&["ingest"]);
        assert_eq!(place.number("select count(*) from runs where state = 'complete' and missing = ''"), 4.0);
        assert_eq!(place.number("select count(*) from tnce"), 4.0 * PAIRS);
        assert_eq!(place.number("select count(*) from tnce_d4"), 4.0 * PAIRS * 8.0);
        assert_eq!(place.number("select count(*) from heightmaps"), 4.0 * 8.0);
        assert_eq!(place.number("select count(*) from surfaces where origin = 'simulated'"), 4.0);

        // Flat over itself is 1, and its bands sum to it.
        let off =
            "select max(abs(tnce_total - 1)) + max(abs(tnce_2500 + tnce_5000 + tnce_10000 + tnce_20000 + tnce_40000 - \
                1))
                   + max(abs(tnce_band_5000 - 1)) from tnce where surface_id = 'flat'";
        assert!(place.number(off) < 1e-4);
        // The second Foam run lies 25 dB under Flat at least, on the mean over the pairs.
        let foam = place.number("select 10 * log10(avg(tnce_total)) from tnce where surface_id = 'foam_2'");
        assert!(foam < -25.0, "{foam} dB");
        // Flat reflects 29.3 % less energy than Wood (Rust et al. 2021); the grid, noise, drift and Foam's own
        // reflection leave less than 2 %.
        let wood = place.number("select avg(tnce_total) from tnce where surface_id = 'wood'");
        let expected = 1.0 / (1.0 - 0.293);
        assert!((wood / expected - 1.0).abs() < 0.02, "{wood} {expected}");

        // The same runs again add nothing, and say so.
        let before = place.sql("select run_id, run_derivation, reference_derivation from runs order by run_id");
        let name = before[0]["run_id"].as_str().expect("a name").to_owned();
        place.fails(0, &["ingest", &name], "is in the lake already, nothing added");
        assert_eq!(place.sql("select run_id, run_derivation, reference_derivation from runs order by run_id"), before);
        let report: serde_json::Value = serde_json::from_str(&place.ok(&["doctor", "--json"])).expect("JSON");
        let findings = report["findings"].as_array().expect("a list");
        assert!(findings.iter().all(|f| f["severity"] == "note"), "{findings:?}");
        assert_eq!(report["runs"], 4);
    }

    #[test]
    fn a_second_flat_run_rewrites_its_dependants_and_a_lost_table_is_made_anew() {
        let place = TestFolder::new();
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("wavy", "3")] {
            place.acquire(surface, &["--seed", seed]);
        }
        place.ok(&["ingest"]);
        let version = |place: &TestFolder| place.sql("select distinct flat_version from nce where surface_id = 'wavy'");
        let first = version(&place);
        place.acquire("flat", &["--seed", "9"]);
        place.ok(&["ingest"]);
        let second = version(&place);
        assert_eq!(second.len(), 1, "only the new derivation is seen");
        assert_ne!(first, second);
        assert!(second[0]["flat_version"].as_str().expect("text").starts_with("flat:2:"), "{second:?}");
        let sum = "select sum(tnce_total) from tnce where surface_id = 'wavy'";
        let before = place.number(sum);
        // Tables can be deleted: the runs are the truth.
        std::fs::remove_dir_all(place.path("lake/tables")).expect("removed");
        place.ok(&["ingest"]);
        assert_eq!(place.number("select count(*) from measurements"), 4.0 * PAIRS);
        assert_eq!(place.number(sum), before);
    }

    #[test]
    fn answers_come_in_every_format_or_are_refused_clearly() {
        let place = TestFolder::new();
        place.acquire("flat", &[]);
        place.ok(&["ingest"]);
        for format in ["csv", "json", "parquet", "arrow", "table"] {
            let query = "select pair_id, ir from measurements order by pair_id";
            place.ok(&["sql", "--format", format, "-o", "answer", query]);
            assert!(std::fs::metadata(place.path("answer")).expect("written").len() > 1_000, "{format}");
        }
        let formulas = "select '=1+1' as \"@name\", '-x' as text, -1.5 as number, null as nothing";
        let plain = place.ok(&["sql", "--format", "csv", formulas]);
        assert_eq!(plain, "@name,text,number,nothing\n=1+1,-x,-1.5,\n");
        let escaped = place.ok(&["sql", "--format", "csv", "--escape-formulas", formulas]);
        assert_eq!(escaped, "'@name,text,number,nothing\n'=1+1,'-x,-1.5,\n");
        place.fails(2, &["sql", "--escape-formulas", formulas], "--format");
        place.fails(1, &["sql", "--format", "json", "--escape-formulas", formulas], "--format csv");
        place.fails(1, &["sql", "-o", "missing/answer", "select 1"], "cannot write");
        place.fails(1, &["sql", "selec 1"], "^");
        place.fails(1, &["sql", "drop table runs"], "only reading");
        place.fails(2, &["sql", "--format", "xml", "select 1"], "xml");
        let columns = place.ok(&["sql", "\\d surface_stats"]);
        let level = columns.lines().find(|line| line.starts_with("p90_mean_db ")).expect("a line per column");
        assert!(level.contains("dB re Flat total"), "{level}");
        let script = "\\d surface_stats\nselect ';' as a; -- two in a line\nselect x; select 3 as b;\n";
        std::fs::write(place.path("script.sql"), script.replace("select x", "select 2 as c") + "\\q\nselect x")
            .expect("written");
        let answers = place.ok(&["sql", "-f", "script.sql"]);
        assert!(answers.starts_with(&columns), "{answers}");
        let values = ["| ; |", "| 2 |", "| 3 |"].map(|value| answers.find(value).expect(value));
        assert!(values.is_sorted(), "{answers}");
        let failed = place.run(&["sql", "--format", "csv", &script.replace("\\d surface_stats", "")]);
        assert_eq!((failed.status.code(), failed.stdout.as_slice()), (Some(1), "a\n;\n".as_bytes()));
        let place_of_error = "statement 2 of 3: no column `x` (line 3, column 8)\n  select x\n         ^";
        assert!(crate::stderr(&failed).contains(place_of_error), "{}", crate::stderr(&failed));
        place.fails(1, &["sql", "-o", "answer", "select 1; select 2"], "the script has 2");
        place.fails(1, &["sql", "\\d nothing"], "no table `nothing`");
        place.fails(1, &["sql", "\\z"], "no command `\\z`");
        place.fails(1, &["sql", "--json", "\\d"], "--json");
    }
}
