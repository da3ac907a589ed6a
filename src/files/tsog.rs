//! Reads and writes `.tsog` files, version 4 of the format (temporal SOG), which hold moving Gaussians as lossless WebP
//! images in a ZIP archive.
//!
//! An archive holds the images and the members of `meta.json` of a [`.sog`](super::sog) file, and also the members in
//! the table. Time t runs from 0 to 1. Sources: the encoder of xiaomi-research/tsog, and the playback profile of
//! OpsiClear-4DGS/ftgs-player.
//!
//! | member | content | value of the bytes R G B of its images |
//! |---|---|---|
//! | `timeline`, type 1 | range of c and σ, two images | low and high byte of c and σ: opacity α·exp(−½((t − c)/σ)²) |
//! | `timeline`, type 0 | numbers of frames `N` and `delta`, two images | low and high byte of q: the Gaussian is seen in frame ⌊q/delta⌋ only |
//! | `temporal.means` | range of the velocity v, one or two images | v with 8 or 16 bits: position + v·(t − c) |
//! | `profile`, `fps`, `playback` | version of the profile, frame rate and duration | |
//!
//! Without `timeline` the file is a still. The member `splatsieve`, which players ignore, maps the time of the player
//! to the time of the sequence that was converted.

pub mod read;
pub mod write;

use serde::{Deserialize, Serialize};

use super::sog::Meta;
use crate::files::ftgs::{ClipTimes, PARAMS_PER_GAUSSIAN};
use crate::model::StoredParams;

/// Version of the `.tsog` format that is read and written.
pub const VERSION: u64 = 4;
/// Name of the playback profile that `meta.json` of a written `.tsog` file states, because players expect it.
const PROFILE: &str = "org.opsiclear.tsog-playback";
/// Number of frames that is assumed for a sequence whose `.tsog` file states no duration.
const DEFAULT_FRAMES: usize = 300;

/// Times at which the Gaussians of a file are visible, and whether they move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Timeline {
    /// A still: every Gaussian is visible at every time and does not move.
    Still,
    /// Each Gaussian is seen in a single frame of a sequence with the given number of frames.
    /// [`StoredParams::format_specific`] holds the index of this frame.
    Frames(usize),
    /// Each Gaussian moves linearly and is visible in a Gaussian window of time. [`StoredParams::format_specific`]
    /// holds the center and the log deviation of the window and the velocity, as in [`crate::files::ftgs`].
    Windows,
}

impl Timeline {
    /// Returns the number of parameters per Gaussian in [`StoredParams::format_specific`].
    pub fn param_count(self) -> usize {
        match self {
            Timeline::Still => 0,
            Timeline::Frames(_) => 1,
            Timeline::Windows => PARAMS_PER_GAUSSIAN,
        }
    }
}

/// Gaussians of a file, with the times at which players show them.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedGaussians {
    /// Stored parameters of the Gaussians. `timeline` determines the meaning of [`StoredParams::format_specific`].
    pub params: StoredParams,
    /// Times at which the Gaussians are visible, and whether they move.
    pub timeline: Timeline,
    /// Number and rate of the frames, and the mapping of their times to the range from 0 to 1.
    pub clip: ClipTimes,
}

/// Content of the file `meta.json` of a `.tsog` archive.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct TsogMeta {
    #[serde(flatten)]
    sog: Meta,
    #[serde(skip_serializing_if = "Option::is_none")]
    profile: Option<Profile>,
    #[serde(skip_serializing_if = "Option::is_none")]
    timeline: Option<TimelineEntry>,
    #[serde(skip_serializing_if = "Option::is_none")]
    temporal: Option<Temporal>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fps: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    playback: Option<Playback>,
    #[serde(skip_serializing_if = "Option::is_none")]
    splatsieve: Option<OriginalTimes>,
}

/// Member `profile` of `meta.json`: the playback profile that the archive follows.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Profile {
    id: String,
    version: u64,
}

/// Member `timeline` of `meta.json`: names and value ranges of the two images of the time windows (type 1) or of the
/// frames (type 0) of the Gaussians.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct TimelineEntry {
    #[serde(rename = "type")]
    kind: u64,
    #[serde(rename = "N", skip_serializing_if = "Option::is_none")]
    frames: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    delta: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mins: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    maxs: Option<[f64; 2]>,
    files: [String; 2],
}

/// Member `temporal` of `meta.json`: the motion of the Gaussians. Its member `means` describes the velocities.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Temporal {
    means: Velocity,
}

/// Member `temporal.means` of `meta.json`: range of the velocities, and the names of their images: one image with 8
/// bits per axis, or two images with the low and the high bytes of 16 bits per axis.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Velocity {
    mins: [[f64; 3]; 1],
    maxs: [[f64; 3]; 1],
    files: Vec<String>,
}

/// Member `playback` of `meta.json`: settings of the player.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Playback {
    /// Duration of the playback in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    duration: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fps: Option<f64>,
}

/// Member `splatsieve` of `meta.json`: times of the first and the last frame of the sequence that was converted.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct OriginalTimes {
    times: [f64; 2],
}

/// Returns how many 16-bit codes stand for one frame in a timeline of type 0, in which each Gaussian is seen in a
/// single frame: 65,536 / `frames`, rounded down. `frames` is the number of frames of the sequence.
fn codes_per_frame(frames: usize) -> usize {
    (1 << 16) / frames.max(1)
}

#[cfg(test)]
mod tests;
