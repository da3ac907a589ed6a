//! Reads `train_meta.json` and `test_meta.json` of Dynamic3DGaussians: for every frame, a list of its cameras.
//!
//! The keys `w` and `h` give the image size in pixels. Four keys hold lists by frame and camera: `k`, the 3 × 3 matrix
//! of focal lengths and principal point in pixels; `w2c`, world to camera, row-major, OpenCV axes; `fn`, the path of
//! the image below `ims`; `cam_id`. The files state no times: frame i of T is at time i / (T − 1).

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::assemble::{ListedImage, RigBuilder};
use super::fields::{CameraFields, POSE, place};
use super::image_list::outline;
use crate::error::ShowPath;
use crate::error::{Error, Result};
use crate::files::json::lists::{ElementPosition, ListSelection, each_element};
use crate::files::json::small::SmallValue;
use crate::files::names::shown_name;
use crate::limits::ReadLimit;
use crate::model::{Camera, Rig, Split};

/// Names of the two camera files of a Dynamic3DGaussians data set, and the split whose images each file lists.
const FILES: [(&str, Split); 2] = [("train_meta.json", Split::Train), ("test_meta.json", Split::Test)];

/// Keys of a Dynamic3DGaussians camera file whose values are lists of lists: one list per frame, with one value per
/// camera.
const KEYS: [&str; 4] = ["k", "w2c", "fn", "cam_id"];

/// Returns whether the camera file with the keys `outline` is in the format of Dynamic3DGaussians.
pub(super) fn is_meta_json(outline: &SmallValue) -> bool {
    ["k", "w2c"].iter().all(|key| matches!(outline.get(key), Some(SmallValue::List(..))))
}

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

/// Values of one of the [`KEYS`] in a camera file, by frame and camera. The values of all frames are in one list;
/// frames may have different numbers of cameras.
#[derive(Debug)]
struct KeyedValues<T> {
    /// Values of all frames, one frame after another.
    values: Vec<Option<T>>,
    /// For each frame, the index in `values` of the element after the last value of this frame.
    ends: Vec<usize>,
}

impl<T> KeyedValues<T> {
    /// Table without any frames.
    const EMPTY: KeyedValues<T> = KeyedValues { values: Vec::new(), ends: Vec::new() };

    /// Estimated memory per value of a table, in bytes. When the list of values grows, it is copied to a list of twice
    /// the length, and both exist for a moment. So this is 3 times the size of a value.
    const BYTES: u64 = 3 * size_of::<Option<T>>() as u64;

    /// Returns the index in `values` of the first value of frame `frame`.
    fn start(&self, frame: usize) -> usize {
        frame.checked_sub(1).map_or(0, |before| self.ends[before])
    }

    /// Returns the number of values of frame number `frame`, one per camera.
    fn len(&self, frame: usize) -> usize {
        self.ends[frame] - self.start(frame)
    }

    /// Returns the value of camera `camera` at `frame`; `None` if there is none.
    fn get(&self, frame: usize, camera: usize) -> Option<&T> {
        (frame < self.ends.len() && camera < self.len(frame))
            .then(|| self.values[self.start(frame) + camera].as_ref())?
    }
}

/// Content of one camera file: for each of the four [`KEYS`], a table of its values by frame and camera.
#[derive(Debug)]
struct Tables {
    intrinsics: KeyedValues<[f64; 4]>,
    poses: KeyedValues<(DMat3, DVec3)>,
    images: KeyedValues<Box<str>>,
    views: KeyedValues<u32>,
}

impl Tables {
    /// Appends one value to the table of the key `KEYS[key]`: the value of the next camera of the current frame.
    /// `fields` is a JSON object that holds this value under its key.
    fn take(&mut self, fields: CameraFields<'_>, key: usize) -> Result<()> {
        match key {
            0 => {
                let k = fields.matrix3("k")?;
                self.intrinsics.values.push(Some([k.x_axis.x, k.y_axis.y, k.z_axis.x, k.z_axis.y]));
            }
            1 => self.poses.values.push(Some(fields.pose("w2c")?)),
            2 => self.images.values.push(fields.optional_text("fn")?.map(Into::into)),
            _ => self.views.values.push(fields.optional_index("cam_id")?),
        }
        Ok(())
    }

    /// Ends the current frame in the table of the key `KEYS[key]`, because the JSON list of this frame is complete.
    /// Values added afterwards belong to the next frame.
    fn end(&mut self, key: usize) {
        match key {
            0 => self.intrinsics.ends.push(self.intrinsics.values.len()),
            1 => self.poses.ends.push(self.poses.values.len()),
            2 => self.images.ends.push(self.images.values.len()),
            _ => self.views.ends.push(self.views.values.len()),
        }
    }
}

/// Adds the images that `file` lists to `builder`, as images of `split`. Returns the number of frames of the file.
fn add_file(builder: &mut RigBuilder, file: &Path, split: Split) -> Result<usize> {
    let outline = outline(file)?;
    let shared = CameraFields::new(file, None, &outline)?;
    let (width, height) = (shared.side("w")?, shared.side("h")?);
    let frames = shared.list_len("k")?;
    let mut tables = Tables {
        intrinsics: KeyedValues::EMPTY,
        poses: KeyedValues::EMPTY,
        images: KeyedValues::EMPTY,
        views: KeyedValues::EMPTY,
    };
    let bytes = [
        KeyedValues::<[f64; 4]>::BYTES,
        KeyedValues::<(DMat3, DVec3)>::BYTES,
        KeyedValues::<Box<str>>::BYTES + 32,
        KeyedValues::<u32>::BYTES,
    ];
    let (mut used, mut next) = (0, [0; KEYS.len()]);
    let selection = ListSelection { keys: &KEYS, nested: true, element_keys: &[] };
    each_element(file, selection, |ElementPosition { key, index, inner }, value| {
        let name = KEYS[key];
        if index != next[key] {
            return Err(Error::input(file, format!("key \"{name}\""), "this key once", "twice"));
        }
        let text = if let SmallValue::Text(text) = &value { text.len() as u64 } else { 0 };
        let taken = if inner.is_some() { bytes[key] + text } else { 3 * size_of::<usize>() as u64 };
        builder.memory_counter().take(file, &place(Some(index)), "its cameras", taken)?;
        used += taken;
        if inner.is_some() {
            let entry = SmallValue::from_entry(name, value);
            return tables.take(CameraFields::new(file, Some(index), &entry)?, key);
        }
        next[key] += 1;
        match value {
            SmallValue::List(..) => tables.end(key),
            other if key == 0 => {
                return Err(Error::input(
                    file,
                    format!("k of frame {index}"),
                    "a list with a matrix for every camera",
                    other.describe(),
                ));
            }
            _ => tables.end(key),
        }
        Ok(())
    })?;
    let Tables { intrinsics, poses, images, views } = tables;
    builder.begin_file(file, intrinsics.values.len())?;
    for frame in 0..intrinsics.ends.len() {
        for camera in 0..intrinsics.len(frame) {
            let nothing = || Error::input(file, format!("frame {frame}, key \"w2c\""), POSE, "nothing");
            let [fx, fy, cx, cy] = *intrinsics.get(frame, camera).expect("a matrix for every camera");
            let &(rotation, translation) = poses.get(frame, camera).ok_or_else(nothing)?;
            let image = images.get(frame, camera).map(|name| PathBuf::from("ims").join(&**name));
            builder.add(ListedImage {
                camera: Camera { width, height, fx, fy, cx, cy, rotation, translation, near: Camera::NEAR },
                time: Some(frame as f64 / frames.saturating_sub(1).max(1) as f64),
                split,
                image: image.map(|image| file.with_file_name(image)),
                view: views.get(frame, camera).copied(),
            })?;
        }
    }
    builder.memory_counter().release(used);
    Ok(frames)
}
