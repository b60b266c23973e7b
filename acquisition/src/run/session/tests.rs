//! Whole runs of the small rig: stopped, resumed, and ended.

use std::sync::atomic::{AtomicBool, Ordering};

use echolake_panel::PanelSpecimen;
use echolake_panel::relief::PanelRelief;

use super::*;
use crate::run::recorder::Held;
use crate::run::simulate::run_simulation;
use crate::run::{RunRequest, resume_run};
use echolake_recording::prove_file;

const SMALL_RIG: &str = include_str!("../../../../tests/fixtures/small_rig.toml");
const PAIRS: u64 = 45;

fn run<'a>(rig: &'a Rig, specimen: &'a PanelSpecimen, folder: &'a Path) -> RunRequest<'a> {
    let start = Timestamp(1_767_600_000_000_000_000);
    RunRequest::new(rig, "flat".parse().expect("an id"), specimen, start, folder)
}

fn flat() -> PanelSpecimen {
    PanelSpecimen::Relief(PanelRelief::by_name("flat").expect("a relief"))
}

#[test]
fn a_run_that_is_stopped_is_gone_on_with() {
    let (rig, specimen) = (Rig::from_toml(SMALL_RIG).expect("a rig"), flat());
    let folder = tempfile::tempdir().expect("a folder");
    let mut left = Vec::new();
    let mut partial: Option<PathBuf> = None;
    loop {
        let (control, mut tried) = (RunControl::default(), 0);
        let mut observe = |event: RunEvent<'_>| {
            tried += usize::from(matches!(event, RunEvent::Pair(_)));
            control.stop.store(tried >= 20, Ordering::Relaxed);
        };
        let session = RunSession {
            control: &control,
            observe: &mut observe,
            tap: None,
            preflight: PreflightMode::Check,
            checkpoint_every: Some(7),
            pace: TakePace::Fast,
        };
        let measured = match &partial {
            None => run(&rig, &specimen, folder.path()).measure_run(session),
            Some(partial) => resume_run(partial, session),
        };
        let measured = measured.expect("a session");
        left.push(measured.outcome.left);
        if measured.outcome.left == 0 {
            assert_eq!((measured.outcome.end.accepted, measured.outcome.end.rejected), (PAIRS, 0));
            assert_eq!(prove_file(&measured.path), Ok(()));
            assert_eq!(Held::from_file(&measured.path).expect("the run").accepted_count() as u64, PAIRS);
            break;
        }
        assert!(measured.path.extension().is_some_and(|e| e == "partial"), "{measured:?}");
        partial = Some(measured.path);
    }
    assert_eq!(left, [25, 5, 0]);
    let names = std::fs::read_dir(folder.path()).expect("listed").count();
    assert_eq!(names, 1, "nothing else is left");
}

#[test]
fn a_run_that_nobody_goes_on_with_is_ended_where_it_is_stopped() {
    let (rig, specimen) = (Rig::from_toml(SMALL_RIG).expect("a rig"), flat());
    let folder = tempfile::tempdir().expect("a folder");
    let stop = AtomicBool::new(false);
    let measured = run_simulation(&run(&rig, &specimen, folder.path()), Origin::Simulated, &stop, &mut |done| {
        stop.store(done >= 3, Ordering::Relaxed);
    });
    let (path, end) = measured.expect("a run");
    assert!(path.extension().is_some_and(|e| e == "mcap"), "{}", path.display());
    assert!((3..=4).contains(&end.accepted), "{end:?}");
    assert_eq!(prove_file(&path), Ok(()));
}
