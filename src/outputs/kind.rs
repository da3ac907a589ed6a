//! Kinds of result, and the kind that a name asks for.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, ShowPath};

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
    /// An archive, to store and to send: of frames a container within bounds.
    Archive,
    /// A `.splatv`: Gaussians on cubic paths, for viewers of them.
    Splatv,
    /// A `.4dgs`: pieces of straight motion.
    #[serde(rename = "4dgs")]
    FourDgs,
    /// A `.spz`: one frame, in few bytes.
    Spz,
}

impl OutputKind {
    /// The kind that is asked for outright, else by the name `path`, else `own`.
    pub fn from_path(path: &Path, asked: Option<OutputKind>, own: OutputKind) -> OutputKind {
        asked.or(Self::by_name(path)).unwrap_or(own)
    }

    /// Confirms that a name that nobody says the kind of is one that some output has.
    ///
    /// # Errors
    /// The ending of another kind of file, as [`Error::Usage`] with what can be written.
    pub fn check_name(path: &Path) -> Result<()> {
        let known = Self::by_name(path).is_some();
        let Some(ending) = foreign_ending(path).filter(|_| !known) else { return Ok(()) };
        Err(Error::usage(format!(
            "{}: nothing that is written here ends in .{ending}; expected one of\n  \
             NAME.gsz       archive of a model, of one PLY or of frames, the smallest\n  \
             NAME.gseq      container of all frames\n  \
             NAME.ply       one PLY\n  \
             NAME.splatv    curved motion in windows of time, for splaTV and WebGS\n  \
             NAME.4dgs      pieces of straight motion, for readers of 4dgs\n  \
             NAME.spz       one frame, for most web viewers\n  \
             a folder       of the input's kind: model folder, or PLY files; its name has no such ending\n  \
             or say outright with --as model|gseq|ply-sequence|ply|archive|splatv|4dgs|spz what {} is to be",
            path.shown(),
            path.shown()
        )))
    }

    fn by_name(path: &Path) -> Option<OutputKind> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "gseq" => Some(OutputKind::Gseq),
            "ply" => Some(OutputKind::Ply),
            "gsz" => Some(OutputKind::Archive),
            "splatv" => Some(OutputKind::Splatv),
            "4dgs" => Some(OutputKind::FourDgs),
            "spz" => Some(OutputKind::Spz),
            _ => None,
        }
    }

    /// Whether the result is a folder.
    pub fn is_folder(self) -> bool {
        matches!(self, OutputKind::Model | OutputKind::PlySequence)
    }

    /// Whether it holds every frame, as opposed to what frames are made of.
    pub fn holds_frames(self) -> bool {
        !matches!(self, OutputKind::Model | OutputKind::Ply | OutputKind::Archive)
    }

    /// Confirms that a result of this kind, named `path`, can hold so many frames.
    ///
    /// # Errors
    /// More frames, or fewer.
    pub fn check_frames(self, frames: usize, path: &Path) -> Result<()> {
        match self {
            OutputKind::Spz if frames != 1 => Err(Error::usage(format!(
                "{}: {frames} frames do not fit one .spz\n  write a .splatv, a .4dgs or a .gseq",
                path.shown()
            ))),
            _ => Ok(()),
        }
    }
}

/// Confirms that `path` may be called the name of a folder that `what` writes.
///
/// # Errors
/// The ending of a file, as [`Error::Usage`].
pub fn check_folder_name(path: &Path, what: &str) -> Result<()> {
    match foreign_ending(path) {
        Some(ending) => Err(Error::usage(format!(
            "{}: {what} writes a folder; expected a name that does not end in .{ending}",
            path.shown()
        ))),
        None => Ok(()),
    }
}

/// Confirms that `path` may be called the name of a container.
///
/// # Errors
/// The ending of another kind of file, as [`Error::Usage`].
pub fn check_container_name(path: &Path, what: &str) -> Result<()> {
    match foreign_ending(path).filter(|ending| !ending.eq_ignore_ascii_case("gseq")) {
        Some(ending) => Err(Error::usage(format!(
            "{}: {what} writes a container; expected NAME.gseq, found a name that ends in .{ending}",
            path.shown()
        ))),
        None => Ok(()),
    }
}

/// The ending of a name that looks like that of a kind of file: letters, or one of a few with digits. `small.v2` and
/// `run.2024` are names of folders, and so is whatever is one already.
fn foreign_ending(path: &Path) -> Option<&str> {
    const WITH_DIGITS: [&str; 7] = ["mp4", "4dgs", "splat4d", "h5", "hdf5", "7z", "bz2"];
    let ending = path.extension()?.to_str()?;
    let letters = ending.chars().all(|c| c.is_ascii_alphabetic());
    let known = letters || WITH_DIGITS.iter().any(|known| ending.eq_ignore_ascii_case(known));
    Some(ending).filter(|ending| known && !ending.is_empty() && !path.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_no_output_has_are_refused_with_what_can_be_written() {
        let refused = |name: &str| OutputKind::check_name(Path::new(name)).err().map(|error| error.to_string());
        for name in ["x.txt", "a/b.json", "x.ZIP", "x.mp4", "small.gsq", "x.sog"] {
            let message = refused(name).expect(name);
            for part in [name, "NAME.gsz", "NAME.gseq", "NAME.ply", "a folder", "--as"] {
                assert!(message.contains(part), "{part:?} is not in {message:?}");
            }
        }
        for name in ["x", "x.gsz", "X.GSEQ", "x.ply", "small.v2", "run.2024", "out_0.3", ".hidden"] {
            assert_eq!(refused(name), None, "{name}");
        }
        assert!(check_folder_name(Path::new("page.html"), "report").unwrap_err().to_string().contains("folder"));
        assert!(check_folder_name(Path::new("page.v2"), "report").is_ok());
        assert!(check_container_name(Path::new("x.ply"), "pack").unwrap_err().to_string().contains("NAME.gseq"));
        assert!(
            check_container_name(Path::new("x"), "pack").is_ok()
                && check_container_name(Path::new("x.gseq"), "pack").is_ok()
        );
    }
}
