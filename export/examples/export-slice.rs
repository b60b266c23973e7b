//! Cuts, for trying the crate without the command: `export-slice LAKE RUN FROM_PAIR TO_PAIR FILE [TOPIC]...` writes a
//! slice, with `sofa`, `npz` or `wav` in place of a pair's topics a folder of these.
#![allow(clippy::print_stdout, reason = "a program of its own")]

use std::path::Path;
use std::time::Instant;

use echolake_export::{Check, PendingFile, ResponseFormat, Slice, SliceParams, Taken, write_responses, write_wav};
use echolake_schema::{RunId, Table};
use futures::TryStreamExt as _;

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<_> = std::env::args().collect();
    let [_, lake, run, from, to, path, topics @ ..] = arguments.as_slice() else {
        return Err("export-slice LAKE RUN FROM_PAIR TO_PAIR FILE [TOPIC]...".into());
    };
    let lake = echolake_lake::Lake::open(lake).await?;
    let (run, path): (RunId, _) = (run.parse()?, Path::new(path));
    let taken = taken(&lake, &run, from.parse()?..to.parse()?).await?;
    let surface = lake.snapshot().await?.run(&run).map(|r| r.surface.clone()).into_iter().collect::<Vec<_>>();
    match topics.first().map(String::as_str) {
        Some("sofa") => drop(write_responses(&lake, path, ResponseFormat::Sofa, &surface, &mut |_, _| {}).await?),
        Some("npz") => drop(write_responses(&lake, path, ResponseFormat::Npz, &surface, &mut |_, _| {}).await?),
        Some("wav") => println!("{}", write_wav(&lake, path, &taken, Check::Whole, &mut |_, _| {}).await?),
        _ => slice(&lake, taken, topics, path).await?,
    }
    Ok(())
}

async fn slice(
    lake: &echolake_lake::Lake,
    taken: Vec<Taken>,
    topics: &[String],
    path: &Path,
) -> Result<(), Box<dyn std::error::Error>> {
    let snapshot = lake.snapshot().await?;
    let (started, count) = (Instant::now(), taken.len());
    let params = SliceParams { taken, topics: topics.to_vec(), check: Check::Ends, ..SliceParams::default() };
    let mut slice = Slice::open(lake, &snapshot, params).await?;
    let mut file = PendingFile::create(path)?;
    let (mut bytes, mut first) = (0, None);
    while let Some(piece) = slice.next().await? {
        first.get_or_insert(started.elapsed());
        bytes += piece.len();
        file.write(&piece)?;
    }
    file.publish()?;
    println!("{count} measurements, {bytes} bytes, first after {first:?}, all after {:?}", started.elapsed());
    Ok(())
}

async fn taken(
    lake: &echolake_lake::Lake,
    run: &RunId,
    pairs: std::ops::Range<i32>,
) -> Result<Vec<Taken>, Box<dyn std::error::Error>> {
    let snapshot = lake.snapshot().await?;
    let mut taken = Vec::new();
    for file in snapshot.files_of(Table::Measurements, run) {
        let batches: Vec<_> =
            lake.rows(Table::Measurements, file, &Taken::COLUMNS, 0..file.rows).await?.try_collect().await?;
        for batch in batches {
            let range = pairs.start as u32..pairs.end as u32;
            taken.extend(Taken::of_batch(&batch)?.into_iter().filter(|one| range.contains(&one.pair)));
        }
    }
    Ok(taken)
}
