//! Ctrl-C and SIGTERM at the first moment at which a user could send them: when a command has just announced itself.
//! The parent ignores Ctrl-C, as shells do for background jobs and some build services for all they start.

use std::process::Command;

use echolake_testing::ChildProcess;

use super::{ECHOLAKE, TestFolder, stderr};

const SIGNALS: [&str; 2] = ["INT", "TERM"];

/// Starts the command by a shell that ignores Ctrl-C, and waits for a line of it.
fn start_ignoring_interrupts(place: &TestFolder, args: &[&str], line: &str) -> ChildProcess {
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' INT; exec \"$0\" \"$@\"", ECHOLAKE, "--lake", "lake"]).args(args);
    command.current_dir(place.path("")).env_remove("ECHOLAKE_LAKE");
    let mut child = ChildProcess::start(&mut command).expect("a shell");
    child.wait_for_line(line);
    child
}

/// Signals the command behind that line; it must end with this code, and say this.
fn check(place: &TestFolder, args: &[&str], line: &str, code: i32, expected: &str) {
    for signal in SIGNALS {
        let mut child = start_ignoring_interrupts(place, args, line);
        child.signal(signal);
        let output = child.wait();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(code), "SIG{signal} {args:?}: {said}");
        assert!(said.contains(expected), "SIG{signal} {args:?}: expected `{expected}` in: {said}");
    }
}

#[test]
fn the_demo_can_be_stopped_while_it_serves() {
    let place = TestFolder::new();
    check(&place, &["demo", "--surfaces", "2", "--ir-only", "--rig", "rig.toml"], "http://", 0, "clean place");
}

#[test]
fn a_second_signal_ends_at_once() {
    let place = TestFolder::new();
    // A take an hour: the current pair does not end.
    let acquire = ["acquire", "--surface", "flat", "--rig", "rig.toml", "--pace", "3600"];
    for (signal, code) in SIGNALS.into_iter().zip([130, 143]) {
        let mut child = start_ignoring_interrupts(&place, &acquire, "simulated rig");
        child.signal("INT");
        child.wait_for_line("stopping after the current pair");
        child.signal(signal);
        assert_eq!(child.wait().status.code(), Some(code), "SIG{signal}");
    }
}

mod slow {
    use super::*;

    #[test]
    fn whoever_announces_itself_can_be_stopped() {
        let place = TestFolder::new();
        place.acquire("flat", &["--ir-only"]);
        place.ok(&["ingest"]);
        let any = "127.0.0.1:0";
        check(&place, &["replay", "flat", "--listen", any], "ws://", 0, "recordings");
        let serve = ["serve", "--listen", any, "--flight-sql", any, "--postgres", any];
        check(&place, &serve, "lake", 0, "answers may go on");
        check(&place, &["ingest", "--watch"], "watching", 0, "clean place");
        let acquire = ["acquire", "--surface", "foam", "--rig", "rig.toml", "--pace", "1", "--live", any];
        check(&place, &acquire, "simulated rig", 0, "pairs left; nothing that was measured is lost");
        // More surfaces than are measured before the signal comes, however late it is.
        let demo = ["demo", "--surfaces", "2000", "--ir-only", "--rig", "rig.toml"];
        check(&place, &demo, "simulated rig", 1, "run the same command again to resume");
    }
}
