//! The paper's pictures and tables, drawn from plain data. It knows no lake: the server and the command bring numbers.
//!
//! A figure ([`GridFigure`], [`NceFigure`], ...) is laid out as a [`FigureDrawing`], a list of shapes, which is written
//! as SVG, PDF or PNG: the same picture on the catalogue's pages and in a paper. A [`FigureTable`] is written as LaTeX,
//! CSV or Markdown. Each file says in its [`FigureNotes`] where it comes from.
//!
//! ```
//! use echolake_figures::{FigureNotes, FilterFigure};
//!
//! let figure = FilterFigure { centres_hz: vec![2500.0, 5000.0, 10000.0], low_hz: 2000.0, high_hz: 40000.0, width_px:
//! 480.0 }; let svg = figure.draw(&FigureNotes { title: "Filter bank".into(), ..FigureNotes::default() }).to_svg();
//! assert!(svg.contains("5 kHz"));
//! ```

mod colours;
mod coverage;
mod drawing;
mod filters;
mod font;
mod frame;
mod grid;
mod map;
mod nce;
mod notes;
mod output;
mod picture;
mod relief;
mod steps;
mod table;

pub use colours::LevelPalette;
pub use coverage::{CoverageFigure, CoverageZone};
pub use drawing::FigureDrawing;
pub use filters::FilterFigure;
pub use grid::{BandLevels, GridFigure, GridLayer, GridPanel, GridPosition, GridScale};
pub use map::{MapFigure, MapPosition};
pub use nce::{NceFigure, NcePanel};
pub use notes::FigureNotes;
pub use picture::encode_grey_png;
pub use relief::{ReliefFigure, ReliefPanel};
pub use steps::{ResponseTrace, StepsFigure, StepsRow};
pub use table::{FigureTable, TableRow};
