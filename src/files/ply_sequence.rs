//! A dynamic scene as one PLY file per frame.
//!
//! In: PLY files with the same Gaussians in the same order. Out: a [`FrameSource`]. Memory: that of [`PlyFrames`].

use std::ops::Range;
use std::path::{Path, PathBuf};

use super::ply::{Ply, PlyOptions, check_ids};
use super::ply_frames::PlyFrames;
use crate::error::{Error, Result, ShowPath};
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::source::{BlockReader, Count, FrameSource, Ids, Reads};

/// A sequence of PLY files.
#[derive(Debug)]
pub struct PlySequence {
    frames: PlyFrames,
    info: SequenceInfo,
    note: Option<String>,
    bytes: Count,
    states: Count,
}

impl PlySequence {
    /// [`PlyFrames::open`], of the same Gaussians in every frame.
    ///
    /// # Errors
    /// Those of [`PlyFrames::open`] and [`PlySequence::new`].
    pub fn open(folder: &Path) -> Result<PlySequence> {
        Self::new(PlyFrames::open(folder, &PlyOptions::default())?)
    }

    /// One PLY file as a sequence of one frame, in which nothing varies.
    ///
    /// # Errors
    /// Those of [`PlyFrames::single`].
    pub fn single(path: &Path, options: &PlyOptions) -> Result<PlySequence> {
        Self::new(PlyFrames::single(path, options)?)
    }

    /// Frames that hold the same Gaussians in the same order. Frame i of T has time i / T; all columns vary when T > 1.
    ///
    /// # Errors
    /// Frames that differ in their number of Gaussians.
    pub fn new(frames: PlyFrames) -> Result<PlySequence> {
        if let Some(other) = frames.other_count() {
            let counts = frames.counts();
            let expected = format!("{} Gaussians, as in {}", counts[0], frames.paths()[0].shown());
            let found = format!("{} Gaussians", counts[other]);
            return Err(Error::input(&frames.paths()[other], "element vertex", expected, found)
                .hint("every frame must hold the same Gaussians in the same order, unless they are linked (--link)"));
        }
        let info = SequenceInfo {
            count: frames.counts()[0] as usize,
            times: frames.times(),
            sh_degree: frames.sh_degree(),
            varying: if frames.paths().len() == 1 { Columns::empty() } else { Columns::all() },
        };
        let (bytes, states) = (Count::default(), Count::default());
        Ok(PlySequence { frames, info, note: None, bytes, states })
    }

    /// The same, with something that a person should know of them.
    pub fn with_note(self, note: String) -> PlySequence {
        PlySequence { note: Some(note), ..self }
    }

    /// What a person should know of them, if anything.
    pub fn note(&self) -> Option<&str> {
        self.note.as_deref()
    }

    /// The same frames at other times, one per frame.
    ///
    /// # Errors
    /// A number of times other than T; times that are not finite or not strictly increasing, naming the
    /// frames.
    pub fn with_times(mut self, times: Vec<f64>) -> Result<PlySequence> {
        self.info = self.info.with_times(times)?;
        Ok(self)
    }

    /// The files, in frame order.
    pub fn paths(&self) -> &[PathBuf] {
        self.frames.paths()
    }

    /// The file of one frame, open.
    ///
    /// # Errors
    /// Those of [`PlyFrames::frame`].
    pub fn frame(&self, frame: usize) -> Result<Ply> {
        self.frames.frame(frame)
    }

    /// [`PlyFrames::digest`] as 32 hexadecimal digits.
    ///
    /// # Errors
    /// A file that cannot be read.
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
    fn from_ids(ids: Ids<'_>) -> OwnedIds {
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

#[cfg(test)]
mod tests;
