//! Kinds of output ([`OutputKind`]: file formats and folder layouts), and the kind that the ending of a file name
//! stands for.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, ShowPath};
use crate::files::names::has_ending;
use crate::model::NO_SH_LIMIT;

/// Kind of output: the file format, or the layout of the output folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutputKind {
    /// Files of a trained model, in the format that its training code writes.
    Model,
    /// A `.gseq` container of all frames.
    Gseq,
    /// A folder with one PLY per frame.
    PlySequence,
    /// One PLY file: a single frame; of a 4DGaussians model with several frames its canonical Gaussians, of a
    /// SpacetimeGaussians model all stored values with the motion.
    Ply,
    /// A `.gsz` archive for storage and transfer. For a sequence of frames it is a container with error bounds.
    Archive,
    /// A `.splatv` file for web viewers: Gaussians with cubic motion, each visible in a window of time.
    Splatv,
    /// A `.4dgs` file: pieces of straight motion, each visible in a window of time.
    #[serde(rename = "4dgs")]
    FourDgs,
    /// A `.spz` file of version 3: one frame, strongly compressed.
    Spz,
    /// A `.spz` file of version 4.
    #[serde(rename = "spz-4")]
    Spz4,
    /// A `.sog` file: one frame, as images for web players.
    Sog,
    /// A `.glb` file: one frame, uncompressed.
    Glb,
    /// A folder with one `.sog` file per frame.
    SogSequence,
    /// A `.gsd` file for a plugin of Unreal: every frame in full, with colors of SH degree 0.
    Gsd,
    /// A `.ftgs.ply` file: Gaussians with linear motion, whose opacity follows a Gaussian function of time.
    Ftgs,
    /// A `.tsog` file for web players, with attributes as images: Gaussians with linear motion, whose opacity follows a
    /// Gaussian function of time, or single frames.
    Tsog,
}

/// Endings of file names, each with the kind of output that has it. Of two kinds with one ending, the name stands for the
/// first.
const ENDINGS: [(&str, OutputKind); 12] = [
    ("gseq", OutputKind::Gseq),
    ("ply", OutputKind::Ply),
    ("gsz", OutputKind::Archive),
    ("splatv", OutputKind::Splatv),
    ("4dgs", OutputKind::FourDgs),
    ("spz", OutputKind::Spz),
    ("spz", OutputKind::Spz4),
    ("sog", OutputKind::Sog),
    ("glb", OutputKind::Glb),
    ("tsog", OutputKind::Tsog),
    ("gsd", OutputKind::Gsd),
    ("ftgs.ply", OutputKind::Ftgs),
];

/// Relation of the renders of an output file to those of the result that is stored in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fidelity {
    /// The file stores the values themselves, so its renders are the same.
    Exact,
    /// The file stores rounded values or fitted motion.
    Approximate,
    /// The file stores rounded values or fitted motion, and this program does not read files of this kind.
    Unreadable,
}

impl OutputKind {
    /// Returns the kind of output, from the first of these sources that gives one:
    /// - `requested`: the kind that the user named.
    /// - The ending of `path`.
    /// - `input_kind`: the kind of the input.
    pub fn from_path(path: &Path, requested: Option<OutputKind>, input_kind: OutputKind) -> OutputKind {
        requested.or(Self::from_name(path)).unwrap_or(input_kind)
    }

    /// Checks the ending of the file name `path`, for users who name no kind of output. Allowed are the endings of all
    /// kinds of output, and names without a file ending.
    ///
    /// # Errors
    /// Returns [`Error::Usage`], which lists the possible outputs, for any other ending, such as `.zip`.
    pub fn check_name(path: &Path) -> Result<()> {
        let known = Self::from_name(path).is_some();
        let Some(ending) = foreign_ending(path).filter(|_| !known) else { return Ok(()) };
        Err(Error::usage(format!(
            "{}: splatsieve does not write .{ending} files; expected one of\n  \
             NAME.gsz       archive of a model, of one PLY or of frames, the smallest\n  \
             NAME.gseq      container of all frames\n  \
             NAME.ply       one PLY\n  \
             NAME.splatv    curved motion in windows of time, for splaTV and WebGS\n  \
             NAME.4dgs      pieces of straight motion, for readers of 4dgs\n  \
             NAME.spz       one frame, for most web viewers\n  \
             NAME.sog       one frame as images, for web viewers\n  \
             NAME.glb       one frame, for viewers of glTF\n  \
             NAME.tsog      linear motion in windows of time, SH degree 0 to 3\n  \
             NAME.ftgs.ply  linear motion in windows of time, for ftgs-player\n  \
             NAME.gsd       every frame whole, for Unreal\n  \
             a folder       of the input's kind: model folder, or PLY files; give a name without an ending\n  \
             or name the kind of {} with --as model|gseq|ply-sequence|ply|archive|splatv|4dgs|spz|sog|glb|\
             sog-sequence|tsog|ftgs|gsd",
            path.shown(),
            path.shown()
        )))
    }

    fn from_name(path: &Path) -> Option<OutputKind> {
        // These endings have two parts, of which the second one alone means an ordinary PLY.
        if has_ending(path, ".ftgs.ply") {
            return Some(OutputKind::Ftgs);
        }
        if has_ending(path, ".compressed.ply") {
            return None;
        }
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        ENDINGS.iter().find(|(known, _)| *known == ending).map(|(_, kind)| *kind)
    }

    /// Returns the ending of file names of this kind, without the first dot; `None` for folders.
    pub fn ending(self) -> Option<&'static str> {
        ENDINGS.iter().find(|(_, kind)| *kind == self).map(|(ending, _)| *ending)
    }

    /// Returns whether this kind of output is a folder rather than a file.
    pub fn is_folder(self) -> bool {
        matches!(self, OutputKind::Model | OutputKind::PlySequence | OutputKind::SogSequence)
    }

    /// Returns whether this kind of output is made from the values of every frame: the frames themselves, or motions
    /// fitted to them. The kinds `Model`, `Ply` and `Archive` are made from the stored parameters of a model instead.
    pub fn stores_frames(self) -> bool {
        !matches!(self, OutputKind::Model | OutputKind::Ply | OutputKind::Archive)
    }

    /// Returns the highest SH degree that this kind of output stores, whatever the input has.
    pub fn max_sh_degree(self) -> usize {
        match self {
            OutputKind::Splatv | OutputKind::Gsd => 0,
            _ => NO_SH_LIMIT,
        }
    }

    /// Returns how renders of a file of this kind differ from those of the result that is stored in it. Archives are
    /// not considered: a stage of their own chooses their precision and measures it.
    pub fn fidelity(self) -> Fidelity {
        match self {
            OutputKind::FourDgs | OutputKind::Gsd => Fidelity::Unreadable,
            OutputKind::Splatv
            | OutputKind::Spz
            | OutputKind::Spz4
            | OutputKind::Sog
            | OutputKind::SogSequence
            | OutputKind::Ftgs
            | OutputKind::Tsog => Fidelity::Approximate,
            OutputKind::Model
            | OutputKind::Gseq
            | OutputKind::PlySequence
            | OutputKind::Ply
            | OutputKind::Archive
            | OutputKind::Glb => Fidelity::Exact,
        }
    }

    /// Returns the number of bytes of memory per Gaussian that encoding one frame takes, besides the frame itself.
    /// `state_bytes` is the number of bytes of the attributes of one Gaussian.
    pub fn encoding_bytes(self, state_bytes: u64) -> u64 {
        match self {
            // Six images of 4 bytes, compressed and not, the Morton order with its keys, and for the SH coefficients a
            // copy in groups, the palette and the labels.
            OutputKind::Sog | OutputKind::SogSequence => 100 + 3 * state_bytes,
            OutputKind::Spz4 => state_bytes,
            _ => 0,
        }
    }

    /// Checks that this kind of output can hold `frames` frames. Messages name `path`, the output.
    ///
    /// # Errors
    /// Fails for a `.spz`, a `.sog` or a `.glb` file if the number of frames is not 1.
    pub fn check_frames(self, frames: usize, path: &Path) -> Result<()> {
        let too_many = |ending: &str, others: &str| Err(too_many_frames(frames, ending, others, path));
        match self {
            _ if frames == 1 => Ok(()),
            OutputKind::Spz | OutputKind::Spz4 => too_many("spz", "a .splatv, a .4dgs or a .gseq"),
            OutputKind::Sog => too_many("sog", "--as sog-sequence, a .splatv, a .4dgs or a .gseq"),
            OutputKind::Glb => too_many("glb", "a .splatv, a .4dgs or a .gseq"),
            _ => Ok(()),
        }
    }
}

/// Returns the error that `frames` frames do not fit one file with the ending `ending` at `path`. `others`: outputs
/// that can hold them.
pub fn too_many_frames(frames: usize, ending: &str, others: &str, path: &Path) -> Error {
    Error::usage(format!(
        "{}: {frames} frames do not fit one .{ending}\n  write {others}\n  \
         for one frame of a model: convert with --frames 1; of frames: write them with --as ply-sequence, and \
         convert one of the files",
        path.shown()
    ))
}

/// Checks that `path` can be the name of an output folder. `what` is the command that writes the folder, for messages.
///
/// # Errors
/// Returns [`Error::Usage`] if the name has the ending of a file, such as `.ply`.
pub fn check_folder_name(path: &Path, what: &str) -> Result<()> {
    match foreign_ending(path) {
        Some(ending) => Err(Error::usage(format!(
            "{}: {what} writes a folder; expected a name that does not end in .{ending}",
            path.shown()
        ))),
        None => Ok(()),
    }
}

/// Checks that `path` can be the name of a container. `what` is the command that writes the container, for messages.
///
/// # Errors
/// Returns [`Error::Usage`] if the name has the ending of a file other than a container, such as `.ply`.
pub fn check_container_name(path: &Path, what: &str) -> Result<()> {
    match foreign_ending(path).filter(|ending| !ending.eq_ignore_ascii_case("gseq")) {
        Some(ending) => Err(Error::usage(format!(
            "{}: {what} writes a container; expected NAME.gseq, found a name that ends in .{ending}",
            path.shown()
        ))),
        None => Ok(()),
    }
}

/// Returns the ending of the file name `path` if it looks like the ending of a file: letters only, or one of a few
/// endings with digits, such as `mp4`. Returns `None` in two cases:
/// - The ending has other digits. `small.v2` and `run.2024` count as names of folders.
/// - `path` is an existing folder, which may have any name.
fn foreign_ending(path: &Path) -> Option<&str> {
    const WITH_DIGITS: [&str; 7] = ["mp4", "4dgs", "splat4d", "h5", "hdf5", "7z", "bz2"];
    if has_ending(path, ".compressed.ply") && !path.is_dir() {
        return Some("compressed.ply");
    }
    let ending = path.extension()?.to_str()?;
    let only_letters = ending.chars().all(|c| c.is_ascii_alphabetic());
    let known = only_letters || WITH_DIGITS.iter().any(|known| ending.eq_ignore_ascii_case(known));
    Some(ending).filter(|ending| known && !ending.is_empty() && !path.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_double_ending_of_ftgs_is_no_plain_ply() {
        let kind = |name: &str| OutputKind::from_path(Path::new(name), None, OutputKind::Model);
        assert_eq!(["a/x.ftgs.ply", "x.Ftgs.PLY"].map(kind), [OutputKind::Ftgs; 2]);
        assert_eq!(["x.ply", "ftgs.ply", "x.ftgs/x.ply"].map(kind), [OutputKind::Ply; 3]);
    }

    #[test]
    fn unknown_endings_are_refused_with_the_possible_ones() {
        let refused = |name: &str| OutputKind::check_name(Path::new(name)).err().map(|error| error.to_string());
        for name in ["x.txt", "a/b.json", "x.ZIP", "x.mp4", "small.gsq", "x.fbx", "x.compressed.ply"] {
            let message = refused(name).expect(name);
            for part in [name, "NAME.gsz", "NAME.gseq", "NAME.ply", "a folder", "--as"] {
                assert!(message.contains(part), "{part:?} is not in {message:?}");
            }
        }
        for name in [
            "x",
            "x.gsz",
            "X.GSEQ",
            "x.ply",
            "x.FTGS.ply",
            "x.tsog",
            "x.gsd",
            "small.v2",
            "run.2024",
            "out_0.3",
            ".hidden",
        ] {
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
