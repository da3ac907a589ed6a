//! What everything that stages find in a scene follows from.

use std::fs;
use std::path::Path;
use std::time::UNIX_EPOCH;

use super::Scene;
use super::input::InputOptions;
use crate::TOOL;
use crate::cache::{Cache, CacheKey};
use crate::error::{Error, Result, ShowPath};
use crate::models::InputModel;
use crate::render;

/// Under what the digest of an input is kept.
const DIGEST: &str = "input";

impl Scene {
    /// Opens the work folder that `options` name.
    pub(super) fn keep_work(&mut self, options: &InputOptions) -> Result<()> {
        (self.work, self.digest) = kept_work(options, &*self.input)?;
        if self.work.keeps() {
            self.work.follow_from(self.key());
        }
        Ok(())
    }

    /// Digest of the input.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn digest(&self) -> Result<String> {
        self.digest.clone().map_or_else(|| self.input.digest(), Ok)
    }

    /// Digest of another input, opened as `options` say, which is kept, too.
    ///
    /// # Errors
    /// A file that cannot be read, and those of the work folder.
    pub fn digest_of(&self, options: &InputOptions, input: &dyn InputModel) -> Result<String> {
        known_digest(&self.work, options, input)
    }

    /// From where the input is looked at.
    fn key(&self) -> CacheKey {
        let shots: Vec<_> = self.rig.shots.iter().map(|of| (of.view, of.camera, of.time, of.split)).collect();
        CacheKey::new(&(&self.rig.cameras, shots, &self.schedule, self.background, self.has_cameras))
    }
}

/// The work folder that `options` name, and the digest of `input`, from which all in it follows; without a folder neither.
///
/// # Errors
/// A file that cannot be read, and those of the work folder.
pub fn kept_work(options: &InputOptions, input: &dyn InputModel) -> Result<(Cache, Option<String>)> {
    let Some(asked) = &options.work else { return Ok((Cache::none(), None)) };
    let instructions = render::instructions();
    let mut work = Cache::open(asked, format!("{} ({TOOL}, {instructions})", options.path.shown()))?;
    let digest = known_digest(&work, options, input)?;
    // This program and this machine, the input's content as it was opened; not where it lies.
    let info = input.source().info();
    work.follow_from(CacheKey::new(&(TOOL, instructions, &digest)).and(&(
        info.count,
        &info.times,
        info.sh_degree,
        info.varying.bits(),
        input.kind(),
    )));
    Ok((work, Some(digest)))
}

/// Digest of `input`, which is read for it only if it may have changed since.
fn known_digest(work: &Cache, options: &InputOptions, input: &dyn InputModel) -> Result<String> {
    match work.keeps() {
        true => work.known(DIGEST, stamp(options)?, || input.digest()),
        false => input.digest(),
    }
}

/// What says, without reading it, that an input is the one that it was: its path, and of all of its files names, lengths
/// and times of their last change.
fn stamp(options: &InputOptions) -> Result<CacheKey> {
    let path = fs::canonicalize(&options.path).map_err(Error::io("find", &options.path))?;
    let mut files = Vec::new();
    stamps(&path, &mut files)?;
    Ok(CacheKey::new(&(TOOL, path, options.iteration, options.conventions, options.link, files)))
}

/// Of every file at `path` and below, in order: name, length, and when it was last changed, ns.
pub(crate) fn stamps(path: &Path, files: &mut Vec<(String, u64, u128)>) -> Result<()> {
    let name = path.to_string_lossy().into_owned();
    // Links that lead nowhere are no part of an input either.
    let Ok(found) = fs::metadata(path) else {
        files.push((name, 0, 0));
        return Ok(());
    };
    if found.is_dir() {
        let failed = |error| Error::io("read the folder", path)(error);
        let mut entries = Vec::new();
        for entry in fs::read_dir(path).map_err(failed)? {
            entries.push(entry.map_err(failed)?.path());
        }
        entries.sort();
        return entries.iter().try_for_each(|entry| stamps(entry, files));
    }
    let changed = found.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    files.push((name, found.len(), changed.map_or(0, |since| since.as_nanos())));
    Ok(())
}
