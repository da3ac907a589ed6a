//! Estimates the memory of linked frames, whose Gaussians were matched across frames. There are two estimates: the peak
//! while the frames are opened, which takes several steps, and the memory while they are open.

use std::mem::size_of;

use super::steady::{BATCH, TrackSums};
use crate::model::Attributes;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::render::{BYTES_PER_VISIBLE, STRIP_BYTES};
use crate::tracking::{Joiner, Linker};

/// Maximum bytes of frames that are packed into a container, or unpacked from one, at a time. A single frame may be
/// larger than this.
pub(super) const TOGETHER_BYTES: u64 = 128 << 20;
/// Bytes of memory that each Gaussian of a frame takes in two lists. The first list holds its track (Gaussian followed
/// through frames) and its row number in the file of the frame; the second is a sorted copy of the first.
const BYTES_PER_ROW: u64 = 16;
/// Number of frames that are rendered before and after tracks (Gaussians followed through frames) are joined or
/// attributes are made constant, to measure the change.
pub(super) const SAMPLED_FRAMES: usize = 3;
/// Bytes of memory that two renders by a virtual camera and their comparison take.
const RENDER_BYTES: u64 = 16 << 20;

/// Counts of Gaussians and tracks (Gaussians followed through frames), from which memory is estimated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizes {
    /// Number of Gaussians of the largest frame.
    pub(super) frame_gaussians: u64,
    /// SH degree of the Gaussians.
    pub(super) sh_degree: usize,
    /// Number of tracks (Gaussians followed through frames) that linking found, before any of them are joined.
    pub(super) linked: u64,
    /// Number of tracks (Gaussians followed through frames) that may continue in the next frame: the maximum over all
    /// frames.
    pub(super) live_tracks: u64,
}

impl Sizes {
    /// Returns the bytes that all attributes of one Gaussian take in memory.
    fn state(&self) -> u64 {
        state_bytes(self.sh_degree, Attributes::all())
    }

    /// Returns the bytes that one Gaussian takes in the file of a frame: its attributes and 24 bytes of normals and
    /// other extra properties.
    fn file(&self) -> u64 {
        self.state() + 24
    }

    /// Returns the size in bytes of the largest file of a frame.
    pub(super) fn frame_file(&self) -> u64 {
        self.frame_gaussians * self.file()
    }

    /// Returns the number of frames that are packed into the container together: the number that fits into
    /// [`TOGETHER_BYTES`], but at least 1 and at most the number of frames in a tile.
    pub(super) fn frame_block(&self) -> usize {
        (TOGETHER_BYTES / self.frame_file().max(1)).clamp(1, FRAME_BLOCK as u64) as usize
    }

    /// Returns the peak bytes of memory while frames are opened: the maximum over three steps, which are linking,
    /// making attributes constant, and packing.
    pub(super) fn opening(&self) -> u64 {
        [self.linking(), self.holding(), self.packing()].into_iter().max().unwrap_or(0)
    }

    /// Returns the bytes of memory that the tracks (Gaussians followed through frames) take while the frames are open.
    /// Each track takes memory for its first frame and row, the joined track it belongs to, and its constant
    /// attributes.
    pub(super) fn open(&self) -> u64 {
        (8 + 4 + size_of::<Attributes>() as u64) * self.linked
    }

    /// Returns the bytes of memory that linking frames into tracks (Gaussians followed through frames) takes. They are
    /// the sum of:
    /// - the largest frame: its file, its attributes, and the values by which it is linked to the tracks
    /// - for each track that may continue in the next frame: the values with which the next frame is compared
    /// - for each track: its first frame and row, and lists for joining tracks
    fn linking(&self) -> u64 {
        let of_frame = self.file() + self.state() + Linker::BYTES_PER_GAUSSIAN as u64 + BYTES_PER_ROW;
        let of_living = (Linker::BYTES_PER_TRACK + Joiner::BYTES_PER_OPEN_TRACK) as u64;
        let of_track = 2 * 8 + Joiner::BYTES_PER_TRACK as u64;
        self.frame_gaussians * of_frame + self.live_tracks * of_living + self.linked * of_track
    }

    /// Returns the bytes of memory that making attributes constant along tracks (Gaussians followed through frames)
    /// takes. It is the sum of:
    /// - the memory of the open frames ([`Sizes::open`])
    /// - for each track: its first frame and row, and the number of its frames
    /// - the larger one of two steps: computing means takes sums for a batch of tracks and one frame per thread;
    ///   rendering takes the sampled frames before and after the change, and their renders
    ///
    /// Joining tracks reads as many frames as computing means and needs less memory per track, so it is not counted
    /// separately.
    fn holding(&self) -> u64 {
        let threads = rayon::current_num_threads() as u64;
        let sums = self.linked.min(BATCH as u64) * TrackSums::bytes(self.sh_degree);
        let summing = threads * (sums + self.frame_gaussians * (self.file() + self.state() + BYTES_PER_ROW));
        let frames = (2 * SAMPLED_FRAMES as u64 + 1) * self.state() + self.file() + 2 * BYTES_PER_ROW;
        let renders = RENDER_BYTES + threads * STRIP_BYTES as u64;
        let rendering = self.frame_gaussians * (frames + 2 * BYTES_PER_VISIBLE as u64) + renders;
        // First row of each track, a copy in the order of joined tracks, and the lengths of tracks in frames.
        self.open() + 2 * 8 * self.linked + summing.max(rendering)
    }

    /// Returns the bytes of memory that packing tracks (Gaussians followed through frames) into a container takes. It
    /// is the sum of:
    /// - the memory of the open frames ([`Sizes::open`])
    /// - for each track: the frame and row of its last Gaussian so far
    /// - the files of a block of consecutive frames
    /// - for each thread: a tile (block of Gaussians × frames) of every column
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
