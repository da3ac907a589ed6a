//! Runs the whole program as a user does, from opening the input to a result on disk, and measures run time, memory and
//! the quality of the result. Used by the commands `sweep` and `precision`.

use std::fs;
use std::path::Path;

use crate::error::{Error, Result};
use crate::evaluation::baseline::prune_by;
use crate::evaluation::cost::{Cost, RepeatLimits};
use crate::evaluation::method::MethodKind;
use crate::evaluation::results::Evaluation;
use crate::evaluation::{self, EvaluateOptions, ModelPair};
use crate::files::atomic::Replace;
use crate::model::Split;
use crate::pipeline::{Request, Target, compress};
use crate::scene::view_selection::ViewSet;
use crate::scene::{InputOptions, Scene};

/// Settings shared by all complete runs that are compared with one another.
#[derive(Debug, Clone)]
pub(crate) struct WholeRun<'a> {
    /// Input and cameras. The split that these options request is ignored: Gaussians are scored by the training views.
    pub(crate) input: &'a InputOptions,
    /// Path of a folder that does not exist yet. It is created to hold the result of a run, and deleted once this
    /// result has been measured.
    pub(crate) scratch: &'a Path,
    /// File name of the result, which determines the output format.
    pub(crate) name: &'a str,
    /// Limits on the number and the total time of the runs that measure the time of one setting.
    pub(crate) repeats: RepeatLimits,
    /// Maximum number of frames at which the result is compared with the original, evenly spaced; `None`: all frames.
    pub(crate) max_frames: Option<usize>,
    /// Background color of the renders: red, green, blue in [0, 1]; `None`: the default of the command `evaluate`.
    pub(crate) background: Option<[f32; 3]>,
}

impl WholeRun<'_> {
    /// Compresses the input and measures time and memory. If [`WholeRun::repeats`] allows more than one run, compresses
    /// it several times. Then calls `inspect` with the path of the last result, and deletes this result. Returns the
    /// value of `inspect` and the cost (time and memory) of the compression.
    /// - `method_kind`: recipe or baseline by which the input is compressed
    /// - `target`: number or fraction of the Gaussians to keep; `None`: `method_kind` decides
    ///
    /// # Errors
    /// Returns the errors of `compress` and of `inspect`.
    pub(crate) fn run<T>(
        &self,
        method_kind: &MethodKind,
        target: Option<Target>,
        inspect: impl FnOnce(&Path) -> Result<T>,
    ) -> Result<(T, Cost)> {
        let input = with_training_views(self.input);
        let output = self.scratch.join(self.name);
        let clear = || fs::remove_dir_all(self.scratch).map_err(Error::io("remove", self.scratch));
        let create = || fs::create_dir(self.scratch).map_err(Error::io("create", self.scratch));
        let once = || match method_kind {
            MethodKind::Recipe(recipe, only) => {
                let run = Request::new(input.clone(), output.clone(), (**recipe).clone());
                compress(&Request { only: *only, target, ..run }).map(|_| ())
            }
            MethodKind::Baseline(baseline) => prune_by(*baseline, &input, target, &output).map(|_| ()),
        };
        create()?;
        let ((), cost) = self.repeats.measure_cost(once, || clear().and_then(|()| create()))?;
        let seen = inspect(&output)?;
        clear()?;
        Ok((seen, cost))
    }

    /// Compares the compressed model at the path `result` with the original on held-out (test) views.
    ///
    /// # Errors
    /// Returns the errors of `evaluate`.
    pub(crate) fn compare(&self, result: &Path) -> Result<Evaluation> {
        let options = EvaluateOptions {
            original: with_training_views(self.input),
            compressed: result.to_owned(),
            ground_truth: None,
            views: ViewSet::HeldOut,
            max_frames: self.max_frames,
            max_views: None,
            background: self.background,
            flip: false,
            csv: None,
            overwrite: Replace::Never,
        };
        let mut pair = ModelPair::open(&options)?;
        pair.plan_memory(options.original.memory, evaluation::resource_estimates)?;
        pair.evaluate()
    }
}

/// Returns the file name for a result of the same kind as the input of `scene`: `result.gseq` for a container, `result`
/// for any other input.
///
/// # Errors
/// Fails if the index of a container cannot be read.
pub(crate) fn result_name(scene: &Scene) -> Result<&'static str> {
    Ok(if scene.input.columns()?.is_empty() { "result" } else { "result.gseq" })
}

/// Returns a copy of `input` that requests the training views as the views by which Gaussians are scored.
pub(crate) fn with_training_views(input: &InputOptions) -> InputOptions {
    InputOptions { split: Some(Split::Train), ..input.clone() }
}
