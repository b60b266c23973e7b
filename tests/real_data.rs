//! Real data, if it is beside the checkout: a room's recording and the published combinations.

use super::{TestFolder, shared_data};

const ROOM_RIG: &str = r#"
name = "room"
bands.centres_hz = [125, 250, 500, 1000, 2000, 4000, 8000, 16000]
[sweep]
rate_hz = 48000
low_hz = 20
high_hz = 20000
[impulse_response]
length = 480000
[grid]
points_mm = [[0, 0, 1000], [2000, 0, 1000]]
"#;

// Source of the two figures: the data's own description, peak at sample 24 495, about 50 dB over the rms of the whole.
#[test]
fn a_room_s_impulse_response_is_asked_for_in_sql() {
    let (Some(recording), Some(sweep)) =
        (shared_data("recordings/room_recording.wav"), shared_data("recordings/room_sweep.wav"))
    else {
        return;
    };
    let place = TestFolder::new();
    std::fs::write(place.path("room.toml"), ROOM_RIG).expect("written");
    let manifest = format!(
        "surface,recording,loopback,microphone,speaker,temperature_c\nroom,{},{},0/0/0,0/1/0,20\n",
        recording.display(),
        sweep.display()
    );
    std::fs::write(place.path("manifest.csv"), manifest).expect("written");
    place.ok(&["import", "wav", "manifest.csv", "--rig", "room.toml"]);
    place.fails(0, &["ingest"], "waits for reference flat, foam");
    let samples = "select unnest(ir) as x, unnest(range(0, cardinality(ir)::bigint)) as n from measurements";
    let peak = place.number(&format!("select n from ({samples}) order by abs(x) desc limit 1"));
    assert_eq!(peak, 24_495.0);
    let level = place.number(&format!("select 20 * log10(max(abs(x)) / sqrt(avg(x * x))) from ({samples})"));
    assert!((level - 50.0).abs() < 2.0, "{level} dB");
}

#[test]
fn the_published_combinations_are_the_built_in_pairs() {
    let Some(path) = shared_data("gir/combinations.csv") else { return };
    let grid = echolake_schema::Rig::paper().build_grid().expect("the built-in rig is valid");
    let text = std::fs::read_to_string(path).expect("read");
    let mut seen = std::collections::BTreeSet::new();
    for line in text.lines().skip(1) {
        let cells: Vec<f64> = line.split(',').map(|c| c.parse().expect("a number")).collect();
        let point =
            |i: usize| grid.parse_point(&format!("{}/{}/{}", cells[i], cells[i + 1], cells[i + 2])).expect("a point");
        let (microphone, speaker) = (point(1), point(4));
        seen.insert(grid.parse_pair(microphone, speaker).expect("a pair"));
        let delay = echolake_dsp::geometry::direct_mm(microphone.position_mm, speaker.position_mm) / 1e3 / 343.0 * 96e3;
        // The file prints six decimals.
        assert!((delay - cells[8]).abs() < 1e-6, "{line}: {delay}");
        let incidence = cells[7];
        assert!((0.0..90.0).contains(&incidence));
    }
    assert_eq!(seen.len(), grid.pairs().len());
}
