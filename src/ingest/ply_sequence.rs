//! A dynamic scene as one PLY file per frame.
//!
//! In: a folder of PLY files (or a single one) with the same Gaussians in the same order. Out: a
//! [`FrameSource`]. Memory: the path of every frame; a frame's file is mapped only while it is read,
//! so thousands of frames need neither thousands of maps nor of file descriptors. A text frame is
//! parsed whole for every block: pack such a sequence first.

use std::cmp::Ordering;
use std::ffi::OsStr;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::digest::hash_file;
use super::ply::{Ply, Property, check_ids};
use crate::error::{Error, Result, quoted};
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::source::{BlockReader, Count, FrameSource, Ids, Reads};

/// A sequence of PLY files.
#[derive(Debug)]
pub struct PlySequence {
    frames: Vec<PathBuf>,
    properties: Vec<Property>,
    info: SequenceInfo,
    bytes: Count,
    states: Count,
}

impl PlySequence {
    /// All `.ply` files of `folder` but the hidden ones, in natural order (`frame_2` before `frame_10`).
    /// Frame i of T has time i / T; all columns vary when T > 1.
    ///
    /// # Errors
    /// A gap in the frames' numbers, or an entry called like a frame that is no file; a folder without PLY files; a file [`Ply::open`] refuses; frames that differ in their number of
    /// Gaussians or in their properties.
    pub fn open(folder: &Path) -> Result<PlySequence> {
        let (frames, others) = frames_of(folder)?;
        if let Some(other) = others.first() {
            let found = if other.is_dir() { "a folder" } else { "a link to nothing" };
            return Err(Error::input(other, "", "a PLY file, as its name says", found).hint(ALLOW_GAPS));
        }
        if let Some((missing, before, after)) = first_gap(&frames) {
            let found = format!("{before}, then {after}");
            return Err(Error::input(folder, "", format!("a frame {missing}"), found).hint(ALLOW_GAPS));
        }
        Self::of(folder, frames)
    }

    /// [`PlySequence::open`] of the files that are there, whatever is missing between them.
    ///
    /// # Errors
    /// Those of [`PlySequence::open`] but gaps.
    pub fn open_with_gaps(folder: &Path) -> Result<PlySequence> {
        Self::of(folder, frames_of(folder)?.0)
    }

    /// One PLY file as a sequence of one frame, in which nothing varies.
    pub fn single(path: &Path) -> Result<PlySequence> {
        Self::of(path, vec![path.to_owned()])
    }

    fn of(origin: &Path, frames: Vec<PathBuf>) -> Result<PlySequence> {
        let Some((first_path, others)) = frames.split_first() else {
            return Err(Error::input(origin, "", "a folder with one .ply file per frame", "no .ply file in it"));
        };
        let first = Ply::open(first_path)?;
        for path in others {
            check_agrees(&Ply::open(path)?, first.properties(), first.count(), first_path)?;
        }
        let info = SequenceInfo {
            count: first.count(),
            times: (0..frames.len()).map(|i| i as f64 / frames.len() as f64).collect(),
            sh_degree: first.sh_degree(),
            varying: if others.is_empty() { Columns::empty() } else { Columns::all() },
        };
        let (bytes, states) = (Count::default(), Count::default());
        Ok(PlySequence { properties: first.properties().to_vec(), frames, info, bytes, states })
    }

    /// The same frames at other times, one per frame.
    ///
    /// # Errors
    /// A number of times other than T; times that are not finite or not strictly increasing, naming the
    /// frames.
    pub fn with_times(mut self, times: Vec<f64>) -> Result<PlySequence> {
        if times.len() != self.frames.len() {
            return Err(Error::usage(format!("{} times were given for {} frames", times.len(), self.frames.len())));
        }
        if let Some(i) = times.iter().position(|time| !time.is_finite()) {
            return Err(Error::usage(format!("the time of frame {i} is {}, which is no time", times[i])));
        }
        if let Some(i) = (1..times.len()).find(|&i| times[i] <= times[i - 1]) {
            let (before, after) = (times[i - 1], times[i]);
            return Err(Error::usage(format!(
                "times must increase: frame {} has {before}, frame {i} has {after}",
                i - 1
            )));
        }
        self.info.times = times;
        Ok(self)
    }

    /// The files, in frame order.
    pub fn paths(&self) -> &[PathBuf] {
        &self.frames
    }

    /// The file of one frame, open.
    ///
    /// # Errors
    /// A frame beyond the last; a file that no longer is what it was when the sequence was opened.
    pub fn frame(&self, frame: usize) -> Result<Ply> {
        let Some(path) = self.frames.get(frame) else {
            return Err(Error::usage(format!("frame {frame} was asked for, of {} counted from 0", self.frames.len())));
        };
        let ply = Ply::open(path)?;
        check_agrees(&ply, &self.properties, self.info.count, &self.frames[0])?;
        Ok(ply)
    }

    /// XXH3-128 over names and bytes of all files in frame order, as 32 hexadecimal digits. Reads
    /// everything once. Folders do not enter it: a sequence that was moved keeps its digest.
    pub fn digest(&self) -> Result<String> {
        let mut hash = Xxh3::new();
        for path in &self.frames {
            // Lengths in front, so that no byte can pass from a name to a content or between files.
            let name = file_name(path).as_encoded_bytes();
            hash.update(&(name.len() as u64).to_le_bytes());
            hash.update(name);
            let length = fs::metadata(path).map_err(Error::io("read the size of", path))?.len();
            hash.update(&length.to_le_bytes());
            hash_file(path, &mut hash)?;
        }
        Ok(format!("{:032x}", hash.digest128()))
    }
}

impl FrameSource for PlySequence {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        check_ids(&self.frames[0], &ids, self.info.count)?;
        Ok(Box::new(PlyBlock { sequence: self, ids: OwnedIds::of(ids) }))
    }

    fn reads(&self) -> Reads {
        Reads { bytes: self.bytes.get(), states: self.states.get(), ..Reads::default() }
    }
}

/// Some Gaussians of a sequence of PLY files.
struct PlyBlock<'a> {
    sequence: &'a PlySequence,
    ids: OwnedIds,
}

impl BlockReader for PlyBlock<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        let (ply, ids) = (self.sequence.frame(frame)?, self.ids.borrow());
        self.sequence.bytes.add(ply.bytes_of(ids.len()));
        self.sequence.states.add(ids.len() as u64);
        ply.gather(&ids, want, out)
    }
}

/// [`Ids`] that outlive the call they came with.
enum OwnedIds {
    Range(Range<usize>),
    List(Vec<u32>),
}

impl OwnedIds {
    fn of(ids: Ids<'_>) -> OwnedIds {
        match ids {
            Ids::Range(range) => OwnedIds::Range(range),
            Ids::List(list) => OwnedIds::List(list.to_vec()),
        }
    }

    fn borrow(&self) -> Ids<'_> {
        match self {
            OwnedIds::Range(range) => Ids::Range(range.clone()),
            OwnedIds::List(list) => Ids::List(list),
        }
    }
}

fn file_name(path: &Path) -> &OsStr {
    path.file_name().unwrap_or_default()
}

/// What a sequence that is refused can be read with all the same.
const ALLOW_GAPS: &str = "--allow-gaps takes the frames that are there as the whole sequence";

/// The files of a folder's frames in natural order, and what is called like one and is no file.
fn frames_of(folder: &Path) -> Result<(Vec<PathBuf>, Vec<PathBuf>)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let path = entry.map_err(Error::io("list", folder))?.path();
        if is_called_frame(&path) {
            found.push(path);
        }
    }
    found.sort_by(|a, b| natural_order(file_name(a), file_name(b)));
    Ok(found.into_iter().partition(|path| path.is_file()))
}

/// The name of the first frame that is missing, with its neighbours', where names differ in one number alone: of those
/// that follow each other by the least step it is the one that would be next.
fn first_gap(frames: &[PathBuf]) -> Option<(String, String, String)> {
    let parts = |path: &PathBuf| -> Option<(String, u64, String, usize)> {
        let name = file_name(path).to_str()?;
        let stem = name.rsplit_once('.')?.0;
        let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
        let start = stem[..end].trim_end_matches(|c: char| c.is_ascii_digit()).len();
        Some((name[..start].to_owned(), name[start..end].parse().ok()?, name[end..].to_owned(), end - start))
    };
    let named: Vec<_> = frames.iter().map(parts).collect::<Option<_>>()?;
    let (before, _, after, _) = named.first()?;
    if named.iter().any(|(b, _, a, _)| (b, a) != (before, after)) {
        return None;
    }
    let steps: Vec<u64> = named.windows(2).map(|pair| pair[1].1.saturating_sub(pair[0].1)).collect();
    let least = steps.iter().copied().min().filter(|&least| least > 0)?;
    let at = steps.iter().position(|&step| step != least)?;
    let width = named[at].3;
    let missing = format!("{before}{:0width$}{after}", named[at].1 + least);
    let name = |at: usize| file_name(&frames[at]).display().to_string();
    Some((missing, name(at), name(at + 1)))
}

/// Hidden files are left out: a file manager's `._frame_1.ply` is no frame.
fn is_called_frame(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("ply"))
        && !file_name(path).as_encoded_bytes().starts_with(b".")
}

/// Numbers by value, then bytes: names equal to the natural comparison (`a 1`, `a1`) have an order too.
fn natural_order(a: &OsStr, b: &OsStr) -> Ordering {
    natord::compare(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b))
}

fn check_agrees(ply: &Ply, properties: &[Property], count: usize, first: &Path) -> Result<()> {
    let first = first.display();
    if ply.count() != count {
        let expected = format!("{count} Gaussians, as in {first}");
        return Err(Error::input(ply.path(), "element vertex", expected, format!("{} Gaussians", ply.count()))
            .hint("every frame must hold the same Gaussians in the same order"));
    }
    if ply.properties() != properties {
        let differing = (0..).find(|&i| ply.properties().get(i) != properties.get(i)).unwrap_or(0);
        let name = |list: &[Property]| match list.get(differing) {
            Some(property) => format!("{} {}", property.scalar.name(), quoted(&property.name)),
            None => "no property".to_owned(),
        };
        let expected = format!("{} in place {differing} of {}, as in {first}", name(properties), properties.len());
        let found = format!("{} of {}", name(ply.properties()), ply.properties().len());
        return Err(Error::input(ply.path(), "element vertex", expected, found)
            .hint("every frame must have the same properties in the same order"));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
