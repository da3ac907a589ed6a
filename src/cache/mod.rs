//! Cache of stage results in a work folder. An interrupted run continues from these results, and several processes
//! divide work by writing their parts into the folder.
//!
//! Every result of a stage is a *cache entry*: a file named after the stage and the cache key, the digest of everything
//! that the result depends on (input, cameras, parameters, version of this program, instruction set of the machine). So
//! an entry is never out of date; a changed recipe uses entries with other names. A stage that can be divided has
//! *units* (blocks of Gaussians, views, frame blocks). A *shard* is a range of consecutive units, shard `i` of `n`;
//! joined shards equal the undivided result bit for bit. Entries appear completely or not at all. The result of a
//! damaged entry is computed again.
//!
//! Without a work folder nothing is stored, and every call computes its result.

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
use crate::cache::shard::MAX_SHARDS;
pub use crate::cache::shard::{Completion, Shard};
use crate::error::{Error, Result};
use crate::model::format_ranges;
pub use folder::{StoredResult, format_list, list_results, remove_entries};
pub use key::CacheKey;
pub use spill::{Spill, SpillWriter};

/// Request for a cache: the path of the work folder, and the shard (part of a divided stage) to which the run is
/// limited, if any.
#[derive(Debug, Clone)]
pub struct CacheRequest {
    /// Path of the work folder.
    pub folder: PathBuf,
    /// Shard (part of a divided stage) to which the run is limited. The run computes this shard of the next stage that
    /// can be divided, then ends. `None`: the run computes everything.
    pub shard: Option<Shard>,
}

/// Cache of stage results in a work folder. Without a work folder, nothing is stored. Also holds the shard (part of a
/// divided stage) to which this run is limited, if any.
#[derive(Debug, Default)]
pub struct Cache {
    dir: Option<CacheDir>,
    shard: Option<Shard>,
    /// Cache key made from the ids of Gaussians that are excluded from the input; `None`: none are excluded.
    excluded_ids_key: Mutex<Option<CacheKey>>,
    notes: Mutex<Vec<String>>,
}

impl Cache {
    /// Returns a cache that stores nothing.
    pub fn disabled() -> Cache {
        Cache::default()
    }

    /// Opens the cache in the work folder of `request`, which is created if it does not exist. `about` describes the
    /// input for people; it is stored in every entry.
    ///
    /// # Errors
    /// Fails if the folder cannot be created or the path is not a folder.
    pub fn open(request: &CacheRequest, about: String) -> Result<Cache> {
        Ok(Cache {
            dir: Some(CacheDir::open_or_create(&request.folder, about)?),
            shard: request.shard,
            ..Cache::default()
        })
    }

    /// Makes the keys of all entries that are read or written from now on depend on `context` too. `context` is the key
    /// of something that all these results depend on, such as the input or the views.
    pub fn depend_on(&mut self, context: CacheKey) {
        if let Some(dir) = &mut self.dir {
            dir.depend_on(context);
        }
    }

    /// Returns whether results are stored, that is, whether there is a work folder.
    pub fn is_enabled(&self) -> bool {
        self.dir.is_some()
    }

    /// Makes all cache keys that [`Cache::key`] returns from now on depend on `ids`, the Gaussians that are excluded
    /// from the input. An empty list has no effect on the keys.
    pub fn set_excluded_ids(&self, ids: &[u32]) {
        *self.excluded_ids_key.lock().unwrap_or_else(PoisonError::into_inner) =
            (self.is_enabled() && !ids.is_empty()).then(|| CacheKey::new(&ids));
    }

    /// Returns the cache key of `value`: a digest of its bits and of the ids set by [`Cache::set_excluded_ids`].
    /// Without a work folder returns [`CacheKey::NONE`] and does not hash.
    pub fn key(&self, value: &impl Serialize) -> CacheKey {
        let excluded_ids_key = *self.excluded_ids_key.lock().unwrap_or_else(PoisonError::into_inner);
        match (self.is_enabled(), excluded_ids_key) {
            (false, _) => CacheKey::NONE,
            (true, None) => CacheKey::new(value),
            (true, Some(excluded_ids_key)) => CacheKey::new(value).extended_by(&excluded_ids_key),
        }
    }

    /// Returns the notes about the cache, for the user, that were added since the last call.
    pub fn take_notes(&self) -> Vec<String> {
        std::mem::take(&mut self.notes.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn add_note(&self, note: String) {
        self.notes.lock().unwrap_or_else(PoisonError::into_inner).push(note);
    }

    /// Returns the stored result of `stage` for `key`; `None` if there is none.
    ///
    /// # Errors
    /// Fails if the folder cannot be read. A damaged entry counts as missing and causes a note.
    pub fn load<T: DeserializeOwned>(&self, stage: &str, key: CacheKey) -> Result<Option<T>> {
        self.read_shard(stage, key, Shard::WHOLE)
    }

    /// Stores the result `value` of `stage` for `key`.
    ///
    /// # Errors
    /// Fails if the folder cannot be written.
    pub fn store<T: Serialize>(&self, stage: &str, key: CacheKey, value: &T) -> Result<()> {
        self.write_shard(stage, key, Shard::WHOLE, value)
    }

    /// Returns the result of `stage` for `key` if it is stored. If it is not, computes it with `compute` and stores it.
    ///
    /// Use this method for stages that are not divided into shards (parts). A run that is limited to one shard computes
    /// the whole stage, too. If such a run must end before this stage, let `compute` begin with a call of
    /// [`Cache::end_shard_run_before`].
    ///
    /// # Errors
    /// Fails if `compute` fails or the folder cannot be read or written.
    pub fn get_or_compute<T: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        key: CacheKey,
        compute: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        if let Some(found) = self.load(stage, key)? {
            return Ok(found);
        }
        let found = compute()?;
        self.store(stage, key, &found)?;
        Ok(found)
    }

    /// Ends a run that is limited to one shard (part of a divided stage), by returning an error; does nothing in any
    /// other run. Call this method before `stage`, a stage that cannot be divided and so has no shard that such a run
    /// could compute.
    ///
    /// # Errors
    /// Fails with [`Error::ShardDone`] if the run is limited to one shard.
    pub fn end_shard_run_before(&self, stage: &str) -> Result<()> {
        match self.shard {
            None => Ok(()),
            Some(part) => Err(Error::ShardDone(format!(
                "part {part}: nothing left to do; the next stage, {stage}, is not divided: run without --shard"
            ))),
        }
    }

    /// Returns the result of `stage` for `key`. The work of the stage consists of `units` units, such as views. It is
    /// divided into shards, each a range of consecutive units, some of which other runs may have computed and stored.
    /// `compute` returns the result of a range; `join` combines the results of all ranges, in order. The combined
    /// result must not depend on how the units are divided.
    ///
    /// # Errors
    /// Fails if `compute` or `join` fails or the folder cannot be used. A run that is limited to one shard ends with
    /// [`Error::ShardDone`] once this shard is stored.
    pub fn compute_in_shards<T: Serialize + DeserializeOwned, U: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        key: CacheKey,
        units: usize,
        compute: impl Fn(Range<usize>) -> Result<T>,
        join: impl FnOnce(&mut dyn Iterator<Item = Result<T>>) -> Result<U>,
    ) -> Result<U> {
        if let Some(whole) = self.load(stage, key)? {
            return Ok(whole);
        }
        let find = |part| self.read_shard(stage, key, part);
        let make = |part: Shard| -> Result<T> {
            let found = compute(part.unit_range(units))?;
            self.write_shard(stage, key, part, &found)?;
            Ok(found)
        };
        let count = self.resolve_shard_count(stage, key, &find, &make)?;
        let whole = match count {
            1 => join(&mut std::iter::once_with(|| compute(0..units)))?,
            _ => join(&mut Shard::all(count).map(|part| find(part)?.map_or_else(|| make(part), Ok)))?,
        };
        self.store(stage, key, &whole)?;
        self.complete(stage, whole)
    }

    /// Computes the result of `stage` for `key` in shards (ranges of its `units` units of work), but leaves it on disk.
    /// Returns for each shard the range of its units, and a [`Spill`] from which its result can be read. `write`
    /// computes the result of a range and writes it to the given writer. Without a work folder, the result goes to a
    /// scratch file in the folder `scratch`.
    ///
    /// # Errors
    /// Fails where [`Cache::compute_in_shards`] fails.
    pub fn spill_in_shards(
        &self,
        stage: &str,
        key: CacheKey,
        units: usize,
        scratch: &Path,
        write: impl Fn(Range<usize>, &mut SpillWriter) -> Result<()>,
    ) -> Result<Vec<(Range<usize>, Spill)>> {
        let find = |part| match &self.dir {
            None => Ok(None),
            Some(dir) => dir.open(&EntryName::new(stage, dir.key(key), part), |note| self.add_note(note)),
        };
        let make = |part: Shard| -> Result<Spill> {
            let mut spilling = match &self.dir {
                None => SpillWriter::new(scratch)?,
                Some(dir) => dir.begin_entry(&EntryName::new(stage, dir.key(key), part))?,
            };
            write(part.unit_range(units), &mut spilling)?;
            spilling.finish()
        };
        if let Some(whole) = find(Shard::WHOLE)? {
            return Ok(vec![(0..units, whole)]);
        }
        let count = self.resolve_shard_count(stage, key, &find, &make)?;
        let spill = |part: Shard| Ok((part.unit_range(units), find(part)?.map_or_else(|| make(part), Ok)?));
        let spills = Shard::all(count).map(spill).collect::<Result<_>>()?;
        self.complete(stage, spills)
    }

    /// Returns `whole`, the full result of `stage`. Only in a run that is limited to shard 1 of 1 (the whole stage as a
    /// single part), fails with [`Error::ShardDone`] instead: such a run ends when this stage is done.
    fn complete<T>(&self, stage: &str, whole: T) -> Result<T> {
        match self.shard {
            Some(Shard::WHOLE) => {
                Err(Error::ShardDone(format!("{stage}: part {} is done; it is the whole stage", Shard::WHOLE)))
            }
            _ => Ok(whole),
        }
    }

    /// Returns the number of shards (parts) that the caller must join to get the result of `stage`; 1: the stage is not
    /// divided. The caller computes the shards that are not stored yet. Call this method only if the full result of
    /// `stage` is not stored.
    ///
    /// The cache may hold shards from runs that divided the stage into different numbers of shards. The first case that
    /// applies decides:
    /// - There is no cache folder: returns 1.
    /// - All m shards of some division are stored: returns m.
    /// - The run has no option `--shard`: returns the number of shards of the division of which the largest fraction is
    ///   stored, or 1 if no shard is stored.
    /// - `--shard 1/1`: returns 1.
    /// - `--shard i/n` with n > 1: if `find` does not find the stored shard i, `make` computes and stores it. Then the
    ///   method fails with [`Error::ShardDone`], which ends the run as intended and reports the missing shards.
    fn resolve_shard_count<T>(
        &self,
        stage: &str,
        key: CacheKey,
        find: &dyn Fn(Shard) -> Result<Option<T>>,
        make: &dyn Fn(Shard) -> Result<T>,
    ) -> Result<usize> {
        let Some(dir) = &self.dir else { return Ok(1) };
        // Indices of the stored shards, by the number of shards.
        let stored = dir.stored_shards(stage, key)?;
        if let Some((&count, _)) = stored.iter().find(|(count, parts)| parts.len() == **count) {
            return Ok(count);
        }
        let Some(part) = self.shard else {
            let Some((&count, parts)) = stored.iter().max_by_key(|(count, parts)| parts.len() * MAX_SHARDS / **count)
            else {
                self.note_unusable_shards(dir, stage, key)?;
                return Ok(1);
            };
            self.add_note(format!(
                "{stage}: of {count} parts these are missing and computed here: {}",
                missing(parts, count)
            ));
            return Ok(count);
        };
        let (_, count) = part.numbers();
        if count == 1 {
            return Ok(1);
        }
        // A file with the name of this shard may be damaged, so its content is read.
        let done = match find(part)? {
            Some(_) => "is there already",
            None => {
                make(part)?;
                "is done"
            }
        };
        if stored.is_empty() {
            self.note_unusable_shards(dir, stage, key)?;
        }
        let stored = dir.stored_shards(stage, key)?.remove(&count).unwrap_or_default();
        let mut report = match stored.len() == count {
            true => format!("{stage}: part {part} {done}; all parts are there"),
            false => format!("{stage}: part {part} {done}; missing: {}", missing(&stored, count)),
        };
        self.take_notes().iter().for_each(|note| report += &format!("\n  note: {note}"));
        Err(Error::ShardDone(report))
    }

    /// Adds a note for the user if the folder `dir` holds shards (parts of a divided stage) of `stage` that have
    /// another key than `key`, because they belong to another input or recipe.
    fn note_unusable_shards(&self, dir: &CacheDir, stage: &str, key: CacheKey) -> Result<()> {
        for other in dir.foreign_inputs(stage, key)? {
            self.add_note(format!(
                "{stage}: parts in the work folder are not used because they come from another input, recipe, \
                 program version or kind of processor; they belong to {other}"
            ));
        }
        Ok(())
    }

    fn read_shard<T: DeserializeOwned>(&self, stage: &str, key: CacheKey, part: Shard) -> Result<Option<T>> {
        let Some(dir) = &self.dir else { return Ok(None) };
        dir.read(&EntryName::new(stage, dir.key(key), part), |note| self.add_note(note))
    }

    fn write_shard<T: Serialize>(&self, stage: &str, key: CacheKey, part: Shard, value: &T) -> Result<()> {
        let Some(dir) = &self.dir else { return Ok(()) };
        dir.write(&EntryName::new(stage, dir.key(key), part), value)
    }
}

/// Returns the indices (1 to `count`) of the shards (parts of a divided stage) that are not in `stored`, as text such
/// as `3, 10-20`.
fn missing(stored: &BTreeSet<usize>, count: usize) -> String {
    format_ranges(&(1..=count).filter(|index| !stored.contains(index)).collect::<Vec<_>>()).join(", ")
}

#[cfg(test)]
mod tests;
