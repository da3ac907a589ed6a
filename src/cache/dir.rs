//! Work folder with the files of cache entries (stored results of stages).

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::key::CacheKey;
use super::spill::{Spill, SpillWriter};
use crate::cache::entry::{CacheEntry, EXTENSION, EntryName, names};
use crate::cache::shard::MAX_SHARDS;
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::remove_leftovers;

/// Open work folder, in which cache entries (stored results of stages) are read and written.
#[derive(Debug)]
pub(super) struct CacheDir {
    folder: PathBuf,
    /// Digest of everything that all results of this run depend on, such as the input. The key of every cache entry
    /// includes this digest.
    context: CacheKey,
    /// Description of the input for people, stored in every new entry.
    about: String,
}

impl CacheDir {
    /// Opens the work folder `folder`; creates it if it does not exist. `about` describes the input for people; it is
    /// stored in every new entry. Fails if the path is not a folder or cannot be created.
    pub(super) fn open_or_create(folder: &Path, about: String) -> Result<CacheDir> {
        match fs::create_dir(folder) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                Err(Error::io("create the cache folder", folder)(error))
            }
            _ if !folder.is_dir() => Err(Error::usage(format!("{}: expected a folder, found a file", folder.shown()))),
            _ => {
                remove_leftovers(folder, EXTENSION);
                Ok(CacheDir { folder: folder.to_owned(), context: CacheKey::new(&()), about })
            }
        }
    }

    /// Makes the keys of all entries that are read or written from now on depend on `context` too. `context` is the key
    /// of something that all these results depend on, such as the input or the views.
    pub(super) fn depend_on(&mut self, context: CacheKey) {
        self.context = self.context.extended_by(&context);
    }

    /// Returns the key of a cache entry: `key` combined with the context ([`CacheDir::depend_on`]).
    pub(super) fn key(&self, key: CacheKey) -> CacheKey {
        self.context.extended_by(&key)
    }

    /// Returns the indices of the stored shards (parts of a divided stage) of `stage` with the key `key`, grouped by
    /// the number of shards into which the stage was divided.
    pub(super) fn stored_shards(&self, stage: &str, key: CacheKey) -> Result<BTreeMap<usize, BTreeSet<usize>>> {
        let key = self.key(key).text();
        let mut found: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
        for name in names(&self.folder)? {
            let (index, of) = name.part;
            if name.stage == stage && name.key == key && (1..=of).contains(&index) && (2..=MAX_SHARDS).contains(&of) {
                found.entry(of).or_default().insert(index);
            }
        }
        Ok(found)
    }

    /// Finds the stored shards (parts of a divided stage) of `stage` whose key is not `key`. Returns the descriptions
    /// of the inputs to which they belong.
    pub(super) fn foreign_inputs(&self, stage: &str, key: CacheKey) -> Result<BTreeSet<String>> {
        let key = self.key(key).text();
        let is_foreign = |name: &EntryName| name.stage == stage && name.key != key && name.part.1 > 1;
        let mut found = BTreeMap::new();
        for name in names(&self.folder)?.into_iter().filter(is_foreign) {
            // Opening one shard per key is enough. The input of a damaged shard is unknown.
            if let Entry::Vacant(new) = found.entry(name.key.clone()) {
                let entry = CacheEntry::open(&self.folder.join(name.file()), &name.key)?;
                new.insert(entry.map_or_else(|_| "an unknown input".to_owned(), |entry| entry.about().to_owned()));
            }
        }
        Ok(found.into_values().collect())
    }

    /// Reads the value of the cache entry `name`; `None` if it is missing or damaged. Calls `damaged` with a message
    /// about a damaged entry.
    pub(super) fn read<T: DeserializeOwned>(&self, name: &EntryName, damaged: impl Fn(String)) -> Result<Option<T>> {
        let Some(entry) = self.open_entry(name, &damaged)? else { return Ok(None) };
        let found = entry.value();
        let wrong = |error| damaged(format!("{} has unexpected contents ({error}): computed again", name.file()));
        Ok(found.map_err(wrong).ok())
    }

    /// Returns the content of the cache entry `name` as a [`Spill`] (data on disk that can be read in any order).
    /// Returns `None` if the entry is missing or damaged. Calls `damaged` with a message about a damaged entry.
    pub(super) fn open(&self, name: &EntryName, damaged: impl Fn(String)) -> Result<Option<Spill>> {
        let at = self.folder.join(name.file());
        let spill = |entry: CacheEntry| {
            let (file, start) = entry.into_file();
            Spill::from_file(file, start, at)
        };
        Ok(self.open_entry(name, &damaged)?.map(spill))
    }

    fn open_entry(&self, name: &EntryName, damaged: &impl Fn(String)) -> Result<Option<CacheEntry>> {
        let path = self.folder.join(name.file());
        if !path.exists() {
            return self.check_exists().map(|()| None);
        }
        match CacheEntry::open(&path, &name.key) {
            Ok(Ok(entry)) => Ok(Some(entry)),
            Ok(Err(why)) => {
                damaged(format!("{} is damaged ({why}): computed again", name.file()));
                Ok(None)
            }
            // Another process removed the file meanwhile.
            Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Checks that the cache folder still exists. A vanished folder is an error, not an empty cache.
    fn check_exists(&self) -> Result<()> {
        fs::metadata(&self.folder).map(|_| ()).map_err(Error::io("find the cache folder", &self.folder))
    }

    /// Writes a cache entry `name` with the value `value`.
    pub(super) fn write<T: Serialize>(&self, name: &EntryName, value: &T) -> Result<()> {
        let mut writer = self.begin_entry(name)?;
        writer.write_value(value)?;
        writer.finish()?;
        Ok(())
    }

    /// Begins a cache entry `name` and returns the writer of its content. Fails if the work folder no longer exists or
    /// cannot be written.
    pub(super) fn begin_entry(&self, name: &EntryName) -> Result<SpillWriter> {
        self.check_exists()?;
        let key = u128::from_str_radix(&name.key, 16).unwrap_or_default();
        SpillWriter::named(&self.folder.join(name.file()), key, &self.about)
    }
}
