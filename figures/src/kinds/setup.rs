//! The rig over its panel: the grid's layers and both arms, in parallel projection.

use crate::canvas::drawing::{
    DrawnShape, FigureColour, FigureDrawing, SMALL_PX, StrokeStyle, TextAnchor, filled_area, filled_ellipse, ink_label,
    sized_label, stroked_line,
};
use crate::canvas::notes::FigureNotes;

/// Direction of view: turned about the vertical, and down from the horizontal.
const AZIMUTH_DEG: f64 = -28.0;
const ELEVATION_DEG: f64 = 24.0;
/// Space around the drawing, and above it for the title, px.
const MARGIN: f32 = 12.0;
const HEAD: f32 = 36.0;

/// A link of an arm: a segment, and its radius, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmLink {
    /// One end, mm from the panel's centre.
    pub from_mm: [f64; 3],
    /// The other end.
    pub to_mm: [f64; 3],
    /// Its radius, mm.
    pub radius_mm: f64,
}

/// An arm that stands at one of the grid's points.
#[derive(Debug, Clone, PartialEq)]
pub struct SetupArm {
    /// What it carries.
    pub name: String,
    /// Its links from the foot on.
    pub links: Vec<ArmLink>,
}

/// Panel, grid and arms.
#[derive(Debug, Clone, PartialEq)]
pub struct SetupFigure {
    /// Edge of the panel, mm.
    pub panel_mm: f64,
    /// The panel's lower side, mm from its mean plane.
    pub bottom_mm: f64,
    /// Points of each layer, mm.
    pub layers_mm: Vec<Vec<[f64; 3]>>,
    /// The arms.
    pub arms: Vec<SetupArm>,
    /// Width of the drawing, px.
    pub width_px: f32,
}

/// Places on the page of places over the panel.
struct Projection {
    scale: f64,
    shift_px: [f64; 2],
}

impl Projection {
    /// Shows all of these in this width.
    fn new(all_mm: &[[f64; 3]], width_px: f32) -> Self {
        let raw = Self { scale: 1.0, shift_px: [0.0; 2] };
        let [left, top] =
            all_mm.iter().map(|mm| raw.place(*mm)).fold([f32::MAX; 2], |m, p| [0, 1].map(|i| m[i].min(p[i])));
        let right = all_mm.iter().map(|mm| raw.place(*mm)[0]).fold(f32::MIN, f32::max);
        let scale = f64::from((width_px - 2.0 * MARGIN) / (right - left).max(1.0));
        Self {
            scale,
            shift_px: [f64::from(MARGIN) - scale * f64::from(left), f64::from(HEAD) - scale * f64::from(top)],
        }
    }

    // Where it is on the page, y downwards.
    fn place(&self, mm: [f64; 3]) -> [f32; 2] {
        let [across, _, up] = turned(mm);
        [(self.shift_px[0] + self.scale * across) as f32, (self.shift_px[1] - self.scale * up) as f32]
    }
}

// Across the page, towards the viewer, and up the page, mm.
fn turned([x, y, z]: [f64; 3]) -> [f64; 3] {
    let [azimuth, elevation] = [AZIMUTH_DEG, ELEVATION_DEG].map(f64::to_radians);
    let across = x * azimuth.cos() - y * azimuth.sin();
    let away = x * azimuth.sin() + y * azimuth.cos();
    let near = z * elevation.sin() - away * elevation.cos();
    [across, near, z * elevation.cos() + away * elevation.sin()]
}

impl SetupFigure {
    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let half = self.panel_mm / 2.0;
        let square = |z: f64| [[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]];
        let ends = self.arms.iter().flat_map(|arm| &arm.links).flat_map(|link| {
            [link.from_mm, link.to_mm].into_iter().flat_map(|[x, y, z]| {
                let r = link.radius_mm;
                [[x - r, y, z - r], [x + r, y, z + r]]
            })
        });
        let points = self.layers_mm.iter().flatten().copied();
        let all: Vec<_> = square(self.bottom_mm).into_iter().chain(square(0.0)).chain(points).chain(ends).collect();
        let page = Projection::new(&all, self.width_px);
        let lowest = all.iter().map(|mm| page.place(*mm)[1]).fold(0.0, f32::max);
        let mut drawing = FigureDrawing::new(self.width_px, lowest + 36.0, notes);
        drawing.add_title();
        let outline = StrokeStyle::new(FigureColour::Ink, 1.0);
        // The two sides of the panel that face the viewer, and its top.
        let [a, b, c, d] = square(0.0);
        let [e, f, g, _] = square(self.bottom_mm);
        for (face, fill) in [
            ([a, b, f, e], FigureColour::Block),
            ([b, c, g, f], FigureColour::Quiet),
            ([a, b, c, d], FigureColour::Rule),
        ] {
            let corners: Vec<_> = face.iter().map(|mm| page.place(*mm)).collect();
            drawing.add_shape(filled_area(corners.clone(), fill));
            drawing.add_shape(stroked_line([corners.clone(), vec![corners[0]]].concat(), outline));
        }
        let mut shapes: Vec<(f64, Vec<DrawnShape>)> = Vec::new();
        let links = self.arms.iter().flat_map(|arm| &arm.links);
        shapes.extend(links.map(|link| (link_depth(link), link_shapes(link, &page))));
        for point in self.layers_mm.iter().flatten() {
            let dot = filled_ellipse(page.place(*point), [2.6, 2.6], 0.0, FigureColour::Accent);
            shapes.push((turned(*point)[1], vec![dot]));
        }
        // What is nearer hides what is behind it.
        shapes.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        shapes.into_iter().flat_map(|(_, shapes)| shapes).for_each(|shape| drawing.add_shape(shape));
        self.draw_labels(&mut drawing, &page);
        drawing.add_origin();
        drawing
    }

    fn draw_labels(&self, drawing: &mut FigureDrawing, page: &Projection) {
        let heights =
            self.layers_mm.iter().filter_map(|layer| Some(format!("{} at {:.0} mm", layer.len(), layer.first()?[2])));
        let text = format!("points: {}", heights.collect::<Vec<_>>().join(", "));
        let at = [MARGIN, drawing.height_px - 20.0];
        drawing.add_shape(sized_label(at, text, TextAnchor::Start, SMALL_PX, FigureColour::Ink));
        for arm in &self.arms {
            let Some(foot) = arm.links.first() else { continue };
            let [x, y] = page.place(foot.from_mm);
            drawing.add_shape(ink_label([x, y + 20.0], arm.name.clone(), TextAnchor::Middle));
        }
    }
}

fn link_depth(link: &ArmLink) -> f64 {
    (turned(link.from_mm)[1] + turned(link.to_mm)[1]) / 2.0
}

// A bar with round ends, outlined.
fn link_shapes(link: &ArmLink, page: &Projection) -> Vec<DrawnShape> {
    let [from, to] = [link.from_mm, link.to_mm].map(|mm| page.place(mm));
    let radius = ((link.radius_mm * page.scale) as f32).max(0.8);
    let bar = |radius: f32, colour: FigureColour| {
        let end = |at: [f32; 2]| filled_ellipse(at, [radius, radius], 0.0, colour);
        [stroked_line(vec![from, to], StrokeStyle::new(colour, 2.0 * radius)), end(from), end(to)]
    };
    [bar(radius + 0.8, FigureColour::Ink), bar(radius, FigureColour::Block)].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_higher_is_higher_on_the_page_and_points_are_counted() {
        let link = ArmLink { from_mm: [-500.0, 0.0, -100.0], to_mm: [-500.0, 0.0, 200.0], radius_mm: 60.0 };
        let figure = SetupFigure {
            panel_mm: 600.0,
            bottom_mm: -30.0,
            layers_mm: vec![vec![[-100.0, 0.0, 124.0], [100.0, 0.0, 124.0]], vec![[0.0, 0.0, 474.0]]],
            arms: vec![SetupArm { name: "microphone".into(), links: vec![link] }],
            width_px: 400.0,
        };
        let page = Projection::new(&[link.from_mm, link.to_mm, [300.0, 300.0, 0.0]], 400.0);
        let [foot, head] = [link.from_mm, link.to_mm].map(|mm| page.place(mm));
        // Seen from 24 degrees above, 300 mm of height are 300 cos 24 mm.
        assert!((f64::from(foot[1] - head[1]) / page.scale - 274.06).abs() < 0.01 && (foot[0] - head[0]).abs() < 1e-3);
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        assert!(svg.contains("points: 2 at 124 mm, 1 at 474 mm"), "{svg}");
    }
}
