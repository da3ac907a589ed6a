//! NeRFies and HyperNeRF: `dataset.json`, `metadata.json` and a file `camera/ID.json` per picture.
//!
//! As the loader of 4DGaussians has them (`scene/hyper_loader.py`), with which models are trained: `orientation` is world
//! to camera, row by row, in OpenCV axes, `position` the camera's own, both as they are: `scale` and `center` of
//! `scene.json` are for other programs, and that file is not read. The focal length holds along both axes, the principal
//! point is the middle; distortion, which that loader passes over, is passed over here. A picture's time is its `warp_id` by the largest. Held out are `val_ids`; where there are none
//! every fourth picture is for training, from the first, and the one two after each but the last is held out.
//! Pictures are those of `rgb/2x`, half the cameras' size, unless `--size` says another.

use std::path::Path;

use hashbrown::HashSet;
use serde_json::Value;

use super::CameraOptions;
use super::assemble::{Picture, assemble, from_camera_to_world};
use super::fields::{Fields, describe};
use crate::error::{Error, Result, quoted};
use crate::ingest::image::measure;
use crate::ingest::text::read_json;
use crate::model::{Rig, Split};

/// Pictures between one for training and the next, where a data set names none to hold out.
const TRAIN_EVERY: usize = 4;

/// Reads the data set of which `file` is the `dataset.json`.
///
/// # Errors
/// Files that are missing or malformed; a picture without a camera or a time.
pub(super) fn load(file: &Path, options: &CameraOptions) -> Result<Rig> {
    let folder = file.parent().unwrap_or(Path::new(""));
    let dataset = read_json(file)?;
    let of = Fields::of(file, None, &dataset)?;
    let names = |key: &str| -> Result<Vec<&str>> {
        let name = |value: &'_ Value| value.as_str().is_some();
        let list = of.list(key)?;
        match list.iter().all(name) {
            true => Ok(list.iter().filter_map(Value::as_str).collect()),
            false => Err(of.wrong(key, "a list of names")),
        }
    };
    let ids = names("ids")?;
    let splits = splits(&ids, &names("val_ids")?, || names("train_ids"))?;
    let metadata_file = folder.join("metadata.json");
    let metadata = read_json(&metadata_file)?;
    let mut warps = Vec::with_capacity(ids.len());
    for id in &ids {
        let own = metadata.get(*id).ok_or_else(|| {
            Error::input(&metadata_file, "", format!("the picture {}", quoted(id)), describe(&metadata))
        })?;
        let own = Fields::of(&metadata_file, None, own)?;
        warps.push(own.optional_index("warp_id")?.ok_or_else(|| own.wrong("warp_id", "a number"))?);
    }
    let latest = f64::from(warps.iter().copied().max().unwrap_or(0).max(1));
    let mut pictures = Vec::new();
    for ((id, warp), splits) in ids.iter().zip(warps).zip(splits) {
        for split in splits {
            let time = f64::from(warp) / latest;
            pictures.push(Picture { time: Some(time), split, ..picture(folder, id, options)? });
        }
    }
    assemble(vec![(file.to_owned(), pictures)], None, folder.display().to_string())
}

/// The splits of every picture, mostly one; of some none.
fn splits<'a>(ids: &[&str], val: &[&str], train: impl FnOnce() -> Result<Vec<&'a str>>) -> Result<Vec<Vec<Split>>> {
    if val.is_empty() {
        let trained = ids.len().div_ceil(TRAIN_EVERY);
        let held_out = |at: usize| at % TRAIN_EVERY == TRAIN_EVERY / 2 && at / TRAIN_EVERY + 1 < trained;
        let split = |at: usize| match at % TRAIN_EVERY {
            0 => vec![Split::Train],
            _ if held_out(at) => vec![Split::Test],
            _ => Vec::new(),
        };
        return Ok((0..ids.len()).map(split).collect());
    }
    let (train, val): (HashSet<&str>, HashSet<&str>) = (train()?.into_iter().collect(), val.iter().copied().collect());
    let split = |id: &&str| {
        let is_in = [(Split::Train, train.contains(id)), (Split::Test, val.contains(id))];
        is_in.into_iter().filter(|(_, is_in)| *is_in).map(|(split, _)| split).collect()
    };
    Ok(ids.iter().map(split).collect())
}

fn picture(folder: &Path, id: &str, options: &CameraOptions) -> Result<Picture> {
    let file = folder.join("camera").join(format!("{id}.json"));
    let document = read_json(&file)?;
    let own = Fields::of(&file, None, &document)?;
    let [width, height] = own.sides("image_size")?;
    let image = folder.join("rgb/2x").join(format!("{id}.png"));
    let size = options.size.or_else(|| measure(&image)).unwrap_or(((width / 2).max(1), (height / 2).max(1)));
    let focal = own.number("focal_length")?;
    let (x, y) = (f64::from(size.0) / f64::from(width), f64::from(size.1) / f64::from(height));
    let intrinsics = [focal * x, focal * y, 0.5 * f64::from(size.0), 0.5 * f64::from(size.1)];
    let orientation = own.matrix3("orientation")?;
    Ok(Picture {
        camera: from_camera_to_world(size, intrinsics, orientation.transpose(), own.vector("position")?.into()),
        time: None,
        split: Split::Train,
        image: Some(image),
        view: None,
    })
}
