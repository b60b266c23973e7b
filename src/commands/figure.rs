//! `echolake figure`: the paper's pictures and tables as files.

mod calculated;
mod drift;
mod levels;
mod output;
mod source;
mod surfaces;
mod tables;

use clap::{Args, Subcommand, ValueEnum};
use echolake_lake::Lake;
use echolake_query::figure_rows::LevelReference;
use echolake_schema::SurfaceId;

use crate::CommandOutcome;
use output::{FigureFormats, OutputArgs};
use source::FigureSource;

#[derive(Debug, Subcommand)]
pub(crate) enum FigureCommand {
    /// TNCE of each point's pair with one microphone point, layers across, bands down.
    Grid(GridArgs),
    /// NCE curves stacked by band, beside Flat's total.
    Nce(NceArgs),
    /// A table of surfaces by band.
    Table(TableArgs),
    /// Levels by band with error bars, a series for each surface.
    Levels(LevelsArgs),
    /// Control chart of a Flat: its level by band, run after run, and the runs from which on it is another.
    Drift(DriftArgs),
    /// The filter bank.
    Filters(FiltersArgs),
    /// First Fresnel zones of a layer's pairs on the panel.
    Coverage(CoverageArgs),
    /// A response in three rows: measured, corrected, direct sound removed.
    Steps(StepsArgs),
    /// Surfaces as points, close together if they reflect alike.
    Map(MapArgs),
    /// Surfaces on the units of a self-organising map, beside each other if they reflect alike.
    Som(MapArgs),
    /// Reliefs in oblique light.
    Relief(ReliefArgs),
    /// The steps in which a wall is generated: flat, subdivided, thickened, with joints and roughness.
    Generation(GenerationArgs),
    /// The grid's layers and both arms over the panel.
    Setup(SetupArgs),
}

/// The surfaces of a figure, in this order.
#[derive(Debug, Args)]
pub(super) struct SelectionArgs {
    /// Names of surfaces.
    #[arg(value_name = "SURFACE", required_unless_present = "predicate")]
    surfaces: Vec<SurfaceId>,
    /// Further surfaces, by an SQL predicate over the columns of table surfaces.
    #[arg(long = "where", value_name = "PREDICATE")]
    predicate: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct GridArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    #[command(flatten)]
    output: OutputArgs,
    /// Grid point of the microphone: a number, layer/x/y, or x y z in mm. By default that in the middle of layer 0.
    #[arg(long, value_name = "POINT")]
    microphone: Option<String>,
    #[command(flatten)]
    reference: ReferenceArgs,
    /// Only this band: its centre in Hz, or total.
    #[arg(long)]
    band: Option<String>,
    /// Subtract the levels of this surface from those of the others.
    #[arg(long, value_name = "SURFACE")]
    less: Option<SurfaceId>,
    /// The paper's colours: white at -20 dB, black at 0 dB, red at +6 dB. By default grey is 0 dB, blue below, orange
    /// above, and the range fits.
    #[arg(long)]
    paper_colours: bool,
    /// Number of surfaces per row.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=20))]
    columns: u32,
}

/// Reference of levels.
#[derive(Debug, Args)]
struct ReferenceArgs {
    /// Reference of the bands' levels: Flat's energy in the same band, as on the catalogue's pages and in the paper's
    /// grid plots, or in all bands, as in the paper's tables.
    #[arg(long, value_enum, default_value_t = OverArg::Band)]
    over: OverArg,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum OverArg {
    Band,
    Total,
}

impl From<OverArg> for LevelReference {
    fn from(over: OverArg) -> Self {
        match over {
            OverArg::Band => Self::FlatBand,
            OverArg::Total => Self::FlatTotal,
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct NceArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    #[command(flatten)]
    output: OutputArgs,
    /// Grid point whose pairs the mean is over; by default it is over all pairs.
    #[arg(long, value_name = "POINT")]
    microphone: Option<String>,
    /// Number of surfaces per row.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=20))]
    columns: u32,
}

#[derive(Debug, Args)]
pub(crate) struct TableArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    #[command(flatten)]
    output: OutputArgs,
    /// Values of the table.
    #[arg(long, value_enum, default_value_t = ValuesArg::Shown)]
    values: ValuesArg,
    #[command(flatten)]
    reference: ReferenceArgs,
    /// Subtract the levels of this surface from those of the others.
    #[arg(long, value_name = "SURFACE")]
    less: Option<SurfaceId>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ValuesArg {
    /// Levels as pages show them: without Foam's own reflection if it is known, with their standard uncertainty.
    Shown,
    /// Mean of the TNCE values up to their 90th percentile, in dB, with its standard uncertainty; as in the paper, it
    /// holds Foam's own reflection.
    Levels,
    /// The same without Foam's own reflection, which is estimated.
    UnbiasedLevels,
    /// Mean TNCE over all pairs, linear, beside Flat's, with the difference in per cent. A few loud pairs raise it,
    /// which levels leave out.
    Energies,
    /// Diffusion coefficient, the mean over grid points: how evenly a point's pairs share the reflected energy. The
    /// grid is in the near field, where Flat is even, too: compare surfaces with each other alone.
    Diffusion,
}

#[derive(Debug, Args)]
pub(crate) struct LevelsArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    reference: ReferenceArgs,
    /// Subtract the levels of this surface from those of the others.
    #[arg(long, value_name = "SURFACE")]
    less: Option<SurfaceId>,
    /// Draw levels as in the paper, which hold Foam's own reflection.
    #[arg(long)]
    measured: bool,
}

#[derive(Debug, Args)]
pub(crate) struct DriftArgs {
    /// The Flat; by default the lake's.
    #[arg(value_name = "SURFACE")]
    surface: Option<SurfaceId>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
pub(crate) struct FiltersArgs {
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
pub(crate) struct CoverageArgs {
    #[command(flatten)]
    output: OutputArgs,
    /// Layer of both points, 0 the lowest.
    #[arg(long, default_value_t = 0)]
    layer: u32,
    /// Frequencies in Hz; by default the sweep's limits, the upper one first.
    #[arg(long, value_delimiter = ',', value_name = "HZ")]
    frequencies: Vec<f64>,
}

#[derive(Debug, Args)]
pub(crate) struct StepsArgs {
    /// Name of the surface.
    #[arg(value_name = "SURFACE")]
    surface: SurfaceId,
    #[command(flatten)]
    output: OutputArgs,
    /// The pair.
    #[arg(long, default_value_t = 0)]
    pair: u32,
    /// Temperatures that the second row corrects, as if it had been measured at them; by default the measured one. The
    /// paper shows 30 and 15.
    #[arg(long, value_delimiter = ',', value_name = "C", allow_negative_numbers = true)]
    celsius: Vec<f64>,
}

#[derive(Debug, Args)]
pub(crate) struct MapArgs {
    #[command(flatten)]
    output: OutputArgs,
    /// Selection of surfaces: an SQL predicate over the columns of table surfaces; by default all but Foam.
    #[arg(long = "where", value_name = "PREDICATE")]
    predicate: Option<String>,
}

/// What surfaces are placed on.
#[derive(Debug, Clone, Copy)]
enum MapKind {
    Components,
    Units,
}

#[derive(Debug, Args)]
pub(crate) struct ReliefArgs {
    #[command(flatten)]
    selection: SelectionArgs,
    #[command(flatten)]
    output: OutputArgs,
    /// Number of surfaces per row.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=20))]
    columns: u32,
}

#[derive(Debug, Args)]
pub(crate) struct GenerationArgs {
    /// Kind of wall, or a panel of the paper; `echolake panel --list` prints all.
    #[arg(value_name = "NAME", default_value = "flemish_bond")]
    name: String,
    /// Set a parameter of the wall; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
pub(crate) struct SetupArgs {
    #[command(flatten)]
    output: OutputArgs,
    /// The pair at which the arms stand.
    #[arg(long, default_value_t = 0)]
    pair: u32,
}

impl FigureCommand {
    fn check_extensions(&self) -> anyhow::Result<()> {
        let (output, formats) = match self {
            Self::Table(args) => (&args.output, FigureFormats::Table),
            Self::Levels(args) => (&args.output, FigureFormats::Chart),
            Self::Drift(args) => (&args.output, FigureFormats::Chart),
            Self::Grid(GridArgs { output, .. })
            | Self::Nce(NceArgs { output, .. })
            | Self::Filters(FiltersArgs { output, .. })
            | Self::Coverage(CoverageArgs { output, .. })
            | Self::Steps(StepsArgs { output, .. })
            | Self::Map(MapArgs { output, .. })
            | Self::Som(MapArgs { output, .. })
            | Self::Relief(ReliefArgs { output, .. })
            | Self::Generation(GenerationArgs { output, .. })
            | Self::Setup(SetupArgs { output, .. }) => (output, FigureFormats::Drawing),
        };
        output.check_extensions(formats)
    }
}

pub(crate) async fn run_figure(command: &FigureCommand, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    command.check_extensions()?;
    let source = FigureSource::open(Lake::open(lake_url).await?).await?;
    match command {
        FigureCommand::Grid(args) => surfaces::write_grid(&source, args).await?,
        FigureCommand::Nce(args) => surfaces::write_nce(&source, args).await?,
        FigureCommand::Table(args) => tables::write_table(&source, args).await?,
        FigureCommand::Levels(args) => levels::write_levels(&source, args).await?,
        FigureCommand::Drift(args) => drift::write_drift(&source, args).await?,
        FigureCommand::Filters(args) => calculated::write_filters(&source, args)?,
        FigureCommand::Coverage(args) => calculated::write_coverage(&source, args)?,
        FigureCommand::Steps(args) => surfaces::write_steps(&source, args).await?,
        FigureCommand::Map(args) => surfaces::write_map(&source, args, MapKind::Components).await?,
        FigureCommand::Som(args) => surfaces::write_map(&source, args, MapKind::Units).await?,
        FigureCommand::Relief(args) => surfaces::write_relief(&source, args).await?,
        FigureCommand::Generation(args) => calculated::write_generation(&source, args)?,
        FigureCommand::Setup(args) => calculated::write_setup(&source, args)?,
    }
    Ok(CommandOutcome::Whole)
}
