//! Target views: renders of the original model that refinement fits Gaussians to.

use std::ops::Range;

use rayon::prelude::*;

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Camera, FrameView};
use crate::passes::{Batch, RenderedSource, VIEWS_PER_FRAME, ViewStates, show, spread};
use crate::render::{Image, render};
use crate::scene::Scene;
use crate::scene::between::{SplitMix64, between};

/// Name of the cache entry of the target views.
pub(crate) const NAME: &str = "targets";
/// Shares of the target views, in 26ths: views from the scene's cameras, and views from cameras between two of these.
const VIEW_SHARES: [usize; 2] = [3, 23];
/// Maximum number of bytes of all target views in the scratch file. There are at least [`MIN_VIEWS`] views even if they
/// exceed it.
const MAX_BYTES: u64 = 1 << 30;
/// Minimum number of target views, even if they exceed [`MAX_BYTES`].
const MIN_VIEWS: u64 = 96;
/// One in this many views is a validation view.
pub(super) const VALIDATION_EVERY: usize = 8;

/// One in this many views is a test view, used only for the reported quality. Applies to runs with a quality target.
const TEST_EVERY: usize = 4;

/// Indices of the target views, by the purpose they are used for.
#[derive(Clone)]
pub(crate) struct ViewSplit {
    /// Training views, to which optimization steps fit the parameters.
    pub(crate) stepped: Vec<usize>,
    /// Validation views, by which the best parameters are chosen.
    pub(crate) apart: Vec<usize>,
    /// Test views, used only to report the quality, not for training or validation.
    pub(crate) held: Vec<usize>,
}

/// Returns the numbers of target views from the scene's cameras and from cameras between these. Together they are at
/// most `max_views`; fewer if the `pixels` pixels of each view would need too many bytes.
pub(super) fn view_counts(max_views: usize, pixels: u64) -> [usize; 2] {
    let count = (MAX_BYTES / (6 * pixels.max(1))).max(MIN_VIEWS).min(max_views as u64) as usize;
    VIEW_SHARES.map(|part| part * count / 26)
}

/// Renders of the original model, in a scratch file. Their cameras are those by which Gaussians are scored, and cameras
/// between these.
pub(crate) struct Targets {
    pub(crate) cameras: Vec<Camera>,
    /// Camera and frame of each target view, sorted by frame.
    pub(crate) pictures: Vec<FrameView>,
    /// Scratch files, each with a range of consecutive views. A file has the color values of one view after the other,
    /// from 0 to 1 as 16-bit integers.
    values: Vec<(Range<usize>, Spill)>,
}

impl Targets {
    /// Renders `max_views` views of the original; fewer if they would need too many bytes.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or the scratch file cannot be written.
    pub(crate) fn new(scene: &Scene, max_views: usize) -> Result<Targets> {
        let (cameras, pictures) = choose_views(scene, max_views);
        let make = |some: Range<usize>, values: &mut SpillWriter| {
            let subject = [RenderedSource::all(scene.source())];
            show(subject, &cameras, &pictures[some], Batch::one_frame(&scene.limits), |views| {
                let picture = |view: &ViewStates<'_, 1>| narrow(&render(view.states[0], view.camera, scene.background));
                let made: Vec<Vec<u16>> = views.par_iter().map(picture).collect();
                made.iter().try_for_each(|picture| values.write(bytemuck::cast_slice(picture)))
            })
        };
        let key = scene.work.key(&(&cameras, &pictures));
        let values = scene.work.sharded_spill(NAME, key, pictures.len(), &scene.scratch, make)?;
        Ok(Targets { cameras, pictures, values })
    }

    /// Divides the views into training, validation and test views. If `held`, every fourth view is a test view;
    /// otherwise there are none.
    pub(crate) fn parted(&self, held: bool) -> ViewSplit {
        let (held, rest): (Vec<usize>, Vec<usize>) =
            (0..self.pictures.len()).partition(|k| held && k % TEST_EVERY == TEST_EVERY - 1);
        // Validation views are chosen from the views that are not test views.
        let (apart, stepped) = rest.into_iter().partition(|k| k % VALIDATION_EVERY == 1);
        ViewSplit { stepped, apart, held }
    }

    /// Returns the camera of target view `k`.
    pub(super) fn camera(&self, k: usize) -> &Camera {
        &self.cameras[self.pictures[k].camera as usize]
    }

    /// Returns the number of color values of view `k`: three per pixel.
    fn len(&self, k: usize) -> usize {
        let camera = self.camera(k);
        3 * camera.width as usize * camera.height as usize
    }

    /// Reads the color values of view `k`, from 0 to 1 as 16-bit integers.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be read.
    pub(crate) fn values(&self, k: usize) -> Result<Vec<u16>> {
        let mut values = vec![0u16; self.len(k)];
        for (some, spill) in self.values.iter().filter(|(some, _)| some.contains(&k)) {
            let before: usize = (some.start..k).map(|k| self.len(k)).sum();
            spill.read(2 * before as u64, bytemuck::cast_slice_mut(&mut values))?;
        }
        Ok(values)
    }
}

/// Chooses the cameras, and the views sorted by frame: views by which Gaussians are scored, and views from cameras in
/// between.
fn choose_views(scene: &Scene, max_views: usize) -> (Vec<Camera>, Vec<FrameView>) {
    let [scene_views, between_views] = view_counts(max_views, scene.workload().pixels);
    let mut pictures = spread(&scene.schedule, scene_views, VIEWS_PER_FRAME);
    let used = scene.schedule.used();
    let mut cameras: Vec<Camera> = used.iter().map(|&camera| scene.schedule.cameras[camera as usize].clone()).collect();
    for picture in &mut pictures {
        picture.camera = used.binary_search(&picture.camera).unwrap_or_default() as u32;
    }
    let (seen, mut random) = (pictures.len(), SplitMix64(2));
    for camera in between(&cameras, if seen == 0 { 0 } else { between_views }) {
        let frame = pictures[random.below(seen)].frame;
        pictures.push(FrameView { frame, view: u32::MAX, camera: cameras.len() as u32 });
        cameras.push(camera);
    }
    pictures.sort_by_key(|picture| picture.frame);
    (cameras, pictures)
}

/// Returns the mean square error of the render `picture` against the 16-bit values `target`.
pub(crate) fn mean_square(picture: &Image, target: &[u16]) -> f64 {
    let square = |(value, &wanted): (&f32, &u16)| f64::from(value.clamp(0.0, 1.0) - wide(wanted)).powi(2);
    picture.data.iter().zip(target).map(square).sum::<f64>() / target.len().max(1) as f64
}

/// Converts color values from 0 to 1 to 16-bit integers; values outside are clamped.
pub(super) fn narrow(picture: &Image) -> Vec<u16> {
    // NaN becomes 0.
    picture.data.iter().map(|value| (value.clamp(0.0, 1.0) * f32::from(u16::MAX)).round() as u16).collect()
}

/// Converts a 16-bit value made by [`narrow`] back to a value from 0 to 1.
pub(super) fn wide(value: u16) -> f32 {
    f32::from(value) / f32::from(u16::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bits_are_accurate_to_1e_5() {
        let picture = Image { width: 1, height: 1, data: vec![0.0, 1.0, 0.123_456] };
        let back: Vec<f32> = narrow(&picture).into_iter().map(wide).collect();
        assert!(back.iter().zip(&picture.data).all(|(a, b)| (a - b).abs() < 1e-5), "{back:?}");
        let odd = Image { data: vec![-3.0, f32::NAN, 7.0], ..picture };
        assert_eq!(narrow(&odd), [0, 0, u16::MAX]);
    }

    #[test]
    fn large_views_are_fewer_but_never_too_few() {
        assert_eq!(view_counts(520, 320 * 256), [60, 460]);
        assert_eq!(view_counts(520, 0), [60, 460]);
        assert_eq!(view_counts(520, 1352 * 1014), [15, 115]);
        assert_eq!(view_counts(520, 1 << 40), [11, 84]);
        assert_eq!(view_counts(40, 1 << 40), [4, 35]);
    }
}
