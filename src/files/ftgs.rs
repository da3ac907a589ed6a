//! Reads and writes `.ftgs.ply` files, version 1, of the player ftgs-player. Each Gaussian moves linearly, and its
//! opacity rises and falls like a Gaussian function of time (its time window).
//!
//! A PLY file with the properties of the INRIA layout and five more floats per Gaussian: `time` (center of its window),
//! `log_duration` (natural logarithm of the standard deviation σ of the window) and `velocity_0..2`. Time t of the
//! player runs from 0 to 1. With dt = t − `time`: position + velocity·dt, and opacity max(α·exp(−½(dt/max(σ,
//! `min_duration`))²), `opacity_floor`). Comments of the header hold the version and the settings ([`FtgsHeader`]).
//!
//! The comment `splatsieve_times FIRST LAST`, which players ignore, maps the time of the player to the time of the
//! sequence that was converted: FIRST at 0, LAST at 1.

use std::path::Path;

use crate::error::{Error, Result, quoted};
use crate::files::defects::{Defect, Defects, KEPT_ZERO_QUATERNION};
use crate::files::ply::write::write_inria_with;
use crate::files::ply::{Ply, PlyOptions};
use crate::files::splatv::rows::ZeroRotation;
use crate::model::{AttributeValues, Attributes, StoredParams};

/// Index in [`StoredParams::format_specific`] of the center of the time window.
pub const TIME_CENTER: usize = 0;
/// Index in [`StoredParams::format_specific`] of the natural logarithm of the standard deviation of the time window.
pub const LOG_TIME_DEVIATION: usize = 1;
/// First of three indices in [`StoredParams::format_specific`] of the velocity along x, y, z, per unit of time.
pub const VELOCITY: usize = 2;
/// Number of parameters in [`StoredParams::format_specific`] of a Gaussian with linear motion in a Gaussian window of
/// time.
pub const PARAMS_PER_GAUSSIAN: usize = 5;

/// Smallest standard deviation with which the player shows a time window, as a fraction of the length of the sequence.
/// The player raises smaller standard deviations to this value.
pub const MIN_TIME_DEVIATION: f64 = 0.02;
/// Minimum opacity of every Gaussian at every time: the player raises lower opacities to it. This value is written to
/// the header, and assumed if a header does not state one.
const OPACITY_FLOOR: f64 = 1e-4;
/// Names of the properties that a `.ftgs.ply` file has in addition to those of an INRIA PLY, in the order of
/// [`StoredParams::format_specific`].
const OWN_PROPERTIES: [&str; PARAMS_PER_GAUSSIAN] = ["time", "log_duration", "velocity_0", "velocity_1", "velocity_2"];
/// First word of the header comment by which a `.ftgs.ply` file is recognized.
pub const MARKER_COMMENT: &str = "ftgs_version";

/// Mapping of the times of a sequence to the time from 0 to 1 that players use, with the number of frames and the frame
/// rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClipTimes {
    /// Time of the original sequence that is mapped to 0.
    pub first: f64,
    /// Time of the original sequence that is mapped to 1; greater than `first`.
    pub last: f64,
    /// Number of frames T, if it is known. The mapped time of frame i is i/max(T − 1, 1).
    pub frames: Option<usize>,
    /// Frame rate of the playback, in frames per second. A `.ftgs.ply` does not store it.
    pub frame_rate: f64,
}

/// Frame rate of the playback if nothing else is known, in frames per second.
pub const FRAME_RATE: f64 = 30.0;

impl ClipTimes {
    /// Mapping that leaves times unchanged: the times of the sequence run from 0 to 1 already. The number of frames is
    /// not known.
    pub const UNIT_INTERVAL: ClipTimes = ClipTimes { first: 0.0, last: 1.0, frames: None, frame_rate: FRAME_RATE };

    /// Returns the mapping of the increasing `times`, one per frame, to the range from 0 to 1: the first time becomes
    /// 0, the last becomes 1. A single time t becomes 0, and t + 1 becomes 1. Without times, the mapping leaves times
    /// unchanged.
    pub fn from_times(times: &[f64]) -> ClipTimes {
        let first = times.first().copied().unwrap_or(0.0);
        let last = times.last().copied().filter(|&last| last > first).unwrap_or(first + 1.0);
        ClipTimes { first, last, frames: Some(times.len()), frame_rate: FRAME_RATE }
    }

    /// Returns the time from 0 to 1 that belongs to `time` of the original sequence.
    pub fn to_unit(&self, time: f64) -> f64 {
        (time - self.first) / (self.last - self.first)
    }

    /// Returns the mapping of times that maps `first` to 0 and `last` to 1, for an unknown number of frames. Returns
    /// `None` if a time is not finite or `last` is not greater than `first`.
    pub(crate) fn from_range(first: f64, last: f64) -> Option<ClipTimes> {
        let is_range = first.is_finite() && last.is_finite() && last - first > 1e-12 * first.abs().max(last.abs());
        is_range.then_some(ClipTimes { first, last, ..ClipTimes::UNIT_INTERVAL })
    }
}

/// Settings in the header of a `.ftgs.ply` file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FtgsHeader {
    /// Mapping of the times of the frames to the range from 0 to 1.
    pub clip: ClipTimes,
    /// Smallest standard deviation with which the player shows a time window, as a fraction of the length of the
    /// sequence.
    pub min_deviation: f64,
    /// Minimum opacity of every Gaussian at every time: the player raises lower opacities to it.
    pub opacity_floor: f64,
    /// Whether the velocities are used; if not, the Gaussians do not move.
    uses_velocity: bool,
}

/// Content of a `.ftgs.ply` file: the parameters of its Gaussians, and counts of the Gaussians that were repaired or
/// left out.
#[derive(Debug)]
pub struct FtgsFile {
    /// Settings that the header of the file states.
    pub header: FtgsHeader,
    /// Parameters of the Gaussians that were read.
    pub params: StoredParams,
    /// Counts of the rows (Gaussians) with defects.
    pub defects: Defects,
}

/// Value of a row (Gaussian) that is not finite.
const NON_FINITE: Defect = ("NaN or infinite value", true, "the player refuses files with such values");
/// Zero quaternion of a row (Gaussian), if the user does not ask to keep such rows.
const ZERO_QUATERNION: Defect = (
    "zero quaternion",
    true,
    "the player refuses files with such rotations; --zero-rotation identity keeps the Gaussians without a rotation",
);

impl FtgsHeader {
    /// Parses the settings in `comments`, the comment lines in the header of the PLY file at `path`. `sh_degree` is the
    /// SH degree of the properties of the file. Fails if a setting is invalid, or if the comments state another SH
    /// degree, version or unit of time.
    fn parse(path: &Path, comments: &[String], sh_degree: usize) -> Result<FtgsHeader> {
        let value = |name: &str| {
            let of = |comment: &String| Some(comment.strip_prefix(name)?.strip_prefix([' ', '\t'])?.trim().to_owned());
            comments.iter().find_map(of)
        };
        let place = |name: &str| format!("header, comment {name}");
        let number = |name: &str, default: f64, is_valid: &dyn Fn(f64) -> bool, expected: &str| match value(name) {
            None => Ok(default),
            Some(text) => match text.parse::<f64>().ok().filter(|&number| is_valid(number)) {
                Some(number) => Ok(number),
                None => Err(Error::input(path, place(name), expected, quoted(&text))),
            },
        };
        let is_word = |name: &str, expected: &str| match value(name) {
            Some(text) if text != expected => Err(Error::input(path, place(name), expected, quoted(&text))
                .hint("export the model again with a version of its tool that writes version 1 of the format")),
            _ => Ok(()),
        };
        is_word(MARKER_COMMENT, "1")?;
        is_word("time_units", "normalized")?;
        let degree =
            number("sh_degree", sh_degree as f64, &|degree| degree == sh_degree as f64, "the degree of f_rest_*");
        degree?;
        let uses_velocity = number("use_velocity", 1.0, &|x| x == 0.0 || x == 1.0, "0 or 1")? == 1.0;
        let is_positive = |x: f64| x.is_finite() && x >= 0.0;
        let min_deviation = number("min_duration", MIN_TIME_DEVIATION, &is_positive, "a number of at least 0")?;
        let opacity_floor =
            number("opacity_floor", OPACITY_FLOOR, &|x| (0.0..1.0).contains(&x), "a number from 0 to below 1")?;
        let frames = number("n_frames", 0.0, &|x| (1.0..=1e9).contains(&x) && x.fract() == 0.0, "a number of frames")?;
        let clip = match value("splatsieve_times") {
            None => ClipTimes::UNIT_INTERVAL,
            Some(text) => {
                let numbers: Vec<f64> = text.split_ascii_whitespace().filter_map(|word| word.parse().ok()).collect();
                let clip = if let [first, last] = numbers[..] { ClipTimes::from_range(first, last) } else { None };
                clip.ok_or_else(|| {
                    Error::input(path, place("splatsieve_times"), "two increasing numbers", quoted(&text))
                })?
            }
        };
        let clip = ClipTimes { frames: (frames > 0.0).then_some(frames as usize), ..clip };
        Ok(FtgsHeader { clip, min_deviation, opacity_floor, uses_velocity })
    }
}

impl FtgsFile {
    /// Reads the Gaussians of the file at `path`. Leaves out Gaussians with a value that is not finite. `zero_rotation`
    /// determines whether Gaussians with a zero quaternion are left out or get the identity as rotation.
    ///
    /// # Errors
    /// Fails if the file is not a PLY of Gaussians, lacks a property, has another version or unit of time, or if all
    /// Gaussians would be left out.
    pub fn open(path: &Path, options: &PlyOptions, zero_rotation: ZeroRotation) -> Result<FtgsFile> {
        let ply = Ply::open_with(path, options)?;
        let header = FtgsHeader::parse(path, ply.comments(), ply.sh_degree())?;
        let own_bytes = 4 * PARAMS_PER_GAUSSIAN as u64 * ply.count() as u64;
        options.memory.check(path, "element vertex", "the Gaussians of the file", own_bytes)?;
        let mut own = AttributeValues::zeros(PARAMS_PER_GAUSSIAN, ply.count());
        for (plane, name) in OWN_PROPERTIES.into_iter().enumerate() {
            let values = ply.values(name)?;
            let values =
                values.ok_or_else(|| Error::input(path, "element vertex", format!("property {name}"), "none"))?;
            if header.uses_velocity || plane < VELOCITY {
                own.plane_mut(plane).copy_from_slice(&values);
            }
        }
        let mut params = StoredParams { gaussians: ply.whole()?, format_specific: own };
        let (defects, kept) = inspect(&params, zero_rotation);
        if defects.dropped > 0 && kept.is_empty() {
            let found = defects.describe_kinds();
            return Err(Error::input(path, "element vertex", "Gaussians that the player shows", found)
                .hint("the model did not train, or its conversion failed: export it again"));
        }
        if defects.dropped > 0 {
            params = params.pick(&kept);
        }
        for row in 0..params.len() {
            if params.gaussians.rotation.row::<4>(row) == [0.0; 4] {
                params.gaussians.rotation.set_row(row, [1.0, 0.0, 0.0, 0.0]);
            }
        }
        Ok(FtgsFile { header, params, defects })
    }
}

/// Returns the defects of the rows (Gaussians) of `params`, and the indices of the rows that are kept. `zero_rotation`
/// determines whether rows with a zero quaternion are kept.
fn inspect(params: &StoredParams, zero_rotation: ZeroRotation) -> (Defects, Vec<u32>) {
    let mut defects = Defects::new(params.len());
    let columns: Vec<&AttributeValues> = Attributes::all()
        .iter()
        .map(|column| params.gaussians.attribute_values(column))
        .chain([&params.format_specific])
        .collect();
    let zero = match zero_rotation {
        ZeroRotation::Drop => ZERO_QUATERNION,
        ZeroRotation::Identity => KEPT_ZERO_QUATERNION,
    };
    let mut kept = Vec::new();
    for row in 0..params.len() {
        let is_finite = |column: &&AttributeValues| (0..column.width()).all(|c| column.plane(c)[row].is_finite());
        let found =
            [(!columns.iter().all(is_finite), NON_FINITE), (params.gaussians.rotation.row::<4>(row) == [0.0; 4], zero)];
        let found: Vec<_> = found.into_iter().filter_map(|(is_there, defect)| is_there.then_some(defect)).collect();
        if !defects.add_row(row as u32, &found) {
            kept.push(row as u32);
        }
    }
    (defects, kept)
}

/// Writes the Gaussians `params` with linear motion in time windows to the file `path`. The times in `params` are those
/// of the player, from 0 to 1. The header also states the number of frames and the original times of `clip`.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_ftgs(params: &StoredParams, clip: &ClipTimes, path: &Path) -> Result<()> {
    write_ftgs_with(params, clip, MIN_TIME_DEVIATION, path)
}

/// Writes a file like [`write_ftgs`], but without widening narrow time windows. Players widen every window to a minimum
/// standard deviation, which the header states. In this file, the header states the smallest deviation in `params` if
/// that is below the usual minimum [`MIN_TIME_DEVIATION`].
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_exact_ftgs(params: &StoredParams, clip: &ClipTimes, path: &Path) -> Result<()> {
    let smallest =
        params.format_specific.plane(LOG_TIME_DEVIATION).iter().fold(f32::INFINITY, |least, &x| least.min(x));
    let smallest = f64::from(smallest).exp();
    // The logarithm of the usual minimum is rounded to f32.
    let is_usual = smallest >= MIN_TIME_DEVIATION * (1.0 - 1e-6);
    write_ftgs_with(params, clip, if is_usual { MIN_TIME_DEVIATION } else { smallest }, path)
}

/// Writes a file as [`write_ftgs`] does. The header states `min_deviation` as the minimum standard deviation of a time
/// window.
fn write_ftgs_with(params: &StoredParams, clip: &ClipTimes, min_deviation: f64, path: &Path) -> Result<()> {
    let degree = params.gaussians.sh_degree();
    let mut comments = vec![
        format!("{MARKER_COMMENT} 1"),
        "time_units normalized".to_owned(),
        format!("sh_degree {degree}"),
        "use_velocity 1".to_owned(),
        format!("min_duration {min_deviation}"),
        format!("opacity_floor {OPACITY_FLOOR}"),
    ];
    comments.extend(clip.frames.map(|frames| format!("n_frames {frames}")));
    if (clip.first, clip.last) != (0.0, 1.0) {
        comments.push(format!("splatsieve_times {} {}", clip.first, clip.last));
    }
    let own: Vec<(&str, &[f32])> = OWN_PROPERTIES
        .into_iter()
        .enumerate()
        .map(|(plane, name)| (name, params.format_specific.plane(plane)))
        .collect();
    write_inria_with(&params.gaussians, &comments, &own, path)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::model::Gaussians;

    /// Returns parameters of `count` test Gaussians with the SH degree `sh_degree`. Each of them moves linearly and is
    /// visible in a Gaussian window of time.
    fn params(count: usize, sh_degree: usize) -> StoredParams {
        let mut made = StoredParams {
            gaussians: Gaussians::zeros(count, sh_degree),
            format_specific: AttributeValues::zeros(PARAMS_PER_GAUSSIAN, count),
        };
        let mut next = 0.0f64;
        let columns =
            made.gaussians.selected_attribute_values_mut(Attributes::all()).chain([&mut made.format_specific]);
        for value in columns.flat_map(AttributeValues::planes_mut) {
            next = (next + 0.618_034).fract();
            *value = next as f32 - 0.4;
        }
        made
    }

    fn read(path: &Path) -> Result<FtgsFile> {
        FtgsFile::open(path, &PlyOptions::default(), ZeroRotation::Drop)
    }

    #[test]
    fn written_files_read_back_bit_for_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ftgs.ply");
        for (degree, bytes_per_row) in [(0, 88), (1, 124), (2, 184), (3, 268)] {
            let clip = ClipTimes { first: -0.5, last: 2.0, frames: Some(31), ..ClipTimes::UNIT_INTERVAL };
            write_ftgs(&params(7, degree), &clip, &path).unwrap();
            let found = read(&path).unwrap();
            assert_eq!((&found.params, found.header.clip), (&params(7, degree), clip));
            assert_eq!((found.header.min_deviation, found.header.opacity_floor), (0.02, 1e-4));
            let file = std::fs::read(&path).unwrap();
            let header = file.windows(11).position(|bytes| bytes == b"end_header\n").unwrap() + 11;
            assert_eq!(file.len() - header, 7 * bytes_per_row);
        }
    }

    #[test]
    fn headers_have_the_comments_of_the_format() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ftgs.ply");
        write_ftgs(&params(1, 0), &ClipTimes { frames: Some(60), ..ClipTimes::UNIT_INTERVAL }, &path).unwrap();
        let file = std::fs::read(&path).unwrap();
        let text = String::from_utf8_lossy(&file[..file.len().min(1000)]).into_owned();
        let expected = "ply\nformat binary_little_endian 1.0\ncomment ftgs_version 1\ncomment time_units normalized\n\
                        comment sh_degree 0\ncomment use_velocity 1\ncomment min_duration 0.02\n\
                        comment opacity_floor 0.0001\ncomment n_frames 60\nelement vertex 1\nproperty float x\n";
        assert!(text.starts_with(expected), "{text}");
        assert!(text.contains(
            "property float rot_3\nproperty float time\nproperty float log_duration\nproperty float velocity_0\n"
        ));
    }

    /// Writes a file of Gaussians, replaces the text `from` in it by `to`, and reads the file.
    fn read_changed(from: &str, to: &str) -> Result<FtgsFile> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ftgs.ply");
        write_ftgs(&params(4, 0), &ClipTimes { frames: Some(9), ..ClipTimes::UNIT_INTERVAL }, &path).unwrap();
        let file = std::fs::read(&path).unwrap();
        let at = file.windows(from.len()).position(|bytes| bytes == from.as_bytes()).unwrap();
        std::fs::write(&path, [&file[..at], to.as_bytes(), &file[at + from.len()..]].concat()).unwrap();
        read(&path)
    }

    #[test]
    fn settings_out_of_range_are_refused_by_name() {
        for (from, to, expected) in [
            ("ftgs_version 1", "ftgs_version 2", "comment ftgs_version"),
            ("units normalized", "units seconds", "comment time_units"),
            ("sh_degree 0", "sh_degree 3", "comment sh_degree"),
            ("use_velocity 1", "use_velocity yes", "comment use_velocity"),
            ("min_duration 0.02", "min_duration -1", "comment min_duration"),
            ("opacity_floor 0.0001", "opacity_floor 1", "comment opacity_floor"),
            ("n_frames 9", "n_frames 0", "comment n_frames"),
            ("n_frames 9", "splatsieve_times 2 1", "comment splatsieve_times"),
            ("log_duration", "log_durations", "property log_duration"),
        ] {
            let message = read_changed(from, to).expect_err(to).to_string();
            assert!(message.contains(expected) && message.contains("a.ftgs.ply"), "{to}: {message}");
        }
    }

    #[test]
    fn velocities_count_only_if_the_header_says_so() {
        let still = read_changed("use_velocity 1", "use_velocity 0").unwrap();
        assert!((VELOCITY..PARAMS_PER_GAUSSIAN).all(|plane| still.params.format_specific.plane(plane) == [0.0; 4]));
        assert_eq!(still.params.format_specific.plane(TIME_CENTER), params(4, 0).format_specific.plane(TIME_CENTER));
    }

    #[test]
    fn rows_that_the_player_refuses_are_left_out_and_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ftgs.ply");
        let mut odd = params(6, 1);
        odd.format_specific.plane_mut(VELOCITY + 1)[1] = f32::NAN;
        odd.gaussians.sh.plane_mut(7)[2] = f32::INFINITY;
        odd.gaussians.rotation.set_row(4, [0.0; 4]);
        write_ftgs(&odd, &ClipTimes::UNIT_INTERVAL, &path).unwrap();
        let found = read(&path).unwrap();
        assert_eq!((found.params.len(), found.defects.dropped), (3, 3));
        assert_eq!(found.params, params(6, 1).pick(&[0, 3, 5]));
        let notes = found.defects.notes().join("\n");
        assert!(
            notes.contains("2 of 6 rows") && notes.contains("rows 1, 2") && notes.contains("--zero-rotation"),
            "{notes}"
        );
        let kept = FtgsFile::open(&path, &PlyOptions::default(), ZeroRotation::Identity).unwrap();
        assert_eq!((kept.params.len(), kept.params.gaussians.rotation.row(2)), (4, [1.0, 0.0, 0.0, 0.0]));
        odd.format_specific.plane_mut(TIME_CENTER).fill(f32::NAN);
        write_ftgs(&odd, &ClipTimes::UNIT_INTERVAL, &path).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("NaN or infinite value in 6"));
    }

    proptest! {
        #[test]
        fn changed_bytes_never_panic(at in 0..700usize, value in any::<u8>()) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.ftgs.ply");
            write_ftgs(&params(2, 0), &ClipTimes::UNIT_INTERVAL, &path).unwrap();
            let mut file = std::fs::read(&path).unwrap();
            let at = at % file.len();
            file[at] = value;
            std::fs::write(&path, &file).unwrap();
            _ = read(&path);
        }
    }
}
