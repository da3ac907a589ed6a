//! From pictures as a file lists them to a [`Rig`]: cameras checked and told apart, views numbered.

use std::path::PathBuf;

use glam::{DMat3, DVec3};
use hashbrown::{HashMap, HashSet};

use super::fields::place;
use super::{MAX_PICTURES, MAX_SIDE_PX};
use crate::error::{Error, Result};
use crate::model::{Camera, Rig, Shot, Split};

/// Largest entry of |RᵀR − I| of a rotation. Matrices written in f32 reach 1e-6; at 1e-4 a point
/// moves by 0.05 px at a focal length of 1000 px, and a scaled or sheared matrix is far beyond.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// Longest focal length in pixels: beyond it, the squares of what a picture shows of the largest Gaussians overflow.
const MAX_FOCAL_PX: f64 = 1e9;

/// A picture as a file lists it.
#[derive(Debug, Clone)]
pub(super) struct Picture {
    /// The camera that took it.
    pub(super) camera: Camera,
    /// Its time stamp; none when it stands for every frame.
    pub(super) time: Option<f64>,
    /// Part of the data set.
    pub(super) split: Split,
    /// Its file.
    pub(super) image: Option<PathBuf>,
    /// View number, when the file states it.
    pub(super) view: Option<u32>,
}

/// The pictures of one file, in its order.
pub(super) type Listing = (PathBuf, Vec<Picture>);

/// Joins the pictures of all files of a data set.
///
/// Cameras equal in every bit become one. Views are numbered as the files state, or, unless they do
/// so for every picture, by distinct camera in order of appearance. A picture without a time stands
/// for every frame, so a second one of the same camera and split adds nothing and is left out.
///
/// # Errors
/// No pictures or too many; a camera that is none; times for some pictures only; two pictures of one
/// file with the same view, split and time.
pub(super) fn assemble(files: Vec<Listing>, background: Option<[f32; 3]>, origin: String) -> Result<Rig> {
    let total: usize = files.iter().map(|(_, pictures)| pictures.len()).sum();
    let pictures = || files.iter().flat_map(|(_, pictures)| pictures);
    if let (0, Some((path, _))) = (total, files.first()) {
        return Err(Error::input(path, "", "at least one picture", "none"));
    }
    if let (true, Some((path, _))) = (total > MAX_PICTURES, files.first()) {
        return Err(Error::input(path, "", format!("at most {MAX_PICTURES} pictures"), total.to_string()));
    }
    let views_stated = pictures().all(|picture| picture.view.is_some());
    let timed = pictures().next().is_some_and(|picture| picture.time.is_some());

    let mut rig = Rig { cameras: Vec::new(), shots: Vec::with_capacity(total), background, origin };
    let mut known: HashMap<[u64; 18], u32> = HashMap::new();
    let mut untimed_seen: HashSet<(u32, Split)> = HashSet::new();
    for (path, pictures) in files {
        let mut taken: HashMap<(u32, Split, u64), usize> = HashMap::new();
        for (frame, picture) in pictures.into_iter().enumerate() {
            let wrong = |expected: String, found: String| Error::input(&path, place(Some(frame)), expected, found);
            if let Err((expected, found)) = check(&picture.camera) {
                return Err(wrong(expected, found));
            }
            if picture.time.is_some() != timed {
                return Err(wrong("a time for every picture or for none".into(), one_sided(timed).into()));
            }
            let camera = *known.entry(key(&picture.camera)).or_insert_with(|| {
                rig.cameras.push(picture.camera);
                rig.cameras.len() as u32 - 1
            });
            let view = picture.view.filter(|_| views_stated).unwrap_or(camera);
            match picture.time {
                None if !untimed_seen.insert((camera, picture.split)) => continue,
                None => {}
                // −0 and 0 are one time.
                Some(time) => {
                    if let Some(before) = taken.insert((view, picture.split, (time + 0.0).to_bits()), frame) {
                        return Err(wrong(
                            "one picture per view and time".into(),
                            format!("view {view} at time {time} again, as in frame {before}"),
                        ));
                    }
                }
            }
            rig.shots.push(Shot { view, camera, time: picture.time, split: picture.split, image: picture.image });
        }
    }
    Ok(rig)
}

fn one_sided(timed: bool) -> &'static str {
    if timed { "none here, but one in the first picture" } else { "one here, but none in the first picture" }
}

/// What is wrong with a camera, as (expected, found).
pub(super) fn check(camera: &Camera) -> std::result::Result<(), (String, String)> {
    let Camera { width, height, fx, fy, cx, cy, rotation, translation, near: _ } = camera;
    let side = 1..=MAX_SIDE_PX;
    if !side.contains(width) || !side.contains(height) {
        return Err((format!("a picture of 1 to {MAX_SIDE_PX} pixels a side"), format!("{width} × {height}")));
    }
    let usable = |focal: &f64| *focal > 0.0 && *focal <= MAX_FOCAL_PX;
    if !usable(fx) || !usable(fy) {
        return Err((
            format!("focal lengths above 0 and at most {MAX_FOCAL_PX:e} pixels"),
            format!("{fx:e} and {fy:e}"),
        ));
    }
    if !cx.is_finite() || !cy.is_finite() {
        return Err(("a finite principal point".into(), format!("{cx} and {cy}")));
    }
    let defect = (rotation.transpose() * *rotation - DMat3::IDENTITY).to_cols_array();
    // `all` rather than a maximum: NaN fails here and is lost there.
    if !defect.iter().all(|x| x.abs() <= ROTATION_TOLERANCE) {
        let worst = defect.iter().fold(0.0, |worst: f64, x| worst.max(x.abs()));
        return Err((
            format!("a rotation, |RᵀR − I| at most {ROTATION_TOLERANCE:e}"),
            format!("{worst:.3e} for the world-to-camera rows {:?}", rotation.transpose().to_cols_array_2d()),
        ));
    }
    if rotation.determinant() < 0.0 {
        return Err(("a rotation".into(), "a reflection (determinant −1)".into()));
    }
    // After the rotation, which it is computed with: a bad rotation is named as one.
    if !translation.is_finite() {
        return Err(("a finite camera position".into(), format!("{translation}")));
    }
    Ok(())
}

/// Every value of a camera as bits, −0 as 0.
fn key(camera: &Camera) -> [u64; 18] {
    let Camera { width, height, fx, fy, cx, cy, rotation, translation, near: _ } = camera;
    let mut key = [0; 18];
    let values = [*fx, *fy, *cx, *cy].into_iter().chain(rotation.to_cols_array()).chain(translation.to_array());
    for (to, value) in key.iter_mut().zip(values) {
        *to = (value + 0.0).to_bits();
    }
    key[16] = u64::from(*width);
    key[17] = u64::from(*height);
    key
}

/// The camera of a camera-to-world pose in OpenCV axes; `intrinsics` are fx, fy, cx, cy.
pub(super) fn from_camera_to_world(
    (width, height): (u32, u32),
    [fx, fy, cx, cy]: [f64; 4],
    rotation: DMat3,
    center: DVec3,
) -> Camera {
    let rotation = rotation.transpose();
    Camera { width, height, fx, fy, cx, cy, rotation, translation: -(rotation * center), near: Camera::NEAR }
}

/// The view number in a picture's name of the form `…tNNN_vNN…`.
pub(super) fn view_in_name(name: &str) -> Option<u32> {
    let name = name.rsplit(['/', '\\']).next()?;
    name.match_indices("_v").find_map(|(at, mark)| {
        let before = name[..at].trim_end_matches(|c: char| c.is_ascii_digit());
        let after = &name[at + mark.len()..];
        let end = after.find(|c: char| !c.is_ascii_digit()).unwrap_or(after.len());
        if before.len() < at && before.ends_with('t') { after[..end].parse().ok() } else { None }
    })
}
