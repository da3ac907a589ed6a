//! Work folder with the files of cache entries.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::key::CacheKey;
use super::spill::{Spill, SpillWriter};
use crate::cache::entry::{CacheEntry, ENDING, EntryName, names};
use crate::cache::shard::MOST_PARTS;
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::remove_leftovers;

/// Work folder that is read and written.
#[derive(Debug)]
pub(super) struct CacheDir {
    folder: PathBuf,
    /// Key on which all keys of this run depend.
    context: CacheKey,
    about: String,
}

impl CacheDir {
    /// Opens the work folder `folder`; creates it if it does not exist.
    pub(super) fn at(folder: &Path, about: String) -> Result<CacheDir> {
        match fs::create_dir(folder) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                Err(Error::io("create the work folder", folder)(error))
            }
            _ if !folder.is_dir() => Err(Error::usage(format!("{}: expected a folder, found a file", folder.shown()))),
            _ => {
                remove_leftovers(folder, ENDING);
                Ok(CacheDir { folder: folder.to_owned(), context: CacheKey::new(&()), about })
            }
        }
    }

    /// Makes all further keys also depend on `context`.
    pub(super) fn follow_from(&mut self, context: CacheKey) {
        self.context = self.context.and(&context);
    }

    /// Returns the combination of `key` with the context.
    pub(super) fn key(&self, key: CacheKey) -> CacheKey {
        self.context.and(&key)
    }

    /// Returns the indices of the stored shards of `stage`, by the number of shards.
    pub(super) fn parts(&self, stage: &str, key: CacheKey) -> Result<BTreeMap<usize, BTreeSet<usize>>> {
        let key = self.key(key).text();
        let mut found: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
        for name in names(&self.folder)? {
            let (index, of) = name.part;
            if name.stage == stage && name.key == key && (1..=of).contains(&index) && (2..=MOST_PARTS).contains(&of) {
                found.entry(of).or_default().insert(index);
            }
        }
        Ok(found)
    }

    /// Returns descriptions of the inputs to which stored shards of `stage` with other keys belong.
    pub(super) fn others(&self, stage: &str, key: CacheKey) -> Result<BTreeSet<String>> {
        let key = self.key(key).text();
        let is_other = |name: &EntryName| name.stage == stage && name.key != key && name.part.1 > 1;
        let mut found = BTreeMap::new();
        for name in names(&self.folder)?.into_iter().filter(is_other) {
            // One shard per key is enough. The input of a damaged shard is unknown.
            if let Entry::Vacant(new) = found.entry(name.key.clone()) {
                let piece = CacheEntry::open(&self.folder.join(name.file()), &name.key)?;
                new.insert(piece.map_or_else(|_| "an unknown input".to_owned(), |piece| piece.about().to_owned()));
            }
        }
        Ok(found.into_values().collect())
    }

    /// Reads the value of a cache entry, if it exists. Calls `damaged` with a message for a damaged entry, which counts
    /// as missing.
    pub(super) fn read<T: DeserializeOwned>(&self, name: &EntryName, damaged: impl Fn(String)) -> Result<Option<T>> {
        let Some(piece) = self.open_piece(name, &damaged)? else { return Ok(None) };
        let found = piece.value();
        let wrong = |error| damaged(format!("{} has unexpected contents ({error}): computed again", name.file()));
        Ok(found.map_err(wrong).ok())
    }

    /// Opens the content of a cache entry, if it exists and is undamaged. Calls `damaged` with a message for a damaged
    /// one.
    pub(super) fn open(&self, name: &EntryName, damaged: impl Fn(String)) -> Result<Option<Spill>> {
        let at = self.folder.join(name.file());
        let spill = |piece: CacheEntry| {
            let (file, start) = piece.into_file();
            Spill::from_file(file, start, at)
        };
        Ok(self.open_piece(name, &damaged)?.map(spill))
    }

    fn open_piece(&self, name: &EntryName, damaged: &impl Fn(String)) -> Result<Option<CacheEntry>> {
        let path = self.folder.join(name.file());
        if !path.exists() {
            return self.is_there().map(|()| None);
        }
        match CacheEntry::open(&path, &name.key) {
            Ok(Ok(piece)) => Ok(Some(piece)),
            Ok(Err(why)) => {
                damaged(format!("{} is damaged ({why}): computed again", name.file()));
                Ok(None)
            }
            // Another process removed the file meanwhile.
            Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Checks that the folder still exists: a vanished folder is an error, not an empty cache.
    fn is_there(&self) -> Result<()> {
        fs::metadata(&self.folder).map(|_| ()).map_err(Error::io("find the work folder", &self.folder))
    }

    /// Writes a cache entry with the value `found`.
    pub(super) fn write<T: Serialize>(&self, name: &EntryName, found: &T) -> Result<()> {
        let mut spilling = self.begin(name)?;
        spilling.write_value(found)?;
        spilling.finish()?;
        Ok(())
    }

    /// Begins to write a cache entry.
    pub(super) fn begin(&self, name: &EntryName) -> Result<SpillWriter> {
        self.is_there()?;
        let key = u128::from_str_radix(&name.key, 16).unwrap_or_default();
        SpillWriter::named(&self.folder.join(name.file()), key, &self.about)
    }
}
