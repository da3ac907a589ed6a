//! Parts of the work of a stage.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use crate::error::{Error, Result};

/// Most parts that a stage is divided into: each is a file, and of pictures all may be open at once.
pub(super) const MOST_PARTS: usize = 900;

/// Result of a run that may have been asked for one part of the work alone.
#[derive(Debug)]
#[must_use]
pub enum Completion<T> {
    /// The run did all the work.
    Whole(T),
    /// The run did the part it was asked for and wrote no result. Holds what it did, for a person.
    Shard(String),
}

impl<T> Completion<T> {
    /// Turns [`Error::ShardDone`], the early end of a run of one part, into a success.
    ///
    /// # Errors
    /// Every other error of `result`.
    pub(crate) fn from_result(result: Result<T>) -> Result<Completion<T>> {
        match result {
            Ok(whole) => Ok(Completion::Whole(whole)),
            Err(Error::ShardDone(done)) => Ok(Completion::Shard(done)),
            Err(error) => Err(error),
        }
    }
}

/// Part `index`, counted from 1, of `of`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    of: usize,
}

impl Shard {
    /// All there is.
    pub(super) const WHOLE: Shard = Shard { index: 1, of: 1 };

    /// Every part of `of`.
    pub(super) fn all(of: usize) -> impl Iterator<Item = Shard> {
        (1..=of).map(move |index| Shard { index, of })
    }

    /// Its number, and how many there are.
    pub(super) fn numbers(self) -> (usize, usize) {
        (self.index, self.of)
    }

    /// Which of `units` are its own.
    pub(super) fn of_units(self, units: usize) -> Range<usize> {
        let end = |parts: usize| (units as u128 * parts as u128 / self.of as u128) as usize;
        end(self.index - 1)..end(self.index)
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.of)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Shard, String> {
        let numbers = text.split_once('/').and_then(|(index, of)| Some((index.parse().ok()?, of.parse().ok()?)));
        match numbers {
            Some((index, of)) if (1..=of).contains(&index) && of <= MOST_PARTS => Ok(Shard { index, of }),
            _ => Err(format!("expected i/n with 1 <= i <= n <= {MOST_PARTS}, such as 3/8")),
        }
    }
}
