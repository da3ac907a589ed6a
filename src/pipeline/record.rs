//! The file `recipe.toml` beside a result, which holds everything that is needed to repeat the run.
//!
//! Contents of the file: the table `[provenance]` with the program and the digest of the input; the table `[run]` with
//! every option that affects a byte of the result, except parameters; then every parameter of the method.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::request::{Goal, PruneOrMerge, Quality, Request, Target, decibels};
use crate::TOOL;
use crate::files::cameras::TimesSource;
use crate::files::names::relative_to_folder;
use crate::model::{Split, format_ranges};
use crate::models::{LinkMode, ZeroRotation};
use crate::outputs::kind::OutputKind;
use crate::pruning::score::UserOverrides;
use crate::recipe::plain_toml_error;

/// Program and input with which a recipe file was written.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Name and version of the program.
    pub tool: String,
    /// Digest (hash of the content) of the input for which the recipe file was written.
    pub input_digest: String,
}

/// Images to which refinement fits the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FitTarget {
    /// Renders of the original model.
    #[default]
    Renders,
    /// Renders of the original model, and then photographs of the training views.
    Photographs,
}

impl FitTarget {
    fn is_renders(&self) -> bool {
        *self == FitTarget::Renders
    }
}

/// Options of a run that affect the result, except the parameters of the recipe. A field is `None` if the user did not
/// give the option.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunOptions {
    /// Whether the run prunes, merges or does both.
    pub mode: PruneOrMerge,
    /// Exact number of Gaussians in the output.
    pub target_count: Option<u64>,
    /// Number of Gaussians in the output divided by the number in the input. The output has exactly the rounded product
    /// of this ratio and the number in the input.
    pub target_ratio: Option<f64>,
    /// Minimum mean PSNR of renders of the output against renders of the original, dB.
    pub min_psnr: Option<f64>,
    /// Maximum loss of mean PSNR against photographs, dB: PSNR of the original minus PSNR of the output.
    pub max_loss: Option<f64>,
    /// Folder of the photographs: of test views if `max_loss` is given, of training views if `toward` is photographs. A
    /// relative path in a recipe file starts at the folder of the recipe file.
    pub ground_truth: Option<PathBuf>,
    /// Images to which the result is fitted.
    #[serde(skip_serializing_if = "FitTarget::is_renders")]
    pub toward: FitTarget,
    /// Maximum number of bytes of all output files together.
    pub target_size: Option<u64>,
    /// Minimum PSNR, dB, of renders of an archive against renders of the result before its values are quantized.
    pub archive_psnr: Option<f64>,
    /// Ids of Gaussians to keep, as a list with ranges such as `3,10-20`.
    pub keep_ids: Option<String>,
    /// Ids of Gaussians to drop, as a list with ranges such as `3,10-20`.
    pub drop_ids: Option<String>,
    /// Box, in scene units, whose Gaussians are kept: the three low coordinates, then the three high ones.
    pub keep_box: Option<[f64; 6]>,
    /// Kind of output, such as archive or model folder, as stated with the option `--as`.
    pub output: Option<OutputKind>,
    /// Training iteration whose files are read, if the input is a model folder with the files of several iterations.
    pub iteration: Option<u32>,
    /// Value of the option `--time-duration`: length of the time interval `time_duration` with which a 4D Gaussian
    /// Splatting model was trained, in the model's time unit. Colors of the input repeat after this period.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_duration: Option<f64>,
    /// Whether the option `--rot4d unflipped` was given: the 4D rotations of the input use the axis order of 4D
    /// Gaussian Splatting from before 15 September 2024.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub rot4d_unflipped: bool,
    /// Value of the option `--zero-rotation`: whether Gaussians with a zero quaternion in a `.splatv` or `.ftgs.ply`
    /// input are removed or kept.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_rotation: Option<ZeroRotation>,
    /// File or folder of the cameras. In a recipe file the path is relative to the folder of the file.
    pub cameras: Option<PathBuf>,
    /// Split (training, test …) whose views were used for scoring; `None`: all views.
    pub split: Option<Split>,
    /// Number of evenly spaced frames at which an input model that is continuous in time is sampled.
    pub frames: Option<usize>,
    /// Width and height of views in pixels, for cameras that state no size.
    pub size: Option<(u32, u32)>,
    /// Source of the times of views, in the form of the option `--times`; `None`: the views' own times. In a recipe
    /// file the path of a table of times is relative to the folder of the file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub times: Option<String>,
    /// Value of the option `--link`: whether Gaussians of successive frames are matched, to find the same Gaussian in
    /// each frame. `None`: the program decides.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkMode>,
}

/// Tables `[provenance]` and `[run]` of a recipe file: everything in it except the parameters of the method.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RecipeRecord {
    /// Program and input with which the recipe file was written.
    pub provenance: Option<Provenance>,
    /// Options of the run that affect the result.
    pub run: Option<RunOptions>,
}

/// Error message for a recipe with several targets.
const ONE_TARGET: &str =
    "expected one of target_count, target_ratio, min_psnr, max_loss with ground_truth, and target_size";

impl RunOptions {
    /// Returns the requested number or fraction of Gaussians, if any.
    pub fn target(&self) -> Option<Target> {
        self.target_count.map(Target::Count).or(self.target_ratio.map(Target::Ratio))
    }

    /// Returns the requested goal (a quality or a size on disk), if any.
    ///
    /// # Errors
    /// Fails with a message for the user in these cases:
    /// - there are several goals, both a goal and a target number of Gaussians, or this number in two forms;
    /// - `max_loss` or `toward = "photographs"` is given without `ground_truth` (folder of photographs), or
    ///   `ground_truth` without both;
    /// - a value in decibels is out of range.
    pub fn goal(&self) -> std::result::Result<Option<Goal>, String> {
        let fits_photographs = self.toward == FitTarget::Photographs;
        if self.ground_truth.is_some() != (self.max_loss.is_some() || fits_photographs) {
            return Err("expected --ground-truth, a folder of photographs, together with --max-loss or --toward \
                        photographs, and only with these"
                .to_owned());
        }
        let photographs = self.ground_truth.as_ref().filter(|_| self.max_loss.is_some());
        if self.target_count.is_some() && self.target_ratio.is_some() {
            return Err(ONE_TARGET.to_owned());
        }
        match (self.target(), self.min_psnr, self.max_loss, photographs, self.target_size) {
            (_, None, None, None, None) => Ok(None),
            (None, Some(least), None, None, None) => {
                Ok(Some(Goal::Quality(Quality::Psnr(decibels("min_psnr", least)?))))
            }
            (None, None, Some(most), Some(photographs), None) => {
                let most = decibels("max_loss", most)?;
                Ok(Some(Goal::Quality(Quality::Loss { most, photographs: photographs.clone() })))
            }
            (None, None, None, None, Some(most)) => Ok(Some(Goal::Bytes(most))),
            _ => Err(ONE_TARGET.to_owned()),
        }
    }
}

impl RunOptions {
    /// Returns the options with every path `p` replaced by `path(p)`.
    fn with_paths(mut self, path: impl Fn(&Path) -> PathBuf) -> RunOptions {
        self.cameras = self.cameras.as_deref().map(&path);
        self.ground_truth = self.ground_truth.as_deref().map(&path);
        self.times = self.times.as_deref().map(|times| match TimesSource::parse(times) {
            TimesSource::Table(table) => path(&table).to_string_lossy().into_owned(),
            _ => times.to_owned(),
        });
        self
    }
}

impl RecipeRecord {
    /// Returns the record that describes a run of `request`. `user` holds the ids of the Gaussians that the user keeps
    /// and drops, `input_digest` is the digest of the input.
    pub(super) fn new(request: &Request, user: &UserOverrides, input_digest: String) -> RecipeRecord {
        let (target_count, target_ratio) = match request.target {
            None => (None, None),
            Some(Target::Count(count)) => (Some(count), None),
            Some(Target::Ratio(ratio)) => (None, Some(ratio)),
        };
        let mut run = RunOptions::default();
        match &request.goal {
            None => (),
            Some(Goal::Bytes(most)) => run.target_size = Some(*most),
            Some(Goal::Quality(Quality::Psnr(least))) => run.min_psnr = Some(*least),
            Some(Goal::Quality(Quality::Loss { most, photographs })) => {
                (run.max_loss, run.ground_truth) = (Some(*most), Some(photographs.clone()));
            }
        }
        if let Some(photographs) = &request.photographs {
            (run.toward, run.ground_truth) = (FitTarget::Photographs, Some(photographs.clone()));
        }
        let ids = |ids: &[u32]| (!ids.is_empty()).then(|| format_ranges(ids).join(","));
        let input = &request.input;
        let run = RunOptions {
            mode: request.only,
            target_count,
            target_ratio,
            archive_psnr: request.archive_psnr,
            keep_ids: ids(&user.keep),
            drop_ids: ids(&user.drop),
            keep_box: request.keep_box,
            output: request.kind,
            iteration: input.iteration,
            time_duration: input.conventions.time_duration,
            rot4d_unflipped: input.conventions.rot4d_unflipped,
            zero_rotation: input.conventions.zero_rotation,
            cameras: input.cameras.clone(),
            split: input.split,
            frames: input.frames,
            size: input.size,
            times: input.times.name(),
            link: (input.link != LinkMode::Auto).then_some(input.link),
            ..run
        };
        let tool = TOOL.to_owned();
        RecipeRecord { provenance: Some(Provenance { tool, input_digest }), run: Some(run) }
    }

    /// Parses the tables `[provenance]` and `[run]` from the text of a recipe file in `folder`. Relative paths in the
    /// text are resolved against `folder`.
    ///
    /// # Errors
    /// Fails with a message if one of the two tables has unknown or wrong entries.
    pub fn read(text: &str, folder: &Path) -> std::result::Result<RecipeRecord, String> {
        let record: RecipeRecord = toml::from_str(text).map_err(|error| plain_toml_error(&error))?;
        Ok(RecipeRecord { run: record.run.map(|run| run.with_paths(|path| folder.join(path))), ..record })
    }

    /// Returns the record as it is written to a recipe file in `folder`. Every path is made relative to `folder`; a
    /// path for which this is impossible is reduced to its file name.
    fn seen_from(&self, folder: &Path) -> RecipeRecord {
        RecipeRecord {
            run: self.run.clone().map(|run| run.with_paths(|path| relative_to_folder(path, folder))),
            ..self.clone()
        }
    }

    /// Returns the text of the file `recipe.toml` that is written to `folder`: this record and the recipe of `request`.
    pub(super) fn text(&self, request: &Request, folder: &Path) -> String {
        format!(
            "# What this result was made with; give it to --recipe to repeat the run.\n{}\n{}",
            toml::to_string(&self.seen_from(folder)).expect("a record is plain data"),
            request.recipe.to_toml()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::ids::parse_ids;
    use crate::recipe::Recipe;
    use crate::scene::InputOptions;

    #[test]
    fn a_number_of_gaussians_in_two_forms_is_refused() {
        let run = RunOptions { target_count: Some(10), target_ratio: Some(0.5), ..RunOptions::default() };
        assert!(run.goal().unwrap_err().contains("one of target_count, target_ratio"));
        assert_eq!(RunOptions { target_count: None, ..run }.goal().unwrap(), None);
    }

    #[test]
    fn wrong_types_are_named_in_plain_words() {
        for (text, expected) in
            [("frames = \"many\"", "expected a whole number, 0 or more"), ("min_psnr = true", "expected a number")]
        {
            let message = RecipeRecord::read(&format!("[run]\n{text}\n"), Path::new(".")).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn record_reads_back_unchanged_beside_the_recipe() {
        let input = InputOptions {
            cameras: Some("data, \"odd\" name".into()),
            split: Some(Split::Test),
            frames: Some(12),
            link: LinkMode::Always,
            size: Some((320, 200)),
            ..InputOptions::default()
        };
        let mut request = Request::new(input, "out".into(), Recipe::preset("paper").unwrap());
        (request.only, request.target) = (PruneOrMerge::Prune, Some(Target::Ratio(0.3)));
        (request.keep_box, request.kind) = (Some([-1.0, 0.0, 0.5, 1.0, 2.0, 1e9]), Some(OutputKind::PlySequence));
        let user = UserOverrides { keep: vec![1, 2, 3, 9], drop: Vec::new(), keep_box: request.keep_box };
        let record = RecipeRecord::new(&request, &user, "00ff".to_owned());
        let folder = Path::new("/somewhere/else");
        let text = record.text(&request, folder);
        // The folder is far from the working directory, so only the file name of the cameras is kept.
        let read = RecipeRecord::read(&text, folder).unwrap();
        assert_eq!(read.run.as_ref().unwrap().cameras.as_deref(), Some(&*folder.join("data, \"odd\" name")), "{text}");
        let cameras = record.run.as_ref().unwrap().cameras.clone();
        let run = read.run.map(|run| RunOptions { cameras, ..run });
        assert_eq!(RecipeRecord { run, ..read }, record, "{text}");
        assert_eq!(Recipe::from_toml(&text, "default").unwrap(), request.recipe, "{text}");
        assert_eq!(record.run.unwrap().keep_ids.as_deref(), Some("1-3,9"));
    }

    #[test]
    fn recipe_paths_are_relative_to_its_folder() {
        let here = std::env::current_dir().unwrap();
        let run = RunOptions {
            cameras: Some(here.join("data/cameras.json")),
            ground_truth: Some("photos".into()),
            times: Some("table.csv".to_owned()),
            ..RunOptions::default()
        };
        let record = RecipeRecord { run: Some(run), ..RecipeRecord::default() };
        let seen = record.seen_from(&here.join("out/small")).run.unwrap();
        assert_eq!(seen.cameras.as_deref(), Some(Path::new("../../data/cameras.json")));
        assert_eq!(seen.ground_truth.as_deref(), Some(Path::new("../../photos")));
        assert_eq!(seen.times.as_deref(), Some("../../table.csv"));
        let text = toml::to_string(&RecipeRecord { run: Some(seen), ..RecipeRecord::default() }).unwrap();
        let read = RecipeRecord::read(&text, &here.join("out/small")).unwrap().run.unwrap();
        assert_eq!(read.cameras, Some(here.join("out/small/../../data/cameras.json")));
        let named = RecipeRecord {
            run: Some(RunOptions { times: Some("names".to_owned()), ..RunOptions::default() }),
            ..RecipeRecord::default()
        };
        assert_eq!(named.seen_from(Path::new("/x/y/z")).run.unwrap().times.as_deref(), Some("names"));
    }

    #[test]
    fn misspelled_run_option_is_named_in_the_error() {
        let message = RecipeRecord::read("[run]\ntarget_rato = 0.3\n", Path::new("")).unwrap_err();
        assert!(message.contains("target_rato"), "{message}");
    }

    #[test]
    fn formatted_ranges_parse_back_into_the_same_ids() {
        for ids in [&[][..], &[7], &[0, 1, 2], &[1, 3, 4, 5, 9, 11, 12]] {
            assert_eq!(parse_ids(&format_ranges(ids).join(","), 20).unwrap(), ids);
        }
    }
}
