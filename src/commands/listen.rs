//! `echolake listen`: a recording as a surface would reflect it at full scale, and as Flat would.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use echolake_dsp::full_scale_octave::OctaveGap;
use echolake_export::{DryRecording, ListenedResponse, write_sounds};
use echolake_import::DryWav;
use echolake_lake::Lake;
use echolake_query::Session;
use echolake_query::figure_rows::quote_literal;
use echolake_schema::{ErrorCause, SurfaceId};
use serde::Deserialize;

use crate::CommandOutcome;

#[derive(Debug, Args)]
pub(crate) struct ListenArgs {
    /// The surface; its Flat is written beside it.
    surface: SurfaceId,
    /// Number of the pair of microphone and speaker.
    pair: u32,
    /// A recording without a room, as WAV; FILE#2 is its second channel.
    #[arg(long, value_name = "FILE")]
    dry: PathBuf,
    /// The response that the recording is convolved with.
    #[arg(long, value_enum, default_value_t = ListenedSignal::Reflected)]
    signal: ListenedSignal,
    /// Give Flat's sound the energy of the surface's; by default both have one gain.
    #[arg(long)]
    match_levels: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// The new folder.
    #[arg(short, long, value_name = "FOLDER")]
    output: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ListenedSignal {
    /// Without the direct sound, as the tables' levels are of.
    Reflected,
    /// With the direct sound.
    Measured,
}

#[derive(Deserialize)]
struct ResponseRow {
    surface_id: String,
    run_id: String,
    origin: String,
    flat_reference: Option<String>,
    samples: Option<Vec<f32>>,
}

pub(crate) async fn run_listen(args: &ListenArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    let dry = DryWav::open(&args.dry).context("--dry")?;
    if let Some(channel) = dry.describe_channel() {
        eprintln!("--dry is {channel}; hint: `file.wav#2` names the second one");
    }
    let session = Session::new(&lake)?;
    let surface = newest_response(&session, args, args.surface.as_str()).await?;
    let flat = surface.flat_reference.clone().with_context(|| format!("{} has no Flat", args.surface))?;
    let mut rows = vec![surface];
    if flat != args.surface.as_str() {
        rows.push(newest_response(&session, args, &flat).await?);
    }
    // Models are smaller than what they stand for, and sound is as fast: all takes longer at full scale.
    let scale = lake.rig().known_scale().ok_or(OctaveGap::UnknownScale)?;
    let rate_hz = (lake.rig().sweep.rate_hz.get() / scale).round() as u32;
    let names: Vec<String> =
        rows.iter().map(|row| format!("{}-{}-{}", row.surface_id, args.pair, row.origin)).collect();
    let responses: Vec<_> = rows
        .iter()
        .zip(&names)
        .map(|(row, name)| ListenedResponse { name, samples: row.samples.as_deref().unwrap_or_default(), rate_hz })
        .collect();
    let read_block = |range| dry.read_block(range).map_err(ErrorCause::from);
    let recording = DryRecording { read_block: &read_block, sample_count: dry.sample_count(), rate_hz: dry.rate_hz() };
    let written = tokio::task::block_in_place(|| write_sounds(&args.output, recording, &responses, args.match_levels));
    let levels = written?;
    if args.json {
        super::print_line(&serde_json::to_string_pretty(&levels)?)?;
    } else {
        super::print_line("response dB  sound dB  gain dB  file")?;
        for level in &levels {
            let [response, sound, gain] = [level.response_db, level.sound_db, level.gain_db];
            super::print_line(&format!("{response:11.2}  {sound:8.2}  {gain:7.2}  {}", level.file))?;
        }
    }
    let [low_hz, high_hz] = [lake.rig().sweep.low_hz, lake.rig().sweep.high_hz].map(|hz| hz / scale);
    eprintln!(
        "{}: {} files of {low_hz:.0} to {high_hz:.0} Hz at full scale, which the sweep had",
        args.output.display(),
        levels.len()
    );
    Ok(CommandOutcome::Whole)
}

// Of the surface's newest run, as its row in `surfaces` names it.
async fn newest_response(session: &Session, args: &ListenArgs, surface: &str) -> anyhow::Result<ResponseRow> {
    let samples = match args.signal {
        ListenedSignal::Reflected => "reflected_ir",
        ListenedSignal::Measured => "ir",
    };
    let sql = format!(
        "select s.surface_id, s.run_id, s.origin, s.flat_reference, i.{samples} as samples from surfaces s \
         left join (select run_id, {samples} from ir where surface_id = {name} and pair_id = {pair}) i \
         on i.run_id = s.run_id where s.surface_id = {name}",
        name = quote_literal(surface),
        pair = args.pair
    );
    let row: Option<ResponseRow> = super::sql::query_rows(session, &sql).await?.pop();
    let row = row.with_context(|| format!("no surface `{surface}`; hint: echolake sql \"select * from surfaces\""))?;
    if row.samples.is_none() {
        anyhow::bail!(
            "surface `{surface}` has no {samples} of pair {} in its newest run, {run}; hint: echolake sql \"select \
             pair_id from ir where run_id = '{run}'\"",
            args.pair,
            run = row.run_id
        );
    }
    Ok(row)
}
