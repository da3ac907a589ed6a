//! Writes any sequence as Gaussians with linear motion, whose opacity follows a Gaussian function of time (a time
//! window). This module calls such a Gaussian a line. Lines are fitted to the trajectory of every Gaussian of the
//! sequence. Models whose own Gaussians are lines are written without a fit.
//!
//! The time of these formats runs from 0, at the first frame, to 1, at the last. A `.tsog` can also hold single frames,
//! and does if the fit is too inaccurate or has too many lines ([`are_frames_better`]). Memory: all lines, or the
//! visible Gaussians of all single frames.

use std::path::Path;

use crate::error::{Error, Result};
use crate::files::ftgs::{
    ClipTimes, LOG_TIME_DEVIATION, MIN_TIME_DEVIATION, PARAMS_PER_GAUSSIAN, TIME_CENTER, VELOCITY, write_exact_ftgs,
};
use crate::files::tsog::write::{MAX_FRAMES, write_tsog};
use crate::files::tsog::{TimedGaussians, Timeline};
use crate::fit::{CubicTrack, CurveForm, FitError, MIN_VISIBLE_OPACITY, Tolerance, fit_curves};
use crate::model::{AttributeValues, Attributes, Gaussians, StoredParams, logit, opacity};
use crate::outputs::fit_tracks;
use crate::outputs::kind::OutputKind;
use crate::passes::FrameStates;
use crate::progress::Events;
use crate::source::{FrameSource, ReadPlan};

/// Standard deviation of the time window of a Gaussian with constant opacity, as a multiple of the sequence's duration.
/// It is so large that the window differs from 1 by less than 1e-7 at every time of the sequence.
const CONSTANT_DEVIATION: f64 = 2000.0;
/// Minimum distance of an opacity from 0 and from 1, so that its logit is finite.
const OPACITY_MARGIN: f64 = 1e-6;

/// Maximum number of Gaussians in a `.tsog` of single frames, summed over all frames. The player of this format shows
/// no more by default.
pub const MAX_SINGLE_FRAME_GAUSSIANS: usize = 1_000_000;
/// Maximum fraction of the visible states (Gaussians × frames, weighted by opacity) in which fitted linear motions may
/// be far off ([`FitError::far_off_fraction`]). If the fraction is larger, single frames are written.
const MAX_FAR_OFF_FRACTION: f64 = 0.1;
/// Maximum number of intervals into which the trajectory of a Gaussian is divided to fit linear motions for a `.tsog`.
/// More intervals would cost many bytes, and only few Gaussians need them.
const COMPACT_INTERVALS: usize = 8;
/// Approximate number of bytes of a Gaussian with linear motion and a time window in a `.tsog`, as a multiple of the
/// bytes of a Gaussian in a single frame.
const BYTES_RATIO: f64 = 1.5;

/// Gaussians with linear motion in time windows, fitted to a sequence.
#[derive(Debug)]
struct FittedWindows {
    lines: TimedGaussians,
    misfit: FitError,
    /// Number of fitted Gaussians that were left out because one of their values is not finite.
    left_out: usize,
}

/// Returns whether `kind` is a format of Gaussians with linear motion in time windows.
pub fn is_windowed(kind: OutputKind) -> bool {
    matches!(kind, OutputKind::Ftgs | OutputKind::Tsog)
}

/// Returns whether the format `kind` can store Gaussians that are visible as `timeline` says (always, in single frames,
/// or in time windows).
pub fn can_store(kind: OutputKind, timeline: Timeline) -> bool {
    kind == OutputKind::Tsog || (kind == OutputKind::Ftgs && timeline == Timeline::Windows)
}

/// Writes the Gaussians `timed` to the file `path`, in the format `kind`. Returns notes for the user.
///
/// # Errors
/// Fails if the file cannot be written, or if the format cannot store when the Gaussians are visible ([`can_store`]).
pub fn write_timed(timed: &TimedGaussians, kind: OutputKind, path: &Path) -> Result<Vec<String>> {
    match kind {
        OutputKind::Ftgs if timed.timeline == Timeline::Windows => {
            write_exact_ftgs(&timed.params, &timed.clip, path).map(|()| Vec::new())
        }
        OutputKind::Tsog => Ok(vec![write_tsog(timed, path)?.error_note()]),
        _ => Err(Error::internal("time windows in a format without them")),
    }
}

/// Writes all frames of `source` to the file `path` in the format `kind`, as fitted Gaussians with linear motion and an
/// opacity that is a Gaussian function of time. Writes a `.tsog` as single frames instead if the fit is too inaccurate
/// or would take more bytes than the frames. Returns notes for the user: the errors of the fit, and what was written
/// instead.
///
/// # Errors
/// Fails if a frame cannot be read or the file cannot be written.
pub fn write_fitted_windows(
    source: &dyn FrameSource,
    kind: OutputKind,
    path: &Path,
    events: &Events,
) -> Result<Vec<String>> {
    let info = source.info();
    if kind == OutputKind::Tsog && info.times.len() == 1 {
        let still = single_frames(source, &ClipTimes::from_times(&info.times))?;
        let params = StoredParams::from(still.params.gaussians);
        return write_timed(&TimedGaussians { params, timeline: Timeline::Still, ..still }, kind, path);
    }
    let fitted = fit(source, kind, events)?;
    let FittedWindows { lines, misfit, left_out } = &fitted;
    let mut notes = vec![format!(
        "{} Gaussians became {} lines in time windows; off by more than the middle scale or 0.1 of opacity: {:.1}% of \
         what is visible; error of positions, as a fraction of the Gaussian's middle scale: {:.3} rms, {:.3} at most; \
         error of opacities: {:.3} rms, {:.3} at most",
        info.count,
        lines.params.len(),
        100.0 * misfit.far_off_fraction(),
        misfit.rms(),
        misfit.max_position_error,
        misfit.opacity_rms(),
        misfit.max_opacity_error
    )];
    if *left_out > 0 {
        notes.push(format!("{left_out} lines left out: a value of their Gaussian is not finite"));
    }
    if kind == OutputKind::Tsog && are_frames_better(lines, misfit) {
        let frames = single_frames(source, &lines.clip)?;
        let why = format!(
            "single frames are written instead, {} Gaussians in {} frames: the lines are too far off or too many",
            frames.params.len(),
            info.times.len()
        );
        return Ok([vec![why], notes, write_timed(&frames, kind, path)?].concat());
    }
    notes.extend(write_timed(lines, kind, path)?);
    Ok(notes)
}

/// Returns whether single frames are written instead of `lines`, which are fitted Gaussians with linear motion.
/// `misfit` is the error of the fit. One of two reasons must hold:
/// - `lines` are far off in more than the fraction [`MAX_FAR_OFF_FRACTION`] of the visible states. (A state is one
///   Gaussian at one frame.)
/// - Single frames, which have no fit error, take no more bytes by an estimate.
///
/// Single frames are never written if they have more than [`MAX_SINGLE_FRAME_GAUSSIANS`] Gaussians or [`MAX_FRAMES`]
/// frames.
fn are_frames_better(lines: &TimedGaussians, misfit: &FitError) -> bool {
    let is_far_off = misfit.far_off_fraction() > MAX_FAR_OFF_FRACTION;
    let are_many = BYTES_RATIO * lines.params.len() as f64 >= misfit.states as f64;
    let frames = lines.clip.frames.unwrap_or(1);
    (is_far_off || are_many) && misfit.states <= MAX_SINGLE_FRAME_GAUSSIANS as u64 && frames <= MAX_FRAMES
}

/// Returns the visible Gaussians of all frames of `source`, each shown in its own frame only. `clip` maps the times of
/// the frames to the range from 0 to 1. Gaussians with values that are not finite are left out.
fn single_frames(source: &dyn FrameSource, clip: &ClipTimes) -> Result<TimedGaussians> {
    let info = source.info();
    let mut states = FrameStates::open(source, &ReadPlan::all_frames().with_max_kept_frames(1))?;
    let (mut parts, mut frame_of) = (Vec::new(), Vec::new());
    for frame in 0..info.times.len() {
        let state = states.read(frame)?;
        let is_finite = |row: usize| {
            let columns = Attributes::all().iter().map(|column| state.attribute_values(column));
            columns.flat_map(|values| (0..values.width()).map(|c| values.plane(c)[row])).all(f32::is_finite)
        };
        let is_seen = |row: usize| opacity(state.opacity_logit.plane(0)[row]) >= MIN_VISIBLE_OPACITY && is_finite(row);
        let rows: Vec<u32> = (0..state.len() as u32).filter(|&row| is_seen(row as usize)).collect();
        frame_of.extend(std::iter::repeat_n(frame as f32, rows.len()));
        parts.push(state.pick(&rows));
    }
    let mut gaussians = Gaussians::zeros(frame_of.len(), info.sh_degree);
    for column in Attributes::all().iter() {
        let to = gaussians.attribute_values_mut(column);
        for c in 0..to.width() {
            let values = parts.iter().flat_map(|part| part.attribute_values(column).plane(c).iter().copied());
            to.plane_mut(c).iter_mut().zip(values).for_each(|(to, value)| *to = value);
        }
    }
    let own = AttributeValues::from_planes(1, frame_of);
    let timeline = Timeline::Frames(info.times.len());
    Ok(TimedGaussians { params: StoredParams { gaussians, format_specific: own }, timeline, clip: *clip })
}

/// Fits Gaussians with linear motion and an opacity that is a Gaussian function of time to all Gaussians of `source`,
/// for the format `kind`. Returns the fitted Gaussians and the error of the fit.
fn fit(source: &dyn FrameSource, kind: OutputKind, events: &Events) -> Result<FittedWindows> {
    let info = source.info();
    let clip = ClipTimes::from_times(&info.times);
    let times: Vec<f64> = info.times.iter().map(|&time| clip.to_unit(time)).collect();
    let (tolerance, form) = match kind {
        OutputKind::Tsog => {
            (Tolerance::COMPACT, CurveForm::linear_with_min_width(0.0).with_intervals(COMPACT_INTERVALS))
        }
        _ => (Tolerance::default(), CurveForm::linear_with_min_width(std::f64::consts::SQRT_2 * MIN_TIME_DEVIATION)),
    };
    let (found, misfit) =
        fit_tracks(source, &times, events, |track, misfit| fit_curves(track, form, &tolerance, misfit))?;
    let all = found.iter().map(Vec::len).sum::<usize>();
    let lines: Vec<&CubicTrack> = found.iter().flatten().filter(|line| is_finite(line)).collect();
    let mut params = StoredParams {
        gaussians: Gaussians::zeros(lines.len(), info.sh_degree),
        format_specific: AttributeValues::zeros(PARAMS_PER_GAUSSIAN, lines.len()),
    };
    lines.iter().enumerate().for_each(|(row, line)| set_row(&mut params, row, line));
    let left_out = all - lines.len();
    Ok(FittedWindows { lines: TimedGaussians { params, timeline: Timeline::Windows, clip }, misfit, left_out })
}

/// Returns whether all values of the fitted Gaussian `line` are finite as f32. Its motion is linear: of the
/// coefficients in [`CubicTrack`], the quadratic and cubic ones are 0. The width of its time window is not checked,
/// because it may be infinite.
fn is_finite(line: &CubicTrack) -> bool {
    let values = line.position.iter().flatten().chain(&line.rotation[0]).chain(&line.log_scale).copied();
    let values = values.chain([line.opacity, line.center]);
    let sh = line.sh.iter().map(|&value| f64::from(value));
    values.chain(sh).all(|value| (value as f32).is_finite())
}

/// Sets the parameters of the Gaussian with index `row` in `params` to those of the fitted Gaussian `line`. The motion
/// of `line` must be linear: of the coefficients in [`CubicTrack`], the quadratic and cubic ones and the linear one of
/// the rotation are 0.
fn set_row(params: &mut StoredParams, row: usize, line: &CubicTrack) {
    let narrow = |value: f64| value as f32;
    let gaussians = &mut params.gaussians;
    gaussians.position.set_row(row, line.position[0].map(narrow));
    let length = line.rotation[0].iter().map(|x| x * x).sum::<f64>().sqrt();
    let rotation = if length > 1e-6 { line.rotation[0].map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] };
    gaussians.rotation.set_row(row, rotation.map(narrow));
    gaussians.log_scale.set_row(row, line.log_scale.map(narrow));
    let opacity = line.opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    gaussians.opacity_logit.set_row(row, [narrow(logit(opacity))]);
    line.sh.iter().enumerate().for_each(|(c, &value)| gaussians.sh.plane_mut(c)[row] = value);
    // The window of the fit is exp(−(dt/w)²), which has the standard deviation w/√2.
    let deviation = (line.width / std::f64::consts::SQRT_2).min(CONSTANT_DEVIATION);
    params.format_specific.plane_mut(TIME_CENTER)[row] = narrow(line.center);
    params.format_specific.plane_mut(LOG_TIME_DEVIATION)[row] = narrow(deviation.ln());
    (0..3).for_each(|c| params.format_specific.plane_mut(VELOCITY + c)[row] = narrow(line.position[1][c]));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::files::ftgs::FtgsFile;
    use crate::files::ply::PlyOptions;
    use crate::files::splatv::rows::ZeroRotation;
    use crate::files::tsog::read::read_tsog;
    use crate::limits::ReadLimit;
    use crate::outputs::tests::{blended, opacities_near};
    use crate::passes::gather_all;

    /// Returns the position and the opacity of every Gaussian of `file` at the time `time`, by the formulas of the
    /// player.
    fn shown(file: &FtgsFile, time: f64) -> Vec<([f64; 3], f64)> {
        let params = &file.params;
        let own = |plane: usize, row: usize| f64::from(params.format_specific.plane(plane)[row]);
        let state = |row: usize| {
            let dt = time - own(TIME_CENTER, row);
            let at = params.gaussians.position.row::<3>(row);
            let place = std::array::from_fn(|c| f64::from(at[c]) + own(VELOCITY + c, row) * dt);
            let deviation = own(LOG_TIME_DEVIATION, row).exp().max(file.header.min_deviation);
            let alpha = opacity(params.gaussians.opacity_logit.row::<1>(row)[0]);
            (place, (alpha * (-0.5 * (dt / deviation).powi(2)).exp()).max(file.header.opacity_floor))
        };
        (0..params.len()).map(state).collect()
    }

    #[test]
    fn the_formulas_of_the_player_show_every_gaussian() {
        let scene = DemoScene::new(300, 30);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.ftgs.ply");
        let notes = write_fitted_windows(&scene, OutputKind::Ftgs, &path, &Events::IGNORED).unwrap();
        assert!(notes.len() == 1 && notes[0].starts_with("300 Gaussians became"), "{notes:?}");
        let file = FtgsFile::open(&path, &PlyOptions::default(), ZeroRotation::Drop).unwrap();
        assert_eq!(file.header.clip.frames, Some(30));
        let (mut missing, mut too_faint, mut seen) = (0, 0, 0);
        for frame in 0..30 {
            let state = gather_all(&scene, frame, Attributes::all()).unwrap();
            let lines = shown(&file, frame as f64 / 29.0);
            for id in 0..300 {
                let Some((visible, near)) = opacities_near(&state, id, &lines) else { continue };
                seen += 1;
                missing += i32::from(near.iter().all(|&alpha| alpha <= MIN_VISIBLE_OPACITY));
                too_faint += i32::from(blended(&near) < visible - 0.1);
            }
        }
        assert!(seen > 3000 && 100 * missing < seen && 20 * too_faint < seen, "{missing} {too_faint} of {seen}");
    }

    #[test]
    fn the_file_does_not_depend_on_the_number_of_threads() {
        let scene = DemoScene::new(150, 12);
        let folder = tempfile::tempdir().unwrap();
        let file = |threads: usize| {
            let path = folder.path().join(format!("{threads}.ftgs.ply"));
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| write_fitted_windows(&scene, OutputKind::Ftgs, &path, &Events::IGNORED)).unwrap();
            std::fs::read(&path).unwrap()
        };
        assert!(file(1) == file(3));
    }

    #[test]
    fn still_gaussians_are_one_line_with_an_open_window() {
        let scene = DemoScene::new(40, 1);
        let fitted = fit(&scene, OutputKind::Ftgs, &Events::IGNORED).unwrap();
        let params = &fitted.lines.params;
        assert!(params.len() <= 40 && !params.is_empty());
        assert!(params.format_specific.plane(LOG_TIME_DEVIATION).iter().all(|&log| f64::from(log) > 7.0));
        assert!(
            (VELOCITY..PARAMS_PER_GAUSSIAN).all(|plane| params.format_specific.plane(plane).iter().all(|&x| x == 0.0))
        );
    }

    /// Returns `lines` Gaussians, and the error of a fit in which `states` states were compared and each position is
    /// off by `position`.
    fn fitted(lines: usize, states: usize, position: f64) -> (TimedGaussians, FitError) {
        let mut misfit = FitError::default();
        (0..states).for_each(|_| misfit.add_state(position, 0.0, 0.5));
        let params = StoredParams {
            gaussians: Gaussians::zeros(lines, 0),
            format_specific: AttributeValues::zeros(PARAMS_PER_GAUSSIAN, lines),
        };
        let clip = ClipTimes { frames: Some(10), ..ClipTimes::UNIT_INTERVAL };
        (TimedGaussians { params, timeline: Timeline::Windows, clip }, misfit)
    }

    #[test]
    fn single_frames_replace_lines_that_are_far_off_or_many() {
        for (lines, states, position, expected) in [
            (100, 1000, 0.1, false),
            (100, 1000, 1.5, true),
            (700, 1000, 0.1, true),
            (700, MAX_SINGLE_FRAME_GAUSSIANS + 1, 1.5, false),
        ] {
            let (lines, misfit) = fitted(lines, states, position);
            assert_eq!(are_frames_better(&lines, &misfit), expected, "{states} states, {position} off");
        }
    }

    #[test]
    fn single_frames_hold_all_visible_gaussians() {
        let scene = DemoScene::new(60, 2);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.tsog");
        let frames = single_frames(&scene, &ClipTimes::from_times(&scene.info().times)).unwrap();
        let visible: usize = (0..2)
            .map(|frame| {
                let state = gather_all(&scene, frame, Attributes::OPACITY).unwrap();
                let logits = state.opacity_logit.plane(0);
                logits.iter().filter(|&&logit| opacity(logit) >= MIN_VISIBLE_OPACITY).count()
            })
            .sum();
        assert_eq!((frames.params.len(), frames.timeline), (visible, Timeline::Frames(2)));
        write_timed(&frames, OutputKind::Tsog, &path).unwrap();
        let found = read_tsog(&path, ReadLimit::NONE).unwrap();
        assert_eq!((found.params.len(), found.timeline), (visible, Timeline::Frames(2)));
    }

    #[test]
    fn a_tsog_of_one_frame_is_a_still() {
        let scene = DemoScene::new(50, 1);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("still.tsog");
        write_fitted_windows(&scene, OutputKind::Tsog, &path, &Events::IGNORED).unwrap();
        assert_eq!(read_tsog(&path, ReadLimit::NONE).unwrap().timeline, Timeline::Still);
    }
}
