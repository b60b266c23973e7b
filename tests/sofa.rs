//! Responses out as SOFA and back: what the format holds is the same to the bit.

use super::Place;

#[test]
fn sofa_out_and_in_again() {
    let place = Place::new();
    for (surface, seed) in [("flat", "1"), ("foam", "2"), ("0015_0", "3")] {
        let panel = if surface == "0015_0" { "wavy" } else { surface };
        place.acquire(surface, &["--seed", seed, "--panel", panel, "--ir-only"]);
    }
    place.ok(&["ingest"]);
    place.ok(&["export", "sofa", "-o", "sofa"]);
    let other = Place::new();
    let mut args = vec!["import".to_owned(), "sofa".to_owned(), "--rig".to_owned(), "rig.toml".to_owned()];
    for surface in ["flat", "foam", "0015_0"] {
        args.push(place.path("sofa").join(format!("{surface}.sofa")).display().to_string());
    }
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    assert_eq!(other.ok(&args).lines().count(), 3);
    other.ok(&["ingest"]);
    let responses = "select surface_id, pair_id, ir from measurements order by surface_id, pair_id";
    let original = place.sql(responses);
    assert_eq!(original.len(), 3 * 45);
    assert!(original == other.sql(responses), "responses are the same");
    // And with them what is derived of them.
    let derived = "select surface_id, pair_id, tnce_total, tnce_2500 from tnce order by surface_id, pair_id";
    assert!(place.sql(derived) == other.sql(derived), "curves are the same");
    // What the format does not hold: the measured temperature, and times below a second.
    let kelvin = "select distinct temperature_c, humidity_pct from measurements";
    assert_eq!(other.sql(kelvin).len(), 1);
    assert_eq!(other.sql(kelvin)[0]["temperature_c"], 20.0);
    let late = "select max(abs(log_time_ns - floor(log_time_ns / 1e9) * 1e9)) from measurements";
    assert!(other.number(late) < 1e6, "whole seconds, and a microsecond where two would be one");
    assert_eq!(other.sql("select distinct origin from runs")[0]["origin"], "imported_sofa");

    // What is refused leaves nothing, not even a lake.
    let third = Place::new();
    std::fs::write(third.path("a.sofa"), "no HDF5").expect("written");
    third.fails(1, &["import", "sofa", "a.sofa", "--rig", "rig.toml"], "it is no HDF5 file");
    third.fails(1, &["import", "sofa", "b.sofa", "--rig", "rig.toml"], "b.sofa");
    assert!(!third.path("lake").exists());
    place.fails(2, &["export", "sofa", "-o", "s3://bucket/sofa"], "hint: name a path");
    place.fails(2, &["export", "ml", "-o", "https://example.org/set"], "hint: name a path");
    assert!(!place.path("s3:").exists());
}
