//! Saves frames that the user did not give as PLY files as temporary PLY files, so that their Gaussians can be linked.
//! There are two sources of such frames:
//! - a frame stream without ids of Gaussians (format/STREAM.md, version 2),
//! - an input that identifies Gaussians across frames, if the user asks to link it anew.
//!
//! Memory while frames arrive:
//! - from a stream: one frame,
//! - from a container: up to 128 MiB of visible Gaussians, and for each thread a tile (block of Gaussians × frames) of
//!   every column (attribute).
//!
//! Disk space, in a temporary folder: every frame as PLY.

use std::io::Read;
use std::ops::Range;
use std::path::Path;

use rayon::prelude::*;

use super::memory::TOGETHER_BYTES;
use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::files::frame_stream::FrameStream;
use crate::files::ply::PlyOptions;
use crate::files::ply::write::write_inria;
use crate::files::ply_frames::PlyFrames;
use crate::fit::MIN_VISIBLE_OPACITY;
use crate::model::{Attributes, Gaussians, opacity};
use crate::models::input_model::InputModel;
use crate::models::trajectories::state_bytes;
use crate::models::unpacked::{Original, Unpacked};
use crate::outputs::container::{GAUSSIAN_BLOCK, gaussian_range};
use crate::source::{FrameSource, Ids, ReadPlan};

/// Temporary PLY files of the frames received so far, and their times.
pub(super) struct ReceivedFrames {
    folder: ScratchFolder,
    times: Vec<f64>,
    /// Bytes of memory that the reader of the input takes, which supplies the frames.
    reader_bytes: u64,
    /// Bytes of memory that the largest frame takes.
    largest_frame_bytes: u64,
}

impl ReceivedFrames {
    /// Creates an empty temporary folder in `scratch` for the frames. `reader_bytes` is the memory in bytes that the
    /// reader of the input takes. Fails if the folder cannot be created.
    fn new(scratch: &Path, reader_bytes: u64) -> Result<ReceivedFrames> {
        Ok(ReceivedFrames {
            folder: ScratchFolder::new(scratch)?,
            times: Vec::new(),
            reader_bytes,
            largest_frame_bytes: 0,
        })
    }

    /// Writes `state`, the Gaussians of the next frame, to a PLY file. `time` is the time stamp of the frame.
    fn push(&mut self, time: f64, state: &Gaussians) -> Result<()> {
        write_inria(state, &[], &self.folder.path().join(format!("frame_{:05}.ply", self.times.len())))?;
        self.times.push(time);
        self.largest_frame_bytes =
            self.largest_frame_bytes.max(state.len() as u64 * state_bytes(state.sh_degree(), Attributes::all()));
        Ok(())
    }

    /// Returns the time stamps of the received frames.
    pub(super) fn times(&self) -> &[f64] {
        &self.times
    }

    /// Links the Gaussians of the received frames into tracks (Gaussians followed through frames) with the function
    /// `link`, whose second argument is the memory in bytes that receiving the frames took. `kind`
    /// and `bytes` are the name of the original input's format, shown to users, and its size in bytes.
    ///
    /// # Errors
    /// Fails if `link` fails or the temporary files cannot be read.
    pub(super) fn link(
        self,
        kind: &'static str,
        bytes: u64,
        link: impl FnOnce(PlyFrames, u64) -> Result<Box<dyn InputModel>>,
        options: &PlyOptions,
    ) -> Result<Box<dyn InputModel>> {
        let frames = PlyFrames::open(self.folder.path(), options)?;
        let linked = link(frames, self.reader_bytes + 2 * self.largest_frame_bytes)?.with_times(self.times)?;
        Ok(Unpacked { _scratch: self.folder, kind, original: Original::Stamped(bytes) }.into_model(linked))
    }
}

/// Receives a whole stream, which messages call `name`. Returns its frames and the number of bytes received.
///
/// # Errors
/// Fails if the stream is damaged or has no frames, or if a write fails.
pub(super) fn receive(
    mut stream: FrameStream<impl Read>,
    name: &Path,
    options: &PlyOptions,
) -> Result<(ReceivedFrames, u64)> {
    let mut received = ReceivedFrames::new(&options.scratch, 0)?;
    let mut state = Gaussians::zeros(0, stream.header().sh_degree);
    let progress = options.events.counting_task("receive", "frames");
    while let Some(time) = stream.next_frame(&mut state)? {
        received.push(time, &state)?;
        progress.advance(1);
    }
    if received.times.is_empty() {
        return Err(Error::input(name, "", "at least one frame", "the end of the stream"));
    }
    Ok((received, stream.received_bytes()))
}

/// Saves the frames of `input`, each with the Gaussians that may be visible in it, as temporary PLY files. Which Gaussian
/// is which in the input is lost.
///
/// # Errors
/// Fails if a frame cannot be read or a write fails.
pub(super) fn unpack_visible(input: &dyn InputModel, options: &PlyOptions) -> Result<ReceivedFrames> {
    let (source, info) = (input.source(), input.source().info());
    let visible_rows = count_visible_rows(source)?;
    let state = state_bytes(info.sh_degree, Attributes::all());
    let profile = input.memory_profile();
    let tile = profile.gaussian_block.min(info.count as u64) * profile.frame_block;
    let decoding = tile * (state + 3 * state_bytes(info.sh_degree, Attributes::SH));
    let unpacked = TOGETHER_BYTES.min(state * visible_rows.iter().sum::<u64>());
    let mut received =
        ReceivedFrames::new(&options.scratch, unpacked + rayon::current_num_threads() as u64 * decoding)?;
    let progress = options.events.task("unpack", "frames", info.times.len() as u64);
    let mut start = 0;
    while start < visible_rows.len() {
        let mut bytes = 0;
        let more = visible_rows[start..].iter().take_while(|&&visible_rows| {
            bytes += state * visible_rows;
            bytes <= TOGETHER_BYTES
        });
        let together = start..start + more.count().max(1);
        start = together.end;
        let blocks = unpack(source, together.clone())?;
        for (at, frame) in together.enumerate() {
            let mut whole = Gaussians::zeros(visible_rows[frame] as usize, info.sh_degree);
            let mut first = 0;
            for block in &blocks {
                whole.write_rows(first, &block[at]);
                first += block[at].len();
            }
            received.push(info.times[frame], &whole)?;
            progress.advance(1);
        }
    }
    drop(progress);
    Ok(received)
}

/// Returns the blocks of consecutive Gaussians of `source`, as ranges of indices, for reading in parallel.
fn blocks(source: &dyn FrameSource) -> impl IndexedParallelIterator<Item = Range<usize>> {
    let count = source.info().count;
    (0..count.div_ceil(GAUSSIAN_BLOCK)).into_par_iter().map(move |block| gaussian_range(count, block))
}

/// Returns the indices of the Gaussians of `state` that may be visible: those with an opacity of at least
/// [`MIN_VISIBLE_OPACITY`].
fn visible_rows(state: &Gaussians) -> Vec<u32> {
    let opacities = (0u32..).zip(state.opacity_logit.plane(0));
    opacities.filter(|&(_, &logit)| opacity(logit) >= MIN_VISIBLE_OPACITY).map(|(row, _)| row).collect()
}

/// Returns the number of visible Gaussians ([`visible_rows`]) in each frame of `source`.
fn count_visible_rows(source: &dyn FrameSource) -> Result<Vec<u64>> {
    let frames = source.info().times.len();
    let count = |range: Range<usize>| -> Result<Vec<u64>> {
        let (mut reader, mut state) = (source.open(Ids::Range(range))?, Gaussians::zeros(0, 0));
        (0..frames)
            .map(|frame| {
                reader.read(frame, Attributes::OPACITY, &mut state)?;
                Ok(visible_rows(&state).len() as u64)
            })
            .collect()
    };
    let add = |mut a: Vec<u64>, b: Vec<u64>| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        Ok(a)
    };
    blocks(source).map(count).try_reduce(|| vec![0; frames], add)
}

/// Reads the visible Gaussians ([`visible_rows`]) of `source` at each of `frames`. Returns for each block of
/// consecutive Gaussians a list with one entry per frame: the visible Gaussians of the block at this frame.
fn unpack(source: &dyn FrameSource, frames: Range<usize>) -> Result<Vec<Vec<Gaussians>>> {
    let wanted = ReadPlan::new(frames.clone());
    let unpack = |range: Range<usize>| {
        let (mut reader, mut state) = (source.open(Ids::Range(range))?, Gaussians::zeros(0, source.info().sh_degree));
        reader.expect(&wanted);
        frames
            .clone()
            .map(|frame| {
                reader.read(frame, Attributes::all(), &mut state)?;
                Ok(state.pick(&visible_rows(&state)))
            })
            .collect()
    };
    blocks(source).map(unpack).collect()
}
