//! Frames that came another way than as files, kept as files and then linked like files: a stream of frames that do not know
//! one another (format/STREAM.md, version 2), or what says which Gaussian is which and is linked all the same.
//!
//! Memory while they arrive: a frame, and what the readers of a container keep of the frames that are decoded together. On
//! the disk, in a folder without a name, every frame as PLY.

use std::io::Read;
use std::path::Path;

use super::{Arrived, Linked};
use crate::emit::atomic::ScratchFolder;
use crate::emit::ply::write_inria;
use crate::error::{Error, Result};
use crate::families::Family;
use crate::families::trajectories::state_bytes;
use crate::ingest::frame_stream::FrameStream;
use crate::ingest::ply_frames::PlyFrames;
use crate::model::{Columns, Gaussians, opacity};
use crate::source::{BlockReader, Ids, Wanted};
use crate::stream::{Frames, Progress};

/// Of a lower opacity no picture shows anything.
const LEAST_OPACITY: f64 = 1.0 / 255.0;
/// Most bytes of frames that are decoded together and kept, if that is one frame at least.
const HELD_BYTES: u64 = 64 << 20;

/// Files of frames that are arriving, and their times.
struct Arriving {
    folder: ScratchFolder,
    times: Vec<f64>,
    /// Bytes of what they are read from, and of the largest as it is read.
    beside: u64,
    largest: u64,
}

impl Arriving {
    fn new(scratch: &Path, beside: u64) -> Result<Arriving> {
        Ok(Arriving { folder: ScratchFolder::new(scratch)?, times: Vec::new(), beside, largest: 0 })
    }

    fn push(&mut self, time: f64, state: &Gaussians) -> Result<()> {
        write_inria(state, &[], &self.folder.path().join(format!("frame_{:05}.ply", self.times.len())))?;
        self.times.push(time);
        self.largest = self.largest.max(state.len() as u64 * state_bytes(state.sh_degree(), Columns::all()));
        Ok(())
    }

    /// Links them: a `kind` of input of `bytes`.
    fn link(self, kind: &'static str, bytes: u64, why: &str, joins: bool, scratch: &Path) -> Result<Linked> {
        let linked = Linked::open(PlyFrames::open(self.folder.path())?, why, joins, scratch)?;
        let memory = self.beside + 2 * self.largest;
        let arrived = Some(Arrived { _folder: self.folder, kind, bytes, memory });
        Ok(Linked { info: linked.info.with_times(self.times)?, arrived, ..linked })
    }
}

impl Linked {
    /// Receives all of a stream, called `name`, and links it, and lives that are one if `joins`, with scratch files in
    /// `scratch`.
    ///
    /// # Errors
    /// What is wrong with the stream; none but the end of it; a failed write.
    pub fn receive(mut stream: FrameStream<impl Read>, name: &Path, joins: bool, scratch: &Path) -> Result<Linked> {
        let mut arriving = Arriving::new(scratch, 0)?;
        let mut state = Gaussians::zeros(0, stream.header().sh_degree);
        let progress = Progress::counting("receive", "frames");
        while let Some(time) = stream.next_frame(&mut state)? {
            arriving.push(time, &state)?;
            progress.advance(1);
        }
        drop(progress);
        if arriving.times.is_empty() {
            return Err(Error::input(name, "", "at least one frame", "the end of the stream"));
        }
        let why = "the stream does not say which Gaussian is which";
        arriving.link("linked frame stream", stream.received(), why, joins, scratch)
    }

    /// Links what `input` shows, which says itself which Gaussian is which, and lives that are one if `joins`: in each frame
    /// those that any picture may show. `kind` says what that is.
    ///
    /// # Errors
    /// A frame that cannot be read; a failed write.
    pub fn anew(input: &dyn Family, kind: &'static str, joins: bool, scratch: &Path) -> Result<Linked> {
        let source = input.source();
        let info = source.info();
        let frame_bytes = info.count as u64 * state_bytes(info.sh_degree, info.varying);
        let held = (HELD_BYTES / frame_bytes.max(1)).max(1);
        let mut arriving = Arriving::new(scratch, reading(input, held))?;
        let wanted = Wanted::every().holding(held as usize);
        let mut frames = Frames::open(source, Ids::Range(0..info.count), Columns::all(), &wanted)?;
        let mut state = frames.state();
        let progress = Progress::new("unpack", "frames", info.times.len() as u64);
        for (frame, &time) in info.times.iter().enumerate() {
            frames.read(frame, Columns::all(), &mut state)?;
            let is_seen = |&row: &u32| opacity(state.opacity_logit.plane(0)[row as usize]) >= LEAST_OPACITY;
            let seen: Vec<u32> = (0..info.count as u32).filter(is_seen).collect();
            arriving.push(time, &state.pick(&seen))?;
            progress.advance(1);
        }
        drop((progress, frames, state));
        arriving.link(kind, input.bytes()?, "as asked", joins, scratch)
    }
}

/// Bytes of reading `input` with `held` frames that are decoded together: readers, one frame, those that are held, and
/// what decodes them.
fn reading(input: &dyn Family, held: u64) -> u64 {
    let (residence, info) = (input.residence(), input.source().info());
    let [whole, varying] = [Columns::all(), info.varying].map(|columns| state_bytes(info.sh_degree, columns));
    let count = info.count as u64;
    let tile = residence.gaussian_block.min(count) * residence.frame_block * state_bytes(info.sh_degree, Columns::SH);
    let held = held.min(residence.frame_block) + 2;
    count * (residence.reader + whole + held * varying) + 3 * rayon::current_num_threads() as u64 * tile
}
