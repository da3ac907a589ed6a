//! PLY frames that do not know one another: linked, packed into a container, and read from that.
//!
//! Every frame is read twice: to link it, then to pack its tracks. Lives that are one become one track, where pictures with
//! them stay within 40 dB of those without: of the close ones alone where that is not so of all that are alike. A track
//! that is not there in a frame is held as it was, or as it will be first, with an opacity of nothing, so that it is seen
//! nowhere and costs next to nothing. Then colors, scales, rotations and opacities that hardly change along a track are at
//! every frame what they are in the mean ([`steady`]), where pictures with them stay within 40 dB of those without.
//!
//! Memory: [`Sizes`](memory::Sizes); of frames two while they are linked, one for every thread and a few to look at while
//! lives are joined and held, and up to 128 MiB while they are packed. On the disk, in files without a name, 4 bytes per
//! Gaussian and frame and 4 per track and value that may be steady, beside the container.

mod arrival;
mod lives;
mod memory;
mod steady;
mod tracks;
mod write;

use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::xxh3_128;

use self::tracks::LinkedTracks;
use super::size::bytes_of;
use super::trajectories::write_trajectories;
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::atomic::{ScratchFile, ScratchFolder};
use crate::files::container::Container;
use crate::files::ply::PlyOptions;
use crate::files::ply_frames::PlyFrames;
use crate::limits::Limits;
use crate::model::SequenceInfo;
use crate::models::input_model::{InputModel, MemoryProfile, Timing};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::source::{BlockReader, FrameSource, Ids, Prefetch, ReadPlan, Reads};
use crate::tracking::Joiner;

/// Linked frames.
pub struct LinkedFrames {
    tracks: LinkedTracks,
    /// The tracks at every frame.
    container: Container,
    /// Of the container, at times that may be others.
    info: SequenceInfo,
    notes: Vec<String>,
    /// Keeps the container's file until nobody reads it any more.
    _scratch: ScratchFile,
    /// What the frames came as, if not as files.
    arrived: Option<Arrived>,
}

/// Frames that came another way than as files.
struct Arrived {
    /// Keeps their files until nobody reads them any more.
    _folder: ScratchFolder,
    /// What they are, for people.
    kind: &'static str,
    /// Bytes that they came as.
    bytes: u64,
    /// Bytes of memory that this took.
    memory: u64,
}

impl LinkedFrames {
    /// Links `frames`, which the notes say `why` of, and if `joins` lives that are one, along which what hardly changes is held.
    /// Messages call the frames `name`.
    ///
    /// # Errors
    /// A frame that cannot be read or has changed meanwhile; more memory than `options` allow; a failed write.
    pub(super) fn open(
        frames: PlyFrames,
        name: &Path,
        why: &str,
        joins: bool,
        options: &PlyOptions,
    ) -> Result<LinkedFrames> {
        let scratch = &*options.scratch;
        let mut joiner = joins.then(Joiner::default);
        let (mut tracks, found, linker) = LinkedTracks::link(frames, name, joiner.as_mut(), options)?;
        let joined = joiner.map(|joiner| lives::join(joiner, &linker, &mut tracks)).transpose()?.flatten();
        drop(linker);
        let held = if joins { lives::hold(&mut tracks, scratch)? } else { None };
        let packed = ScratchFile::new(scratch)?;
        tracks.pack(packed.path(), &options.events)?;
        let container = Container::open(packed.path())?;
        let info = container.info().clone();
        let mut notes = vec![format!("frames were linked: {why}")];
        notes.extend(found.notes(&tracks)?);
        notes.extend(joined.into_iter().chain(held));
        Ok(LinkedFrames { tracks, container, info, notes, _scratch: packed, arrived: None })
    }
}

impl FrameSource for LinkedFrames {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        self.container.open(ids)
    }

    fn open_all(&self, wanted: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        self.container.open_all(wanted)
    }

    fn reads(&self) -> Reads {
        self.container.reads()
    }

    fn ahead(&self) -> Option<&dyn Prefetch> {
        self.container.ahead()
    }
}

impl InputModel for LinkedFrames {
    fn kind(&self) -> &'static str {
        self.arrived.as_ref().map_or("linked PLY frames", |arrived| arrived.kind)
    }

    fn source(&self) -> &dyn FrameSource {
        self
    }

    fn digest(&self) -> Result<String> {
        // Another linking of the same files is another input.
        let both = format!("{:032x} {}", self.tracks.frames().digest()?, self.container.digest());
        Ok(format!("{:032x}", xxh3_128(both.as_bytes())))
    }

    fn bytes(&self) -> Result<u64> {
        match &self.arrived {
            None => bytes_of(self.tracks.frames().paths().iter().map(PathBuf::as_path)),
            Some(arrived) => Ok(arrived.bytes),
        }
    }

    fn stored_bytes(&self) -> Result<u64> {
        self.container.bytes()
    }

    fn has_explicit_frames(&self) -> bool {
        true
    }

    fn residence(&self) -> MemoryProfile {
        let (sizes, count) = (self.tracks.sizes(), self.info.count.max(1) as u64);
        let arriving = self.arrived.as_ref().map_or(0, |arrived| arrived.memory);
        MemoryProfile {
            per_gaussian: sizes.open().div_ceil(count),
            opening: sizes.opening().max(arriving).div_ceil(count),
            file: sizes.frame_file().div_ceil(count),
            ..self.container.residence()
        }
    }

    fn hold_decoded(&self) {
        InputModel::hold_decoded(&self.container);
    }

    fn timing(&self) -> Timing {
        match self.arrived {
            None => Timing::Numbered,
            Some(_) => Timing::Stamped,
        }
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        self.info = self.info.with_times(times)?;
        Ok(self)
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    fn write(
        &self,
        reduction: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        match kind {
            OutputKind::PlySequence => self.write_files(reduction, path, events).map(|()| Vec::new()),
            _ => write_trajectories(self, reduction, kind, path, limits, events),
        }
    }
}
