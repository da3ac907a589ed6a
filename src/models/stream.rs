//! Frame stream (format/STREAM.md) as a model format: the frames are packed into a temporary container as they arrive,
//! then read from that container.
//!
//! Frames are encoded in blocks of F consecutive frames. A thread reads ahead meanwhile. Memory, with N Gaussians and b
//! bytes of time-varying attributes per Gaussian:
//!
//! - N·b·F bytes for the frames of a block. F is the number of frames that fit into 64 MiB, but at least 1 (a single
//!   frame may be larger) and at most [`FRAME_BLOCK`].
//! - 2·N·b bytes for two frames that were read ahead.
//! - The constant attributes.
//! - 24 bytes per received frame.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;
use std::thread;

use crossbeam_channel::bounded;
use gseq::Compression;

use crate::error::{Error, Result};
use crate::files::atomic::ScratchFile;
use crate::files::container::Container;
use crate::files::frame_stream::{FrameStream, StreamHeader};
use crate::model::Gaussians;
use crate::models::input_model::{InputModel, MemoryProfile, TimeOrigin};
use crate::outputs::container::{ContainerWriter, FRAME_BLOCK, Packing};
use crate::passes::FramesInMemory;
use crate::progress::Events;
use crate::source::FrameSource;

/// Maximum bytes of received frames that are kept in memory together; at least one frame is kept.
const HELD_BYTES: u64 = 64 << 20;
/// Maximum number of frames that the reading thread has read ahead and that are not yet packed.
pub const PREFETCH_FRAMES: usize = 2;
/// Compression of the temporary container. It is the same as in the command `convert`, so that a stream and the
/// container into which `convert` writes it have the same digest (hash of the input).
const COMPRESSION: Compression = Compression::Zstd(1);

/// Frame stream that was received completely.
pub struct ReceivedStream {
    /// Temporary container of the received frames.
    container: Container,
    /// Number of bytes received from the stream.
    received: u64,
    /// Owner of the container's file; deletes the file when it is dropped.
    _scratch: ScratchFile,
}

impl ReceivedStream {
    /// Receives a stream, packs it into a temporary container in `folder`, and returns the received stream, whose
    /// frames are read from this container. Calls `take` with the frames of each block of consecutive frames, in order.
    ///
    /// # Errors
    /// Fails if the stream is damaged or a write fails.
    pub fn receive_and_pack(
        stream: FrameStream<impl Read + Send + 'static>,
        folder: &Path,
        events: &Events,
        take: impl FnMut(&FramesInMemory) -> Result<()>,
    ) -> Result<ReceivedStream> {
        let scratch = ScratchFile::new(folder)?;
        let received = pack_stream(stream, scratch.path(), COMPRESSION, events, take)?;
        let container = Container::open(scratch.path())?;
        Ok(ReceivedStream { container, received, _scratch: scratch })
    }
}

impl InputModel for ReceivedStream {
    fn kind(&self) -> &'static str {
        "frame stream"
    }

    fn source(&self) -> &dyn FrameSource {
        &self.container
    }

    fn digest(&self) -> Result<String> {
        InputModel::digest(&self.container)
    }

    fn bytes(&self) -> Result<u64> {
        Ok(self.received)
    }

    fn stored_bytes(&self) -> Result<u64> {
        self.container.bytes()
    }

    fn may_be_linked(&self) -> bool {
        true
    }

    fn has_explicit_frames(&self) -> bool {
        true
    }

    fn memory_profile(&self) -> MemoryProfile {
        self.container.memory_profile()
    }

    fn hold_decoded(&self) {
        InputModel::hold_decoded(&self.container);
    }

    fn timing(&self) -> TimeOrigin {
        TimeOrigin::Stamped
    }

    fn with_times(self: Box<Self>, _: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Err(Error::usage("a frame stream contains the times of its frames; no other times can be given"))
    }
}

/// Receives a stream, writes its frames to the container `path` with the settings `packing`, and returns the number of
/// bytes received. Calls `take` with the frames of each block of consecutive frames, in order. Fails if the stream is
/// damaged or a write fails.
pub fn pack_stream(
    mut stream: FrameStream<impl Read + Send + 'static>,
    path: &Path,
    packing: impl Into<Packing>,
    events: &Events,
    mut take: impl FnMut(&FramesInMemory) -> Result<()>,
) -> Result<u64> {
    let StreamHeader { count, sh_degree, varying, .. } = *stream.header();
    let block = frames_per_tile(stream.header());
    let mut writer = ContainerWriter::create(path, count, sh_degree, block, packing, BTreeMap::new())?;
    let mut held = FramesInMemory::new(count, sh_degree, varying, stream.take_constant_attributes());
    let progress = events.counting_task("receive", "frames");
    let mut flush = |held: &mut FramesInMemory| -> Result<Vec<Gaussians>> {
        writer.append_block(held, 0..held.len(), |_| ())?;
        take(held)?;
        Ok(held.drain().collect())
    };

    // A fixed set of frame buffers circulates: empty ones go to the reading thread, filled ones to the packer.
    let (to_fill, empty) = bounded(block + PREFETCH_FRAMES);
    for _ in 0..block + PREFETCH_FRAMES {
        let _ = to_fill.send(Gaussians::zeros(0, sh_degree));
    }
    let (filled, arrived) = bounded(PREFETCH_FRAMES);
    // On failure the reading thread is not joined: it may be waiting for a program that writes no more. It ends at its
    // next frame.
    let reader = thread::spawn(move || {
        while let Ok(mut state) = empty.recv() {
            let frame = stream.next_frame(&mut state).map(|time| time.map(|time| (time, state)));
            let last = !matches!(frame, Ok(Some(_)));
            if filled.send(frame).is_err() || last {
                break;
            }
        }
        stream.received_bytes()
    });
    for frame in &arrived {
        let Some((time, state)) = frame? else { break };
        held.push(time, state);
        progress.advance(1);
        if held.len() == block {
            for state in flush(&mut held)? {
                let _ = to_fill.send(state);
            }
        }
    }
    if !held.is_empty() {
        flush(&mut held)?;
    }
    writer.finish()?;
    reader.join().map_err(|_| Error::internal("the thread that reads standard input failed"))
}

/// Returns the number of frames per tile of the container: as many as fit into [`HELD_BYTES`], between 1 and
/// [`FRAME_BLOCK`]. It depends only on the header of the stream, so the same stream always gives the same container.
pub fn frames_per_tile(header: &StreamHeader) -> usize {
    (HELD_BYTES / header.frame_bytes().max(1)).clamp(1, FRAME_BLOCK as u64) as usize
}
