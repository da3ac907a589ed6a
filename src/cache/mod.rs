//! A work folder: what stages found, kept so that a run that was cut short goes on and that several runs share the work.
//!
//! Every result of a stage is a *piece*, a file named after the stage and the digest of all that the result follows from:
//! input, cameras, parameters, this program's version and the machine's instructions. So a piece is never out of date; a
//! changed recipe asks for pieces of other names. A stage that can be divided has *units* (blocks of Gaussians, pictures,
//! frame blocks); part `i` of `n` of it is a run of consecutive units, and parts join to what the whole would have been,
//! bit for bit. Pieces appear whole or not at all, and one that is damaged is computed again.
//!
//! Without a folder nothing is kept: the same calls compute what they are asked for.

pub(crate) mod dir;
pub(crate) mod entry;
mod folder;
mod key;
pub(crate) mod shard;
mod spill;

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::cache::dir::CacheDir;
use crate::cache::entry::EntryName;
use crate::cache::shard::MOST_PARTS;
pub use crate::cache::shard::{Completion, Shard};
use crate::error::{Error, Result};
use crate::model::ranges;
pub use folder::{Listed, clean, list, text};
pub use key::CacheKey;
pub use spill::{Spill, SpillWriter};

/// What a user asks for.
#[derive(Debug, Clone)]
pub struct CacheRequest {
    /// The work folder.
    pub folder: PathBuf,
    /// Of the next stage that can be divided this part is computed and nothing else; none: everything.
    pub part: Option<Shard>,
}

/// Where the results of stages are kept, if anywhere, and which part of the work is this run's.
#[derive(Debug, Default)]
pub struct Cache {
    place: Option<CacheDir>,
    part: Option<Shard>,
    /// Key of the Gaussians that the input is read without; none: it is read with all.
    absent: Mutex<Option<CacheKey>>,
    said: Mutex<Vec<String>>,
}

impl Cache {
    /// Nothing is kept.
    pub fn none() -> Cache {
        Cache::default()
    }

    /// As `asked`, in a folder that is created if it is not there. `about` says in words what the pieces belong to.
    ///
    /// # Errors
    /// A folder that cannot be created, or is none.
    pub fn open(asked: &CacheRequest, about: String) -> Result<Cache> {
        Ok(Cache { place: Some(CacheDir::at(&asked.folder, about)?), part: asked.part, ..Cache::default() })
    }

    /// From now on everything follows from what `context` stands for, too.
    pub fn follow_from(&mut self, context: CacheKey) {
        if let Some(place) = &mut self.place {
            place.follow_from(context);
        }
    }

    /// Whether anything is kept.
    pub fn keeps(&self) -> bool {
        self.place.is_some()
    }

    /// Has all keys made from now on follow from the ids of the Gaussians that the input is read without, if there are any.
    pub fn set_absent(&self, ids: &[u32]) {
        *self.absent.lock().unwrap_or_else(PoisonError::into_inner) =
            (self.keeps() && !ids.is_empty()).then(|| CacheKey::new(&ids));
    }

    /// The key of `value`; where nothing is kept it stands for nothing, and takes no time.
    pub fn key(&self, value: &impl Serialize) -> CacheKey {
        let absent = *self.absent.lock().unwrap_or_else(PoisonError::into_inner);
        match (self.keeps(), absent) {
            (false, _) => CacheKey::NONE,
            (true, None) => CacheKey::new(value),
            (true, Some(absent)) => CacheKey::new(value).and(&absent),
        }
    }

    /// Things a person should know, said once.
    pub fn take_notes(&self) -> Vec<String> {
        std::mem::take(&mut self.said.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn say(&self, note: String) {
        self.said.lock().unwrap_or_else(PoisonError::into_inner).push(note);
    }

    /// What `stage` found earlier for `key`, if that is there.
    ///
    /// # Errors
    /// A folder that cannot be read. A damaged piece counts as none, with a note.
    pub fn find<T: DeserializeOwned>(&self, stage: &str, key: CacheKey) -> Result<Option<T>> {
        self.find_part(stage, key, Shard::WHOLE)
    }

    /// Keeps what `stage` found for `key`.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn keep<T: Serialize>(&self, stage: &str, key: CacheKey, found: &T) -> Result<()> {
        self.keep_part(stage, key, Shard::WHOLE, found)
    }

    /// What `compute` finds as `stage` for `key`, or found earlier. A run of a part computes it too, unless `compute` says
    /// that it is [not divided](Work::not_divided).
    ///
    /// # Errors
    /// Those of `compute`, and of the folder.
    pub fn known<T: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        key: CacheKey,
        compute: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        if let Some(found) = self.find(stage, key)? {
            return Ok(found);
        }
        let found = compute()?;
        self.keep(stage, key, &found)?;
        Ok(found)
    }

    /// Ends a run of a part before `stage`, which cannot be divided.
    ///
    /// # Errors
    /// [`Error::ShardDone`] in a run of a part.
    pub fn not_divided(&self, stage: &str) -> Result<()> {
        match self.part {
            None => Ok(()),
            Some(part) => Err(Error::ShardDone(format!(
                "part {part}: nothing to do; what comes next, {stage}, is not divided: run without --part"
            ))),
        }
    }

    /// What `join` makes of what `compute` finds for consecutive runs of all `units` of `stage`, in order; here or in other
    /// runs. However often they are cut, the same must come out.
    ///
    /// # Errors
    /// Those of `compute` and `join`, and of the folder; [`Error::ShardDone`] in a run of a part, which has computed it then
    /// if it was not there.
    pub fn divided<T: Serialize + DeserializeOwned, U: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        key: CacheKey,
        units: usize,
        compute: impl Fn(Range<usize>) -> Result<T>,
        join: impl FnOnce(&mut dyn Iterator<Item = Result<T>>) -> Result<U>,
    ) -> Result<U> {
        if let Some(whole) = self.find(stage, key)? {
            return Ok(whole);
        }
        let find = |part| self.find_part(stage, key, part);
        let make = |part: Shard| -> Result<T> {
            let found = compute(part.of_units(units))?;
            self.keep_part(stage, key, part, &found)?;
            Ok(found)
        };
        let of = self.divide(stage, key, &find, &make)?;
        let whole = match of {
            1 => join(&mut std::iter::once_with(|| compute(0..units)))?,
            _ => join(&mut Shard::all(of).map(|part| find(part)?.map_or_else(|| make(part), Ok)))?,
        };
        self.keep(stage, key, &whole)?;
        self.complete(stage, whole)
    }

    /// The same of content that stays on the disk, written by `write`; in `scratch`, where nothing is kept. Gives the
    /// units of every part, and their content.
    ///
    /// # Errors
    /// Those of [`Cache::divided`].
    pub fn divided_spill(
        &self,
        stage: &str,
        key: CacheKey,
        units: usize,
        scratch: &Path,
        write: impl Fn(Range<usize>, &mut SpillWriter) -> Result<()>,
    ) -> Result<Vec<(Range<usize>, Spill)>> {
        let find = |part| match &self.place {
            None => Ok(None),
            Some(place) => place.open(&EntryName::new(stage, place.key(key), part), |note| self.say(note)),
        };
        let make = |part: Shard| -> Result<Spill> {
            let mut spilling = match &self.place {
                None => SpillWriter::new(scratch)?,
                Some(place) => place.begin(&EntryName::new(stage, place.key(key), part))?,
            };
            write(part.of_units(units), &mut spilling)?;
            spilling.finish()
        };
        if let Some(whole) = find(Shard::WHOLE)? {
            return Ok(vec![(0..units, whole)]);
        }
        let of = self.divide(stage, key, &find, &make)?;
        let spill = |part: Shard| Ok((part.of_units(units), find(part)?.map_or_else(|| make(part), Ok)?));
        let spills = Shard::all(of).map(spill).collect::<Result<_>>()?;
        self.complete(stage, spills)
    }

    /// All of `stage`, with which a run of its only part ends.
    fn complete<T>(&self, stage: &str, whole: T) -> Result<T> {
        match self.part {
            Some(Shard::WHOLE) => Err(Error::ShardDone(format!("{stage}: part {} is done; it is all", Shard::WHOLE))),
            _ => Ok(whole),
        }
    }

    /// In how many parts `stage`, of which the whole is not there, is to be taken: they are there or to be made; 1: the
    /// whole is to be made. A run of one of several parts makes that and ends.
    fn divide<T>(
        &self,
        stage: &str,
        key: CacheKey,
        find: &dyn Fn(Shard) -> Result<Option<T>>,
        make: &dyn Fn(Shard) -> Result<T>,
    ) -> Result<usize> {
        let Some(place) = &self.place else { return Ok(1) };
        // By the number of parts, those that are there.
        let there = place.parts(stage, key)?;
        if let Some((&of, _)) = there.iter().find(|(of, parts)| parts.len() == **of) {
            return Ok(of);
        }
        let Some(part) = self.part else {
            let Some((&of, parts)) = there.iter().max_by_key(|(of, parts)| parts.len() * MOST_PARTS / **of) else {
                self.say_of_others(place, stage, key)?;
                return Ok(1);
            };
            self.say(format!("{stage}: missing of {of} parts, and computed here: {}", missing(parts, of)));
            return Ok(of);
        };
        let (_, of) = part.numbers();
        if of == 1 {
            return Ok(1);
        }
        // One that has its name may be damaged.
        let done = match find(part)? {
            Some(_) => "is there already",
            None => {
                make(part)?;
                "is done"
            }
        };
        if there.is_empty() {
            self.say_of_others(place, stage, key)?;
        }
        let there = place.parts(stage, key)?.remove(&of).unwrap_or_default();
        let mut said = match there.len() == of {
            true => format!("{stage}: part {part} {done}; all parts are there"),
            false => format!("{stage}: part {part} {done}; missing: {}", missing(&there, of)),
        };
        self.take_notes().iter().for_each(|note| said += &format!("\n  note: {note}"));
        Err(Error::ShardDone(said))
    }

    /// Says that there are parts of `stage` that are none of this run's.
    fn say_of_others(&self, place: &CacheDir, stage: &str, key: CacheKey) -> Result<()> {
        for other in place.others(stage, key)? {
            self.say(format!(
                "{stage}: parts that are there are of another input, recipe, version or kind of processor, and are not \
                 used; they belong to {other}"
            ));
        }
        Ok(())
    }

    fn find_part<T: DeserializeOwned>(&self, stage: &str, key: CacheKey, part: Shard) -> Result<Option<T>> {
        let Some(place) = &self.place else { return Ok(None) };
        place.read(&EntryName::new(stage, place.key(key), part), |note| self.say(note))
    }

    fn keep_part<T: Serialize>(&self, stage: &str, key: CacheKey, part: Shard, found: &T) -> Result<()> {
        let Some(place) = &self.place else { return Ok(()) };
        place.write(&EntryName::new(stage, place.key(key), part), found)
    }
}

/// Which of `of` parts are not `there`.
fn missing(there: &BTreeSet<usize>, of: usize) -> String {
    ranges(&(1..=of).filter(|index| !there.contains(index)).collect::<Vec<_>>()).join(", ")
}

#[cfg(test)]
mod tests;
