//! `echolake panel`: a generated relief as a mesh.

use anyhow::Context as _;
use echolake_acquisition::mesh::{Format, Mesh};

use crate::Done;
use crate::cli::PanelArgs;

/// Cells along each side of a written mesh, and its back, mm.
const CELLS: usize = 274;
const BACK_MM: f32 = -30.0;

pub(crate) fn run(args: &PanelArgs) -> anyhow::Result<Done> {
    let relief = super::acquire::with_parameters(&args.name, &args.set)?;
    let format = Format::of(&args.output)?;
    let mesh = Mesh::from_height_field(&relief.height_field(CELLS), BACK_MM);
    std::fs::write(&args.output, mesh.to_bytes(format))
        .with_context(|| format!("cannot write `{}`", args.output.display()))?;
    eprintln!("{}: {} triangles", args.output.display(), mesh.triangles.len());
    Ok(Done::Whole)
}
