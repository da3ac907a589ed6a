//! Opens a compressed model for comparison with its original.

use std::fs;
use std::path::Path;

use super::{InputOptions, Scene};
use crate::error::{Error, Result, ShowPath};
use crate::models::{self, InputModel, OpenOptions, TimeOrigin};
use crate::outputs::curves::scale_to_unit;
use crate::outputs::kind::OutputKind;

/// Maximum difference between the times of the same frame in two models, as a fraction of the time span of the
/// sequence. Times that were written to a file are rounded, so they may differ slightly.
const TIME_TOLERANCE: f64 = 1e-6;

/// Checks that the compressed model at `path` exists. Called before the original is opened, which can take long.
///
/// # Errors
/// Fails if `path` does not exist, or if it is `-`: only the original can be a stream.
pub fn check_compressed(path: &Path) -> Result<()> {
    if path == Path::new("-") {
        return Err(Error::usage(
            "the compressed model: expected a file or a folder, found -; only the original can be a stream on standard \
             input\n  write the stream to a container first: splatsieve convert - NAME.gseq",
        ));
    }
    fs::metadata(path).map_err(Error::io("open", path)).map(|_| ())
}

/// Opens the compressed model at `path`, with frames at the times of the frames of `original`. `options` are the
/// options with which the original was opened; the training iteration in them is ignored.
///
/// A `.splatv` file that was made from frames with times outside the range from 0 to 1 stores these times scaled to
/// this range. Such a model is opened at the scaled times; the second result is then a note for the user that says so.
///
/// # Errors
/// Fails if the model cannot be read, or if the number or the times of its frames differ from the original's.
pub fn open_compressed(
    path: &Path,
    original: &Scene,
    options: &InputOptions,
) -> Result<(Box<dyn InputModel>, Option<String>)> {
    let own_times = &original.source().info().times;
    let input = models::open(path, &OpenOptions { iteration: None, ..options.open_options() })?.into_linked()?;
    let description = input.description();
    let is_fitted_splatv =
        description.default_output_kind == OutputKind::Splatv && !original.input.keeps_motion(OutputKind::Splatv);
    let times = &if is_fitted_splatv { scale_to_unit(own_times) } else { own_times.clone() };
    let note = match &own_times[..] {
        [first, .., last] if times != own_times => Some(format!(
            "the times of the original, {first} to {last}, are compared with the times 0 to 1 of {}, because a .splatv \
             holds no other times",
            path.shown()
        )),
        _ => None,
    };
    let input = match description.timing {
        TimeOrigin::Continuous => input.with_times(times.clone())?,
        TimeOrigin::Numbered if input.source().info().times.len() == times.len() => input.with_times(times.clone())?,
        TimeOrigin::Numbered | TimeOrigin::Stamped => input,
    };
    let found = &input.source().info().times;
    let expected = |what: String| format!("{what}, as in {}", original.path.shown());
    if found.len() != times.len() {
        let expected = expected(format!("{} frames", times.len()));
        return Err(Error::input(path, "", expected, format!("{} frames", found.len()))
            .hint("compare models of the same scene, with the cameras both were made for"));
    }
    let span = times.first().zip(times.last()).map_or(0.0, |(first, last)| last - first);
    let tolerance = TIME_TOLERANCE * if times.len() > 1 { span } else { 1.0 };
    match (0..times.len()).find(|&frame| (found[frame] - times[frame]).abs() > tolerance) {
        Some(frame) => {
            let expected = expected(format!("time {}", times[frame]));
            Err(Error::input(path, format!("frame {frame}"), expected, found[frame].to_string())
                .hint("compare models of the same scene, with the cameras both were made for"))
        }
        None => Ok((input, note)),
    }
}

/// Returns a note for each of the two models whose frames were linked, so that its renders differ from those of its
/// input files.
pub fn tracking_notes(original: &dyn InputModel, compressed: &dyn InputModel) -> impl Iterator<Item = String> {
    [("original", original.description().tracking_note), ("compressed", compressed.description().tracking_note)]
        .into_iter()
        .filter_map(|(role, note)| Some(format!("the {role} model: {}", note?)))
}
