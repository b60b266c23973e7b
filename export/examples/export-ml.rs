//! Writes a training set, for trying the crate without the command: `export-ml LAKE DIR [all] [by-typology]`.
#![allow(clippy::print_stdout, reason = "a program of its own")]

use std::path::Path;

use echolake_export::{Split, SplitBy, Symmetries, TrainingSet, write_training_set};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<_> = std::env::args().collect();
    let [_, lake, folder, rest @ ..] = arguments.as_slice() else { return Err("export-ml LAKE DIR [all]".into()) };
    let has = |word: &str| rest.iter().any(|r| r == word);
    let lake = echolake_lake::Lake::open(lake).await?;
    let by = if has("by-typology") { SplitBy::Typology } else { SplitBy::Panel };
    let symmetries = if has("all") { Symmetries::All } else { Symmetries::None };
    let set = TrainingSet { symmetries, split: Split { by, ..Split::default() }, columns: Vec::new() };
    let done = write_training_set(&lake, Path::new(folder), &set, &mut |_, _| {}).await?;
    println!("{:?}", done.parts);
    Ok(())
}
