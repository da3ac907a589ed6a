//! Reads a dynamic scene that is stored as one PLY file per frame.
//!
//! Input: PLY files with the same Gaussians in the same order. Output: a [`FrameSource`], which reads any Gaussians at
//! any frame. Memory: that of [`PlyFrames`].

use std::ops::Range;
use std::path::{Path, PathBuf};

use super::ply::{Ply, PlyOptions, check_ids};
use super::ply_frames::PlyFrames;
use crate::error::{Error, Result, ShowPath};
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, SharedCounter};

/// Dynamic scene stored as one PLY file per frame, with the same Gaussians in every file.
#[derive(Debug)]
pub struct PlySequence {
    frames: PlyFrames,
    info: SequenceInfo,
    /// Notes for the user about the files.
    notes: Vec<String>,
    bytes: SharedCounter,
    states: SharedCounter,
}

impl PlySequence {
    /// Opens the PLY files in `folder`, one per frame, like [`PlyFrames::open`]. Every frame must have the same number
    /// of Gaussians.
    ///
    /// # Errors
    /// Fails like [`PlyFrames::open`] and [`PlySequence::new`].
    pub fn open(folder: &Path) -> Result<PlySequence> {
        Self::new(PlyFrames::open(folder, &PlyOptions::default())?)
    }

    /// Opens the PLY file at `path` as a sequence of one frame, in which no attribute varies.
    ///
    /// # Errors
    /// Fails like [`PlyFrames::open_single`].
    pub fn open_single(path: &Path, options: &PlyOptions) -> Result<PlySequence> {
        Self::new(PlyFrames::open_single(path, options)?)
    }

    /// Builds a sequence from frames with the same Gaussians in the same order. Frame i of T has time i / T; all
    /// attributes vary if T > 1.
    ///
    /// # Errors
    /// Fails if frames differ in their number of Gaussians.
    pub fn new(frames: PlyFrames) -> Result<PlySequence> {
        if let Some(other) = frames.first_differing_frame() {
            let counts = frames.gaussian_counts();
            let expected = format!("{} Gaussians, as in {}", counts[0], frames.shown_paths()[0].shown());
            let found = format!("{} Gaussians", counts[other]);
            let shown = &frames.shown_paths()[other];
            let place = if *shown == frames.paths()[other] { "element vertex" } else { "" };
            return Err(Error::input(shown, place, expected, found)
                .hint("every frame must hold the same Gaussians in the same order, unless they are linked (--link)"));
        }
        let info = SequenceInfo {
            count: frames.gaussian_counts()[0] as usize,
            times: frames.times(),
            sh_degree: frames.sh_degree(),
            varying: if frames.paths().len() == 1 { Attributes::empty() } else { Attributes::all() },
        };
        let (bytes, states) = (SharedCounter::default(), SharedCounter::default());
        let first = frames.frame(0)?;
        let notes = if frames.paths().len() == 1 { first.notes()? } else { first.header_notes() };
        Ok(PlySequence { frames, info, notes, bytes, states })
    }

    /// Returns this sequence with `note`, an additional note for the user about its files.
    pub fn with_note(mut self, note: String) -> PlySequence {
        self.notes.push(note);
        self
    }

    /// Returns notes for the user about unusual content. For a sequence of one file, they count its rows (Gaussians)
    /// with defects and name content that is not read. For several files, they only name content that is not read,
    /// because counting would need a pass over all files.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Replaces the time stamps of the T frames by `times`, one per frame.
    ///
    /// # Errors
    /// Fails if the number of times is not T, or if times are not finite or not strictly increasing; the message names
    /// the frames.
    pub fn with_times(mut self, times: Vec<f64>) -> Result<PlySequence> {
        self.info = self.info.with_times(times)?;
        Ok(self)
    }

    /// Returns the paths of the files in frame order.
    pub fn paths(&self) -> &[PathBuf] {
        self.frames.paths()
    }

    /// Opens the PLY file of frame `frame`.
    ///
    /// # Errors
    /// Fails like [`PlyFrames::frame`].
    pub fn frame(&self, frame: usize) -> Result<Ply> {
        self.frames.frame(frame)
    }

    /// Returns the hash of all files ([`PlyFrames::digest`]) as 32 hexadecimal digits.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn digest(&self) -> Result<String> {
        Ok(format!("{:032x}", self.frames.digest()?))
    }
}

impl FrameSource for PlySequence {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        check_ids(&self.paths()[0], &ids, self.info.count)?;
        Ok(Box::new(PlyBlock { sequence: self, ids: OwnedIds::from_ids(ids) }))
    }

    fn reads(&self) -> ReadCounts {
        ReadCounts { bytes: self.bytes.get(), states: self.states.get(), ..ReadCounts::default() }
    }
}

/// Reader of a selection of the Gaussians of a [`PlySequence`], frame by frame.
struct PlyBlock<'a> {
    sequence: &'a PlySequence,
    ids: OwnedIds,
}

impl BlockReader for PlyBlock<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let (ply, ids) = (self.sequence.frame(frame)?, self.ids.borrow());
        self.sequence.bytes.add(ply.bytes_read_for(ids.len()));
        self.sequence.states.add(ids.len() as u64);
        ply.gather(&ids, want, out)
    }
}

/// Selection of Gaussians like [`Ids`] (a range or a list of indices) that owns its list instead of borrowing it.
enum OwnedIds {
    Range(Range<usize>),
    List(Vec<u32>),
}

impl OwnedIds {
    /// Copies the indices `ids` into a value that owns them.
    fn from_ids(ids: Ids<'_>) -> OwnedIds {
        match ids {
            Ids::Range(range) => OwnedIds::Range(range),
            Ids::List(list) => OwnedIds::List(list.to_vec()),
        }
    }

    /// Returns the indices as [`Ids`], which borrows them.
    fn borrow(&self) -> Ids<'_> {
        match self {
            OwnedIds::Range(range) => Ids::Range(range.clone()),
            OwnedIds::List(list) => Ids::List(list),
        }
    }
}

#[cfg(test)]
mod tests;
