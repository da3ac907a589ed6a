//! What linked frames take of memory: while they are opened, stage by stage, and while they are open.

use std::mem::size_of;

use super::steady::{BATCH, TrackSums};
use crate::model::Columns;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::render::{BYTES_PER_VISIBLE, STRIP_BYTES};
use crate::tracking::{Joiner, Linker};

/// Most bytes of frames that are packed, or unpacked, together, if that is one frame at least.
pub(super) const TOGETHER_BYTES: u64 = 128 << 20;
/// Of a row in a list of those of a frame: itself, and once more while they are brought into order.
const PER_ROW: u64 = 16;
/// Frames that are looked at before and after lives are joined, or anything is held.
pub(super) const LOOKED_AT: usize = 3;
/// Two pictures by a virtual camera, and what compares them.
const PICTURES: u64 = 16 << 20;

/// What it depends on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizes {
    /// Most Gaussians of a frame.
    pub(super) of_frame: u64,
    /// Degree of the spherical harmonics.
    pub(super) sh_degree: usize,
    /// Tracks as they were linked.
    pub(super) linked: u64,
    /// Most of them that might go on.
    pub(super) living: u64,
}

impl Sizes {
    /// Bytes of a Gaussian's state.
    fn state(&self) -> u64 {
        state_bytes(self.sh_degree, Columns::all())
    }

    /// Bytes of a Gaussian in the file of a frame: normals and the like stand beside the values.
    fn file(&self) -> u64 {
        self.state() + 24
    }

    /// Bytes of a frame's file.
    pub(super) fn frame_file(&self) -> u64 {
        self.of_frame * self.file()
    }

    /// Frames that are packed together: whole tiles where they are small.
    pub(super) fn frame_block(&self) -> usize {
        (TOGETHER_BYTES / self.frame_file().max(1)).clamp(1, FRAME_BLOCK as u64) as usize
    }

    /// Bytes while they are opened, at most.
    pub(super) fn opening(&self) -> u64 {
        [self.linking(), self.holding(), self.packing()].into_iter().max().unwrap_or(0)
    }

    /// Bytes while they are open: where every track begins, which life it is of, and what is held of it.
    pub(super) fn open(&self) -> u64 {
        (8 + 4 + size_of::<Columns>() as u64) * self.linked
    }

    /// A frame, what is compared of it, tracks that may go on, and for every track where it begins and what it goes on from.
    fn linking(&self) -> u64 {
        let of_frame = self.file() + self.state() + Linker::BYTES_PER_GAUSSIAN as u64 + PER_ROW;
        let of_living = (Linker::BYTES_PER_TRACK + Joiner::BYTES_PER_LIVING) as u64;
        let of_track = 2 * 8 + Joiner::BYTES_PER_TRACK as u64;
        self.of_frame * of_frame + self.living * of_living + self.linked * of_track
    }

    /// Sums over some tracks and a frame for every thread; or the frames that are looked at, each as it is and as it is held,
    /// and pictures of them. Joining lives takes the same of frames, and less for tracks.
    fn holding(&self) -> u64 {
        let threads = rayon::current_num_threads() as u64;
        let sums = self.linked.min(BATCH as u64) * TrackSums::bytes(self.sh_degree);
        let summing = threads * (sums + self.of_frame * (self.file() + self.state() + PER_ROW));
        let frames = (2 * LOOKED_AT as u64 + 1) * self.state() + self.file() + 2 * PER_ROW;
        let pictures = PICTURES + threads * STRIP_BYTES as u64;
        let looking = self.of_frame * (frames + 2 * BYTES_PER_VISIBLE as u64) + pictures;
        // Where each begins, once more in the order of lives, and how long each is there.
        self.open() + 2 * 8 * self.linked + summing.max(looking)
    }

    /// A block of frames, where each track was last, and a tile of every column and thread.
    fn packing(&self) -> u64 {
        let frames = self.frame_block() as u64;
        let blocks = (GAUSSIAN_BLOCK as u64).min(self.linked) * (3 * frames + 4) * self.state();
        let of_frame = self.file() + PER_ROW;
        self.open()
            + 8 * self.linked
            + frames * self.of_frame * of_frame
            + 2 * rayon::current_num_threads() as u64 * blocks
    }
}
