//! Walls in three layers, as the paper makes its panels: any large shape, with any stones, with any joints and skin.
//!
//! Parameters are full-scale: the panel is a tenth of the wall. Every parameter's range is such that all of them at
//! their greatest still fit the relief's 40 mm, so that each combination can be made.

use super::chance::SeededRandom;
use super::macrostructure::{self, MacrostructureModel};
use super::mesostructure::StoneArrangement;
use super::microstructure::{MicrostructureModel, SKIN};
use super::parameter::{ParameterDomain, ParameterValue, ReliefParameter};
use super::settings::{FULL_SCALE, JointShape, MacrostructureShape, WallSettings};
use super::stones::SEED;
use super::{HeightField, PANEL_SIZE_MM, RELIEF_MM};

/// Heights of a cell are the mean of those this far apart or less, mm: a joint is 1 mm wide.
const DETAIL_MM: f64 = 0.4;

/// A wall in layers.
#[derive(Debug, Clone, PartialEq)]
pub struct LayeredWall {
    mesostructure: StoneArrangement,
    settings: Box<WallSettings>,
}

impl LayeredWall {
    /// A wall with its default parameters.
    pub fn new(mesostructure: StoneArrangement) -> Self {
        Self::with(mesostructure, |_, parameter| parameter.default_setting())
    }

    /// A wall with every parameter drawn from its range.
    pub(super) fn drawn(mesostructure: StoneArrangement, chance: SeededRandom) -> Self {
        Self::with(mesostructure, |n, parameter| parameter.domain.value(chance.unit(n)))
    }

    fn with(mesostructure: StoneArrangement, value: impl Fn(u64, &ReliefParameter) -> ParameterValue) -> Self {
        let mut wall = Self { mesostructure, settings: Box::default() };
        wall.set((0..).zip(parameters(mesostructure)).map(|(n, parameter)| (parameter.key, value(n, &parameter))));
        let shape = &mut wall.settings.macrostructure;
        if mesostructure == StoneArrangement::Macrostructure && *shape == MacrostructureShape::Flat {
            // Without stones and flat it would be Flat.
            *shape = MacrostructureShape::WavyXy;
        }
        wall
    }

    /// Returns the arrangement of its stones.
    pub fn mesostructure(&self) -> StoneArrangement {
        self.mesostructure
    }

    /// Its joints and skin, in words.
    pub fn microstructure(&self) -> String {
        let WallSettings { roughness_mm, joint_width_mm: width, joint_depth_mm: depth, joint_shape, .. } =
            *self.settings;
        let skin = if roughness_mm == 0.0 { "smooth".to_owned() } else { format!("rough by {roughness_mm} mm") };
        match joint_shape {
            _ if width == 0.0 || self.mesostructure == StoneArrangement::Macrostructure => skin,
            JointShape::Flush => format!("flush joints {width} mm wide, {skin}"),
            _ => {
                let shape = self.word("joint_shape");
                format!("{shape} joints {width} mm wide and {depth} mm deep, {skin}")
            }
        }
    }

    /// Its large shape.
    pub fn macrostructure(&self) -> String {
        self.word("macrostructure")
    }

    fn word(&self, key: &str) -> String {
        self.parameters().remove(key).and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
    }

    /// Returns its parameters with their values.
    pub fn parameters(&self) -> serde_json::Map<String, serde_json::Value> {
        let Ok(serde_json::Value::Object(mut all)) = serde_json::to_value(&self.settings) else {
            return serde_json::Map::new();
        };
        let own = parameters(self.mesostructure);
        all.retain(|key, _| own.iter().any(|p| p.key == key));
        all
    }

    /// Makes the parameter's value here its default.
    pub(super) fn name_default(&self, parameter: &mut ReliefParameter) {
        if let ParameterDomain::Choice { options, default } = &mut parameter.domain {
            let set = self.word(parameter.key);
            *default = options.iter().find(|o| **o == set).unwrap_or(default);
        }
    }

    /// Sets parameters to values of their domains.
    pub(super) fn set(&mut self, values: impl IntoIterator<Item = (&'static str, ParameterValue)>) {
        let mut all = self.parameters();
        all.extend(values.into_iter().map(|(key, value)| (key.to_owned(), value.into())));
        // Values of a parameter's domain fit its field; a test tries them.
        self.settings = serde_json::from_value(all.into()).unwrap_or_default();
    }

    /// Its heights, each the mean over its cell. Their mean is 0 if that keeps them within the relief.
    pub(super) fn height_field(&self, cells: usize) -> HeightField {
        let settings = &self.settings;
        let shape = MacrostructureModel::of(settings);
        let skin = MicrostructureModel::of(settings);
        let stones = self.mesostructure.stones(settings);
        let half_joint = settings.joint_width_mm / FULL_SCALE / 2.0;
        let height = |x: f64, y: f64| {
            let relief = stones.as_ref().map_or(0.0, |stones| {
                let spot = stones.spot(x, y, half_joint);
                let inside = skin.inside(spot.to_joint);
                if inside < 0.0 { skin.joint(inside, x, y) } else { spot.face }
            });
            shape.height(x, y) + relief + skin.roughness(x, y)
        };
        let pitch = PANEL_SIZE_MM / cells.max(2) as f64;
        let places = ((pitch / DETAIL_MM).ceil() as usize).clamp(2, 6);
        let off = |i: usize| ((i as f64 + 0.5) / places as f64 - 0.5) * pitch;
        let mean = |x: f64, y: f64| {
            let rows = (0..places).map(|j| (0..places).map(|i| height(x + off(i), y + off(j))).sum::<f64>());
            rows.sum::<f64>() / (places * places) as f64
        };
        centred(HeightField::from_fn(PANEL_SIZE_MM, cells, mean))
    }
}

/// Parameters of all layers of a wall.
pub(super) fn parameters(mesostructure: StoneArrangement) -> Vec<ReliefParameter> {
    let own = mesostructure.parameters().iter().copied();
    let seed = own.clone().all(|p| p.key != SEED.key).then_some(SEED);
    macrostructure::PARAMETERS.into_iter().chain(own).chain(SKIN).chain(seed).collect()
}

fn centred(heights: HeightField) -> HeightField {
    let all = heights.heights_mm();
    let mean = all.iter().copied().map(f64::from).sum::<f64>() / all.len() as f64;
    let [low, high] = heights.extent_mm().map(f64::from);
    let shift = (-mean).clamp(RELIEF_MM[0] - low, (RELIEF_MM[1] - high).max(RELIEF_MM[0] - low));
    heights.raised_by(shift)
}

#[cfg(test)]
mod tests {
    use super::super::{Error, PanelRelief, ParameterDomain};
    use super::*;

    fn wall(name: &str, settings: &[(&str, &str)]) -> PanelRelief {
        let mut relief = PanelRelief::by_name(name).expect(name);
        settings.iter().for_each(|(key, value)| relief.set(key, value).expect(key));
        relief
    }

    fn depth(relief: &PanelRelief) -> f32 {
        let [low, high] = relief.height_field(128).extent_mm();
        high - low
    }

    #[test]
    fn layers_add_up() {
        let bricks = wall("stretcher_bond", &[]).height_field(64);
        let dome = [("macrostructure", "convex"), ("macro_depth_mm", "100")];
        let (both, alone) =
            (wall("stretcher_bond", &dome).height_field(64), wall("macrostructure", &dome).height_field(64));
        for (n, height) in both.heights_mm().iter().enumerate() {
            let sum = bricks.heights_mm()[n] + alone.heights_mm()[n];
            assert!((height - sum).abs() < 1e-4, "{n}: {height} {sum}");
        }
    }

    // The heights' bits, as numbers that say when a wall of some seed is no longer what it was, or is another on
    // another machine.
    #[test]
    fn walls_have_the_same_bits_everywhere() {
        let digest = |name: &str| {
            let heights = wall(name, &[("roughness_mm", "4")]).height_field(48);
            let bytes: Vec<u8> = heights.heights_mm().iter().flat_map(|h| h.to_le_bytes()).collect();
            crc32fast::hash(&bytes)
        };
        let digests = StoneArrangement::ALL.map(|m| digest(m.name()));
        assert_eq!(digests, DIGESTS);
    }

    const DIGESTS: [u32; 9] = [
        449_339_013,
        1_870_956_126,
        3_730_505_683,
        112_774_444,
        3_391_104_038,
        581_177_784,
        1_716_257_505,
        1_133_449_639,
        607_196_090,
    ];

    #[test]
    fn seeds_and_walls_are_told_apart() {
        for mesostructure in StoneArrangement::ALL {
            let of = |seed| wall(mesostructure.name(), &[("roughness_mm", "3"), ("seed", seed)]).height_field(32);
            assert_eq!(of("5"), of("5"));
            assert_ne!(of("5"), of("6"), "{mesostructure:?}");
        }
    }

    #[test]
    fn values_out_of_range_are_refused_by_name_range_and_hint() {
        let mut relief = wall("coursed_ashlar", &[]);
        let refused = relief.set("joint_depth_mm", "50").expect_err("too deep").to_string();
        assert_eq!(
            refused,
            "parameter `joint_depth_mm` of relief `coursed_ashlar` is `50`, expected 0 to 40 mm full scale; \
             hint: how far the joints lie behind the stones' faces"
        );
        let refused = relief.set("joint_shape", "round").expect_err("no shape").to_string();
        assert!(refused.contains("recessed, flush, raked, concave, v"), "{refused}");
        for value in ["NaN", "inf", "", "-1", "1e9"] {
            assert!(relief.set("stone_length_mm", value).is_err(), "{value}");
        }
        let refused = relief.set("brick_length_mm", "200").expect_err("no bricks").to_string();
        assert!(refused.contains("course_height_mm"), "{refused}");
    }

    #[test]
    fn parameters_go_through_json() {
        for name in PanelRelief::NAMES {
            let mut relief = PanelRelief::by_name(name).expect(name);
            if relief.describe().iter().any(|p| p.key == "seed") {
                relief.set("seed", "9").expect("a seed");
            }
            assert_eq!(PanelRelief::from_json(&relief.to_json().to_string()), Ok(relief));
        }
        let deep = r#"{"relief": "stretcher_bond", "parameters": {"joint_depth_mm": 400}}"#;
        assert!(matches!(PanelRelief::from_json(deep), Err(Error::Value { .. })));
        for text in ["", "[]", "{}", r#"{"relief": "flat"}"#] {
            assert!(matches!(PanelRelief::from_json(text), Err(Error::Text { .. })), "{text}");
        }
    }

    mod slow {
        use super::*;

        #[test]
        fn parameters_move_what_their_names_say() {
            let flat_bricks = [("projection_mm", "0"), ("lean_mm", "0")];
            let bricks = |more: &[(&str, &str)]| wall("stretcher_bond", &[&flat_bricks, more].concat());
            // A cell of the 512 is 1.14 mm: joints of 30 mm are 3 mm here, and some cells lie wholly in them.
            let deep = |mm| {
                let [low, high] =
                    bricks(&[("joint_width_mm", "30"), ("joint_depth_mm", mm)]).height_field(512).extent_mm();
                high - low
            };
            assert_eq!(deep("0"), 0.0);
            assert!(
                (deep("10") - 1.0).abs() < 1e-5 && (deep("30") - 3.0).abs() < 1e-5,
                "{} {}",
                deep("10"),
                deep("30")
            );
            assert_eq!(depth(&bricks(&[("joint_shape", "flush")])), 0.0);
            let mean_square = |relief: &PanelRelief| {
                let heights = relief.height_field(512);
                heights.heights_mm().iter().map(|h| f64::from(h * h)).sum::<f64>()
            };
            // Heights' mean is 0, so their mean square says how much of the wall lies how deep.
            let wide = |mm| mean_square(&bricks(&[("joint_width_mm", mm)]));
            assert!(wide("20") > 1.5 * wide("10"));
            let shape = |name| mean_square(&bricks(&[("joint_width_mm", "30"), ("joint_shape", name)]));
            let [recessed, concave, v] = ["recessed", "concave", "v"].map(shape);
            assert!(recessed > concave && concave > v, "a v is the shallowest");
            let rough = |mm| mean_square(&wall("macrostructure", &[("macrostructure", "flat"), ("roughness_mm", mm)]));
            let [smooth, single, double] = ["0", "5", "10"].map(rough);
            assert!(smooth == 0.0 && single > 0.0);
            assert!((double / single - 4.0).abs() < 1e-2, "twice as rough");
            let large = |mm| depth(&wall("macrostructure", &[("macrostructure", "convex"), ("macro_depth_mm", mm)]));
            assert!((large("100") - 10.0).abs() < 0.2 && (large("200") - 20.0).abs() < 0.4);
            for (name, key, low, high) in [
                ("coursed_ashlar", "projection_mm", "0", "80"),
                ("slated_stone", "lean_mm", "0", "30"),
                ("polygonal_rubble", "bulge_mm", "0", "40"),
                ("river_rock", "bulge_mm", "20", "120"),
                ("primitives", "primitive_height_mm", "20", "150"),
                ("primitive_root", "well_depth_mm", "20", "150"),
            ] {
                let [less, more] = [low, high].map(|value| depth(&wall(name, &[(key, value)])));
                assert!(more > less + 1.0, "{name} {key}: {less} {more}");
            }
        }

        // Ranges are chosen so that everything fits: all parameters at their greatest, under every large shape, with
        // every joint and every solid.
        #[test]
        fn every_combination_fits_the_relief() {
            for mesostructure in StoneArrangement::ALL {
                let mut greatest = PanelRelief::Layered(LayeredWall::new(mesostructure));
                let parameters = greatest.describe();
                for parameter in &parameters {
                    match parameter.domain {
                        ParameterDomain::Number { high, .. } => {
                            greatest.set(parameter.key, &high.to_string()).expect("in range");
                            assert_eq!(greatest.parameters()[parameter.key], high);
                        }
                        ParameterDomain::Whole { .. } => greatest.set(parameter.key, "7").expect("in range"),
                        ParameterDomain::Choice { .. } => {}
                    }
                }
                for parameter in &parameters {
                    let ParameterDomain::Choice { options, .. } = parameter.domain else { continue };
                    for option in options {
                        let mut relief = greatest.clone();
                        relief.set("macrostructure", "convex").expect("a shape");
                        relief.set(parameter.key, option).expect("an option");
                        assert_eq!(relief.parameters()[parameter.key], *option);
                        let [low, high] = relief.height_field(40).extent_mm().map(f64::from);
                        let fits = low >= RELIEF_MM[0] - 1e-4 && high <= RELIEF_MM[1] + 1e-4;
                        assert!(fits, "{} {}={option}: {low} to {high}", relief.name(), parameter.key);
                    }
                }
            }
        }
    }
}
