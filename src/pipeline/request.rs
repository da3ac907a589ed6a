//! The request of a user: input, output, recipe, and the size or quality of the result.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::files::atomic::Replace;
use crate::outputs::kind::OutputKind;
use crate::recipe::Recipe;
use crate::scene::InputOptions;

/// Whether a run prunes, merges or does both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PruneOrMerge {
    /// Prunes Gaussians, then merges the survivors (Gaussians left by pruning).
    #[default]
    Both,
    /// Only prunes Gaussians (the paper's "pruned").
    Prune,
    /// Only merges Gaussians (the paper's "merged").
    Merge,
}

/// Requested number of Gaussians in the output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// Exact number of Gaussians.
    Count(u64),
    /// Number of Gaussians in the output divided by that in the input, above 0 and at most 1. The number in the output
    /// is rounded to the nearest integer, and is at least 1.
    Ratio(f64),
}

/// Goal from which the program finds the number of Gaussians in the output.
#[derive(Debug, Clone, PartialEq)]
pub enum Goal {
    /// Smallest output with at least this quality.
    Quality(Quality),
    /// Best output whose files together have at most this number of bytes.
    Bytes(u64),
}

/// Quality that the output must have.
#[derive(Debug, Clone, PartialEq)]
pub enum Quality {
    /// Minimum mean PSNR of renders of the output against renders of the original, dB.
    Psnr(f64),
    /// Maximum amount by which the mean PSNR against photographs may be lower for the output than for the original
    /// model.
    Loss {
        /// Maximum loss of mean PSNR, dB.
        most: f64,
        /// Folder with the photographs, against which both models are compared.
        photographs: PathBuf,
    },
}

impl Quality {
    /// Returns the limit, dB: the minimum PSNR or the maximum loss of PSNR.
    pub fn limit(&self) -> f64 {
        match self {
            Quality::Psnr(least) => *least,
            Quality::Loss { most, .. } => *most,
        }
    }
}

/// Returns `value` if it is a valid number of decibels for a quality: above 0 and at most 100.
///
/// # Errors
/// Fails if `value` is out of this range. The error message names the parameter by `name`.
pub(super) fn decibels(name: &str, value: f64) -> std::result::Result<f64, String> {
    match value > 0.0 && value <= 100.0 {
        true => Ok(value),
        false => Err(format!("{name}: expected decibels above 0 and at most 100, found {value}")),
    }
}

/// Everything that a user asks for in a compression.
#[derive(Debug, Clone)]
pub struct Request {
    /// Input to read, with the options for reading it.
    pub input: InputOptions,
    /// Path of the output.
    pub output: PathBuf,
    /// Kind of output, such as archive or model folder; `None`: determined by the name of the output.
    pub kind: Option<OutputKind>,
    /// Parameters of the method.
    pub recipe: Recipe,
    /// Digest of the input for which the recipe was written, if known. If the actual input has another digest, the user
    /// gets a note.
    pub made_for: Option<String>,
    /// Minimum PSNR, dB, of renders of an archive against renders of the result before its values are quantized.
    /// `None`: derived from the quality of the result.
    pub archive_psnr: Option<f64>,
    /// Whether the run prunes, merges or does both.
    pub only: PruneOrMerge,
    /// Exact number or fraction of Gaussians in the output, if requested.
    pub target: Option<Target>,
    /// Goal (quality or size on disk) by which the number of Gaussians is found, if requested; then `target` is `None`.
    pub goal: Option<Goal>,
    /// Folder with photographs of the training views, to which the result is fitted after its refinement toward renders
    /// of the original; `None`: the result is fitted to renders only.
    pub photographs: Option<PathBuf>,
    /// Ids of Gaussians to keep: a list such as `3,10-20`, or the path of a file with a list.
    pub keep_ids: Option<String>,
    /// Ids of Gaussians to drop: a list such as `3,10-20`, or the path of a file with a list.
    pub drop_ids: Option<String>,
    /// Box, in scene units, whose Gaussians are kept: the three low coordinates, then the three high ones.
    pub keep_box: Option<[f64; 6]>,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

impl Request {
    /// Returns a request that compresses `input` by the parameters of `recipe` and writes to `output`. The request
    /// names no Gaussians to keep or drop, and existing output is not replaced.
    pub fn new(input: InputOptions, output: PathBuf, recipe: Recipe) -> Self {
        Request {
            input,
            output,
            kind: None,
            recipe,
            made_for: None,
            archive_psnr: None,
            only: PruneOrMerge::Both,
            target: None,
            goal: None,
            photographs: None,
            keep_ids: None,
            drop_ids: None,
            keep_box: None,
            overwrite: Replace::Never,
        }
    }
}

impl Target {
    /// Returns the requested number of output Gaussians for an input of `count` Gaussians. For an input without
    /// Gaussians, returns 0 whatever number was requested.
    ///
    /// # Errors
    /// Fails if a fraction is not above 0 and at most 1. Also fails if `count` is above 0 and the number is not from 1
    /// to `count`.
    pub fn resolve_count(self, count: usize) -> Result<usize> {
        let wanted = match self {
            Target::Count(wanted) => wanted,
            Target::Ratio(ratio) if ratio > 0.0 && ratio <= 1.0 => ((ratio * count as f64).round() as u64).max(1),
            Target::Ratio(ratio) => {
                return Err(Error::usage(format!("--ratio: expected a number above 0 and at most 1, found {ratio}")));
            }
        };
        match usize::try_from(wanted) {
            Ok(wanted @ 1..) if wanted <= count => Ok(wanted),
            // An empty scene has only the size 0.
            _ if count == 0 => Ok(0),
            _ => {
                Err(Error::usage(format!("--count: expected 1 to {count}, the Gaussians of the input, found {wanted}")))
            }
        }
    }
}
