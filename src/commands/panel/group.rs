//! `echolake panel --group` and `--next`: the loop from steps to panels to results to steps.

use std::path::Path;

use anyhow::Context as _;
use echolake_acquisition::disk::read_text_file;
use echolake_panel::relief::PanelRelief;
use echolake_panel::relief::group::{BandLevel, GroupRanges};

use crate::CommandOutcome;

/// Writes a JSON file for each surface and `group.csv` with a row for each.
pub(super) fn make_group(ranges: &Path, count: usize, folder: &Path) -> anyhow::Result<CommandOutcome> {
    let reliefs = read_ranges(ranges)?.draw_reliefs(count)?;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make `{}`", folder.display()))?;
    let keys: Vec<_> = reliefs.first().map(PanelRelief::parameters).into_iter().flatten().map(|(key, _)| key).collect();
    let mut table = format!("surface_id,relief,{}\n", keys.join(","));
    for (n, relief) in reliefs.iter().enumerate() {
        let surface = format!("{:04}_{}", n / 2 + 1, n % 2);
        super::write_output(&folder.join(format!("{surface}.json")), &serde_json::to_vec_pretty(&relief.to_json())?)?;
        let values: Vec<_> = relief.parameters().values().map(|v| v.to_string().replace('"', "")).collect();
        table += &format!("{surface},{},{}\n", relief.name(), values.join(","));
    }
    super::write_output(&folder.join("group.csv"), table.as_bytes())?;
    eprintln!("{}: {count} surfaces", folder.display());
    eprintln!("next: echolake acquire --surface 0001_0 --parameters {}", folder.join("0001_0.json").display());
    Ok(CommandOutcome::Whole)
}

/// Writes the steps of the next group, and prints the reasons for them.
pub(super) fn write_next_ranges(ranges: &Path, results: &Path, output: &Path) -> anyhow::Result<CommandOutcome> {
    let text = read_text_file(results).with_context(|| format!("cannot read `{}`", results.display()))?;
    let rows = csv::Reader::from_reader(text.as_bytes()).deserialize().collect::<Result<Vec<BandLevel>, _>>();
    let rows = rows.with_context(|| {
        format!("results `{}`, expected surface_id, band and p90_mean_db in every row", results.display())
    })?;
    let step = read_ranges(ranges)?.next_step(&rows).with_context(|| format!("results `{}`", results.display()))?;
    let reasons: String = step.reasons.iter().map(|reason| format!("# {reason}\n")).collect();
    super::write_output(output, (reasons + &step.ranges.to_toml()).as_bytes())?;
    super::super::print_line(&step.reasons.join("\n"))?;
    Ok(CommandOutcome::Whole)
}

fn read_ranges(path: &Path) -> anyhow::Result<GroupRanges> {
    let text = read_text_file(path).with_context(|| format!("cannot read ranges `{}`", path.display()))?;
    GroupRanges::from_toml(&text).with_context(|| format!("ranges `{}`", path.display()))
}
