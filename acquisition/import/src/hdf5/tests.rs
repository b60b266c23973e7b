//! Sets of two microphones and two speakers, with their dimensions in every order.

use std::path::PathBuf;

use echolake_schema::messages::ImpulseResponse;
use echolake_schema::{Timestamp, topics};
use hdf5_pure::FileBuilder;
use prost::Message as _;

use super::*;

const LENGTH: usize = 400;
/// Two microphones, then two speakers.
const POINTS_MM: [[f64; 3]; 4] = [[0.0, 0.0, 124.0], [150.0, 0.0, 124.0], [0.0, 150.0, 304.0], [0.0, 300.0, 304.0]];

fn rig() -> Rig {
    Rig::from_toml(&format!("impulse_response.length = 384\ngrid.points_mm = {POINTS_MM:?}\n")).expect("a rig")
}

fn value(measurement: usize, microphone: usize, speaker: usize, sample: usize) -> f64 {
    (measurement * 4 + microphone * 2 + speaker) as f64 + sample as f64 / 1024.0
}

struct Hdf5Folder(tempfile::TempDir);

impl Hdf5Folder {
    /// A file with responses of these dimensions; the rest of the mapping can be changed.
    fn new(dimensions: &[&str], chunk: Option<&[u64]>) -> Self {
        let place = Self(tempfile::tempdir().expect("a folder"));
        std::fs::create_dir(place.inbox()).expect("a folder");
        let sizes = [("microphone", 2), ("speaker", 2), ("sample", LENGTH), ("measurement", 2)];
        let size = |name: &str| sizes.iter().find(|(of, _)| *of == name).expect("a dimension").1;
        let shape: Vec<usize> = dimensions.iter().map(|d| size(d)).collect();
        let number = |at: Vec<usize>| {
            let index = |name: &str| dimensions.iter().position(|d| *d == name).map_or(0, |axis| at[axis]);
            value(index("measurement"), index("microphone"), index("speaker"), index("sample"))
        };
        let numbers: Vec<f64> = (0..shape.iter().product()).map(|i| number(super::place_in_grid(i, &shape))).collect();
        let mut file = FileBuilder::new();
        let mut group = file.create_group("data");
        let stored_shape: Vec<u64> = shape.iter().map(|n| *n as u64).collect();
        let responses = group.create_dataset("responses").with_f64_data(&numbers).with_shape(&stored_shape);
        if let Some(chunk) = chunk {
            responses.with_chunks(chunk);
        }
        let mut put = |name: &str, shape: &[u64], numbers: &[f64]| {
            group.create_dataset(name).with_f64_data(numbers).with_shape(shape);
        };
        put("microphones", &[2, 3], &POINTS_MM[..2].concat().iter().map(|mm| mm / 1e3).collect::<Vec<_>>());
        // The speakers' coordinates are rows.
        let rows: Vec<f64> = (0..3).flat_map(|i| POINTS_MM[2..].iter().map(move |p| p[i])).collect();
        put("speakers", &[3, 2], &rows);
        put("rate", &[1], &[96e3]);
        put("kelvin", &[2], &[294.15, 295.15]);
        file.add_group(group.finish());
        file.write(place.file()).expect("written");
        place
    }

    fn file(&self) -> PathBuf {
        self.0.path().join("set.h5")
    }

    fn inbox(&self) -> PathBuf {
        self.0.path().join("inbox")
    }

    fn mapping(&self, dimensions: &[&str], change: (&str, &str)) -> PathBuf {
        let surfaces = if dimensions.contains(&"measurement") { "\"a\", \"b\"" } else { "\"a\"" };
        let text = format!(
            "file = \"set.h5\"\nsurfaces = [{surfaces}]\nsampling_rate = {{ dataset = \"data/rate\" }}\n\
             [responses]\ndataset = \"data/responses\"\ndimensions = {dimensions:?}\n\
             [microphones]\ndataset = \"/data/microphones\"\nunits = \"metre\"\n\
             [speakers]\ndataset = \"data/speakers\"\nunits = \"mm\"\n\
             [temperature]\ndataset = \"data/kelvin\"\nunits = \"kelvin\"\ndimensions = [\"speaker\"]\n"
        );
        assert!(text.contains(change.0), "{change:?}");
        let path = self.0.path().join("mapping.toml");
        std::fs::write(&path, text.replace(change.0, change.1)).expect("written");
        path
    }

    fn import(&self, mapping: &Path, celsius: Option<f64>) -> Result<Vec<ImportedRun>, Error> {
        let inbox = self.inbox();
        let options = ImportOptions { started: Timestamp(1_767_700_000_000_000_000), folder: &inbox, project: None };
        let celsius = celsius.map(|c| Celsius::new(c).expect("a temperature"));
        import_hdf5(mapping, &rig(), celsius, options, &mut |_, _| {})
    }
}

fn irs(run: &ImportedRun) -> Vec<ImpulseResponse> {
    let file = std::fs::read(&run.path).expect("the run");
    let messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let of_irs = messages.filter(|m| m.channel.topic == topics::IR);
    of_irs.map(|m| ImpulseResponse::decode(&m.data[..]).expect("a response")).collect()
}

#[test]
fn every_order_of_dimensions_is_the_same_set() {
    let orders: [(&[&str], Option<&[u64]>); 5] = [
        (&["microphone", "speaker", "sample"], None),
        (&["speaker", "microphone", "sample"], Some(&[1, 2, 100])),
        (&["sample", "speaker", "microphone"], Some(&[64, 2, 1])),
        (&["speaker", "sample", "measurement", "microphone"], None),
        (&["measurement", "microphone", "sample", "speaker"], Some(&[2, 1, 37, 2])),
    ];
    let grid = rig().build_grid().expect("a grid");
    for (dimensions, chunk) in orders {
        let place = Hdf5Folder::new(dimensions, chunk);
        let runs = place.import(&place.mapping(dimensions, ("", "")), None).expect("imported");
        assert_eq!(runs.len(), if dimensions.contains(&"measurement") { 2 } else { 1 });
        for (measurement, run) in runs.iter().enumerate() {
            assert_eq!((run.surface.as_str(), run.measurements), (["a", "b"][measurement], 4));
            let irs = irs(run);
            assert_eq!(irs.len(), 4);
            for microphone in 0..2 {
                for speaker in 0..2 {
                    let [m, s] = [microphone, 2 + speaker].map(|i| &grid.points()[i]);
                    let pair = grid.parse_pair(m, s).expect("a pair").0;
                    let ir = irs.iter().find(|ir| ir.pair_id == pair).expect("its response");
                    let expected: Vec<f32> =
                        (0..LENGTH).map(|n| value(measurement, microphone, speaker, n) as f32).collect();
                    assert_eq!(ir.samples, expected, "{dimensions:?}");
                    assert_eq!(ir.temperature_c, 21.0 + speaker as f64);
                    assert!(!ir.temperature_corrected);
                }
            }
        }
    }
}

#[test]
fn what_is_wrong_is_named_and_nothing_is_left() {
    let dimensions = ["speaker", "microphone", "sample"];
    let place = Hdf5Folder::new(&dimensions, None);
    let refused = |change: (&str, &str), expected: &str| {
        let error = place.import(&place.mapping(&dimensions, change), None).expect_err(expected).to_string();
        assert!(error.contains(expected), "expected `{expected}` in: {error}");
        assert_eq!(std::fs::read_dir(place.inbox()).expect("a folder").count(), 0, "{expected}");
    };
    refused(("set.h5", "none.h5"), "No such file");
    refused(("set.h5", "mapping.toml"), "it is no HDF5 file");
    refused(("[speakers]", "[loudspeakers]"), "line 10: unknown field `loudspeakers`");
    refused(("data/responses", "data/none"), "data/none: it is missing, expected one of ");
    refused(("data/responses", "data/rate"), "data/rate: shape [1], expected one number each of [speaker, micro");
    refused(("\"speaker\", \"microphone\"", "\"speaker\", \"speaker\""), "[speaker, speaker, sample]");
    refused(("\"microphone\", \"sample\"]", "\"sample\", \"microphone\"]"), "shape [2, 3], expected [400, 3]");
    refused(("{ dataset = \"data/rate\" }", "48000.0"), "sampling_rate: 48000 Hz, expected the rig's 96000 Hz");
    let attribute = "{ dataset = \"data/rate\", attribute = \"fs\" }";
    refused(("{ dataset = \"data/rate\" }", attribute), "attribute `fs` of data/rate");
    refused(("units = \"metre\"\n", ""), "units = \"metre\"` under [microphones]");
    refused(("\"mm\"", "\"metre\""), "data/speakers[0]");
    refused(("\"data/speakers\"\nunits = \"mm\"", "\"data/microphones\"\nunits = \"m\""), "pairs of the rig");
    refused(("[\"a\"]", "[\"a\", \"b\"]"), "surfaces: 2 names, expected 1, one per measurement");
    refused(("[\"a\"]", "[\"../a\"]"), "not a valid surface id");
    refused(("[\"speaker\"]\n", "[]\n"), "data/kelvin: shape [2], expected []");
    refused(("\"kelvin\"\nd", "\"celsius\"\nd"), "temperature (C) is 294.15");
    let without = place.mapping(&dimensions, ("[temperature]\ndataset = \"data/kelvin\"\nunits = \"kelvin\"\n", "#"));
    let text = std::fs::read_to_string(&without).expect("read").replace("#dimensions", "# dimensions");
    std::fs::write(&without, text).expect("written");
    // Nothing is corrected then, and the import says so.
    let runs = place.import(&without, None).expect("imported");
    let [note] = runs[0].notes.as_slice() else { panic!("{:?}", runs[0].notes) };
    assert!(note.starts_with("no temperature is known of 4 responses: 20 C, the reference's"), "{note}");
    assert!(irs(&runs[0]).iter().all(|ir| ir.temperature_c == 20.0));
    let runs = place.import(&without, Some(19.0)).expect("imported");
    assert!(irs(&runs[0]).iter().all(|ir| ir.temperature_c == 19.0));
}

#[test]
fn a_sample_that_is_no_number_leaves_nothing() {
    let dimensions = ["speaker", "microphone", "sample"];
    let place = Hdf5Folder::new(&dimensions, None);
    let mut bytes = std::fs::read(place.file()).expect("the file");
    let sample = value(0, 0, 1, 7).to_le_bytes();
    let at = bytes.windows(8).position(|eight| eight == sample).expect("the only such number");
    bytes[at..at + 8].copy_from_slice(&f64::INFINITY.to_le_bytes());
    std::fs::write(place.file(), bytes).expect("written");
    let error = place.import(&place.mapping(&dimensions, ("", "")), None).expect_err("infinite").to_string();
    assert!(error.contains("data/responses[1, 0, 7]: inf, expected a finite f32"), "{error}");
    assert_eq!(std::fs::read_dir(place.inbox()).expect("a folder").count(), 0);
}
