//! Fit of pieces with linear motion to the track of a Gaussian (its states at all frames). Within a piece, all
//! attributes other than the position are constant.

use std::ops::Range;

use super::least_squares::polynomial;
use super::{FitError, FittedTrack, Tolerance};

/// Piece of a track (states of a Gaussian at all frames): linear motion of the Gaussian during consecutive frames.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearPiece {
    /// Frames in which the piece represents the Gaussian.
    pub frames: Range<usize>,
    /// Time in the middle of the piece. At this time the Gaussian is at `position`.
    pub mid_time: f64,
    /// Position at the time `mid_time`, in scene units.
    pub position: [f64; 3],
    /// Velocity, scene units per unit of time.
    pub velocity: [f64; 3],
    /// Rotation, a unit quaternion (w, x, y, z).
    pub rotation: [f64; 4],
    /// Natural logarithms of the three scales (scene units).
    pub log_scale: [f64; 3],
    /// Opacity in [0, 1].
    pub opacity: f64,
    /// SH coefficients of the Gaussian, constant within the piece.
    pub sh: Vec<f32>,
}

/// Divides `track` (states of a Gaussian at all frames) into pieces of linear motion and returns them in order of time.
/// Adds the errors of the pieces to `misfit`.
///
/// - Each piece covers a span of 2ᵏ frames that begins at a multiple of 2ᵏ: the whole sequence, one of its halves, one
///   of its quarters and so on. Therefore all Gaussians together have at most twice as many different spans as there
///   are frames.
/// - A piece covers the largest such span in which it meets `tolerance` at every frame.
/// - Frames in which the Gaussian is invisible have no piece.
pub fn fit_lines(track: &FittedTrack, tolerance: &Tolerance, misfit: &mut FitError) -> Vec<LinearPiece> {
    let mut pieces = Vec::new();
    add_pieces(track, 0..track.len().next_power_of_two(), tolerance, &mut pieces);
    for piece in &pieces {
        for frame in piece.frames.clone() {
            misfit.add_state(
                track.distance_in_middle_scales(frame, position_at(piece, track.times[frame])),
                track.opacity[frame] - piece.opacity,
                track.opacity[frame],
            );
        }
    }
    pieces
}

/// Fits pieces of linear motion to the frames `span` of `track` (states of a Gaussian at all frames), and appends them
/// to `pieces`. Halves the span if one piece would differ from the track by more than `tolerance`, or if the Gaussian
/// is invisible in some frames of the span. A span has 2ᵏ frames and may extend beyond the last frame of the track.
fn add_pieces(track: &FittedTrack, span: Range<usize>, tolerance: &Tolerance, pieces: &mut Vec<LinearPiece>) {
    let frames = span.start..span.end.min(track.len());
    let visible_count = frames.clone().filter(|&frame| track.is_visible(frame)).count();
    if visible_count == 0 {
        return;
    }
    if visible_count == frames.len() {
        let piece = fit_piece(track, frames.clone());
        if frames.len() == 1 || is_within(track, &piece, tolerance) {
            return pieces.push(piece);
        }
    }
    let middle = span.start.midpoint(span.end);
    add_pieces(track, span.start..middle, tolerance, pieces);
    add_pieces(track, middle..span.end, tolerance, pieces);
}

/// Returns the position of the Gaussian at `time` according to `piece`, in scene units.
fn position_at(piece: &LinearPiece, time: f64) -> [f64; 3] {
    std::array::from_fn(|c| piece.position[c] + piece.velocity[c] * (time - piece.mid_time))
}

/// Returns the best piece of linear motion for `frames` of `track` (states of a Gaussian at all frames): a least
/// squares fit of the positions, and the means of all other attributes.
fn fit_piece(track: &FittedTrack, frames: Range<usize>) -> LinearPiece {
    let count = frames.len() as f64;
    let (first, last) = (track.times[frames.start], track.times[frames.end - 1]);
    let (mid_time, half) = (first.midpoint(last), ((last - first) / 2.0).max(f64::MIN_POSITIVE));
    let samples = frames.clone().map(|frame| ((track.times[frame] - mid_time) / half, track.position[frame], 1.0));
    let [position, velocity] =
        if frames.len() > 1 { polynomial(samples, 0.0) } else { [track.position[frames.start], [0.0; 3]] };
    let mean = |value: &dyn Fn(usize) -> f64| frames.clone().map(value).sum::<f64>() / count;
    let rotation: [f64; 4] = std::array::from_fn(|c| mean(&|frame| track.rotation[frame][c]));
    let length = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    LinearPiece {
        mid_time,
        position,
        velocity: if frames.len() > 1 { velocity.map(|v| v / half) } else { velocity },
        rotation: if length > 1e-6 { rotation.map(|x| x / length) } else { track.rotation[frames.start] },
        log_scale: std::array::from_fn(|c| mean(&|frame| track.log_scale[frame][c])),
        opacity: mean(&|frame| track.opacity[frame]),
        sh: track.mean_sh(mean),
        frames,
    }
}

/// Returns whether `piece` (linear motion) differs from `track` (states of a Gaussian at all frames) by at most
/// `tolerance` at every frame of the piece.
fn is_within(track: &FittedTrack, piece: &LinearPiece, tolerance: &Tolerance) -> bool {
    let near = |a: f64, b: f64, within: f64| (a - b).abs() <= within;
    piece.frames.clone().all(|frame| {
        track.distance_in_middle_scales(frame, position_at(piece, track.times[frame])) <= tolerance.position
            && track.rotation_error(frame, piece.rotation) <= tolerance.rotation
            && near(track.opacity[frame], piece.opacity, tolerance.opacity)
            && (0..3).all(|c| near(track.log_scale[frame][c], piece.log_scale[c], tolerance.log_scale))
            && track.sh(frame).iter().zip(&piece.sh).all(|(a, b)| near(f64::from(*a), f64::from(*b), tolerance.sh))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the track (states at all frames) of a round Gaussian of scale e⁻³, with its position and opacity given
    /// as functions of time.
    pub(super) fn track(
        frames: usize,
        position: impl Fn(f64) -> [f64; 3],
        opacity: impl Fn(f64) -> f64,
    ) -> FittedTrack {
        let times: Vec<f64> = (0..frames).map(|i| i as f64 / frames as f64).collect();
        FittedTrack {
            position: times.iter().map(|&t| position(t)).collect(),
            rotation: vec![[1.0, 0.0, 0.0, 0.0]; frames],
            log_scale: vec![[-3.0; 3]; frames],
            opacity: times.iter().map(|&t| opacity(t)).collect(),
            sh: vec![vec![0.5, -0.5, 0.0]],
            times,
        }
    }

    #[test]
    fn linear_motion_is_one_piece_and_a_bend_splits_it() {
        let mut misfit = FitError::default();
        let one = fit_lines(&track(50, |t| [1.0 + 2.0 * t, -t, 0.0], |_| 0.7), &Tolerance::default(), &mut misfit);
        assert_eq!(one.len(), 1);
        assert!(
            (one[0].velocity[0] - 2.0).abs() < 1e-9 && one[0].frames == (0..50) && misfit.max_position_error < 1e-9
        );
        let bent = track(50, |t| [(t - 0.4).abs(), 0.0, 0.0], |_| 0.7);
        let pieces = fit_lines(&bent, &Tolerance::default(), &mut misfit);
        // The motion bends in frame 20, so the pieces are frames 0 to 15, 16 to 19, and from 20 on.
        assert!(pieces.len() >= 3 && pieces.len() <= 8, "{} pieces", pieces.len());
        assert_eq!(pieces.iter().map(|piece| piece.frames.len()).sum::<usize>(), 50);
        assert!(misfit.max_position_error <= 0.1 && misfit.states == 100, "{misfit:?}");
    }

    #[test]
    fn invisible_frames_have_no_piece_and_tracks_may_pause() {
        let mut misfit = FitError::default();
        let blink = track(60, |_| [0.0; 3], |t| if (0.2..0.4).contains(&t) || t > 0.7 { 0.5 } else { 0.001 });
        let pieces = fit_lines(&blink, &Tolerance::default(), &mut misfit);
        let frames: Vec<_> = pieces.iter().map(|piece| piece.frames.clone()).collect();
        assert_eq!(frames, [12..16, 16..24, 43..44, 44..48, 48..60]);
        let mut broken = track(5, |_| [0.0; 3], |_| 0.5);
        broken.position[2][1] = f64::NAN;
        // The pieces are frames 0 and 1, frame 3, and frame 4.
        assert_eq!(fit_lines(&broken, &Tolerance::default(), &mut misfit).len(), 3);
    }

    #[test]
    fn every_frame_of_a_wild_track_is_within_tolerance() {
        let mut misfit = FitError::default();
        let mut wild = track(200, |t| [(37.0 * t).sin(), (23.0 * t).cos(), t * t], |t| 0.5 + 0.4 * (50.0 * t).sin());
        for (frame, (rotation, scale)) in wild.rotation.iter_mut().zip(&mut wild.log_scale).enumerate() {
            let angle = frame as f64 / 40.0;
            (*rotation, *scale) = ([angle.cos(), angle.sin(), 0.0, 0.0], [-3.0, -2.0, -4.0 + angle]);
        }
        let pieces = fit_lines(&wild, &Tolerance::default(), &mut misfit);
        assert!(pieces.iter().all(|piece| is_within(&wild, piece, &Tolerance::default()) || piece.frames.len() == 1));
        assert!(pieces.windows(2).all(|pair| pair[0].frames.end == pair[1].frames.start));
        assert!(
            misfit.max_position_error <= 0.1 && misfit.max_opacity_error <= 0.02 && misfit.states == 200,
            "{misfit:?}"
        );
    }
}
