//! View `materials`, `export materials` and `listen`, on simulated lakes.

use serde_json::Value;

use super::{TestFolder, TestFolderTemplate, rooms};

const MATERIALS: &str = "select * from materials order by surface_id, band_hz";
/// Absorption of Flat's print at the bands' centres, `acquisition/panel/src/material.rs`.
const PRINT_ABSORPTION: [f64; 5] = [0.06, 0.08, 0.16, 0.33, 0.50];

/// A lake of Flat, Foam and a wall of bricks.
fn brick_lake() -> TestFolder {
    static LAKE: TestFolderTemplate = TestFolderTemplate::new();
    LAKE.place(|place| {
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("stretcher_bond", "3")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        place.ok(&["ingest"]);
    })
}

const PART_OF_SWEEP: &str = "the sweep begins or ends within the octave";

/// Returns true if a sweep from 2 to 40 kHz has all of the octave.
fn is_whole(row: &Value) -> bool {
    ["5000", "10000", "20000"].iter().any(|band| row["band"] == *band)
}

fn material_rows(place: &TestFolder) -> Vec<Value> {
    place.sql(MATERIALS).into_iter().map(Value::Object).collect()
}

fn number(row: &Value, column: &str) -> f64 {
    row[column].as_f64().unwrap_or_else(|| panic!("{column}: {row}"))
}

mod slow {
    use super::*;

    #[test]
    fn materials_are_near_to_what_is_simulated_and_leave_the_lake() {
        let place = brick_lake();
        for row in material_rows(&place) {
            assert_eq!(row["absorption"], Value::Null, "{row}");
            let reason = match row["surface_id"].as_str() {
                _ if !is_whole(&row) => PART_OF_SWEEP,
                Some("foam") => "the surface is its own Foam, which is estimated",
                _ => "no hard surface was measured over the same Flat",
            };
            assert_eq!(row["absorption_reason"], reason);
        }
        place.fails(
            1,
            &["export", "materials", "--format", "choras", "-o", "none.json"],
            "nothing to export: no surface has an absorption and a scattering",
        );
        assert!(!place.path("none.json").exists());

        place.acquire("wood", &["--seed", "4", "--ir-only"]);
        place.ok(&["ingest"]);
        let rows = material_rows(&place);
        assert_eq!(rows.len(), 4 * 5);
        let of = |surface: &str| rows.iter().filter(|row| row["surface_id"] == surface).collect::<Vec<_>>();
        for (row, expected) in of("flat").into_iter().zip(PRINT_ABSORPTION) {
            assert!(number(row, "far_scattering").abs() < 1e-6, "{row}");
            assert!((number(row, "full_scale_hz") - number(row, "band_hz") / 10.0).abs() < 1e-9);
            if !is_whole(row) {
                assert!(row["absorption"] == Value::Null && row["scattering"] == Value::Null, "{row}");
                assert!(row["absorption_reason"] == PART_OF_SWEEP && row["scattering_reason"] == PART_OF_SWEEP);
                continue;
            }
            assert!((number(row, "absorption") - expected).abs() < 0.06, "{row} {expected}");
            assert!((1e-4..0.02).contains(&number(row, "absorption_u")), "{row}");
            assert!(number(row, "scattering") == 0.0, "{row}");
        }
        for row in of("wood").into_iter().filter(|row| is_whole(row)) {
            assert!((number(row, "absorption") - 0.02).abs() < 1e-3, "{row}");
            assert!(number(row, "scattering") < 0.02 && row["specular_loss"] == Value::Null, "{row}");
        }
        // A wall of bricks scatters more the shorter the wave is.
        let bricks: Vec<f64> =
            of("stretcher_bond").into_iter().filter_map(|row| row["far_scattering"].as_f64()).collect();
        assert!(bricks.len() > 3 && bricks.is_sorted() && bricks[0] < 0.05, "{bricks:?}");
        for (row, flat) in of("stretcher_bond").into_iter().zip(of("flat")).filter(|(row, _)| is_whole(row)) {
            assert_eq!(row["absorption"], flat["absorption"]);
            let reason = "that of Flat, which is of the same material; uncertain by the area of the relief";
            assert_eq!(row["absorption_reason"], reason);
            // Joints of the wall make its area larger: S10 of a relief that had Flat's uncertainty.
            assert!(number(row, "absorption_u") > 1.1 * number(flat, "absorption_u"), "{row} {flat}");
        }

        place.ok(&["export", "materials", "--format", "pyroomacoustics", "--surfaces", "flat", "-o", "flat.json"]);
        let file = std::fs::read(place.path("flat.json")).expect("written");
        let file: Value = serde_json::from_slice(&file).expect("JSON");
        let frequencies = serde_json::json!([500.0, 1000.0, 2000.0]);
        assert_eq!(file["flat"]["energy_absorption"]["center_freqs"], frequencies);
        assert_eq!(file["flat"]["scattering"]["coeffs"], serde_json::json!([0.0, 0.0, 0.0]));
        assert_eq!(file["flat"]["energy_absorption"]["coeffs"][2], of("flat")[3]["absorption"]);
        place.ok(&["export", "materials", "--format", "choras", "-o", "choras.json"]);
        let file = std::fs::read(place.path("choras.json")).expect("written");
        let file: Value = serde_json::from_slice(&file).expect("JSON");
        assert_eq!(file["results"][0]["frequencies"], frequencies);
        place.ok(&["export", "materials", "--format", "csv", "-o", "all.csv"]);
        assert_eq!(std::fs::read_to_string(place.path("all.csv")).expect("written").lines().count(), 1 + 4 * 5);
        place.fails(
            1,
            &["export", "materials", "--format", "csv", "--surfaces", "marble", "-o", "marble.csv"],
            "surface `marble` is not in the lake",
        );
    }

    // S9: the scale is said, and what a panel does to a wave does not depend on it.
    #[test]
    fn a_scale_is_said_or_nothing_is_given_at_full_scale() {
        let materials = |scale: &str| {
            let place = TestFolder::new();
            let rig = std::fs::read_to_string(place.path("rig.toml")).expect("a rig");
            let centres = "bands.centres_hz = [4000, 8000, 16000]\n";
            std::fs::write(place.path("rig.toml"), format!("{scale}{centres}{}", rig.replace("scale = 10\n", "")))
                .expect("written");
            for (surface, seed, role) in
                [("flat", "1", ""), ("foam", "2", ""), ("slated_stone", "3", ""), ("wood", "4", "hard")]
            {
                let role: Vec<_> =
                    [role].into_iter().filter(|role| !role.is_empty()).flat_map(|role| ["--role", role]).collect();
                place.acquire(surface, &[&["--seed", seed, "--ir-only"][..], &role].concat());
            }
            place.ok(&["ingest"]);
            place
        };
        let [model, wall] = ["scale = 8\n", "scale = 1\n"].map(|scale| material_rows(&materials(scale)));
        assert_eq!((model.len(), wall.len()), (12, 12));
        for (model, wall) in model.iter().zip(&wall) {
            assert!((8.0 * number(model, "full_scale_hz") - number(wall, "full_scale_hz")).abs() < 1e-9);
            for column in ["absorption", "scattering", "specular_loss", "far_scattering", "diffusion_normalised"] {
                let [model, wall] = [&model[column], &wall[column]].map(Value::as_f64);
                // Midband frequencies of octaves are powers of 10^0.3, and not quite those that their names say.
                let is_equal = match (model, wall) {
                    (Some(model), Some(wall)) => (model - wall).abs() < 0.01,
                    other => other == (None, None),
                };
                assert!(is_equal, "{column}: {model:?} {wall:?}");
            }
        }
        assert!(model.iter().any(|row| row["scattering"].as_f64().is_some_and(|s| s > 0.1)));
        assert!(model.iter().any(|row| row["absorption"].as_f64().is_some_and(|a| a > 0.1)));
        let place = materials("");
        let unknown = "the rig does not say its scale";
        for row in material_rows(&place) {
            let reason = row["absorption_reason"].as_str().expect("a reason");
            assert!(reason.starts_with(unknown) && row["full_scale_hz"] == Value::Null, "{row}");
            assert!(
                ["scattering", "far_scattering", "diffusion_normalised"].iter().all(|c| row[*c] == Value::Null),
                "{row}"
            );
        }
        rooms::write_wav(&place, "click.wav", &[&[0.5][..], &[0.0; 99]].concat());
        std::fs::write(
            place.path("target.toml"),
            "relief = \"macrostructure\"\n[ranges]\nmacro_depth_mm = [20, 100]\n[bands.4000]\nlevel_db = -1\n",
        )
        .expect("written");
        for args in [
            &["listen", "flat", "3", "--dry", "click.wav", "-o", "sounds"][..],
            &["export", "materials", "--format", "csv", "-o", "all.csv"],
            &["design", "target.toml", "-o", "found"],
        ] {
            place.fails(1, args, unknown);
        }
        assert!(!place.path("all.csv").exists() && !place.path("sounds").exists() && !place.path("found").exists());
        // A lake that exists is told, and derives its octaves.
        let config = std::fs::read_to_string(place.path("lake/lake.toml")).expect("a lake");
        std::fs::write(place.path("lake/lake.toml"), config.replace("[rig]\n", "[rig]\nscale = 8.0\n"))
            .expect("written");
        place.ok(&["ingest"]);
        assert_eq!(material_rows(&place).len(), 12);
        assert!(material_rows(&place).iter().any(|row| row["scattering"].as_f64().is_some_and(|s| s > 0.1)));
    }

    #[test]
    fn sounds_are_the_dry_recording_by_the_responses_at_full_scale() {
        let place = brick_lake();
        // A click, so that the sound is the response: 9.6 kHz at full scale, of which each sample is every fifth here.
        rooms::write_wav(&place, "click.wav", &[&[0.5][..], &[0.0; 99]].concat());
        let listen = ["listen", "stretcher_bond", "7", "--dry", "click.wav", "--json"];
        for more in [&["-o", "sounds"][..], &["-o", "matched", "--match-levels"]] {
            let levels: Vec<Value> = serde_json::from_str(&place.ok(&[&listen[..], more].concat())).expect("JSON");
            assert_eq!(levels.len(), 2);
            let mut peak = 0.0f64;
            let mut energies = Vec::new();
            for (level, surface) in levels.iter().zip(["stretcher_bond", "flat"]) {
                let file = level["file"].as_str().expect("a name");
                assert_eq!(file, format!("{surface}-7-simulated.wav"));
                let sound = read_floats(&place, &format!("{}/{file}", more[1]));
                let row =
                    place.sql(&format!("select reflected_ir from ir where surface_id = '{surface}' and pair_id = 7"));
                let response: Vec<f64> = serde_json::from_value(row[0]["reflected_ir"].clone()).expect("numbers");
                assert_eq!(sound.len(), 99 + 5 * response.len());
                // 0.5 of a file of 16 bits, and a response of another rate with the same spectrum.
                let gain = 0.5 * 32767.0 / 32768.0 / 5.0 * 10f64.powf(number(level, "gain_db") / 20.0);
                let greatest = response.iter().fold(0.0f64, |most, x| most.max(x.abs()));
                for (sample, response) in sound.iter().step_by(5).zip(&response) {
                    assert!((sample - gain * response).abs() < 1e-4 * gain * greatest, "{sample} {response}");
                }
                let response_db = 10.0 * response.iter().map(|x| x * x).sum::<f64>().log10();
                assert!((number(level, "response_db") - response_db).abs() < 1e-4, "{level}");
                peak = sound.iter().fold(peak, |most, x| most.max(x.abs()));
                energies.push(sound.iter().map(|x| x * x).sum::<f64>());
            }
            assert!((peak - 0.891).abs() < 1e-5, "{peak}");
            let difference_db = 10.0 * (energies[0] / energies[1]).log10();
            let expected_db = match more.len() {
                2 => number(&levels[0], "sound_db") - number(&levels[1], "sound_db"),
                _ => 0.0,
            };
            assert!((difference_db - expected_db).abs() < 1e-4, "{difference_db} {expected_db}");
        }
        place.fails(1, &[&listen[..], &["-o", "sounds"]].concat(), "sounds");
        // The same samples, said to be those of two channels in turn.
        let mut stereo = std::fs::read(place.path("click.wav")).expect("read");
        stereo[22] = 2;
        stereo[28..32].copy_from_slice(&(4 * 48_000u32).to_le_bytes());
        stereo[32] = 4;
        std::fs::write(place.path("stereo.wav"), stereo).expect("written");
        let said = "--dry is `stereo.wav`, channel 1 of 2; hint: `file.wav#2` names the second one";
        place.fails(0, &["listen", "stretcher_bond", "7", "--dry", "stereo.wav", "-o", "stereo"], said);
        for (args, expected) in [
            (["marble", "7", "click.wav"], "no surface `marble`"),
            (["flat", "99999", "click.wav"], "surface `flat` has no reflected_ir of pair 99999"),
            (["flat", "7", "none.wav"], "none.wav"),
            (["flat", "7", "click.wav#2"], "click.wav"),
        ] {
            let [surface, pair, dry] = args;
            place.fails(1, &["listen", surface, pair, "--dry", dry, "-o", "bad"], expected);
            assert!(!place.path("bad").exists(), "{args:?}");
        }
    }

    /// Samples of a file of 32-bit floats.
    fn read_floats(place: &TestFolder, name: &str) -> Vec<f64> {
        let bytes = std::fs::read(place.path(name)).expect("written");
        let data = bytes.windows(4).position(|name| name == b"data").expect("a chunk of samples") + 8;
        bytes[data..].chunks_exact(4).map(|x| f64::from(f32::from_le_bytes(x.try_into().expect("4 bytes")))).collect()
    }
}
