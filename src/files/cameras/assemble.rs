//! Builds a [`Rig`] (cameras and views) from the images that a camera file lists: checks the cameras, merges equal
//! cameras and assigns view numbers.

use std::hash::BuildHasher;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use hashbrown::{DefaultHashBuilder, HashSet, HashTable};

use super::fields::place;
use super::memory::MemoryCounter;
use super::{MAX_IMAGES, MAX_SIDE_PX};
use crate::error::{Error, Result, ShowPath};
use crate::limits::ReadLimit;
use crate::model::{Camera, Rig, RigView, Split};

/// Maximum absolute entry of RᵀR − I of a rotation matrix R. Matrices written in f32 reach 1e-6; at 1e-4 a projected
/// point moves by 0.05 px at a focal length of 1000 px. A scaled or sheared matrix exceeds the limit by far.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// Maximum focal length in pixels. Above it, the squared image size of the largest Gaussians overflows f32.
const MAX_FOCAL_PX: f64 = 1e9;

/// Entry of one image in a camera file.
#[derive(Debug, Clone)]
pub(super) struct ListedImage {
    /// Camera that took the image.
    pub(super) camera: Camera,
    /// Time stamp; `None` if the image shows every frame.
    pub(super) time: Option<f64>,
    /// Split to which the image belongs: training, validation or test.
    pub(super) split: Split,
    /// Path of the image file; `None` if the camera file states none.
    pub(super) image: Option<PathBuf>,
    /// View number, if the camera file states one.
    pub(super) view: Option<u32>,
}

/// Builder of a [`Rig`] that takes the images of all files of a data set one by one.
///
/// Cameras that are equal in every bit become one camera. If the files state a view number for every image, these
/// numbers are used; otherwise the distinct cameras are numbered in order of appearance. An image without a time shows
/// every frame, so a second image without a time of the same camera and split is left out.
#[derive(Debug)]
pub(super) struct RigBuilder {
    rig: Rig,
    memory_counter: MemoryCounter,
    /// Hash table for finding an equal camera: the index in `rig.cameras` of each camera, hashed by the camera's
    /// values.
    camera_indices: HashTable<u32>,
    hasher: DefaultHashBuilder,
    /// (Camera index, split) pairs for which an image without a time has been added.
    untimed: HashSet<(u32, Split)>,
    /// Path of every camera file, and the index in `rig.views` of its first image.
    files: Vec<(PathBuf, usize)>,
    /// Number of images added so far from the camera file that is being read (the last of `files`).
    images_added: usize,
    /// Whether every image so far has a stated view number.
    are_views_stated: bool,
    /// Whether the images have time stamps; `None` before the first image.
    is_timed: Option<bool>,
}

impl RigBuilder {
    /// Returns a builder without images; `memory` limits the memory of the images and cameras.
    pub(super) fn new(memory: ReadLimit) -> RigBuilder {
        RigBuilder {
            rig: Rig { cameras: Vec::new(), views: Vec::new(), background: None, origin: String::new() },
            memory_counter: MemoryCounter::new(memory),
            camera_indices: HashTable::new(),
            hasher: DefaultHashBuilder::default(),
            untimed: HashSet::new(),
            files: Vec::new(),
            images_added: 0,
            are_views_stated: true,
            is_timed: None,
        }
    }

    /// Returns the counter of the memory that is used while the cameras are read.
    pub(super) fn memory_counter(&mut self) -> &mut MemoryCounter {
        &mut self.memory_counter
    }

    /// Starts a camera file with `count` images: reserves memory for them. The images that are added next belong to
    /// `file`.
    ///
    /// # Errors
    /// Fails if there are too many images, or if they take more memory than allowed.
    pub(super) fn begin_file(&mut self, file: &Path, count: usize) -> Result<()> {
        let total = self.rig.views.len() + count;
        if total > MAX_IMAGES {
            return Err(Error::input(file, "", format!("at most {MAX_IMAGES} images"), total.to_string()));
        }
        self.memory_counter.take(file, "", &format!("{count} images"), Rig::BYTES_PER_VIEW * count as u64)?;
        self.rig.views.reserve_exact(count);
        // Reserve one camera per image, up to a limit: usually either every image has its own camera or there are few
        // cameras. Reserved memory that stays unused costs nothing, but growing the list would copy it.
        let affordable = self.memory_counter.limit.bytes() / 4 / Rig::BYTES_PER_CAMERA;
        self.rig.cameras.reserve_exact(count.min(affordable.min(1 << 20) as usize));
        self.files.push((file.to_owned(), self.rig.views.len()));
        self.images_added = 0;
        Ok(())
    }

    /// Starts a camera file of `cameras` cameras, each with an image at each of `frames` frames.
    ///
    /// # Errors
    /// Fails with [`Error::Usage`] if there are too many images, and like [`RigBuilder::begin_file`].
    pub(super) fn begin_frames(&mut self, file: &Path, cameras: usize, frames: usize) -> Result<()> {
        let images = cameras.saturating_mul(frames);
        if images > MAX_IMAGES {
            let file = file.shown();
            return Err(Error::usage(format!(
                "{file}: {cameras} cameras × {frames} frames are more than {MAX_IMAGES} images"
            )));
        }
        self.begin_file(file, images)
    }

    /// Adds the image `listed`, which belongs to the file that was last passed to [`RigBuilder::begin_file`].
    ///
    /// # Errors
    /// Fails if the camera is invalid, if only some images have a time, or if the memory limit for reading is exceeded.
    ///
    /// # Panics
    /// If no file was begun.
    pub(super) fn add(&mut self, listed: ListedImage) -> Result<()> {
        let path = &self.files.last().expect("a file was begun").0;
        let frame = self.images_added;
        let wrong = |expected: String, found: String| Error::input(path, place(Some(frame)), expected, found);
        self.images_added += 1;
        if let Err((expected, found)) = check(&listed.camera) {
            return Err(wrong(expected, found));
        }
        let is_timed = *self.is_timed.get_or_insert(listed.time.is_some());
        if listed.time.is_some() != is_timed {
            return Err(wrong("a time for every image or for none".into(), time_mismatch(is_timed).into()));
        }
        let values = camera_bits(&listed.camera);
        let (cameras, hasher) = (&mut self.rig.cameras, &self.hasher);
        let hash = hasher.hash_one(values);
        let found = self.camera_indices.find(hash, |&at| camera_bits(&cameras[at as usize]) == values).copied();
        let camera = match found {
            Some(camera) => camera,
            None => {
                self.memory_counter.take(path, &place(Some(frame)), "the cameras", Rig::BYTES_PER_CAMERA)?;
                if cameras.len() == cameras.capacity() {
                    // While the list grows, the old list and the longer copy exist at the same time.
                    let more = (cameras.len() / 4).max(64);
                    let copied = (size_of::<Camera>() * (cameras.len() + more)) as u64;
                    self.memory_counter.take(path, &place(Some(frame)), "the cameras", copied)?;
                    cameras.reserve_exact(more);
                    self.memory_counter.used -= copied;
                }
                let camera = cameras.len() as u32;
                cameras.push(listed.camera);
                self.camera_indices
                    .insert_unique(hash, camera, |&at| hasher.hash_one(camera_bits(&cameras[at as usize])));
                camera
            }
        };
        self.are_views_stated &= listed.view.is_some();
        if !is_timed && !self.untimed.insert((camera, listed.split)) {
            return Ok(());
        }
        let mut image = listed.image;
        if let Some(image) = &mut image {
            image.shrink_to_fit();
            let bytes = image.as_os_str().len() as u64 + Rig::NAME_OVERHEAD_BYTES;
            self.memory_counter.take(path, &place(Some(frame)), "the names of images", bytes)?;
        }
        let view = listed.view.unwrap_or(0);
        self.rig.views.push(RigView { view, camera, time: listed.time, split: listed.split, image });
        Ok(())
    }

    /// Returns the largest time stamp of the images added so far, but at least `least`.
    pub(super) fn latest(&self, least: f64) -> f64 {
        self.rig.views.iter().filter_map(|rig_view| rig_view.time).fold(least, f64::max)
    }

    /// Divides the time stamps of all images by `span`, the largest time stamp, so that times run up to 1.
    pub(super) fn divide_times(&mut self, span: f64) {
        for rig_view in &mut self.rig.views {
            rig_view.time = rig_view.time.map(|time| time / span);
        }
    }

    /// Returns the rig of all images added. `background` is the background color, if a camera file states one. `origin`
    /// describes for the user where the cameras come from.
    ///
    /// # Errors
    /// Fails if there are no images, or if two images of one file have the same view, split and time.
    pub(super) fn finish(mut self, background: Option<[f32; 3]>, origin: String) -> Result<Rig> {
        if let (true, Some((path, _))) = (self.rig.views.is_empty(), self.files.first()) {
            return Err(Error::input(path, "", "at least one image", "none"));
        }
        if !self.are_views_stated {
            self.rig.views.iter_mut().for_each(|rig_view| rig_view.view = rig_view.camera);
        }
        let rig_views = &self.rig.views;
        // Adding 0.0 turns −0 into 0, so that both count as the same time.
        let view_key = |at: usize| {
            let rig_view: &RigView = &rig_views[at];
            rig_view.time.map(|time| (rig_view.view, rig_view.split, (time + 0.0).to_bits()))
        };
        for (k, (path, first)) in self.files.iter().enumerate() {
            let end = self.files.get(k + 1).map_or(rig_views.len(), |next| next.1);
            let mut view_indices: HashTable<u32> = HashTable::new();
            for at in *first..end {
                let key = view_key(at);
                let Some((view, _, time)) = key else { continue };
                let hash = self.hasher.hash_one(key);
                if let Some(&earlier) = view_indices.find(hash, |&other| view_key(other as usize) == key) {
                    let time = f64::from_bits(time);
                    return Err(Error::input(
                        path,
                        place(Some(at - first)),
                        "one image per view and time",
                        format!("view {view} at time {time} again, as in frame {}", earlier as usize - first),
                    ));
                }
                view_indices.insert_unique(hash, at as u32, |&other| self.hasher.hash_one(view_key(other as usize)));
            }
        }
        Ok(Rig { background, origin, ..self.rig })
    }
}

/// Returns the error text for an image that has a time although the first image has none, or the reverse. `timed` says
/// whether the first image has a time.
fn time_mismatch(timed: bool) -> &'static str {
    if timed { "none here, but one in the first image" } else { "one here, but none in the first image" }
}

/// Checks that a camera is valid. The error is the pair (expected, found) for the message.
pub(super) fn check(camera: &Camera) -> std::result::Result<(), (String, String)> {
    let Camera { width, height, fx, fy, cx, cy, rotation, translation, near: _ } = camera;
    let side = 1..=MAX_SIDE_PX;
    if !side.contains(width) || !side.contains(height) {
        return Err((format!("an image of 1 to {MAX_SIDE_PX} pixels a side"), format!("{width} × {height}")));
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
    // Test `all` entries rather than their maximum, because a maximum would ignore NaN.
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
    // Check the translation after the rotation: some formats compute the translation from the rotation, and a bad
    // rotation should be reported as such.
    if !translation.is_finite() {
        return Err(("a finite camera position".into(), format!("{translation}")));
    }
    Ok(())
}

/// Returns the bits of every value of a camera except `near`, with −0 replaced by 0, for comparing and hashing.
fn camera_bits(camera: &Camera) -> [u64; 18] {
    let Camera { width, height, fx, fy, cx, cy, rotation, translation, near: _ } = camera;
    let mut bits = [0; 18];
    let values = [*fx, *fy, *cx, *cy].into_iter().chain(rotation.to_cols_array()).chain(translation.to_array());
    for (to, value) in bits.iter_mut().zip(values) {
        *to = (value + 0.0).to_bits();
    }
    bits[16] = u64::from(*width);
    bits[17] = u64::from(*height);
    bits
}

/// Builds a camera from a camera-to-world pose in OpenCV axes. The arguments are, in this order: image width and height
/// in pixels; fx, fy, cx, cy in pixels; the camera-to-world rotation; the camera position.
pub(super) fn from_camera_to_world(
    (width, height): (u32, u32),
    [fx, fy, cx, cy]: [f64; 4],
    rotation: DMat3,
    center: DVec3,
) -> Camera {
    let rotation = rotation.transpose();
    Camera { width, height, fx, fy, cx, cy, rotation, translation: -(rotation * center), near: Camera::NEAR }
}

/// Returns the number after `v` in an image name of the form `…tNNN_vNN…`: the view number. Returns `None` for other
/// names.
pub(super) fn view_in_name(name: &str) -> Option<u32> {
    let name = name.rsplit(['/', '\\']).next()?;
    name.match_indices("_v").find_map(|(at, mark)| {
        let before = name[..at].trim_end_matches(|c: char| c.is_ascii_digit());
        let after = &name[at + mark.len()..];
        let end = after.find(|c: char| !c.is_ascii_digit()).unwrap_or(after.len());
        if before.len() < at && before.ends_with('t') { after[..end].parse().ok() } else { None }
    })
}
