//! The files that figures go to: their names, their formats by extension, and what they say of themselves.

use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use clap::Args;
use echolake_figures::{FigureDrawing, FigureNotes, FigureTable};

use super::source::SelectedSurface;

/// Extensions of files that a figure can be written to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FigureFormats {
    Drawing,
    /// A drawing whose numbers can be written, too.
    Chart,
    Table,
}

impl FigureFormats {
    fn extensions(self) -> &'static [&'static str] {
        match self {
            Self::Drawing => &["svg", "pdf", "png"],
            Self::Chart => &["svg", "pdf", "png", "csv"],
            Self::Table => &["tex", "csv", "md"],
        }
    }

    /// Checks that a file has one of the extensions.
    fn check_extension(self, path: &Path) -> anyhow::Result<()> {
        let known = self.extensions();
        anyhow::ensure!(
            known.contains(&path_extension(path)),
            "`{}` has another extension; hint: {}",
            path.display(),
            match known {
                [first @ .., last] => format!("{} or {last}", first.join(", ")),
                [] => String::new(),
            }
        );
        Ok(())
    }
}

/// The part of a file's name that stands for a surface.
const PLACEHOLDER: &str = "{surface}";

#[derive(Debug, Args)]
pub(crate) struct OutputArgs {
    /// A file to write, as often as wanted: svg, pdf or png; tex, csv or md of a table; csv of levels, too. With
    /// {surface} in its name, one file for each surface. Without it SVG, or Markdown of a table, goes to stdout.
    #[arg(short, long, value_name = "FILE")]
    output: Vec<PathBuf>,
    /// Title of the figure.
    #[arg(long)]
    title: Option<String>,
}

impl OutputArgs {
    /// Checks the extensions of all files, before the first is written.
    ///
    /// # Errors
    /// If a file has none of the figure's formats.
    pub fn check_extensions(&self, formats: FigureFormats) -> anyhow::Result<()> {
        self.output.iter().try_for_each(|path| formats.check_extension(path))
    }

    /// Returns the surfaces of each figure: each alone if files are named by them, else all together.
    ///
    /// # Errors
    /// If only some of the files are named by surfaces.
    pub fn group_surfaces<'a>(&self, surfaces: &'a [SelectedSurface]) -> anyhow::Result<Vec<&'a [SelectedSurface]>> {
        let named = self.output.iter().filter(|path| path.to_string_lossy().contains(PLACEHOLDER)).count();
        match named {
            0 => Ok(vec![surfaces]),
            _ if named == self.output.len() => Ok(surfaces.chunks(1).collect()),
            _ => bail!("some of the files have {PLACEHOLDER} in their names, some have not; hint: run it twice"),
        }
    }

    /// Returns the title: the one that was asked for, or this.
    pub fn title_or(&self, otherwise: impl FnOnce() -> String) -> String {
        self.title.clone().unwrap_or_else(otherwise)
    }

    /// Writes a drawing to its files.
    pub fn write_drawing(&self, drawing: &FigureDrawing, surfaces: &[SelectedSurface]) -> anyhow::Result<()> {
        if self.output.is_empty() {
            return Ok(std::io::stdout().write_all(drawing.to_svg().as_bytes())?);
        }
        for path in self.output_paths(surfaces)? {
            write_file(&path, &drawing_bytes(drawing, &path, FigureFormats::Drawing)?)?;
        }
        Ok(())
    }

    /// Writes a chart to its files, and its numbers to those that are tables.
    pub fn write_chart(
        &self,
        drawing: &FigureDrawing,
        table: &FigureTable,
        notes: &FigureNotes,
        surfaces: &[SelectedSurface],
    ) -> anyhow::Result<()> {
        if self.output.is_empty() {
            return self.write_drawing(drawing, surfaces);
        }
        for path in self.output_paths(surfaces)? {
            let bytes = match path_extension(&path) {
                "csv" => table.to_csv(notes).into_bytes(),
                _ => drawing_bytes(drawing, &path, FigureFormats::Chart)?,
            };
            write_file(&path, &bytes)?;
        }
        Ok(())
    }

    /// Writes a table to its files.
    pub fn write_table(
        &self,
        table: &FigureTable,
        notes: &FigureNotes,
        surfaces: &[SelectedSurface],
    ) -> anyhow::Result<()> {
        if self.output.is_empty() {
            return Ok(super::super::print_line(table.to_markdown(&FigureNotes::default()).trim_end())?);
        }
        for path in self.output_paths(surfaces)? {
            FigureFormats::Table.check_extension(&path)?;
            let text = match path_extension(&path) {
                "tex" => table.to_latex(notes),
                "csv" => table.to_csv(notes),
                _ => table.to_markdown(notes),
            };
            write_file(&path, text.as_bytes())?;
        }
        Ok(())
    }

    fn output_paths(&self, surfaces: &[SelectedSurface]) -> anyhow::Result<Vec<PathBuf>> {
        let path = |path: &PathBuf| match (path.to_str(), surfaces.first()) {
            (Some(text), Some(surface)) => Ok(PathBuf::from(text.replace(PLACEHOLDER, &surface.surface_id))),
            (Some(text), None) if text.contains(PLACEHOLDER) => {
                bail!("`{text}` is named by a surface, and the figure is of none; hint: a name without {PLACEHOLDER}")
            }
            _ => Ok(path.clone()),
        };
        self.output.iter().map(path).collect()
    }
}

// The drawing in the format of a file.
fn drawing_bytes(drawing: &FigureDrawing, path: &Path, formats: FigureFormats) -> anyhow::Result<Vec<u8>> {
    formats.check_extension(path)?;
    Ok(match path_extension(path) {
        "pdf" => drawing.to_pdf()?,
        "png" => drawing.to_png()?,
        _ => drawing.to_svg().into_bytes(),
    })
}

fn path_extension(path: &Path) -> &str {
    path.extension().and_then(|extension| extension.to_str()).unwrap_or("")
}

fn write_file(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot write `{}`", path.display()))?;
    }
    super::super::write_whole_file(path, bytes)?;
    eprintln!("{}: {}", path.display(), super::super::format_size(bytes.len() as u64));
    Ok(())
}
