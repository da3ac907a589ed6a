//! Writers that read a sequence from beginning to end and write it as containers, fitted curves, frame streams, films
//! or tables.
//!
//! Each writer creates the file at the path it is given. Callers pass a temporary name from [`crate::files::atomic`],
//! which moves the finished file to the path that the user asked for.

pub mod bounds;
pub mod container;
pub mod curves;
pub mod film;
pub mod four_dgs;
pub mod frame_stream;
pub mod gsd;
pub mod index_map;
pub mod kind;
pub mod rows;
pub mod time_windows;

use crate::error::Result;
use crate::fit::{FitError, FittedTrack};
use crate::passes::map_tracks;
use crate::progress::Events;
use crate::source::FrameSource;

/// Fits motions to the track of every Gaussian of `source`. `times` holds the times of the frames, in any unit. `fit`
/// returns the motions for one track, and adds their errors to the given record. Returns the motions of each Gaussian,
/// and the errors of all of them.
fn fit_tracks<T: Send>(
    source: &dyn FrameSource,
    times: &[f64],
    events: &Events,
    fit: impl Fn(&FittedTrack, &mut FitError) -> Vec<T> + Sync,
) -> Result<(Vec<Vec<T>>, FitError)> {
    let progress = events.task("emit", "states", (source.info().count * times.len()) as u64);
    let found = map_tracks(source, times, &progress, |track| {
        let mut misfit = FitError::default();
        (fit(track, &mut misfit), misfit)
    })?;
    let (motions, misfits): (Vec<Vec<T>>, Vec<FitError>) = found.into_iter().unzip();
    Ok((motions, misfits.into_iter().fold(FitError::default(), FitError::merged_with)))
}

#[cfg(test)]
mod tests {
    use crate::model::{Gaussians, opacity};

    /// Returns the opacity of Gaussian `id` of the frame state `state`, and the opacities in `shown` that belong to
    /// positions near it: closer than half its largest scale. `shown` has the position and opacity of everything that a
    /// player shows at this frame. Returns `None` if the opacity of the Gaussian is below 0.1.
    pub(super) fn opacities_near(state: &Gaussians, id: usize, shown: &[([f64; 3], f64)]) -> Option<(f64, Vec<f64>)> {
        let visible = opacity(state.opacity_logit.row::<1>(id)[0]);
        let at = state.position_f64(id);
        let size = f64::from(state.log_scale.row::<3>(id).iter().copied().fold(f32::MIN, f32::max)).exp();
        let distance = |place: [f64; 3]| (0..3).map(|c| (place[c] - at[c]).powi(2)).sum::<f64>().sqrt() / size;
        let near = shown.iter().filter(|(place, _)| distance(*place) < 0.5).map(|&(_, alpha)| alpha);
        (visible >= 0.1).then(|| (visible, near.collect()))
    }

    /// Returns the blended opacity 1 − Π(1 − α) of all Gaussians that are shown at one position; `near` holds their
    /// opacities α. Gaussians other than the one under test may lie there and raise the result. So a test can only
    /// conclude from a low result that the Gaussian is missing.
    pub(super) fn blended(near: &[f64]) -> f64 {
        1.0 - near.iter().map(|alpha| (1.0 - alpha).ln()).sum::<f64>().exp()
    }
}
