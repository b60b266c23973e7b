//! `echolake panel`: generated reliefs as meshes, height fields, pictures and parameters; groups of them.

mod group;
mod list;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use clap::Args;
use echolake_figures::encode_grey_png;
use echolake_panel::mesh::{BACK_MM, Mesh, MeshFormat};
use echolake_panel::relief::{HeightField, PanelRelief};

use crate::CommandOutcome;

/// Cells along each side of a mesh without joints, and of those whose joints are 1 mm wide.
const CELLS: usize = 274;
const FINE_CELLS: usize = 585;
/// Cells along each side of a height field, as in the published data.
const FIELD_CELLS: usize = 512;
/// Cells along each side of a picture; two make a pixel.
const PICTURE_CELLS: usize = 1600;

/// Arguments of `echolake panel`.
#[derive(Debug, Args)]
pub(crate) struct PanelArgs {
    /// Kind of relief; --list prints all kinds and their parameters.
    #[arg(required_unless_present_any = ["list", "parameters", "group", "next"])]
    name: Option<String>,
    /// Set a parameter of the relief; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// JSON file of parameters, as `-o FILE.json` writes it, instead of a kind.
    #[arg(long, value_name = "FILE", conflicts_with = "name")]
    parameters: Option<PathBuf>,
    /// Kind of relief of the panel's other side.
    #[arg(long, value_name = "NAME")]
    back: Option<String>,
    /// Set a parameter of the other side; repeatable.
    #[arg(long, value_name = "KEY=VALUE", requires = "back")]
    back_set: Vec<String>,
    /// Output file; repeatable. The extension selects the content: glb or stl for the panel's mesh, png for a picture,
    /// npy for 512 x 512 heights in mm, json for the parameters. The png, npy and json of a panel with two sides are
    /// written as FILE_0 and FILE_1. With --group, the output folder; with --next, the file of the next ranges.
    #[arg(short, long, required_unless_present = "list", value_name = "FILE")]
    output: Vec<PathBuf>,
    /// Cells along each side of the mesh; by default 585 (1 mm each) for walls with joints, and 274 for flat, foam,
    /// wood and prd.
    #[arg(long, value_parser = clap::value_parser!(u32).range(16..=2340))]
    cells: Option<u32>,
    /// Print all kinds and parameters with ranges, defaults and units, or those of the named kind.
    #[arg(long)]
    list: bool,
    /// Print the list as JSON.
    #[arg(long, requires = "list")]
    json: bool,
    /// Generate a group of surfaces, whose parameters go through the ranges in this TOML file in steps: one JSON file
    /// per surface, and group.csv, in the folder of -o.
    #[arg(long, value_name = "RANGES", conflicts_with_all = ["name", "set", "back", "list", "parameters"])]
    group: Option<PathBuf>,
    /// Number of surfaces in the group; two per panel.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    count: u32,
    /// Write the ranges with the steps of the next group: larger if the last group's results are alike, else smaller.
    #[arg(
        long, value_name = "RANGES", requires = "results",
        conflicts_with_all = ["name", "set", "back", "list", "group", "parameters"]
    )]
    next: Option<PathBuf>,
    /// Results of the last group: CSV with surface_id, band and p90_mean_db, from `echolake sql` on surface_stats.
    #[arg(long, value_name = "CSV", requires = "next")]
    results: Option<PathBuf>,
}

pub(crate) fn run_panel(args: &PanelArgs) -> anyhow::Result<CommandOutcome> {
    if args.list {
        return list::list_panels(args.name.as_deref(), args.json);
    }
    if let Some(ranges) = &args.group {
        return group::make_group(ranges, args.count as usize, single_output(&args.output)?);
    }
    if let (Some(ranges), Some(results)) = (&args.next, &args.results) {
        return group::write_next_ranges(ranges, results, single_output(&args.output)?);
    }
    let mut front = match &args.parameters {
        Some(path) => super::acquire::relief_of_file(path)?,
        None => PanelRelief::by_name(args.name.as_deref().unwrap_or_default())?,
    };
    super::acquire::set_all(&mut front, &args.set)?;
    let mut back = args.back.as_deref().map(PanelRelief::by_name).transpose()?;
    if let Some(back) = &mut back {
        super::acquire::set_all(back, &args.back_set)?;
    }
    // Wrong arguments are refused before anything is written.
    let kinds = args.output.iter().map(|path| OutputKind::from_path(path)).collect::<anyhow::Result<Vec<_>>>()?;
    for (path, kind) in args.output.iter().zip(kinds) {
        write_one(path, kind, &front, back.as_ref(), args.cells.map(|n| n as usize))?;
    }
    Ok(CommandOutcome::Whole)
}

/// The content of an output file.
#[derive(Debug, Clone, Copy)]
enum OutputKind {
    Mesh(MeshFormat),
    Picture,
    Heights,
    Parameters,
}

impl OutputKind {
    fn from_path(path: &Path) -> anyhow::Result<Self> {
        Ok(match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("png") => Self::Picture,
            Some("npy") => Self::Heights,
            Some("json") => Self::Parameters,
            _ => Self::Mesh(MeshFormat::from_path(path).with_context(|| {
                format!(
                    "cannot tell what `{}` is to hold; or a picture .png, heights .npy, parameters .json",
                    path.display()
                )
            })?),
        })
    }

    fn encode_relief(self, relief: &PanelRelief) -> anyhow::Result<Vec<u8>> {
        Ok(match self {
            Self::Picture => {
                let pixels = relief.height_field(PICTURE_CELLS).to_pixels();
                encode_grey_png(&pixels, pixels.len().isqrt())?
            }
            Self::Heights => relief.height_field(FIELD_CELLS).to_npy(),
            Self::Parameters => serde_json::to_vec_pretty(&relief.to_json())?,
            Self::Mesh(_) => bail!("a mesh is of a whole panel"),
        })
    }
}

fn write_one(
    path: &Path,
    kind: OutputKind,
    front: &PanelRelief,
    back: Option<&PanelRelief>,
    cells: Option<usize>,
) -> anyhow::Result<()> {
    match (kind, back) {
        (OutputKind::Mesh(format), _) => {
            let field =
                |relief: &PanelRelief| -> HeightField { relief.height_field(cells.unwrap_or(mesh_cells(relief))) };
            let mesh = match back {
                Some(back) => Mesh::double_sided(&field(front), &field(back)),
                None => Mesh::from_height_field(&field(front), BACK_MM),
            };
            write_output(path, &mesh.to_bytes(format))?;
            eprintln!("{}: {} triangles", path.display(), mesh.triangles.len());
        }
        (_, None) => write_output(path, &kind.encode_relief(front)?)?,
        (_, Some(back)) => {
            for (side, relief) in [front, back].into_iter().enumerate() {
                write_output(&of_side(path, side), &kind.encode_relief(relief)?)?;
            }
        }
    }
    Ok(())
}

/// Cells along each side of a relief's mesh.
pub(super) fn mesh_cells(relief: &PanelRelief) -> usize {
    if matches!(relief, PanelRelief::Layered(_)) { FINE_CELLS } else { CELLS }
}

/// `0015.png` is `0015_0.png` for side 0.
fn of_side(path: &Path, side: usize) -> PathBuf {
    let [stem, extension] = [path.file_stem(), path.extension()].map(|part| part.unwrap_or_default().to_string_lossy());
    path.with_file_name(format!("{stem}_{side}.{extension}"))
}

fn single_output(outputs: &[PathBuf]) -> anyhow::Result<&Path> {
    match outputs {
        [path] => Ok(path),
        _ => bail!("{} outputs for a group; hint: one -o", outputs.len()),
    }
}

fn write_output(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("cannot write `{}`", path.display()))
}
