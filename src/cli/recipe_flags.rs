//! One flag per hyper-parameter, made from the list in `recipe`, so that none can be forgotten.

use std::path::{Path, PathBuf};

use clap::builder::BoolishValueParser;
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches};

use splatsieve::error::{Error, Result, ShowPath, quoted};
use splatsieve::files::text::read_text;
use splatsieve::pipeline::RecipeRecord;
use splatsieve::recipe::{Effort, MergePass, PRESETS, Recipe, parameters};

const RECIPE: &str = "Recipe";
const HEADING: &str = "Recipe, every parameter (`splatsieve recipe` prints a documented file)";

/// Maximum number of bytes of a recipe: a written one has about 4,000.
const MAX_RECIPE: u64 = 1 << 20;

/// The recipe as the command line gives it: a preset or a file, and single parameters over it.
#[derive(Debug, Clone, Default)]
pub(super) struct RecipeFlags {
    preset: Option<String>,
    file: Option<PathBuf>,
    effort: Option<String>,
    /// (section, key, value as TOML)
    set: Vec<(String, String, String)>,
    passes: Vec<MergePass>,
}

impl RecipeFlags {
    /// What the recipe file, if there is one, says of the run it was written beside.
    pub(super) fn record(&self) -> Result<RecipeRecord> {
        let Some(path) = &self.file else { return Ok(RecipeRecord::default()) };
        let text = read_text(path, MAX_RECIPE)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        RecipeRecord::read(&text, folder).map_err(|message| Error::usage(format!("{}: {message}", path.shown())))
    }

    /// Confirms that what the recipe file names for `option` is there.
    ///
    /// # Errors
    /// A path where nothing is.
    pub(super) fn check_named(&self, option: &str, path: &Path) -> Result<()> {
        if path.exists() {
            return Ok(());
        }
        let recipe = self.file.as_deref().unwrap_or(Path::new("")).shown();
        Err(Error::usage(format!(
            "{recipe}: [run] {}: expected a file or folder, found nothing at {}\n  \
             paths in a recipe are seen from its own folder; name another with --{option}",
            option.replace('-', "_"),
            path.shown()
        )))
    }

    /// The effective recipe.
    pub(super) fn recipe(&self) -> Result<Recipe> {
        let fallback = self.preset.as_deref().unwrap_or("default");
        let mut recipe = match &self.file {
            None => Recipe::preset(fallback)?,
            Some(path) => {
                let text = read_text(path, MAX_RECIPE)?;
                Recipe::from_toml(&text, fallback)
                    .map_err(|message| Error::usage(format!("{}: {message}", path.shown())))?
            }
        };
        if let Some(effort) = Effort::ALL.into_iter().find(|effort| self.effort.as_deref() == Some(effort.name())) {
            recipe = recipe.at_effort(effort);
        }
        for (section, key, value) in &self.set {
            recipe = recipe.with(section, key, value).map_err(|message| {
                Error::usage(format!(
                    "--{}: {} does not fit: {}",
                    key.replace('_', "-"),
                    quoted(value),
                    message.trim_end()
                ))
            })?;
        }
        if !self.passes.is_empty() {
            recipe.merge.passes.clone_from(&self.passes);
        }
        recipe.validate().map_err(Error::usage)?;
        Ok(recipe)
    }
}

impl Args for RecipeFlags {
    fn augment_args(command: Command) -> Command {
        let mut command = command
            .arg(
                Arg::new("preset")
                    .long("preset")
                    .value_parser(PRESETS.map(|(name, _)| name))
                    .help_heading(RECIPE)
                    .help("Where the parameters start from: `default`, the best known; `paper`, to the letter"),
            )
            .arg(
                Arg::new("recipe")
                    .long("recipe")
                    .value_name("FILE")
                    .value_parser(clap::value_parser!(PathBuf))
                    .help_heading(RECIPE)
                    .help("TOML file with any of the parameters; the recipe.toml beside a result repeats its run"),
            );
        command = command.arg(
            Arg::new("effort").long("effort").value_parser(Effort::ALL.map(Effort::name)).help_heading(RECIPE).help(
                "How much time to take for how small an error",
            ).long_help("How much time to take for how small an error: `fast`, a third of the steps of refinement and a coarser look and rounds; `default`; `best`, three times the steps"),
        );
        for parameter in parameters() {
            let mut arg = Arg::new(parameter.key.clone())
                .long(parameter.key.replace('_', "-"))
                .value_name("VALUE")
                .help(parameter.doc)
                .help_heading(HEADING)
                .hide_short_help(true)
                .allow_negative_numbers(true);
            if parameter.boolean {
                arg = arg
                    .num_args(0..=1)
                    .default_missing_value("true")
                    .value_name("true|false")
                    .value_parser(BoolishValueParser::new());
            }
            command = command.arg(arg);
        }
        command = command.arg(
            Arg::new("no_refine")
                .long("no-refine")
                .action(clap::ArgAction::SetTrue)
                .conflicts_with("refine")
                .help_heading(RECIPE)
                .help("Leave what stays as it was stored; what looks and moves alike merges instead"),
        );
        command.arg(
            Arg::new("merge_pass")
                .long("merge-pass")
                .value_name("EPSILON,D0,RHO,TAU_M")
                .action(clap::ArgAction::Append)
                .value_parser(parse_pass)
                .allow_hyphen_values(true)
                .help("A merge pass instead of the recipe's; give it once per pass")
                .help_heading(HEADING)
                .hide_short_help(true),
        )
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for RecipeFlags {
    fn from_arg_matches(matches: &ArgMatches) -> std::result::Result<Self, clap::Error> {
        let mut flags = RecipeFlags::default();
        flags.update_from_arg_matches(matches)?;
        Ok(flags)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> std::result::Result<(), clap::Error> {
        self.preset = matches.get_one::<String>("preset").cloned();
        self.file = matches.get_one::<PathBuf>("recipe").cloned();
        self.effort = matches.get_one::<String>("effort").cloned();
        self.set = parameters()
            .into_iter()
            .filter_map(|p| {
                let value = match p.boolean {
                    true => matches.get_one::<bool>(&p.key)?.to_string(),
                    false => matches.get_one::<String>(&p.key)?.clone(),
                };
                Some((p.section, p.key, value))
            })
            .collect();
        if matches.get_flag("no_refine") {
            self.set.push(("refine".to_owned(), "refine".to_owned(), "none".to_owned()));
        }
        self.passes = matches.get_many::<MergePass>("merge_pass").into_iter().flatten().copied().collect();
        Ok(())
    }
}

fn parse_pass(text: &str) -> std::result::Result<MergePass, String> {
    let numbers: Vec<f64> = numbers(text)?;
    match numbers[..] {
        [epsilon, d0, rho, tau_m] => Ok(MergePass { epsilon, d0, rho, tau_m }),
        _ => Err(format!("expected four numbers EPSILON,D0,RHO,TAU_M, found {}", numbers.len())),
    }
}

/// Parses numbers that are separated by commas.
pub(super) fn numbers<T: std::str::FromStr>(text: &str) -> std::result::Result<Vec<T>, String> {
    text.split(',').map(|part| part.trim().parse().map_err(|_| format!("{} is no number", quoted(part)))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatsieve::model::Columns;

    fn parse(args: &[&str]) -> Result<Recipe> {
        let command = RecipeFlags::augment_args(Command::new("t").no_binary_name(true));
        let matches = command.try_get_matches_from(args).map_err(|e| Error::usage(e.to_string()))?;
        RecipeFlags::from_arg_matches(&matches).unwrap().recipe()
    }

    #[test]
    fn flags_override_the_preset() {
        let recipe =
            parse(&["--preset", "paper", "--mu", "2", "--weigh-motion-by-life", "--low-priority", "rescue"]).unwrap();
        let mut expected = Recipe::preset("paper").unwrap();
        expected.score.mu = 2.0;
        expected.score.weigh_motion_by_life = true;
        expected.select.low_priority = splatsieve::recipe::LowPriority::Rescue;
        assert_eq!(recipe, expected);
    }

    #[test]
    fn boolean_parameters_take_an_optional_value() {
        let paper = Recipe::preset("paper").unwrap();
        assert!(!paper.score.clip_norm);
        for (args, expected) in [
            (&["--clip-norm"][..], true),
            (&["--clip-norm", "true"], true),
            (&["--clip-norm=yes"], true),
            (&["--clip-norm", "false"], false),
            (&["--clip-norm=off"], false),
            (&["--clip-norm", "--mu", "2"], true),
        ] {
            let args = [&["--preset", "paper"], args].concat();
            assert_eq!(parse(&args).unwrap().score.clip_norm, expected, "{args:?}");
        }
        assert!(parse(&["--clip-norm=maybe"]).unwrap_err().to_string().contains("--clip-norm"));
    }

    #[test]
    fn negative_numbers_are_values_and_not_options() {
        assert!(parse(&["--mu", "-1"]).unwrap_err().to_string().contains("score.mu: expected 0 to 1e6, found -1"));
        assert_eq!(parse(&["--merge-pass", "1,1e9,-1,-0.5"]).unwrap().merge.passes[0].tau_m, -0.5);
        assert!(parse(&["--merge-pass", "-1,1,0,0"]).unwrap_err().to_string().contains("merge.passes.epsilon"));
    }

    #[test]
    fn effort_moves_the_preset_and_single_parameters_stand_over_it() {
        let default = parse(&[]).unwrap();
        assert_eq!(parse(&["--effort", "default"]).unwrap(), default);
        let best = parse(&["--effort", "best", "--round-pictures", "7"]).unwrap();
        assert_eq!(best.select.round_pictures, 7);
        assert!(best.refine.refine_steps > default.refine.refine_steps);
        assert!(parse(&["--effort", "luck"]).is_err());
    }

    #[test]
    fn groups_are_named_and_none_of_them_is_said_in_two_ways() {
        let refined = |args: &[&str]| parse(args).unwrap().refine.refine.0;
        assert_eq!(refined(&[]), Columns::all());
        assert_eq!(refined(&["--refine", "colour, scale"]), Columns::SH | Columns::LOG_SCALE);
        for none in [&["--no-refine"][..], &["--refine", "none"], &["--preset", "gentle"]] {
            assert_eq!(refined(none), Columns::empty());
        }
        let message = parse(&["--refine", "colour,size"]).unwrap_err().to_string();
        assert!(
            message.contains("--refine") && message.contains("\"size\"") && message.contains("rotation"),
            "{message}"
        );
        assert!(parse(&["--refine", "scale", "--no-refine"]).is_err());
        let text = parse(&["--refine", "position,opacity"]).unwrap().to_toml();
        assert!(text.contains("refine = \"opacity,position\""), "{text}");
    }

    #[test]
    fn merge_passes_replace_the_recipes() {
        let recipe = parse(&["--merge-pass", "0.1,1,0.5,0.25", "--merge-pass", "0.2,1,0.5,0.25"]).unwrap();
        assert_eq!(recipe.merge.passes.len(), 2);
        assert_eq!(recipe.merge.passes[1], MergePass { epsilon: 0.2, d0: 1.0, rho: 0.5, tau_m: 0.25 });
    }

    #[test]
    fn a_value_that_does_not_fit_names_its_flag() {
        for args in [["--mu", "many"], ["--low-priority", "maybe"], ["--keep-fraction", "1.5"]] {
            let message = parse(&args).unwrap_err().to_string();
            assert!(message.contains(args[0]) || message.contains("keep_fraction"), "{message}");
        }
        assert!(parse(&["--merge-pass", "1,2"]).unwrap_err().to_string().contains("four numbers"));
    }
}
