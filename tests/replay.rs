//! Start and end of a replay by its users; the content that a viewer sees is tested beside the player.

use echolake_testing::ChildProcess;

use super::{TestFolder, stderr};

/// Replays until it listens, then ends it by Ctrl-C; its exit code, and what it said.
fn replayed(place: &TestFolder, runs: &[&str]) -> (Option<i32>, String) {
    replayed_at(place, "127.0.0.1:0", runs)
}

fn replayed_at(place: &TestFolder, address: &str, args: &[&str]) -> (Option<i32>, String) {
    let args = [&["replay", "--listen", address], args].concat();
    let mut replay = ChildProcess::start(&mut place.command(&args)).expect("the command starts");
    replay.wait_for_line("ws://");
    replay.signal("INT");
    let output = replay.wait();
    (output.status.code(), stderr(&output))
}

mod slow {
    use super::*;

    #[test]
    fn runs_are_named_in_every_way_and_damage_is_told() {
        let place = TestFolder::new();
        let path = place.acquire("flat", &["--seed", "1"]);
        place.ok(&["ingest"]);
        let run = place.sql("select run_id from runs")[0]["run_id"].as_str().expect("a name").to_owned();
        for name in ["flat", run.as_str(), &format!("lake/runs/flat/{run}.mcap")] {
            let (code, said) = replayed(&place, &[name]);
            assert_eq!(code, Some(0), "{name}: {said}");
            assert!(said.contains("1 recordings"), "{said}");
        }
        // A second one that was cut off is shown as far as it is whole; a third is none.
        let second = place.acquire("foam", &["--seed", "2"]);
        assert_ne!(path, second);
        let whole = std::fs::read(&second).expect("the run");
        std::fs::write(place.path("cut.mcap"), &whole[..whole.len() * 9 / 10]).expect("written");
        std::fs::write(place.path("none.mcap"), "nothing").expect("written");
        let (code, said) = replayed(&place, &["flat", "cut.mcap", "none.mcap"]);
        assert_eq!(code, Some(3), "{said}");
        assert!(said.contains("`cut.mcap` is not whole") && said.contains("`none.mcap`"), "{said}");

        place.fails(1, &["replay", "nobody"], "hint: there are surfaces flat");
        place.fails(1, &["replay", "none.mcap"], "none of the recordings can be replayed");
        place.fails(1, &["replay", "missing.mcap"], "missing.mcap");
        place.fails(2, &["replay", "flat", "--speed", "0"], "from 0.01");
        place.fails(2, &["replay"], "RUN");
        place.fails(2, &["replay", "flat", "--allow-origin", "viewer.example"], "scheme and host");

        let (_, said) = replayed(&place, &["flat"]);
        assert!(!said.contains("token") && said.contains("hint: a viewer on the web"), "{said}");
        let named = ["flat", "--allow-origin", "https://viewer.example/"];
        assert!(!replayed(&place, &named).1.contains("hint: a viewer on the web"));
        let (_, said) = replayed_at(&place, "0.0.0.0:0", &["flat"]);
        assert!(said.contains("/?token=") && !said.contains("warning: anyone"), "{said}");
        let (_, said) = replayed_at(&place, "0.0.0.0:0", &["flat", "--open"]);
        assert!(!said.contains("token") && said.contains("warning: anyone"), "{said}");
    }
}
