//! Opens the cache of a scene's stage results. Provides the digest (hash of the content) of the input, and the keys on
//! which all entries of the cache depend.

use std::fs;
use std::path::Path;

use super::Scene;
use super::input::InputOptions;
use crate::TOOL;
use crate::cache::{Cache, CacheKey};
use crate::error::{Error, Result, ShowPath};
use crate::models::InputModel;
use crate::render;

/// Name of the cache entry that holds the digest (hash of the content) of an input.
const DIGEST: &str = "input";

impl Scene {
    /// Opens the cache folder that `options` name, and makes the keys of its entries depend on this scene.
    pub(super) fn open_cache(&mut self, options: &InputOptions) -> Result<()> {
        (self.work, self.digest) = open_cache(options, &*self.input)?;
        if self.work.is_enabled() {
            self.work.depend_on(self.key());
        }
        Ok(())
    }

    /// Makes the keys of cache entries depend on the views of the schedule and on the weight of the quality outside the
    /// rig ([`Scene::outside`]), after one of them has changed.
    pub(super) fn depend_on_views(&mut self) {
        self.work.depend_on(CacheKey::new(&(&self.schedule, self.outside)));
    }

    /// Returns the digest (hash of the content) of the input.
    pub fn digest(&self) -> Result<String> {
        self.digest.clone().map_or_else(|| self.input.digest(), Ok)
    }

    /// Returns the digest (hash of the content) of another input, which was opened with `options`. The digest is also
    /// stored in the cache of this scene.
    ///
    /// # Errors
    /// Fails if a file or the cache folder cannot be read.
    pub fn input_digest(&self, options: &InputOptions, input: &dyn InputModel) -> Result<String> {
        cached_digest(&self.work, options, input)
    }

    /// Returns the cache key that stands for the cameras, their views at each frame, and the background.
    fn key(&self) -> CacheKey {
        let rig_views: Vec<_> = self
            .rig
            .views
            .iter()
            .map(|rig_view| (rig_view.view, rig_view.camera, rig_view.time, rig_view.split))
            .collect();
        CacheKey::new(&(&self.rig.cameras, rig_views, &self.schedule, self.background, self.has_cameras))
    }
}

/// Opens the cache folder that `options` name. Returns it with the digest (hash of the content) of `input`, on which
/// the keys of all entries depend. If `options` name no folder, returns a cache that stores nothing, and no digest.
///
/// # Errors
/// Fails if a file or the cache folder cannot be read.
pub fn open_cache(options: &InputOptions, input: &dyn InputModel) -> Result<(Cache, Option<String>)> {
    let Some(asked) = &options.work else { return Ok((Cache::disabled(), None)) };
    // The C library's mathematical functions differ in the last bits.
    let libc = if cfg!(target_env = "musl") { ", musl" } else { "" };
    let instructions = format!("{}{libc}", render::instruction_set());
    let mut work = Cache::open(asked, format!("{} ({TOOL}, {instructions})", options.path.shown()))?;
    let digest = cached_digest(&work, options, input)?;
    // The key stands for this program, the machine's instruction set, and the content of the input as it was opened;
    // not for its path.
    let info = input.source().info();
    work.depend_on(CacheKey::new(&(TOOL, &instructions, &digest)).extended_by(&(
        info.count,
        &info.times,
        info.sh_degree,
        info.varying.bits(),
        input.description().kind,
    )));
    Ok((work, Some(digest)))
}

/// Returns the digest (hash of the content) of `input`. Reads the input only if its files may have changed since the
/// digest was cached.
fn cached_digest(work: &Cache, options: &InputOptions, input: &dyn InputModel) -> Result<String> {
    match work.is_enabled() {
        true => work.get_or_compute(DIGEST, input_stamp(options)?, || input.digest()),
        false => input.digest(),
    }
}

/// Returns a key that changes whenever the content of the input may have changed, without reading the input. It stands
/// for the path of the input, for the options with which it is read, and for the path, length and change time of each of
/// its files.
fn input_stamp(options: &InputOptions) -> Result<CacheKey> {
    let path = fs::canonicalize(&options.path).map_err(Error::io("find", &options.path))?;
    let mut files = Vec::new();
    add_file_stamps(&path, &mut files)?;
    Ok(CacheKey::new(&(TOOL, path, options.iteration, options.conventions, options.link, files)))
}

/// Appends the path, the length in bytes, and the change time ([`splat_platform::change_time`]) of the file `path` to
/// `files`. If `path` is a folder, appends them for all files in it and in its subfolders, in the order of their paths.
pub(crate) fn add_file_stamps(path: &Path, files: &mut Vec<(String, u64, i128)>) -> Result<()> {
    let name = path.to_string_lossy().into_owned();
    // Broken links are not part of an input, so only their paths are recorded.
    let Ok(metadata) = fs::metadata(path) else {
        files.push((name, 0, 0));
        return Ok(());
    };
    if metadata.is_dir() {
        let failed = |error| Error::io("read the folder", path)(error);
        let mut entries = Vec::new();
        for entry in fs::read_dir(path).map_err(failed)? {
            entries.push(entry.map_err(failed)?.path());
        }
        entries.sort();
        return entries.iter().try_for_each(|entry| add_file_stamps(entry, files));
    }
    files.push((name, metadata.len(), splat_platform::change_time(&metadata)));
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    #[test]
    fn a_file_with_other_content_of_equal_length_and_time_has_another_stamp() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path().join("model");
        let written = |content: &str| {
            fs::write(&path, content).unwrap();
            File::options().write(true).open(&path).unwrap().set_modified(std::time::UNIX_EPOCH).unwrap();
            let mut files = Vec::new();
            add_file_stamps(&path, &mut files).unwrap();
            files
        };
        let (first, mut again) = (written("1"), Vec::new());
        add_file_stamps(&path, &mut again).unwrap();
        assert_eq!(first, again);
        // Change times are as coarse as the clock of the file system.
        std::thread::sleep(std::time::Duration::from_millis(50));
        assert_ne!(first, written("2"));
    }
}
