//! SOFA files of another make than our export's: what is taken of them, and what is wrong with them by name.

use echolake_schema::messages::ImpulseResponse;
use echolake_schema::topics;
use hdf5_pure::{AttrValue, FileBuilder};
use prost::Message as _;

use super::*;

const LENGTH: usize = 512;

/// Three points, thus three pairs.
fn rig() -> Rig {
    let points = "[grid]\npoints_mm = [[0.0, 0.0, 124.0], [150.0, 0.0, 124.0], [0.0, 150.0, 304.0]]\n";
    Rig::from_toml(&format!("impulse_response.length = 384\n{points}")).expect("a rig")
}

/// Name, shape, numbers and attributes of a variable.
type WrittenVariable = (&'static str, Vec<usize>, Vec<f64>, Vec<(&'static str, &'static str)>);

/// A file's content, to be changed before it is written.
struct SofaContent {
    texts: Vec<(&'static str, String)>,
    variables: Vec<WrittenVariable>,
}

impl SofaContent {
    /// Two pairs of the rig, positions of the speaker spherical, times the other way round.
    fn new() -> Self {
        let text = |name, value: &str| (name, value.to_owned());
        let away = 150f64.hypot(124.0) / 1e3;
        let elevation = 124f64.atan2(150.0).to_degrees();
        Self {
            texts: vec![
                text("Conventions", "SOFA"),
                text("SOFAConventions", "SingleRoomSRIR"),
                text("DataType", "FIR"),
                text("APIName", "somebody"),
                text("Title", "for people, with spaces"),
            ],
            variables: vec![
                ("Data.IR", vec![2, 1, LENGTH], (0..2 * LENGTH).map(|i| i as f64 / 1e4).collect(), vec![]),
                ("Data.SamplingRate", vec![1], vec![96_000.0], vec![("Units", "hertz")]),
                ("Data.Delay", vec![1, 1], vec![0.0], vec![]),
                ("ListenerPosition", vec![1, 3], vec![0.0, 0.0, 0.124], vec![("Type", "cartesian")]),
                (
                    "SourcePosition",
                    vec![2, 3],
                    [[0.0, elevation, away], [90.0, 304f64.atan2(150.0).to_degrees(), 150f64.hypot(304.0) / 1e3]]
                        .concat(),
                    vec![("Type", "spherical")],
                ),
                ("ReceiverPosition", vec![1, 3, 1], vec![0.0; 3], vec![]),
                ("RoomTemperature", vec![1], vec![294.65], vec![("Units", "kelvin")]),
                ("MeasurementDate", vec![2], vec![1_767_600_012.0, 1_767_600_000.0], vec![]),
            ],
        }
    }

    fn with(mut self, name: &str, shape: &[usize], values: &[f64]) -> Self {
        let found = self.variables.iter_mut().find(|v| v.0 == name).expect("a variable");
        (found.1, found.2) = (shape.to_vec(), values.to_vec());
        self
    }

    /// Adds a variable, or replaces it, with its attributes.
    fn put(mut self, variable: WrittenVariable) -> Self {
        self.variables.retain(|v| v.0 != variable.0);
        self.variables.push(variable);
        self
    }

    fn without(mut self, name: &str) -> Self {
        self.variables.retain(|v| v.0 != name);
        self
    }

    fn text(mut self, name: &str, value: &str) -> Self {
        self.texts.iter_mut().find(|t| t.0 == name).expect("an attribute").1 = value.to_owned();
        self
    }

    fn write(&self, path: &Path) {
        let mut file = FileBuilder::new();
        for (name, value) in &self.texts {
            file.set_attr(name, AttrValue::VarLenString(value.clone()));
        }
        for (name, shape, values, attributes) in &self.variables {
            let shape: Vec<u64> = shape.iter().map(|n| *n as u64).collect();
            let dataset = file.create_dataset(name).with_f64_data(values).with_shape(&shape);
            for (key, value) in attributes {
                dataset.set_attr(key, AttrValue::VarLenString((*value).to_owned()));
            }
        }
        file.write(path).expect("written");
    }
}

struct SofaFolder(tempfile::TempDir);

impl SofaFolder {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a folder"));
        std::fs::create_dir(place.inbox()).expect("a folder");
        place
    }

    fn inbox(&self) -> PathBuf {
        self.0.path().join("inbox")
    }

    fn import(&self, made: &[(&str, SofaContent)], celsius: Option<f64>) -> Result<Vec<ImportedRun>, Error> {
        let files: Vec<_> = made
            .iter()
            .map(|(name, made)| {
                let path = self.0.path().join(name);
                made.write(&path);
                path
            })
            .collect();
        let (started, inbox) = (Timestamp(1_767_700_000_000_000_000), self.inbox());
        let options = ImportOptions { started, folder: &inbox, project: None };
        let celsius = celsius.map(|c| Celsius::new(c).expect("a temperature"));
        import_sofa(&files, &rig(), celsius, options, &mut |_, _| {})
    }
}

fn irs(run: &ImportedRun) -> Vec<(u64, ImpulseResponse)> {
    let file = std::fs::read(&run.path).expect("the run");
    let messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let of_irs = messages.filter(|m| m.channel.topic == topics::IR);
    of_irs.map(|m| (m.log_time, ImpulseResponse::decode(&m.data[..]).expect("a response"))).collect()
}

#[test]
fn responses_of_others_come_at_their_own_temperature_and_in_the_order_of_time() {
    let place = SofaFolder::new();
    let runs = place.import(&[("0007_1.sofa", SofaContent::new())], None).expect("imported");
    assert_eq!((runs.len(), runs[0].measurements, runs[0].surface.as_str()), (1, 2, "0007_1"));
    let irs = irs(&runs[0]);
    assert_eq!(irs.iter().map(|(time, _)| *time / 1_000_000_000).collect::<Vec<_>>(), [1_767_600_000, 1_767_600_012]);
    // Points 0 and 2, then 0 and 1: as the rig counts its pairs.
    let grid = rig().build_grid().expect("a grid");
    let pair = |speaker: usize| grid.parse_pair(&grid.points()[0], &grid.points()[speaker]).expect("a pair").0;
    assert_eq!(irs.iter().map(|(_, ir)| ir.pair_id).collect::<Vec<_>>(), [pair(2), pair(1)]);
    for (number, (_, ir)) in irs.iter().enumerate() {
        assert_eq!((ir.temperature_c, ir.temperature_corrected), (21.5, false));
        let first = (1 - number) * LENGTH;
        let expected: Vec<f32> = (first..first + LENGTH).map(|i| (i as f64 / 1e4) as f32).collect();
        assert_eq!(ir.samples, expected);
    }
}

#[test]
fn what_a_file_does_not_tell_is_made_up_and_said() {
    let place = SofaFolder::new();
    let silent = || SofaContent::new().without("MeasurementDate").without("RoomTemperature").without("Data.Delay");
    // 0 kelvin is with what tools fill what nobody measured.
    let zero = SofaContent::new().with("RoomTemperature", &[1], &[0.0]);
    for run in place.import(&[("a.sofa", silent()), ("zero.sofa", zero)], None).expect("imported") {
        let [note] = run.notes.as_slice() else { panic!("{:?}", run.notes) };
        assert!(note.starts_with("no temperature is known of 2 responses: 20 C, the reference's"), "{note}");
        assert!(irs(&run).iter().all(|(_, ir)| ir.temperature_c == 20.0));
    }
    let runs = place.import(&[("b.sofa", silent())], Some(18.0)).expect("imported");
    let irs = irs(&runs[0]);
    assert!(irs[0].0 < irs[1].0 && irs[0].0 >= 1_767_700_000_000_000_000);
    assert_eq!(irs[0].1.temperature_c, 18.0);
}

#[test]
fn a_given_temperature_overrides_the_files() {
    let place = SofaFolder::new();
    let zero = SofaContent::new().with("RoomTemperature", &[1], &[0.0]);
    let foreign = ("RoomTemperature", vec![1], vec![70.0], vec![("Units", "fahrenheit")]);
    let made = [("a.sofa", zero), ("b.sofa", SofaContent::new().put(foreign)), ("c.sofa", SofaContent::new())];
    let runs = place.import(&made, Some(18.0)).expect("imported");
    assert!(runs.iter().all(|run| irs(run).iter().all(|(_, ir)| ir.temperature_c == 18.0)));
    // Only what somebody may have measured is worth a word.
    let said = |run: &ImportedRun| run.warnings.iter().any(|w| w.contains("RoomTemperature is 21.5 C; taken as 18 C"));
    assert_eq!(runs.iter().map(said).collect::<Vec<_>>(), [false, false, true]);
}

#[test]
fn units_of_positions_are_honoured() {
    let place = SofaFolder::new();
    let cartesian = |units| vec![("Type", "Cartesian"), ("Units", units)];
    let metres =
        SofaContent::new().put(("ListenerPosition", vec![1, 3], vec![0.0, 0.0, 0.124], cartesian("meter"))).put((
            "SourcePosition",
            vec![2, 3],
            vec![0.15, 0.0, 0.124, 0.0, 0.15, 0.304],
            cartesian("metre, metre, metre"),
        ));
    let millimetres = SofaContent::new()
        .put(("ListenerPosition", vec![1, 3], vec![0.0, 0.0, 124.0], cartesian("millimetre")))
        .put(("SourcePosition", vec![2, 3], vec![15.0, 0.0, 124.0, 0.0, 15.0, 304.0], cartesian("cm, cm, mm")));
    let runs = place.import(&[("a.sofa", metres), ("b.sofa", millimetres)], None).expect("imported");
    let pairs = |run| irs(run).iter().map(|(_, ir)| ir.pair_id).collect::<Vec<_>>();
    assert_eq!(pairs(&runs[0]), pairs(&runs[1]));
    assert!(runs.iter().all(|run| run.warnings.is_empty()));
    // Without units they are metres, and that is said.
    let runs = place.import(&[("c.sofa", SofaContent::new())], None).expect("imported");
    assert!(runs[0].warnings.iter().any(|w| w.contains("ListenerPosition has no attribute Units")), "{:?}", runs[0]);
}

// Receivers and emitters turn with their listener and source, and come in the file's order.
/// E28: GeneralFIR-E has the layout of SingleRoomMIMOSRIR.
#[test]
fn responses_of_several_receivers_and_emitters() {
    let place = SofaFolder::new();
    let metres = || vec![("Type", "cartesian"), ("Units", "metre")];
    // In the file, samples lie between receivers and emitters.
    let value = |receiver: usize, emitter: usize, sample: usize| (receiver * 2 + emitter) as f64 + sample as f64 / 1e3;
    let of_receiver = |r: usize| (0..LENGTH).flat_map(move |n| (0..2).map(move |e| value(r, e, n)));
    let mimo = |convention| {
        SofaContent::new()
            .text("SOFAConventions", convention)
            .text("DataType", "FIR-E")
            .put(("Data.IR", vec![1, 1, LENGTH, 2], of_receiver(0).collect(), vec![]))
            .put(("Data.Delay", vec![1, 1, 1], vec![0.0], vec![]))
            .put(("SourcePosition", vec![1, 3], vec![0.0, 0.0, 0.124], metres()))
            // To the left and up of a source that looks along y: its left is -x.
            .put(("SourceView", vec![1, 3], vec![0.0, 2.0, 0.0], metres()))
            .put(("SourceUp", vec![1, 3], vec![0.0, 0.5, 3.0], vec![]))
            .put(("EmitterPosition", vec![2, 3, 1], vec![0.15, 0.0, 0.18, 0.0, -0.15, 0.0], metres()))
            .without("MeasurementDate")
    };
    let files = [("a.sofa", mimo("SingleRoomMIMOSRIR")), ("b.sofa", mimo("GeneralFIR-E"))];
    let runs = place.import(&files, None).expect("imported");
    let grid = rig().build_grid().expect("a grid");
    let pair = |speaker: usize| grid.parse_pair(&grid.points()[0], &grid.points()[speaker]).expect("a pair").0;
    assert_eq!(runs.len(), 2);
    for found in runs.iter().map(irs) {
        assert_eq!(found.iter().map(|(_, ir)| ir.pair_id).collect::<Vec<_>>(), [pair(2), pair(1)]);
        for (emitter, (_, ir)) in found.iter().enumerate() {
            assert!(ir.samples.iter().enumerate().all(|(n, x)| *x == value(0, emitter, n) as f32), "{emitter}");
        }
    }
}

#[test]
fn spectra_become_responses() {
    let place = SofaFolder::new();
    let bins = LENGTH / 2 + 1;
    // An impulse at sample 3, as its spectrum.
    let phase = |k: usize| -std::f64::consts::TAU * (3 * k) as f64 / LENGTH as f64;
    let spectrum = |part: fn(f64) -> f64| (0..bins).map(|k| part(phase(k))).collect::<Vec<_>>();
    let frequencies = |highest: f64| (0..bins).map(|k| highest * k as f64 / (bins - 1) as f64).collect::<Vec<_>>();
    let of_convention = |convention, highest: f64| {
        SofaContent::new()
            .text("SOFAConventions", convention)
            .text("DataType", "TF")
            .without("Data.IR")
            .without("Data.SamplingRate")
            .without("Data.Delay")
            .without("MeasurementDate")
            .put(("Data.Real", vec![1, 1, bins], spectrum(f64::cos), vec![]))
            .put(("Data.Imag", vec![1, 1, bins], spectrum(f64::sin), vec![]))
            .put(("N", vec![bins], frequencies(highest), vec![("Units", "hertz")]))
            .put(("SourcePosition", vec![1, 3], vec![0.0, 0.15, 0.304], vec![]))
    };
    let made = |highest: f64| of_convention("FreeFieldDirectivityTF", highest);
    let names = ["d.sofa", "e.sofa"];
    let others = ["GeneralTF", "SimpleFreeFieldHRTF"].map(|convention| of_convention(convention, 48e3));
    let files: Vec<_> = [("a.sofa", made(48e3))].into_iter().chain(names.into_iter().zip(others)).collect();
    let runs = place.import(&files, None).expect("imported");
    assert_eq!(runs.len(), 3);
    for run in &runs {
        let samples = &irs(run)[0].1.samples;
        assert!(samples.iter().enumerate().all(|(n, x)| (x - if n == 3 { 1.0 } else { 0.0 }).abs() < 1e-6));
    }
    let error = place.import(&[("b.sofa", made(24e3))], None).expect_err("another rate").to_string();
    assert!(error.contains("b.sofa") && error.contains("N: frequencies up to 24000 Hz"), "{error}");
    let imaginary = made(48e3).put(("Data.Imag", vec![1, 1, bins], vec![0.5; bins], vec![]));
    let error = place.import(&[("c.sofa", imaginary)], None).expect_err("no response").to_string();
    assert!(error.contains("Data.Imag[0, 0, 0]: 5e-1, expected 0"), "{error}");
}

#[test]
fn what_is_wrong_is_named_and_nothing_is_left() {
    let refused = |made: SofaContent, expected: &str| {
        let place = SofaFolder::new();
        // The first file is good: it must not be left behind alone.
        let error = place.import(&[("good.sofa", SofaContent::new()), ("b.sofa", made)], None).expect_err(expected);
        let error = error.to_string();
        assert!(error.contains(expected) && error.contains("b.sofa"), "{error}");
        assert_eq!(std::fs::read_dir(place.inbox()).expect("a folder").count(), 0, "{expected}");
    };
    refused(
        SofaContent::new().text("SOFAConventions", "SimpleHeadphoneIR"),
        "`SimpleHeadphoneIR`, expected one of SingleRoomSRIR, SingleRoomMIMOSRIR",
    );
    refused(SofaContent::new().text("DataType", "TF"), "expected `FIR`");
    refused(SofaContent::new().without("Data.IR"), "Data.IR: it is missing");
    refused(
        SofaContent::new().with("Data.IR", &[2, 2, LENGTH], &vec![0.0; 4 * LENGTH]),
        "receiver 1: a second response",
    );
    refused(SofaContent::new().with("Data.IR", &[2, LENGTH], &vec![0.0; 2 * LENGTH]), "measurements x receivers");
    refused(SofaContent::new().with("Data.IR", &[2, 1, 100], &[0.0; 200]), "100 samples");
    let mut broken = vec![0.0; 2 * LENGTH];
    broken[LENGTH + 7] = f64::NAN;
    refused(SofaContent::new().with("Data.IR", &[2, 1, LENGTH], &broken), "Data.IR[1, 0, 7]");
    refused(SofaContent::new().with("Data.SamplingRate", &[1], &[48_000.0]), "48000 Hz, expected the rig's 96000 Hz");
    refused(SofaContent::new().with("Data.Delay", &[1, 1], &[12.0]), "Data.Delay: 12");
    refused(SofaContent::new().with("ReceiverPosition", &[1, 3, 1], &[0.0, 0.09, 0.0]), "ReceiverPosition[0]");
    let foreign = |units| ("ListenerPosition", vec![1, 3], vec![0.0; 3], vec![("Units", units)]);
    refused(SofaContent::new().put(foreign("foot")), "ListenerPosition, its attributes: units `foot`, expected metre");
    refused(SofaContent::new().put(foreign("metre, metre")), "units `metre, metre`");
    let spherical = ("ReceiverPosition", vec![1, 3, 1], vec![1.0; 3], vec![("Type", "spherical harmonics")]);
    refused(SofaContent::new().put(spherical), "type `spherical harmonics`, expected cartesian or spherical");
    let rate = ("Data.SamplingRate", vec![1], vec![96.0], vec![("Units", "furlong")]);
    refused(SofaContent::new().put(rate), "units `furlong`, expected hertz");
    refused(SofaContent::new().with("ListenerPosition", &[1, 3], &[0.0, 0.0, 0.2]), "the nearest is");
    refused(SofaContent::new().with("ListenerPosition", &[5, 3], &[0.0; 15]), "[5, 3], expected [2, 3] or [1, 3]");
    let same = [0.0, 124f64.atan2(150.0).to_degrees(), 150f64.hypot(124.0) / 1e3];
    refused(SofaContent::new().with("SourcePosition", &[1, 3], &same), "a second response of its pair");
    refused(SofaContent::new().with("RoomTemperature", &[1], &[20.0]), "RoomTemperature");
    refused(SofaContent::new().with("RoomTemperature", &[1], &[20.0]), "--temperature-c says");
    refused(SofaContent::new().with("MeasurementDate", &[2], &[-1.0, 1.0]), "seconds since 1970");
    let place = SofaFolder::new();
    let path = place.0.path().join("text.sofa");
    std::fs::write(&path, "no HDF5 at all").expect("written");
    let error = check_sofa(&[path], &rig(), None).expect_err("text").to_string();
    assert!(error.contains("no HDF5 file") && error.contains("text.sofa"), "{error}");
    let error = check_sofa(&[place.0.path().join("none.sofa")], &rig(), None).expect_err("none").to_string();
    assert!(error.contains("cannot read") && error.contains("No such file"), "{error}");
}
