//! The original's pictures that what is left is to come close to.

use std::ops::Range;

use rayon::prelude::*;

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Camera, Picture};
use crate::passes::{Batch, Subject, VIEWS_AT_ONCE, ViewStates, show, spread};
use crate::render::{Image, render};
use crate::scene::Scene;
use crate::scene::between::{SplitMix64, between};

/// What they are called in a work folder.
pub(crate) const NAME: &str = "targets";
/// Parts of the pictures that are of the scene's cameras, and of cameras in between, in 26ths.
const PARTS: [usize; 2] = [3, 23];
/// Bytes that they may take in a scratch file, as long as there are [`FEWEST`].
const MOST_BYTES: u64 = 1 << 30;
/// See [`MOST_BYTES`].
const FEWEST: u64 = 96;
/// Of all every eighth is kept apart.
pub(super) const APART_EVERY: usize = 8;

/// Of a run that is asked for a quality every fourth gives nothing but the figure that is reported.
const HELD_EVERY: usize = 4;

/// What pictures are for, by their numbers.
#[derive(Clone)]
pub(crate) struct Parted {
    /// To step along.
    pub(crate) stepped: Vec<usize>,
    /// To judge by.
    pub(crate) apart: Vec<usize>,
    /// To report.
    pub(crate) held: Vec<usize>,
}

/// How many pictures of the scene's cameras are looked at, and how many of cameras in between, of `most` if one has
/// `pixels`.
pub(super) fn numbers(most: usize, pixels: u64) -> [usize; 2] {
    let count = (MOST_BYTES / (6 * pixels.max(1))).max(FEWEST).min(most as u64) as usize;
    PARTS.map(|part| part * count / 26)
}

/// The original's pictures, of the cameras that the scene is scored by and of cameras in between, in a scratch file.
pub(crate) struct Targets {
    pub(crate) cameras: Vec<Camera>,
    /// By frame.
    pub(crate) pictures: Vec<Picture>,
    /// Of consecutive pictures their values from 0 to 1 as 16 bits, one after the other.
    values: Vec<(Range<usize>, Spill)>,
}

impl Targets {
    /// Renders `most` pictures, or fewer large ones.
    ///
    /// # Errors
    /// Frames that cannot be read; a scratch file that cannot be written.
    pub(crate) fn new(scene: &Scene, most: usize) -> Result<Targets> {
        let (cameras, pictures) = looked_at(scene, most);
        let make = |some: Range<usize>, values: &mut SpillWriter| {
            let subject = [Subject::all(scene.source())];
            show(subject, &cameras, &pictures[some], Batch::of_frame(&scene.limits), |views| {
                let picture = |view: &ViewStates<'_, 1>| narrow(&render(view.states[0], view.camera, scene.background));
                let made: Vec<Vec<u16>> = views.par_iter().map(picture).collect();
                made.iter().try_for_each(|picture| values.write(bytemuck::cast_slice(picture)))
            })
        };
        let key = scene.work.key(&(&cameras, &pictures));
        let values = scene.work.divided_spill(NAME, key, pictures.len(), &scene.scratch, make)?;
        Ok(Targets { cameras, pictures, values })
    }

    /// What each picture is for; every fourth for nothing but the figure that is reported, if some are to be `held`.
    pub(crate) fn parted(&self, held: bool) -> Parted {
        let (held, rest): (Vec<usize>, Vec<usize>) =
            (0..self.pictures.len()).partition(|k| held && k % HELD_EVERY == HELD_EVERY - 1);
        // Never one of those held.
        let (apart, stepped) = rest.into_iter().partition(|k| k % APART_EVERY == 1);
        Parted { stepped, apart, held }
    }

    /// What took picture `k`.
    pub(super) fn camera(&self, k: usize) -> &Camera {
        &self.cameras[self.pictures[k].camera as usize]
    }

    /// How many values picture `k` has.
    fn len(&self, k: usize) -> usize {
        let camera = self.camera(k);
        3 * camera.width as usize * camera.height as usize
    }

    /// The values of picture `k`.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(crate) fn values(&self, k: usize) -> Result<Vec<u16>> {
        let mut values = vec![0u16; self.len(k)];
        for (some, spill) in self.values.iter().filter(|(some, _)| some.contains(&k)) {
            let before: usize = (some.start..k).map(|k| self.len(k)).sum();
            spill.read(2 * before as u64, bytemuck::cast_slice_mut(&mut values))?;
        }
        Ok(values)
    }
}

/// Cameras and pictures that are looked at, by frame: those that the scene is scored by, and those in between.
fn looked_at(scene: &Scene, most: usize) -> (Vec<Camera>, Vec<Picture>) {
    let [own, more] = numbers(most, scene.workload().pixels);
    let mut pictures = spread(&scene.schedule, own, VIEWS_AT_ONCE);
    let used = scene.schedule.used();
    let mut cameras: Vec<Camera> = used.iter().map(|&camera| scene.schedule.cameras[camera as usize].clone()).collect();
    for picture in &mut pictures {
        picture.camera = used.binary_search(&picture.camera).unwrap_or_default() as u32;
    }
    let (seen, mut dice) = (pictures.len(), SplitMix64(2));
    for camera in between(&cameras, if seen == 0 { 0 } else { more }) {
        let frame = pictures[dice.below(seen)].frame;
        pictures.push(Picture { frame, view: u32::MAX, camera: cameras.len() as u32 });
        cameras.push(camera);
    }
    pictures.sort_by_key(|picture| picture.frame);
    (cameras, pictures)
}

/// Mean square error of a picture.
pub(crate) fn mean_square(picture: &Image, target: &[u16]) -> f64 {
    let square = |(value, &wanted): (&f32, &u16)| f64::from(value.clamp(0.0, 1.0) - wide(wanted)).powi(2);
    picture.data.iter().zip(target).map(square).sum::<f64>() / target.len().max(1) as f64
}

/// Values from 0 to 1 as 16 bits.
pub(super) fn narrow(picture: &Image) -> Vec<u16> {
    // NaN becomes 0.
    picture.data.iter().map(|value| (value.clamp(0.0, 1.0) * f32::from(u16::MAX)).round() as u16).collect()
}

/// The value that [`narrow`] made 16 bits of.
pub(super) fn wide(value: u16) -> f32 {
    f32::from(value) / f32::from(u16::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bits_hold_a_value_to_a_hundred_thousandth() {
        let picture = Image { width: 1, height: 1, data: vec![0.0, 1.0, 0.123_456] };
        let back: Vec<f32> = narrow(&picture).into_iter().map(wide).collect();
        assert!(back.iter().zip(&picture.data).all(|(a, b)| (a - b).abs() < 1e-5), "{back:?}");
        let odd = Image { data: vec![-3.0, f32::NAN, 7.0], ..picture };
        assert_eq!(narrow(&odd), [0, 0, u16::MAX]);
    }

    #[test]
    fn large_pictures_are_fewer_but_never_too_few() {
        assert_eq!(numbers(520, 320 * 256), [60, 460]);
        assert_eq!(numbers(520, 0), [60, 460]);
        assert_eq!(numbers(520, 1352 * 1014), [15, 115]);
        assert_eq!(numbers(520, 1 << 40), [11, 84]);
        assert_eq!(numbers(40, 1 << 40), [4, 35]);
    }
}
