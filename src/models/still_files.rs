//! Files of web viewers that hold one frame each (`.sog`, `.spz`, `.splat`, `.glb`, `.compressed.ply`): a single file,
//! or a folder with one file per frame.
//!
//! The files are decoded into PLY files in a temporary folder and opened there like PLY frames, so every command that
//! reads PLY frames reads them too.

use std::fs;
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::ply_sequence::open_frames;
use super::size::bytes_read_for;
use crate::archive::ArchiveContent;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::ScratchFolder;
use crate::files::compressed_ply::{self, read_compressed_ply};
use crate::files::digest::hash_file;
use crate::files::glb;
use crate::files::glb::read::read_glb;
use crate::files::names::has_ending;
use crate::files::ply::write::write_inria;
use crate::files::ply_frames::{FrameFiles, PlyFrames};
use crate::files::sog::read::read_sog;
use crate::files::splat::read_splat;
use crate::files::spz;
use crate::files::spz::read::read_spz;
use crate::limits::{Limits, ReadLimit};
use crate::model::Gaussians;
use crate::models::input_model::{FoundInput, InputModel, MemoryProfile, OpenOptions, TimeOrigin};
use crate::models::opened::{FrameFormat, Opened};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::source::FrameSource;

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
pub(super) const ENTRY: FrameFormat = FrameFormat {
    recognizes: |found| format_of(found).is_some(),
    open: |path, options| {
        let found = FoundInput::new(path, options.memory)?;
        let format = format_of(&found).ok_or_else(|| Error::internal("the input has changed its format"))?;
        StillFiles::open(path, format, options)
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

/// Opened files of web viewers, which were decoded into PLY files in a temporary folder.
struct StillFiles {
    /// Frames opened from the files in the folder `scratch`.
    inner: Box<dyn InputModel>,
    scratch: ScratchFolder,
    paths: Vec<PathBuf>,
    kind: &'static str,
}

impl StillFiles {
    /// Decodes the file at `path`, or the files in the folder at `path`, and opens the decoded frames. Fails if a file
    /// cannot be decoded or if the SH degree differs between frames.
    fn open(path: &Path, format: &'static StillFormat, options: &OpenOptions) -> Result<Opened> {
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
        let opened = open_frames(frames, path, options)?;
        Ok(opened.wrapped(|inner| Box::new(StillFiles { inner, scratch, paths, kind: format.kind })))
    }
}

impl InputModel for StillFiles {
    fn kind(&self) -> &'static str {
        self.kind
    }

    fn source(&self) -> &dyn FrameSource {
        self.inner.source()
    }

    fn digest(&self) -> Result<String> {
        let mut hash = Xxh3::new();
        for path in files_of(&self.paths)? {
            hash.update(path.file_name().unwrap_or_default().as_encoded_bytes());
            hash_file(&path, &mut hash)?;
        }
        Ok(format!("{:032x}", hash.digest128()))
    }

    fn bytes(&self) -> Result<u64> {
        bytes_read_for(files_of(&self.paths)?.iter().map(PathBuf::as_path))
    }

    fn stored_bytes(&self) -> Result<u64> {
        self.inner.stored_bytes()
    }

    fn memory_profile(&self) -> MemoryProfile {
        self.inner.memory_profile()
    }

    fn hold_decoded(&self) {
        self.inner.hold_decoded();
    }

    fn timing(&self) -> TimeOrigin {
        self.inner.timing()
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        let StillFiles { inner, scratch, paths, kind } = *self;
        Ok(Box::new(StillFiles { inner: inner.with_times(times)?, scratch, paths, kind }))
    }

    fn notes(&self) -> Vec<String> {
        self.inner.notes()
    }

    fn tracking_note(&self) -> Option<String> {
        self.inner.tracking_note()
    }

    fn default_output_kind(&self) -> OutputKind {
        self.inner.default_output_kind()
    }

    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        self.inner.check_output(kind, path)
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.inner.archive_content(compressed)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.inner.decode_frames(content)
    }

    fn may_be_linked(&self) -> bool {
        self.inner.may_be_linked()
    }

    fn has_explicit_frames(&self) -> bool {
        self.inner.has_explicit_frames()
    }

    fn archives_as_frames(&self) -> bool {
        self.inner.archives_as_frames()
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        self.inner.compressed_frames(compressed)
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        self.inner.write(compressed, kind, path, limits, events)
    }
}

/// Returns `paths` with each folder replaced by the files in it, sorted by name. Fails if a folder cannot be listed.
fn files_of(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let listed = fs::read_dir(path).map_err(Error::io("list", path))?;
        let mut inside = Vec::new();
        for entry in listed {
            let file = entry.map_err(Error::io("list", path))?.path();
            if file.is_file() {
                inside.push(file);
            }
        }
        inside.sort();
        files.extend(inside);
    }
    Ok(files)
}
