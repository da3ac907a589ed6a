//! How frames reach a pass: a source hands out readers over blocks of Gaussians, is told which frames they will be asked
//! for, and counts what it reads.

use std::ops::{Add, Range, Sub};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::model::{Column, Columns, Gaussians, Jacobian, Raw, SequenceInfo};

/// Which Gaussians of a sequence a reader covers.
#[derive(Debug, Clone)]
pub enum Ids<'a> {
    /// Consecutive ones.
    Range(Range<usize>),
    /// Any, in any order.
    List(&'a [u32]),
}

impl Ids<'_> {
    /// How many there are.
    pub fn len(&self) -> usize {
        match self {
            Ids::Range(range) => range.len(),
            Ids::List(list) => list.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The ids one by one.
    pub fn iter(&self) -> impl Iterator<Item = usize> {
        let (range, list) = match self {
            Ids::Range(range) => (range.clone(), &[][..]),
            Ids::List(list) => (0..0, *list),
        };
        range.chain(list.iter().map(|&id| id as usize))
    }
}

/// Which frames a reader will be asked for, so that what is decoded together is decoded once and only those are kept.
///
/// Advice: other frames, or these in another order, read the same and cost more.
#[derive(Debug, Clone)]
pub struct ReadPlan {
    /// Increasing; none: every frame.
    frames: Option<Arc<[usize]>>,
    held: usize,
}

impl ReadPlan {
    /// Every frame, in order: what a reader expects unless it is told.
    pub fn every() -> ReadPlan {
        ReadPlan { frames: None, held: usize::MAX }
    }

    /// These frames, in increasing order.
    pub fn new(frames: impl IntoIterator<Item = usize>) -> ReadPlan {
        let mut frames: Vec<usize> = frames.into_iter().collect();
        frames.sort_unstable();
        frames.dedup();
        ReadPlan { frames: Some(frames.into()), held: usize::MAX }
    }

    /// Keeping at most `frames` (at least 1) of those that have to be decoded together anyway: less memory, at the
    /// price of decoding again.
    pub fn holding(self, frames: usize) -> ReadPlan {
        ReadPlan { held: frames.max(1), ..self }
    }

    /// Most frames to keep.
    pub fn held(&self) -> usize {
        self.held
    }

    /// The frames from `frame` on, it included, before `end`. A frame that nobody spoke of stands for itself alone.
    pub fn between(&self, frame: usize, end: usize) -> Vec<usize> {
        match &self.frames {
            None => (frame..end).collect(),
            Some(frames) => match frames.binary_search(&frame) {
                Ok(at) => frames[at..].iter().copied().take_while(|&frame| frame < end).collect(),
                Err(_) => vec![frame],
            },
        }
    }

    /// The first frame from `frame` on.
    pub fn next(&self, frame: usize) -> Option<usize> {
        match &self.frames {
            None => Some(frame),
            Some(frames) => frames.get(frames.partition_point(|&wanted| wanted < frame)).copied(),
        }
    }
}

/// What was read of a source, counted where it happens.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reads {
    /// Stored bytes of values that were read from files.
    pub bytes: u64,
    /// Tiles that were decoded, of sources that have some.
    pub tiles: u64,
    /// States (one Gaussian at one frame) that were evaluated or handed out, whatever their columns.
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

    /// What was read since `before`.
    fn sub(self, before: Reads) -> Reads {
        Reads {
            bytes: self.bytes - before.bytes,
            tiles: self.tiles - before.tiles,
            states: self.states - before.states,
        }
    }
}

/// A count that many threads add to. A copy starts from zero: it belongs to another source.
#[derive(Debug, Default)]
pub struct Count(AtomicU64);

impl Count {
    /// Adds `more`.
    pub fn add(&self, more: u64) {
        // Relaxed: a sum that is looked at when the reading is done.
        self.0.fetch_add(more, Ordering::Relaxed);
    }

    /// The sum so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

impl Clone for Count {
    fn clone(&self) -> Count {
        Count::default()
    }
}

/// A sequence of Gaussians that can be read block by block, frame by frame, in any order, from
/// several threads. The same (Gaussian, frame) always gives the same bits, whatever the block.
pub trait FrameSource: Send + Sync {
    /// Size, time stamps and varying columns.
    fn info(&self) -> &SequenceInfo;

    /// A reader over the Gaussians `ids`, in that order. What does not change with time is prepared
    /// here once.
    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>>;

    /// A reader over all Gaussians, for the frames `wanted`, if it costs less than readers of blocks. Memory: its own,
    /// per Gaussian, may be more than theirs.
    fn open_all(&self, _wanted: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        None
    }

    /// How states follow from what is stored, where that is more than a sum; none of explicit trajectories, of which a
    /// change of what is stored is that change at every frame.
    fn deformation(&self) -> Option<&dyn Deformation> {
        None
    }

    /// How its pictures get their colors, where Gaussians have features in the place of colors; the colors of its states
    /// are then near to what they look like.
    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        None
    }

    /// What was read so far, by all readers; nothing where nobody counts.
    fn reads(&self) -> Reads {
        Reads::default()
    }

    /// How to have its bytes in memory before they are read, where waiting for them would cost more than asking.
    fn ahead(&self) -> Option<&dyn Prefetch> {
        None
    }
}

/// States that follow from what is stored, once for all frames, by a function that can be differentiated.
pub trait Deformation: Sync {
    /// What is stored.
    fn stored(&self) -> &Raw;

    /// Columns of what is stored that a derivative leads to.
    fn movable(&self) -> Columns;

    /// Writes the columns `want` of the state at `frame` of Gaussians stored as `stored` into `out`, which is resized in
    /// them.
    ///
    /// # Errors
    /// A frame that the sequence does not have.
    fn state(&self, frame: usize, stored: &Raw, want: Columns, out: &mut Gaussians) -> Result<()>;

    /// How the columns `want` of that state change with what is stored in them.
    ///
    /// # Errors
    /// A frame that the sequence does not have.
    fn jacobian(&self, frame: usize, stored: &Raw, want: Columns) -> Result<Jacobian>;
}

/// Features in the place of colors: they are blended without a background, and what comes of that decides, pixel by pixel.
pub trait FeatureDecoder: Sync {
    /// Writes the features of all Gaussians at `frame` into `out`: as many planes as there are features.
    ///
    /// # Errors
    /// A frame that the sequence does not have.
    fn features(&self, frame: usize, out: &mut Column) -> Result<()>;

    /// Red, green and blue of a pixel that has blended `features`, seen from `center` along the unit `ray`.
    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3];
}

/// A source on a disk, whose bytes can be brought ahead of their use, from a thread that does nothing else.
pub trait Prefetch: Sync {
    /// Frames that are brought and decoded together: those from a multiple of it to the next.
    fn frame_block(&self) -> usize;

    /// Brings what the columns `want` of `gaussians` take at `frames`, and waits for it. That it cannot be had shows when it is
    /// read.
    fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Columns);
}

/// Reads one block of Gaussians at any frame.
pub trait BlockReader: Send {
    /// Writes the columns `want` of the block at `frame` into `out`, which is resized to the block.
    /// Columns outside `want` are left alone.
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()>;

    /// Tells it which frames it will be asked for from now on, and how many it may keep. Readers that keep no frames
    /// have nothing to do.
    fn expect(&mut self, _wanted: &ReadPlan) {}

    /// Does now what reading `want` at `frame` and at those decoded with it takes beside copying, as far as it may
    /// keep the outcome.
    fn prepare(&mut self, _frame: usize, _want: Columns) -> Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wanted_frames_are_found_from_any_of_them_and_a_stranger_stands_alone() {
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
