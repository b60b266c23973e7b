//! The lake that figures are made from: its rows, and what files say of it.

use anyhow::Context as _;
use echolake_figures::FigureNotes;
use echolake_lake::Lake;
use echolake_query::figure_rows::{lake_version, quote_literal};
use echolake_query::{PredicateForm, Session};
use echolake_schema::{Point, SurfaceId};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::SelectionArgs;

/// Options whose values are of the machine, and not of the figure.
const LOCAL_OPTIONS: [&str; 4] = ["--lake", "-o", "--output", "--log-format"];

/// A surface of a figure.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct SelectedSurface {
    pub surface_id: String,
    pub run_id: Option<String>,
    pub typology: String,
    pub flat_reference: String,
    pub foam_reference: String,
    pub origin: String,
}

#[derive(Deserialize)]
struct SurfaceWithLevels {}

const SURFACES: &str = "select surface_id, run_id, typology, flat_reference, foam_reference, origin from surfaces";

/// The lake, and one session of queries.
pub(super) struct FigureSource {
    pub lake: Lake,
    session: Session,
    version: String,
}

impl FigureSource {
    pub async fn open(lake: Lake) -> anyhow::Result<Self> {
        let session = Session::new(&lake)?;
        let version = lake_version(session.current_snapshot().await?.as_ref());
        Ok(Self { lake, session, version })
    }

    /// Returns the rows of a query.
    pub async fn query_rows<T: DeserializeOwned>(&self, sql: &str) -> anyhow::Result<Vec<T>> {
        crate::commands::sql::query_rows(&self.session, sql).await
    }

    /// Returns the session.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// Returns the surfaces that are selected, the named ones first.
    ///
    /// # Errors
    /// If one is not in the lake, or none is selected.
    pub async fn selected_surfaces(&self, selection: &SelectionArgs) -> anyhow::Result<Vec<SelectedSurface>> {
        let names: Vec<_> = selection.surfaces.iter().map(|surface| surface.as_str()).collect();
        let mut selected = self.named_surfaces(&names).await?;
        if let Some(predicate) = &selection.predicate {
            let more = self.surfaces_where(predicate).await?;
            selected.extend(more.into_iter().filter(|surface| !names.contains(&surface.surface_id.as_str())));
        }
        Ok(selected)
    }

    /// Returns the surfaces of these names, in their order.
    pub async fn named_surfaces(&self, names: &[&str]) -> anyhow::Result<Vec<SelectedSurface>> {
        if names.is_empty() {
            return Ok(Vec::new());
        }
        let list: Vec<_> = names.iter().map(|name| quote_literal(name)).collect();
        let sql = format!("{SURFACES} where surface_id in ({}) order by run_id desc", list.join(", "));
        let found: Vec<SelectedSurface> = self.query_rows(&sql).await?;
        let surface = |name: &&str| {
            let surface = found.iter().find(|surface| surface.surface_id == *name).cloned();
            surface.with_context(|| {
                format!("surface `{name}` is not in the lake; hint: echolake sql \"select surface_id from surfaces\"")
            })
        };
        names.iter().map(surface).collect()
    }

    /// Checks that there is something to draw: that some of the surfaces have levels.
    ///
    /// # Errors
    /// If none has.
    pub async fn require_levels(&self, surfaces: &[SelectedSurface]) -> anyhow::Result<()> {
        let ids: Vec<_> = surfaces.iter().map(|surface| quote_literal(&surface.surface_id)).collect();
        let list = ids.join(", ");
        let sql = format!("select surface_id from surface_stats where surface_id in ({list}) limit 1");
        let found: Vec<SurfaceWithLevels> = self.query_rows(&sql).await?;
        anyhow::ensure!(
            !found.is_empty(),
            "{} no levels; hint: levels need runs of Flat and Foam with the same pairs; `echolake figure steps {}` \
             draws a response",
            match surfaces {
                [one] => format!("surface `{}` has", one.surface_id),
                _ => "these surfaces have".to_owned(),
            },
            surfaces.first().map_or("SURFACE", |surface| &surface.surface_id)
        );
        Ok(())
    }

    /// Returns the surface whose levels are subtracted from those of the others.
    ///
    /// # Errors
    /// If it is not in the lake.
    pub async fn base_surface(&self, surface: Option<&SurfaceId>) -> anyhow::Result<Option<SelectedSurface>> {
        let names: Vec<_> = surface.map(|surface| surface.as_str()).into_iter().collect();
        Ok(self.named_surfaces(&names).await?.pop())
    }

    /// Returns the surfaces that a predicate selects, by name.
    pub async fn surfaces_where(&self, predicate: &str) -> anyhow::Result<Vec<SelectedSurface>> {
        let select = format!("{SURFACES} where");
        let sql = self.session.append_predicate(&select, predicate, PredicateForm::AnyExpression).context("--where")?;
        let mut found: Vec<SelectedSurface> = self.query_rows(&sql).await.context("--where")?;
        anyhow::ensure!(!found.is_empty(), "`{predicate}` selects no surface; hint: `echolake sql` tries predicates");
        found.sort_by(|a, b| (&a.surface_id, &b.run_id).cmp(&(&b.surface_id, &a.run_id)));
        found.dedup_by(|a, b| a.surface_id == b.surface_id);
        Ok(found)
    }

    /// Returns the grid point that is named, or the one of the lowest layer that is nearest to the middle.
    pub fn microphone_point(&self, named: Option<&str>) -> anyhow::Result<&Point> {
        let grid = self.lake.grid();
        if let Some(text) = named {
            let by_number = text.parse::<usize>().ok();
            return match by_number {
                Some(number) => grid.points().get(number).with_context(|| {
                    format!("`--microphone` is {number}; the grid has the points 0 to {}", grid.points().len() - 1)
                }),
                None => Ok(grid.parse_point(text)?),
            };
        }
        grid.central_point().context("the grid has no points")
    }

    /// Returns what a figure of these surfaces says of itself.
    pub fn figure_notes<'a>(
        &self,
        title: String,
        query: String,
        surfaces: impl IntoIterator<Item = &'a SelectedSurface>,
    ) -> FigureNotes {
        let origins = surfaces.into_iter().map(|surface| surface.origin.clone());
        FigureNotes { title, command: typed_command(), query, ..FigureNotes::of_lake(self.version.clone(), origins) }
    }
}

// The command as it was typed, without the lake and the files.
fn typed_command() -> String {
    let typed: Vec<String> = std::env::args_os().skip(1).map(|word| word.to_string_lossy().into_owned()).collect();
    plain_command(&typed)
}

fn plain_command(typed: &[String]) -> String {
    let mut words = vec!["echolake".to_owned()];
    let mut typed = typed.iter();
    while let Some(word) = typed.next() {
        if LOCAL_OPTIONS.contains(&word.as_str()) {
            typed.next();
        } else if !LOCAL_OPTIONS.iter().any(|o| word.starts_with(&format!("{o}="))) && !word.starts_with("-o") {
            let is_plain = word.chars().all(|c| c.is_ascii_alphanumeric() || "-_./,=".contains(c));
            words.push(if is_plain { word.clone() } else { format!("'{}'", word.replace('\'', "'\\''")) });
        }
    }
    words.join(" ")
}
