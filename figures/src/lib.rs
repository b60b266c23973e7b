//! The paper's pictures and tables, drawn from plain data. It knows no lake: the server and the command bring numbers.
//!
//! A figure ([`GridFigure`], [`NceFigure`], ...) is laid out as a [`FigureDrawing`], a list of shapes, which is written
//! as SVG, PDF or PNG: the same picture on the catalogue's pages and in a paper. A [`FigureTable`] is written as LaTeX,
//! CSV or Markdown. Each file says in its [`FigureNotes`] where it comes from.
//!
//! ```
//! use echolake_figures::{FigureNotes, FilterFigure};
//!
//! let centres_hz = vec![2500.0, 5000.0, 10000.0];
//! let figure = FilterFigure { centres_hz, low_hz: 2000.0, high_hz: 40000.0, width_px: 480.0 };
//! let svg = figure.draw(&FigureNotes { title: "Filter bank".into(), ..FigureNotes::default() }).to_svg();
//! assert!(svg.contains("5 kHz"));
//! ```

mod canvas;
mod kinds;

pub use canvas::colours::LevelPalette;
pub use canvas::drawing::FigureDrawing;
pub use canvas::notes::FigureNotes;
pub use canvas::picture::encode_grey_png;
pub use kinds::coverage::{CoverageFigure, CoverageZone};
pub use kinds::filters::FilterFigure;
pub use kinds::grid::{BandLevels, GridFigure, GridLayer, GridPanel, GridPosition, GridScale};
pub use kinds::growth::GrowthFigure;
pub use kinds::levels::LevelsFigure;
pub use kinds::map::{MapFigure, MapPlane, MapPosition};
pub use kinds::nce::{NceFigure, NcePanel};
pub use kinds::relief::{ReliefFigure, ReliefPanel};
pub use kinds::setup::{ArmLink, SetupArm, SetupFigure};
pub use kinds::steps::{ResponseTrace, StepsFigure, StepsRow};
pub use kinds::table::{FigureTable, TableRow};
