//! Reads `transforms*.json` of NeRF and D-NeRF: one camera-to-world pose per image, in OpenGL axes.
//!
//! Intrinsics are `fl_x fl_y cx cy w h`, or `camera_angle_x` (and `camera_angle_y`), the field of view in radians. They
//! are keys of the image or, for all images, of the file; a key of the image takes precedence. Pixels are square and
//! the principal point is the middle of the image unless the file states otherwise. An image has `file_path`,
//! `transform_matrix` and, if the scene moves, `time`. Lens distortion (`k1` …) is ignored: images are assumed to be
//! undistorted.
//!
//! Times are divided by the largest time in the files of all splits, as in the D-NeRF loaders with which the models
//! were trained (4DGaussians `scene/dataset_readers.py`, `read_timeline`): files that count frames 0 … T−1 and files
//! that reach 1 give the same times. For models whose time has another unit, times are used as they are
//! ([`TimeConvention`]).

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::assemble::{ListedImage, RigBuilder, from_camera_to_world, view_in_name};
use super::fields::CameraFields;
use super::image_list::{each_image, outline};
use super::{CameraOptions, TimeConvention};
use crate::error::{Result, ShowPath};
use crate::files::image::measure;
use crate::files::json::small::SmallValue;
use crate::files::names::shown_name;
use crate::model::{Rig, Split};

/// Rotation from OpenGL camera axes (x right, y up, z backward) to OpenCV axes (x right, y down, z forward).
const OPENGL_TO_OPENCV: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

/// Keys that are read from the entry of an image in `transforms*.json`.
const IMAGE_KEYS: [&str; 11] =
    ["file_path", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "transform_matrix", "time"];

/// Reads the cameras in `file`, the `transforms*.json` of one split (training, validation or test). The files of the
/// other splits may lie beside it. If `with_others` is true (the user named the folder), their cameras are read, too.
/// If it is false, these files only contribute to the largest time, by which all times are divided.
pub(super) fn load(file: &Path, with_others: bool, options: &CameraOptions) -> Result<Rig> {
    let mut files = vec![file.to_owned()];
    let mut latest = 0.0;
    for other in others(file) {
        if with_others {
            files.push(other);
        } else {
            latest = latest_in(&other)?.max(latest);
        }
    }
    files.sort_by_key(|file| split_of(file) as u8);
    let mut builder = RigBuilder::new(options.memory);
    for file in &files {
        add_file(&mut builder, file, options)?;
    }
    let latest = builder.latest(latest);
    if latest > 0.0 && options.clock == TimeConvention::Normalized {
        builder.divide_times(latest);
    }
    let names: Vec<String> = files.iter().map(|path| shown_name(path)).collect();
    builder.finish(None, names.join(" and "))
}

/// Returns the split named in a file name (train, val or test); training if the name contains none.
fn split_of(file: &Path) -> Split {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    match () {
        () if name.contains("test") => Split::Test,
        () if name.contains("val") => Split::Val,
        () => Split::Train,
    }
}

/// Returns the files of the other splits that exist beside `file`. Returns no files if `file` is not called
/// `transforms_train.json`, `transforms_val.json` or `transforms_test.json`.
fn others(file: &Path) -> Vec<PathBuf> {
    const ALL: [&str; 3] = ["transforms_train.json", "transforms_val.json", "transforms_test.json"];
    let is_own = |name: &&str| file.file_name().is_some_and(|own| own.to_str() == Some(*name));
    if !ALL.iter().any(&is_own) {
        return Vec::new();
    }
    let others = ALL.iter().filter(|name| !is_own(name)).map(|name| file.with_file_name(name));
    others.filter(|other| other.is_file()).collect()
}

/// Returns the largest time stamp of the images that `file` lists, at least 0. Values that are not finite numbers are
/// ignored without an error.
fn latest_in(file: &Path) -> Result<f64> {
    let mut latest = 0.0;
    each_image(file, Some("frames"), &["time"], |_, frame| {
        let time = frame.get("time").and_then(SmallValue::as_f64).filter(|time| time.is_finite());
        latest = time.map_or(latest, |time| time.max(latest));
        Ok(())
    })?;
    Ok(latest)
}

/// Adds the images listed in `file` to `builder`.
fn add_file(builder: &mut RigBuilder, file: &Path, options: &CameraOptions) -> Result<()> {
    let outline = outline(file)?;
    let shared = CameraFields::new(file, None, &outline)?;
    builder.begin_file(file, shared.list_len("frames")?)?;
    let split = split_of(file);
    each_image(file, Some("frames"), &IMAGE_KEYS, |index, frame| {
        builder.add(listed_image(file, shared, CameraFields::new(file, Some(index), frame)?, split, options)?)
    })
}

/// Builds an image of the split `split` from its own keys `image_fields` and the keys `shared` by all images of the
/// file.
fn listed_image(
    file: &Path,
    shared: CameraFields<'_>,
    image_fields: CameraFields<'_>,
    split: Split,
    options: &CameraOptions,
) -> Result<ListedImage> {
    let name = image_fields.optional_text("file_path")?;
    let image = name.map(|name| resolve(file, name));
    let size = size(shared, image_fields, image.as_deref(), options)?;
    let intrinsics = intrinsics(shared, image_fields, size)?;
    let (rotation, center) = image_fields.pose("transform_matrix")?;
    Ok(ListedImage {
        camera: from_camera_to_world(size, intrinsics, rotation * OPENGL_TO_OPENCV, center),
        time: image_fields.optional_number("time")?,
        split,
        image,
        view: name.and_then(view_in_name),
    })
}

/// Returns the width and height of an image in pixels: from the camera file, else from the image file, else from the
/// options. In the camera file, the keys `image_fields` of the image take precedence over the keys `shared` by all
/// images. Fails if no size is found.
fn size(
    shared: CameraFields<'_>,
    image_fields: CameraFields<'_>,
    image: Option<&Path>,
    options: &CameraOptions,
) -> Result<(u32, u32)> {
    let side = |key| {
        image_fields.optional_side(key).and_then(|side| side.map_or_else(|| shared.optional_side(key), |s| Ok(Some(s))))
    };
    if let (Some(width), Some(height)) = (side("w")?, side("h")?) {
        return Ok((width, height));
    }
    // Ignore a missing or unreadable image, because the options may give the size.
    image.and_then(measure).or(options.size).ok_or_else(|| {
        let tried = image.map_or_else(String::new, |image| format!(", or the image {}", image.shown()));
        image_fields
            .wrong("w", format!("the image size as w and h{tried}"))
            .hint("give --resolution WIDTHxHEIGHT (800x800 for the original D-NeRF scenes)")
    })
}

/// Returns the focal lengths and the principal point fx, fy, cx, cy in pixels, for an image of the given size. The keys
/// `image_fields` of the image take precedence over the keys `shared` by all images. Fails if there is no horizontal
/// focal length.
fn intrinsics(
    shared: CameraFields<'_>,
    image_fields: CameraFields<'_>,
    (width, height): (u32, u32),
) -> Result<[f64; 4]> {
    let (width, height) = (f64::from(width), f64::from(height));
    let focal = |fields: CameraFields<'_>, pixels: &str, angle: &str, side: f64| -> Result<Option<f64>> {
        if let Some(focal) = fields.optional_number(pixels)? {
            return Ok(Some(focal));
        }
        Ok(fields.optional_number(angle)?.map(|angle| 0.5 * side / (0.5 * angle).tan()))
    };
    let mut fx = None;
    let mut fy = None;
    for fields in [image_fields, shared] {
        if fx.is_none() {
            fx = focal(fields, "fl_x", "camera_angle_x", width)?;
            // Take the vertical focal length from the same object as the horizontal one: the image, or the file.
            fy = focal(fields, "fl_y", "camera_angle_y", height)?;
        }
    }
    let fx = fx.ok_or_else(|| shared.wrong("camera_angle_x", "camera_angle_x or fl_x, here or in every frame"))?;
    let middle = |key, middle| -> Result<f64> {
        Ok(image_fields.optional_number(key)?.or(shared.optional_number(key)?).unwrap_or(middle))
    };
    Ok([fx, fy.unwrap_or(fx), middle("cx", 0.5 * width)?, middle("cy", 0.5 * height)?])
}

/// Returns the path of the image that `file` calls `name`, which is relative to the folder of `file`. If `name` has no
/// image extension, as in D-NeRF, returns the first of `name`, `name.png`, `name.jpg` and `name.jpeg` that exists, or
/// `name.png` if none exists.
fn resolve(file: &Path, name: &str) -> PathBuf {
    let named = file.parent().unwrap_or(Path::new("")).join(name.strip_prefix("./").unwrap_or(name));
    let with = |extension: &str| {
        let mut path = named.clone().into_os_string();
        path.push(extension);
        PathBuf::from(path)
    };
    let stated =
        named.extension().is_some_and(|e| ["png", "jpg", "jpeg"].iter().any(|known| e.eq_ignore_ascii_case(known)));
    if stated {
        return named;
    }
    let candidates = [named.clone(), with(".png"), with(".jpg"), with(".jpeg")];
    candidates.into_iter().find(|path| path.is_file()).unwrap_or_else(|| with(".png"))
}
