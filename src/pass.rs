//! How frames reach a pass: a source hands out readers over blocks of Gaussians.

use std::ops::{Range, Sub};

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::model::{Columns, Gaussians, SequenceInfo};

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

/// What was read of a source.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reads {
    /// Stored bytes.
    pub bytes: u64,
    /// Tiles of a container decoded.
    pub tiles: u64,
    /// States handed out, each of one Gaussian at one frame.
    pub states: u64,
}

impl Sub for Reads {
    type Output = Reads;

    fn sub(self, before: Reads) -> Reads {
        Reads {
            bytes: self.bytes - before.bytes,
            tiles: self.tiles - before.tiles,
            states: self.states - before.states,
        }
    }
}

/// A sequence of Gaussians that can be read block by block, frame by frame, in any order, from
/// several threads. The same (Gaussian, frame) always gives the same bits, whatever the block.
pub trait FrameSource: Send + Sync {
    /// Size, time stamps and varying columns.
    fn info(&self) -> &SequenceInfo;

    /// What readers of it have read so far.
    fn reads(&self) -> Reads {
        Reads::default()
    }

    /// A reader over the Gaussians `ids`, in that order. What does not change with time is prepared
    /// here once.
    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>>;

    /// The columns `want` of all Gaussians at `frame`, if reading them together costs less than block by block.
    fn whole(&self, _frame: usize, _want: Columns) -> Option<Result<Gaussians>> {
        None
    }
}

/// Reads one block of Gaussians at any frame.
pub trait BlockReader: Send {
    /// Writes the columns `want` of the block at `frame` into `out`, which is resized to the block.
    /// Columns outside `want` are left alone.
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()>;

    /// Keeps from now on at most `frames` (at least 1) of those that have to be decoded together anyway: less
    /// memory, at the price of decoding again. Readers that keep no frames have nothing to do.
    fn hold(&mut self, _frames: usize) {}
}
