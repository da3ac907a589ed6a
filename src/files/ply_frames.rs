//! Files of frames: which they are, and what all of them have in common.
//!
//! In: a folder with one PLY file per frame, or a single file. Out: their paths in order, the number of Gaussians in each,
//! and each open when it is asked for. Memory: path and number of every frame; a frame's file is mapped only while it is
//! read, so thousands of frames need neither thousands of maps nor of file descriptors. Text files are converted once, when
//! they are opened, into one scratch file.

use std::cmp::Ordering;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::digest::hash_file;
use super::ply::{Ply, PlyOptions, Property, TextRows, TextStore};
use crate::error::{Error, Result, ShowPath, quoted};
use crate::limits::ReadLimit;

/// PLY files with the same properties, one per frame.
#[derive(Debug, Clone)]
pub struct PlyFrames {
    paths: Vec<PathBuf>,
    counts: Vec<u32>,
    properties: Vec<Property>,
    sh_degree: usize,
    /// Converted rows of each text file.
    texts: Vec<Option<TextRows>>,
    memory: ReadLimit,
}

impl PlyFrames {
    /// All `.ply` files of `folder` but the hidden ones, in natural order (`frame_2` before `frame_10`).
    ///
    /// # Errors
    /// A gap in the frames' numbers, or an entry called like a frame that is no file; a folder without PLY files; a file
    /// [`Ply::open`] refuses; frames that differ in their properties.
    pub fn open(folder: &Path, options: &PlyOptions) -> Result<PlyFrames> {
        let (frames, others) = frames_of(folder)?;
        if let Some(other) = others.first() {
            let found = if other.is_dir() { "a folder" } else { "a link to nothing" };
            return Err(Error::input(other, "", "a PLY file, as its name says", found).hint(ALLOW_GAPS));
        }
        if let Some((missing, before, after)) = first_gap(&frames) {
            let found = format!("{before}, then {after}");
            return Err(Error::input(folder, "", format!("a frame {missing}"), found).hint(ALLOW_GAPS));
        }
        Self::from_paths(folder, frames, options)
    }

    /// [`PlyFrames::open`] of the files that are there, whatever is missing between them.
    ///
    /// # Errors
    /// Those of [`PlyFrames::open`] but gaps.
    pub fn open_with_gaps(folder: &Path, options: &PlyOptions) -> Result<PlyFrames> {
        Self::from_paths(folder, frames_of(folder)?.0, options)
    }

    /// One PLY file as the only frame.
    ///
    /// # Errors
    /// A file [`Ply::open`] refuses.
    pub fn single(path: &Path, options: &PlyOptions) -> Result<PlyFrames> {
        Self::from_paths(path, vec![path.to_owned()], options)
    }

    fn from_paths(origin: &Path, paths: Vec<PathBuf>, options: &PlyOptions) -> Result<PlyFrames> {
        let Some(first_path) = paths.first() else {
            return Err(Error::input(origin, "", "a folder with one .ply file per frame", "no .ply file in it"));
        };
        let (store, memory) = (TextStore::new(&options.scratch), options.memory);
        let first = Ply::open_into(first_path, memory, &store)?;
        let (properties, sh_degree) = (first.properties().to_vec(), first.sh_degree());
        let (mut counts, mut texts) = (Vec::with_capacity(paths.len()), Vec::with_capacity(paths.len()));
        let mut take = |ply: &Ply| {
            // A PLY has at most 2³² − 1 rows.
            counts.push(ply.count() as u32);
            texts.push(ply.text_rows().cloned());
        };
        take(&first);
        drop(first);
        for path in &paths[1..] {
            let ply = Ply::open_into(path, memory, &store)?;
            check_properties(&ply, &properties, first_path)?;
            take(&ply);
        }
        Ok(PlyFrames { paths, counts, properties, sh_degree, texts, memory })
    }

    /// The files, in frame order.
    pub fn paths(&self) -> &[PathBuf] {
        &self.paths
    }

    /// Gaussians in each.
    pub fn counts(&self) -> &[u32] {
        &self.counts
    }

    /// Degree of the spherical harmonics of all, 0 to 3.
    pub fn sh_degree(&self) -> usize {
        self.sh_degree
    }

    /// The first frame with another number of Gaussians than frame 0.
    pub fn other_count(&self) -> Option<usize> {
        self.counts.iter().position(|count| *count != self.counts[0])
    }

    /// Even times, one per frame: frame i of T has time i / T.
    pub fn times(&self) -> Vec<f64> {
        (0..self.paths.len()).map(|i| i as f64 / self.paths.len() as f64).collect()
    }

    /// The file of one frame, open.
    ///
    /// # Errors
    /// A frame beyond the last; a file that no longer is what it was when the frames were opened.
    pub fn frame(&self, frame: usize) -> Result<Ply> {
        let Some(path) = self.paths.get(frame) else {
            return Err(Error::internal(format!(
                "frame {frame} was asked for, of {} counted from 0",
                self.paths.len()
            )));
        };
        let ply = Ply::open_again(path, self.memory, self.texts[frame].as_ref())?;
        check_properties(&ply, &self.properties, &self.paths[0])?;
        let expected = self.counts[frame] as usize;
        if ply.count() != expected {
            let [expected, found] = [expected, ply.count()].map(|count| format!("{count} Gaussians"));
            return Err(Error::input(path, "element vertex", expected + ", as before", found)
                .hint("the file has changed since it was opened"));
        }
        Ok(ply)
    }

    /// XXH3-128 over names and bytes of all files in frame order. Reads everything once. Folders do not enter it: a
    /// sequence that was moved keeps its digest.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn digest(&self) -> Result<u128> {
        let mut hash = Xxh3::new();
        for path in &self.paths {
            // Lengths in front, so that no byte can pass from a name to a content or between files.
            let name = file_name(path).as_encoded_bytes();
            hash.update(&(name.len() as u64).to_le_bytes());
            hash.update(name);
            let length = fs::metadata(path).map_err(Error::io("read the size of", path))?.len();
            hash.update(&length.to_le_bytes());
            hash_file(path, &mut hash)?;
        }
        Ok(hash.digest128())
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

/// The name of the first frame that is missing, with its neighbors', where names differ in one number alone: of those
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
    let name = |at: usize| file_name(&frames[at]).shown().to_string();
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

fn check_properties(ply: &Ply, properties: &[Property], first: &Path) -> Result<()> {
    if ply.properties() == properties {
        return Ok(());
    }
    let first = first.shown();
    let differing = (0..).find(|&i| ply.properties().get(i) != properties.get(i)).unwrap_or(0);
    let name = |list: &[Property]| match list.get(differing) {
        Some(property) => format!("{} {}", property.scalar.name(), quoted(&property.name)),
        None => "no property".to_owned(),
    };
    let expected = format!("{} in place {differing} of {}, as in {first}", name(properties), properties.len());
    let found = format!("{} of {}", name(ply.properties()), ply.properties().len());
    Err(Error::input(ply.path(), "element vertex", expected, found)
        .hint("every frame must have the same properties in the same order"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn padded_and_unpadded_numbers_sort_by_value() {
        let order = |names: &[&str]| {
            let mut sorted = names.to_vec();
            sorted.reverse();
            sorted.sort_by(|a, b| natural_order(OsStr::new(a), OsStr::new(b)));
            assert_eq!(sorted, names);
        };
        order(&["frame_0001.ply", "frame_0009.ply", "frame_0010.ply", "frame_9999.ply", "frame_10000.ply"]);
        order(&["time_00000.ply", "time_00001.ply", "time_00100.ply"]);
        order(&["a1.ply", "a2.ply", "a10.ply", "b0.ply"]);
        order(&["a 1.ply", "a1.ply"]);
    }
}
