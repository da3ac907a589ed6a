//! What everything that stages find in a scene follows from.

use std::fs;
use std::path::Path;
use std::time::UNIX_EPOCH;

use super::Scene;
use super::input::InputOptions;
use crate::TOOL;
use crate::error::{Error, Result};
use crate::render;
use crate::work::{Asked, Key, Work};

/// Under what the digest of an input is kept.
const DIGEST: &str = "input";

impl Scene {
    /// Opens the work folder that `options` name.
    pub(super) fn keep_work(&mut self, options: &InputOptions) -> Result<()> {
        let Some(asked) = &options.work else { return Ok(()) };
        self.work = open_work(asked, options)?;
        let digest = self.work.known(DIGEST, stamp(options)?, || self.input.digest())?;
        self.work.follow_from(self.key(&digest));
        self.digest = Some(digest);
        Ok(())
    }

    /// Digest of the input.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn digest(&self) -> Result<String> {
        self.digest.clone().map_or_else(|| self.input.digest(), Ok)
    }

    /// This program and this machine, the input's content as it was opened, and its cameras; not where anything lies.
    fn key(&self, digest: &str) -> Key {
        let info = self.source().info();
        let shots: Vec<_> = self.rig.shots.iter().map(|of| (of.view, of.camera, of.time, of.split)).collect();
        Key::of(&(TOOL, render::instructions(), digest))
            .and(&(info.count, &info.times, info.sh_degree, info.varying.bits(), self.input.kind()))
            .and(&(&self.rig.cameras, shots, &self.schedule, self.background, self.has_cameras))
    }
}

/// The work folder that is asked for, for an input that can be read again.
fn open_work(asked: &Asked, options: &InputOptions) -> Result<Work> {
    if options.is_stream() {
        return Err(Error::usage(
            "--work: expected an input that can be read again, found a stream on standard input\n  \
             write it to a container first: splatsieve pack - -o NAME.gseq",
        ));
    }
    let path = options.path.display();
    Work::open(asked, format!("{path} ({TOOL}, {})", render::instructions()))
}

/// What says, without reading it, that an input is the one that it was: its path, and of all of its files names, lengths
/// and times of their last change.
fn stamp(options: &InputOptions) -> Result<Key> {
    let path = fs::canonicalize(&options.path).map_err(Error::io("find", &options.path))?;
    let mut files = Vec::new();
    stamps(&path, &mut files)?;
    Ok(Key::of(&(TOOL, path, options.iteration, files)))
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
