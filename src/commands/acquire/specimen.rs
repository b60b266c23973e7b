//! The specimen from the arguments: a generated relief with its parameters, or a mesh file.

use std::path::Path;

use anyhow::Context as _;
use echolake_acquisition::disk::read_text_file;
use echolake_panel::PanelSpecimen;
use echolake_panel::mesh::{Mesh, PanelSide};
use echolake_panel::paper_panel::PaperPanel;
use echolake_panel::relief::PanelRelief;
use echolake_schema::{Rig, SurfaceId};

use super::AcquireArgs;
use crate::UsageError;

/// Returns the specimen that the arguments name. A real panel is what it is, whatever its surface is called.
pub(super) fn choose_specimen(args: &AcquireArgs, rig: &Rig) -> anyhow::Result<PanelSpecimen> {
    let is_simulated = rig.devices.are_simulated();
    if is_simulated && args.material.is_some() {
        let text = "the simulated rig computes the material of its panel; hint: leave out --material";
        return Err(UsageError(text.to_owned()).into());
    }
    if args.no_geometry {
        let hint = "the simulated rig measures the panel's geometry; hint: leave out --no-geometry";
        anyhow::ensure!(!is_simulated, UsageError(hint.to_owned()));
        return Ok(PanelSpecimen::NoGeometry);
    }
    if !is_simulated && args.mesh.is_none() && args.parameters.is_none() && args.panel.is_none() {
        let text = "the rig's devices are real, and nothing says what the panel looks like; hint: --mesh FILE (or the \
                    --panel or --parameters that it was made from), or --no-geometry";
        return Err(UsageError(text.to_owned()).into());
    }
    let surface = args.surface.as_ref().context("no surface is named; hint: --surface NAME")?;
    Ok(match (&args.mesh, &args.parameters) {
        // Absolute, so that a run can be resumed from another folder.
        (Some(mesh), _) => {
            let path = std::path::absolute(mesh).unwrap_or_else(|_| mesh.clone());
            PanelSpecimen::Mesh(path, args.side.unwrap_or(PanelSide::Front))
        }
        (None, Some(file)) => {
            let mut relief = relief_of_file(file)?;
            set_all(&mut relief, &args.set)?;
            PanelSpecimen::Relief(relief)
        }
        (None, None) => PanelSpecimen::Relief(choose_relief(args.panel.as_deref(), surface, &args.set)?),
    })
}

/// Checks that a mesh can be measured with a rig.
pub(in crate::commands) fn check_mesh(specimen: &PanelSpecimen, rig: &Rig) -> anyhow::Result<()> {
    if let PanelSpecimen::Mesh(path, side) = specimen {
        Mesh::from_file(path)?.seen_from(*side).check_solid(rig.panel.size_mm, rig.panel.depth_mm, path)?;
    }
    Ok(())
}

/// The surface with the specimen's large shape alone: the one that is named, else that of the paper's panel.
pub(super) fn macro_reference(args: &AcquireArgs, rig: &Rig) -> anyhow::Result<Option<SurfaceId>> {
    if args.macro_reference.is_some() || args.mesh.is_some() || args.parameters.is_some() {
        return Ok(args.macro_reference.clone());
    }
    let named = args.surface.as_ref().filter(|_| rig.devices.are_simulated()).map(SurfaceId::as_str);
    let name = args.panel.as_deref().or(named);
    let reference = name.and_then(PaperPanel::by_name).and_then(|panel| panel.macro_reference);
    Ok(reference.map(str::parse).transpose()?)
}

/// The named relief, or the one that the surface's name begins with, with its parameters set.
fn choose_relief(name: Option<&str>, surface: &SurfaceId, set: &[String]) -> anyhow::Result<PanelRelief> {
    let name = name.or_else(|| PanelRelief::guess_name(surface.as_str())).with_context(|| {
        format!(
            "unknown surface `{surface}`: no relief is known for it; hint: --panel {} or --mesh FILE",
            PanelRelief::NAMES.join("|")
        )
    })?;
    with_parameters(name, set)
}

/// A relief with its parameters set from `key=value`.
fn with_parameters(name: &str, set: &[String]) -> anyhow::Result<PanelRelief> {
    let mut relief = PanelRelief::by_name(name)?;
    set_all(&mut relief, set)?;
    Ok(relief)
}

/// Sets parameters from `key=value`.
pub(in crate::commands) fn set_all(relief: &mut PanelRelief, set: &[String]) -> anyhow::Result<()> {
    for setting in set {
        let (key, value) =
            setting.split_once('=').with_context(|| format!("`--set {setting}` has no `=`; hint: --set key=value"))?;
        relief.set_parameter(key, value)?;
    }
    relief.check_depth()?;
    Ok(())
}

/// The relief of a file of parameters.
pub(in crate::commands) fn relief_of_file(path: &Path) -> anyhow::Result<PanelRelief> {
    let text = read_text_file(path).with_context(|| format!("cannot read parameters `{}`", path.display()))?;
    PanelRelief::from_json(&text).with_context(|| format!("parameters `{}`", path.display()))
}
