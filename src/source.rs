//! Traits for reading the frames of a sequence. A [`FrameSource`] opens readers for blocks of Gaussians and counts what
//! they read. The caller can announce to a reader which frames it will read.

use std::ops::{Add, Range, Sub};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, SequenceInfo, StoredParams};

/// Ids of the Gaussians that a reader reads.
#[derive(Debug, Clone)]
pub enum Ids<'a> {
    /// Ids of a range of consecutive Gaussians.
    Range(Range<usize>),
    /// Ids in a list, in any order.
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

/// Plan of the frames that the caller will read from a reader. The plan saves time: the reader decodes a tile (some
/// Gaussians at consecutive frames) once, and keeps only the planned frames of it for later reads.
#[derive(Debug, Clone)]
pub struct ReadPlan {
    /// Frames that will be read, in increasing order; `None` means every frame.
    frames: Option<Arc<[usize]>>,
    max_kept_frames: usize,
}

impl ReadPlan {
    /// Creates the plan to read every frame in order. A reader that is given no plan assumes this one.
    pub fn all_frames() -> ReadPlan {
        ReadPlan { frames: None, max_kept_frames: usize::MAX }
    }

    /// Creates the plan to read each of `frames` once, in increasing order. The order of `frames` and repetitions in it
    /// have no effect.
    pub fn new(frames: impl IntoIterator<Item = usize>) -> ReadPlan {
        let mut frames: Vec<usize> = frames.into_iter().collect();
        frames.sort_unstable();
        frames.dedup();
        ReadPlan { frames: Some(frames.into()), max_kept_frames: usize::MAX }
    }

    /// Returns a copy of this plan in which a reader keeps at most `frames` frames (at least 1) in memory. A reader
    /// that decodes a tile gets several consecutive frames at once, and keeps them for later reads. A small limit saves
    /// memory but makes the reader decode tiles repeatedly.
    pub fn with_max_kept_frames(self, frames: usize) -> ReadPlan {
        ReadPlan { max_kept_frames: frames.max(1), ..self }
    }

    /// Returns the maximum number of frames that a reader keeps in memory after it has decoded a tile, for later reads.
    /// Decoding a tile gives the values of several consecutive frames at once.
    pub fn max_kept_frames(&self) -> usize {
        self.max_kept_frames
    }

    /// Returns whether at most one frame is planned.
    pub fn has_at_most_one_frame(&self) -> bool {
        self.frames.as_ref().is_some_and(|frames| frames.len() <= 1)
    }

    /// Returns the planned frames from `frame` (inclusive) to `end` (exclusive), or `frame` alone if it is not in the
    /// plan.
    pub fn frames_between(&self, frame: usize, end: usize) -> Vec<usize> {
        match &self.frames {
            None => (frame..end).collect(),
            Some(frames) => match frames.binary_search(&frame) {
                Ok(at) => frames[at..].iter().copied().take_while(|&frame| frame < end).collect(),
                Err(_) => vec![frame],
            },
        }
    }

    /// Returns the first planned frame at or after `frame`; `None` if there is none.
    pub fn first_planned_from(&self, frame: usize) -> Option<usize> {
        match &self.frames {
            None => Some(frame),
            Some(frames) => frames.get(frames.partition_point(|&planned| planned < frame)).copied(),
        }
    }
}

/// Amounts read from a source, counted by the code that reads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReadCounts {
    /// Number of bytes of attribute values read from files, as stored there.
    pub bytes: u64,
    /// Number of tiles decoded, a tile being some Gaussians at consecutive frames; 0 for sources without tiles.
    pub tiles: u64,
    /// Number of states (one Gaussian at one frame) evaluated or returned, no matter how many attributes were read.
    pub states: u64,
}

impl Add for ReadCounts {
    type Output = ReadCounts;

    fn add(self, other: ReadCounts) -> ReadCounts {
        ReadCounts {
            bytes: self.bytes + other.bytes,
            tiles: self.tiles + other.tiles,
            states: self.states + other.states,
        }
    }
}

impl Sub for ReadCounts {
    type Output = ReadCounts;

    /// Returns the amounts read between two counts of the same source. `self` is the later count, `before` the earlier
    /// one.
    fn sub(self, before: ReadCounts) -> ReadCounts {
        ReadCounts {
            bytes: self.bytes - before.bytes,
            tiles: self.tiles - before.tiles,
            states: self.states - before.states,
        }
    }
}

/// Counter that many threads add to. A clone starts from zero, because a cloned source counts its own reads.
#[derive(Debug, Default)]
pub struct SharedCounter(AtomicU64);

impl SharedCounter {
    /// Adds `amount` to the count.
    pub fn add(&self, amount: u64) {
        // Relaxed ordering suffices: the sum is read after reading has finished.
        self.0.fetch_add(amount, Ordering::Relaxed);
    }

    /// Returns the sum so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

impl Clone for SharedCounter {
    fn clone(&self) -> SharedCounter {
        SharedCounter::default()
    }
}

/// Sequence of Gaussians that can be read block by block and frame by frame, in any order, from several threads. The
/// values of a Gaussian at a frame are the same to the bit, whichever block of Gaussians they are read with.
pub trait FrameSource: Send + Sync {
    /// Returns the number of Gaussians, the time stamps of the frames and the attributes that vary in time.
    fn info(&self) -> &SequenceInfo;

    /// Opens a reader that returns the Gaussians `ids`, in the order of `ids`. This call also computes everything that
    /// does not depend on time, so that reading many frames does not repeat it.
    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>>;

    /// Opens a reader that returns all Gaussians at the frames of the plan `_wanted`. It may take more memory per
    /// Gaussian than readers of blocks. Returns `None` if reading block by block takes less time.
    fn open_all(&self, _plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        None
    }

    /// Returns the function that computes the states of Gaussians from stored parameters. Returns `None` for models
    /// that store the state at every frame (explicit trajectories). For such a model, an optimizer that changes a
    /// parameter adds the change to the states at all frames.
    fn deformation(&self) -> Option<&dyn Deformation> {
        None
    }

    /// Returns the decoder that computes pixel colors, for models that store features in place of colors; `None` for
    /// models that store colors. With a decoder, the colors in a frame state only approximate the colors of renders.
    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        None
    }

    /// Returns the amounts read so far by all readers of this source; zeros if the source does not count.
    fn reads(&self) -> ReadCounts {
        ReadCounts::default()
    }
}

/// Deformation field, or another differentiable motion model: computes the state of each Gaussian at a frame from its
/// stored parameters, which do not depend on time.
pub trait Deformation: Sync {
    /// Returns the stored parameters of all Gaussians.
    fn stored(&self) -> &StoredParams;

    /// Returns the attributes of the stored parameters that an optimizer can change: the attributes whose derivatives
    /// [`PreparedDeformation::jacobian`] can compute.
    fn movable(&self) -> Attributes;

    /// Prepares the evaluation of the Gaussians with the parameters `stored` at several frames. This call does all the
    /// work that does not depend on time.
    fn with_params<'a>(&'a self, stored: &'a StoredParams) -> Box<dyn PreparedDeformation + 'a>;
}

/// [`Deformation`] that is prepared for one set of stored parameters. Computes the states of these Gaussians at any
/// frame, and their derivatives.
pub trait PreparedDeformation {
    /// Computes the state of all Gaussians at `frame`. Writes only the attributes `want` to `out`, and resizes these.
    ///
    /// # Errors
    /// Fails if there is no such frame or the model cannot be evaluated.
    fn state(&self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()>;

    /// Returns the derivatives of the attributes `want` of the state at `frame` with respect to the same attributes of
    /// the stored parameters.
    ///
    /// # Errors
    /// Fails if there is no such frame or the model cannot be evaluated.
    fn jacobian(&self, frame: usize, want: Attributes) -> Result<Jacobian>;
}

/// Decoder of features that take the place of colors. Features are blended without a background, and the decoder
/// computes the color of each pixel from the blended features.
pub trait FeatureDecoder: Sync {
    /// Writes the features of all Gaussians at `frame` to `out`, one plane (array with a value per Gaussian) per
    /// feature.
    fn features(&self, frame: usize, out: &mut AttributeValues) -> Result<()>;

    /// Returns the red, green and blue of a pixel with the blended `features`. The pixel is seen from the camera center
    /// `center` along the unit vector `ray`.
    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3];
}

/// Reader of one block of Gaussians at any frame.
pub trait BlockReader: Send {
    /// Reads the attributes `want` of the block at `frame` into `out`, which is resized in these attributes. Leaves the
    /// other attributes of `out` unchanged.
    ///
    /// # Errors
    /// Fails if the frame cannot be read.
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()>;

    /// Announces the frames that will be read from now on. The plan `_wanted` lists them and limits how many of them
    /// the reader may keep in memory. Readers that keep no frames ignore the plan.
    fn expect(&mut self, _plan: &ReadPlan) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unplanned_frames_are_read_alone() {
        let wanted = ReadPlan::new([40, 3, 9, 3, 31]).with_max_kept_frames(0);
        assert_eq!(wanted.max_kept_frames(), 1);
        assert_eq!(wanted.frames_between(3, 32), [3, 9, 31]);
        assert_eq!(wanted.frames_between(9, 32), [9, 31]);
        assert_eq!(wanted.frames_between(4, 32), [4]);
        assert_eq!(
            [wanted.first_planned_from(0), wanted.first_planned_from(32), wanted.first_planned_from(41)],
            [Some(3), Some(40), None]
        );
        assert_eq!(ReadPlan::all_frames().frames_between(30, 32), [30, 31]);
        assert_eq!(ReadPlan::all_frames().first_planned_from(64), Some(64));
    }
}
