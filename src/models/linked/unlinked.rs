//! Frames whose Gaussians have to be linked into tracks (Gaussians followed through frames) before they can be used:
//! the same index does not mean the same Gaussian in every frame, or the user wants all frames to be linked.
//!
//! Opening such frames computes nothing. [`UnlinkedFrames::link`] does the work; in a compression it is the stage
//! `track`.

use std::io::Read;
use std::path::{Path, PathBuf};

use super::LinkedFrames;
use super::arrival::{ReceivedFrames, receive, unpack_visible};
use crate::error::Result;
use crate::files::frame_stream::FrameStream;
use crate::files::ply::PlyOptions;
use crate::files::ply_frames::PlyFrames;
use crate::models::input_model::{InputModel, LinkMode, OpenOptions, TimeOrigin};
use crate::models::unpacked::Unpacked;

/// Opened frames whose Gaussians are to be linked into tracks (Gaussians followed through frames).
pub struct UnlinkedFrames {
    frames: Frames,
    /// Name of the frames in messages to the user.
    name: PathBuf,
    /// Reason for linking, for messages to the user.
    why: String,
    /// Whether tracks that seem to be the same Gaussian are joined.
    joins: bool,
    options: PlyOptions,
    /// Original of frames that were unpacked from other files; `None` if the user gave PLY files or a stream.
    original: Option<Unpacked>,
}

/// Where frames that are to be linked come from.
enum Frames {
    /// PLY files of the user, one per frame.
    Files(PlyFrames),
    /// Frames of a stream, which were received completely.
    Received {
        frames: ReceivedFrames,
        /// Number of bytes of the stream.
        bytes: u64,
    },
    /// Frames of an input that identifies Gaussians across frames, which the user wants to ignore.
    Model {
        input: Box<dyn InputModel>,
        /// Name of the format of the input after linking, shown to users.
        kind: &'static str,
    },
}

impl UnlinkedFrames {
    /// Opens the PLY files `frames`, which messages call `name`. `why` is the reason for linking them.
    pub(in crate::models) fn from_files(
        frames: PlyFrames,
        name: &Path,
        why: String,
        options: &OpenOptions,
    ) -> UnlinkedFrames {
        UnlinkedFrames::new(Frames::Files(frames), name, why, options)
    }

    /// Returns the frames of `input`, to be linked because the user wants it. `kind` is the name of their format after
    /// linking.
    pub fn from_model(input: Box<dyn InputModel>, kind: &'static str, options: &OpenOptions) -> UnlinkedFrames {
        UnlinkedFrames::new(Frames::Model { input, kind }, Path::new(kind), LinkMode::REQUESTED.to_owned(), options)
    }

    /// Receives a whole stream that does not identify Gaussians and that messages call `name`.
    ///
    /// # Errors
    /// Fails if the stream is damaged or has no frames, or if a write fails.
    pub fn receive(stream: FrameStream<impl Read>, name: &Path, options: &OpenOptions) -> Result<UnlinkedFrames> {
        let why = "the stream does not say which Gaussian is which".to_owned();
        let (frames, bytes) = receive(stream, name, &options.ply())?;
        Ok(UnlinkedFrames::new(Frames::Received { frames, bytes }, name, why, options))
    }

    fn new(frames: Frames, name: &Path, why: String, options: &OpenOptions) -> UnlinkedFrames {
        let joins = options.link.joins_tracks();
        UnlinkedFrames { frames, name: name.to_owned(), why, joins, options: options.ply(), original: None }
    }

    /// Returns the frames as those of the input that was unpacked into `original`.
    pub(in crate::models) fn with_original(self, original: Unpacked) -> UnlinkedFrames {
        UnlinkedFrames { original: Some(original), ..self }
    }

    /// Returns the reason for linking, for messages to the user.
    pub fn why(&self) -> &str {
        &self.why
    }

    /// Returns the time stamps of the frames.
    pub fn times(&self) -> Vec<f64> {
        match &self.frames {
            Frames::Files(frames) => frames.times(),
            Frames::Received { frames, .. } => frames.times().to_vec(),
            Frames::Model { input, .. } => input.source().info().times.clone(),
        }
    }

    /// Returns where the time stamps of the frames come from.
    pub fn timing(&self) -> TimeOrigin {
        match &self.frames {
            Frames::Files(_) => TimeOrigin::Numbered,
            Frames::Received { .. } | Frames::Model { .. } => TimeOrigin::Stamped,
        }
    }

    /// Links the Gaussians of the frames into tracks (Gaussians followed through frames), and packs the tracks into a
    /// temporary container. Renders some frames to check whether tracks that seem to be the same Gaussian may be
    /// joined, and whether nearly constant attributes may be made constant.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or has changed since it was opened, if linking needs more memory than the
    /// options allow, or if a write fails.
    pub fn link(self) -> Result<Box<dyn InputModel>> {
        let UnlinkedFrames { frames, name, why, joins, options, original } = self;
        let link = |frames, unpacking_bytes| -> Result<Box<dyn InputModel>> {
            Ok(Box::new(LinkedFrames::new(frames, &name, &why, joins, unpacking_bytes, &options)?))
        };
        let linked = match frames {
            Frames::Files(frames) => link(frames, 0)?,
            Frames::Received { frames, bytes } => frames.link("linked frame stream", bytes, link, &options)?,
            Frames::Model { input, kind } => {
                unpack_visible(&*input, &options)?.link(kind, input.bytes()?, link, &options)?
            }
        };
        Ok(match original {
            Some(original) => original.into_model(linked),
            None => linked,
        })
    }
}
