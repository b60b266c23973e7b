//! How far the simulation is trusted follows from a table that `tests/simulation/compare_bem.py` writes.

use super::{MEAN_LEVEL_U_DB, TRUSTED_PHASE, UNTRUSTED_ERROR_DB, mean_level_u_db};

/// The page with the table, the table's markers, and its rows. Paths are from this member's folder.
const PAGE: &str = "../docs/devices.md";
const MARKERS: [&str; 2] =
    ["<!-- tests/simulation/compare_bem.py -->", "<!-- end of tests/simulation/compare_bem.py -->"];
const EXPECTED_MEAN: &str = "boundary elements, mean, dB";
const SIMULATED_MEAN: &str = "`steep_facets = true`, mean, dB";
const PAIR_ERROR: &str = "`steep_facets = true`, rms a pair, dB";
const DETAIL_PHASE: &str = "phase of details, rad";
/// Error of single pairs, dB, from which on a simulation is not trusted: our choice, which no table gives.
const UNTRUSTED_PAIR_DB: f64 = 0.9;
/// What the table rounds phases to.
const PHASE_STEP: f64 = 0.01;

/// A relief in a band.
#[derive(Debug)]
struct ComparedBand {
    phase: f64,
    mean_error_db: f64,
    pair_error_db: f64,
}

fn read_file(path: &str) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// A text without line breaks and the beginnings of comments.
fn read_words(path: &str) -> String {
    let text = read_file(path);
    text.split_whitespace().filter(|word| *word != "///").collect::<Vec<_>>().join(" ")
}

/// Values of a row by its name, relief after relief, band after band.
fn row_values(table: &str, name: &str) -> Vec<f64> {
    let cells = table.lines().map(|line| line.split('|').map(str::trim).collect::<Vec<_>>());
    let rows: Vec<_> = cells.filter(|cells| cells.get(2) == Some(&name)).collect();
    let values = rows.iter().flat_map(|cells| cells[3..].iter().filter(|cell| !cell.is_empty()));
    values.map(|cell| cell.parse().unwrap_or_else(|_| panic!("{name}: {cell} is no number"))).collect()
}

fn read_bands() -> Vec<ComparedBand> {
    let page = read_file(PAGE);
    let (_, rest) = page.split_once(MARKERS[0]).expect("the first marker");
    let (table, _) = rest.split_once(MARKERS[1]).expect("the second marker");
    let [expected, simulated, pairs, phases] =
        [EXPECTED_MEAN, SIMULATED_MEAN, PAIR_ERROR, DETAIL_PHASE].map(|name| row_values(table, name));
    assert!(!phases.is_empty(), "{PAGE}: the table has no rows");
    for other in [&expected, &simulated, &pairs] {
        assert_eq!(other.len(), phases.len(), "{PAGE}: a relief of the table lacks a row");
    }
    let band = |at: usize| ComparedBand {
        phase: phases[at],
        mean_error_db: (simulated[at] - expected[at]).abs(),
        pair_error_db: pairs[at],
    };
    (0..phases.len()).map(band).collect()
}

fn greatest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(f64::NEG_INFINITY, f64::max)
}

fn least(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(f64::INFINITY, f64::min)
}

fn rms(bands: &[ComparedBand]) -> f64 {
    (bands.iter().map(|band| band.mean_error_db.powi(2)).sum::<f64>() / bands.len() as f64).sqrt()
}

/// E36: a table that is written again with other numbers needs other constants, and other words in the manual, on the
/// pages and in the contract. The table has 35 bands of 7 reliefs, so errors are of these alone.
#[test]
fn constants_of_trust_follow_from_the_table() {
    let hint = "hint: change schema/src/simulation.rs, then the texts that this test reads";
    let first_untrusted =
        least(read_bands().iter().filter(|band| band.pair_error_db >= UNTRUSTED_PAIR_DB).map(|band| band.phase));
    // The greatest phase of two digits under which no band's pairs are off.
    assert!(
        (first_untrusted - PHASE_STEP - TRUSTED_PHASE).abs() < PHASE_STEP / 2.0,
        "{PAGE}: pairs are off from {first_untrusted} rad on, and the trusted phase is {TRUSTED_PHASE}; {hint}"
    );
    let (trusted, untrusted): (Vec<_>, Vec<_>) = read_bands().into_iter().partition(|band| band.phase <= TRUSTED_PHASE);
    let error_db = rms(&untrusted);
    assert!((error_db - UNTRUSTED_ERROR_DB).abs() < 0.005, "{PAGE}: {error_db:.3} dB over the trusted phase; {hint}");
    for band in trusted.iter().chain(&untrusted) {
        assert!(band.mean_error_db <= 1.96 * mean_level_u_db(Some(band.phase)), "{PAGE}: {band:?}; {hint}");
    }
    let all = || trusted.iter().chain(&untrusted);
    let over_u = all().map(|band| (band.mean_error_db / mean_level_u_db(Some(band.phase))).powi(2)).sum::<f64>();
    let over_u = (over_u / all().count() as f64).sqrt();
    assert!((0.6..1.0).contains(&over_u), "{PAGE}: errors over their uncertainties are {over_u:.2}, rms; {hint}");

    let trusted_pair_db = (greatest(trusted.iter().map(|band| band.pair_error_db)) * 10.0).ceil() / 10.0;
    let untrusted_pair_db = (least(untrusted.iter().map(|band| band.pair_error_db)) * 10.0).floor() / 10.0;
    let texts = [
        (
            PAGE,
            format!(
                "over {TRUSTED_PHASE} rad the pairs are off by {untrusted_pair_db:.1} dB and more, below by \
                 {trusted_pair_db:.1} dB at most"
            ),
        ),
        (
            "../docs/design.md",
            format!(
                "a panel's mean in a band has a standard uncertainty of {} dB and {} dB a radian of the phase of its \
                 details that are narrower than a wavelength, up to {} dB",
                MEAN_LEVEL_U_DB[0], MEAN_LEVEL_U_DB[1], MEAN_LEVEL_U_DB[2]
            ),
        ),
        ("../docs/design.md", format!("of {UNTRUSTED_ERROR_DB} dB and 2 dB over the root of the pairs")),
        ("../server/http/src/catalogue/surface.rs", format!("Over {TRUSTED_PHASE} a simulated relief is off by 1 dB")),
        ("../web/src/pages/Surface.svelte", format!("const GREATEST_PHASE = {TRUSTED_PHASE} ")),
        // What the constants' comments say of the table.
        (
            "src/simulation.rs",
            format!(
                "off by {untrusted_pair_db:.1} dB or more, root mean square, and up to it by {trusted_pair_db:.1} dB \
                 at most. A choice between the table's phases of {:.2} and {first_untrusted:.2}.",
                greatest(trusted.iter().map(|band| band.phase))
            ),
        ),
    ];
    for (path, text) in texts {
        assert!(read_words(path).contains(&text), "{path} does not have `{text}`; {hint}");
    }
}
