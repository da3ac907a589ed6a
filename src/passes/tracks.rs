//! Passes over trajectories: every Gaussian with its attributes at all frames, a block of Gaussians at a time on each
//! thread.

use std::ops::Range;

use rayon::prelude::*;

use crate::error::Result;
use crate::fit::FittedTrack;
use crate::model::{Attributes, Gaussians};
use crate::progress::Progress;
use crate::source::{FrameSource, Ids};

/// Number of Gaussians whose attributes at all frames a thread holds in memory at once.
pub const TRACKS_PER_BLOCK: usize = 64;

/// Calls `make` with the trajectory of every Gaussian (its attributes at every frame), and returns the results of these
/// calls in the order of the Gaussians. `times` holds the times of the frames, in any unit.
///
/// Memory: the results; on every thread a reader and the attributes of [`TRACKS_PER_BLOCK`] Gaussians at all frames.
pub fn map_tracks<R: Send>(
    source: &dyn FrameSource,
    times: &[f64],
    progress: &Progress,
    make: impl Fn(&FittedTrack) -> R + Sync,
) -> Result<Vec<R>> {
    let info = source.info();
    let tracks_of_block = |ids: Range<usize>| -> Result<Vec<R>> {
        let mut reader = source.open(Ids::Range(ids.clone()))?;
        let mut states: Vec<Gaussians> = Vec::with_capacity(info.times.len());
        let mut want = Attributes::all();
        for frame in 0..info.times.len() {
            // Attributes that do not vary in time keep the values of the previous frame.
            let mut state = states.last().cloned().unwrap_or_else(|| Gaussians::zeros(0, info.sh_degree));
            reader.read(frame, want, &mut state)?;
            want = info.varying;
            states.push(state);
        }
        progress.advance((ids.len() * states.len()) as u64);
        let has_varying_sh = info.varying.contains(Attributes::SH);
        Ok((0..ids.len()).map(|row| make(&FittedTrack::from_states(times, &states, row, has_varying_sh))).collect())
    };
    let blocks: Vec<Vec<R>> = (0..info.count.div_ceil(TRACKS_PER_BLOCK))
        .into_par_iter()
        .map(|block| tracks_of_block(block * TRACKS_PER_BLOCK..info.count.min((block + 1) * TRACKS_PER_BLOCK)))
        .collect::<Result<_>>()?;
    Ok(blocks.into_iter().flatten().collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::opacity;
    use crate::passes::gather_all;

    #[test]
    fn tracks_equal_the_frames_for_any_thread_count() {
        let scene = DemoScene::new(3 * TRACKS_PER_BLOCK + 5, 7);
        let progress = Progress::IGNORED;
        let all = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| map_tracks(&scene, &scene.info().times, &progress, Clone::clone)).unwrap()
        };
        let (one, three) = (all(1), all(3));
        assert_eq!(one.len(), scene.info().count);
        for frame in 0..7 {
            let state = gather_all(&scene, frame, Attributes::all()).unwrap();
            for (row, (a, b)) in one.iter().zip(&three).enumerate() {
                assert_eq!(a.position[frame], state.position_f64(row));
                assert_eq!(a.opacity[frame], opacity(state.opacity_logit.row::<1>(row)[0]));
                assert_eq!(a.sh(frame)[2], state.sh.plane(2)[row]);
                assert_eq!((&a.rotation, &a.position), (&b.rotation, &b.position));
                let length: f64 = a.rotation[frame].iter().map(|x| x * x).sum();
                assert!((length - 1.0).abs() < 1e-12);
            }
        }
    }
}
