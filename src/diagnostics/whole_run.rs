//! A whole run as a user starts it, from opening the input to a result on the disk, and how close its result is.

use std::fs;
use std::path::Path;

use crate::error::{Error, Result};
use crate::evaluation::baseline::prune_by;
use crate::evaluation::cost::{Cost, Repeats};
use crate::evaluation::found::Evaluation;
use crate::evaluation::method::MethodKind;
use crate::evaluation::{EvaluateOptions, evaluate_whole};
use crate::files::atomic::Replace;
use crate::model::Split;
use crate::pipeline::{Request, Target, compress};
use crate::scene::pictures::PictureSet;
use crate::scene::{InputOptions, Scene};

/// What all runs that are compared with one another share.
#[derive(Debug, Clone)]
pub(crate) struct WholeRun<'a> {
    /// What to read, and the cameras; scored by the training pictures.
    pub(crate) input: &'a InputOptions,
    /// Folder that does not exist, for results while they are measured.
    pub(crate) scratch: &'a Path,
    /// The result's name, which says its kind.
    pub(crate) name: &'a str,
    /// How often it is run.
    pub(crate) repeats: Repeats,
    /// Compare on at most this many frames, evenly; none: all.
    pub(crate) max_frames: Option<usize>,
    /// Red, green, blue in [0, 1]; none: as `evaluate`.
    pub(crate) background: Option<[f32; 3]>,
}

impl WholeRun<'_> {
    /// Compresses by `means`, measures, and looks at the result by `look` while it is there. Gives what that saw and what
    /// compressing took.
    ///
    /// # Errors
    /// Those of `compress` and of `look`.
    pub(crate) fn run<T>(
        &self,
        means: &MethodKind,
        target: Option<Target>,
        look: impl FnOnce(&Path) -> Result<T>,
    ) -> Result<(T, Cost)> {
        let input = trained(self.input);
        let output = self.scratch.join(self.name);
        let clear = || fs::remove_dir_all(self.scratch).map_err(Error::io("remove", self.scratch));
        let create = || fs::create_dir(self.scratch).map_err(Error::io("create", self.scratch));
        let once = || match means {
            MethodKind::Recipe(recipe, only) => {
                let run = Request::new(input.clone(), output.clone(), (**recipe).clone());
                compress(&Request { only: *only, target, ..run }).map(|_| ())
            }
            MethodKind::Baseline(baseline) => prune_by(*baseline, &input, target, &output).map(|_| ()),
        };
        create()?;
        let ((), cost) = self.repeats.measure(once, || clear().and_then(|()| create()))?;
        let seen = look(&output)?;
        clear()?;
        Ok((seen, cost))
    }

    /// A result beside the original, on held-out pictures.
    ///
    /// # Errors
    /// Those of `evaluate`.
    pub(crate) fn compared(&self, result: &Path) -> Result<Evaluation> {
        evaluate_whole(&EvaluateOptions {
            original: trained(self.input),
            compressed: result.to_owned(),
            ground_truth: None,
            part: PictureSet::HeldOut,
            max_frames: self.max_frames,
            max_views: None,
            background: self.background,
            flip: false,
            csv: None,
            overwrite: Replace::Never,
        })
    }
}

/// The name by which a result is of the kind of `scene`'s input.
///
/// # Errors
/// An index of a container that cannot be read.
pub(crate) fn result_name(scene: &Scene) -> Result<&'static str> {
    Ok(if scene.input.columns()?.is_empty() { "result" } else { "result.gseq" })
}

/// The same input, scored by its training pictures.
pub(crate) fn trained(input: &InputOptions) -> InputOptions {
    InputOptions { split: Some(Split::Train), ..input.clone() }
}
