//! A frame stream (format/STREAM.md) as a family: packed into a container as it arrives, then read from that.
//!
//! Memory, with b the bytes of one Gaussian's varying columns: frames held N·b·F, at most 64 MiB or one frame;
//! two more on their way in; the constant columns; 24 bytes per frame that has arrived. A thread reads ahead while the frames before are encoded.

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
use crate::models::input_model::{InputModel, MemoryProfile, Timing};
use crate::outputs::container::{ContainerWriter, FRAME_BLOCK, Packing};
use crate::passes::HeldFrames;
use crate::progress::Events;
use crate::source::FrameSource;

/// Most bytes of frames that are held together, if that is one frame at least.
const HELD_BYTES: u64 = 64 << 20;
/// Frames that may be on their way from the reading thread.
pub const AHEAD: usize = 2;
/// How the scratch container is stored: as `pack` does, so that the digest of the input is the same.
const COMPRESSION: Compression = Compression::Zstd(1);

/// What a stream has become.
pub struct Streamed {
    /// Its frames.
    container: Container,
    /// Bytes that arrived.
    received: u64,
    /// Keeps the container's file until nobody reads it any more.
    _scratch: ScratchFile,
}

impl Streamed {
    /// Packs a stream into a scratch file in `folder`. `take` sees the frames of every frame block, in order.
    ///
    /// # Errors
    /// What is wrong with the stream; a failed write.
    pub fn receive(
        stream: FrameStream<impl Read + Send + 'static>,
        folder: &Path,
        events: &Events,
        take: impl FnMut(&HeldFrames) -> Result<()>,
    ) -> Result<Streamed> {
        let scratch = ScratchFile::new(folder)?;
        let received = pack_stream(stream, scratch.path(), COMPRESSION, events, take)?;
        let container = Container::open(scratch.path())?;
        Ok(Streamed { container, received, _scratch: scratch })
    }
}

impl InputModel for Streamed {
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

    fn residence(&self) -> MemoryProfile {
        self.container.residence()
    }

    fn hold_decoded(&self) {
        InputModel::hold_decoded(&self.container);
    }

    fn timing(&self) -> Timing {
        Timing::Stamped
    }

    fn with_times(self: Box<Self>, _: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Err(Error::usage("a frame stream says itself when its frames are"))
    }
}

/// Writes a stream to the container `path`; gives the number of bytes that arrived. `take` sees the frames
/// of every frame block, in order.
pub fn pack_stream(
    mut stream: FrameStream<impl Read + Send + 'static>,
    path: &Path,
    packing: impl Into<Packing>,
    events: &Events,
    mut take: impl FnMut(&HeldFrames) -> Result<()>,
) -> Result<u64> {
    let StreamHeader { count, sh_degree, varying, .. } = *stream.header();
    let block = frame_block(stream.header());
    let mut writer = ContainerWriter::create(path, count, sh_degree, block, packing, BTreeMap::new())?;
    let mut held = HeldFrames::new(count, sh_degree, varying, stream.take_constant());
    let progress = events.counting_task("receive", "frames");
    let mut put = |held: &mut HeldFrames| -> Result<Vec<Gaussians>> {
        writer.append(held, 0..held.len(), |_| ())?;
        take(held)?;
        Ok(held.drain().collect())
    };

    // Every buffer there will ever be goes round: empty to the reader, filled to the packer.
    let (to_fill, empty) = bounded(block + AHEAD);
    for _ in 0..block + AHEAD {
        let _ = to_fill.send(Gaussians::zeros(0, sh_degree));
    }
    let (filled, arrived) = bounded(AHEAD);
    // Not joined on failure: it may wait for a program that writes nothing more, and ends at its next frame.
    let reader = thread::spawn(move || {
        while let Ok(mut state) = empty.recv() {
            let frame = stream.next_frame(&mut state).map(|time| time.map(|time| (time, state)));
            let last = !matches!(frame, Ok(Some(_)));
            if filled.send(frame).is_err() || last {
                break;
            }
        }
        stream.received()
    });
    for frame in &arrived {
        let Some((time, state)) = frame? else { break };
        held.push(time, state);
        progress.advance(1);
        if held.len() == block {
            for state in put(&mut held)? {
                let _ = to_fill.send(state);
            }
        }
    }
    if !held.is_empty() {
        put(&mut held)?;
    }
    writer.finish()?;
    reader.join().map_err(|_| Error::internal("the thread that reads standard input failed"))
}

/// Frames that are held together, which the container's tiles are made of: as many as fit [`HELD_BYTES`], from 1
/// to [`FRAME_BLOCK`]. The header alone decides, so that the bytes of the container depend on nothing else.
pub fn frame_block(header: &StreamHeader) -> usize {
    (HELD_BYTES / header.frame_bytes().max(1)).clamp(1, FRAME_BLOCK as u64) as usize
}
