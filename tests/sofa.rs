//! Responses out as SOFA and back: what the format holds is the same to the bit.

use super::TestFolder;

// A SOFA file of one pair is a set in HDF5, too.
#[test]
fn a_mapped_set_is_what_its_file_has() {
    let (place, other) = (TestFolder::new(), TestFolder::new());
    let rig = std::fs::read_to_string(place.path("rig.toml")).expect("read");
    let (head, _) = rig.split_once("[[grid.layers]]").expect("a grid");
    let rig = format!("{head}[grid]\npoints_mm = [[0.0, 0.0, 124.0], [150.0, 0.0, 304.0]]\n");
    for folder in [&place, &other] {
        std::fs::write(folder.path("rig.toml"), &rig).expect("written");
    }
    place.acquire("flat", &["--ir-only"]);
    place.ok(&["ingest"]);
    place.ok(&["export", "sofa", "-o", &other.path("out").to_string_lossy()]);
    let mapping = "file = \"out/flat.sofa\"\nsurfaces = [\"flat\"]\nsampling_rate = { dataset = \"Data.SamplingRate\" \
                   }\n[responses]\ndataset = \"Data.IR\"\ndimensions = [\"speaker\", \"microphone\", \"sample\"]\n\
                   [microphones]\ndataset = \"ListenerPosition\"\n[speakers]\ndataset = \"SourcePosition\"\n\
                   [temperature]\ndataset = \"RoomTemperature\"\nunits = \"kelvin\"\n";
    std::fs::write(other.path("set.toml"), mapping.replace("Data.IR", "Data.None")).expect("written");
    other.fails(1, &["import", "hdf5", "set.toml", "--rig", "rig.toml"], "Data.None: it is missing, expected one of ");
    assert!(!other.path("lake").exists());
    std::fs::write(other.path("set.toml"), mapping).expect("written");
    other.ok(&["import", "hdf5", "set.toml", "--rig", "rig.toml"]);
    other.ok(&["ingest"]);
    let responses = "select surface_id, pair_id, ir from measurements";
    assert_eq!(place.sql(responses).len(), 1);
    assert!(place.sql(responses) == other.sql(responses), "the response is the same");
    assert_eq!(other.sql("select origin from runs")[0]["origin"], "imported_hdf5");
}

mod slow {
    use super::*;

    #[test]
    fn sofa_out_and_in_again() {
        let (place, other) = (TestFolder::new(), TestFolder::new());
        for (surface, panel, seed) in [("flat", "flat", "1"), ("foam", "foam", "2"), ("0015_0", "macrostructure", "3")]
        {
            place.acquire(surface, &["--seed", seed, "--panel", panel, "--ir-only"]);
        }
        place.ok(&["ingest"]);
        place.ok(&["export", "sofa", "-o", &other.path("out").to_string_lossy()]);
        let runs =
            other.ok(&["import", "sofa", "--rig", "rig.toml", "out/flat.sofa", "out/foam.sofa", "out/0015_0.sofa"]);
        assert_eq!(runs.lines().count(), 3);
        other.ok(&["ingest"]);
        let responses = "select surface_id, pair_id, ir from measurements order by surface_id, pair_id";
        let original = place.sql(responses);
        assert_eq!(original.len(), 3 * 45);
        assert!(original == other.sql(responses), "responses are the same");
        // And with them what is derived of them, but for the air, of which the format knows the temperature alone.
        let totals = |of: &TestFolder| of.number("select avg(tnce_total) from tnce where surface_id = '0015_0'");
        assert!((totals(&place) / totals(&other) - 1.0).abs() < 0.01, "{} {}", totals(&place), totals(&other));
        // What the format does not hold: the measured temperature, and times below a second.
        let air = other.sql("select distinct temperature_c, humidity_pct from measurements");
        assert_eq!((air.len(), air[0]["temperature_c"].as_f64()), (1, Some(20.0)));
        let late = "select max(abs(log_time_ns - floor(log_time_ns / 1e9) * 1e9)) from measurements";
        assert!(other.number(late) < 1e6, "whole seconds, and a microsecond where two would be one");
        assert_eq!(other.sql("select distinct origin from runs")[0]["origin"], "imported_sofa");

        // Two files of a surface are refused before there is a lake.
        let third = TestFolder::new();
        for copy in ["a.sofa", "b.sofa"] {
            std::fs::copy(other.path("out/flat.sofa"), third.path(copy)).expect("copied");
        }
        third.fails(1, &["import", "sofa", "--rig", "rig.toml", "a.sofa", "b.sofa"], "a second file of surface flat");
        assert!(!third.path("lake").exists());
    }
}
