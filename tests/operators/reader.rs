//! The independent reader: what a run file must give, read by the crate `mcap` alone, and what an answer gives.

use std::collections::BTreeMap;
use std::path::Path;

use echolake_schema::messages::{Measurement, Verdict};
use prost::Message as _;

/// Sorted rows of each run: run id, then each row's other columns.
pub(crate) type RowsByRun = BTreeMap<String, Vec<String>>;

/// The query whose rows [`read_measurements`] foretells.
pub(crate) const MEASUREMENTS_QUERY: &str = "select run_id, pair_id, microphone, speaker, attempt, log_time_ns, \
    clipped_samples, temperature_c, humidity_pct from measurements";

/// Returns the sorted rows of measurements that a file must give, as far as the file is whole.
pub(crate) fn read_measurements(path: &Path) -> Vec<String> {
    let bytes = std::fs::read(path).expect("read");
    let options = mcap::read::Options::IgnoreEndMagic.into();
    let messages = mcap::MessageStream::new_with_options(&bytes, options).expect("an MCAP file");
    let mut rows = Vec::new();
    for message in messages.map_while(Result::ok) {
        if message.channel.topic != "/measurement" {
            continue;
        }
        let measured = Measurement::decode(&message.data[..]).expect("a verdict");
        if measured.verdict() == Verdict::Accepted {
            let Measurement { pair_id, microphone, speaker, attempt, clipped_samples, .. } = measured;
            let (time, temperature, humidity) = (message.log_time, measured.temperature_c, measured.humidity_pct);
            rows.push(format!(
                "{pair_id},{microphone},{speaker},{attempt},{time},{clipped_samples},{temperature:?},{humidity:?}"
            ));
        }
    }
    rows.sort();
    rows
}

/// Returns the rows of an answer in CSV whose first column is the run. Numbers with a point are written as Rust does.
pub(crate) fn rows_by_run(csv: &str) -> RowsByRun {
    let mut rows = RowsByRun::new();
    for line in csv.lines().skip(1) {
        let (run, rest) = line.split_once(',').unwrap_or((line, ""));
        let value = |text: &str| match text.parse::<f64>() {
            Ok(number) if text.contains(['.', 'e']) => format!("{number:?}"),
            _ => text.to_owned(),
        };
        rows.entry(run.to_owned()).or_default().push(rest.split(',').map(value).collect::<Vec<_>>().join(","));
    }
    rows.values_mut().for_each(|of_run| of_run.sort());
    rows
}
