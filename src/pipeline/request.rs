//! What a user asks for.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::files::atomic::Replace;
use crate::outputs::kind::OutputKind;
use crate::recipe::Recipe;
use crate::scene::InputOptions;

/// Which of pruning and merging to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Only {
    /// Prune, then merge.
    #[default]
    Both,
    /// The paper's "pruned".
    Prune,
    /// The paper's "merged".
    Merge,
}

/// How many Gaussians the output is to have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// This many.
    Count(u64),
    /// This fraction of the input, in (0, 1], rounded to the nearest and at least one.
    Ratio(f64),
}

/// What the size of the output is to be found by.
#[derive(Debug, Clone, PartialEq)]
pub enum Goal {
    /// The smallest that is as good as this.
    Quality(Quality),
    /// The best with at most this many bytes of everything that is written.
    Bytes(u64),
}

/// How good an output is to be.
#[derive(Debug, Clone, PartialEq)]
pub enum Quality {
    /// At least this mean PSNR against the original's own pictures, dB.
    Psnr(f64),
    /// At most this much PSNR against photographs less than the original has, dB.
    Loss {
        /// dB.
        most: f64,
        /// Folder of the photographs.
        photographs: PathBuf,
    },
}

/// `value` of the parameter `name`, if it is one of a quality.
///
/// # Errors
/// One that is not, in words.
pub(super) fn decibels(name: &str, value: f64) -> std::result::Result<f64, String> {
    match value > 0.0 && value <= 100.0 {
        true => Ok(value),
        false => Err(format!("{name}: expected decibels above 0 and at most 100, found {value}")),
    }
}

/// Everything a compression is asked for.
#[derive(Debug, Clone)]
pub struct Request {
    /// What to read.
    pub input: InputOptions,
    /// Where to write.
    pub output: PathBuf,
    /// What to write; none: by the output's name.
    pub kind: Option<OutputKind>,
    /// All hyper-parameters.
    pub recipe: Recipe,
    /// Digest of the input that the recipe was written beside, if it was: another input is noted.
    pub made_for: Option<String>,
    /// PSNR of an archive's pictures against those of the result before, dB; none: by the result's own level.
    pub archive_psnr: Option<f64>,
    /// Which stages to run.
    pub only: Only,
    /// Exact size of the output, if asked for.
    pub target: Option<Target>,
    /// What the output's size is to be found by, if it is; then there is no target.
    pub goal: Option<Goal>,
    /// Ids to keep: a list or a file.
    pub keep_ids: Option<String>,
    /// Ids to drop: a list or a file.
    pub drop_ids: Option<String>,
    /// Box whose Gaussians are kept.
    pub keep_box: Option<[f64; 6]>,
    /// Replace an earlier output.
    pub overwrite: Replace,
}

impl Request {
    /// Prunes and merges `input` to the recipe's own size, keeps and drops nobody in particular, replaces nothing.
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
    /// The number of Gaussians it means for an input of `count`.
    pub fn count(self, count: usize) -> Result<usize> {
        let wanted = match self {
            Target::Count(wanted) => wanted,
            Target::Ratio(ratio) if ratio > 0.0 && ratio <= 1.0 => ((ratio * count as f64).round() as u64).max(1),
            Target::Ratio(ratio) => {
                return Err(Error::usage(format!(
                    "--target-ratio: expected a number above 0 and at most 1, found {ratio}"
                )));
            }
        };
        match usize::try_from(wanted) {
            Ok(wanted @ 1..) if wanted <= count => Ok(wanted),
            // The empty scene has one size only.
            _ if count == 0 => Ok(0),
            _ => Err(Error::usage(format!(
                "--target-count: expected 1 to {count}, the Gaussians of the input, found {wanted}"
            ))),
        }
    }
}
