//! What a run was asked for, as `recipe.toml` beside its result keeps it, so that the recipe repeats the run.
//!
//! The file: `[provenance]`, the tool and the digest of the input; `[run]`, everything beside the hyper-parameters that
//! decides a byte of the result; then every hyper-parameter.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::request::{Goal, Only, Quality, Request, Target, decibels};
use crate::TOOL;
use crate::files::cameras::Times;
use crate::files::names::from_folder;
use crate::model::{Split, ranges};
use crate::models::{Link, ZeroRotation};
use crate::outputs::kind::OutputKind;
use crate::pruning::score::UserOverrides;

/// Where a recipe comes from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Program and version.
    pub tool: String,
    /// Digest of the input.
    pub input_digest: String,
}

/// What decides a result beside its hyper-parameters. What is none was not asked for.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunOptions {
    /// Which of pruning and merging was done.
    pub mode: Only,
    /// Exact number of Gaussians in the output.
    pub target_count: Option<u64>,
    /// Exact fraction of them.
    pub target_ratio: Option<f64>,
    /// Least PSNR against the original's own pictures, dB.
    pub min_psnr: Option<f64>,
    /// Most loss of PSNR against photographs, dB.
    pub max_loss: Option<f64>,
    /// Folder of these photographs; in a file, seen from the folder of the recipe.
    pub ground_truth: Option<PathBuf>,
    /// Most bytes of everything that is written.
    pub target_size: Option<u64>,
    /// PSNR of an archive's pictures against those of the result before, dB.
    pub archive_psnr: Option<f64>,
    /// Ids to keep, as a list with ranges.
    pub keep_ids: Option<String>,
    /// Ids to drop, as a list with ranges.
    pub drop_ids: Option<String>,
    /// Box whose Gaussians are kept: low corner, high corner.
    pub keep_box: Option<[f64; 6]>,
    /// What was written, as `--as` names it.
    pub output: Option<OutputKind>,
    /// Training iteration of a model folder.
    pub iteration: Option<u32>,
    /// `--time-duration` of a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_duration: Option<f64>,
    /// Whether `--rot4d unflipped` was said of it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub rot4d_unflipped: bool,
    /// `--zero-rotation` of a `.splatv`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_rotation: Option<ZeroRotation>,
    /// File or folder of the cameras; in a file, seen from the folder of the recipe.
    pub cameras: Option<PathBuf>,
    /// Part of their pictures that was scored; none: all.
    pub split: Option<Split>,
    /// Evenly spaced frames of a model that is continuous in time.
    pub frames: Option<usize>,
    /// Picture size where the cameras name none.
    pub size: Option<(u32, u32)>,
    /// Where the times of pictures came from, as `--times` says it; none: their own. A table is seen from the folder of
    /// the recipe.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub times: Option<String>,
    /// Whether frames were linked, where that was not left to them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub link: Option<Link>,
}

/// A recipe file's tables beside its hyper-parameters.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RecipeRecord {
    /// Where it comes from.
    pub provenance: Option<Provenance>,
    /// What was asked for.
    pub run: Option<RunOptions>,
}

impl RunOptions {
    /// The exact size that was asked for.
    pub fn target(&self) -> Option<Target> {
        self.target_count.map(Target::Count).or(self.target_ratio.map(Target::Ratio))
    }

    /// The goal that was asked for.
    ///
    /// # Errors
    /// Several, a part of one, or decibels that no goal has, in words.
    pub fn goal(&self) -> std::result::Result<Option<Goal>, String> {
        match (self.target(), self.min_psnr, self.max_loss, &self.ground_truth, self.target_size) {
            (_, None, None, None, None) => Ok(None),
            (None, Some(least), None, None, None) => {
                Ok(Some(Goal::Quality(Quality::Psnr(decibels("min_psnr", least)?))))
            }
            (None, None, Some(most), Some(photographs), None) => {
                let most = decibels("max_loss", most)?;
                Ok(Some(Goal::Quality(Quality::Loss { most, photographs: photographs.clone() })))
            }
            (None, None, None, None, Some(most)) => Ok(Some(Goal::Bytes(most))),
            _ => {
                Err("expected one of target_count, target_ratio, min_psnr, max_loss with ground_truth, and target_size"
                    .to_owned())
            }
        }
    }
}

impl RunOptions {
    /// Replaces every path by what `path` makes of it.
    fn with_paths(mut self, path: impl Fn(&Path) -> PathBuf) -> RunOptions {
        self.cameras = self.cameras.as_deref().map(&path);
        self.ground_truth = self.ground_truth.as_deref().map(&path);
        self.times = self.times.as_deref().map(|times| match Times::named(times) {
            Times::Table(table) => path(&table).to_string_lossy().into_owned(),
            _ => times.to_owned(),
        });
        self
    }
}

impl RecipeRecord {
    /// Of `request`, whose ids are those of `user`.
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
        let ids = |ids: &[u32]| (!ids.is_empty()).then(|| ranges(ids).join(","));
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
            link: (input.link != Link::Auto).then_some(input.link),
            ..run
        };
        let tool = TOOL.to_owned();
        RecipeRecord { provenance: Some(Provenance { tool, input_digest }), run: Some(run) }
    }

    /// Parses what the text of a recipe file in `folder` says beside its hyper-parameters. Files that it names by relative
    /// paths are those that `folder` leads to.
    ///
    /// # Errors
    /// A table that is not as [`RunOptions`] has it, in words.
    pub fn read(text: &str, folder: &Path) -> std::result::Result<RecipeRecord, String> {
        let record: RecipeRecord = toml::from_str(text).map_err(|error| error.to_string())?;
        Ok(RecipeRecord { run: record.run.map(|run| run.with_paths(|path| folder.join(path))), ..record })
    }

    /// Returns the record for a recipe file in `folder`: with paths seen from there, without those of this machine.
    fn seen_from(&self, folder: &Path) -> RecipeRecord {
        RecipeRecord {
            run: self.run.clone().map(|run| run.with_paths(|path| from_folder(path, folder))),
            ..self.clone()
        }
    }

    /// Returns the text of `recipe.toml` in `folder`.
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
    fn a_record_reads_back_as_itself_and_leaves_the_recipe_as_it_was() {
        let input = InputOptions {
            cameras: Some("data, \"odd\" name".into()),
            split: Some(Split::Test),
            frames: Some(12),
            link: Link::Always,
            size: Some((320, 200)),
            ..InputOptions::default()
        };
        let mut request = Request::new(input, "out".into(), Recipe::preset("paper").unwrap());
        (request.only, request.target) = (Only::Prune, Some(Target::Ratio(0.3)));
        (request.keep_box, request.kind) = (Some([-1.0, 0.0, 0.5, 1.0, 2.0, 1e9]), Some(OutputKind::PlySequence));
        let user = UserOverrides { keep: vec![1, 2, 3, 9], drop: Vec::new(), keep_box: request.keep_box };
        let record = RecipeRecord::new(&request, &user, "00ff".to_owned());
        let folder = Path::new("/somewhere/else");
        let text = record.text(&request, folder);
        // The folder is far from the working directory, so that the cameras keep their name alone.
        let read = RecipeRecord::read(&text, folder).unwrap();
        assert_eq!(read.run.as_ref().unwrap().cameras.as_deref(), Some(&*folder.join("data, \"odd\" name")), "{text}");
        let cameras = record.run.as_ref().unwrap().cameras.clone();
        let run = read.run.map(|run| RunOptions { cameras, ..run });
        assert_eq!(RecipeRecord { run, ..read }, record, "{text}");
        assert_eq!(Recipe::from_toml(&text, "default").unwrap(), request.recipe, "{text}");
        assert_eq!(record.run.unwrap().keep_ids.as_deref(), Some("1-3,9"));
    }

    #[test]
    fn a_recipe_names_files_seen_from_its_folder() {
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
    fn a_misspelt_option_of_a_run_is_named() {
        let message = RecipeRecord::read("[run]\ntarget_rato = 0.3\n", Path::new("")).unwrap_err();
        assert!(message.contains("target_rato"), "{message}");
    }

    #[test]
    fn ranges_parse_into_the_ids_they_stand_for() {
        for ids in [&[][..], &[7], &[0, 1, 2], &[1, 3, 4, 5, 9, 11, 12]] {
            assert_eq!(parse_ids(&ranges(ids).join(","), 20).unwrap(), ids);
        }
    }
}
