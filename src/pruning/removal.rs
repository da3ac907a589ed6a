//! Removal error of each Gaussian of a subset of the input: the squared error that removing this Gaussian alone would
//! cause in the views by which Gaussians are scored.

use crate::error::Result;
use crate::limits::Limits;
use crate::model::{Attributes, Camera, FrameView};
use crate::passes::views::{RenderedSource, Workers};
use crate::render::{GridStrides, PixelGrid, RemovalError, Renderer};
use crate::source::{FrameSource, Ids};

/// Renders only the Gaussians `ids` and returns for each of them the [`RemovalError`], the squared error that removing
/// it would cause, summed over `views`. Only every `stride`-th column and row of pixels is rendered. The square of
/// `contrast_floor` is added to each squared color difference ([`RemovalError::contrast_floor`]). Calls `advance` after
/// each view. The result does not depend on the number of threads. Fails if a frame cannot be read.
///
/// Memory per Gaussian of `ids`, where d is the SH degree and a state has 44 + 12·(d + 1)² bytes:
/// - the memory of the reader of `source`, per Gaussian;
/// - its state at each frame of a batch; a batch has at most 4 × threads views, of at most [`Limits::frames_together`]
///   frames;
/// - its state while its block of Gaussians is read;
/// - for each view rendered at the same time, 8 bytes of sums and the buffers of the view.
///
/// Memory does not grow with the number of frames or views.
pub fn removal_error(
    source: &dyn FrameSource,
    ids: &[u32],
    (cameras, views): (&[Camera], &[FrameView]),
    background: [f32; 3],
    (contrast_floor, strides): (f32, GridStrides),
    limits: Limits,
    advance: impl Fn() + Sync,
) -> Result<RemovalError> {
    let mut workers = Workers::new(limits);
    workers.for_each_view(
        RenderedSource { source, ids: Some(Ids::List(ids)), columns: Attributes::all() },
        cameras,
        views,
        || (Renderer::new(), RemovalError::new(ids.len(), contrast_floor)),
        |(renderer, errors), state, camera| {
            renderer.removal_error(state, PixelGrid::centered(strides).sampled_view(camera), background, errors);
            advance();
        },
    )?;
    let mut sum = RemovalError::new(ids.len(), contrast_floor);
    workers.into_inner().iter().for_each(|(_, thread_sum)| sum.merge(thread_sum));
    Ok(sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::Split;
    use crate::passes::{VIEWS_PER_FRAME, gather, select_evenly};
    use crate::render::ALL_PIXELS;

    #[test]
    fn errors_equal_a_plain_loop_on_any_thread_count() {
        let scene = DemoScene::new(2500, 4);
        let schedule = scene.rig().schedule(&scene.info().times, Some(Split::Train)).unwrap();
        let ids: Vec<u32> = (0..2500).filter(|id| id % 3 != 1).collect();
        let background = [0.1, 0.2, 0.3];
        let mut plain = RemovalError::new(ids.len(), 0.1);
        for (t, views) in schedule.iter().enumerate() {
            let state = gather(&scene, &ids, t, Attributes::all()).unwrap();
            for &(_, camera) in views {
                Renderer::new().removal_error(&state, &schedule.cameras[camera as usize], background, &mut plain);
            }
        }
        assert!(plain.sum.iter().filter(|&&sum| sum > 0).count() > 1000);
        let sample = select_evenly(&schedule, usize::MAX, VIEWS_PER_FRAME);
        assert_eq!(sample.len(), schedule.pair_count());
        let two = Limits { max_kept_frames: 2, frames_together: 2, views_together: 2, ..Limits::NONE };
        for (threads, limits) in [(1, Limits::NONE), (3, Limits::NONE), (3, two)] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let found = pool
                .install(|| {
                    removal_error(
                        &scene,
                        &ids,
                        (&schedule.cameras, &sample),
                        background,
                        (0.1, ALL_PIXELS),
                        limits,
                        || (),
                    )
                })
                .unwrap();
            assert!(found == plain, "{threads} threads");
        }
    }
}
