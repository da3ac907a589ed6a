//! Parameters of the method: presets, recipe files that override presets, and flags that override files.
//!
//! The meaning of each parameter is documented beside its value in `paper.toml`; the types in `sections` only define
//! the possible values.

mod effort;
mod parameters;
mod sections;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, quoted};
use crate::model::Attributes;

pub use effort::Effort;
pub use parameters::{Parameter, parameters};
pub use sections::{
    Anisotropy, AttributeGroups, Coverage, FieldParams, FieldPrecision, LengthUnit, LowScorePolicy, MergeParams,
    MergePass, MotionParams, MotionSimilarity, NonFinitePolicy, ProxyHigherSh, ProxyOpacity, ProxyPosition,
    RefineParams, ScanFrames, ScanParams, ScoreParams, SelectParams, ShDegreeParams, ShDegreeRule, StaticScoreTerm,
};

/// Text of the preset `paper`, with a comment on every parameter.
const PAPER: &str = include_str!("paper.toml");

/// Name and TOML text of every preset. A preset may start from another one, which it names by the key `preset`.
pub const PRESETS: [(&str, &str); 4] = [
    ("default", include_str!("default.toml")),
    ("paper", PAPER),
    ("gentle", include_str!("gentle.toml")),
    ("strong", include_str!("strong.toml")),
];

/// Maximum fraction of the Gaussians that may be left after one pruning round. At this fraction, pruning 10 million
/// Gaussians down to a few takes about 1300 rounds.
pub const MAX_ROUND_FRACTION: f64 = 0.99;
/// Maximum number of optimization steps of refinement; these take about one day.
const MAX_STEPS: u32 = 1_000_000;
/// Maximum number of merge passes. Every pass reads all frames, so more passes would make a run endless.
const MAX_PASSES: usize = 16;

/// Parameters of the method; `paper.toml` documents each of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Parameters of the scan, which reads all frames once and gathers statistics.
    pub scan: ScanParams,
    /// Parameters of the scores by which Gaussians are ranked: normalization and weights of the statistics.
    pub score: ScoreParams,
    /// Parameters of the selection of the Gaussians that stay (stages 1 and 2 of the paper).
    pub select: SelectParams,
    /// Parameters of merging, which replaces clusters of Gaussians by one each (stage 3 of the paper).
    pub merge: MergeParams,
    /// Parameters of refinement, which fits the stored values of the survivors (Gaussians not removed) to renders.
    pub refine: RefineParams,
    /// Parameters of the precision with which the deformation field is written.
    pub field: FieldParams,
    /// Parameters by which the SH degree of the result is chosen.
    pub bands: ShDegreeParams,
}

impl Recipe {
    /// Returns the recipe of the preset `name`.
    ///
    /// # Errors
    /// Fails if there is no preset of that name.
    pub fn preset(name: &str) -> Result<Recipe> {
        preset_text(name)?;
        Ok(Recipe::from_toml("", name).expect("presets parse: tested"))
    }

    /// Parses the text of a recipe file, which sets any subset of the parameters. The others come from the preset that
    /// its key `preset` names, or from the preset `fallback` if it names none. Ignores the tables `[provenance]` and
    /// `[run]`, which recipe files written beside results have. Fails with a message if the text is not TOML, or if a
    /// parameter is unknown or out of range.
    pub fn from_toml(text: &str, fallback: &str) -> std::result::Result<Recipe, String> {
        let over: toml::Table = toml::from_str(text).map_err(|e| e.to_string())?;
        let recipe: Recipe = over_preset(over, Some(fallback))?.try_into().map_err(|error| plain_toml_error(&error))?;
        recipe.validate()?;
        Ok(recipe)
    }

    /// Returns this recipe with the parameter `key` of the table `section` set from the text `value`: a number, `true`,
    /// `false`, or a name without quotes. Fails with a message if there is no such parameter, or if `value` is not of
    /// its type.
    pub fn with_parameter(&self, section: &str, key: &str, value: &str) -> std::result::Result<Recipe, String> {
        let number = value.parse().map(toml::Value::Float).ok().ok_or("a number");
        let whole = value.parse().map(toml::Value::Integer).ok().ok_or("a whole number");
        let truth = value.parse().map(toml::Value::Boolean).ok().ok_or("true or false");
        let wrong = |expected: &str| format!("expected {expected}, found {}", quoted(value));
        let mut table = toml::Table::try_from(self).map_err(|e| e.to_string())?;
        let slot =
            table.get_mut(section).and_then(|t| t.get_mut(key)).ok_or(format!("no parameter {section}.{key}"))?;
        *slot = match slot {
            toml::Value::Integer(_) => whole.map_err(wrong)?,
            toml::Value::Float(_) => number.map_err(wrong)?,
            toml::Value::Boolean(_) => truth.map_err(wrong)?,
            _ => toml::Value::String(value.to_owned()),
        };
        table.try_into().map_err(|error| plain_toml_error(&error))
    }

    /// Returns this recipe with refinement turned off.
    pub fn without_refinement(&self) -> Recipe {
        let mut recipe = self.clone();
        recipe.refine.refine = AttributeGroups(Attributes::empty());
        recipe
    }

    /// Returns this recipe with `steps` final optimization steps. Two other numbers of optimization steps are multiplied
    /// by the same factor and rounded up: of those before each prune step (removal of the lowest-ranked Gaussians), and
    /// of those for an archive.
    pub fn with_refinement_steps(&self, steps: u32) -> Recipe {
        let mut recipe = self.clone();
        let refine = &mut recipe.refine;
        let previous = u64::from(refine.refine_steps.max(1));
        for other_steps in [&mut refine.refine_steps_per_prune, &mut refine.refine_archive_steps] {
            let scaled = (u64::from(*other_steps) * u64::from(steps)).div_ceil(previous);
            *other_steps = scaled.try_into().unwrap_or(u32::MAX);
        }
        refine.refine_steps = steps;
        recipe
    }

    /// Returns the parameters as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a recipe is plain data")
    }

    /// Checks that every parameter is within its range. Otherwise fails with a message that names the first parameter
    /// that is out of range.
    pub fn validate(&self) -> std::result::Result<(), String> {
        let table = toml::Table::try_from(self).map_err(|error| error.to_string())?;
        let number = |value: &toml::Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
        for (section, key, range) in RANGES {
            let value = table.get(section).and_then(|values| number(values.get(key)?));
            check_range(&format!("{section}.{key}"), value.unwrap_or(f64::NAN), range)?;
        }
        let fraction = self.select.round_fraction;
        if !(0.01..=MAX_ROUND_FRACTION).contains(&fraction) && fraction != 1.0 {
            return Err(format!("select.round_fraction: expected 0.01 to 0.99, or 1 for no rounds, found {fraction}"));
        }
        let passes = &self.merge.passes;
        if passes.len() > MAX_PASSES {
            return Err(format!("merge.passes: expected at most {MAX_PASSES} passes, found {}", passes.len()));
        }
        passes.iter().try_for_each(|pass| {
            check_range("merge.passes.epsilon", pass.epsilon, FINITE)?;
            check_range("merge.passes.d0", pass.d0, NONNEGATIVE)?;
            check_range("merge.passes.rho", pass.rho, [-1.0, 1.0])?;
            check_range("merge.passes.tau_m", pass.tau_m, [-1.0, 1.0])
        })
    }
}

/// Range of fractions: minimum and maximum.
const FRACTION: [f64; 2] = [0.0, 1.0];
/// Range of weights. The maximum keeps weighted sums finite, so that a weight of 0 gives 0 and not NaN.
const WEIGHT: [f64; 2] = [0.0, 1e6];
/// Range of finite numbers from 0.
const FINITE: [f64; 2] = [0.0, f64::MAX];
/// Range of numbers from 0, infinity included.
const NONNEGATIVE: [f64; 2] = [0.0, f64::INFINITY];
/// Range of numbers of optimization steps.
const STEPS: [f64; 2] = [0.0, MAX_STEPS as f64];

/// Ranges of the parameters that are numbers: the table of the recipe, the key in it, and the minimum and maximum.
const RANGES: [(&str, &str, [f64; 2]); 29] = [
    ("scan", "alpha_min", FRACTION),
    ("scan", "outside", FRACTION),
    ("score", "w_static", WEIGHT),
    ("score", "w_dynamic", WEIGHT),
    ("score", "lambda", WEIGHT),
    ("score", "mu", WEIGHT),
    ("score", "eta", WEIGHT),
    ("score", "xi", WEIGHT),
    ("score", "norm_epsilon", FINITE),
    ("select", "keep_fraction", FRACTION),
    ("select", "tau_static", FINITE),
    ("select", "tau_dynamic", NONNEGATIVE),
    ("select", "round_views", [1.0, f64::INFINITY]),
    ("select", "round_groups", [1.0, 1000.0]),
    ("select", "contrast_floor", FRACTION),
    ("merge", "max_scale_ratio", [1.0, f64::INFINITY]),
    ("merge", "max_color_difference", NONNEGATIVE),
    ("merge", "motion_noise", FINITE),
    ("merge", "max_drift", NONNEGATIVE),
    ("merge", "max_dead_time", NONNEGATIVE),
    ("merge", "max_neighbors", [1.0, 1024.0]),
    ("bands", "bands_margin", FINITE),
    ("refine", "refine_steps", STEPS),
    ("refine", "refine_steps_per_prune", STEPS),
    ("refine", "refine_archive_steps", STEPS),
    ("refine", "refine_target_views", [16.0, 1e6]),
    ("refine", "refine_keyframes", [0.0, 1000.0]),
    ("refine", "refine_ssim", FRACTION),
    ("field", "field_margin", FINITE),
];

/// Checks that the value `value` of the parameter `name` is within the range from `min` to `max`; NaN is not. Fails
/// with a message that states the range.
fn check_range(name: &str, value: f64, [min, max]: [f64; 2]) -> std::result::Result<(), String> {
    if (min..=max).contains(&value) {
        return Ok(());
    }
    let range = match max {
        f64::INFINITY => format!("{min} or more"),
        f64::MAX => format!("finite, {min} or more"),
        _ => format!("{min} to {max}"),
    };
    Err(format!("{name}: expected {range}, found {value}"))
}

/// Returns the message of `error` for users, with the expected type of a value in plain words instead of the name of a
/// Rust type.
pub(crate) fn plain_toml_error(error: &toml::de::Error) -> String {
    const TYPES: [(&str, &str); 8] = [
        ("a nonzero u32", "a whole number of at least 1"),
        ("a nonzero usize", "a whole number of at least 1"),
        ("f64", "a number"),
        ("u32", "a whole number, 0 or more"),
        ("u64", "a whole number, 0 or more"),
        ("usize", "a whole number, 0 or more"),
        ("a boolean", "true or false"),
        ("a string", "a text in quotes"),
    ];
    let message = error.to_string();
    let replaced = TYPES.iter().find_map(|(name, plain)| {
        let (before, after) = message.split_once(&format!("expected {name}"))?;
        (!after.starts_with(|c: char| c.is_alphanumeric())).then(|| format!("{before}expected {plain}{after}"))
    });
    replaced.unwrap_or(message)
}

/// Returns the TOML text of the preset `name`. Fails if there is no preset of that name.
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

/// Returns the parameters in `over`, and for all others the values of a preset. The preset is the one that the key
/// `preset` of `over` names, otherwise `fallback`. It may itself be based on another preset.
///
/// Without any preset (`over` names none and `fallback` is `None`), returns only the parameters in `over`. Fails if the
/// named preset does not exist.
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

/// Replaces the values in `base` by those of `over`, table by table. Also adds keys that `base` lacks: the later
/// conversion to [`Recipe`] fails for an unknown key.
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
    fn presets_parse_and_are_within_their_ranges() {
        for (name, _) in PRESETS {
            Recipe::preset(name).unwrap().validate().unwrap();
        }
        assert_eq!(Recipe::preset("gentle").unwrap().merge.passes, []);
        assert_eq!(Recipe::preset("strong").unwrap().merge.passes.len(), 2);
    }

    #[test]
    fn written_recipe_reads_back_unchanged() {
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
        let many = "[[merge.passes]]\nepsilon = 0.01\nd0 = 1.0\nrho = 0.9\ntau_m = 0.9\n".repeat(MAX_PASSES + 1);
        for (text, parts) in [
            ("[select]\nround_fraction = 0.9999999999\n", ["select.round_fraction", "0.01 to 0.99, or 1"]),
            ("[refine]\nrefine_steps = 4000000000\n", ["refine.refine_steps", "0 to 1000000"]),
            ("[refine]\nrefine_steps_per_prune = 4000000000\n", ["refine.refine_steps_per_prune", "0 to 1000000"]),
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

    #[test]
    fn every_number_has_a_range() {
        // A fraction with another rule, and numbers whose type is their range.
        const OTHER: [&str; 5] = ["round_fraction", "scoring_views", "pixel_stride", "view_stride", "frame_stride"];
        let table = toml::Table::try_from(Recipe::preset("default").unwrap()).unwrap();
        for (section, values) in &table {
            for (key, value) in values.as_table().into_iter().flatten() {
                let is_number = value.is_integer() || value.is_float();
                let has_range = RANGES.iter().any(|(in_section, name, _)| section == in_section && key == name);
                assert!(!is_number || has_range || OTHER.contains(&key.as_str()), "{section}.{key}");
            }
        }
        for text in ["[bands]\nbands_margin = -100.0\n", "[merge]\nmax_neighbors = 0\n"] {
            assert!(Recipe::from_toml(text, "default").is_err(), "{text}");
        }
    }
}
