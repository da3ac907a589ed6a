//! Visible contribution: how much every Gaussian adds to the views by which Gaussians are scored, occlusion included.
//!
//! Input: a source of frames, the cameras, and the views to render. Output, for every Gaussian: the contribution C
//! `visible` (Σ alpha · transmittance over the pixels of a view, averaged over the views) and the peak W (largest alpha
//! · transmittance in one pixel); see method.md, section 1. The results are sums of integers and maxima, so the order
//! of views, threads and batches does not change a bit.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::limits::Limits;
use crate::model::{Attributes, Camera, FrameView};
use crate::passes::views::{RenderedSource, Workers};
use crate::progress::Events;
use crate::render::{Contribution, Renderer};
use crate::source::{FrameSource, Ids};

/// Attributes that the contribution depends on: all except color.
const GEOMETRY: Attributes = Attributes::all().difference(Attributes::SH);

/// Contributions of all N Gaussians to the views by which Gaussians are scored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VisibleContribution {
    /// `[N]`, contribution C in pixels: Σ alpha · transmittance over the pixels of a view, averaged over the views. If
    /// only a grid of pixels is rendered, each pixel counts for the stride² pixels that it stands for.
    pub coverage: Vec<f64>,
    /// `[N]`, peak W: maximum alpha · transmittance in any rendered pixel of any view, in [0, 0.99].
    pub peak: Vec<f64>,
}

impl VisibleContribution {
    /// Computes the contributions C (mean per view, pixels) and the peaks W (largest alpha · transmittance) from sums
    /// and maxima over rendered views. `view_count`: number of these views. `pixel_stride`: only every n-th column and
    /// row of their pixels was rendered.
    pub fn from_sums(sums: &Contribution, view_count: usize, pixel_stride: NonZeroU32) -> VisibleContribution {
        let per_pixel = f64::from(pixel_stride.get()).powi(2);
        let coverage = (0..sums.len()).map(|i| sums.in_pixels(i) * per_pixel / view_count.max(1) as f64).collect();
        VisibleContribution { coverage, peak: sums.max.iter().map(|&max| f64::from(max)).collect() }
    }
}

/// Renders `views` and returns the contribution of every Gaussian, summed over the views. Only every `pixel_stride`-th
/// column and row of pixels is rendered. [`VisibleContribution::from_sums`] converts the result to C (mean contribution
/// per view) and W (largest weight in a pixel).
///
/// A Gaussian with NaN or infinity in a frame adds nothing in this frame, and a view without pixels adds nothing.
/// Without views all results are zero. Fails if a frame cannot be read.
///
/// Memory per Gaussian: that of the reader of the frames, and that of [`RunningContribution`]. Memory does not grow
/// with the number of frames or views.
pub fn visible_contribution(
    source: &dyn FrameSource,
    (cameras, views): (&[Camera], &[FrameView]),
    pixel_stride: NonZeroU32,
    limits: Limits,
    events: &Events,
) -> Result<Contribution> {
    let progress = events.task("visible", "views", views.len() as u64);
    let mut running = RunningContribution::new(source.info().count, pixel_stride, limits);
    running.add(source, cameras, views, || progress.advance(1))?;
    Ok(running.sum())
}

/// Running sums of the contributions of every Gaussian to all views rendered so far.
///
/// Memory per Gaussian:
/// - 44 bytes for its state at each frame of a batch; a batch has at most 4 × threads views, of at most
///   [`Limits::frames_together`] frames;
/// - 44 bytes for its state while its block of Gaussians is read;
/// - for each view rendered at the same time, 12 bytes of sums and the buffers of the view ([`crate::render`]).
pub struct RunningContribution {
    count: usize,
    pixel_stride: NonZeroU32,
    view_count: usize,
    workers: Workers<(Renderer, Contribution)>,
}

impl RunningContribution {
    /// Creates the sums for `count` Gaussians, all 0. Only every `pixel_stride`-th column and row of pixels of the
    /// views will be rendered.
    pub fn new(count: usize, pixel_stride: NonZeroU32, limits: Limits) -> Self {
        RunningContribution { count, pixel_stride, view_count: 0, workers: Workers::new(limits) }
    }

    /// Renders `views` (frames of `source` seen by `cameras`), in the order of frames, and adds the contributions of
    /// the Gaussians to the sums. Every call must pass a source of the same Gaussians. Calls `advance` after each view.
    /// Fails if a frame cannot be read.
    pub fn add(
        &mut self,
        source: &dyn FrameSource,
        cameras: &[Camera],
        views: &[FrameView],
        advance: impl Fn() + Sync,
    ) -> Result<()> {
        let (count, pixel_stride) = (self.count, self.pixel_stride);
        self.view_count += views.len();
        self.workers.for_each_view(
            RenderedSource { source, ids: Some(Ids::Range(0..count)), columns: GEOMETRY },
            cameras,
            views,
            || (Renderer::new(), Contribution::new(count)),
            |(renderer, seen), state, camera| {
                renderer.contribution(state, camera, pixel_stride, seen);
                advance();
            },
        )
    }

    /// Returns two values of every Gaussian over all views added so far: its contribution C (Σ alpha · transmittance
    /// over the pixels of a view, averaged over the views) and its peak W (largest alpha · transmittance in one pixel).
    pub fn finish(self) -> VisibleContribution {
        let (view_count, pixel_stride) = (self.view_count, self.pixel_stride);
        VisibleContribution::from_sums(&self.sum(), view_count, pixel_stride)
    }

    fn sum(self) -> Contribution {
        let mut sum = Contribution::new(self.count);
        self.workers.into_inner().iter().for_each(|(_, thread_sum)| sum.merge(thread_sum));
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::{AnomalyFlags, Gaussians, Rig, SequenceInfo, Split, StatisticRows, ViewSchedule};
    use crate::passes::scoring_views;
    use crate::pruning::select;
    use crate::recipe::{self, Recipe};
    use crate::render;
    use crate::source::BlockReader;
    use crate::statistics::score;

    fn strides(pixel: u32, view: u32, frame: u32) -> recipe::ScanParams {
        let [pixel_stride, view_stride, frame_stride] = [pixel, view, frame].map(|n| NonZeroU32::new(n).unwrap());
        recipe::ScanParams {
            pixel_stride,
            view_stride,
            frame_stride,
            scoring_views: 0,
            ..Recipe::preset("default").unwrap().scan
        }
    }

    fn on_threads<R: Send>(threads: usize, work: impl FnOnce() -> R + Send) -> R {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
    }

    #[test]
    fn contributions_equal_a_plain_loop_on_any_thread_count() {
        let scene = DemoScene::new(2500, 7);
        let schedule = scene.rig().schedule(&scene.info().times, Some(Split::Train)).unwrap();
        for (pixel, view, frame) in [(1, 1, 1), (3, 2, 2)] {
            let scan = strides(pixel, view, frame);
            let mut plain = Contribution::new(2500);
            let mut view_count = 0;
            for (frame_index, t) in (0..7).step_by(frame as usize).enumerate() {
                let mut state = Gaussians::zeros(2500, scene.info().sh_degree);
                scene.open(Ids::Range(0..2500)).unwrap().read(t, Attributes::all(), &mut state).unwrap();
                for &(_, camera) in schedule.views(t).iter().skip(frame_index % view as usize).step_by(view as usize) {
                    let camera = &schedule.cameras[camera as usize];
                    render::contribution(&state, camera, scan.pixel_stride, &mut plain);
                    view_count += 1;
                }
            }
            let sample = scoring_views(&schedule, &scan, 1);
            let frames = sample.chunk_by(|a, b| a.frame == b.frame).count();
            assert_eq!((sample.len(), frames), (view_count, 7usize.div_ceil(frame as usize)));
            let one = Limits { max_kept_frames: 1, frames_together: 1, views_together: 1, ..Limits::NONE };
            for (threads, limits) in [(1, Limits::NONE), (2, Limits::NONE), (5, Limits::NONE), (3, one)] {
                let look = || {
                    visible_contribution(
                        &scene,
                        (&schedule.cameras, &sample),
                        scan.pixel_stride,
                        limits,
                        &Events::IGNORED,
                    )
                    .unwrap()
                };
                let seen = VisibleContribution::from_sums(&on_threads(threads, look), sample.len(), scan.pixel_stride);
                for i in 0..2500 {
                    let expected = plain.in_pixels(i) * f64::from(pixel * pixel) / view_count as f64;
                    assert_eq!(seen.coverage[i], expected, "C of {i} on {threads} threads");
                    assert_eq!(seen.peak[i], f64::from(plain.max[i]), "W of {i} on {threads} threads");
                }
            }
        }
    }

    #[test]
    fn a_sampled_pixel_counts_for_all_it_skips() {
        let scene = DemoScene::new(1200, 3);
        let schedule = scene.rig().schedule(&scene.info().times, Some(Split::Train)).unwrap();
        let total = |pixel| {
            let scan = strides(pixel, 1, 1);
            let sample = (&schedule.cameras[..], &scoring_views(&schedule, &scan, 1)[..]);
            let found =
                visible_contribution(&scene, sample, scan.pixel_stride, Limits::NONE, &Events::IGNORED).unwrap();
            VisibleContribution::from_sums(&found, sample.1.len(), scan.pixel_stride).coverage.iter().sum::<f64>()
        };
        let (all, third) = (total(1), total(3));
        assert!((third / all - 1.0).abs() < 0.02, "got {third}, expected about {all}");
    }

    #[test]
    fn strides_rotate_views_and_keep_at_least_one() {
        let camera = Camera::look_at(glam::DVec3::X, glam::DVec3::ZERO, 1.0, (8, 8));
        let views = |from: u32, to: u32| (from..to).map(|view| (view, view)).collect::<Vec<_>>();
        // The first frame has no view among the training views.
        let mut schedule = ViewSchedule::new((0..3).map(|_| camera.clone()).collect());
        for (count, seen) in [(1, views(0, 0)), (2, views(0, 3)), (1, views(0, 0)), (2, views(0, 3))] {
            schedule.push_frames(count, &seen);
        }
        let taken = |view, frame| -> Vec<(usize, u32)> {
            let sample = scoring_views(&schedule, &strides(1, view, frame), 1);
            sample.iter().map(|frame_view| (frame_view.frame, frame_view.camera)).collect()
        };
        assert_eq!(taken(3, 1), [(1, 0), (2, 1), (4, 2), (5, 0)]);
        assert_eq!(taken(2, 2), [(1, 0), (1, 2), (4, 1)]);
        assert_eq!(taken(100, 100), [(1, 0)]);
    }

    /// Source of frames that all show the same Gaussians.
    struct Static(Gaussians, SequenceInfo);

    impl FrameSource for Static {
        fn info(&self) -> &SequenceInfo {
            &self.1
        }
        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(Picked(self.0.pick(&ids.iter().map(|id| id as u32).collect::<Vec<_>>()))))
        }
    }

    struct Picked(Gaussians);

    impl BlockReader for Picked {
        fn read(&mut self, _: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            want.iter().for_each(|column| *out.attribute_values_mut(column) = self.0.attribute_values(column).clone());
            Ok(())
        }
    }

    #[test]
    fn fully_occluded_gaussians_are_pruned_first() {
        // A bright and large Gaussian is hidden behind four opaque walls; a faint one is in front of them.
        const HIDDEN: usize = 5;
        const FAINT: usize = 0;
        let count = 40;
        let mut state = Gaussians::zeros(count, 0);
        for i in 0..count {
            let (y, size, logit) = match i {
                FAINT => (-1.0, -4.0, -4.0f32),
                HIDDEN => (3.0, -1.0, 6.0),
                1..5 => (0.1 * i as f32, 4.0, 12.0),
                _ => (-1.0, -2.0, 0.0),
            };
            state.position.set_row(i, [0.02 * i as f32 - 0.4, y, 0.0]);
            state.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
            state.log_scale.set_row(i, [size, if size > 0.0 { -5.0 } else { size }, size]);
            state.opacity_logit.set_row(i, [logit]);
        }
        let info = SequenceInfo { count, times: vec![0.0, 1.0], sh_degree: 0, varying: Attributes::empty() };
        let rig = Rig {
            cameras: vec![Camera::look_at(glam::DVec3::new(0.0, -4.0, 0.0), glam::DVec3::ZERO, 1.0, (64, 48))],
            views: vec![crate::model::RigView { view: 0, camera: 0, time: None, split: Split::Train, image: None }],
            background: None,
            origin: "test".into(),
        };
        let schedule = rig.schedule(&info.times, None).unwrap();
        let recipe = Recipe::preset("default").unwrap();
        let sample = scoring_views(&schedule, &recipe.scan, 1);
        let seen = visible_contribution(
            &Static(state, info),
            (&schedule.cameras, &sample),
            recipe.scan.pixel_stride,
            Limits::NONE,
            &Events::IGNORED,
        )
        .unwrap();
        let seen = VisibleContribution::from_sums(&seen, sample.len(), recipe.scan.pixel_stride);
        assert_eq!((seen.coverage[HIDDEN], seen.peak[HIDDEN]), (0.0, 0.0));
        assert!(seen.coverage[FAINT] > 0.0 && seen.peak[FAINT] > 0.0);

        let zeros = || vec![0.0; count];
        let rows = StatisticRows {
            d: zeros(),
            kappa: zeros(),
            v: zeros(),
            life: vec![2; count],
            c: seen.coverage,
            w: seen.peak,
            e: zeros(),
            vis: vec![1.0; count],
            flags: vec![AnomalyFlags::empty(); count],
        };
        let scores = score::score(&rows, 2, &recipe.score);
        let selection = select(&scores, &recipe.select, &[], &[]).unwrap();
        let unseen: Vec<bool> = selection.ranking.order().iter().map(|&id| rows.c[id as usize] == 0.0).collect();
        assert!(unseen.is_sorted() && unseen.iter().filter(|&&unseen| unseen).count() < 5, "{unseen:?}");
    }

    #[test]
    fn without_views_or_gaussians_results_are_zero() {
        let scene = DemoScene::new(300, 2);
        let mut schedule = ViewSchedule::default();
        schedule.push_frames(2, &[]);
        let look = |source: &dyn FrameSource, schedule: &ViewSchedule| {
            let sample = scoring_views(schedule, &strides(1, 1, 1), 1);
            let sample = (&schedule.cameras[..], &sample[..]);
            let found = visible_contribution(source, sample, NonZeroU32::MIN, Limits::NONE, &Events::IGNORED).unwrap();
            VisibleContribution::from_sums(&found, sample.1.len(), NonZeroU32::MIN)
        };
        let seen = look(&scene, &schedule);
        assert_eq!(seen, VisibleContribution { coverage: vec![0.0; 300], peak: vec![0.0; 300] });
        let none = Static(Gaussians::zeros(0, 0), SequenceInfo { count: 0, ..scene.info().clone() });
        let schedule = scene.rig().schedule(&scene.info().times, None).unwrap();
        let seen = look(&none, &schedule);
        assert!(seen.coverage.is_empty() && seen.peak.is_empty());
    }
}
