//! A frame stream on standard input as an input: it is packed into a temporary container file, which is then read like
//! any container.

use std::io::{IsTerminal, Stdin};
use std::path::Path;

use super::input::{InputOptions, UntrackedInput, load_cameras, with_cameras};
use crate::error::{Error, Result};
use crate::files::cameras::TimeConvention;
use crate::files::frame_stream::{FrameStream, StreamHeader};
use crate::limits::Limits;
use crate::memory_plan::{Budget, MemoryPlan, ResourceEstimate, Workload};
use crate::model::{Attributes, Rig};
use crate::models::stream::{PREFETCH_FRAMES, frames_per_tile, receive_and_pack};
use crate::models::{InputModel, LinkMode, MemoryProfile, Opened, UnlinkedFrames};
use crate::passes::GAUSSIANS_PER_BLOCK;
use crate::statistics;

/// Name of standard input in messages to the user.
const STANDARD_INPUT: &str = "standard input";

/// Returns the name by which messages call the input at `path`.
pub(super) fn shown_input(path: &Path) -> &Path {
    if path == Path::new("-") { Path::new(STANDARD_INPUT) } else { path }
}

/// Returns the error for a stream with Gaussians but without frames.
pub fn no_frames_error() -> Error {
    Error::input(Path::new(STANDARD_INPUT), "", "at least one frame", "the end of the stream")
}

/// Opens standard input as a stream of frames.
///
/// # Errors
/// Fails if standard input is a terminal or is not a frame stream, or if an option applies to models only or needs an
/// input that can be read again.
pub fn open_stream(options: &InputOptions) -> Result<FrameStream<Stdin>> {
    if options.work.is_some() {
        return Err(Error::usage(
            "--cache: expected an input that can be read again, found a stream on standard input\n  \
             write it to a container first: splatsieve convert - NAME.gseq",
        ));
    }
    if options.frames.is_some() || options.iteration.is_some() {
        return Err(Error::usage("--frames and --iteration are for models, not for a stream"));
    }
    let stdin = std::io::stdin();
    if stdin.is_terminal() {
        return Err(Error::usage("standard input is a terminal; pipe a frame stream into it (format/STREAM.md)"));
    }
    let stream = FrameStream::open(stdin, Path::new(STANDARD_INPUT), options.memory.read_limit())?;
    match options.link == LinkMode::Never && stream.header().is_unlinked {
        true => stream.with_common_indices(),
        false => Ok(stream),
    }
}

/// Loads the cameras that `options` name for a stream, before its frames arrive; `None` if `options` name none. Their
/// times are normalized. [`with_cameras`] corrects them once the times of all frames are known.
///
/// # Errors
/// Fails if the file does not exist or contains no cameras.
pub fn load_stream_cameras(options: &InputOptions) -> Result<Option<Rig>> {
    load_cameras(options, options.cameras.as_deref(), options.times.clone(), TimeConvention::Normalized, None)
}

/// Receives a stream of frames completely. Its Gaussians still have to be linked into tracks (Gaussians followed through
/// frames) if [`is_linked`] says so. `rig`: cameras from [`load_stream_cameras`].
///
/// # Errors
/// Fails if the stream is invalid, or if the memory budget is too small for one block of frames (consecutive frames
/// that the container stores together).
pub fn receive_untracked(
    stream: FrameStream<Stdin>,
    rig: Option<Rig>,
    options: &InputOptions,
) -> Result<UntrackedInput> {
    let opened = match is_linked(stream.header(), options) {
        true => Opened::Unlinked(Box::new(receive_unlinked(stream, options)?)),
        false => Opened::Model(pack_stream(stream, options)?),
    };
    with_cameras(options, opened, rig)
}

/// Packs a stream of frames into a temporary container file and opens this file.
///
/// # Errors
/// Fails if the stream is invalid, or if the memory budget is too small for one block of frames (consecutive frames
/// that the container stores together).
fn pack_stream(stream: FrameStream<Stdin>, options: &InputOptions) -> Result<Box<dyn InputModel>> {
    let mut quota = frame_quota(options, stream.header())?;
    receive_and_pack(stream, &options.scratch_folder(), &options.events, |held| quota.count_arrived(held.len()))
}

/// Returns whether Gaussians of successive frames are linked into tracks (Gaussians followed through frames): if the
/// frames share no Gaussian ids, or if the user asks for it. Never if the user takes the same index to mean the same
/// Gaussian.
pub fn is_linked(header: &StreamHeader, options: &InputOptions) -> bool {
    let is_needed = header.is_unlinked && options.link != LinkMode::Never;
    is_needed || options.link.links_frames_always()
}

/// Receives a stream of frames whose Gaussians are to be linked into tracks (Gaussians followed through frames). Only for
/// streams for which [`is_linked`] returns true.
///
/// # Errors
/// Fails if the stream is invalid, or if the memory budget is too small for one block of frames (consecutive frames
/// that the container stores together).
fn receive_unlinked(stream: FrameStream<Stdin>, options: &InputOptions) -> Result<UnlinkedFrames> {
    let open = options.open_options();
    match stream.header().is_unlinked {
        true => UnlinkedFrames::receive(stream, Path::new(STANDARD_INPUT), &open),
        false => Ok(UnlinkedFrames::from_model(pack_stream(stream, options)?, "linked frame stream", &open)),
    }
}

/// Returns the quota for the frames of a stream with the header `header`: a counter of arriving frames, which fails as
/// soon as more frames have arrived than fit into the memory budget.
///
/// # Errors
/// Fails if the memory budget is too small for one block of frames (consecutive frames that the container stores
/// together).
pub fn frame_quota(options: &InputOptions, header: &StreamHeader) -> Result<FrameQuota> {
    let block = frames_per_tile(header);
    let held = (block + PREFETCH_FRAMES) as u64;
    let no_cameras = Rig { cameras: Vec::new(), views: Vec::new(), background: None, origin: String::new() };
    let work = |frames| Workload::from_stream_header(header, block, &no_cameras, frames);
    let receive =
        |frames| move |work: &Workload, limits: &Limits| vec![receiving_estimate(work, limits, held, None, frames)];
    MemoryPlan::fit_budget(work(0), options.memory, &options.events, receive(0))?;
    Ok(FrameQuota::new(options.memory, |budget, frames| {
        let packed = MemoryPlan::closest(work(frames), budget, |_, _| Vec::new()).peak_bytes();
        packed.max(MemoryPlan::closest(work(0), budget, receive(frames)).peak_bytes())
    }))
}

/// Counter of the frames of a stream that have arrived, with their maximum number within the memory budget. It is
/// needed because the length of a stream is unknown until its end.
#[derive(Debug)]
pub struct FrameQuota {
    /// Number of frames that have arrived so far.
    arrived: u64,
    /// Maximum number of frames for which the memory budget suffices.
    pub most: u64,
    /// Advice to the user, shown in the error if more frames arrive than fit.
    hint: String,
    budget: Budget,
}

impl FrameQuota {
    /// Creates a counter of arriving frames, and finds the maximum number of frames with which a run stays within
    /// `budget`, the memory budget. `peak(limit, frames)` returns the memory in bytes that a run takes for a stream of
    /// `frames` frames if its budget is `limit` bytes.
    pub fn new(budget: Budget, peak: impl Fn(u64, u64) -> u64) -> FrameQuota {
        let bytes = budget.limit();
        // Finds the number bit by bit; a stream has fewer than 2^32 frames.
        let most = (0..32).rev().fold(0, |most, bit| {
            let more = most | 1 << bit;
            if peak(bytes, more) <= bytes { more } else { most }
        });
        let enough = (2 * most).max(1000);
        let least = peak(0, enough).div_ceil(1 << 20);
        let hint = format!("use --memory {least}MiB, which is enough for {enough} frames, or send fewer frames");
        FrameQuota { arrived: 0, most, hint, budget }
    }

    /// Adds `frames` to the number of frames that have arrived, and checks the new number.
    ///
    /// # Errors
    /// Fails if more frames have arrived than fit into the memory budget.
    pub fn count_arrived(&mut self, frames: usize) -> Result<()> {
        self.arrived += frames as u64;
        if self.arrived <= self.most {
            return Ok(());
        }
        let expected = format!("at most {} frames within the memory budget ({})", self.most, self.budget.text());
        let found = format!("{} frames, and the stream continues", self.arrived);
        Err(Error::input(Path::new(STANDARD_INPUT), format!("frame {}", self.most), expected, found).hint(&self.hint))
    }

    /// Returns the number of frames that have arrived so far.
    pub fn arrived(&self) -> u64 {
        self.arrived
    }
}

/// Bytes of memory per frame while a stream is packed: the frame's time stamp and, if statistics are computed, its
/// number of Gaussians alive (opacity ≥ alpha_min). Both are counted twice, because they are in lists that grow by
/// being copied to twice their length.
const PER_FRAME: u64 = 2 * (8 + 4);

/// Estimates the memory of packing a stream of `frames` frames, of which `held` are in memory at a time. `measuring`
/// states what else is computed as frames arrive:
/// - `None`: nothing.
/// - `Some(false)`: statistics.
/// - `Some(true)`: statistics, and contributions to rendered views.
pub fn receiving_estimate(
    work: &Workload,
    limits: &Limits,
    held: u64,
    measuring: Option<bool>,
    frames: u64,
) -> ResourceEstimate {
    let whole = work.state_bytes(Attributes::all());
    let mut per_gaussian = vec![
        ("frames", held * work.state_bytes(work.varying)),
        ("constant columns", whole - work.state_bytes(work.varying)),
    ];
    let mut fixed = work.write_buffers();
    fixed.push(("times", PER_FRAME * frames));
    if let Some(visible) = measuring {
        per_gaussian.push(("accumulators", statistics::BYTES_PER_GAUSSIAN as u64));
        fixed.push(("blocks", work.threads * GAUSSIANS_PER_BLOCK as u64 * whole));
        if visible {
            let nothing_held = Workload { input: MemoryProfile { frame_block: 0, ..work.input }, ..*work };
            let (more, fixed_parts) =
                nothing_held.view_pass_memory(limits, Attributes::all().difference(Attributes::SH), 12);
            per_gaussian.extend(more);
            fixed.extend(fixed_parts);
        }
    }
    ResourceEstimate { stage: "receive", reads: 0.0, seconds: 0.0, per_gaussian, fixed }
}
