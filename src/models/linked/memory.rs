//! Memory of linked frames: while they are opened, stage by stage, and while they are open.

use std::mem::size_of;

use super::steady::{BATCH, TrackSums};
use crate::model::Attributes;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::render::{BYTES_PER_VISIBLE, STRIP_BYTES};
use crate::tracking::{Joiner, Linker};

/// Maximum bytes of frames that are packed or unpacked together; at least one frame is.
pub(super) const TOGETHER_BYTES: u64 = 128 << 20;
/// Bytes of a row in the list of rows of a frame: the row and a copy for sorting.
const BYTES_PER_ROW: u64 = 16;
/// Number of frames rendered before and after tracks are joined or attributes made constant.
pub(super) const SAMPLED_FRAMES: usize = 3;
/// Bytes of two renders by a virtual camera and of their comparison.
const RENDER_BYTES: u64 = 16 << 20;

/// Counts from which the memory of linked frames is estimated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizes {
    /// Maximum number of Gaussians in a frame.
    pub(super) frame_gaussians: u64,
    /// SH degree.
    pub(super) sh_degree: usize,
    /// Number of tracks found by linking, before any are joined.
    pub(super) linked: u64,
    /// Peak number of tracks that may continue in the next frame.
    pub(super) live_tracks: u64,
}

impl Sizes {
    /// Returns the bytes of the state of a Gaussian.
    fn state(&self) -> u64 {
        state_bytes(self.sh_degree, Attributes::all())
    }

    /// Returns the bytes of a Gaussian in the file of a frame: its attributes and 24 bytes of normals and other extra
    /// properties.
    fn file(&self) -> u64 {
        self.state() + 24
    }

    /// Returns the bytes of the largest frame file.
    pub(super) fn frame_file(&self) -> u64 {
        self.frame_gaussians * self.file()
    }

    /// Returns the number of frames that are packed together: whole tiles if frames are small.
    pub(super) fn frame_block(&self) -> usize {
        (TOGETHER_BYTES / self.frame_file().max(1)).clamp(1, FRAME_BLOCK as u64) as usize
    }

    /// Returns the peak bytes while the frames are opened.
    pub(super) fn opening(&self) -> u64 {
        [self.linking(), self.holding(), self.packing()].into_iter().max().unwrap_or(0)
    }

    /// Returns the bytes while the frames are open: first frame and row of every track, the joined track it belongs to,
    /// and its constant columns.
    pub(super) fn open(&self) -> u64 {
        (8 + 4 + size_of::<Attributes>() as u64) * self.linked
    }

    /// Returns the bytes of linking: a frame and its compared attributes, the tracks that may continue, and for every
    /// track its first row and its last state.
    fn linking(&self) -> u64 {
        let of_frame = self.file() + self.state() + Linker::BYTES_PER_GAUSSIAN as u64 + BYTES_PER_ROW;
        let of_living = (Linker::BYTES_PER_TRACK + Joiner::BYTES_PER_OPEN_TRACK) as u64;
        let of_track = 2 * 8 + Joiner::BYTES_PER_TRACK as u64;
        self.frame_gaussians * of_frame + self.live_tracks * of_living + self.linked * of_track
    }

    /// Returns the bytes of the larger of two steps: summing (sums of a batch of tracks and a frame, per thread), or
    /// rendering (the sampled frames before and after the change, and their renders). Joining tracks needs the same for
    /// frames and less for tracks.
    fn holding(&self) -> u64 {
        let threads = rayon::current_num_threads() as u64;
        let sums = self.linked.min(BATCH as u64) * TrackSums::bytes(self.sh_degree);
        let summing = threads * (sums + self.frame_gaussians * (self.file() + self.state() + BYTES_PER_ROW));
        let frames = (2 * SAMPLED_FRAMES as u64 + 1) * self.state() + self.file() + 2 * BYTES_PER_ROW;
        let renders = RENDER_BYTES + threads * STRIP_BYTES as u64;
        let rendering = self.frame_gaussians * (frames + 2 * BYTES_PER_VISIBLE as u64) + renders;
        // First row of each track, a copy in the order of joined tracks, and the lengths of tracks.
        self.open() + 2 * 8 * self.linked + summing.max(rendering)
    }

    /// Returns the bytes of packing: a block of frames, the last row of each track, and a tile of every column per
    /// thread.
    fn packing(&self) -> u64 {
        let frames = self.frame_block() as u64;
        let blocks = (GAUSSIAN_BLOCK as u64).min(self.linked) * (3 * frames + 4) * self.state();
        let of_frame = self.file() + BYTES_PER_ROW;
        self.open()
            + 8 * self.linked
            + frames * self.frame_gaussians * of_frame
            + 2 * rayon::current_num_threads() as u64 * blocks
    }
}
