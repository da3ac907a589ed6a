//! Reads NeRFies and HyperNeRF data sets: `dataset.json`, `metadata.json` and a file `camera/ID.json` per image.
//!
//! The conventions are those of the loader of 4DGaussians (`scene/hyper_loader.py`), with which models are trained:
//!
//! - `orientation` is world to camera, row by row, in OpenCV axes; `position` is the camera's position. Both are used
//!   as they are: `scale` and `center` of `scene.json` are for other programs, and that file is not read.
//! - The focal length holds along both axes. The principal point is the middle of the image.
//! - Distortion is ignored, as in that loader.
//! - The time of an image is its `warp_id` divided by the largest `warp_id`.
//! - Images in `val_ids` are test images. If `val_ids` is empty, images 0, 4, 8, … are training images, and images 2,
//!   6, 10, … are test images if a training image follows.
//! - Images are those of `rgb/2x`, half the size in the camera files, unless `--resolution` gives another.

use std::collections::BTreeMap;
use std::path::Path;

use hashbrown::HashSet;
use serde_json::value::RawValue;

use super::CameraOptions;
use super::assemble::{ListedImage, RigBuilder, from_camera_to_world};
use super::fields::{CameraFields, read_camera_text, shorten};
use super::memory::MemoryCounter;
use crate::error::{Error, Result, quoted};
use crate::files::image::measure;
use crate::files::json::parse;
use crate::files::names::shown_name;
use crate::files::text::read_text;
use crate::model::{Rig, Split};

/// Maximum length in bytes of `camera/ID.json`, the camera file of the image called ID.
const MAX_CAMERA_BYTES: u64 = 1 << 20;
/// Interval of training images in a data set that names no test images: every image whose index is a multiple of this
/// number is a training image.
const TRAIN_EVERY: usize = 4;

/// Reads the NeRFies or HyperNeRF data set whose `dataset.json` is `file`.
///
/// # Errors
/// Fails if a file is missing or malformed, or if an image has no camera or no time.
pub(super) fn load(file: &Path, options: &CameraOptions) -> Result<Rig> {
    let folder = file.parent().unwrap_or(Path::new(""));
    let mut builder = RigBuilder::new(options.memory);
    let [ids, val, train] = names(file, builder.memory_counter())?;
    let splits = splits(&ids, &val, &train);
    let metadata = folder.join("metadata.json");
    let warps = warps(&metadata, &ids, builder.memory_counter())?;
    let latest = f64::from(warps.iter().copied().max().unwrap_or(0).max(1));
    builder.begin_file(file, splits.iter().map(Vec::len).sum())?;
    for ((id, warp), splits) in ids.iter().zip(warps).zip(splits) {
        if splits.is_empty() {
            continue;
        }
        let listed = listed_image(folder, id, options)?;
        for split in splits {
            let time = f64::from(warp) / latest;
            builder.add(ListedImage { time: Some(time), split, ..listed.clone() })?;
        }
    }
    builder.finish(None, shown_name(folder))
}

/// Keys in `dataset.json` of the lists of image names: all images, test images, training images.
const LIST_KEYS: [&str; 3] = ["ids", "val_ids", "train_ids"];
/// Bytes of memory per image name in addition to its text: its entries in a list and in two tables.
const NAME_OVERHEAD_BYTES: u64 = 200;
/// Bytes of memory of the parsed `metadata.json` per byte of its text, at most: an entry has at least 6 bytes of text.
const METADATA_FACTOR: u64 = 16;

/// Reads the three lists of image names in `file` and returns them in this order: all images, test images, training
/// images. `train_ids` may be missing if `val_ids` is empty.
fn names(file: &Path, counter: &mut MemoryCounter) -> Result<[Vec<String>; 3]> {
    let text = read_camera_text(file, counter)?;
    let fields = CameraFields::new(file, None, &text)?;
    let [ids, val, train] = LIST_KEYS.map(|key| fields.texts(key, NAME_OVERHEAD_BYTES, counter));
    let (ids, val) = (ids?, val?);
    let train = if val.is_empty() { Vec::new() } else { train? };
    Ok([ids, val, train])
}

/// Reads the `warp_id` (time index) of each image in `ids` from `file`, the `metadata.json` of the data set. `counter`
/// limits the memory.
fn warps(file: &Path, ids: &[String], counter: &mut MemoryCounter) -> Result<Vec<u32>> {
    let text = read_camera_text(file, counter)?;
    counter.take(file, "", "the times of its images", METADATA_FACTOR * text.len() as u64 + 4 * ids.len() as u64)?;
    let images: BTreeMap<String, &RawValue> = parse(&text, file)?;
    let warp = |id: &String| {
        let image = images
            .get(id)
            .ok_or_else(|| Error::input(file, "", format!("the image {}", quoted(id)), "none of this name"))?;
        let is_object = image.get().starts_with('{');
        if !is_object {
            let place = format!("image {}", quoted(id));
            return Err(Error::input(file, place, "an object", shorten(image.get())));
        }
        let fields = CameraFields::new(file, None, image.get())?;
        fields.optional_index("warp_id")?.ok_or_else(|| fields.wrong("warp_id", "a number"))
    };
    ids.iter().map(warp).collect()
}

/// Returns, for every image of `ids`, the list of the splits to which the image belongs: usually one split, none for an
/// image that is not used. `val` lists the test images and `train` the training images. If `val` is empty, the index of
/// an image decides (see the module documentation).
fn splits(ids: &[String], val: &[String], train: &[String]) -> Vec<Vec<Split>> {
    if val.is_empty() {
        let trained = ids.len().div_ceil(TRAIN_EVERY);
        let held_out = |at: usize| at % TRAIN_EVERY == TRAIN_EVERY / 2 && at / TRAIN_EVERY + 1 < trained;
        let split = |at: usize| match at % TRAIN_EVERY {
            0 => vec![Split::Train],
            _ if held_out(at) => vec![Split::Test],
            _ => Vec::new(),
        };
        return (0..ids.len()).map(split).collect();
    }
    let (train, val): (HashSet<&String>, HashSet<&String>) = (train.iter().collect(), val.iter().collect());
    let split = |id: &String| {
        let is_in = [(Split::Train, train.contains(id)), (Split::Test, val.contains(id))];
        is_in.into_iter().filter(|(_, is_in)| *is_in).map(|(split, _)| split).collect()
    };
    ids.iter().map(split).collect()
}

/// Reads the camera of the image called `id`. The image size in pixels comes from `--resolution`, else from the image
/// file, else it is half the size stated in the camera file.
fn listed_image(folder: &Path, id: &str, options: &CameraOptions) -> Result<ListedImage> {
    let file = folder.join("camera").join(format!("{id}.json"));
    let text = read_text(&file, MAX_CAMERA_BYTES)?;
    let own = CameraFields::new(&file, None, &text)?;
    let (width, height) = own.sides("image_size")?;
    let image = folder.join("rgb/2x").join(format!("{id}.png"));
    let size = options.size.or_else(|| measure(&image)).unwrap_or(((width / 2).max(1), (height / 2).max(1)));
    let focal = own.number("focal_length")?;
    let (x, y) = (f64::from(size.0) / f64::from(width), f64::from(size.1) / f64::from(height));
    let intrinsics = [focal * x, focal * y, 0.5 * f64::from(size.0), 0.5 * f64::from(size.1)];
    let orientation = own.matrix3("orientation")?;
    Ok(ListedImage {
        camera: from_camera_to_world(size, intrinsics, orientation.transpose(), own.vector("position")?),
        time: None,
        split: Split::Train,
        image: Some(image),
        view: None,
    })
}
