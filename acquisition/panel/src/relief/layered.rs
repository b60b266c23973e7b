//! Walls in three layers, as the paper makes its panels: any large shape, with any stones, with any joints and skin.
//!
//! Parameters are full-scale: the panel is a tenth of the wall. Not all of them at their greatest fit the relief's 40
//! mm together: [`LayeredWall::check_depth`] refuses what does not.

use super::chance::SeededRandom;
use super::macrostructure::{self, MacrostructureModel};
use super::mesostructure::StoneArrangement;
use super::microstructure::{JITTER, JOINT_SHAPE, MicrostructureModel, SKIN};
use super::parameter::{ParameterDomain, ParameterValue, ReliefParameter};
use super::settings::{FULL_SCALE, JointShape, MacrostructureShape, WallSettings};
use super::stones::SEED;
use super::{Error, GenerationStep, HeightField, PANEL_SIZE_MM, PanelRelief, RELIEF_MM};

/// Heights of a cell are the mean of those this far apart or less, mm: a joint is 1 mm wide.
const DETAIL_MM: f64 = 0.4;

/// Width and depth of the grooves that mark outlines of stones, full-scale mm.
const GROOVE_MM: f64 = 10.0;
/// Greatest depth of a wall, full-scale mm.
const DEEPEST_MM: f64 = FULL_SCALE * (RELIEF_MM[1] - RELIEF_MM[0]);
const MACRO_DEPTH: &str = "macro_depth_mm";

/// A wall in layers.
#[derive(Debug, Clone, PartialEq)]
pub struct LayeredWall {
    mesostructure: StoneArrangement,
    settings: Box<WallSettings>,
}

impl LayeredWall {
    /// A wall with its default parameters.
    pub fn new(mesostructure: StoneArrangement) -> Self {
        Self::with_values(mesostructure, |_, parameter| parameter.default_setting())
    }

    /// A wall with every parameter drawn from its range; its large shape is as deep as the rest leaves room for.
    pub(super) fn from_chance(mesostructure: StoneArrangement, chance: SeededRandom) -> Self {
        let mut wall =
            Self::with_values(mesostructure, |n, parameter| parameter.domain.value_at(chance.unit_number(n)));
        let rest: f64 = wall.depths_mm().iter().filter(|(key, _)| *key != MACRO_DEPTH).map(|(_, mm)| mm).sum();
        let room = (10.0 * (DEEPEST_MM - rest)).floor() / 10.0;
        wall.settings.macro_depth_mm = wall.settings.macro_depth_mm.min(room);
        wall
    }

    fn with_values(mesostructure: StoneArrangement, value: impl Fn(u64, &ReliefParameter) -> ParameterValue) -> Self {
        let mut wall = Self { mesostructure, settings: Box::default() };
        wall.set_values(
            (0..).zip(wall_parameters(mesostructure)).map(|(n, parameter)| (parameter.key, value(n, &parameter))),
        );
        let shape = &mut wall.settings.macrostructure;
        if mesostructure == StoneArrangement::Macrostructure && *shape == MacrostructureShape::Flat {
            // Without stones and flat it would be Flat.
            *shape = MacrostructureShape::WavyXy;
        }
        wall
    }

    /// Returns the wall as its layers are added to a plane (Rust et al. 2021, figure "Geometry generation steps"): the
    /// stones' outlines as grooves, the stones with the large shape, then joints and roughness. None without joints.
    pub(super) fn generation_steps(&self) -> Vec<GenerationStep> {
        if self.settings.joint_width_mm == 0.0 {
            return Vec::new();
        }
        let thick = WallSettings {
            joint_shape: JointShape::Recessed,
            joint_width_jitter_mm: 0.0,
            joint_depth_jitter_mm: 0.0,
            roughness_mm: 0.0,
            ..(*self.settings).clone()
        };
        let outlined = WallSettings {
            macrostructure: MacrostructureShape::Flat,
            projection_mm: 0.0,
            lean_mm: 0.0,
            bulge_mm: 0.0,
            joint_width_mm: GROOVE_MM,
            joint_depth_mm: GROOVE_MM,
            ..thick.clone()
        };
        let wall = |settings: WallSettings| {
            PanelRelief::Layered(Self { mesostructure: self.mesostructure, settings: Box::new(settings) })
        };
        vec![
            GenerationStep { caption: "Flat", relief: PanelRelief::Flat },
            GenerationStep { caption: "Subdivided", relief: wall(outlined) },
            GenerationStep { caption: "Thickened, large shape", relief: wall(thick) },
            GenerationStep { caption: "Joints and roughness", relief: PanelRelief::Layered(self.clone()) },
        ]
    }

    /// Returns the arrangement of its stones.
    pub fn mesostructure(&self) -> StoneArrangement {
        self.mesostructure
    }

    /// Its joints and skin, in words.
    pub fn microstructure_text(&self) -> String {
        let WallSettings { roughness_mm, joint_width_mm, joint_depth_mm, joint_shape, .. } = *self.settings;
        let skin = if roughness_mm == 0.0 { "smooth".to_owned() } else { format!("rough by {roughness_mm} mm") };
        let told = |mm: f64, jitter: f64| if jitter == 0.0 { mm.to_string() } else { format!("{mm} +- {jitter}") };
        let width = told(joint_width_mm, self.settings.joint_width_jitter_mm);
        let depth = told(joint_depth_mm, self.settings.joint_depth_jitter_mm);
        match joint_shape {
            _ if joint_width_mm == 0.0 || self.mesostructure == StoneArrangement::Macrostructure => skin,
            JointShape::Flush => format!("flush joints {width} mm wide, {skin}"),
            _ => {
                let shape = self.parameter_word("joint_shape");
                format!("{shape} joints {width} mm wide and {depth} mm deep, {skin}")
            }
        }
    }

    /// Its large shape.
    pub fn macrostructure_name(&self) -> String {
        self.parameter_word("macrostructure")
    }

    fn parameter_word(&self, key: &str) -> String {
        self.parameters().remove(key).and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
    }

    /// Returns its parameters with their values.
    pub fn parameters(&self) -> serde_json::Map<String, serde_json::Value> {
        let Ok(serde_json::Value::Object(mut all)) = serde_json::to_value(&self.settings) else {
            return serde_json::Map::new();
        };
        let own = wall_parameters(self.mesostructure);
        all.retain(|key, _| own.iter().any(|p| p.key == key));
        all
    }

    /// Makes the parameter's value here its default.
    pub(super) fn name_default(&self, parameter: &mut ReliefParameter) {
        if let ParameterDomain::Choice { options, default } = &mut parameter.domain {
            let set = self.parameter_word(parameter.key);
            *default = options.iter().find(|o| **o == set).unwrap_or(default);
        }
    }

    /// Sets parameters to values of their domains.
    pub(super) fn set_values(&mut self, values: impl IntoIterator<Item = (&'static str, ParameterValue)>) {
        let mut all = self.parameters();
        all.extend(values.into_iter().map(|(key, value)| (key.to_owned(), value.into())));
        // Values of a parameter's domain fit its field; a test tries them.
        self.settings = serde_json::from_value(all.into()).unwrap_or_default();
    }

    /// Returns what its layers add to its depth at most, full-scale mm, by the parameter.
    fn depths_mm(&self) -> Vec<(&'static str, f64)> {
        let settings = &self.settings;
        let mut depths = vec![
            ("projection_mm", settings.projection_mm),
            ("lean_mm", settings.lean_mm),
            ("bulge_mm", settings.bulge_mm),
            ("primitive_height_mm", settings.primitive_height_mm),
            ("well_depth_mm", settings.well_depth_mm),
            ("roughness_mm", settings.roughness_mm),
        ];
        if settings.macrostructure != MacrostructureShape::Flat {
            depths.push((MACRO_DEPTH, settings.macro_depth_mm));
        }
        let has_joints = settings.joint_width_mm + settings.joint_width_jitter_mm > 0.0;
        if has_joints && settings.joint_shape != JointShape::Flush {
            depths.push(("joint_depth_mm", settings.joint_depth_mm));
            depths.push(("joint_depth_jitter_mm", settings.joint_depth_jitter_mm));
        }
        depths.retain(|(_, mm)| *mm > 0.0);
        depths
    }

    /// Checks that it is not deeper than a panel's side can be.
    ///
    /// # Errors
    /// [`Error::Depth`], which names what it is made of.
    pub(super) fn check_depth(&self) -> Result<(), Error> {
        let depths = self.depths_mm();
        let depth_mm: f64 = depths.iter().map(|(_, mm)| mm).sum();
        if depth_mm <= DEEPEST_MM + 1e-9 {
            return Ok(());
        }
        let parts: Vec<_> = depths.iter().map(|(key, mm)| format!("{key}={mm}")).collect();
        Err(Error::Depth {
            relief: self.mesostructure.name(),
            depth_mm: (10.0 * depth_mm).round() / 10.0,
            greatest_mm: DEEPEST_MM,
            parts: parts.join(", "),
        })
    }

    /// Its heights, each the mean over its cell. Their mean is 0 if that keeps them within the relief.
    pub(super) fn height_field(&self, cells: usize) -> HeightField {
        let settings = &self.settings;
        let shape = MacrostructureModel::from_settings(settings);
        let skin = MicrostructureModel::from_settings(settings);
        let stones = self.mesostructure.stone_layout(settings);
        let half_joint = settings.joint_width_mm / FULL_SCALE / 2.0;
        let height = |x: f64, y: f64| {
            let relief = stones.as_ref().map_or(0.0, |stones| {
                let spot = stones.spot_at(x, y, half_joint);
                let half_width = skin.half_width(x, y);
                if spot.to_joint < half_width { skin.joint_height(spot.to_joint, half_width, x, y) } else { spot.face }
            });
            shape.height_at(x, y) + relief + skin.roughness_at(x, y)
        };
        let pitch = PANEL_SIZE_MM / cells.max(2) as f64;
        let places = ((pitch / DETAIL_MM).ceil() as usize).clamp(2, 6);
        let off = |i: usize| ((i as f64 + 0.5) / places as f64 - 0.5) * pitch;
        let mean = |x: f64, y: f64| {
            let rows = (0..places).map(|j| (0..places).map(|i| height(x + off(i), y + off(j))).sum::<f64>());
            rows.sum::<f64>() / (places * places) as f64
        };
        centre_heights(HeightField::from_fn(PANEL_SIZE_MM, cells, mean))
    }
}

/// Parameters of all layers of a wall.
pub(super) fn wall_parameters(mesostructure: StoneArrangement) -> Vec<ReliefParameter> {
    let own = mesostructure.parameters().iter().copied();
    let seed = own.clone().all(|p| p.key != SEED.key).then_some(SEED);
    let jitter = own.clone().any(|p| p.key == JOINT_SHAPE.key).then_some(JITTER);
    macrostructure::PARAMETERS
        .into_iter()
        .chain(own)
        .chain(jitter.into_iter().flatten())
        .chain(SKIN)
        .chain(seed)
        .collect()
}

fn centre_heights(heights: HeightField) -> HeightField {
    let all = heights.heights_mm();
    let mean = all.iter().copied().map(f64::from).sum::<f64>() / all.len() as f64;
    let [low, high] = heights.extent_mm().map(f64::from);
    let shift = (-mean).clamp(RELIEF_MM[0] - low, (RELIEF_MM[1] - high).max(RELIEF_MM[0] - low));
    heights.raised_by(shift)
}

#[cfg(test)]
mod tests {
    use super::super::{Error, ParameterDomain};
    use super::*;

    fn wall(name: &str, settings: &[(&str, &str)]) -> PanelRelief {
        let mut relief = PanelRelief::by_name(name).expect(name);
        settings.iter().for_each(|(key, value)| relief.set_parameter(key, value).expect(key));
        relief
    }

    fn depth(relief: &PanelRelief) -> f32 {
        let [low, high] = relief.height_field(128).extent_mm();
        high - low
    }

    #[test]
    fn generation_adds_layer_to_layer() {
        let relief = wall("flemish_bond", &[("macrostructure", "convex"), ("macro_depth_mm", "100")]);
        let steps = relief.generation_steps();
        let depths: Vec<_> = steps.iter().map(|step| step.relief.height_field(256).extent_mm()).collect();
        let deep = |step: usize| f64::from(depths[step][1] - depths[step][0]);
        // Grooves of 1 mm at 1:10, a mean over each cell; then a dome of 10 mm and stones that stand out.
        assert!(deep(0) == 0.0 && (0.2..=1.0).contains(&deep(1)) && deep(2) > 9.0, "{depths:?}");
        assert_eq!(steps[3].relief, relief);
        assert!(wall("primitives", &[]).generation_steps().is_empty());
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
        let refused = relief.set_parameter("joint_depth_mm", "90").expect_err("too deep").to_string();
        assert_eq!(
            refused,
            "parameter `joint_depth_mm` of relief `coursed_ashlar` is `90`, expected 0 to 80 mm full scale; \
             hint: how far the joints lie behind the stones' faces"
        );
        let refused = relief.set_parameter("joint_shape", "round").expect_err("no shape").to_string();
        assert!(refused.contains("recessed, flush, raked, concave, v"), "{refused}");
        for value in ["NaN", "inf", "", "-1", "1e9"] {
            assert!(relief.set_parameter("stone_length_mm", value).is_err(), "{value}");
        }
        let refused = relief.set_parameter("brick_length_mm", "200").expect_err("no bricks").to_string();
        assert!(refused.contains("course_height_mm"), "{refused}");
    }

    // Old files of parameters do not name the jitter: they make the walls that they made.
    #[test]
    fn joints_differ_from_their_width_by_their_jitter() {
        let joints = [("joint_width_mm", "15"), ("joint_depth_mm", "40"), ("projection_mm", "0"), ("lean_mm", "0")];
        let of = |more: &[(&str, &str)]| wall("stretcher_bond", &[&joints, more].concat());
        let plain = of(&[]);
        let mut old = plain.to_json();
        old["parameters"].as_object_mut().expect("parameters").retain(|key, _| !key.contains("jitter"));
        assert_eq!(PanelRelief::from_json(&old.to_string()).as_ref(), Ok(&plain));
        // The share of the wall that lies in joints, along one bed joint of 0.05 mm steps.
        let share = |relief: &PanelRelief| {
            let PanelRelief::Layered(wall) = relief else { return Vec::new() };
            let skin = MicrostructureModel::from_settings(&wall.settings);
            (0..2000).map(|n| 20.0 * skin.half_width(f64::from(n) * 0.3, 7.0)).collect::<Vec<f64>>()
        };
        assert!(share(&plain).iter().all(|mm| (mm - 15.0).abs() < 1e-9));
        let uneven = share(&of(&[("joint_width_jitter_mm", "1")]));
        assert!(uneven.iter().all(|mm| (14.0..=16.0).contains(mm)), "{uneven:?}");
        let (least, greatest) = uneven.iter().fold((15.0f64, 15.0f64), |(a, b), mm| (a.min(*mm), b.max(*mm)));
        assert!(least < 14.5 && greatest > 15.5, "{least} {greatest}");
        let deepest = |relief: &PanelRelief| {
            let [low, high] = relief.height_field(585).extent_mm();
            high - low
        };
        let (level, deeper) = (deepest(&plain), deepest(&of(&[("joint_depth_jitter_mm", "10")])));
        assert!(deeper > level + 0.5 && deeper < level + 1.0, "{level} {deeper}");
    }

    #[test]
    fn parameters_go_through_json() {
        for name in PanelRelief::NAMES {
            let mut relief = PanelRelief::by_name(name).expect(name);
            if relief.describe_parameters().iter().any(|p| p.key == "seed") {
                relief.set_parameter("seed", "9").expect("a seed");
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
            assert!((large("100") - 10.0).abs() < 0.2 && (large("400") - 40.0).abs() < 0.8);
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

        // All parameters at their greatest, but for the large shape, which takes what room is left; every large shape,
        // every joint and every solid.
        #[test]
        fn every_combination_fits_the_relief() {
            for mesostructure in StoneArrangement::ALL {
                let mut greatest = PanelRelief::Layered(LayeredWall::new(mesostructure));
                let parameters = greatest.describe_parameters();
                for parameter in &parameters {
                    match parameter.domain {
                        ParameterDomain::Number { high, .. } => {
                            greatest.set_parameter(parameter.key, &high.to_string()).expect("in range");
                            assert_eq!(greatest.parameters()[parameter.key], high);
                        }
                        ParameterDomain::Whole { .. } => greatest.set_parameter(parameter.key, "7").expect("in range"),
                        ParameterDomain::Choice { .. } => {}
                    }
                }
                greatest.set_parameter("macrostructure", "convex").expect("a shape");
                let refused = greatest.check_depth().expect_err("too deep").to_string();
                assert!(refused.contains("macro_depth_mm=400") && refused.contains("expected 400 mm"), "{refused}");
                greatest.set_parameter("macro_depth_mm", "0").expect("in range");
                let PanelRelief::Layered(wall) = &greatest else { continue };
                let room = DEEPEST_MM - wall.depths_mm().iter().map(|(_, mm)| mm).sum::<f64>();
                assert!(room >= 50.0, "{mesostructure:?}: {room}");
                greatest.set_parameter("macro_depth_mm", &room.to_string()).expect("in range");
                for parameter in &parameters {
                    let ParameterDomain::Choice { options, .. } = parameter.domain else { continue };
                    for option in options {
                        let mut relief = greatest.clone();
                        relief.set_parameter(parameter.key, option).expect("an option");
                        assert_eq!(relief.parameters()[parameter.key], *option);
                        assert_eq!(relief.check_depth(), Ok(()));
                        let [low, high] = relief.height_field(40).extent_mm().map(f64::from);
                        let fits = low >= RELIEF_MM[0] - 1e-4 && high <= RELIEF_MM[1] + 1e-4;
                        assert!(fits, "{} {}={option}: {low} to {high}", relief.name(), parameter.key);
                    }
                }
            }
        }
    }
}
