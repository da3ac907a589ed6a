//! The request of a user: input, output, recipe and size or quality of the result.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::files::atomic::Replace;
use crate::outputs::kind::OutputKind;
use crate::recipe::Recipe;
use crate::scene::InputOptions;

/// Choice of pruning, merging or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Only {
    /// Prunes, then merges.
    #[default]
    Both,
    /// Prunes only (the paper's "pruned").
    Prune,
    /// Merges only (the paper's "merged").
    Merge,
}

/// Requested number of Gaussians in the output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// Exact number.
    Count(u64),
    /// Fraction of the input in (0, 1], rounded to the nearest number and at least one.
    Ratio(f64),
}

/// Goal by which the size of the output is found.
#[derive(Debug, Clone, PartialEq)]
pub enum Goal {
    /// Smallest output that has at least this quality.
    Quality(Quality),
    /// Best output whose files together have at most this many bytes.
    Bytes(u64),
}

/// Requested quality of an output.
#[derive(Debug, Clone, PartialEq)]
pub enum Quality {
    /// Minimum mean PSNR against renders of the original, dB.
    Psnr(f64),
    /// Maximum loss of mean PSNR against photographs, compared with the original model.
    Loss {
        /// Maximum loss, dB.
        most: f64,
        /// Folder of the photographs.
        photographs: PathBuf,
    },
}

/// Returns `value` if it is a valid quality in decibels: above 0 and at most 100.
///
/// # Errors
/// Fails with a message that names the parameter `name` if it is not.
pub(super) fn decibels(name: &str, value: f64) -> std::result::Result<f64, String> {
    match value > 0.0 && value <= 100.0 {
        true => Ok(value),
        false => Err(format!("{name}: expected decibels above 0 and at most 100, found {value}")),
    }
}

/// Complete request of a compression.
#[derive(Debug, Clone)]
pub struct Request {
    /// Input to read.
    pub input: InputOptions,
    /// Path to write to.
    pub output: PathBuf,
    /// Kind of output; `None`: determined by the output's name.
    pub kind: Option<OutputKind>,
    /// Recipe with the parameters of the method.
    pub recipe: Recipe,
    /// Digest of the input for which the recipe was written, if known. A different input causes a note.
    pub made_for: Option<String>,
    /// Minimum PSNR of an archive's views against views of the result before quantization, dB. `None`: derived from the
    /// quality of the result.
    pub archive_psnr: Option<f64>,
    /// Choice of pruning, merging or both.
    pub only: Only,
    /// Exact number or fraction of Gaussians in the output, if requested.
    pub target: Option<Target>,
    /// Goal by which the number of Gaussians is found, if requested; then `target` is `None`.
    pub goal: Option<Goal>,
    /// Ids to keep: a list such as `3,10-20`, or a file.
    pub keep_ids: Option<String>,
    /// Ids to drop: a list such as `3,10-20`, or a file.
    pub drop_ids: Option<String>,
    /// Box whose Gaussians are kept: low corner, high corner, scene units.
    pub keep_box: Option<[f64; 6]>,
    /// Policy for an output that exists already.
    pub overwrite: Replace,
}

impl Request {
    /// Returns a request that prunes and merges `input` to the size that the recipe gives. It keeps and drops no single
    /// Gaussians and replaces no existing output.
    pub fn new(input: InputOptions, output: PathBuf, recipe: Recipe) -> Self {
        Request {
            input,
            output,
            kind: None,
            recipe,
            made_for: None,
            archive_psnr: None,
            only: Only::Both,
            target: None,
            goal: None,
            keep_ids: None,
            drop_ids: None,
            keep_box: None,
            overwrite: Replace::Never,
        }
    }
}

impl Target {
    /// Returns the target number of Gaussians for an input of `count` Gaussians.
    ///
    /// # Errors
    /// Fails if the ratio is not in (0, 1] or the number is not in 1..=`count`. An input without Gaussians always gives
    /// 0.
    pub fn count(self, count: usize) -> Result<usize> {
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
