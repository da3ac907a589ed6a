//! Files of web viewers that hold one frame each (`.sog`, `.spz`, `.splat`, `.glb`, `.compressed.ply`): a single file,
//! or a folder with one file per frame.
//!
//! The files are decoded into PLY files in a temporary folder and opened there like PLY frames, so every command that
//! reads PLY frames reads them too.

use std::fs;
use std::path::Path;

use super::ply_sequence::open_frames;
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::ScratchFolder;
use crate::files::compressed_ply::{self, read_compressed_ply};
use crate::files::glb;
use crate::files::glb::read::read_glb;
use crate::files::names::has_ending;
use crate::files::ply::write::write_inria;
use crate::files::ply_frames::{FrameFiles, PlyFrames};
use crate::files::sog::read::read_sog;
use crate::files::splat::read_splat;
use crate::files::spz;
use crate::files::spz::read::read_spz;
use crate::limits::ReadLimit;
use crate::model::Gaussians;
use crate::models::input_model::{FoundInput, OpenOptions};
use crate::models::opened::{InputFormat, Opened};
use crate::models::unpacked::{Original, Unpacked};

/// File format that holds one frame.
struct StillFormat {
    /// Ending of file names, with its dot.
    ending: &'static str,
    /// Name of the format, shown to users.
    kind: &'static str,
    /// Returns whether the path is one frame of this format: a file, or for `.sog` also a folder with the unpacked
    /// content of a `.sog` file.
    recognizes: fn(&FoundInput) -> bool,
    /// Reads the Gaussians of a file.
    read: fn(&Path, ReadLimit) -> Result<Gaussians>,
}

/// File formats that this module reads. A file holds one frame.
const FORMATS: [StillFormat; 5] = [
    StillFormat {
        ending: ".sog",
        kind: "SOG frames",
        recognizes: |found| match found.is_folder {
            true => found.path.join("meta.json").is_file() && found.path.join("quats.webp").is_file(),
            false => has_ending(found.path, ".sog"),
        },
        read: read_sog,
    },
    StillFormat {
        ending: ".spz",
        kind: "SPZ frames",
        recognizes: |found| found.is_file_of(&spz::MAGIC.to_le_bytes(), "spz"),
        read: read_spz,
    },
    StillFormat {
        ending: ".splat",
        kind: "splat frames",
        recognizes: |found| !found.is_folder && has_ending(found.path, ".splat"),
        read: read_splat,
    },
    StillFormat {
        ending: ".glb",
        kind: "glTF frames",
        recognizes: |found| found.is_file_of(&glb::MAGIC.to_le_bytes(), "glb"),
        read: read_glb,
    },
    StillFormat {
        ending: ".compressed.ply",
        kind: "compressed PLY frames",
        recognizes: |found| has_packed_positions(found),
        read: read_compressed_ply,
    },
];

/// Returns whether the file is a compressed PLY: its header has an element `chunk` first, or a packed property near its
/// start.
fn has_packed_positions(input: &FoundInput) -> bool {
    let has = |text: &str| input.head.windows(text.len()).any(|part| part == text.as_bytes());
    !input.is_folder
        && input.head.starts_with(b"ply")
        && (has("\nelement chunk ") || has(compressed_ply::MARKER_PROPERTY))
}

/// Format of the files of web viewers: recognizes and opens one file, or a folder with one file per frame.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| format_of(found).is_some(),
    open: |path, options| {
        let found = FoundInput::new(path, options.memory)?;
        let format = format_of(&found).ok_or_else(|| Error::internal("the input has changed its format"))?;
        open(path, format, options)
    },
};

/// Returns the file format of `input`, which is a file or a folder of files; `None` if the format is none of
/// [`FORMATS`].
fn format_of(input: &FoundInput) -> Option<&'static StillFormat> {
    let holds_frames = |format: &StillFormat| {
        let entries = fs::read_dir(input.path).ok().filter(|_| input.is_folder);
        entries.is_some_and(|mut entries| {
            entries.any(|entry| entry.is_ok_and(|entry| is_frame(&entry.path(), format.ending)))
        })
    };
    FORMATS.iter().find(|format| (format.recognizes)(input) || holds_frames(format))
}

/// Returns whether `path` is named like a frame of the format with the ending `ending`, and is not hidden.
fn is_frame(path: &Path, ending: &str) -> bool {
    has_ending(path, ending) && !path.file_name().unwrap_or_default().as_encoded_bytes().starts_with(b".")
}

/// Decodes the file at `path`, or the files in the folder at `path`, and opens the decoded frames. Fails if a file
/// cannot be decoded or if the SH degree differs between frames.
fn open(path: &Path, format: &StillFormat, options: &OpenOptions) -> Result<Opened> {
    options.refuse_for(path)?;
    let is_sequence = path.is_dir() && !path.join("meta.json").is_file();
    let paths = match is_sequence {
        true => FrameFiles::list(path, |path| is_frame(path, format.ending))?.checked(path, options.allow_gaps)?,
        false => vec![path.to_owned()],
    };
    let scratch = ScratchFolder::new(&options.scratch())?;
    let mut first: Option<usize> = None;
    for (frame, file) in paths.iter().enumerate() {
        let gaussians = (format.read)(file, options.memory)?;
        let expected = *first.get_or_insert(gaussians.sh_degree());
        if gaussians.sh_degree() != expected {
            let expected = format!("SH degree {expected}, as in {}", paths[0].shown());
            return Err(Error::input(file, "", expected, gaussians.sh_degree().to_string())
                .hint("every frame must have the same SH degree"));
        }
        write_inria(&gaussians, &[], &scratch.path().join(format!("frame_{frame:05}.ply")))?;
    }
    let frames = PlyFrames::open(scratch.path(), &options.ply())?.with_shown_paths(paths.clone());
    let unpacked = Unpacked { _scratch: scratch, kind: format.kind, original: Original::Frames(paths) };
    Ok(match open_frames(frames, path, options)? {
        Opened::Model(model) => Opened::Model(unpacked.into_model(model)),
        Opened::Unlinked(frames) => Opened::Unlinked(Box::new(frames.with_original(unpacked))),
    })
}
