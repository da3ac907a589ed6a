//! Kinds of result, and the kind that a name asks for.

use std::path::Path;

use serde::{Deserialize, Serialize};

/// Kinds of result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutputKind {
    /// The files of a trained model, as its own training writes them.
    Model,
    /// A container.
    Gseq,
    /// A folder with one PLY per frame.
    PlySequence,
    /// One PLY: the canonical cloud of a model, or a sequence of one frame.
    Ply,
    /// An archive: to store and to send.
    Archive,
}

impl OutputKind {
    /// The kind that is asked for outright, else by the name `path`, else `own`.
    pub fn of(path: &Path, asked: Option<OutputKind>, own: OutputKind) -> OutputKind {
        asked.or(Self::by_name(path)).unwrap_or(own)
    }

    fn by_name(path: &Path) -> Option<OutputKind> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "gseq" => Some(OutputKind::Gseq),
            "ply" => Some(OutputKind::Ply),
            "gsz" => Some(OutputKind::Archive),
            _ => None,
        }
    }

    /// Whether the result is a folder.
    pub fn is_folder(self) -> bool {
        matches!(self, OutputKind::Model | OutputKind::PlySequence)
    }

    /// Whether it holds every frame, as opposed to what frames are made of.
    pub fn holds_frames(self) -> bool {
        matches!(self, OutputKind::Gseq | OutputKind::PlySequence)
    }
}
