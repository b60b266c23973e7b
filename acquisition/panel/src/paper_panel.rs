//! The panels that the paper names, as reliefs (Rust et al. 2021, "A data acquisition setup for data driven acoustic
//! design").
//!
//! The paper prints bonds, joints and stones of its walls, and which of them share a large shape, but not the shapes'
//! dimensions. What it does not print is an assumption here, and named as one.

/// A panel of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PaperPanel {
    /// Its name.
    pub name: &'static str,
    /// The relief that it is made with.
    pub relief: &'static str,
    /// Parameters that differ from the relief's defaults, full scale.
    pub settings: &'static [(&'static str, &'static str)],
    /// The panel with the same large shape and nothing on it.
    pub macro_reference: Option<&'static str>,
    /// Statements of the paper about it.
    pub printed: &'static str,
    /// Assumptions, of which the paper says nothing.
    pub assumed: &'static str,
}

/// The large shape that 0015_1 has alone.
const SHAPE: [(&str, &str); 3] =
    [("macrostructure", "wavy_xy"), ("macro_depth_mm", "120"), ("macro_wavelength_mm", "2500")];
const SHAPE_ASSUMED: &str = "the large shape, waves 120 mm high and 2500 mm long in both directions";
const BRICKS_ASSUMED: &str = "bricks 215 x 65 mm as those of 0013_1, none standing out; the large shape of 0015_1, \
    waves 120 mm high and 2500 mm long in both directions";

impl PaperPanel {
    /// All that the paper describes, by name.
    pub const ALL: [Self; 8] = [
        // Section "Stone vs. brick walls". Nine stones a square metre are 292 mm apart when they are 1.3 times as long
        // as high.
        Self {
            name: "0005_1",
            relief: "polygonal_rubble",
            settings: &[
                SHAPE[0],
                SHAPE[1],
                SHAPE[2],
                ("stone_size_mm", "292"),
                ("joint_width_mm", "25"),
                ("joint_width_jitter_mm", "5"),
                ("joint_depth_mm", "65"),
                ("joint_depth_jitter_mm", "15"),
                ("roughness_mm", "60"),
            ],
            macro_reference: Some("0015_1"),
            printed: "polygonal rubble, nine stones a square metre, joints 20 to 30 mm wide and 50 to 80 mm deep, \
                roughness +-30 mm, the large shape of 0015_1",
            assumed: "the stones' shape, projection and grain; the large shape, waves 120 mm high and 2500 mm long in \
                both directions",
        },
        // Section "Brick wall joints", table "Mortar on brick walls".
        Self {
            name: "0011_1",
            relief: "flemish_bond",
            settings: &[
                SHAPE[0],
                SHAPE[1],
                SHAPE[2],
                ("brick_length_mm", "215"),
                ("brick_height_mm", "65"),
                ("projection_mm", "0"),
                ("lean_mm", "0"),
                ("joint_width_mm", "12"),
                ("joint_depth_mm", "10"),
            ],
            macro_reference: Some("0015_1"),
            printed: "Flemish bond, raked joints 12 mm high on average and 10 mm deep, the large shape of 0015_1",
            assumed: BRICKS_ASSUMED,
        },
        Self {
            name: "0012_1",
            relief: "flemish_bond",
            settings: &[
                SHAPE[0],
                SHAPE[1],
                SHAPE[2],
                ("brick_length_mm", "215"),
                ("brick_height_mm", "65"),
                ("projection_mm", "0"),
                ("lean_mm", "0"),
                ("joint_width_mm", "6"),
                ("joint_depth_mm", "10"),
            ],
            macro_reference: Some("0015_1"),
            printed: "Flemish bond, raked joints 6 mm high on average and 10 mm deep, the large shape of 0015_1",
            assumed: BRICKS_ASSUMED,
        },
        // Section "Stone vs. brick walls".
        Self {
            name: "0013_1",
            relief: "stretcher_bond",
            settings: &[
                SHAPE[0],
                SHAPE[1],
                SHAPE[2],
                ("brick_length_mm", "215"),
                ("brick_height_mm", "65"),
                ("projection_mm", "0"),
                ("lean_mm", "0"),
                ("joint_width_mm", "15"),
                ("joint_width_jitter_mm", "1"),
                ("joint_depth_mm", "10"),
                ("joint_depth_jitter_mm", "1"),
            ],
            macro_reference: Some("0015_1"),
            printed: "stretcher bond, bricks 215 x 65 x 102.5 mm, raked joints 15 +- 1 mm wide and 10 +- 1 mm deep, \
                the large shape of 0015_1",
            assumed: "bricks that do not stand out; the large shape, waves 120 mm high and 2500 mm long in both \
                directions",
        },
        // Section "Macrostructure"; 0015_0 is one of the reference panels.
        Self {
            name: "0015_0",
            relief: "macrostructure",
            settings: &[("macrostructure", "convex"), ("macro_depth_mm", "150")],
            macro_reference: None,
            printed: "a large shape without stones and joints, where convex it returns less energy",
            assumed: "the shape, a dome 150 mm high",
        },
        // Sections "Brick wall joints" and "Stone vs. brick walls".
        Self {
            name: "0015_1",
            relief: "macrostructure",
            settings: &SHAPE,
            macro_reference: None,
            printed: "the large shape of 0005_1, 0011_1, 0012_1 and 0013_1 without stones and joints",
            assumed: SHAPE_ASSUMED,
        },
        // Section "Macrostructure".
        Self {
            name: "0031_0",
            relief: "macrostructure",
            settings: &[
                ("macrostructure", "wavy_xy"),
                ("macro_depth_mm", "200"),
                ("macro_wavelength_mm", "2500"),
                ("macro_phase", "0.5"),
            ],
            macro_reference: None,
            printed: "a large shape without stones and joints, whose concave parts focus",
            assumed: "the shape, waves 200 mm high and 2500 mm long in both directions around a trough",
        },
        // Table 2 alone, which prints energies: 47 and 35 % more than Flat in the lower two bands, half in the upper
        // two.
        Self {
            name: "0072_0",
            relief: "flemish_bond",
            settings: &[
                ("macrostructure", "wavy_xy"),
                ("macro_depth_mm", "120"),
                ("macro_wavelength_mm", "3500"),
                ("macro_phase", "0.5"),
                ("brick_length_mm", "215"),
                ("brick_height_mm", "65"),
                ("joint_width_mm", "15"),
                ("joint_depth_mm", "20"),
            ],
            macro_reference: None,
            printed: "energies by band, nothing of its geometry",
            assumed: "all of it: bricks, as most panels of the archive are, around a trough",
        },
    ];

    /// Returns the panel of this name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|panel| panel.name == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relief::PanelRelief;

    #[test]
    fn every_panel_of_the_paper_is_made_by_its_name() {
        for panel in PaperPanel::ALL {
            let relief = PanelRelief::by_name(panel.name).expect(panel.name);
            assert_eq!(Ok(&relief), PanelRelief::from_paper(&panel).as_ref());
            assert_eq!((relief.name(), PanelRelief::guess_name(panel.name)), (panel.relief, Some(panel.name)));
            for (key, value) in panel.settings {
                let set = &relief.parameters()[*key];
                let same = set.as_str().map_or_else(|| set.as_f64() == value.parse().ok(), |word| word == *value);
                assert!(same, "{}: {key} = {set}, not {value}", panel.name);
            }
            // What it is compared with has its large shape and nothing else.
            let Some(reference) = panel.macro_reference else { continue };
            let reference = PanelRelief::by_name(reference).expect(reference);
            assert_eq!(reference.name(), "macrostructure");
            for key in ["macrostructure", "macro_depth_mm", "macro_wavelength_mm", "macro_phase"] {
                assert_eq!(relief.parameters()[key], reference.parameters()[key], "{}: {key}", panel.name);
            }
        }
        assert_eq!(PanelRelief::guess_name("0012_10"), None);
    }
}
