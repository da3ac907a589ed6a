//! Every hyper-parameter of a run: presets, recipe files over them, flags over those.
//!
//! What a parameter means is written beside its value in `paper.toml`; the types here only give
//! each its range.

mod effort;
mod parameters;

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, quoted};
use crate::model::{Columns, HIGHEST_DEGREE};

pub use effort::Effort;
pub use parameters::{Parameter, parameters};

/// Text of preset `paper`, with a comment on every parameter.
const PAPER: &str = include_str!("paper.toml");

/// Every preset: its name and its text. Those that start from another name it by `preset`.
pub const PRESETS: [(&str, &str); 4] = [
    ("default", include_str!("default.toml")),
    ("paper", PAPER),
    ("gentle", include_str!("gentle.toml")),
    ("strong", include_str!("strong.toml")),
];

/// Largest fraction of the Gaussians that a round may leave: with it 10 million Gaussians take 1300 rounds down to a few.
pub const MOST_LEFT_BY_ROUND: f64 = 0.99;
/// Most steps of refinement: a run of a day.
const MOST_STEPS: u32 = 1_000_000;
/// Most merge passes. Every pass reads all frames.
const MOST_PASSES: usize = 16;

/// All hyper-parameters; see `paper.toml` for the meaning of each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The pass over all frames.
    pub scan: ScanParams,
    /// Normalization and weights.
    pub score: ScoreParams,
    /// Stages 1 and 2.
    pub select: Select,
    /// Stage 3.
    pub merge: MergeParams,
    /// Everything that is stored of what is left.
    pub refine: RefineParams,
    /// What deforms it.
    pub field: FieldParams,
    /// How its colors change with direction.
    pub bands: ShDegreeParams,
}

/// Parameters of the pass over all frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ScanParams {
    pub alpha_min: f64,
    pub motion: MotionParams,
    pub snap_noise: bool,
    pub coverage: Coverage,
    pub pixel_stride: NonZeroU32,
    pub view_stride: NonZeroU32,
    pub frame_stride: NonZeroU32,
    pub look_pictures: usize,
    pub non_finite: NonFinite,
}

/// Which steps count as motion and what they are divided by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionParams {
    /// The paper's divisors; steps across gaps of the life span count.
    Literal,
    /// Only steps inside one run of life frames, divided by their number.
    Runs,
}

/// What C measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Coverage {
    /// [`Coverage::Visible`] through cameras of the scene's own, else [`Coverage::Projected`]: a virtual
    /// rig may stand behind walls that no real picture shows.
    Auto,
    /// Σ alpha · transmittance over pixels.
    Visible,
    /// Area of the projected 3σ ellipse inside the image × opacity.
    Projected,
}

/// What to do with a Gaussian that holds NaN or infinity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NonFinite {
    /// Stop and name the Gaussians.
    Error,
    /// Prune it.
    Drop,
    /// Keep it as it is.
    Keep,
}

/// Parameters of the scores.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ScoreParams {
    pub static_term: StaticTerm,
    pub w_static: f64,
    pub w_dynamic: f64,
    pub lambda: f64,
    pub anisotropy: Anisotropy,
    pub mu: f64,
    pub eta: f64,
    pub xi: f64,
    pub weigh_motion_by_life: bool,
    pub norm_epsilon: f64,
    pub clip_norm: bool,
}

/// What S_static starts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StaticTerm {
    /// C.
    Mean,
    /// W.
    Peak,
    /// √(C·W).
    Geometric,
}

/// What E measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Anisotropy {
    /// s_max / s_min.
    Ratio,
    /// ln(s_max / s_mid).
    Log,
}

/// Parameters of stages 1 and 2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct Select {
    pub keep_fraction: f64,
    pub tau_static: f64,
    pub tau_dynamic: f64,
    pub low_priority: LowPriority,
    pub round_fraction: f64,
    pub round_pictures: usize,
    pub round_turns: usize,
    pub contrast_floor: f64,
    pub choose_by_views: bool,
}

/// What becomes of Gaussians outside stage 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LowPriority {
    /// Pruned.
    Drop,
    /// Judged by stage 2 like the candidates.
    Rescue,
}

/// Parameters of stage 3.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct MergeParams {
    pub length_unit: LengthUnit,
    pub max_neighbors: usize,
    pub max_scale_ratio: f64,
    pub max_color_difference: f64,
    pub trajectory: Trajectory,
    pub motion_noise: f64,
    pub max_drift: f64,
    pub max_dead_time: f64,
    pub placement: Placement,
    pub opacity: ProxyOpacity,
    pub sh_high: ShHigh,
    pub passes: Vec<MergePass>,
}

/// Parameters of everything that is stored of what is left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct RefineParams {
    pub refine: AttributeGroups,
    pub refine_steps: u32,
    pub refine_cut_steps: u32,
    pub refine_pictures: usize,
    pub refine_ssim: f64,
    pub refine_knots: usize,
}

/// Parameters of the deformation field that is written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct FieldParams {
    pub field: Precision,
    pub field_margin: f64,
}

/// Parameters of the bands of spherical harmonics that are written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct ShDegreeParams {
    pub bands: WhichBands,
    pub bands_margin: f64,
}

/// Which bands of spherical harmonics are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum WhichBands {
    /// Those that there are.
    All,
    /// No more than pictures need.
    Needed,
    /// Up to this degree, which refining makes the best of.
    UpTo(usize),
}

impl TryFrom<String> for WhichBands {
    type Error = String;

    fn try_from(text: String) -> std::result::Result<WhichBands, String> {
        match text.as_str() {
            "all" => Ok(WhichBands::All),
            "needed" => Ok(WhichBands::Needed),
            degree => match degree.parse() {
                Ok(degree) if degree <= HIGHEST_DEGREE => Ok(WhichBands::UpTo(degree)),
                _ => Err(format!("{}: expected all, needed, or a degree from 0 to {HIGHEST_DEGREE}", quoted(degree))),
            },
        }
    }
}

impl From<WhichBands> for String {
    fn from(bands: WhichBands) -> String {
        match bands {
            WhichBands::All => "all".to_owned(),
            WhichBands::Needed => "needed".to_owned(),
            WhichBands::UpTo(degree) => degree.to_string(),
        }
    }
}

/// How a deformation field is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// As it was, byte for byte.
    #[default]
    Exact,
    /// In IEEE 754 binary16.
    Half,
}

/// Groups of stored values, by names that a person gives them: `color,opacity,scale,rotation,position`, any of them, or
/// `none`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct AttributeGroups(pub Columns);

/// Every group and its column.
const GROUPS: [(&str, Columns); 5] = [
    ("color", Columns::SH),
    ("opacity", Columns::OPACITY),
    ("scale", Columns::LOG_SCALE),
    ("rotation", Columns::ROTATION),
    ("position", Columns::POSITION),
];

impl TryFrom<String> for AttributeGroups {
    type Error = String;

    fn try_from(text: String) -> std::result::Result<AttributeGroups, String> {
        let mut columns = Columns::empty();
        for name in text.split([',', ' ']).filter(|&name| text != "none" && !name.is_empty()) {
            let group = GROUPS.iter().find(|group| group.0 == name).ok_or_else(|| {
                let names = GROUPS.map(|group| group.0).join(",");
                format!("{}: expected some of {names}, or none", quoted(name))
            })?;
            columns |= group.1;
        }
        Ok(AttributeGroups(columns))
    }
}

impl From<AttributeGroups> for String {
    fn from(groups: AttributeGroups) -> String {
        let names: Vec<&str> = GROUPS.iter().filter(|group| groups.0.contains(group.1)).map(|group| group.0).collect();
        if names.is_empty() { "none".to_owned() } else { names.join(",") }
    }
}

/// Thresholds of one merge pass.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "paper.toml documents each parameter beside its value")]
pub struct MergePass {
    pub epsilon: f64,
    pub d0: f64,
    pub rho: f64,
    pub tau_m: f64,
}

/// Unit of the merge lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LengthUnit {
    /// Scene units.
    Scene,
    /// The scene extent.
    Extent,
}

impl LengthUnit {
    /// Length of one unit in a scene of that extent.
    pub fn in_scene_units(self, extent: f64) -> f64 {
        match self {
            LengthUnit::Scene => 1.0,
            LengthUnit::Extent => extent,
        }
    }
}

/// How trajectories are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Trajectory {
    /// The paper's mean cosine of velocities.
    Cosine,
    /// (2Σ a·b + 2nσ²) / (Σ‖a‖² + Σ‖b‖² + 2nσ²).
    Alignment,
}

/// Where a proxy is placed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Placement {
    /// At the weighted mean.
    Mean,
    /// At the leader, with second moments about it.
    Leader,
}

/// How the opacity of a proxy follows from its members'.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProxyOpacity {
    /// Clamped sum.
    Sum,
    /// 1 − Π(1 − α).
    Union,
    /// Σ α·area / area of the proxy, clamped.
    Area,
}

/// Where the higher bands of a proxy come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShHigh {
    /// Weighted average.
    Average,
    /// The heaviest member.
    Heaviest,
}

impl Recipe {
    /// The preset of that name.
    pub fn preset(name: &str) -> Result<Recipe> {
        preset_text(name)?;
        Ok(Recipe::from_toml("", name).expect("presets parse: tested"))
    }

    /// A recipe file's text: any subset of the parameters, over the preset named by its first key
    /// `preset` (or `fallback`). The tables `[provenance]` and `[run]`, as written beside results, are not looked at.
    pub fn from_toml(text: &str, fallback: &str) -> std::result::Result<Recipe, String> {
        let over: toml::Table = toml::from_str(text).map_err(|e| e.to_string())?;
        let recipe: Recipe =
            over_preset(over, Some(fallback))?.try_into().map_err(|e: toml::de::Error| e.to_string())?;
        recipe.validate()?;
        Ok(recipe)
    }

    /// This recipe with one parameter set from its text: a TOML value, or a bare word for a name.
    pub fn with(&self, section: &str, key: &str, value: &str) -> std::result::Result<Recipe, String> {
        let number = value.parse::<f64>().map(toml::Value::Float);
        let whole = value.parse::<i64>().map(toml::Value::Integer);
        let truth = value.parse::<bool>().map(toml::Value::Boolean);
        let mut table = toml::Table::try_from(self).map_err(|e| e.to_string())?;
        let slot =
            table.get_mut(section).and_then(|t| t.get_mut(key)).ok_or(format!("no parameter {section}.{key}"))?;
        *slot = match slot {
            toml::Value::Integer(_) => whole.map_err(|e| e.to_string())?,
            toml::Value::Float(_) => number.map_err(|e| e.to_string())?,
            toml::Value::Boolean(_) => truth.map_err(|e| e.to_string())?,
            _ => toml::Value::String(value.to_owned()),
        };
        table.try_into().map_err(|e: toml::de::Error| e.to_string())
    }

    /// The same, but that what stays keeps its values.
    pub fn unrefined(&self) -> Recipe {
        let mut recipe = self.clone();
        recipe.refine.refine = AttributeGroups(Columns::empty());
        recipe
    }

    /// The same with so many steps of refinement, and before each cut as many in proportion.
    pub fn refining_by(&self, steps: u32) -> Recipe {
        let mut recipe = self.clone();
        let refine = &mut recipe.refine;
        let before_cuts = u64::from(refine.refine_cut_steps) * u64::from(steps);
        let before_cuts = before_cuts.div_ceil(u64::from(refine.refine_steps.max(1)));
        refine.refine_cut_steps = before_cuts.try_into().unwrap_or(u32::MAX);
        refine.refine_steps = steps;
        recipe
    }

    /// The parameters as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a recipe is plain data")
    }

    /// Checks every range; the message names the parameter.
    pub fn validate(&self) -> std::result::Result<(), String> {
        let in_unit = |x: f64| (0.0..=1.0).contains(&x);
        let nonnegative = |x: f64| x >= 0.0;
        let finite = |x: f64| x.is_finite() && x >= 0.0;
        // Sums of weighted norms stay finite, and 0 times a weight is 0.
        let weight = |x: f64| (0.0..=1e6).contains(&x);
        let MergeParams { max_scale_ratio, max_color_difference, motion_noise, max_drift, max_dead_time, .. } =
            self.merge;
        let mut checks = vec![
            ("scan.alpha_min", self.scan.alpha_min, in_unit(self.scan.alpha_min), "0 to 1"),
            ("score.w_static", self.score.w_static, weight(self.score.w_static), "0 to 1e6"),
            ("score.w_dynamic", self.score.w_dynamic, weight(self.score.w_dynamic), "0 to 1e6"),
            ("score.lambda", self.score.lambda, weight(self.score.lambda), "0 to 1e6"),
            ("score.mu", self.score.mu, weight(self.score.mu), "0 to 1e6"),
            ("score.eta", self.score.eta, weight(self.score.eta), "0 to 1e6"),
            ("score.xi", self.score.xi, weight(self.score.xi), "0 to 1e6"),
            ("score.norm_epsilon", self.score.norm_epsilon, finite(self.score.norm_epsilon), "finite, 0 or more"),
            ("select.keep_fraction", self.select.keep_fraction, in_unit(self.select.keep_fraction), "0 to 1"),
            ("select.tau_static", self.select.tau_static, finite(self.select.tau_static), "finite, 0 or more"),
            ("select.tau_dynamic", self.select.tau_dynamic, nonnegative(self.select.tau_dynamic), "0 or more"),
            (
                "select.round_fraction",
                self.select.round_fraction,
                (0.1..=MOST_LEFT_BY_ROUND).contains(&self.select.round_fraction) || self.select.round_fraction == 1.0,
                "0.1 to 0.99, or 1 for no rounds",
            ),
            ("select.round_pictures", self.select.round_pictures as f64, self.select.round_pictures > 0, "1 or more"),
            (
                "select.round_turns",
                self.select.round_turns as f64,
                (1..=1000).contains(&self.select.round_turns),
                "1 to 1000",
            ),
            (
                "refine.refine_steps",
                f64::from(self.refine.refine_steps),
                self.refine.refine_steps <= MOST_STEPS,
                "0 to 1000000",
            ),
            (
                "refine.refine_cut_steps",
                f64::from(self.refine.refine_cut_steps),
                self.refine.refine_cut_steps <= MOST_STEPS,
                "0 to 1000000",
            ),
            (
                "merge.passes",
                self.merge.passes.len() as f64,
                self.merge.passes.len() <= MOST_PASSES,
                "at most 16 passes",
            ),
            (
                "refine.refine_pictures",
                self.refine.refine_pictures as f64,
                (16..=1_000_000).contains(&self.refine.refine_pictures),
                "16 to 1000000",
            ),
            ("refine.refine_knots", self.refine.refine_knots as f64, self.refine.refine_knots <= 1000, "0 to 1000"),
            ("refine.refine_ssim", self.refine.refine_ssim, in_unit(self.refine.refine_ssim), "0 to 1"),
            ("select.contrast_floor", self.select.contrast_floor, in_unit(self.select.contrast_floor), "0 to 1"),
            ("merge.max_scale_ratio", max_scale_ratio, max_scale_ratio >= 1.0, "1 or more"),
            ("merge.max_color_difference", max_color_difference, nonnegative(max_color_difference), "0 or more"),
            ("merge.motion_noise", motion_noise, finite(motion_noise), "finite, 0 or more"),
            ("merge.max_drift", max_drift, nonnegative(max_drift), "0 or more"),
            ("merge.max_dead_time", max_dead_time, nonnegative(max_dead_time), "0 or more"),
            ("field.field_margin", self.field.field_margin, finite(self.field.field_margin), "finite, 0 or more"),
            ("bands.bands_margin", self.bands.bands_margin, finite(self.bands.bands_margin), "finite, 0 or more"),
            (
                "merge.max_neighbors",
                self.merge.max_neighbors as f64,
                (1..=1024).contains(&self.merge.max_neighbors),
                "1 to 1024",
            ),
        ];
        for pass in &self.merge.passes {
            checks.extend([
                ("merge.passes.epsilon", pass.epsilon, finite(pass.epsilon), "finite, 0 or more"),
                ("merge.passes.d0", pass.d0, nonnegative(pass.d0), "0 or more"),
                ("merge.passes.rho", pass.rho, (-1.0..=1.0).contains(&pass.rho), "-1 to 1"),
                ("merge.passes.tau_m", pass.tau_m, (-1.0..=1.0).contains(&pass.tau_m), "-1 to 1"),
            ]);
        }
        match checks.iter().find(|check| !check.2) {
            Some((name, value, _, range)) => Err(format!("{name}: expected {range}, found {value}")),
            None => Ok(()),
        }
    }
}

/// Text of the preset of that name.
pub fn preset_text(name: &str) -> Result<&'static str> {
    match PRESETS.iter().find(|(known, _)| *known == name) {
        Some((_, text)) => Ok(text),
        None => Err(Error::usage(format!(
            "no preset is called {}; there are: {}",
            quoted(name),
            PRESETS.map(|p| p.0).join(", ")
        ))),
    }
}

/// All parameters: those of `over`, the others from the preset it names or from `fallback`. Presets
/// themselves may name one more.
fn over_preset(mut over: toml::Table, fallback: Option<&str>) -> std::result::Result<toml::Table, String> {
    over.remove("provenance");
    over.remove("run");
    let named = over.remove("preset");
    let base = match (&named, fallback) {
        (Some(toml::Value::String(name)), _) => name.as_str(),
        (Some(other), _) => return Err(format!("preset: expected a name, found {other}")),
        (None, Some(fallback)) => fallback,
        (None, None) => return Ok(over),
    };
    let text = preset_text(base).map_err(|e| e.to_string())?;
    let mut table = over_preset(toml::from_str(text).map_err(|e| e.to_string())?, None)?;
    overlay(&mut table, over);
    Ok(table)
}

/// Replaces the leaves of `base` by those of `over`; keys that `base` lacks are added, to be
/// refused by the typed parse.
fn overlay(base: &mut toml::Table, over: toml::Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(over)) => overlay(inner, over),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_parse_and_are_in_range() {
        for (name, _) in PRESETS {
            Recipe::preset(name).unwrap().validate().unwrap();
        }
        assert_eq!(Recipe::preset("gentle").unwrap().merge.passes, []);
        assert_eq!(Recipe::preset("strong").unwrap().merge.passes.len(), 2);
    }

    #[test]
    fn effective_recipe_reads_back_as_itself() {
        let recipe = Recipe::preset("paper").unwrap();
        assert_eq!(Recipe::from_toml(&recipe.to_toml(), "default").unwrap(), recipe);
    }

    #[test]
    fn partial_recipe_changes_only_what_it_names() {
        let recipe = Recipe::from_toml("preset = \"paper\"\n[score]\nmu = 2.0\n", "default").unwrap();
        let mut expected = Recipe::preset("paper").unwrap();
        expected.score.mu = 2.0;
        assert_eq!(recipe, expected);
    }

    #[test]
    fn values_that_make_a_run_endless_are_refused() {
        let many = "[[merge.passes]]\nepsilon = 0.01\nd0 = 1.0\nrho = 0.9\ntau_m = 0.9\n".repeat(MOST_PASSES + 1);
        for (text, parts) in [
            ("[select]\nround_fraction = 0.9999999999\n", ["select.round_fraction", "0.1 to 0.99, or 1"]),
            ("[refine]\nrefine_steps = 4000000000\n", ["refine.refine_steps", "0 to 1000000"]),
            ("[refine]\nrefine_cut_steps = 4000000000\n", ["refine.refine_cut_steps", "0 to 1000000"]),
            (&many, ["merge.passes", "at most 16 passes, found 17"]),
        ] {
            let message = Recipe::from_toml(text, "default").unwrap_err();
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        }
        for fraction in ["0.1", "0.95", "0.99", "1.0"] {
            Recipe::from_toml(&format!("[select]\nround_fraction = {fraction}\n"), "default").unwrap();
        }
    }

    #[test]
    fn unknown_and_out_of_range_parameters_are_named() {
        assert!(Recipe::from_toml("[score]\nnu = 1.0\n", "paper").unwrap_err().contains("nu"));
        let message = Recipe::from_toml("[select]\nkeep_fraction = 1.5\n", "paper").unwrap_err();
        assert!(message.contains("select.keep_fraction") && message.contains("1.5"), "{message}");
        let message = Recipe::from_toml("[select]\ntau_static = nan\n", "paper").unwrap_err();
        assert!(message.contains("select.tau_static"), "{message}");
    }
}
