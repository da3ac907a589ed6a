//! Reads `transforms*.json` of NeRF and D-NeRF: one camera-to-world pose per image, in OpenGL axes.
//!
//! Intrinsics are `fl_x fl_y cx cy w h`, or `camera_angle_x` (and `camera_angle_y`), the field of view in radians. They
//! are keys of the image or, for all images, of the file; a key of the image takes precedence. Pixels are square and
//! the principal point is the middle of the image unless the file states otherwise. An image has `file_path`,
//! `transform_matrix` and, if the scene moves, `time`. Lens distortion (`k1` …) is ignored, as by the trainers, which
//! undistort the photographs; if it moves a corner of an image by [`MAX_SHIFT_PX`] or more, the rig says so. Splits are
//! stated by the names of the files, or by lists of images in a file ([`SPLIT_LISTS`], Nerfstudio).
//!
//! Times are divided by the largest time in the files of all splits, as in the D-NeRF loaders with which the models
//! were trained (4DGaussians `scene/dataset_readers.py`, `read_timeline`): files that count frames 0 … T−1 and files
//! that reach 1 give the same times. For models whose time has another unit, times are used as they are
//! ([`TimeConvention`]).

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use hashbrown::HashMap;

use super::assemble::{ListedImage, RigBuilder, from_camera_to_world, view_in_name};
use super::fields::{CameraFields, read_camera_text};
use super::memory::MemoryCounter;
use super::{CameraOptions, TimeConvention};
use crate::error::{Result, ShowPath};
use crate::files::image::measure;
use crate::files::names::shown_name;
use crate::model::{Rig, Split};

/// Rotation from OpenGL camera axes (x right, y up, z backward) to OpenCV axes (x right, y down, z forward).
const OPENGL_TO_OPENCV: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

/// Lists of image names by which Nerfstudio divides the images of a file into splits. An image in several lists belongs
/// to the split of the last of them, an image in none to the split of the file.
const SPLIT_LISTS: [(&str, Split); 3] =
    [("train_filenames", Split::Train), ("val_filenames", Split::Val), ("test_filenames", Split::Test)];

/// Estimated memory per image name in the lists of splits, without its text, in bytes. When the table grows, it is
/// copied to a table of twice the size, and both exist for a moment.
const SPLIT_ENTRY_BYTES: u64 = 3 * 32 + 32;

/// Values of `camera_model` of cameras without distortion, or with the distortion that [`shift_by_lens`] computes.
const PERSPECTIVE_MODELS: [&str; 5] = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];

/// Shift in pixels of a corner of an image by lens distortion, from which the rig says that distortion was ignored.
const MAX_SHIFT_PX: f64 = 1.0;

/// Reads the cameras in `file`, the `transforms*.json` of one split (training, validation or test). The files of the
/// other splits may lie beside it. If `with_others` is true (the user named the folder), their cameras are read, too.
/// If it is false, these files only contribute to the largest time, by which all times are divided.
pub(super) fn load(file: &Path, with_others: bool, options: &CameraOptions) -> Result<Rig> {
    let mut builder = RigBuilder::new(options.memory);
    let mut files = vec![file.to_owned()];
    let mut latest = 0.0;
    for other in others(file) {
        if with_others {
            files.push(other);
        } else {
            latest = latest_in(&other, builder.memory_counter())?.max(latest);
        }
    }
    files.sort_by_key(|file| split_of(file) as u8);
    let mut shift = 0.0;
    for file in &files {
        shift = add_file(&mut builder, file, options)?.max(shift);
    }
    let latest = builder.latest(latest);
    if latest > 0.0 && options.clock == TimeConvention::Normalized {
        builder.divide_times(latest);
    }
    let names: Vec<String> = files.iter().map(|path| shown_name(path)).collect();
    let lens = match shift < MAX_SHIFT_PX {
        true => String::new(),
        false => format!(" (lens distortion of up to {shift:.1} pixels ignored)"),
    };
    builder.finish(None, names.join(" and ") + &lens)
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
/// ignored without an error. `counter` limits the memory.
fn latest_in(file: &Path, counter: &mut MemoryCounter) -> Result<f64> {
    let used = counter.used;
    let text = read_camera_text(file, counter)?;
    let fields = CameraFields::new(file, None, &text)?;
    let images = if fields.is_list("frames") { fields.list("frames", counter)? } else { Vec::new() };
    let mut latest: f64 = 0.0;
    for image in images {
        let time = CameraFields::new(file, None, image.get()).and_then(|image| image.optional_number("time"));
        latest = latest.max(time.ok().flatten().unwrap_or(0.0));
    }
    // The text and the list are dropped.
    counter.used = used;
    Ok(latest)
}

/// Adds the images listed in `file` to `builder`. Returns the largest shift of a corner of an image by lens distortion,
/// pixels.
fn add_file(builder: &mut RigBuilder, file: &Path, options: &CameraOptions) -> Result<f64> {
    let counter = builder.memory_counter();
    let text = read_camera_text(file, counter)?;
    let shared = CameraFields::new(file, None, &text)?;
    let images = shared.list("frames", counter)?;
    let splits = listed_splits(&shared, counter)?;
    builder.begin_file(file, images.len())?;
    let mut largest: f64 = 0.0;
    for (index, image) in images.into_iter().enumerate() {
        let fields = CameraFields::new(file, Some(index), image.get())?;
        let (image, shift) = listed_image(file, &shared, &fields, &splits, options)?;
        largest = largest.max(shift);
        builder.add(image)?;
    }
    Ok(largest)
}

/// Returns the split of each image that the lists of splits ([`SPLIT_LISTS`]) of a file name. `shared` are the keys of
/// the file; `counter` limits the memory.
fn listed_splits(shared: &CameraFields<'_>, counter: &mut MemoryCounter) -> Result<HashMap<String, Split>> {
    let mut splits = HashMap::new();
    for (key, split) in SPLIT_LISTS.into_iter().filter(|(key, _)| shared.has(key)) {
        let names = shared.texts(key, SPLIT_ENTRY_BYTES, counter)?;
        splits.extend(names.into_iter().map(|name| (relative(&name).to_owned(), split)));
    }
    Ok(splits)
}

/// Returns the image name `name` without a leading `./`.
fn relative(name: &str) -> &str {
    name.strip_prefix("./").unwrap_or(name)
}

/// Builds an image from its own keys `image_fields` and the keys `shared` by all images of the file. `splits` are the
/// splits that lists in the file state. Returns the image, and the largest shift of its corners by lens distortion in
/// pixels. Fails if the camera is invalid or a fisheye camera.
fn listed_image(
    file: &Path,
    shared: &CameraFields<'_>,
    image_fields: &CameraFields<'_>,
    splits: &HashMap<String, Split>,
    options: &CameraOptions,
) -> Result<(ListedImage, f64)> {
    let name = image_fields.optional_text("file_path")?;
    let name = name.as_deref();
    let image = name.map(|name| resolve(file, name));
    let size = size(shared, image_fields, image.as_deref(), options)?;
    let intrinsics = intrinsics(shared, image_fields, size)?;
    let shift = lens_shift(shared, image_fields, size, intrinsics)?;
    let split = name.and_then(|name| splits.get(relative(name))).copied().unwrap_or_else(|| split_of(file));
    let (rotation, center) = image_fields.pose("transform_matrix")?;
    let image = ListedImage {
        camera: from_camera_to_world(size, intrinsics, rotation * OPENGL_TO_OPENCV, center),
        time: image_fields.optional_number("time")?,
        split,
        image,
        view: name.and_then(view_in_name),
    };
    Ok((image, shift))
}

/// Returns the width and height of an image in pixels: from the camera file, else from the image file, else from the
/// options. In the camera file, the keys `image_fields` of the image take precedence over the keys `shared` by all
/// images. Fails if no size is found.
fn size(
    shared: &CameraFields<'_>,
    image_fields: &CameraFields<'_>,
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
    shared: &CameraFields<'_>,
    image_fields: &CameraFields<'_>,
    (width, height): (u32, u32),
) -> Result<[f64; 4]> {
    let (width, height) = (f64::from(width), f64::from(height));
    let focal = |fields: &CameraFields<'_>, pixels: &str, angle: &str, side: f64| -> Result<Option<f64>> {
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

/// Returns the largest shift of a corner of an image by the lens distortion of its camera, pixels; 0 without distortion.
/// `size` is the image size, and `intrinsics` are fx, fy, cx, cy, all in pixels. The keys `image_fields` of the image
/// take precedence over the keys `shared` by all images. Fails for fisheye cameras and other cameras that no pinhole
/// camera approximates.
fn lens_shift(
    shared: &CameraFields<'_>,
    image_fields: &CameraFields<'_>,
    (width, height): (u32, u32),
    [fx, fy, cx, cy]: [f64; 4],
) -> Result<f64> {
    const EXPECTED: &str = "a perspective camera (such as PINHOLE or OPENCV)";
    const ADVICE: &str = "undistort the images, and export their cameras again";
    for fields in [image_fields, shared] {
        if let Some(model) = fields.optional_text("camera_model")? {
            if !PERSPECTIVE_MODELS.contains(&&*model) {
                return Err(fields.wrong("camera_model", EXPECTED).hint(ADVICE));
            }
            break;
        }
    }
    if let Some(fields) = [image_fields, shared].iter().find(|fields| fields.is_true("is_fisheye")) {
        return Err(fields.wrong("is_fisheye", EXPECTED).hint(ADVICE));
    }
    let mut coefficients = [0.0; 6];
    for (key, value) in ["k1", "k2", "k3", "k4", "p1", "p2"].into_iter().zip(&mut coefficients) {
        let own = image_fields.optional_number(key)?;
        *value = own.map_or_else(|| shared.optional_number(key), |own| Ok(Some(own)))?.unwrap_or(0.0);
    }
    let corners = [(0, 0), (width, 0), (0, height), (width, height)];
    let shifts = corners.map(|(x, y)| {
        let [dx, dy] = shift_by_lens([(f64::from(x) - cx) / fx, (f64::from(y) - cy) / fy], coefficients);
        (dx * fx).hypot(dy * fy)
    });
    Ok(shifts.into_iter().fold(0.0, f64::max))
}

/// Returns the shift of the point (x, y) of the image plane at depth 1 by the lens distortion k1, k2, k3, k4, p1, p2 of
/// OpenCV: radial, by the factor k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸, and tangential.
fn shift_by_lens([x, y]: [f64; 2], [k1, k2, k3, k4, p1, p2]: [f64; 6]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let radial = r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
    [x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)]
}

/// Returns the path of the image that `file` calls `name`, which is relative to the folder of `file`. If `name` has no
/// image extension, as in D-NeRF, returns the first of `name`, `name.png`, `name.jpg` and `name.jpeg` that exists, or
/// `name.png` if none exists.
fn resolve(file: &Path, name: &str) -> PathBuf {
    let named = file.parent().unwrap_or(Path::new("")).join(relative(name));
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
