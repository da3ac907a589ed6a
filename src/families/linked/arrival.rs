//! A stream of frames that do not know one another (format/STREAM.md, version 2): kept as files, then linked like files.
//!
//! Memory while it arrives: a frame. On the disk, in a folder without a name, every frame as PLY.

use std::io::Read;
use std::path::Path;

use super::Linked;
use crate::emit::atomic::ScratchFolder;
use crate::emit::ply::write_inria;
use crate::error::{Error, Result};
use crate::ingest::frame_stream::FrameStream;
use crate::ingest::ply_frames::PlyFrames;
use crate::model::Gaussians;
use crate::stream::Progress;

impl Linked {
    /// Receives all of a stream, called `name`, and links it, and lives that are one if `joins`, with scratch files in
    /// `scratch`.
    ///
    /// # Errors
    /// What is wrong with the stream; none but the end of it; a failed write.
    pub fn receive(mut stream: FrameStream<impl Read>, name: &Path, joins: bool, scratch: &Path) -> Result<Linked> {
        let folder = ScratchFolder::new(scratch)?;
        let (mut state, mut times) = (Gaussians::zeros(0, stream.header().sh_degree), Vec::new());
        let progress = Progress::counting("receive", "frames");
        while let Some(time) = stream.next_frame(&mut state)? {
            write_inria(&state, &[], &folder.path().join(format!("frame_{:05}.ply", times.len())))?;
            times.push(time);
            progress.advance(1);
        }
        drop(progress);
        if times.is_empty() {
            return Err(Error::input(name, "", "at least one frame", "the end of the stream"));
        }
        let frames = PlyFrames::open(folder.path())?;
        let linked = Linked::open(frames, "the stream does not say which Gaussian is which", joins, scratch)?;
        Ok(Linked { info: linked.info.with_times(times)?, arrived: Some(folder), ..linked })
    }
}
