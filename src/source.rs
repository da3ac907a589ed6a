//! Traits by which frames are read: a source opens readers over blocks of Gaussians, is told which frames they will be
//! asked for, and counts what it reads.

use std::ops::{Add, Range, Sub};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, SequenceInfo, StoredParams};

/// Gaussians of a sequence that a reader covers.
#[derive(Debug, Clone)]
pub enum Ids<'a> {
    /// Consecutive ids.
    Range(Range<usize>),
    /// List of ids, in any order.
    List(&'a [u32]),
}

impl Ids<'_> {
    /// Returns the number of ids.
    pub fn len(&self) -> usize {
        match self {
            Ids::Range(range) => range.len(),
            Ids::List(list) => list.len(),
        }
    }

    /// Returns whether there are no ids.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns an iterator over the ids.
    pub fn iter(&self) -> impl Iterator<Item = usize> {
        let (range, list) = match self {
            Ids::Range(range) => (range.clone(), &[][..]),
            Ids::List(list) => (0..0, *list),
        };
        range.chain(list.iter().map(|&id| id as usize))
    }
}

/// Frames that a reader will be asked for. With this plan, frames that share a tile are decoded once, and only those
/// that are needed are kept.
///
/// The plan is advice: reading other frames, or these in another order, gives the same values but costs more.
#[derive(Debug, Clone)]
pub struct ReadPlan {
    /// Frames in increasing order; `None`: every frame.
    frames: Option<Arc<[usize]>>,
    held: usize,
}

impl ReadPlan {
    /// Creates the plan to read every frame in order, which is the default of readers.
    pub fn every() -> ReadPlan {
        ReadPlan { frames: None, held: usize::MAX }
    }

    /// Creates the plan to read `frames` in increasing order. Order and duplicates of the argument do not matter.
    pub fn new(frames: impl IntoIterator<Item = usize>) -> ReadPlan {
        let mut frames: Vec<usize> = frames.into_iter().collect();
        frames.sort_unstable();
        frames.dedup();
        ReadPlan { frames: Some(frames.into()), held: usize::MAX }
    }

    /// Limits the number of frames kept, of those that are decoded together, to `frames` (at least 1). This takes less
    /// memory but decodes tiles repeatedly.
    pub fn holding(self, frames: usize) -> ReadPlan {
        ReadPlan { held: frames.max(1), ..self }
    }

    /// Returns the maximum number of frames to keep.
    pub fn held(&self) -> usize {
        self.held
    }

    /// Returns the planned frames from `frame` (inclusive) to `end` (exclusive). A frame that is not in the plan is
    /// returned alone.
    pub fn between(&self, frame: usize, end: usize) -> Vec<usize> {
        match &self.frames {
            None => (frame..end).collect(),
            Some(frames) => match frames.binary_search(&frame) {
                Ok(at) => frames[at..].iter().copied().take_while(|&frame| frame < end).collect(),
                Err(_) => vec![frame],
            },
        }
    }

    /// Returns the first planned frame at or after `frame`.
    pub fn next(&self, frame: usize) -> Option<usize> {
        match &self.frames {
            None => Some(frame),
            Some(frames) => frames.get(frames.partition_point(|&wanted| wanted < frame)).copied(),
        }
    }
}

/// Amounts read from a source, counted where reading happens.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reads {
    /// Stored bytes of attribute values read from files.
    pub bytes: u64,
    /// Number of tiles decoded; 0 for sources without tiles.
    pub tiles: u64,
    /// Number of states (one Gaussian at one frame) evaluated or returned, regardless of the columns read.
    pub states: u64,
}

impl Add for Reads {
    type Output = Reads;

    fn add(self, other: Reads) -> Reads {
        Reads { bytes: self.bytes + other.bytes, tiles: self.tiles + other.tiles, states: self.states + other.states }
    }
}

impl Sub for Reads {
    type Output = Reads;

    /// Returns the amounts read since `before`.
    fn sub(self, before: Reads) -> Reads {
        Reads {
            bytes: self.bytes - before.bytes,
            tiles: self.tiles - before.tiles,
            states: self.states - before.states,
        }
    }
}

/// Counter that many threads add to. A clone starts from zero, because it belongs to another source.
#[derive(Debug, Default)]
pub struct Count(AtomicU64);

impl Count {
    /// Adds `more` to the count.
    pub fn add(&self, more: u64) {
        // Relaxed ordering suffices: the sum is read after reading has finished.
        self.0.fetch_add(more, Ordering::Relaxed);
    }

    /// Returns the sum so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

impl Clone for Count {
    fn clone(&self) -> Count {
        Count::default()
    }
}

/// Sequence of Gaussians that can be read block by block and frame by frame, in any order, from several threads. The
/// same Gaussian at the same frame always has the same bits, whatever the block.
pub trait FrameSource: Send + Sync {
    /// Returns the number of Gaussians, the time stamps and the varying columns.
    fn info(&self) -> &SequenceInfo;

    /// Opens a reader over the Gaussians `ids`, in that order. Work that does not depend on time is done here once.
    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>>;

    /// Opens a reader over all Gaussians for the frames `wanted`, if it costs less than readers of blocks; else returns
    /// `None`. It may take more memory per Gaussian than readers of blocks.
    fn open_all(&self, _wanted: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        None
    }

    /// Returns the deformation that maps stored parameters to states, if it is more than a sum. `None` for explicit
    /// trajectories, where a change of the stored parameters is the same change of every frame's state.
    fn deformation(&self) -> Option<&dyn Deformation> {
        None
    }

    /// Returns the decoder of pixel colors, if the Gaussians have features in place of colors. The colors of the states
    /// then only approximate the renders.
    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        None
    }

    /// Returns the amounts read so far by all readers; zeros if the source does not count.
    fn reads(&self) -> Reads {
        Reads::default()
    }

    /// Returns how to fetch bytes before they are read, if waiting for them costs more than asking for them early.
    fn ahead(&self) -> Option<&dyn Prefetch> {
        None
    }
}

/// States computed from stored parameters, which are the same for all frames, by a differentiable function.
pub trait Deformation: Sync {
    /// Returns the stored parameters.
    fn stored(&self) -> &StoredParams;

    /// Returns the columns of the stored parameters that have derivatives.
    fn movable(&self) -> Attributes;

    /// Writes the columns `want` of the state at `frame` to `out`, for Gaussians with the parameters `stored`. Resizes
    /// these columns of `out`.
    fn state(&self, frame: usize, stored: &StoredParams, want: Attributes, out: &mut Gaussians) -> Result<()>;

    /// Returns the derivatives of the columns `want` of that state with respect to the same columns of `stored`.
    fn jacobian(&self, frame: usize, stored: &StoredParams, want: Attributes) -> Result<Jacobian>;
}

/// Decoder of features that take the place of colors. Features are blended without a background, and the decoder
/// computes the color of each pixel from the blended features.
pub trait FeatureDecoder: Sync {
    /// Writes the features of all Gaussians at `frame` to `out`, one plane per feature.
    fn features(&self, frame: usize, out: &mut AttributeValues) -> Result<()>;

    /// Returns red, green and blue of a pixel with the blended `features`, seen from `center` along the unit vector
    /// `ray`.
    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3];
}

/// Source on a disk whose bytes can be fetched before they are used, by a thread that does nothing else.
pub trait Prefetch: Sync {
    /// Returns the number of frames that are fetched and decoded together. Frame blocks start at its multiples.
    fn frame_block(&self) -> usize;

    /// Fetches the bytes of the columns `want` of `gaussians` at `frames`, and waits for them. Failures are reported
    /// when the bytes are read.
    fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Attributes);
}

/// Reader of one block of Gaussians at any frame.
pub trait BlockReader: Send {
    /// Writes the columns `want` of the block at `frame` to `out`, and resizes these columns to the block. Leaves other
    /// columns unchanged.
    ///
    /// # Errors
    /// A frame that cannot be read.
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()>;

    /// Announces the frames that the reader will be asked for from now on, and how many it may keep. Readers that keep
    /// no frames ignore it.
    fn expect(&mut self, _wanted: &ReadPlan) {}

    /// Does the work of reading `want` at `frame`, and at the frames decoded with it, except for copying, as far as the
    /// reader may keep the result.
    fn prepare(&mut self, _frame: usize, _want: Attributes) -> Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unplanned_frames_are_read_alone() {
        let wanted = ReadPlan::new([40, 3, 9, 3, 31]).holding(0);
        assert_eq!(wanted.held(), 1);
        assert_eq!(wanted.between(3, 32), [3, 9, 31]);
        assert_eq!(wanted.between(9, 32), [9, 31]);
        assert_eq!(wanted.between(4, 32), [4]);
        assert_eq!([wanted.next(0), wanted.next(32), wanted.next(41)], [Some(3), Some(40), None]);
        assert_eq!(ReadPlan::every().between(30, 32), [30, 31]);
        assert_eq!(ReadPlan::every().next(64), Some(64));
    }
}
