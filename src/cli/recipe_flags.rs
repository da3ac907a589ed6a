//! Options of the recipe: a preset, a file, an effort, and single parameters by `--set KEY=VALUE`.

use std::path::{Path, PathBuf};

use clap::builder::{PossibleValue, StringValueParser, TypedValueParser};
use clap::{Arg, Args, Command};

use splatsieve::error::{Error, Result, ShowPath, quoted};
use splatsieve::files::text::read_text;
use splatsieve::pipeline::RecipeRecord;
use splatsieve::recipe::{Effort, MergePass, PRESETS, Recipe, parameters};

/// Heading of the recipe options in the help.
const HEADING: &str = "Recipe";

/// Maximum size of a recipe file in bytes; a larger file is not read. A recipe that splatsieve writes has about 4,000
/// bytes.
const MAX_RECIPE_BYTES: u64 = 1 << 20;

/// Key of the list of merge passes, the only parameter whose value is not a single number or word.
const PASSES: &str = "passes";

/// Change of the recipe by one option `--set KEY=VALUE`.
#[derive(Debug, Clone, PartialEq)]
enum RecipeSetting {
    /// New value, as text, of the parameter `key` in the section `section` of the recipe.
    Parameter { section: String, key: String, value: String },
    /// Merge pass from `--set passes=…`. The merge passes on the command line replace all merge passes of the recipe.
    Pass(MergePass),
}

/// Recipe options of a command line. They apply in this order: a preset or a file, then an effort, then single
/// parameters.
#[derive(Debug, Clone, Args)]
pub(super) struct RecipeFlags {
    /// Recipe to start from: `default`, the best known; `paper`, as published; `gentle`, removes less; `strong`,
    /// removes more. `paper` and `gentle` do not refine
    #[arg(long, help_heading = HEADING, value_parser = PRESETS.map(|(name, _)| name))]
    preset: Option<String>,
    /// TOML file with any of the parameters; others come from --preset. The recipe.toml beside a result repeats its run
    #[arg(long = "recipe", help_heading = HEADING, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Time to spend on quality: `fast`, a third of the refinement steps and coarser ranking; `best`, three times the
    /// steps
    #[arg(long, help_heading = HEADING, value_parser = Effort::ALL.map(Effort::name))]
    effort: Option<String>,
    /// Set a parameter of the recipe; may be repeated. `splatsieve recipe --preset paper` lists all with their meaning
    #[arg(long = "set", help_heading = HEADING, value_name = "KEY=VALUE", value_parser = SettingParser)]
    #[arg(hide_possible_values = true)]
    settings: Vec<RecipeSetting>,
    /// Leave out refinement: kept Gaussians stay as they are, similar ones are merged
    #[arg(long, help_heading = HEADING)]
    no_refine: bool,
}

impl RecipeFlags {
    /// Returns the run record in the recipe file of the command line: program, input and options of the run that wrote
    /// the file. Returns an empty record if the command line names no recipe file.
    ///
    /// # Errors
    /// Fails if the file cannot be read or its record is invalid.
    pub(super) fn record(&self) -> Result<RecipeRecord> {
        let Some(path) = &self.file else { return Ok(RecipeRecord::default()) };
        let text = read_text(path, MAX_RECIPE_BYTES)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        RecipeRecord::read(&text, folder).map_err(|message| Error::usage(format!("{}: {message}", path.shown())))
    }

    /// Checks that the file or folder `path` exists. The recipe file records this path as the value of the option
    /// `option`.
    ///
    /// # Errors
    /// Fails if the path does not exist; the message names the recipe file and the option.
    pub(super) fn check_recorded_path(&self, option: &str, path: &Path) -> Result<()> {
        if path.exists() {
            return Ok(());
        }
        let recipe = self.file.as_deref().unwrap_or(Path::new("")).shown();
        Err(Error::usage(format!(
            "{recipe}: [run] {}: expected a file or folder, found nothing at {}\n  \
             paths in a recipe are relative to its folder; give another path with --{option}",
            option.replace('-', "_"),
            path.shown()
        )))
    }

    /// Returns the recipe that results from all recipe options of the command line.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or if a parameter is unknown or out of range.
    pub(super) fn recipe(&self) -> Result<Recipe> {
        let fallback = self.preset.as_deref().unwrap_or("default");
        let mut recipe = match &self.file {
            None => Recipe::preset(fallback)?,
            Some(path) => {
                let text = read_text(path, MAX_RECIPE_BYTES)?;
                Recipe::from_toml(&text, fallback)
                    .map_err(|message| Error::usage(format!("{}: {message}", path.shown())))?
            }
        };
        if let Some(effort) = Effort::ALL.into_iter().find(|effort| self.effort.as_deref() == Some(effort.name())) {
            recipe = recipe.with_effort(effort);
        }
        for setting in &self.settings {
            let RecipeSetting::Parameter { section, key, value } = setting else { continue };
            recipe = recipe.with_parameter(section, key, value).map_err(|message| {
                Error::usage(format!(
                    "--set {key}={value}: {}\n  see `splatsieve recipe --preset paper`",
                    message.trim_end()
                ))
            })?;
        }
        if self.no_refine {
            recipe = recipe.without_refinement();
        }
        let passes = self.settings.iter().filter_map(|setting| match setting {
            RecipeSetting::Pass(pass) => Some(*pass),
            RecipeSetting::Parameter { .. } => None,
        });
        let passes: Vec<MergePass> = passes.collect();
        if !passes.is_empty() {
            recipe.merge.passes = passes;
        }
        recipe.validate().map_err(Error::usage)?;
        Ok(recipe)
    }
}

/// Parser of the argument `KEY=VALUE` of `--set`. Also lists the keys, for completion in shells.
#[derive(Clone)]
struct SettingParser;

impl TypedValueParser for SettingParser {
    type Value = RecipeSetting;

    fn parse_ref(
        &self,
        command: &Command,
        arg: Option<&Arg>,
        value: &std::ffi::OsStr,
    ) -> std::result::Result<RecipeSetting, clap::Error> {
        let parser = StringValueParser::new().try_map(|text| parse_setting(&text));
        parser.parse_ref(command, arg, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let keys = parameters().into_iter().map(|parameter| parameter.key).chain([PASSES.to_owned()]);
        Some(Box::new(keys.map(|key| PossibleValue::new(format!("{key}=")))))
    }
}

/// Parses the recipe setting `text`, of the form `key=value` or `section.key=value`. Fails with a message for other
/// texts and unknown keys.
fn parse_setting(text: &str) -> std::result::Result<RecipeSetting, String> {
    let (name, value) =
        text.split_once('=').ok_or_else(|| format!("expected KEY=VALUE such as mu=2, found {}", quoted(text)))?;
    let (name, value) = (name.trim().replace('-', "_"), value.trim());
    let key = name.rsplit('.').next().unwrap_or_default();
    if name == PASSES || name == format!("merge.{PASSES}") {
        return parse_pass(value).map(RecipeSetting::Pass);
    }
    let all = parameters();
    let found = all
        .iter()
        .find(|parameter| name == parameter.key || name == format!("{}.{}", parameter.section, parameter.key));
    match found {
        Some(parameter) => Ok(RecipeSetting::Parameter {
            section: parameter.section.clone(),
            key: parameter.key.clone(),
            value: value.to_owned(),
        }),
        None => {
            let near = all.iter().map(|parameter| (strsim::jaro_winkler(key, &parameter.key), &parameter.key));
            let near = near.filter(|(score, _)| *score > 0.7).max_by(|a, b| a.0.total_cmp(&b.0));
            let near = near.map_or(String::new(), |(_, key)| format!("; a similar parameter exists: {key}"));
            Err(format!("there is no parameter {}{near}; `splatsieve recipe --preset paper` lists all", quoted(&name)))
        }
    }
}

/// Parses the text of a merge pass: its four thresholds `EPSILON,D0,RHO,TAU_M`. Fails with a message for other texts.
fn parse_pass(text: &str) -> std::result::Result<MergePass, String> {
    let numbers: Vec<f64> = numbers(text)?;
    match numbers[..] {
        [epsilon, d0, rho, tau_m] => Ok(MergePass { epsilon, d0, rho, tau_m }),
        _ => Err(format!("expected four numbers EPSILON,D0,RHO,TAU_M, found {}", numbers.len())),
    }
}

/// Parses the numbers in `text`, which are separated by commas. Fails with a message for other texts.
pub(super) fn numbers<T: std::str::FromStr>(text: &str) -> std::result::Result<Vec<T>, String> {
    text.split(',').map(|part| part.trim().parse().map_err(|_| format!("{} is not a number", quoted(part)))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::FromArgMatches;
    use splatsieve::model::Attributes;

    fn parse(args: &[&str]) -> Result<Recipe> {
        let command = RecipeFlags::augment_args(Command::new("t").no_binary_name(true));
        let matches = command.try_get_matches_from(args).map_err(|e| Error::usage(e.to_string()))?;
        RecipeFlags::from_arg_matches(&matches).unwrap().recipe()
    }

    fn message(args: &[&str]) -> String {
        parse(args).unwrap_err().to_string()
    }

    #[test]
    fn set_overrides_the_preset() {
        let settings = ["--set", "mu=2", "--set", "weigh_motion_by_life=true", "--set", "select.low_priority=rescue"];
        let recipe = parse(&[&["--preset", "paper"], &settings[..]].concat()).unwrap();
        let mut expected = Recipe::preset("paper").unwrap();
        expected.score.mu = 2.0;
        expected.score.weigh_motion_by_life = true;
        expected.select.low_priority = splatsieve::recipe::LowScorePolicy::Rescue;
        assert_eq!(recipe, expected);
    }

    #[test]
    fn every_parameter_can_be_set_and_is_completed() {
        let keys: Vec<String> =
            SettingParser.possible_values().unwrap().map(|value| value.get_name().to_owned()).collect();
        for parameter in parameters() {
            assert!(keys.contains(&format!("{}=", parameter.key)), "{}", parameter.key);
            let setting = parse_setting(&format!("{}.{}=1", parameter.section, parameter.key)).unwrap();
            assert!(matches!(setting, RecipeSetting::Parameter { key, .. } if key == parameter.key));
        }
    }

    #[test]
    fn values_out_of_range_name_the_parameter_and_the_range() {
        assert!(message(&["--set", "mu=-1"]).contains("score.mu: expected 0 to 1000000, found -1"));
        assert!(message(&["--set", "passes=-1,1,0,0"]).contains("merge.passes.epsilon"));
        assert!(message(&["--set", "clip_norm=maybe"]).contains("clip_norm"));
        for setting in ["mu=many", "low_priority=maybe", "keep_fraction=1.5"] {
            let key = setting.split('=').next().unwrap();
            assert!(message(&["--set", setting]).contains(key), "{setting}");
        }
    }

    #[test]
    fn an_unknown_parameter_gets_the_nearest_name() {
        let text = message(&["--set", "refine_step=5"]);
        assert!(text.contains("refine_steps") && text.contains("splatsieve recipe"), "{text}");
        assert!(message(&["--set", "mu"]).contains("KEY=VALUE"));
    }

    #[test]
    fn effort_changes_the_preset_before_single_parameters() {
        let default = parse(&[]).unwrap();
        assert_eq!(parse(&["--effort", "default"]).unwrap(), default);
        let best = parse(&["--effort", "best", "--set", "round_views=7"]).unwrap();
        assert_eq!(best.select.round_views, 7);
        assert!(best.refine.refine_steps > default.refine.refine_steps);
        assert!(parse(&["--effort", "luck"]).is_err());
    }

    #[test]
    fn refined_attributes_are_named_in_one_list() {
        let refined = |args: &[&str]| parse(args).unwrap().refine.refine.0;
        assert_eq!(refined(&[]), Attributes::all());
        assert_eq!(refined(&["--set", "refine=color, scale"]), Attributes::SH | Attributes::LOG_SCALE);
        for none in [&["--no-refine"][..], &["--set", "refine=none"], &["--preset", "gentle"]] {
            assert_eq!(refined(none), Attributes::empty());
        }
        let text = message(&["--set", "refine=color,size"]);
        assert!(text.contains("refine") && text.contains("\"size\"") && text.contains("rotation"), "{text}");
        let text = parse(&["--set", "refine=position,opacity"]).unwrap().to_toml();
        assert!(text.contains("refine = \"opacity,position\""), "{text}");
    }

    #[test]
    fn passes_on_the_command_line_replace_those_of_the_recipe() {
        let recipe = parse(&["--set", "passes=0.1,1,0.5,0.25", "--set", "merge.passes=0.2,1,0.5,-0.25"]).unwrap();
        let pass = |epsilon, tau_m| MergePass { epsilon, d0: 1.0, rho: 0.5, tau_m };
        assert_eq!(recipe.merge.passes, [pass(0.1, 0.25), pass(0.2, -0.25)]);
        assert!(message(&["--set", "passes=1,2"]).contains("four numbers"));
    }
}
