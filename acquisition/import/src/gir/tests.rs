//! Folders of the data set's form, of three pairs: whole ones are read back, damaged ones leave nothing.

use std::fs::File;

use echolake_schema::messages::ImpulseResponse;
use echolake_schema::{Timestamp, topics};
use mcap::MessageStream;
use ndarray_npy::NpzWriter;
use prost::Message as _;

use super::*;

const SAMPLES: usize = 400;
const CELSIUS: [f64; 3] = [20.5, 21.5, 22.5];

/// Three points, thus three pairs.
fn rig() -> Rig {
    let points = "[grid]\npoints_mm = [[0.0, 0.0, 124.0], [150.0, 0.0, 124.0], [0.0, 150.0, 304.0]]\n";
    Rig::from_toml(&format!("impulse_response.length = {SAMPLES}\n{points}")).expect("a rig")
}

struct GirFolders {
    _root: tempfile::TempDir,
    gir: PathBuf,
    inbox: PathBuf,
}

impl GirFolders {
    fn new() -> Self {
        let root = tempfile::tempdir().expect("a folder");
        let [gir, inbox] = ["gir", "inbox"].map(|name| root.path().join(name));
        for folder in [&gir, &inbox] {
            std::fs::create_dir(folder).expect("a folder");
        }
        Self { _root: root, gir, inbox }
    }

    fn surface(&self, name: &str, matrix: &Array2<f32>, celsius: &[f64]) {
        let mut npz = NpzWriter::new(File::create(self.gir.join(name)).expect("a file"));
        npz.add_array("matrix", matrix).expect("written");
        npz.add_array("temperatures", &Array1::from(celsius.to_vec())).expect("written");
        npz.finish().expect("closed");
    }

    fn import(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<ImportedRun>, Error> {
        let options =
            ImportOptions { started: Timestamp(1_767_600_000_000_000_000), folder: &self.inbox, project: None };
        import_gir(&self.gir, &rig(), options, progress)
    }

    fn left(&self) -> Vec<String> {
        let entries = std::fs::read_dir(&self.inbox).expect("a folder").flatten();
        let mut names: Vec<_> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

fn matrix() -> Array2<f32> {
    Array2::from_shape_fn((3, SAMPLES), |(row, n)| (row * SAMPLES + n) as f32 / 1e4)
}

#[test]
fn responses_come_back_as_they_were() {
    let place = GirFolders::new();
    place.surface("a.npz", &matrix(), &CELSIUS);
    let runs = place.import(&mut |_, _| {}).expect("imported");
    assert_eq!((runs.len(), runs[0].measurements, runs[0].surface.as_str()), (1, 3, "a"));
    assert_eq!(place.left(), [format!("{}.mcap", runs[0].run_id)]);
    let file = std::fs::read(&runs[0].path).expect("the run");
    let messages = MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let of_irs = messages.filter(|m| m.channel.topic == topics::IR);
    let irs: Vec<_> = of_irs.map(|m| ImpulseResponse::decode(&m.data[..]).expect("a response")).collect();
    assert_eq!(irs.len(), 3);
    for (row, ir) in irs.iter().enumerate() {
        assert_eq!((ir.pair_id, ir.temperature_c, ir.temperature_corrected), (row as u32, CELSIUS[row], true));
        assert_eq!(ir.samples, matrix().row(row).to_vec());
    }
}

#[test]
fn rows_are_in_the_order_of_the_visits() {
    let place = GirFolders::new();
    place.surface("a.npz", &matrix(), &CELSIUS);
    // The first row is the pair of points 1 and 2, which the grid counts last.
    let order = "combination,mic_layer,mic_x,mic_y,speaker_layer,speaker_x,speaker_y\n\
                 1,0,1,0,0,2,0\n2,0,0,0,0,2,0\n3,0,0,0,0,1,0\n";
    std::fs::write(place.gir.join("combinations.csv"), order).expect("written");
    let runs = place.import(&mut |_, _| {}).expect("imported");
    let file = std::fs::read(&runs[0].path).expect("the run");
    let messages = MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let of_irs = messages.filter(|m| m.channel.topic == topics::IR);
    let first: Vec<_> = of_irs
        .map(|m| ImpulseResponse::decode(&m.data[..]).expect("a response"))
        .map(|ir| (ir.pair_id, ir.samples[0]))
        .collect();
    assert_eq!(first, [(2, 0.0), (1, 0.04), (0, 0.08)]);
}

#[test]
fn what_is_wrong_is_named_and_nothing_is_left() {
    let refused = |name: &str, damage: &dyn Fn(&GirFolders), expected: &str| {
        let place = GirFolders::new();
        // The first surface is good: it must not be left behind alone.
        place.surface("a.npz", &matrix(), &CELSIUS);
        damage(&place);
        let error = place.import(&mut |_, _| {}).expect_err(expected).to_string();
        assert!(error.contains(expected) && error.contains(name), "{error}");
        assert!(place.left().is_empty(), "{expected}: {:?}", place.left());
    };
    let with = |at: (usize, usize), x: f32| {
        let mut broken = matrix();
        broken[at] = x;
        broken
    };
    let rows = Array2::<f32>::zeros((4, SAMPLES));
    refused("b.npz", &|p| p.surface("b.npz", &rows, &CELSIUS), "4 x 400, expected 3 rows of at least 400 samples");
    let columns = Array2::<f32>::zeros((3, SAMPLES - 1));
    refused("b.npz", &|p| p.surface("b.npz", &columns, &CELSIUS), "3 x 399, expected 3 rows");
    refused("b.npz", &|p| p.surface("b.npz", &with((1, 7), f32::NAN), &CELSIUS), "matrix[1, 7]");
    refused("b.npz", &|p| p.surface("b.npz", &matrix(), &[20.0, 20.0, f64::NAN]), "temperatures[2]");
    refused("b.npz", &|p| p.surface("b.npz", &matrix(), &CELSIUS[..2]), "2 values, expected 3");
    refused("b.npz", &|p| std::fs::write(p.gir.join("b.npz"), "PK, but not really").expect("written"), "matrix");
    let heights = |p: &GirFolders| {
        let mut npz = NpzWriter::new(File::create(p.gir.join("a_mat.npz")).expect("a file"));
        npz.add_array("surface", &Array2::<f64>::zeros((5, 4))).expect("written");
        npz.finish().expect("closed");
    };
    refused("a_mat.npz", &heights, "5 x 4");
    let far = |p: &GirFolders| {
        let order = "combination,mic_layer,mic_x,mic_y,speaker_layer,speaker_x,speaker_y\n1,0,0,0,0,9,0\n";
        std::fs::write(p.gir.join("combinations.csv"), order).expect("written");
    };
    refused("combinations.csv", &far, "line 2");
    refused("gir", &|p| std::fs::remove_file(p.gir.join("a.npz")).expect("removed"), "no .npz file");
    refused("gir", &|p| std::fs::remove_dir_all(&p.gir).expect("removed"), "cannot read");
}

#[test]
fn no_run_has_its_name_before_all_are_whole() {
    let place = GirFolders::new();
    place.surface("a.npz", &matrix(), &CELSIUS);
    place.surface("b.npz", &matrix(), &CELSIUS);
    let mut seen = Vec::new();
    let runs = place.import(&mut |done, _| seen.push((done, place.left()))).expect("imported");
    for (done, names) in seen {
        assert_eq!(names.len(), done);
        assert!(names.iter().all(|n| n.ends_with(".mcap.partial")), "{names:?}");
    }
    assert_eq!(runs.len(), 2);
    assert_eq!(place.left(), runs.iter().map(|r| format!("{}.mcap", r.run_id)).collect::<Vec<_>>());
}
