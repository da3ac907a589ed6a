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
use crate::files::atomic::ScratchFolder;
use crate::files::container::Container;
use crate::files::frame_stream::{FrameStream, StreamHeader};
use crate::model::Gaussians;
use crate::models::input_model::InputModel;
use crate::models::unpacked::{Original, Unpacked};
use crate::outputs::container::{ContainerWriter, FRAME_BLOCK, Packing};
use crate::passes::FramesInMemory;
use crate::progress::Events;

/// Maximum bytes of received frames that are kept in memory together; at least one frame is kept.
const HELD_BYTES: u64 = 64 << 20;
/// Maximum number of frames that the reading thread has read ahead and that are not yet packed.
pub const PREFETCH_FRAMES: usize = 2;
/// Compression of the temporary container. It is the same as in the command `convert`, so that a stream and the
/// container into which `convert` writes it have the same digest (hash of the input).
const COMPRESSION: Compression = Compression::Zstd(1);

/// Receives a stream, packs it into a temporary container in `folder`, and returns the received stream as a model, whose
/// frames are read from this container. Calls `take` with the frames of each block of consecutive frames, in order.
///
/// # Errors
/// Fails if the stream is damaged or a write fails.
pub fn receive_and_pack(
    stream: FrameStream<impl Read + Send + 'static>,
    folder: &Path,
    events: &Events,
    take: impl FnMut(&FramesInMemory) -> Result<()>,
) -> Result<Box<dyn InputModel>> {
    let scratch = ScratchFolder::new(folder)?;
    let path = scratch.path().join("frames.gseq");
    let received = pack_stream(stream, &path, COMPRESSION, events, take)?;
    let original = Original::Stamped(received);
    Ok(Unpacked { _scratch: scratch, kind: "frame stream", original }.into_model(Box::new(Container::open(&path)?)))
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
