//! `echolake figure`: files that say where they come from, and the same picture as the server's.

use std::collections::BTreeMap;

use super::serve::http::HttpRequest;
use super::serve::served;
use super::{TestFolder, TestFolderTemplate};

fn lake() -> TestFolder {
    static THREE_RUNS: TestFolderTemplate = TestFolderTemplate::new();
    THREE_RUNS.place(|place| {
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("wood", "3")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        place.ok(&["ingest"]);
    })
}

fn fills(svg: &str) -> Vec<&str> {
    let cells = svg.lines().filter(|line| line.contains("data-point="));
    cells.map(|line| line.split(" fill=\"").nth(1).expect("a fill").split('"').next().expect("its end")).collect()
}

#[test]
fn flat_is_0_db_and_wood_is_louder() {
    let place = lake();
    let svg = place.ok(&["figure", "grid", "flat", "--paper-colours"]);
    let cells = fills(&svg);
    // The blue cell of each band is the microphone's; pairs with it that are not measured are grey.
    let black = cells.iter().filter(|fill| **fill == "#000000").count();
    let others = cells.iter().filter(|fill| !matches!(**fill, "#000000" | "#0b5c8c" | "#a9adaa")).count();
    assert!(black > 20 && others == 0, "{cells:?}");
    assert!(svg.contains(">simulated · lake runs@"), "the picture says it");
    let notes = svg.split("<metadata>").nth(1).expect("notes");
    for said in
        ["echolake figure grid flat --paper-colours", "from tnce where surface_id = 'flat'", "runs@", "simulated"]
    {
        assert!(notes.contains(said), "{said}");
    }
    let grey = fills(&place.ok(&["figure", "grid", "flat"])).into_iter().filter(|fill| *fill == "#ececec").count();
    assert_eq!(grey, black, "0 dB");
    let wood = place.ok(&["figure", "grid", "wood", "--over", "band", "--paper-colours"]);
    let red = fills(&wood).into_iter().filter(|fill| fill.ends_with("0000") && *fill != "#000000").count();
    assert!(red > 20, "{red} cells over 0 dB");
}

#[test]
fn the_server_draws_the_same() {
    let place = lake();
    let server = served(&place, &[]);
    let drawn =
        |svg: &str| svg.lines().filter(|line| !line.starts_with("<metadata>")).map(str::to_owned).collect::<Vec<_>>();
    for (args, path) in [
        (&["grid", "wood", "--microphone", "3"][..], "grid.svg?microphone=3&width=440"),
        (&["grid", "wood", "--microphone", "3", "--over", "total"], "grid.svg?microphone=3&width=440&over=flat-total"),
        (&["grid", "wood", "--less", "flat", "--microphone", "3"], "grid.svg?microphone=3&width=440&less=flat"),
        (&["grid", "wood", "--paper-colours", "--microphone", "3"], "grid.svg?microphone=3&width=440&palette=paper"),
        (&["nce", "wood"], "curves.svg?width=420"),
        (&["levels", "wood", "flat"], "levels.svg?beside=flat"),
        (&["levels", "wood", "flat", "--over", "total"], "levels.svg?beside=flat&over=flat-total"),
    ] {
        let answer = HttpRequest::get(&format!("/api/v1/surfaces/wood/{path}")).send(&server);
        assert_eq!((answer.status, answer.header("content-type")), (200, Some("image/svg+xml")), "{path}");
        let written = place.ok(&[&["figure"], args].concat());
        assert_eq!(drawn(&answer.text()), drawn(&written), "{path}");
    }
    let answer = HttpRequest::get("/api/v1/map.svg").send(&server);
    assert_eq!(drawn(&answer.text()), drawn(&place.ok(&["figure", "map"])));
    let units = HttpRequest::get("/api/v1/map.svg?axes=som").send(&server).text();
    assert!(units.contains("data-unit=\"0\"") && units.contains("echolake figure som"), "{units}");
    assert_eq!(drawn(&units), drawn(&place.ok(&["figure", "som"])));
    for (format, media_type, opening) in
        [("svg", "image/svg+xml", &b"<svg"[..]), ("pdf", "application/pdf", b"%PDF"), ("png", "image/png", b"\x89PNG")]
    {
        for path in ["surfaces/wood/grid.svg?microphone=3", "surfaces/wood/curves.svg?width=420", "map.svg?axes=som"] {
            let answer = HttpRequest::get(&format!("/api/v1/{path}&format={format}")).send(&server);
            assert_eq!((answer.status, answer.header("content-type")), (200, Some(media_type)), "{path}");
            assert!(answer.body.starts_with(opening), "{path} as {format}");
        }
    }
}

#[test]
fn tables_have_the_numbers_of_the_lake() {
    let place = lake();
    place.ok(&["figure", "table", "wood", "flat", "--over", "total", "-o", "out/levels.csv", "-o", "out/levels.tex"]);
    let csv = std::fs::read_to_string(place.path("out/levels.csv")).expect("read");
    assert!(csv.starts_with("# Title: ") && csv.contains("# Lake: runs@") && csv.contains("# Origin: simulated"));
    let wood = csv.lines().find(|line| line.starts_with("wood,")).expect("a row");
    let numbers: Vec<f64> = wood.split(',').skip(1).map(|text| text.parse().expect("a number")).collect();
    for (at, column) in [(5, "shown_db"), (11, "shown_u_db")] {
        let expected = format!("select {column} from levels where surface_id = 'wood' and band = 'total'");
        assert!((numbers[at] - place.number(&expected)).abs() < 1e-9, "{column}: {numbers:?}");
    }
    place.ok(&["figure", "levels", "wood", "flat", "--over", "total", "-o", "out/chart.csv", "-o", "out/chart.svg"]);
    let chart = std::fs::read_to_string(place.path("out/chart.csv")).expect("read");
    assert_eq!(chart.lines().find(|line| line.starts_with("wood,")), Some(wood), "the chart has the table's numbers");
    let against = place.ok(&["figure", "table", "wood"]);
    let level = place.number("select shown_against_flat_2500_db from catalogue where surface_id = 'wood'");
    let u = place.number("select shown_u_2500_db from catalogue where surface_id = 'wood'");
    // S9 of the review: without Foam's own reflection, unless it is asked for as in the paper.
    let paper = place.ok(&["figure", "table", "wood", "--values", "levels"]);
    let measured = place.number("select against_flat_2500_db from catalogue where surface_id = 'wood'");
    let measured_u = place.number("select level_u_2500_db from catalogue where surface_id = 'wood'");
    let cell = |level: f64, u: f64| match u < 0.005 {
        true => format!("| wood | {level:.2} \u{b1} <0.01 |"),
        false => format!("| wood | {level:.2} \u{b1} {u:.2} |"),
    };
    assert!(measured_u > 0.0 && paper.contains(&cell(measured, measured_u)), "{paper}");
    assert!(
        place.number("select unbiased_db - shown_db from levels where surface_id = 'wood' and band = '2500'") == 0.0
    );
    assert!(u > 0.0 && against.contains(&cell(level, u)), "{against}");
    let tex = std::fs::read_to_string(place.path("out/levels.tex")).expect("read");
    assert!(tex.contains("\\cellcolor") && tex.contains("% Query: select surface_id, band"), "{tex}");
    for (surfaces, base, unit) in [
        (&["wood"][..], "flat", "dB re Flat, same band"),
        (&["flat"], "wood", "dB, less wood"),
        (&["wood", "flat"], "flat", "dB, less flat"),
    ] {
        let file = format!("out/{}-less-{base}.csv", surfaces.join("-"));
        place.ok(&[&["figure", "table"], surfaces, &["--less", base, "-o", &file]].concat());
        let csv = std::fs::read_to_string(place.path(&file)).expect("read");
        assert!(csv.lines().next().is_some_and(|title| title.ends_with(unit)), "{csv}");
    }
    assert!(csv.lines().next().is_some_and(|title| title.ends_with("dB re Flat total")), "{csv}");
    let energies = place.ok(&["figure", "table", "wood", "--values", "energies"]);
    let flat = energies.lines().find(|line| line.starts_with("| flat")).expect("a row");
    assert!(flat.ends_with("1.000 |"), "Flat is one of Flat: {flat}");
    let levels = place.ok(&["figure", "table", "flat", "wood"]);
    for table in [&energies, &levels] {
        assert!(table.contains("| flat (reference) |") && !table.contains("wood (reference)"), "{table}");
    }
}

// The coefficient of ISO 17497-2 of each point's pairs, written out.
#[test]
fn diffusion_is_the_mean_over_points() {
    let place = lake();
    let mut energies: BTreeMap<i64, Vec<f64>> = BTreeMap::new();
    for row in place.sql("select microphone, speaker, energy_5000 from tnce where surface_id = 'wood'") {
        for point in ["microphone", "speaker"] {
            let energy = row["energy_5000"].as_f64().expect("an energy");
            energies.entry(row[point].as_i64().expect("a point")).or_default().push(energy);
        }
    }
    let coefficient = |energies: &Vec<f64>| {
        let sum: f64 = energies.iter().sum();
        let squares: f64 = energies.iter().map(|energy| energy * energy).sum();
        (sum * sum - squares) / ((energies.len() - 1) as f64 * squares)
    };
    let expected = energies.values().map(coefficient).sum::<f64>() / energies.len() as f64;
    place.ok(&["figure", "table", "wood", "--values", "diffusion", "-o", "diffusion.csv"]);
    let csv = std::fs::read_to_string(place.path("diffusion.csv")).expect("read");
    let row = csv.lines().find(|line| line.starts_with("wood,")).expect("a row");
    let value: f64 = row.split(',').nth(2).expect("5 kHz").parse().expect("a number");
    assert!(energies.len() > 8 && (value - expected).abs() < 1e-9, "{value} instead of {expected}");
    let server = served(&place, &[]);
    let answer = HttpRequest::get("/api/v1/diffusion").send(&server);
    let answer: serde_json::Value = serde_json::from_slice(&answer.body).expect("JSON");
    let items = answer["items"].as_array().expect("items");
    let wood = items.iter().find(|item| item["surface_id"] == "wood").expect("wood");
    assert!((wood["diffusion"][1].as_f64().expect("a number") - expected).abs() < 1e-9, "{wood}");
}

// The statement that the manual prints for the paper's range of TNCE.
#[test]
fn the_papers_range_is_a_statement() {
    let place = lake();
    let manual = include_str!("../docs/paper.md");
    let statement = manual.split("```sql\n").nth(1).and_then(|text| text.split("```").next()).expect("a statement");
    let statement = statement.replace("typology <> 'reference'", "typology = 'reference'");
    let found = &place.sql(&statement)[0];
    let bands = ["2500", "5000", "10000", "20000", "40000"];
    let mut energies: Vec<f64> = Vec::new();
    for row in place.sql("select * from tnce") {
        energies.extend(bands.map(|band| row[format!("tnce_band_{band}").as_str()].as_f64().expect("an energy")));
    }
    energies.sort_by(f64::total_cmp);
    let at = 0.95 * (energies.len() - 1) as f64;
    let below = energies[at as usize];
    let p95 = below + at.fract() * (energies[at as usize + 1] - below);
    assert_eq!(found["values"], energies.len());
    for (name, expected) in [("least", energies[0]), ("greatest", energies[energies.len() - 1]), ("p95", p95)] {
        let value = found[name].as_f64().expect("a number");
        assert!((value - expected).abs() <= 1e-6 * expected, "{name}: {value} instead of {expected}");
    }
}

// Flat's energies at the moved pairs are its own times the ratio; Wood, as flat as Flat, is nearly so.
#[test]
fn turned_energies_are_corrected_by_flats() {
    let place = lake();
    let off_db = |surface: &str, factor: &str| {
        let level = format!("10 * log10(t.energy_40000 / (m.energy_40000 * {factor}))");
        place.number(&format!(
            "select sqrt(avg(power({level}, 2))) from augmented a
             join tnce m on m.run_id = a.run_id and m.pair_id = a.pair_id
             join tnce t on t.run_id = a.run_id and t.pair_id = a.d4_pair_id
             where a.surface_id = '{surface}' and a.symmetry <> 'identity'"
        ))
    };
    assert!(off_db("flat", "a.flat_ratio_40000") < 1e-5, "single precision");
    let plain = off_db("wood", "1.0");
    let normalised = off_db("wood", "a.flat_ratio_40000");
    assert!(plain > 0.5 && normalised < 0.2 * plain, "{plain} and {normalised} dB");
}

#[test]
fn refusals_say_what_is_there() {
    let place = lake();
    place.fails(1, &["figure", "grid", "brick"], "surface `brick` is not in the lake");
    place.fails(1, &["figure", "grid", "--where", "surface_id = 'x'"], "selects no surface");
    place.fails(1, &["figure", "grid", "wood", "-o", "x.gif"], "hint: svg, pdf or png");
    place.fails(1, &["figure", "levels", "wood", "-o", "x.tex"], "hint: svg, pdf, png or csv");
    place.fails(1, &["figure", "filters", "-o", "{surface}.svg"], "the figure is of none");
    place.fails(1, &["figure", "table", "wood", "--less", "brick"], "surface `brick` is not in the lake");
    place.fails(1, &["figure", "table", "wood", "--less", "flat", "--values", "energies"], "leave one of them out");
    place.fails(1, &["figure", "table", "wood", "--less", "flat", "--values", "diffusion"], "leave one of them out");
    place.fails(1, &["figure", "grid", "--where", "surface = 'x'"], "no column `surface`");
    place.fails(1, &["figure", "table", "wood", "-o", "x.svg"], "hint: tex, csv or md");
    place.fails(1, &["figure", "grid", "wood", "--band", "7"], "there is no band `7`");
    place.fails(1, &["figure", "steps", "wood", "--pair", "99999"], "has no pair 99999");
    place.fails(1, &["figure", "generation", "primitives"], "`primitives` has no stones with joints");
    place.fails(1, &["figure", "setup", "--pair", "99999"], "the grid has no pair 99999; hint: 0 to ");
    place.fails(2, &["figure", "grid"], "required");
}

mod slow {
    use super::*;

    #[test]
    fn every_figure_is_a_file() {
        let place = lake();
        for args in [
            &["filters"][..],
            &["levels", "wood", "flat"],
            &["coverage"],
            &["map"],
            &["som"],
            &["generation"],
            &["setup"],
            &["steps", "wood", "--celsius", "30,15"],
            &["relief", "wood"],
        ] {
            let name = args[0];
            let files = ["svg", "pdf", "png"].map(|extension| format!("{name}.{extension}"));
            let output: Vec<&str> = files.iter().flat_map(|file| ["-o", file]).collect();
            place.ok(&[&["figure"], args, &output[..]].concat());
            let [svg, pdf, png] = files.map(|file| std::fs::read(place.path(&file)).expect("read"));
            assert!(svg.starts_with(b"<svg ") && svg.ends_with(b"</svg>\n"), "{name}");
            assert!(pdf.starts_with(b"%PDF-") && pdf.windows(14).any(|w| w == b"(echolake 0.1."), "{name}");
            assert!(png.starts_with(b"\x89PNG") && png.windows(8).any(|w| w == b"iTXtLake"), "{name}");
        }
        place.ok(&["figure", "grid", "--where", "surface_id <> 'foam'", "-o", "each/{surface}.svg"]);
        let mut written: Vec<_> =
            std::fs::read_dir(place.path("each")).expect("listed").map(|e| e.expect("an entry").file_name()).collect();
        written.sort();
        assert_eq!(written, ["flat.svg", "wood.svg"]);
    }
}
