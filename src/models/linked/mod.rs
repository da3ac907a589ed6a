//! PLY frames that do not tell which Gaussian is which in other frames. Their Gaussians are linked into tracks
//! (Gaussians followed through frames), packed into a temporary container, and read from it.
//!
//! Every frame is read twice: once to link its Gaussians, once to pack the tracks. Tracks that seem to be the same
//! Gaussian are joined if renders with joined tracks reach at least 40 dB PSNR against renders with separate tracks.
//! Otherwise only the most similar tracks are joined, on the same condition. In frames where a track is absent, it
//! keeps its previous state (or its first one before it begins) with an opacity of nearly zero, so that it is invisible
//! and costs almost no bytes. Then colors, scales, rotations and opacities that hardly change along a track are
//! replaced by their mean ([`steady`]), if renders again reach at least 40 dB PSNR.
//!
//! Memory: [`Sizes`](memory::Sizes). Two frames while linking; one per thread and a few rendered ones while joining
//! tracks and computing means; up to 128 MiB while packing. Disk space, in unnamed files beside the container: 4 bytes
//! per Gaussian and frame, and 4 bytes per track and value that may be constant.

mod arrival;
mod memory;
mod simplify;
mod steady;
mod tracks;
mod unlinked;
mod write;

use std::path::Path;

use xxhash_rust::xxh3::xxh3_128;

use self::tracks::LinkedTracks;
pub use self::unlinked::UnlinkedFrames;
use super::size::{ModelSize, file_bytes};
use super::trajectories::write_trajectories;
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::atomic::ScratchFile;
use crate::files::container::Container;
use crate::files::ply::PlyOptions;
use crate::files::ply_frames::PlyFrames;
use crate::limits::Limits;
use crate::model::SequenceInfo;
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, ReadPlan};
use crate::tracking::Joiner;

/// Frames whose Gaussians have been linked into tracks (Gaussians followed through frames).
struct LinkedFrames {
    tracks: LinkedTracks,
    /// Temporary container with the state of every track (Gaussian followed through frames) at every frame.
    container: Container,
    /// Number of Gaussians, times and SH degree of the sequence. They are those of the container, except that the times
    /// may have been replaced.
    info: SequenceInfo,
    notes: Vec<String>,
    /// Smallest mean PSNR, dB, of renders after a simplification of the tracks (joining, means of attributes) against
    /// renders before it; `None` if the tracks were not simplified.
    simplified_psnr: Option<f64>,
    /// Owner of the container's file; deletes the file when it is dropped.
    _scratch: ScratchFile,
    /// Peak bytes of memory that receiving or unpacking the frames took; 0 if the user gave PLY files.
    unpacking_bytes: u64,
}

impl LinkedFrames {
    /// Links the Gaussians of `frames` into tracks (Gaussians followed through frames). If `joins`, also joins tracks
    /// that seem to be the same Gaussian and makes nearly constant attributes constant. `why` is the reason for
    /// linking, for the notes to the user; `name` is what messages call the frames. `unpacking_bytes` is the memory that
    /// receiving or unpacking the frames took.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or has changed meanwhile, if linking needs more memory than `options` allow, or
    /// if a write fails.
    fn new(
        frames: PlyFrames,
        name: &Path,
        why: &str,
        joins: bool,
        unpacking_bytes: u64,
        options: &PlyOptions,
    ) -> Result<LinkedFrames> {
        let scratch = &*options.scratch;
        let not_read = frames.frame(0)?.header_notes();
        let mut joiner = joins.then(Joiner::default);
        let (mut tracks, found, linker) = LinkedTracks::link(frames, name, joiner.as_mut(), options)?;
        let joined = joiner.map(|joiner| simplify::join(joiner, &linker, &mut tracks)).transpose()?.flatten();
        drop(linker);
        let held = if joins { simplify::hold_steady(&mut tracks, scratch)? } else { None };
        let packed = ScratchFile::new(scratch)?;
        tracks.pack(packed.path(), &options.events)?;
        let container = Container::open(packed.path())?;
        let info = container.info().clone();
        let mut notes = vec![format!("frames were linked: {why}")];
        notes.extend(found.notes(&tracks)?);
        let psnrs = [joined.as_ref(), held.as_ref()].into_iter().flatten().filter_map(|step| step.psnr);
        let simplified_psnr = psnrs.reduce(f64::min);
        notes.extend(joined.into_iter().chain(held).map(|step| step.note).chain(not_read));
        Ok(LinkedFrames { tracks, container, info, notes, simplified_psnr, _scratch: packed, unpacking_bytes })
    }
}

impl FrameSource for LinkedFrames {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        self.container.open(ids)
    }

    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        self.container.open_all(plan)
    }

    fn reads(&self) -> ReadCounts {
        self.container.reads()
    }
}

impl InputModel for LinkedFrames {
    fn description(&self) -> ModelDescription {
        ModelDescription {
            kind: "linked PLY frames",
            notes: self.notes.clone(),
            has_explicit_frames: true,
            archives_as_frames: true,
            tracking_note: self.simplified_psnr.map(|psnr| {
                format!(
                    "its frames were linked, and its tracks joined or partly replaced by means, which changes its \
                     renders: {psnr:.1} dB PSNR, the mean of a few renders; views can have less. --link apart compares \
                     the frames as they are"
                )
            }),
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        self
    }

    fn digest(&self) -> Result<String> {
        // Linking the same files differently gives a different input, so the container's digest is included.
        let both = format!("{:032x} {}", self.tracks.frames().digest()?, self.container.digest());
        Ok(format!("{:032x}", xxh3_128(both.as_bytes())))
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(ModelSize::from_frames(file_bytes(self.tracks.frames().paths())?))
    }

    fn stored_bytes(&self) -> Result<u64> {
        self.container.bytes()
    }

    fn memory_profile(&self) -> MemoryProfile {
        let (sizes, count) = (self.tracks.sizes(), self.info.count.max(1) as u64);
        MemoryProfile {
            per_gaussian: sizes.open().div_ceil(count),
            opening: sizes.opening().max(self.unpacking_bytes).div_ceil(count),
            file: sizes.frame_file().div_ceil(count),
            ..self.container.memory_profile()
        }
    }

    fn hold_decoded(&self) {
        InputModel::hold_decoded(&self.container);
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        self.info = self.info.with_times(times)?;
        Ok(self)
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        match kind {
            OutputKind::PlySequence => {
                self.write_files(compressed, path, events)?;
                let note = "the written frames do not identify their Gaussians either: commands that read them link \
                            them again and may find another number of tracks";
                Ok(vec![note.to_owned()])
            }
            _ => write_trajectories(self, compressed, kind, path, limits, events),
        }
    }
}
