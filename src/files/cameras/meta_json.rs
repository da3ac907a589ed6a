//! Reads `train_meta.json` and `test_meta.json` of Dynamic3DGaussians: for every frame, a list of its cameras.
//!
//! The keys `w` and `h` give the image size in pixels. Four keys hold lists by frame and camera: `k`, the 3 × 3 matrix
//! of focal lengths and principal point in pixels; `w2c`, world to camera, row-major, OpenCV axes; `fn`, the path of
//! the image below `ims`; `cam_id`. The files state no times: frame i of T is at time i / (T − 1).

use std::path::Path;

use super::assemble::{ListedImage, RigBuilder};
use super::fields::{CameraFields, elements, read_camera_text, shorten};
use crate::error::{Error, Result, ShowPath};
use crate::files::names::shown_name;
use crate::limits::ReadLimit;
use crate::model::{Camera, Rig, Split};

/// Names of the two camera files of a Dynamic3DGaussians data set, and the split whose images each file lists.
const FILES: [(&str, Split); 2] = [("train_meta.json", Split::Train), ("test_meta.json", Split::Test)];

/// Keys of a Dynamic3DGaussians camera file whose values are lists of lists: one list per frame, with one value per
/// camera.
const KEYS: [&str; 4] = ["k", "w2c", "fn", "cam_id"];

/// Reads the cameras in `file`, a `train_meta.json` or `test_meta.json`. If `with_others` is true, also reads the other
/// one of these two files if it exists beside `file`.
///
/// # Errors
/// Fails if a value is missing, has the wrong length or is not a valid camera, or if the files have different numbers
/// of frames.
pub(super) fn load(file: &Path, with_others: bool, memory: ReadLimit) -> Result<Rig> {
    let split = |path: &Path| FILES.iter().find(|(name, _)| path.ends_with(name)).map_or(Split::Train, |found| found.1);
    let mut builder = RigBuilder::new(memory);
    let frames = add_file(&mut builder, file, split(file))?;
    for (name, split) in FILES.iter().filter(|(name, _)| with_others && !file.ends_with(name)) {
        let other = file.with_file_name(name);
        if other.is_file() {
            let found = add_file(&mut builder, &other, *split)?;
            if found != frames {
                let expected = format!("{frames} frames, as in {}", file.shown());
                return Err(Error::input(&other, "k", expected, format!("{found} frames")));
            }
        }
    }
    builder.finish(None, shown_name(file))
}

/// Adds the images that `file` lists to `builder`, as images of `split`. Returns the number of frames of the file.
fn add_file(builder: &mut RigBuilder, file: &Path, split: Split) -> Result<usize> {
    let counter = builder.memory_counter();
    let text = read_camera_text(file, counter)?;
    let shared = CameraFields::new(file, None, &text)?;
    let (width, height) = (shared.side("w")?, shared.side("h")?);
    let mut lists = Vec::new();
    // The first key is required, the others may be missing.
    for key in KEYS.into_iter().filter(|key| *key == KEYS[0] || shared.has(key)) {
        let mut by_frame = Vec::new();
        for (frame, cameras) in shared.list(key, counter)?.into_iter().enumerate() {
            if !cameras.get().starts_with('[') {
                let place = format!("frame {frame}, key \"{key}\"");
                return Err(Error::input(file, place, "a list with a value for every camera", shorten(cameras.get())));
            }
            by_frame.push(elements(file, cameras.get(), counter)?);
        }
        lists.push((key, by_frame));
    }
    let (frames, cameras) = (lists[0].1.len(), |frame: usize| lists[0].1[frame].len());
    builder.begin_file(file, (0..frames).map(cameras).sum())?;
    for (frame, camera) in (0..frames).flat_map(|frame| (0..cameras(frame)).map(move |camera| (frame, camera))) {
        let values = lists.iter().filter_map(|(key, by_frame)| Some((*key, *by_frame.get(frame)?.get(camera)?)));
        let fields = CameraFields::from_entries(file, frame, values);
        let k = fields.matrix3("k")?;
        let (rotation, translation) = fields.pose("w2c")?;
        let image = fields.optional_text("fn")?.map(|name| file.with_file_name("ims").join(name));
        builder.add(ListedImage {
            camera: Camera {
                width,
                height,
                fx: k.x_axis.x,
                fy: k.y_axis.y,
                cx: k.z_axis.x,
                cy: k.z_axis.y,
                rotation,
                translation,
                near: Camera::NEAR,
            },
            time: Some(frame as f64 / frames.saturating_sub(1).max(1) as f64),
            split,
            image,
            view: fields.optional_index("cam_id")?,
        })?;
    }
    Ok(frames)
}
