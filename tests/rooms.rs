//! From WAV files to numbers and pictures without Flat, Foam and meshes: rooms of eight octaves, two pairs each.

use std::process::Command;

use serde_json::Value;

use super::serve::{http::HttpRequest, served};
use super::{TestFolder, web};

const RATE_HZ: usize = 48_000;
const HEADER: &str = "surface,recording,loopback,microphone,speaker,temperature_c\n";
const ROOM_RIG: &str = r#"
name = "rooms"
bands.centres_hz = [125, 250, 500, 1000, 2000, 4000, 8000, 16000]
[sweep]
rate_hz = 48000
low_hz = 20
high_hz = 20000
[impulse_response]
length = 24000
[grid]
points_mm = [[0, 0, 1000], [2000, 0, 1000], [0, 3000, 1000]]
"#;

/// An exponential sweep of a second from 20 Hz to 20 kHz, and a second of silence.
fn sweep() -> Vec<f64> {
    let octaves = 1000f64.ln();
    let sample = |n: usize| {
        let time = n as f64 / RATE_HZ as f64;
        0.5 * (std::f64::consts::TAU * 20.0 / octaves * ((time * octaves).exp() - 1.0)).sin()
    };
    (0..RATE_HZ).map(sample).chain(std::iter::repeat_n(0.0, RATE_HZ)).collect()
}

/// The sweep in a room: the direct sound, and 60 reflections that lose 60 dB in `decay_secs`.
fn record_room(sweep: &[f64], decay_secs: f64, direct_mm: f64) -> Vec<f64> {
    let direct = (direct_mm / 343e3 * RATE_HZ as f64) as usize;
    let mut recording = vec![0.0; sweep.len()];
    for reflection in 0..60usize {
        let delay = direct + reflection * 331 + reflection * reflection * 37 % 211;
        let sign = if reflection * 7 % 3 == 0 { -1.0 } else { 1.0 };
        let gain = sign * 0.3 * 10f64.powf(-3.0 * (delay - direct) as f64 / (decay_secs * RATE_HZ as f64));
        for (out, sample) in recording[delay..].iter_mut().zip(sweep) {
            *out += gain * sample;
        }
    }
    recording
}

/// A mono file of 16 bits at 48 kHz.
pub(crate) fn write_wav(place: &TestFolder, name: &str, samples: &[f64]) {
    let size = 2 * samples.len() as u32;
    let rate = RATE_HZ as u32;
    let mut bytes = Vec::new();
    bytes.extend(b"RIFF");
    bytes.extend((36 + size).to_le_bytes());
    bytes.extend(b"WAVEfmt \x10\0\0\0\x01\0\x01\0");
    bytes.extend(rate.to_le_bytes());
    bytes.extend((2 * rate).to_le_bytes());
    bytes.extend(b"\x02\0\x10\0data");
    bytes.extend(size.to_le_bytes());
    bytes.extend(samples.iter().flat_map(|x| ((x * 32767.0).round() as i16).to_le_bytes()));
    std::fs::write(place.path(name), bytes).expect("written");
}

/// Places of the speaker in the rig's pairs, and the distance to each.
const SPEAKERS: [(&str, f64); 2] = [("2000 0 1000", 2000.0), ("0 3000 1000", 3000.0)];

/// Imports recordings of surfaces with their decay, each of two pairs.
fn import_rooms(place: &TestFolder, rooms: &[(&str, f64)]) {
    let both = rooms.iter().flat_map(|room| SPEAKERS.map(|speaker| (*room, speaker)));
    import_pairs(place, &both.collect::<Vec<_>>());
}

/// A recording: surface with its decay in seconds, speaker with the length of the direct path in millimetres.
type RoomRecording<'a> = ((&'a str, f64), (&'a str, f64));

/// Imports a recording of each surface, with its decay, at one pair.
fn import_pairs(place: &TestFolder, recordings: &[RoomRecording<'_>]) {
    let sweep = sweep();
    write_wav(place, "sweep.wav", &sweep);
    let mut manifest = HEADER.to_owned();
    for ((room, decay_secs), (speaker, direct_mm)) in recordings {
        let name = format!("{room}-{direct_mm}.wav");
        write_wav(place, &name, &record_room(&sweep, *decay_secs, *direct_mm));
        manifest += &format!("{room},{name},sweep.wav,0 0 1000,{speaker},20\n");
    }
    std::fs::write(place.path("manifest.csv"), manifest).expect("written");
    std::fs::write(place.path("rooms.toml"), ROOM_RIG).expect("written");
    place.fails(0, &["import", "wav", "manifest.csv", "--rig", "rooms.toml"], "next: echolake --lake lake ingest");
}

fn lake() -> TestFolder {
    let place = TestFolder::new();
    import_rooms(&place, &[("hall", 1.2), ("living", 0.4)]);
    place.fails(0, &["ingest"], "next: echolake --lake lake serve");
    place
}

#[test]
fn commands_name_what_a_lake_of_rooms_lacks() {
    let place = lake();
    assert!(place.ok(&["doctor"]).contains("waits for reference flat, foam, which levels need"));
    assert_eq!(place.number("select count(*) from measurements where snr_db > 20"), 4.0);
    let no_levels = "surface `hall` has no levels; hint: levels need runs of Flat and Foam";
    for kind in ["grid", "nce"] {
        place.fails(1, &["figure", kind, "hall", "-o", "out.svg"], no_levels);
    }
    place.fails(1, &["figure", "table", "hall", "-o", "out.csv"], no_levels);
    place.fails(1, &["figure", "map"], "a map needs two surfaces with levels; hint: levels need Flat and Foam");
    place.fails(1, &["figure", "relief", "hall"], "has no height map; hint: its run came without a mesh");
    let steps = place.ok(&["figure", "steps", "hall"]);
    assert!(steps.contains(">Measured<") && !steps.contains(">Direct sound removed<"));
    for kind in ["filters", "coverage"] {
        assert!(place.ok(&["figure", kind]).starts_with("<svg"), "{kind}");
    }
}

/// Parameters are those of the room as it was, whatever temperature is told of it, and without one.
#[test]
fn parameters_of_a_room_do_not_move_with_the_temperature() {
    let place = TestFolder::new();
    let sweep = sweep();
    write_wav(&place, "sweep.wav", &sweep);
    write_wav(&place, "room.wav", &record_room(&sweep, 0.4, 2000.0));
    let row = |(room, celsius)| format!("{room},room.wav,sweep.wav,0 0 1000,2000 0 1000,{celsius}\n");
    let rows = [("mild", "20"), ("hot", "35"), ("untold", "")].map(row).concat();
    std::fs::write(place.path("manifest.csv"), format!("{HEADER}{rows}")).expect("written");
    std::fs::write(place.path("rooms.toml"), ROOM_RIG).expect("written");
    let import = ["import", "wav", "manifest.csv", "--rig", "rooms.toml"];
    place.fails(0, &import, "no temperature is known of 1 responses: 20 C, the reference's");
    place.ok(&["ingest"]);
    assert_eq!(place.number("select count(distinct ir::varchar) from measurements"), 2.0, "the hot one is corrected");
    let parameters = |room: &str| {
        place.sql(&format!(
            "select * exclude (surface_id, run_id) from room_parameters where surface_id = '{room}' order by midband_hz"
        ))
    };
    let mild = parameters("mild");
    assert_eq!((parameters("hot"), parameters("untold")), (mild.clone(), mild.clone()));
    let known = |name: &str| mild.iter().filter(|row| row[name].is_number()).count();
    assert!(known("c50_db") > 4 && known("t20_s") > 2, "{mild:?}");
}

/// Levels of two pairs have no uncertainty. They are shown without one.
#[test]
fn levels_without_an_uncertainty_are_shown() {
    let place = lake();
    import_rooms(&place, &[("flat", 0.3), ("foam", 0.05)]);
    place.ok(&["ingest"]);
    let of_hall = "from surface_stats h join surface_stats f on f.band = h.band \
                   where h.surface_id = 'hall' and f.surface_id = 'flat' and h.band = '1000'";
    assert_eq!(place.number(&format!("select count(*) {of_hall} and h.p90_mean_u_db is null")), 1.0);
    let level = place.number(&format!("select h.p90_mean_db - f.p90_mean_db {of_hall}"));
    let expected = format!("{:.2}", level.abs());
    place.ok(&["figure", "levels", "hall", "-o", "levels.csv"]);
    let csv = std::fs::read_to_string(place.path("levels.csv")).expect("read");
    for text in [place.ok(&["figure", "table", "hall"]), csv] {
        assert!(text.contains(&expected), "{expected} in {text}");
    }
}

/// E21: `listen` takes the response from the surface's newest run, as `twin`, `replay` and `catalogue` do, also if an
/// older run measured the pair later, or has pairs that the newest lacks.
#[test]
fn listen_takes_the_newest_run_of_a_surface() {
    let place = TestFolder::new();
    std::fs::write(place.path("rooms.toml"), ROOM_RIG).expect("written");
    write_wav(&place, "click.wav", &[&[0.5][..], &[0.0; 99]].concat());
    // 2 m and 3 m of air.
    for (name, gain) in [("old.wav", 0.5), ("new.wav", 0.25)] {
        let mut response = vec![0.0; 30_000];
        response[280] = gain;
        response[419] = gain / 8.0;
        write_wav(&place, name, &response);
    }
    let header = "surface,response,microphone,speaker,temperature_c,timing_offset_ms,start_secs,recorded_at\n";
    let row = |name: &str, speaker: &str, day: u32| {
        format!("flat,{name},0 0 1000,{speaker},20,0,0,2026-01-{day:02}T09:00:00Z\n")
    };
    let first = [row("old.wav", "0 3000 1000", 5), row("old.wav", "2000 0 1000", 7)].concat();
    for (name, rows) in [("first.csv", first), ("second.csv", row("new.wav", "2000 0 1000", 6))] {
        std::fs::write(place.path(name), format!("{header}{rows}")).expect("written");
        place.ok(&["import", "rew", name, "--rig", "rooms.toml"]);
        place.ok(&["ingest"]);
    }
    assert_eq!(place.number("select count(*) from runs"), 2.0);
    let pairs = place.sql("select pair_id, count(*) as runs from measurements group by pair_id order by runs desc");
    assert_eq!((&pairs[0]["runs"], &pairs[1]["runs"]), (&2.into(), &1.into()));
    let [both, one] = [0, 1].map(|at: usize| pairs[at]["pair_id"].to_string());
    let dry = ["--dry", "click.wav", "--signal", "measured", "--json", "-o"];
    let levels = place.ok(&[&["listen", "flat", &both][..], &dry, &["sounds"]].concat());
    let levels: Value = serde_json::from_str(&levels).expect("JSON");
    let response_db = levels[0]["response_db"].as_f64().expect("a level");
    let expected_db = 10.0 * (0.25f64.powi(2) * (1.0 + 1.0 / 64.0)).log10();
    assert!((response_db - expected_db).abs() < 2.0, "{response_db} dB, expected {expected_db} dB");
    let newest = &place.sql("select run_id from catalogue")[0]["run_id"];
    let expected = format!("of pair {one} in its newest run, {}", newest.as_str().expect("a name"));
    place.fails(1, &[&["listen", "flat", &one][..], &dry, &["none"]].concat(), &expected);
}

// The direct sound of pair 0 comes after 2 m, that of pair 1 after 3 m of air.
#[test]
fn the_catalogue_lists_and_draws_responses_without_levels() {
    let place = lake();
    let server = served(&place, &[]);
    let get = |path: &str| HttpRequest::get(path).send(&server);
    let json = |path: &str| serde_json::from_str::<Value>(&get(path).text()).expect("JSON");
    let lake = json("/api/v1/lake");
    assert_eq!(lake["has_levels"], false);
    let pairs = json("/api/v1/surfaces/hall/pairs");
    assert_eq!((&pairs["total"], &pairs["items"][1]["pair_id"]), (&Value::from(2), &Value::from(1)));
    assert_eq!(get("/api/v1/surfaces/hall/thumbnail.png").body[1..4], *b"PNG");
    let analysis = json("/api/v1/surfaces/hall/pairs/1/analysis");
    let number = |name: &str| analysis[name].as_f64().expect("a number");
    assert!((number("arrival_s") - 3.0 / 343.0).abs() < 1e-4, "{}", number("arrival_s"));
    let decay = |sample: usize| analysis["measured"]["decay_db"][sample].as_f64().expect("a level");
    let from = (number("arrival_s") * RATE_HZ as f64) as usize;
    // Over 0.2 s of a decay of 1.2 s for 60 dB; reflections come in steps of 7 ms, and the end is cut off.
    let fallen = decay(from + 1000) - decay(from + 1000 + RATE_HZ / 5);
    assert!((fallen - 10.0).abs() < 1.0, "{fallen} dB");
    let picture = json("/api/v1/surfaces/hall/pairs/0/spectrogram?signal=measured");
    assert_eq!(picture["window_s"], 0.005, "a hundredth of the response");
}

mod slow {
    use super::*;

    /// Bug 3: rooms without a pair in common are compared all the same.
    #[test]
    fn rooms_are_compared_by_pairs_of_their_own() {
        let Some(browser) = web::or_skip("rooms without a common pair in a browser", web::browser()) else { return };
        let place = TestFolder::new();
        let [first, second] = SPEAKERS;
        let [attic, cellar, hall] = [("attic", 0.6), ("cellar", 0.9), ("hall", 1.2)];
        import_pairs(&place, &[(attic, first), (cellar, second), (hall, first), (hall, second)]);
        place.ok(&["ingest"]);
        let server = served(&place, &[]);
        let mut command = Command::new("node");
        command.args(["tests/apart.mjs", &format!("http://{}", server.http)]);
        command.current_dir(web::web()).env("CHROMIUM", &browser);
        eprintln!("{}", web::run(&mut command).unwrap_or_else(|why| panic!("{why}")));
    }

    #[test]
    fn pages_of_rooms_show_no_error() {
        let Some(browser) = web::or_skip("rooms in a browser", web::browser()) else { return };
        let place = lake();
        let server = served(&place, &[]);
        let look = |folder: &str| {
            let shots = place.path(folder);
            let base = format!("http://{}", server.http);
            let mut command = Command::new("node");
            command.args(["tests/rooms.mjs", &base]).arg(shots).current_dir(web::web()).env("CHROMIUM", &browser);
            eprintln!("{}", web::run(&mut command).unwrap_or_else(|why| panic!("{why}")));
        };
        look("rooms");
        import_rooms(&place, &[("flat", 0.3), ("foam", 0.05)]);
        place.ok(&["ingest"]);
        look("levels");
    }
}
