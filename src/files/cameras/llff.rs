//! Reads `poses_bounds.npy` of LLFF and DyNeRF: f64 or f32 `[V, 17]`, one row per camera.
//!
//! A row holds a row-major 3 × 5 matrix and two depth bounds (unused). The columns of the matrix are the camera's down,
//! right and backward axes in the world, its position, and (height, width, focal length) in pixels of the original
//! images. Images are used at half this size unless `--resolution` gives another; the focal length is scaled with the
//! width. The principal point is the middle of the image. Camera 0 is the test camera. Every camera sees every frame.
//! Frame i of n is at time i/n, so time 1 is never reached, as in the DyNeRF loader of 4DGaussians.

use std::io::{BufReader, Read, Seek};
use std::path::Path;

use glam::{DMat3, DVec3};
use npyz::{NpyFile, Order, TypeChar};

use super::assemble::{ListedImage, RigBuilder, check, from_camera_to_world};
use super::fields::side;
use super::memory::MemoryCounter;
use super::{CameraOptions, MAX_SIDE_PX};
use crate::error::{Error, Result};
use crate::files::names::shown_name;
use crate::files::npy::{HEAD, header_is_sound};
use crate::files::open::open_file;
use crate::model::{Camera, Rig, Split};

/// Number of values per camera: a 3 × 5 matrix and two depth bounds.
const WIDTH: usize = 17;
/// Default number of frames: that of the original DyNeRF scenes.
const DEFAULT_FRAMES: usize = 300;

/// Reads the cameras in `file`, a `poses_bounds.npy`. Every camera sees every frame.
///
/// # Errors
/// Fails if the array or a camera is malformed, or if the number of cameras times the number of frames exceeds the
/// maximum number of images.
pub(super) fn load(file: &Path, options: &CameraOptions) -> Result<Rig> {
    let mut builder = RigBuilder::new(options.memory);
    let rows = read_rows(file, builder.memory_counter())?;
    let cameras =
        rows.iter().enumerate().map(|(index, row)| camera(file, index, row, options)).collect::<Result<Vec<_>>>()?;
    let frames = options.frames.unwrap_or(DEFAULT_FRAMES);
    let mut origin = shown_name(file);
    if options.frames.is_none() {
        origin += &format!(" ({DEFAULT_FRAMES} frames, as in the original DyNeRF scenes)");
    }
    builder.begin_frames(file, cameras.len(), frames)?;
    listed_images(&cameras, frames).try_for_each(|image| builder.add(image))?;
    builder.finish(None, origin)
}

/// Returns one image for each of `cameras` at each of `frames` frames, ordered by frame, then by camera.
fn listed_images(cameras: &[Camera], frames: usize) -> impl Iterator<Item = ListedImage> {
    let listed_image = move |frame: usize, view: usize| ListedImage {
        camera: cameras[view].clone(),
        time: Some(frame as f64 / frames as f64),
        split: if view == 0 { Split::Test } else { Split::Train },
        image: None,
        view: Some(view as u32),
    };
    (0..frames).flat_map(move |frame| (0..cameras.len()).map(move |view| listed_image(frame, view)))
}

/// Builds a camera from `row`, the 17 values of the row with index `index` in the array in `file`.
fn camera(file: &Path, index: usize, row: &[f64; WIDTH], options: &CameraOptions) -> Result<Camera> {
    let wrong = |expected: String, found: String| Error::input(file, format!("row {index}"), expected, found);
    let column = |c: usize| DVec3::new(row[c], row[5 + c], row[10 + c]);
    let [height, width, focal] = column(4).to_array();
    let (Some(full_width), Some(full_height)) = (side(width), side(height)) else {
        let expected = format!("height and width of 1 to {MAX_SIDE_PX} whole pixels in columns 4 and 9");
        return Err(wrong(expected, format!("{height} and {width}")));
    };
    // Half the size, but at least one pixel, in case a side of the image is only one pixel.
    let half = |side: u32| (side / 2).max(1);
    let (width_px, height_px) = options.size.unwrap_or((half(full_width), half(full_height)));
    let focal = focal * f64::from(width_px) / width;
    let camera_to_world = DMat3::from_cols(column(1), column(0), -column(2));
    let intrinsics = [focal, focal, 0.5 * f64::from(width_px), 0.5 * f64::from(height_px)];
    let camera = from_camera_to_world((width_px, height_px), intrinsics, camera_to_world, column(3));
    check(&camera).map_err(|(expected, found)| wrong(expected, found))?;
    Ok(camera)
}

/// Reads the rows of the array in `file`. Checks that the array has the shape `[V, 17]`, holds floats and is complete.
/// `counter` limits the memory.
fn read_rows(file: &Path, counter: &mut MemoryCounter) -> Result<Vec<[f64; WIDTH]>> {
    let unreadable = |found: String| Error::input(file, "header", "a NumPy array", found);
    let mut opened = open_file(file)?;
    let bytes = opened.metadata().map_err(Error::io("read the size of", file))?.len();
    let mut head = Vec::new();
    (&mut opened).take(HEAD).read_to_end(&mut head).map_err(Error::io("read", file))?;
    if !header_is_sound(&head, bytes) {
        return Err(unreadable("a header that is not that of an array of numbers".into()));
    }
    opened.rewind().map_err(Error::io("read", file))?;
    let array = NpyFile::new(BufReader::new(opened)).map_err(|error| unreadable(error.to_string()))?;
    let dtype = array.dtype();
    let real = match &dtype {
        npyz::DType::Plain(plain) if plain.type_char() == TypeChar::Float => plain.num_bytes(),
        _ => None,
    };
    let [count, width] = *array.shape() else {
        return Err(Error::input(file, "header", "shape [V, 17]", format!("{:?}", array.shape())));
    };
    if width != WIDTH as u64 || count == 0 {
        return Err(Error::input(file, "header", "shape [V, 17], V at least 1", format!("[{count}, {width}]")));
    }
    if array.order() != Order::C {
        return Err(Error::input(file, "header", "rows stored one after the other (C order)", "Fortran order")
            .hint("save it again with numpy.ascontiguousarray"));
    }
    // Check the length against the file size before memory of that length is allocated.
    if real.is_some_and(|size| count.saturating_mul(WIDTH as u64 * size as u64) > bytes) {
        return Err(Error::input(file, "data", format!("{count} rows of {WIDTH}"), format!("{bytes} bytes in all")));
    }
    // Count the memory of the values as they are stored, of the rows of f64 values, and of one camera per row.
    counter.take(file, "data", &format!("{count} rows of {WIDTH}"), count.saturating_mul(24 * WIDTH as u64 + 256))?;
    let truncated =
        |error: std::io::Error| Error::input(file, "data", format!("{count} rows of {WIDTH}"), error.to_string());
    let values: Vec<f64> = match real {
        Some(8) => array.into_vec::<f64>().map_err(truncated)?,
        Some(4) => array.into_vec::<f32>().map_err(truncated)?.into_iter().map(f64::from).collect(),
        _ => return Err(Error::input(file, "header", "dtype float64 or float32", dtype.descr())),
    };
    Ok(values.as_chunks().0.to_vec())
}
