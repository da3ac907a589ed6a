//! Shards: parts of the work of a stage that several processes divide among themselves.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use crate::error::{Error, Result};

/// Maximum number of shards (parts) of a stage. Each shard is a file, and all files of a stage may be open at once.
pub(super) const MAX_SHARDS: usize = 900;

/// Outcome of a run, which may be limited to one shard (part of a divided stage).
#[derive(Debug)]
#[must_use]
pub enum Completion<T> {
    /// The run did all its work, with this result.
    Whole(T),
    /// The run computed one shard (part of a divided stage) and wrote no result. Holds a report for display.
    Shard(String),
}

impl<T> Completion<T> {
    /// Converts the result of a run that may be limited to one shard (part of a divided stage):
    /// - Success becomes [`Completion::Whole`].
    /// - [`Error::ShardDone`], with which a limited run ends, becomes [`Completion::Shard`].
    ///
    /// # Errors
    /// Fails if `result` is any other error.
    pub(crate) fn from_result(result: Result<T>) -> Result<Completion<T>> {
        match result {
            Ok(whole) => Ok(Completion::Whole(whole)),
            Err(Error::ShardDone(done)) => Ok(Completion::Shard(done)),
            Err(error) => Err(error),
        }
    }
}

/// One of the `count` shards (parts) into which the work of a stage is divided. `index` is its number, counted from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    count: usize,
}

impl Shard {
    /// Shard 1 of 1, which contains all the work of a stage. A shard is a part of a stage's work.
    pub(super) const WHOLE: Shard = Shard { index: 1, count: 1 };

    /// Returns all `count` shards (parts) of a divided stage, in order.
    pub(super) fn all(count: usize) -> impl Iterator<Item = Shard> {
        (1..=count).map(move |index| Shard { index, count })
    }

    /// Returns the index of the shard (part of a divided stage), from 1, and the number of shards.
    pub(super) fn numbers(self) -> (usize, usize) {
        (self.index, self.count)
    }

    /// Returns the range of a stage's units of work, 0 to `units`, that belongs to this shard (part of the stage).
    pub(super) fn unit_range(self, units: usize) -> Range<usize> {
        let end = |shards: usize| (units as u128 * shards as u128 / self.count as u128) as usize;
        end(self.index - 1)..end(self.index)
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Shard, String> {
        let numbers = text.split_once('/').and_then(|(index, count)| Some((index.parse().ok()?, count.parse().ok()?)));
        match numbers {
            Some((index, count)) if (1..=count).contains(&index) && count <= MAX_SHARDS => Ok(Shard { index, count }),
            _ => Err(format!("expected i/n with 1 <= i <= n <= {MAX_SHARDS}, such as 3/8")),
        }
    }
}
