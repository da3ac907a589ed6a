//! Passes over views: these functions read the Gaussians at the frame of each view and call a function with batches of
//! views.
//!
//! Views are processed in the order of their frames, because a render needs all Gaussians of its frame at once to
//! account for occlusion. Frames are read in blocks of Gaussians on all threads; then the views of a batch of frames
//! are distributed among the threads.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use glam::DVec3;
use rayon::prelude::*;

use super::FrameReaders;
use super::frames::open_all;
use crate::error::Result;
use crate::limits::Limits;
use crate::model::{AttributeValues, Attributes, Camera, FrameView, Gaussians};
use crate::render::{Image, blend_features, render};
use crate::source::{BlockReader, FeatureDecoder, FrameSource, Ids, ReadPlan};

/// Number of views per thread in a batch (views that are processed together, in parallel). With fewer, threads would
/// wait longer for the last view of each batch.
pub const VIEWS_PER_THREAD: usize = 4;

/// Selection of the Gaussians of a frame source to render, and of the attributes to read for this.
pub struct RenderedSource<'a> {
    /// Frame source that is read.
    pub source: &'a dyn FrameSource,
    /// Ids of the Gaussians to render; their readers stay open over all frames. `None`: all Gaussians, read in the way
    /// that is cheapest for the source ([`FrameSource::open_all`]).
    pub ids: Option<Ids<'a>>,
    /// Attributes that are read; all other attributes stay empty.
    pub columns: Attributes,
}

impl<'a> RenderedSource<'a> {
    /// Selects all Gaussians of `source`, with all attributes.
    pub fn all_gaussians(source: &'a dyn FrameSource) -> RenderedSource<'a> {
        RenderedSource { source, ids: None, columns: Attributes::all() }
    }

    /// Returns the decoder that computes the colors of pixels from blended features of the Gaussians (values that take
    /// the place of colors). Returns `None` if the source has no such decoder, or if only some Gaussians are rendered.
    fn decoder(&self) -> Option<&'a dyn FeatureDecoder> {
        self.source.decoder().filter(|_| self.ids.is_none())
    }

    fn open(&self, plan: &ReadPlan) -> Result<Box<dyn BlockReader + 'a>> {
        Ok(match &self.ids {
            Some(ids) => Box::new(FrameReaders::open(self.source, ids.clone(), self.columns, plan)?),
            None => open_all(self.source, self.columns, plan)?,
        })
    }
}

/// Limits on the size of a batch of views, and on the frames that readers keep in memory.
#[derive(Debug, Clone, Copy)]
pub struct BatchLimits {
    /// Maximum number of different frames in a batch. For each of these frames, the Gaussians of every rendered source
    /// are in memory.
    pub frames: usize,
    /// Maximum number of views in a batch (views that are processed together, in parallel).
    pub views: usize,
    /// Maximum number of decoded frames that a reader keeps in memory, for readers that decode several frames together.
    pub max_kept_frames: usize,
}

impl BatchLimits {
    /// Returns limits for many views that take little memory each: a batch has views of several frames, to keep all
    /// threads busy.
    fn many_views(limits: &Limits) -> BatchLimits {
        let views = VIEWS_PER_THREAD * rayon::current_num_threads();
        BatchLimits { frames: limits.frames_together, views, max_kept_frames: limits.max_kept_frames }
    }

    /// Returns limits for views whose renders stay in memory until their batch ends: a batch has one frame, and at most
    /// one view per thread.
    pub fn one_frame(limits: &Limits) -> BatchLimits {
        let views = rayon::current_num_threads().min(limits.views_together);
        BatchLimits { frames: 1, views, max_kept_frames: limits.max_kept_frames }
    }

    /// Returns the number of views at the start of `views` that form the next batch within these limits.
    fn batch_length(&self, views: &[FrameView]) -> usize {
        let (mut frames, mut last) = (0, None);
        let fits = |view: &&FrameView| {
            frames += usize::from(last != Some(view.frame));
            last = Some(view.frame);
            frames <= self.frames.max(1)
        };
        views.iter().take(self.views.max(1)).take_while(fits).count()
    }
}

/// View to render, with the Gaussians of `S` sources (the subjects) at the view's frame.
#[derive(Clone, Copy)]
pub struct RenderableView<'a, const S: usize> {
    /// The view: its frame, view number and camera index.
    pub frame_view: FrameView,
    /// Camera of the view.
    pub camera: &'a Camera,
    /// Gaussians of each subject (rendered source) at the view's frame.
    pub states: [&'a Gaussians; S],
    /// For each subject (rendered source): the decoder that computes pixel colors from features, and the features of
    /// its Gaussians at the view's frame. `None` for a subject whose colors are not computed from features.
    decoded: [Option<(&'a dyn FeatureDecoder, &'a AttributeValues)>; S],
}

impl<const S: usize> RenderableView<'_, S> {
    /// Renders the subject (source) with index `subject` over `background` on all threads of the pool, and returns the
    /// image.
    ///
    /// If the subject has features, the renderer blends these in place of colors, and the decoder of its model computes
    /// the color of each pixel from them. `background` is then ignored.
    pub fn render(&self, subject: usize, background: [f32; 3]) -> Image {
        self.render_as(subject, self.states[subject], self.features(subject), background)
    }

    /// Returns the features (values that take the place of colors) of the Gaussians of the subject with index
    /// `subject`; `None` if its colors are not computed from features.
    pub fn features(&self, subject: usize) -> Option<&AttributeValues> {
        self.decoded[subject].map(|(_, features)| features)
    }

    /// Renders the Gaussians `state` with the camera of this view over `background` and returns the image. A view has
    /// one or more subjects (sources of Gaussians to render), such as the original and the compressed model. `state`
    /// takes the place of the Gaussians of the subject with index `subject`.
    ///
    /// `features` takes the place of the features of this subject and must have one row per Gaussian of `state`. The
    /// decoder of the subject's model computes the pixel colors from them, and `background` is ignored. If `features`
    /// is `None` or the subject has no features, the Gaussians are rendered with their own colors.
    pub fn render_as(
        &self,
        subject: usize,
        state: &Gaussians,
        features: Option<&AttributeValues>,
        background: [f32; 3],
    ) -> Image {
        let camera = self.camera;
        let Some(((decoder, _), features)) = self.decoded[subject].zip(features) else {
            return render(state, camera, background);
        };
        let mut image = Image { width: camera.width, height: camera.height, data: Vec::new() };
        let values = blend_features(state, features, camera);
        let (center, to_world) = (camera.center().to_array().map(|x| x as f32), camera.rotation.transpose());
        let color = |(pixel, values): (usize, &[f32])| {
            let [x, y] = [pixel % camera.width as usize, pixel / camera.width as usize].map(|at| at as f64 + 0.5);
            let ray = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0).normalize();
            decoder.color(values, center, (to_world * ray).to_array().map(|x| x as f32))
        };
        let colors = values.par_chunks_exact(features.width().max(1)).enumerate().map(color);
        image.data = colors.collect::<Vec<[f32; 3]>>().into_flattened();
        image
    }
}

/// Gaussians of all subjects (rendered sources) at one frame, in buffers that are reused for later frames.
struct StateSlot<const S: usize> {
    frame: usize,
    states: [Gaussians; S],
    /// Features (values that take the place of colors) of the Gaussians of each subject; empty for a subject whose
    /// colors are not computed from features.
    features: [AttributeValues; S],
}

/// Reads the Gaussians of all `subjects` for `views` and calls `visit` with batches of these views, in order. `views`
/// must be sorted by frame; their camera indices refer to `cameras`. Every frame is read once.
///
/// A batch has one buffer for each of its frames, which later batches use again. Attributes that do not vary in time
/// are therefore read only once into each buffer.
///
/// Memory: for each subject its reader, the frames that this reader keeps, and the Gaussians at every frame of a batch.
///
/// # Errors
/// Fails if a frame cannot be read or if `visit` fails.
pub fn for_each_view_batch<const S: usize>(
    subjects: [RenderedSource<'_>; S],
    cameras: &[Camera],
    views: &[FrameView],
    max_batch: BatchLimits,
    mut visit: impl FnMut(&[RenderableView<'_, S>]) -> Result<()>,
) -> Result<()> {
    let wanted = ReadPlan::new(views.iter().map(|view| view.frame)).with_max_kept_frames(max_batch.max_kept_frames);
    let mut readers = Vec::with_capacity(S);
    for subject in &subjects {
        readers.push(subject.open(&wanted)?);
    }
    let mut slots: Vec<StateSlot<S>> = Vec::new();
    let mut rest = views;
    while !rest.is_empty() {
        let (batch, later) = rest.split_at(max_batch.batch_length(rest));
        rest = later;
        // If a frame has more views than a batch, a slot holds its Gaussians already.
        if let Some(slot) = slots.iter().position(|slot| slot.frame == batch[0].frame) {
            slots.swap(0, slot);
        }
        for (index, frame_views) in batch.chunk_by(|a, b| a.frame == b.frame).enumerate() {
            let frame = frame_views[0].frame;
            let is_new = index == slots.len();
            if is_new {
                let states = std::array::from_fn(|k| Gaussians::zeros(0, subjects[k].source.info().sh_degree));
                slots.push(StateSlot { frame, states, features: std::array::from_fn(|_| AttributeValues::default()) });
            } else if slots[index].frame == frame {
                continue;
            }
            let slot = &mut slots[index];
            for ((subject, reader), state) in subjects.iter().zip(&mut readers).zip(&mut slot.states) {
                let varying = subject.source.info().varying;
                let want = if is_new { subject.columns } else { subject.columns & varying };
                reader.read(frame, want, state)?;
            }
            for (subject, features) in subjects.iter().zip(&mut slot.features) {
                if let Some(decoder) = subject.decoder() {
                    decoder.features(frame, features)?;
                }
            }
            slot.frame = frame;
        }
        let frames = batch.chunk_by(|a, b| a.frame == b.frame).zip(&slots);
        let view_states: Vec<RenderableView<'_, S>> = frames
            .flat_map(|(frame_views, StateSlot { states, features, .. })| {
                let decoded = std::array::from_fn(|k| Some((subjects[k].decoder()?, &features[k])));
                frame_views.iter().map(move |&frame_view| RenderableView {
                    frame_view,
                    camera: &cameras[frame_view.camera as usize],
                    states: states.each_ref(),
                    decoded,
                })
            })
            .collect();
        visit(&view_states)?;
    }
    Ok(())
}

/// Set of workers, each a value of type `W` that accumulates results over the views passed to it. At most one worker
/// per thread works at a time.
///
/// Memory per Gaussian:
/// - the memory of the reader of the frames, per Gaussian;
/// - its attributes at each frame of a batch (at most 4 × threads views and [`Limits::frames_together`] frames);
/// - the memory of all workers, per Gaussian; there are at most [`Limits::views_together`] workers.
pub(crate) struct Workers<W> {
    limits: Limits,
    /// Workers that process no view at the moment.
    free: Mutex<Vec<W>>,
}

impl<W: Send> Workers<W> {
    /// Creates an empty set of workers. Workers are added as soon as views are passed to them.
    pub(crate) fn new(limits: Limits) -> Self {
        Workers { limits, free: Mutex::default() }
    }

    /// Calls `visit` once for each of `views`, on several threads. Arguments of `visit`: a worker, which accumulates
    /// results; the Gaussians of `subject` at the frame of the view; and the camera of the view, an element of
    /// `cameras`. `new_worker` creates a worker if all others are busy.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub(crate) fn for_each_view(
        &mut self,
        subject: RenderedSource<'_>,
        cameras: &[Camera],
        views: &[FrameView],
        new_worker: impl Fn() -> W + Sync,
        visit: impl Fn(&mut W, &Gaussians, &Camera) + Sync,
    ) -> Result<()> {
        let workers = rayon::current_num_threads().min(self.limits.views_together);
        for_each_view_batch([subject], cameras, views, BatchLimits::many_views(&self.limits), |batch| {
            let next = AtomicUsize::new(0);
            (0..workers.min(batch.len())).into_par_iter().with_max_len(1).for_each(|_| {
                let free = self.free.lock().unwrap_or_else(PoisonError::into_inner).pop();
                let mut worker = free.unwrap_or_else(&new_worker);
                while let Some(&RenderableView { camera, states: [state], .. }) =
                    batch.get(next.fetch_add(1, Ordering::Relaxed))
                {
                    visit(&mut worker, state, camera);
                }
                self.free.lock().unwrap_or_else(PoisonError::into_inner).push(worker);
            });
            Ok(())
        })
    }

    /// Returns the workers in no particular order. Their results must be combined in a way that does not depend on this
    /// order.
    pub(crate) fn into_inner(self) -> Vec<W> {
        self.free.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::passes::gather_all;

    /// Returns the views 0 to `views` − 1 of every frame of `frames`.
    fn frame_views(frames: &[usize], views: u32) -> Vec<FrameView> {
        let of_frame = |&frame: &usize| (0..views).map(move |view| FrameView { frame, view, camera: view });
        frames.iter().flat_map(of_frame).collect()
    }

    #[test]
    fn every_view_comes_once_with_its_state_for_any_batch_size() {
        let scene = DemoScene::new(1500, 9);
        let rig = scene.rig();
        let all = frame_views(&[0, 2, 3, 7, 8], 3);
        let expected: Vec<Gaussians> =
            (0..9).map(|frame| gather_all(&scene, frame, Attributes::all()).unwrap()).collect();
        for (frames, max_batch) in [(1, 1), (1, 2), (1, 9), (2, 4), (3, 7), (9, 99), (0, 0)] {
            let mut seen = Vec::new();
            let batch = BatchLimits { frames, views: max_batch, max_kept_frames: 4 };
            let position = RenderedSource { source: &scene, ids: None, columns: Attributes::POSITION };
            for_each_view_batch(
                [RenderedSource::all_gaussians(&scene), position],
                &rig.cameras,
                &all,
                batch,
                |views| {
                    assert!(views.len() <= max_batch.max(1), "{} views of at most {max_batch}", views.len());
                    let of_frames = views.chunk_by(|a, b| a.frame_view.frame == b.frame_view.frame).count();
                    assert!(of_frames <= frames.max(1), "{of_frames} frames of at most {frames}");
                    for RenderableView { frame_view, camera, states: [state, places], .. } in views {
                        assert!(**state == expected[frame_view.frame], "frame {}", frame_view.frame);
                        assert!(places.position == state.position && places.sh.is_empty());
                        assert!(std::ptr::eq(*camera, &rig.cameras[frame_view.camera as usize]));
                        seen.push(*frame_view);
                    }
                    Ok(())
                },
            )
            .unwrap();
            assert_eq!(seen, all, "{frames} frames, {max_batch} views");
        }
    }

    /// Test scene whose Gaussians have features (values that take the place of colors). The decoded color of a pixel
    /// does not depend on them: it is the camera center plus the direction of the ray through the pixel.
    struct RayScene(DemoScene);

    impl FrameSource for RayScene {
        fn info(&self) -> &crate::model::SequenceInfo {
            self.0.info()
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            self.0.open(ids)
        }

        fn decoder(&self) -> Option<&dyn FeatureDecoder> {
            Some(self)
        }
    }

    impl FeatureDecoder for RayScene {
        fn features(&self, frame: usize, out: &mut AttributeValues) -> Result<()> {
            *out = AttributeValues::zeros(2, self.info().count);
            out.plane_mut(1).fill(frame as f32);
            Ok(())
        }

        fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3] {
            assert!(features[0].abs() < 1e-6 && features[1] >= 0.0, "{features:?}");
            std::array::from_fn(|c| center[c] + ray[c])
        }
    }

    #[test]
    fn features_are_decoded_along_the_ray_of_each_pixel() {
        let scene = RayScene(DemoScene::new(200, 3));
        let rig = scene.0.rig();
        let some: Vec<u32> = (0..200).collect();
        let batch = BatchLimits { frames: 2, views: 4, max_kept_frames: 4 };
        let few = RenderedSource { source: &scene, ids: Some(Ids::List(&some)), columns: Attributes::all() };
        for_each_view_batch(
            [RenderedSource::all_gaussians(&scene), few],
            &rig.cameras,
            &frame_views(&[0, 2], 2),
            batch,
            |views| {
                for view in views {
                    let (image, camera) = (view.render(0, [1.0; 3]), view.camera);
                    assert_eq!(image.data.len(), 3 * (camera.width * camera.height) as usize);
                    for (at, color) in image.data.as_chunks::<3>().0.iter().enumerate() {
                        let seen = DVec3::from(color.map(f64::from));
                        assert!(((seen - camera.center()).length() - 1.0).abs() < 1e-5);
                        // The camera sees this point at the center of the pixel.
                        let point = camera.rotation * seen + camera.translation;
                        let found =
                            [camera.fx * point.x / point.z + camera.cx, camera.fy * point.y / point.z + camera.cy];
                        let pixel = [at % camera.width as usize, at / camera.width as usize];
                        assert!((0..2).all(|c| (found[c] - pixel[c] as f64 - 0.5).abs() < 0.02), "{found:?} {pixel:?}");
                    }
                    assert_eq!(view.render(1, [1.0; 3]), render(view.states[1], camera, [1.0; 3]));
                }
                Ok(())
            },
        )
        .unwrap();
    }

    #[test]
    fn each_state_is_read_once_for_any_number_of_batches() {
        let scene = DemoScene::new(300, 6);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.gseq");
        let none = Default::default();
        crate::outputs::container::write_container(&scene, &path, gseq::Compression::Zstd(1), none, |_| ()).unwrap();
        let container = crate::files::container::Container::open(&path).unwrap();
        let rig = scene.rig();
        let reads = |views: u32| {
            let before = container.reads();
            let batch = BatchLimits { frames: 1, views: 2, max_kept_frames: usize::MAX };
            for_each_view_batch(
                [RenderedSource::all_gaussians(&container)],
                &rig.cameras,
                &frame_views(&[1, 4], views),
                batch,
                |_| Ok(()),
            )
            .unwrap();
            container.reads() - before
        };
        assert_eq!(reads(5), reads(1));
    }
}
