//! Documentation files of a training set: `README.md`, a dataset card for hubs, and `surfaces.csv`.

use std::fmt::Write as _;

use arrow::datatypes::{DataType, Field};
use echolake_lake::Lake;
use echolake_schema::SurfaceId;
use echolake_schema::tables::{COMMENT, UNIT};

use super::{ExportSummary, Plan, RowSymmetries, Shard, SplitBy, SplitPart, heights};
use crate::error::{Error, Result};

/// The paper that the rig, the bands and TNCE are of.
pub(super) const PAPER: &str = "Rust, R. et al. (2021). A data acquisition setup for data driven acoustic design. \
Building Acoustics 28(4), 345-360. https://doi.org/10.1177/1351010X20986901";

/// Contents of a card: the lake and its version, the plan, and the export's counts.
pub(super) struct CardContents<'a> {
    pub lake: &'a Lake,
    /// The version of table `runs` that the rows are of, as `AS OF` takes it.
    pub lake_version: u64,
    /// Names of the version.
    pub tags: Vec<String>,
    pub plan: &'a Plan,
    pub exported: &'a ExportSummary,
}

impl CardContents<'_> {
    /// Returns the lake's version as `AS OF` takes it, and its names.
    pub fn version_text(&self) -> String {
        let tags: String = self.tags.iter().map(|tag| format!(", tag `{tag}`")).collect();
        format!("`runs@{}`{tags}", self.lake_version)
    }

    /// Returns a summary of one sentence.
    pub fn summary(&self) -> String {
        let rows: u64 = self.exported.parts.iter().map(|p| p.rows).sum();
        let surfaces: usize = self.exported.parts.iter().map(|p| p.surfaces).sum();
        let rate = self.lake.rig().sweep.rate_hz.get();
        format!(
            "{rows} acoustic reflections of {surfaces} relief surfaces: impulse responses at {rate} Hz between a \
             microphone and a speaker over each surface, their energies by band over those of a flat plate, and the \
             surfaces' height maps."
        )
    }

    /// Returns the origins of the surfaces: measured, simulated, imported.
    pub fn origins(&self) -> Vec<String> {
        let mut origins: Vec<_> =
            SplitPart::ALL.iter().flat_map(|p| self.plan.of_part(*p)).map(|s| s.origin.clone()).collect();
        origins.sort();
        origins.dedup();
        origins
    }

    fn split_words(&self) -> &'static str {
        match self.plan.set.split.by {
            SplitBy::Panel => "Physical panels were drawn; what is held out has never been seen.",
            SplitBy::Typology => "Typologies were drawn; no held-out typology is in the training set.",
            SplitBy::Macrostructure => "Macrostructures were drawn; none that is held out is in the training set.",
            SplitBy::Nothing => "Nothing is held out.",
        }
    }
}

/// Returns the text of the card.
pub(super) fn card_text(about: &CardContents<'_>) -> String {
    let mut text = front_matter(about);
    let split = about.plan.set.split;
    let _ = write!(text, "# Reflections of relief surfaces\n\n{}\n\n", about.summary());
    let _ = writeln!(text, "Origin of the data: {}.", about.origins().join(", "));
    if about.origins().iter().any(|o| o == "simulated") {
        text.push_str("Simulated surfaces come from a Kirchhoff model of single reflections, not from a rig.\n");
    }
    if let Some(selection) = &about.plan.set.selection {
        let _ = writeln!(text, "Surfaces were selected by `{}`.", selection.predicate);
    }
    let _ = writeln!(text, "\n## Splits\n\n{} (`{}`, seed {})", about.split_words(), split.by.name(), split.seed);
    text.push_str(
        "No physical panel (column `group`) is in two splits: neither a side of it, nor a repeated run, nor a \
         symmetry.\n",
    );
    text.push_str(if about.plan.set.references {
        "References are among the rows, for training only, because they are in every number anyway: leave out rows \
         whose `typology` is `reference` to learn reliefs. Foam has no energy, Flat is 1 by definition.\n\n"
    } else {
        "References (Flat, Foam and other plain plates) are no rows of this set, because Foam has no energy, Flat is 1 \
         by definition, and the height maps of all are zero; `--references` puts them into split train.\n\n"
    });
    text.push_str(
        "| split | files | panels | surfaces | rows | height maps |\n| --- | ---: | ---: | ---: | ---: | ---: |\n",
    );
    for p in &about.exported.parts {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} |",
            p.part.name(),
            p.files,
            p.panels,
            p.surfaces,
            p.rows,
            p.height_maps
        );
    }
    if !about.exported.left_out.is_empty() {
        let _ = writeln!(
            text,
            "\n{} surfaces are left out, because another side of their panel is in another split: {}.",
            about.exported.left_out.len(),
            listed_names(&about.exported.left_out)
        );
    }
    if about.exported.rejected > 0 {
        let rejected = about.exported.rejected;
        let _ = writeln!(text, "\n{rejected} measurements are left out, because the last verdict rejects them.");
    }
    if about.exported.waiting > 0 {
        let _ = writeln!(text, "\n{} runs that wait for their references are left out.", about.exported.waiting);
    }
    add_files_section(&mut text, about);
    let fields = about.plan.schema().fields();
    let _ = writeln!(text, "\n## Columns of the measurements\n");
    add_column_table(&mut text, fields.iter().map(AsRef::as_ref));
    if let Ok(schema) = heights::height_map_schema() {
        let _ = writeln!(text, "\n## Columns of the height maps\n");
        add_column_table(&mut text, schema.fields().iter().map(AsRef::as_ref));
    }
    add_usage_section(&mut text);
    if about.plan.set.license.is_none() {
        text.push_str(
            "\nNo licence of the data is known (`license: unknown` above); `--license cc-by-4.0` names one.\n",
        );
    }
    let _ = writeln!(text, "\n## Reference\n\n{PAPER}");
    text
}

fn front_matter(about: &CardContents<'_>) -> String {
    let mut text = format!(
        "---\npretty_name: Reflections of relief surfaces\nlicense: {}\nsize_categories:\n- {}\ntags:\n- acoustics\n- \
         impulse-response\nconfigs:\n",
        about.plan.set.license.as_deref().unwrap_or("unknown"),
        size_category(about.exported.parts.iter().map(|p| p.rows).sum()),
    );
    let mut config = |name: &str,
                      default: bool,
                      path: &dyn Fn(SplitPart) -> String,
                      has: &dyn Fn(SplitPart) -> bool| {
        let _ =
            write!(text, "- config_name: {name}\n{}  data_files:\n", if default { "  default: true\n" } else { "" });
        for part in SplitPart::ALL.into_iter().filter(|p| has(*p)) {
            let _ = writeln!(text, "  - split: {}\n    path: {}", part.name(), path(part));
        }
    };
    let of = |part| about.exported.parts.iter().find(|p| p.part == part);
    config("measurements", true, &|p| format!("data/{}-*.parquet", p.name()), &|p| of(p).is_some());
    if about.exported.parts.iter().any(|p| p.height_maps > 0) {
        config("heightmaps", false, &|p| format!("heightmaps/{}.parquet", p.name()), &|p| {
            of(p).is_some_and(|p| p.height_maps > 0)
        });
    }
    text.push_str("---\n\n");
    text
}

/// Returns the names of surfaces, separated by commas.
pub(super) fn listed_names(surfaces: &[SurfaceId]) -> String {
    surfaces.iter().map(SurfaceId::as_str).collect::<Vec<_>>().join(", ")
}

/// Returns the size category that hubs know for a number of rows.
fn size_category(rows: u64) -> &'static str {
    match rows {
        0..1_000 => "n<1K",
        1_000..10_000 => "1K<n<10K",
        10_000..100_000 => "10K<n<100K",
        100_000..1_000_000 => "100K<n<1M",
        1_000_000..10_000_000 => "1M<n<10M",
        10_000_000..100_000_000 => "10M<n<100M",
        _ => "100M<n<1B",
    }
}

fn add_files_section(text: &mut String, about: &CardContents<'_>) {
    text.push_str(
        "\n## Files\n\n- `data/<split>-*.parquet`: measurements. Whole surfaces in a file, one row group a surface, in \
         a drawn order.\n- `heightmaps/<split>.parquet`: the surfaces' heights, joined by `surface_id` and \
         `symmetry`.\n- `surfaces.csv`: every surface and run, its file, rows, and the digests of what its rows were \
         derived from.\n- `statistics.json`: mean and standard deviation of each column over split train, of positions \
         by axis.\n- `croissant.json`: the same as Croissant metadata. `SHA256SUMS`: `sha256sum -c SHA256SUMS` \
         checks all files.\n\n",
    );
    text.push_str(match about.plan.set.symmetries {
        RowSymmetries::None => {
            "Rows are as they were measured. The grid and the panel have the eight symmetries of a \
            square; `echolake.torch.Measurements(symmetries=\"all\")` turns positions and height maps together while \
            it loads.\n"
        }
        RowSymmetries::All => {
            "Every measurement stands there under each of the square's eight symmetries: its \
            positions are turned, its numbers are the same, and the height map of the same `symmetry` is turned with \
            it. Where `swapped` is true, microphone and speaker changed places as well, which relies on reciprocity; \
            leave these rows out where that is not wanted.\n"
        }
    });
    text.push_str(
        "Turned rows are not exactly what a turned panel gives, because the rig's aim and directivity do not turn with \
         it. Energies of Flat, which is the same in every position, differ from those of their images by 0.04, 0.03, \
         0.1, 0.5 and 0.95 dB rms at 2.5 to 40 kHz (simulated), and so do responses. Of levels over Flat's total \
         (`tnce_*`) 0.1 to 0.6 dB stay, of levels over Flat's same band (`tnce_band_*`) up to 0.2 dB. View `augmented` \
         has the ratio of Flat's energies (`flat_ratio_*`) for every row.\n",
    );
    let _ = writeln!(
        text,
        "Made by echolake {} of the lake as {} has it; the same lake, arguments and version give the same \
         bytes.",
        env!("CARGO_PKG_VERSION"),
        about.version_text()
    );
}

fn add_column_table<'a>(text: &mut String, fields: impl Iterator<Item = &'a Field>) {
    text.push_str("| column | type | unit | meaning |\n| --- | --- | --- | --- |\n");
    for field in fields {
        let of = |key: &str| field.metadata().get(key).map_or("", String::as_str);
        let _ = writeln!(text, "| `{}` | {} | {} | {} |", field.name(), column_type(field), of(UNIT), of(COMMENT));
    }
}

fn column_type(field: &Field) -> String {
    match field.data_type() {
        DataType::FixedSizeList(_, length) => format!("{length} x float32"),
        DataType::Utf8 => "string".into(),
        other => other.to_string().to_lowercase(),
    }
}

fn add_usage_section(text: &mut String) {
    text.push_str(
        r#"
## Loading

```python
from datasets import load_dataset
train = load_dataset("parquet", data_files="data/train-*.parquet", split="train", streaming=True)

import polars as pl
rows = pl.scan_parquet("data/train-*.parquet").select("surface_id", "tnce_total").collect()

from echolake.torch import Measurements
loader = Measurements(".", split="train", symmetries="all", heights=True)
```

Responses in column `ir` have the direct sound in them, levels `tnce_*` do not: a set made with `--columns reflected_ir,tnce_total`
has the responses that the levels are of.
"#,
    );
}

/// Returns the text of `surfaces.csv`: the run file and the derivations behind each surface's rows.
pub(super) fn sources_csv(shards: &[(&Shard, Vec<u64>)]) -> Result<String> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    let failed = |e: csv::Error| Error::damaged("surfaces.csv", e);
    csv.write_record([
        "surface_id",
        "run_id",
        "group",
        "split",
        "typology",
        "macrostructure",
        "origin",
        "file",
        "surface_rows",
        "run_file_sha256",
        "run_derivation",
        "reference_derivation",
    ])
    .map_err(failed)?;
    for (shard, rows) in shards {
        for (surface, rows) in shard.surfaces.iter().zip(rows) {
            for run in &surface.runs {
                csv.write_record([
                    surface.id.as_str(),
                    run.visible.run.as_str(),
                    surface.id.panel(),
                    shard.part.name(),
                    &surface.typology,
                    surface.macrostructure.as_deref().unwrap_or_default(),
                    &surface.origin,
                    &shard.name,
                    &rows.to_string(),
                    &run.file_sha256,
                    &run.visible.run_derivation,
                    run.visible.reference_derivation.as_deref().unwrap_or_default(),
                ])
                .map_err(failed)?;
            }
        }
    }
    let bytes = csv.into_inner().map_err(|e| Error::damaged("surfaces.csv", e))?;
    String::from_utf8(bytes).map_err(|e| Error::damaged("surfaces.csv", e))
}
