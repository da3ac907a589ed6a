//! Opens the PLY files of a sequence, one per frame: determines their order and checks that they have the same
//! properties.
//!
//! Input: a folder with one PLY file per frame, or a single file. Output: the paths in frame order, the number of
//! Gaussians in each file, and any of the files opened on request. Memory: the path and the number of Gaussians of
//! every frame. A file is mapped into memory only while it is read, so thousands of frames need neither thousands of
//! memory maps nor thousands of file descriptors. Text files are converted once, when they are opened, into a shared
//! scratch file.

use std::cmp::Ordering;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::digest::hash_file;
use super::open::sorted_entries;
use super::ply::{Ply, PlyOptions, Property, TextRows, TextStore};
use crate::error::{Error, Result, ShowPath, quoted};
use crate::limits::ReadLimit;

/// PLY files of a sequence, one per frame, all with the same properties.
#[derive(Debug, Clone)]
pub struct PlyFrames {
    paths: Vec<PathBuf>,
    /// Paths of the files from which the PLY files were made, for messages; the PLY files themselves if they are the
    /// user's.
    shown_paths: Vec<PathBuf>,
    counts: Vec<u32>,
    properties: Vec<Property>,
    sh_degree: usize,
    /// For each frame, the location of its rows in binary form if its file is a text file; `None` if it is a binary
    /// file.
    texts: Vec<Option<TextRows>>,
    memory: ReadLimit,
}

impl PlyFrames {
    /// Opens all `.ply` files in `folder`, one per frame, except hidden ones, in natural order (`frame_2` before
    /// `frame_10`).
    ///
    /// # Errors
    /// Fails if the numbers of the frames have a gap, if an entry is named like a frame but is not a file, if the
    /// folder has no PLY files, if [`Ply::open`] fails for a file, or if frames differ in their properties.
    pub fn open(folder: &Path, options: &PlyOptions) -> Result<PlyFrames> {
        Self::from_paths(folder, FrameFiles::list(folder, is_named_like_frame)?.checked(folder, false)?, options)
    }

    /// Opens a folder like [`PlyFrames::open`], but accepts missing frames.
    ///
    /// # Errors
    /// Fails like [`PlyFrames::open`], except for gaps and entries that are not files.
    pub fn open_with_gaps(folder: &Path, options: &PlyOptions) -> Result<PlyFrames> {
        Self::from_paths(folder, FrameFiles::list(folder, is_named_like_frame)?.checked(folder, true)?, options)
    }

    /// Opens the PLY file at `path` as the only frame.
    ///
    /// # Errors
    /// Fails like [`Ply::open`].
    pub fn open_single(path: &Path, options: &PlyOptions) -> Result<PlyFrames> {
        Self::from_paths(path, vec![path.to_owned()], options)
    }

    /// Opens the PLY files at `paths` as frames. Error messages call the sequence `origin`.
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
        Ok(PlyFrames { shown_paths: paths.clone(), paths, counts, properties, sh_degree, texts, memory })
    }

    /// Returns the paths of the files in frame order.
    pub fn paths(&self) -> &[PathBuf] {
        &self.paths
    }

    /// Returns these frames, which messages call by `shown_paths`: the files from which the PLY files were made.
    pub fn with_shown_paths(self, shown_paths: Vec<PathBuf>) -> PlyFrames {
        PlyFrames { shown_paths, ..self }
    }

    /// Returns the paths by which messages call the frames: files of the user, in frame order.
    pub fn shown_paths(&self) -> &[PathBuf] {
        &self.shown_paths
    }

    /// Returns the number of Gaussians in each frame.
    pub fn gaussian_counts(&self) -> &[u32] {
        &self.counts
    }

    /// Returns the SH degree of all frames, 0 to 3.
    pub fn sh_degree(&self) -> usize {
        self.sh_degree
    }

    /// Returns the first frame whose number of Gaussians differs from that of frame 0; `None` if all are equal.
    pub fn first_differing_frame(&self) -> Option<usize> {
        self.counts.iter().position(|count| *count != self.counts[0])
    }

    /// Returns evenly spaced times, one per frame: frame i of T has time i / T.
    pub fn times(&self) -> Vec<f64> {
        (0..self.paths.len()).map(|i| i as f64 / self.paths.len() as f64).collect()
    }

    /// Opens the PLY file of frame `frame`.
    ///
    /// # Errors
    /// Fails if there is no such frame, or if the file has changed since the frames were opened.
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

    /// Returns the XXH3-128 hash of the names and contents of all files in frame order. Reads all files once. Folder
    /// names are not included, so a sequence that was moved keeps its digest.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn digest(&self) -> Result<u128> {
        let mut hash = Xxh3::new();
        for path in &self.paths {
            // Hash lengths first, so that different splits into names and contents give different hashes.
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

/// Returns the last component of `path`, the file name.
fn file_name(path: &Path) -> &OsStr {
    path.file_name().unwrap_or_default()
}

/// Hint for a sequence that is refused because frames are missing.
const ALLOW_GAPS_HINT: &str = "--allow-gaps reads the existing frames as the whole sequence";

/// Entries of a folder whose names are those of frames of a sequence, sorted in natural order (`frame_2` before
/// `frame_10`).
pub(crate) struct FrameFiles {
    /// Entries of the folder that are files. Each of them is one frame.
    frames: Vec<PathBuf>,
    /// Entries of the folder that are named like frames but are not files, such as folders.
    non_files: Vec<PathBuf>,
}

impl FrameFiles {
    /// Lists the entries of `folder` for which `is_frame` returns true.
    ///
    /// # Errors
    /// Fails if the folder cannot be listed.
    pub(crate) fn list(folder: &Path, is_frame: impl Fn(&Path) -> bool) -> Result<FrameFiles> {
        let mut paths = sorted_entries(folder)?;
        paths.retain(|path| is_frame(path));
        paths.sort_by(|a, b| natural_order(file_name(a), file_name(b)));
        let (frames, non_files) = paths.into_iter().partition(|path| path.is_file());
        Ok(FrameFiles { frames, non_files })
    }

    /// Returns the paths of all frames in natural order (`frame_2` before `frame_10`). `folder` is the folder that was
    /// listed; error messages name it.
    ///
    /// # Errors
    /// Fails if the names of the frames differ in more than their numbers, or if two have the same number. Unless
    /// `allow_gaps` is true, also fails if the numbers of the frames have a gap or if an entry is not a file.
    pub(crate) fn checked(self, folder: &Path, allow_gaps: bool) -> Result<Vec<PathBuf>> {
        if let Some((expected, found)) = misnamed_pair(&self.frames) {
            return Err(Error::input(folder, "", expected, found)
                .hint("move the files that are not frames of this sequence into another folder"));
        }
        if allow_gaps {
            return Ok(self.frames);
        }
        if let Some(other) = self.non_files.first() {
            let found = if other.is_dir() { "a folder" } else { "a link to nothing" };
            return Err(Error::input(other, "", "a file, as its name says", found).hint(ALLOW_GAPS_HINT));
        }
        if let Some((missing, before, after)) = first_gap(&self.frames) {
            let found = format!("{before}, then {after}");
            return Err(Error::input(folder, "", format!("a frame {missing}"), found).hint(ALLOW_GAPS_HINT));
        }
        Ok(self.frames)
    }
}

/// Finds two of the files `frames`, sorted in natural order, that cannot be frames of one sequence: their names differ in
/// the text around their numbers, or have the same numbers. Returns descriptions of the expected names and of the two
/// found ones; `None` if all names fit, or if no name has a number.
fn misnamed_pair(frames: &[PathBuf]) -> Option<(&'static str, String)> {
    // Text around the numbers of a name, in which `0` stands for each number, and the numbers without leading zeros.
    let parts = |path: &PathBuf| {
        let name = file_name(path).to_string_lossy().to_ascii_lowercase();
        let (mut text, mut numbers) = (String::new(), Vec::new());
        for run in name.as_bytes().chunk_by(|a, b| a.is_ascii_digit() == b.is_ascii_digit()) {
            let run = String::from_utf8_lossy(run);
            match run.starts_with(|c: char| c.is_ascii_digit()) {
                true => {
                    text.push('0');
                    numbers.push(run.trim_start_matches('0').to_owned());
                }
                false => text.push_str(&run),
            }
        }
        (text, numbers)
    };
    let named: Vec<_> = frames.iter().map(parts).collect();
    if named.iter().all(|(_, numbers)| numbers.is_empty()) {
        return None;
    }
    let pair = |a: usize, b: usize| format!("{} and {}", file_name(&frames[a]).shown(), file_name(&frames[b]).shown());
    if let Some(other) = named.iter().position(|(text, _)| *text != named[0].0) {
        return Some(("files whose names differ only in their numbers", pair(0, other)));
    }
    let mut by_number: Vec<usize> = (0..named.len()).collect();
    by_number.sort_by_key(|&at| &named[at].1);
    let repeated = by_number.windows(2).find(|two| named[two[0]].1 == named[two[1]].1)?;
    Some(("each frame number once", pair(repeated[0], repeated[1])))
}

/// Finds the first missing frame of a sequence with the files `frames`, whose names contain frame numbers. Returns
/// three file names: the expected one of the missing frame, and those of the frames before and after the gap.
///
/// A gap is a difference of successive frame numbers that is larger than the smallest such difference. Returns `None`
/// if there is no gap, or if the file names differ in more than their last number.
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

/// Returns whether `path` has the extension `.ply` and is not hidden: `._frame_1.ply`, written by a file manager, is no
/// frame.
fn is_named_like_frame(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("ply"))
        && !file_name(path).as_encoded_bytes().starts_with(b".")
}

/// Compares two file names in natural order: numbers in them compare by value, so `frame_2` is before `frame_10`. Names
/// that are equal in this order, such as `a 1` and `a1`, compare by bytes, so that their order is fixed.
fn natural_order(a: &OsStr, b: &OsStr) -> Ordering {
    natord::compare(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b))
}

/// Checks that the frame `ply` has the same properties as the first frame. `properties` are the properties of the first
/// frame, and `first` is the path of its file. The error names the first difference.
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
    fn names_that_do_not_fit_one_sequence_are_found() {
        let found = |names: &[&str]| {
            let mut paths: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
            paths.sort_by(|a, b| natural_order(file_name(a), file_name(b)));
            misnamed_pair(&paths).map(|(_, pair)| pair)
        };
        for fitting in [
            &["f_9.ply", "f_10.ply", "f_0011.PLY"][..],
            &["1_cloud_0.ply", "2_cloud_0.ply"],
            &["left.ply", "right.ply"],
            &["only.ply"],
            &[],
        ] {
            assert_eq!(found(fitting), None, "{fitting:?}");
        }
        for (names, pair) in [
            (&["f_0.ply", "f_1.ply", "point_cloud.ply"][..], "f_0.ply and point_cloud.ply"),
            (&["f_0.ply", "f_1.ply", "g_0.ply"], "f_0.ply and g_0.ply"),
            (&["f_0.ply", "f_01.ply", "f_02.ply", "f_1.ply"], "f_01.ply and f_1.ply"),
        ] {
            assert_eq!(found(names).as_deref(), Some(pair));
        }
    }

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
