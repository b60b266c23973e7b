//! `room_parameters`: one row per measurement and octave, and one of all frequencies, with reverberation times and
//! energies by ISO 3382-1.

use std::collections::HashMap;

use echolake_schema::Rig;

use super::column_note;

/// Nominal midband frequencies of octaves, Hz.
const OCTAVES_HZ: [f64; 11] = [31.5, 63.0, 125.0, 250.0, 500.0, 1e3, 2e3, 4e3, 8e3, 16e3, 31.5e3];
/// Upper edge of an octave over its nominal midband frequency, at most.
const UPPER_EDGE: f64 = 1.43;

/// Fields of the function's answer: unit and meaning.
const COLUMNS: [(&str, &str, &str); 15] = [
    ("edt_s", "s", "Early decay time, from 0 to -10 dB; null if the range is less than 25 dB"),
    ("t20_s", "s", "Reverberation time from -5 to -25 dB; null if the range is less than 35 dB"),
    ("t20_u_s", "s", "Its standard deviation by the octave's width, ISO 3382-2; null for all frequencies"),
    ("t30_s", "s", "Reverberation time from -5 to -35 dB; null if the range is less than 45 dB"),
    ("t30_u_s", "s", "Its standard deviation by the octave's width, ISO 3382-2; null for all frequencies"),
    ("t20_nonlinearity", "1e-3", "1000 (1 - r^2) of T20's decay and its line; over 10 is in doubt"),
    ("t30_nonlinearity", "1e-3", "1000 (1 - r^2) of T30's decay and its line; over 10 is in doubt"),
    ("curvature_percent", "%", "By how much T30 is longer than T20; over 10 is in doubt"),
    ("c50_db", "dB", "Clarity: energy of the first 50 ms over the later"),
    ("c80_db", "dB", "Clarity: energy of the first 80 ms over the later"),
    ("d50", "1", "Definition: share of the energy in the first 50 ms"),
    ("ts_ms", "ms", "Centre time after the arrival"),
    ("range_db", "dB", "Range of the decay curve from its start to where the decay meets the noise"),
    ("reason", "", "Why values are missing"),
    ("doubt", "", "Why the times may not be what they are taken for: the decay is no line, or has more than one slope"),
];

/// Returns the octaves whose midband frequency is in the sweep.
fn octaves_hz(rig: &Rig) -> impl Iterator<Item = f64> {
    let sweep = rig.sweep.low_hz..=rig.sweep.high_hz;
    let highest = rig.sweep.rate_hz.get() / 2.0 / UPPER_EDGE;
    OCTAVES_HZ.into_iter().filter(move |hz| sweep.contains(hz) && *hz < highest)
}

// The bands come first: the first side is held in memory, the other side streams. `unnest` keeps the optimizer from
// computing the struct once for each of its columns.
pub(super) fn view_sql(rig: &Rig) -> String {
    let octaves: String = octaves_hz(rig).map(|hz| format!(", ({hz:?})")).collect();
    let columns: Vec<_> = COLUMNS.iter().map(|(name, ..)| format!("\"room.{name}\" AS {name}")).collect();
    format!(
        "SELECT surface_id, run_id, pair_id, microphone, speaker, midband_hz, {} FROM \
         (SELECT surface_id, run_id, pair_id, microphone, speaker, midband_hz, unnest(room) FROM \
         (SELECT m.surface_id, m.run_id, m.pair_id, m.microphone, m.speaker, b.midband_hz, \
         CASE WHEN b.midband_hz IS NULL THEN room_parameters(coalesce(m.measured_ir, m.ir)) \
         ELSE room_parameters(coalesce(m.measured_ir, m.ir), b.midband_hz) END \
         AS room FROM (VALUES (CAST(NULL AS DOUBLE)){octaves}) AS b(midband_hz) CROSS JOIN measurements m))",
        columns.join(", ")
    )
}

pub(super) fn column_notes() -> HashMap<String, HashMap<String, String>> {
    let midband = ("midband_hz", "Hz", "Nominal midband frequency of the octave; null for all frequencies");
    [midband].into_iter().chain(COLUMNS).map(|(name, unit, comment)| column_note(name, unit, comment)).collect()
}
