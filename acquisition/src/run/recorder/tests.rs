//! A run is written, and read back by the mcap crate: every topic, attachment and checksum.

use std::collections::BTreeMap;

use echolake_schema::manifest::Origin;
use echolake_schema::messages::Verdict;
use echolake_schema::{PairId, RunId};
use foxglove::Decode;
use foxglove::messages as fg;
use mcap::read::{LinearReader, MessageStream, Options};
use mcap::records::Record;
use mcap::{McapResult, Summary};
use prost::Message as _;
use rs_opw_kinematics::glam;

use super::*;
use crate::rig::robots::Choreography;
use echolake_recording::{RecordingItem, RecordingReader};

const START: Timestamp = Timestamp(1_767_600_000_123_456_789);
const MICROPHONE_MM: [f64; 3] = [-187.5, 37.5, 124.0];
const SPEAKER_MM: [f64; 3] = [0.0, 0.0, 474.0];

fn heights() -> HeightField {
    HeightField::from_fn(585.0, 273, |x, y| 10.0 * (x / 50.0).sin() + y / 100.0)
}

fn sweep(samples: usize) -> SweepRecording {
    let channel = |seed: usize| (0..3 * samples).map(|i| ((i * 7919 + seed) % 251) as u8).collect::<Vec<_>>();
    SweepRecording {
        pair_id: 7,
        attempt: 2,
        sample_rate_hz: 96e3,
        sample_count: samples as u32,
        format: SampleFormat::S24le.into(),
        microphone: channel(1).into(),
        loopback: channel(2).into(),
        temperature_c: 21.25,
        ..Default::default()
    }
}

fn ir() -> ImpulseResponse {
    ImpulseResponse { pair_id: 7, attempt: 2, sample_rate_hz: 96e3, samples: vec![0.5, -0.25], ..Default::default() }
}

fn measurement() -> Measurement {
    Measurement { pair_id: 7, attempt: 2, verdict: Verdict::Accepted.into(), snr_db: 61.5, ..Default::default() }
}

fn ambient() -> AmbientSample {
    AmbientSample { temperature_c: 21.25, humidity_pct: 40.0, pressure_hpa: 960.0, outside_level_db: 31.0 }
}

/// Begins a run of Flat without its shape.
pub(crate) fn create_flat(
    path: &Path,
    rig: &Rig,
    started: Timestamp,
    plan: Option<BTreeMap<String, String>>,
) -> Recorder {
    let surface_id = "flat".parse().expect("an id");
    let run_id = RunId::compose(started, &surface_id, 1).expect("an id");
    let (software, rig_name) = (SOFTWARE.to_owned(), rig.name.clone());
    let manifest = RunManifest { run_id, surface_id, started, software, rig: rig_name, origin: Origin::Simulated };
    let surface = SurfaceRecord::default();
    Recorder::create(path, &RunStart { manifest: &manifest, rig, surface: &surface, relief: None, plan })
        .expect("a recorder")
}

/// Begins a run in `path` with a relief, and hands it to `record`.
fn begun<T>(path: &Path, record: impl FnOnce(Result<Recorder, Error>) -> T) -> T {
    let rig = Rig::paper();
    let manifest = RunManifest {
        run_id: "20260105T080000Z-flat-7c1e".parse().expect("valid"),
        surface_id: "flat".parse().expect("valid"),
        started: START,
        software: "echolake 0.1.0".into(),
        rig: rig.name.clone(),
        origin: Origin::Simulated,
    };
    let (heights, surface) = (heights(), SurfaceRecord { typology: "flat".into(), ..SurfaceRecord::default() });
    let mesh = Mesh::from_height_field(&heights, -30.0);
    let original = OriginalFile { name: "panel.glb", media_type: "model/gltf-binary", bytes: b"as it came" };
    let relief = Relief { heights: &heights, mesh: &mesh, original: Some(original) };
    record(Recorder::create(
        path,
        &RunStart { manifest: &manifest, rig: &rig, surface: &surface, relief: Some(relief), plan: None },
    ))
}

fn attempt(recorder: &mut Recorder, at: Timestamp, sweep: &SweepRecording) {
    recorder.poses(at, MICROPHONE_MM, SPEAKER_MM).expect("recorded");
    recorder.environment(at, &ambient()).expect("recorded");
    recorder.sweep(at, sweep).expect("recorded");
    recorder.ir(at, &ir()).expect("recorded");
    recorder.measurement(at, &measurement()).expect("recorded");
    recorder.log(at, LogLevel::Warning, "test", "a lorry passed").expect("recorded");
}

fn end() -> RunEnd {
    RunEnd { ended: START.plus_secs(12.3), accepted: 1, rejected: 0, attempts: 2 }
}

/// A whole run with one attempt, as bytes.
fn whole() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let finished = begun(&path, |recorder| {
        let mut recorder = recorder.expect("a recorder");
        attempt(&mut recorder, START.plus_secs(1.0), &sweep(1000));
        recorder.finish(&end()).expect("finished")
    });
    assert_eq!(finished, path);
    let names: Vec<_> = std::fs::read_dir(folder.path()).expect("a folder").flatten().map(|e| e.file_name()).collect();
    assert_eq!(names, ["run.mcap"], "nothing else is left");
    std::fs::read(path).expect("the file")
}

fn one<'a>(file: &'a [u8], topic: &str) -> mcap::Message<'a> {
    let messages: McapResult<Vec<_>> = MessageStream::new(file).expect("an MCAP file").collect();
    let mut found = messages.expect("whole").into_iter().filter(|m| m.channel.topic == topic);
    let message = found.next().expect(topic);
    assert!(found.next().is_none(), "one message of {topic}");
    message
}

fn own<M: RunMessage + Default>(file: &[u8], topic: &str) -> M {
    let message = one(file, topic);
    assert_eq!(message.channel.schema.as_ref().map(|s| s.name.as_str()), Some(M::FULL_NAME));
    M::decode(&message.data[..]).expect(topic)
}

fn shown<M: Decode>(file: &[u8], topic: &str) -> M {
    M::decode(&one(file, topic).data[..]).unwrap_or_else(|_| panic!("{topic} holds another message"))
}

#[test]
fn every_topic_has_its_schema_and_time() {
    let file = whole();
    let (start, later) = (START.0 as u64, START.plus_secs(1.0).0 as u64);
    let expected = BTreeMap::from([
        ("/tf", ("foxglove.FrameTransforms", later)),
        ("/panel/scene", ("foxglove.SceneUpdate", start)),
        ("/panel/points", ("foxglove.PointCloud", start)),
        ("/microphone/pose", ("foxglove.PoseInFrame", later)),
        ("/speaker/pose", ("foxglove.PoseInFrame", later)),
        ("/sweep", ("echolake.v1.SweepRecording", later)),
        ("/sweep/audio", ("foxglove.RawAudio", later)),
        ("/ir", ("echolake.v1.ImpulseResponse", later)),
        ("/environment", ("echolake.v1.AmbientSample", later)),
        ("/measurement", ("echolake.v1.Measurement", later)),
        ("/log", ("foxglove.Log", later)),
    ]);
    let mut seen = BTreeMap::new();
    for message in MessageStream::new(&file).expect("an MCAP file") {
        let message = message.expect("whole");
        let schema = message.channel.schema.clone().expect("a schema");
        assert_eq!((schema.encoding.as_str(), message.channel.message_encoding.as_str()), ("protobuf", "protobuf"));
        assert!(!schema.data.is_empty());
        assert_eq!(message.log_time, message.publish_time);
        seen.insert(message.channel.topic.clone(), (schema.name.clone(), message.log_time));
    }
    let seen: BTreeMap<_, _> = seen.iter().map(|(t, (s, at))| (t.as_str(), (s.as_str(), *at))).collect();
    assert_eq!(seen, expected);
}

#[test]
fn our_messages_come_back_as_they_were() {
    let file = whole();
    assert_eq!(own::<SweepRecording>(&file, topics::SWEEP), sweep(1000));
    assert_eq!(own::<ImpulseResponse>(&file, topics::IR), ir());
    assert_eq!(own::<Measurement>(&file, topics::MEASUREMENT), measurement());
    assert_eq!(own::<AmbientSample>(&file, topics::ENVIRONMENT), ambient());
}

#[test]
fn viewers_see_metres_and_frames() {
    let file = whole();
    let frames = shown::<fg::FrameTransforms>(&file, topics::TF).transforms;
    // Down the tree from the panel to a tool, the translations add up to where the controller said it stands.
    let position = |tool: &str| {
        let (mut at, mut frame) = ([0.0; 3], tool.to_owned());
        while frame != "panel" {
            let link = frames.iter().find(|t| t.child_frame_id == frame).expect("a parent");
            let t = link.translation.as_ref().expect("a translation");
            [t.x, t.y, t.z].iter().zip(&mut at).for_each(|(t, at)| *at += 1e3 * t);
            frame = link.parent_frame_id.clone();
        }
        at
    };
    let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
    assert!(near(position("microphone"), MICROPHONE_MM), "{:?}", position("microphone"));
    assert!(near(position("speaker"), SPEAKER_MM), "{:?}", position("speaker"));
    assert!(frames.iter().any(|t| t.parent_frame_id == "world" && t.child_frame_id == "panel"));

    let pose = shown::<fg::PoseInFrame>(&file, topics::MICROPHONE_POSE);
    let at = pose.pose.and_then(|p| p.position).expect("a position");
    assert!(pose.frame_id == "panel" && near([at.x, at.y, at.z], MICROPHONE_MM.map(|mm| mm / 1e3)), "{at:?}");

    let log = shown::<fg::Log>(&file, topics::LOG);
    assert_eq!(
        (log.level(), log.name.as_str(), log.message.as_str()),
        (fg::log::Level::Warning, "test", "a lorry passed")
    );
    let time = log.timestamp.expect("a time");
    assert_eq!((time.sec(), time.nsec()), (1_767_600_001, 123_456_789));
}

#[test]
fn arms_are_shown_where_their_joints_are_known() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let arms = Choreography::for_rig(&Rig::paper()).expect("a grid").expect("within reach");
    let at = START.plus_secs(1.0);
    begun(&path, |recorder| {
        let mut recorder = recorder.expect("a recorder");
        recorder.record_arms(START, arms.cell(), "simulated & <odd>").expect("recorded");
        recorder.poses(at, MICROPHONE_MM, SPEAKER_MM).expect("recorded");
        let stand = arms.pose_at(PairId(100)).expect("within reach");
        recorder.record_joints(at, &[stand.microphone, stand.speaker]).expect("recorded");
        recorder.finish(&end()).expect("finished");
    });
    let file = std::fs::read(&path).expect("the file");
    let description = one(&file, topics::ROBOT_DESCRIPTION);
    let schema = description.channel.schema.clone().expect("a schema");
    assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("std_msgs/msg/String", "ros2msg"));
    assert_eq!(description.channel.message_encoding, "cdr");
    let urdf = std::str::from_utf8(&description.data[8..description.data.len() - 1]).expect("text");
    assert!(urdf.contains("<robot name=\"simulated _ _odd_\">"), "{urdf}");

    // Every link but the world has one frame in `/tf`, and every frame one parent, up to the world.
    let frames = shown::<fg::FrameTransforms>(&file, topics::TF).transforms;
    let links: Vec<_> = urdf.split("<link name=\"").skip(1).filter_map(|l| l.split('"').next()).collect();
    assert_eq!((links.len(), frames.len()), (18, 17));
    for link in links.iter().filter(|l| **l != "world") {
        assert_eq!(frames.iter().filter(|f| f.child_frame_id == *link).count(), 1, "{link}");
    }
    assert!(frames.iter().all(|f| links.contains(&f.parent_frame_id.as_str())));

    let grid = Rig::paper().build_grid().expect("a grid");
    let pair = grid.pairs()[100];
    let joints = [topics::MICROPHONE_JOINTS, topics::SPEAKER_JOINTS].map(|t| shown::<fg::JointStates>(&file, t).joints);
    for (tool, point, joints) in [("microphone", pair.microphone, &joints[0]), ("speaker", pair.speaker, &joints[1])] {
        assert_eq!(joints.len(), 6);
        assert!(joints.iter().all(|j| urdf.contains(&format!("<joint name=\"{}\"", j.name))));
        let (mut at, mut frame) = (glam::DVec3::ZERO, tool.to_owned());
        while frame != "world" {
            let link = frames.iter().find(|f| f.child_frame_id == frame).expect("a parent");
            let (t, q) = (link.translation.as_ref().expect("there"), link.rotation.as_ref().expect("there"));
            at = glam::DQuat::from_xyzw(q.x, q.y, q.z, q.w) * at + glam::DVec3::new(t.x, t.y, t.z);
            frame = link.parent_frame_id.clone();
        }
        let wanted = glam::DVec3::from_array(grid.points()[point.index()].position_mm) / 1e3;
        assert!(at.distance(wanted + glam::DVec3::new(0.0, 0.0, 0.8)) < 1e-6, "{tool} at {at}");
    }
}

#[test]
fn the_panel_is_shown_as_model_and_as_points() {
    let file = whole();
    let scene = shown::<fg::SceneUpdate>(&file, topics::PANEL_SCENE);
    let [entity] = &scene.entities[..] else { panic!("{} entities", scene.entities.len()) };
    let [model] = &entity.models[..] else { panic!("{} models", entity.models.len()) };
    assert!(entity.frame_locked && entity.frame_id == "panel" && model.media_type == "model/gltf-binary");
    assert_eq!(&model.data[..4], b"glTF");

    let cloud = shown::<fg::PointCloud>(&file, topics::PANEL_POINTS);
    let points: Vec<[f64; 3]> = cloud
        .data
        .chunks_exact(cloud.point_stride as usize)
        .map(|p| [0, 4, 8].map(|i| 1e3 * f64::from(f32::from_le_bytes([p[i], p[i + 1], p[i + 2], p[i + 3]]))))
        .collect();
    assert!((10_000..=20_000).contains(&points.len()), "{}", points.len());
    let heights = heights();
    for [x, y, z] in points {
        // The points are cells' centres, in f32 metres.
        assert!((heights.height_at(x, y) - z).abs() < 1e-3, "{z} at {x}, {y}");
    }
}

#[test]
fn attachments_and_metadata_come_back_as_they_were() {
    let file = whole();
    let summary = Summary::read(&file).expect("a summary").expect("it is there");
    let attachments: BTreeMap<_, _> = summary
        .attachment_indexes
        .iter()
        .map(|index| (index.name.clone(), mcap::read::attachment(&file, index).expect("whole").data.into_owned()))
        .collect();
    let names: Vec<_> = attachments.keys().map(String::as_str).collect();
    assert_eq!(names, ["heights.f32", "original-panel.glb", "panel.glb", "rig.toml", "surface.json"]);
    assert_eq!(attachments["original-panel.glb"], b"as it came");
    assert_eq!(&attachments["panel.glb"][..4], b"glTF");
    let rig = String::from_utf8(attachments["rig.toml"].clone()).expect("text");
    assert_eq!(Rig::from_toml(&rig), Ok(Rig::paper()));
    let surface: SurfaceRecord = serde_json::from_slice(&attachments["surface.json"]).expect("JSON");
    assert_eq!(surface.typology, "flat");
    let stored: Vec<f32> =
        attachments["heights.f32"].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    assert_eq!(stored, heights().heights_mm());

    let metadata: BTreeMap<_, _> = summary
        .metadata_indexes
        .iter()
        .map(|index| mcap::read::metadata(&file, index).map(|m| (m.name, m.metadata)).expect("whole"))
        .collect();
    let run = RunManifest::from_metadata(&metadata[topics::RUN_METADATA]).expect("a manifest");
    assert_eq!((run.run_id.as_str(), run.started), ("20260105T080000Z-flat-7c1e", START));
    assert_eq!(RunEnd::from_metadata(&metadata[topics::RUN_END_METADATA]), Ok(end()));
}

#[test]
fn records_are_chunked_checked_and_in_order() {
    let file = whole();
    let records: McapResult<Vec<_>> = LinearReader::new(&file).expect("an MCAP file").collect();
    let records = records.expect("whole");
    let Some(Record::Header(header)) = records.first() else { panic!("no header first") };
    assert_eq!(
        (header.profile.as_str(), header.library.as_str()),
        ("", concat!("echolake ", env!("CARGO_PKG_VERSION")))
    );
    assert!(
        matches!(&records[1], Record::Metadata(m) if m.name == topics::RUN_METADATA),
        "what the run is comes first"
    );
    let data_end = records.iter().position(|r| matches!(r, Record::DataEnd(_))).expect("an end of the data");
    assert!(matches!(&records[data_end - 1], Record::Metadata(m) if m.name == topics::RUN_END_METADATA));
    for record in &records {
        match record {
            Record::Message { .. } => panic!("a message outside of the chunks"),
            Record::Chunk { header, .. } => {
                assert!(header.compression == "zstd" && header.uncompressed_crc != 0, "{header:?}");
            }
            Record::Attachment { crc, header, .. } => assert_ne!(*crc, 0, "{}", header.name),
            Record::DataEnd(end) => assert_ne!(end.data_section_crc, 0),
            Record::Footer(footer) => assert!(footer.summary_start > 0 && footer.summary_crc != 0),
            _ => {}
        }
    }
    let summary = Summary::read(&file).expect("a summary").expect("it is there");
    let statistics = summary.stats.expect("statistics");
    assert_eq!((statistics.message_count, statistics.channel_count, statistics.metadata_count), (11, 11, 2));
    assert!(summary.chunk_indexes.iter().all(|c| !c.message_index_offsets.is_empty()));
}

#[test]
fn a_flipped_bit_is_noticed() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("flipped.mcap");
    let file = whole();
    let summary = Summary::read(&file).expect("a summary").expect("it is there");
    for chunk in &summary.chunk_indexes {
        let mut flipped = file.clone();
        flipped[(chunk.chunk_start_offset + chunk.chunk_length / 2) as usize] ^= 0x10;
        std::fs::write(&path, &flipped).expect("written");
        assert!(echolake_recording::prove_file(&path).is_err(), "the chunk at {}", chunk.chunk_start_offset);
    }
}

#[test]
fn a_message_of_any_size_stands_in_one_chunk() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let long = sweep(1_000_000);
    begun(&path, |recorder| {
        let mut recorder = recorder.expect("a recorder");
        for second in 1..=3 {
            attempt(&mut recorder, START.plus_secs(f64::from(second)), &long);
        }
        recorder.finish(&end()).expect("finished");
    });
    let file = std::fs::read(path).expect("the file");
    let sweeps: Vec<_> = MessageStream::new(&file)
        .expect("an MCAP file")
        .map(|m| m.expect("whole"))
        .filter(|m| m.channel.topic == topics::SWEEP)
        .collect();
    assert_eq!(sweeps.len(), 3);
    assert!(sweeps.iter().all(|m| SweepRecording::decode(&m.data[..]).expect("a sweep") == long));
}

// A copy of the file at that moment is what a power cut leaves.
#[test]
fn what_a_checkpoint_has_passed_survives() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    begun(&path, |recorder| {
        let mut recorder = recorder.expect("a recorder");
        attempt(&mut recorder, START.plus_secs(1.0), &sweep(1000));
        recorder.checkpoint().expect("on the disk");
        attempt(&mut recorder, START.plus_secs(2.0), &sweep(1000));
        let left = std::fs::read(recorder.partial()).expect("the partial file");
        let messages = MessageStream::new_with_options(&left, Options::IgnoreEndMagic.into()).expect("an MCAP file");
        let verdicts: Vec<_> =
            messages.map_while(|m| m.ok()).filter(|m| m.channel.topic == topics::MEASUREMENT).collect();
        assert_eq!(verdicts.len(), 1, "the first attempt, and not the second");
    });
    assert!(!path.exists(), "a run that was not finished has no name");
    let kept = std::fs::read(partial_of(&path)).expect("what there is of it is kept");
    let messages: McapResult<Vec<_>> =
        MessageStream::new_with_options(&kept, Options::IgnoreEndMagic.into()).expect("an MCAP file").collect();
    let verdicts = messages.expect("whole").iter().filter(|m| m.channel.topic == topics::MEASUREMENT).count();
    assert_eq!(verdicts, 2, "a recorder that is dropped writes what it holds");
}

#[test]
fn a_sealed_run_waits_for_its_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let sealed = begun(&path, |recorder| recorder.expect("a recorder").seal(&end()).expect("sealed"));
    assert!(!path.exists() && sealed.path() == path);
    std::fs::write(&path, "someone else's").expect("written");
    let error = sealed.publish().expect_err("the name is taken").to_string();
    assert!(error.contains("run.mcap` is there already"), "{error}");
    assert_eq!(std::fs::read(&path).expect("the file"), b"someone else's");
    assert!(partial_of(&path).exists());
}

#[test]
fn a_place_that_cannot_be_written_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let check = |path: &Path, expected: &str| {
        let error = begun(path, |recorder| recorder.map(drop)).expect_err(expected).to_string();
        assert!(error.contains(expected) && error.contains(&path.display().to_string()), "{error}");
    };
    check(&folder.path().join("nowhere/run.mcap"), "cannot create");
    std::fs::write(folder.path().join("file"), "").expect("written");
    check(&folder.path().join("file/run.mcap"), "cannot create");
    let taken = folder.path().join("taken.mcap");
    std::fs::write(&taken, "").expect("written");
    check(&taken, "is there already; hint: a run is never overwritten");
    let half = folder.path().join("half.mcap");
    std::fs::write(partial_of(&half), "").expect("written");
    check(&half, "half.mcap.partial` is there already");
    assert!(std::fs::read(partial_of(&half)).expect("read").is_empty(), "someone else's recording is left alone");
}

#[test]
fn a_recording_that_cannot_be_begun_leaves_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let full = |recorder: &mut Recorder| Err(recorder.failed("no space left".into()));
    let error = Recorder::begin(&path, full).map(drop).expect_err("refused").to_string();
    assert!(error.contains("cannot create") && error.contains("no space left"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0, "nothing is left");
    begun(&path, |recorder| recorder.map(drop)).expect("nothing is in the way of another try");
}

#[test]
fn a_run_without_a_folder_cannot_be_finished() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let error = begun(&path, |recorder| {
        let recorder = recorder.expect("a recorder");
        std::fs::remove_dir_all(folder.path()).expect("removed");
        recorder.finish(&end()).expect_err("nowhere to stand").to_string()
    });
    assert!(error.contains("cannot write") && error.contains(&path.display().to_string()), "{error}");
}

#[test]
fn audio_is_the_upper_16_bits() {
    let check = |format: SampleFormat, microphone: Vec<u8>, expected: [i16; 2]| {
        let recording = SweepRecording { format: format.into(), microphone: microphone.into(), ..Default::default() };
        let bytes: Vec<u8> = expected.iter().flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(top_16_bits(&recording), bytes, "{format:?}");
    };
    check(SampleFormat::S16le, vec![0x34, 0x12, 0xFE, 0xFF], [0x1234, -2]);
    check(SampleFormat::S24le, vec![0xFF, 0x34, 0x12, 0x00, 0xFE, 0xFF], [0x1234, -2]);
    check(SampleFormat::S24Split, vec![9, 9, 0x34, 0x12, 0xFE, 0xFF], [0x1234, -2]);
    check(SampleFormat::S32le, vec![0xFF, 0xFF, 0x34, 0x12, 0, 0, 0xFE, 0xFF], [0x1234, -2]);
    let floats = |a: f32, b: f32| [a.to_le_bytes(), b.to_le_bytes()].concat();
    // Beyond full scale, floats are held there; between two steps, the nearer counts.
    check(SampleFormat::F32le, floats(-1.5, 1.0), [i16::MIN, i16::MAX]);
    check(SampleFormat::F32le, floats(1.6 / 32_767.0, -1.6 / 32_767.0), [2, -2]);
}

/// The topics in each chunk, in the file's order.
fn topics_of_chunks(file: &[u8]) -> Vec<std::collections::BTreeSet<String>> {
    let summary = Summary::read(file).expect("a summary").expect("it is there");
    let mut chunks = summary.chunk_indexes.clone();
    chunks.sort_by_key(|c| c.chunk_start_offset);
    let name = |id: &u16| summary.channels[id].topic.clone();
    chunks.iter().map(|c| c.message_index_offsets.keys().map(name).collect()).collect()
}

// Three attempts of 1.6 MB, so that chunks end for their size between the two checkpoints.
#[test]
fn heavy_topics_have_chunks_of_their_own_before_their_verdicts() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    begun(&path, |recorder| {
        let mut recorder = recorder.expect("a recorder");
        for second in 1..=3 {
            attempt(&mut recorder, START.plus_secs(f64::from(second)), &sweep(200_000));
        }
        recorder.checkpoint().expect("on the disk");
        attempt(&mut recorder, START.plus_secs(4.0), &sweep(1_000));
        recorder.finish(&end()).expect("finished");
    });
    let file = std::fs::read(path).expect("the file");
    let chunks = topics_of_chunks(&file);
    let of = |topic: &str| chunks.iter().filter(|c| c.contains(topic)).count();
    assert_eq!((of(topics::SWEEP), of(topics::IR), of(topics::MEASUREMENT)), (4, 2, 2), "{chunks:?}");
    for chunk in &chunks {
        let parts: std::collections::BTreeSet<_> = chunk.iter().map(|t| ChunkLane::from_topic(t)).collect();
        assert_eq!(parts.len(), 1, "{chunk:?}");
    }
    // Whatever byte the file is cut at: what is read has no verdict without its sweep and its response.
    let cut_off = folder.path().join("cut.mcap");
    for cut in (0..file.len()).step_by(file.len() / 41) {
        std::fs::write(&cut_off, &file[..cut]).expect("written");
        let Ok(mut walk) = RecordingReader::open(&cut_off) else { continue };
        let (mut names, mut seen) = (BTreeMap::new(), std::collections::BTreeSet::new());
        while let Some(item) = walk.next_item().expect("readable") {
            let RecordingItem::Chunk(chunk) = item else { continue };
            for record in chunk.records {
                match record {
                    Record::Channel(channel) => drop(names.insert(channel.id, channel.topic)),
                    Record::Message { header, .. } => {
                        seen.insert((names[&header.channel_id].clone(), header.log_time));
                    }
                    _ => {}
                }
            }
        }
        for (_, at) in seen.iter().filter(|(topic, _)| topic == topics::MEASUREMENT) {
            let is_there = |topic: &&str| seen.contains(&((*topic).to_owned(), *at));
            assert!([topics::SWEEP, topics::IR, topics::TF].iter().all(is_there), "cut at {cut}");
        }
    }
}

#[test]
fn a_checkpoint_after_every_pair_makes_no_small_chunks_in_the_end() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    begun(&path, |recorder| {
        let mut recorder = recorder.expect("a recorder");
        for second in 0..100 {
            attempt(&mut recorder, START.plus_secs(f64::from(second)), &sweep(1_000));
            recorder.checkpoint().expect("on the disk");
        }
        recorder.finish(&end()).expect("finished");
    });
    assert_eq!(echolake_recording::prove_file(&path), Ok(()));
    let file = std::fs::read(&path).expect("the file");
    let chunks = topics_of_chunks(&file);
    assert!(chunks.len() < 8, "{}", chunks.len());
    let summary = Summary::read(&file).expect("a summary").expect("it is there");
    let statistics = summary.stats.expect("statistics");
    let counts: Vec<_> = statistics.channel_message_counts.values().copied().filter(|n| *n > 1).collect();
    assert_eq!(counts, [100; 9]);
    let names: Vec<_> = std::fs::read_dir(folder.path()).expect("a folder").flatten().map(|e| e.file_name()).collect();
    assert_eq!(names, ["run.mcap"], "nothing else is left");
}
