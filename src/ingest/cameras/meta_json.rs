//! `train_meta.json` and `test_meta.json` of Dynamic3DGaussians: for every frame the cameras that took it.
//!
//! Keys: `w`, `h`, pixels; by frame and camera `k`, the 3 × 3 matrix of focal lengths and principal point, pixels; `w2c`, world
//! to camera, row-major, OpenCV axes; `fn`, the picture below `ims`; `cam_id`. There are no times: frame i of T is at
//! i / (T − 1).

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::assemble::{Listing, Picture, assemble};
use super::fields::{Fields, describe};
use super::read_json;
use crate::error::{Error, Result};
use crate::model::{Camera, Rig, Split};

/// The files of a sequence, and what of it they list.
const FILES: [(&str, Split); 2] = [("train_meta.json", Split::Train), ("test_meta.json", Split::Test)];

/// Whether a document is such a file.
pub(super) fn is_one(document: &Value) -> bool {
    ["k", "w2c"].iter().all(|key| document.get(key).is_some_and(Value::is_array))
}

/// Reads `file`, whose content is `document`; with what lies beside it, if a folder was asked for.
///
/// # Errors
/// A value that is missing, of another length, or no camera; files of different numbers of frames.
pub(super) fn load(file: &Path, document: &Value, with_others: bool) -> Result<Rig> {
    let split = |path: &Path| FILES.iter().find(|(name, _)| path.ends_with(name)).map_or(Split::Train, |found| found.1);
    let (first, frames) = listing(file, document, split(file))?;
    let mut files = vec![first];
    for (name, split) in FILES.iter().filter(|(name, _)| with_others && !file.ends_with(name)) {
        let other = file.with_file_name(name);
        if other.is_file() {
            let (listing, found) = listing(&other, &read_json(&other)?, *split)?;
            if found != frames {
                let expected = format!("{frames} frames, as in {}", file.display());
                return Err(Error::input(&other, "k", expected, format!("{found} frames")));
            }
            files.push(listing);
        }
    }
    assemble(files, None, file.display().to_string())
}

/// The pictures of a file, and how many frames it has.
fn listing(file: &Path, document: &Value, split: Split) -> Result<(Listing, usize)> {
    let shared = Fields::of(file, None, document)?;
    let (width, height) = (shared.side("w")?, shared.side("h")?);
    let by_frame = shared.list("k")?;
    let frames = by_frame.len();
    let mut pictures = Vec::new();
    for (frame, of_frame) in by_frame.iter().enumerate() {
        let Value::Array(cameras) = of_frame else {
            return Err(Error::input(
                file,
                format!("k of frame {frame}"),
                "a list with a matrix for every camera",
                describe(of_frame),
            ));
        };
        for (camera, k) in cameras.iter().enumerate() {
            let of = |key: &str| document.get(key).and_then(|list| list.get(frame)?.get(camera)).cloned();
            let entry = json!({ "k": k, "w2c": of("w2c"), "fn": of("fn"), "cam_id": of("cam_id") });
            let own = Fields::of(file, Some(frame), &entry)?;
            let (rotation, translation) = own.pose("w2c")?;
            let [fx, fy, cx, cy] = {
                let k = own.matrix3("k")?;
                [k.x_axis.x, k.y_axis.y, k.z_axis.x, k.z_axis.y]
            };
            let image = own.optional_text("fn")?.map(|name| PathBuf::from("ims").join(name));
            pictures.push(Picture {
                camera: Camera { width, height, fx, fy, cx, cy, rotation, translation, near: Camera::NEAR },
                time: Some(frame as f64 / frames.saturating_sub(1).max(1) as f64),
                split,
                image: image.map(|image| file.with_file_name(image)),
                view: own.optional_index("cam_id")?,
            });
        }
    }
    Ok(((file.to_owned(), pictures), frames))
}
