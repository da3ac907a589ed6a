//! Reads a COLMAP reconstruction: `cameras` and `images`, as `.bin` or `.txt` (<https://colmap.github.io/format.html>).
//! The 3D points are not read.
//!
//! An image entry holds a unit quaternion wxyz and a translation (world to camera, OpenCV axes), the number of its
//! camera, and its path below the folder `images/`, which lies beside `sparse/`. The center of the first pixel is at
//! 0.5, as in this project. Cameras must be without distortion: SIMPLE_PINHOLE, PINHOLE, or another model whose
//! distortion coefficients are all 0. `--resolution` scales the focal lengths and the principal point. Images in
//! folders called `test` or `val` belong to that split, all others are for training. [`super::times`] finds the times;
//! [`super::frames`] handles data sets with a folder for each frame.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use hashbrown::HashMap;

use super::assemble::{ListedImage, RigBuilder};
use super::memory::MemoryCounter;
use super::{CameraOptions, MAX_SIDE_PX, TimesSource, frames, times};
use crate::error::{Error, Result, ShowPath, quoted};
use crate::files::names::shown_name;
use crate::files::open::open_file;
use crate::files::text::TextLines;
use crate::model::{Camera, Rig, Split};

/// Maximum length of an image name in bytes.
const MAX_NAME_BYTES: u64 = 4096;
/// Bytes of one 2D point in an image entry: two coordinates (f64) and the number of the 3D point (u64).
const POINT_BYTES: u64 = 24;
/// Estimated memory per camera, in bytes. When the table of cameras grows, it is copied to a table of twice the size,
/// and both exist for a moment. So this is 4 times the size of an entry.
const LENS_BYTES: u64 = 4 * size_of::<(u32, Lens)>() as u64;
/// Estimated memory per image without its name, in bytes. When the list of images grows, it is copied to a list of
/// twice the length, and both exist for a moment. So this is 3 times the size of an element, plus 160 bytes.
const IMAGE_BYTES: u64 = 3 * size_of::<ColmapImage>() as u64 + 160;
/// Maximum difference between 1 and the length of the quaternion of a rotation.
const UNIT_TOLERANCE: f64 = 1e-3;

/// Camera models, indexed by COLMAP's model number: name, number of parameters, index of the first distortion parameter
/// (0 if the model is not a pinhole model).
const MODELS: [(&str, usize, usize); 12] = [
    ("SIMPLE_PINHOLE", 3, 3),
    ("PINHOLE", 4, 4),
    ("SIMPLE_RADIAL", 4, 3),
    ("RADIAL", 5, 3),
    ("OPENCV", 8, 4),
    ("OPENCV_FISHEYE", 8, 0),
    ("FULL_OPENCV", 12, 4),
    ("FOV", 5, 0),
    ("SIMPLE_RADIAL_FISHEYE", 4, 0),
    ("RADIAL_FISHEYE", 5, 0),
    ("THIN_PRISM_FISHEYE", 12, 0),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16, 0),
];

/// Camera of a COLMAP reconstruction: size (width, height) of its images and intrinsics fx, fy, cx, cy, all in pixels.
#[derive(Debug, Clone, Copy)]
struct Lens {
    size: (u32, u32),
    intrinsics: [f64; 4],
}

/// Image entry of a COLMAP reconstruction.
struct ColmapImage {
    quaternion: [f64; 4],
    translation: [f64; 3],
    camera: u32,
    name: Box<str>,
}

/// Reads the reconstruction at `path`, which is the folder of the reconstruction, a folder that contains this folder,
/// or one of its files.
///
/// # Errors
/// Fails if a file is missing, truncated or malformed, if a camera has distortion, or if the times of the images cannot
/// be found.
pub(super) fn load(path: &Path, options: &CameraOptions) -> Result<Rig> {
    let folder = reconstruction_folder(path)?;
    let binary = folder.join("cameras.bin").is_file();
    let file = |name: &str| folder.join(format!("{name}.{}", if binary { "bin" } else { "txt" }));
    let (cameras, images) = (file("cameras"), file("images"));
    let mut builder = RigBuilder::new(options.memory);
    let counter = builder.memory_counter();
    let lenses = if binary { read_cameras(&cameras, counter)? } else { parse_cameras(&cameras, counter)? };
    let mut listed = if binary { read_images(&images, counter)? } else { parse_images(&images, counter)? };
    // Sort by name, because COLMAP lists images in the order in which it registered them.
    listed.sort_by(|a, b| natord::compare(&a.name, &b.name).then_with(|| a.name.cmp(&b.name)));
    let images_folder = find_images_folder(&folder);
    let listed_image = |image: &ColmapImage| -> Result<ListedImage> {
        let wrong = |expected: String, found: String| {
            Error::input(&images, format!("image {}", quoted(&image.name)), expected, found)
        };
        let lens = lenses
            .get(&image.camera)
            .ok_or_else(|| wrong(format!("a camera of {}", cameras.shown()), format!("camera {}", image.camera)))?;
        let [w, x, y, z] = image.quaternion;
        let quaternion = DQuat::from_xyzw(x, y, z, w);
        if (quaternion.length() - 1.0).abs().partial_cmp(&UNIT_TOLERANCE).is_none_or(|order| order.is_gt()) {
            return Err(wrong("a quaternion of length 1".into(), format!("{w} {x} {y} {z}")));
        }
        let (size, [fx, fy, cx, cy]) = scale_intrinsics(*lens, options.size);
        Ok(ListedImage {
            camera: Camera {
                width: size.0,
                height: size.1,
                fx,
                fy,
                cx,
                cy,
                rotation: DMat3::from_quat(quaternion.normalize()),
                translation: DVec3::from(image.translation),
                near: Camera::NEAR,
            },
            time: None,
            split: split_of(&image.name),
            image: Some(images_folder.join(&*image.name)),
            view: None,
        })
    };
    if let (Some(first), TimesSource::Own) = (frames::find(&folder), &options.times) {
        let frames = options.frames.unwrap_or_else(|| frames::count(&first.0, first.1));
        let origin = format!("{} (each of {frames} frames)", shown_reconstruction(&folder));
        let first_frame = listed.iter().map(listed_image).collect::<Result<Vec<_>>>()?;
        builder.begin_frames(&images, listed.len(), frames)?;
        frames::repeat_for_frames(&first_frame, &first, frames).try_for_each(|image| builder.add(image))?;
        return builder.finish(None, origin);
    }
    let names: Vec<Box<str>> = listed.iter().map(|image| image.name.clone()).collect();
    let (given, source) = times::resolve(&images, &names, &options.times, builder.memory_counter())?;
    builder.begin_file(&images, listed.len())?;
    for (index, image) in listed.iter().enumerate() {
        builder.add(ListedImage { time: given.get(index).copied().flatten(), ..listed_image(image)? })?;
    }
    let origin = shown_reconstruction(&folder);
    let origin = if source.is_empty() { origin } else { format!("{origin} ({source})") };
    builder.finish(None, origin)
}

/// Returns the folder that holds the COLMAP files. `path` is a folder or a file in a folder; the result is this folder
/// or its subfolder `0`. Fails if neither holds a reconstruction.
fn reconstruction_folder(path: &Path) -> Result<PathBuf> {
    let holds = |folder: &Path| ["cameras.bin", "cameras.txt"].iter().any(|name| folder.join(name).is_file());
    let folder = if path.is_dir() { path } else { path.parent().unwrap_or(Path::new("")) };
    [folder.to_owned(), folder.join("0")].into_iter().find(|folder| holds(folder)).ok_or_else(|| {
        Error::input(folder, "", "a COLMAP reconstruction: cameras.bin and images.bin, or both as .txt", "neither")
    })
}

/// Returns the name of the reconstruction in `folder` for messages: the last component of its path, or the last two, such
/// as `sparse/0`, if the last is a number.
fn shown_reconstruction(folder: &Path) -> String {
    let name = shown_name(folder);
    let above = std::path::absolute(folder).ok();
    match above.as_deref().and_then(Path::parent).filter(|above| above.file_name().is_some()) {
        Some(above) if name.bytes().all(|byte| byte.is_ascii_digit()) => format!("{}/{name}", shown_name(above)),
        _ => name,
    }
}

/// Returns the folder of the images that belong to the reconstruction in `folder`: the folder `images` beside `sparse`,
/// or the folder of the data set if there is no such folder.
fn find_images_folder(folder: &Path) -> PathBuf {
    let below = if folder.ends_with("sparse/0") { 2 } else { usize::from(folder.ends_with("sparse")) };
    let root = folder.ancestors().nth(below).unwrap_or(folder);
    Some(root.join("images")).filter(|images| images.is_dir()).unwrap_or_else(|| root.to_owned())
}

/// Returns the split that the innermost folder called `test` or `val` in an image name stands for; training if there is
/// no such folder.
fn split_of(name: &str) -> Split {
    match name
        .split(['/', '\\'])
        .rev()
        .skip(1)
        .find_map(|part| Some(part).filter(|part| matches!(*part, "test" | "val")))
    {
        Some("test") => Split::Test,
        Some(_) => Split::Val,
        None => Split::Train,
    }
}

/// Returns the size and the intrinsics (fx, fy, cx, cy) of a camera in pixels, scaled to the image size `requested` if
/// that is given.
fn scale_intrinsics(
    Lens { size, intrinsics: [fx, fy, cx, cy] }: Lens,
    requested: Option<(u32, u32)>,
) -> ((u32, u32), [f64; 4]) {
    let Some(requested) = requested else { return (size, [fx, fy, cx, cy]) };
    let (x, y) = (f64::from(requested.0) / f64::from(size.0), f64::from(requested.1) / f64::from(size.1));
    (requested, [fx * x, fy * y, cx * x, cy * y])
}

/// Builds a camera from an entry of COLMAP's `cameras` file: the name `name` of the camera model, the image width and
/// height in pixels, and the parameters `values` of the camera model. `wrong` receives the expected and the found value
/// and builds an error from them.
///
/// # Errors
/// Fails if the camera model is unknown or has distortion, if the number of `values` is not the number of parameters of
/// the model, or if the image size is out of range.
fn lens(
    wrong: impl Fn(String, String) -> Error,
    name: &str,
    (width, height): (u64, u64),
    values: &[f64],
) -> Result<Lens> {
    let names = || MODELS.map(|model| model.0).join(", ");
    let &(_, count, distortion) = MODELS
        .iter()
        .find(|model| model.0 == name)
        .ok_or_else(|| wrong(format!("a camera model of {}", names()), quoted(name)))?;
    if values.len() != count {
        return Err(wrong(format!("{count} parameters of {name}"), values.len().to_string()));
    }
    if distortion == 0 || values[distortion..].iter().any(|&value| value != 0.0) {
        return Err(wrong("a camera without distortion (SIMPLE_PINHOLE or PINHOLE)".into(), name.to_owned()).hint(
            "undistort the images: colmap image_undistorter writes them with a reconstruction that splatsieve reads",
        ));
    }
    let side = |side: u64| u32::try_from(side).ok().filter(|side| (1..=MAX_SIDE_PX).contains(side));
    let (Some(w), Some(h)) = (side(width), side(height)) else {
        return Err(wrong(format!("an image of 1 to {MAX_SIDE_PX} pixels a side"), format!("{width} × {height}")));
    };
    let intrinsics = match *values {
        [f, cx, cy] | [f, cx, cy, _] | [f, cx, cy, _, _] if distortion == 3 => [f, f, cx, cy],
        [fx, fy, cx, cy, ..] => [fx, fy, cx, cy],
        _ => return Err(wrong("focal length and principal point".into(), "fewer parameters".into())),
    };
    Ok(Lens { size: (w, h), intrinsics })
}

/// Reads the file `cameras.txt` at `path`. Returns the cameras by their COLMAP numbers. `counter` limits the memory.
fn parse_cameras(path: &Path, counter: &mut MemoryCounter) -> Result<HashMap<u32, Lens>> {
    let mut lenses = HashMap::new();
    let mut lines = TextLines::open(path)?;
    while let Some((number, line)) = lines.next_line()? {
        let (at, line) = (number - 1, line.trim());
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let wrong = |expected: String, found: String| Error::input(path, format!("line {}", at + 1), expected, found);
        let expected = || wrong("CAMERA_ID MODEL WIDTH HEIGHT PARAMS".into(), quoted(line));
        let words: Vec<&str> = line.split_whitespace().collect();
        let [id, model, width, height, values @ ..] = &words[..] else { return Err(expected()) };
        let (Ok(id), Ok(width), Ok(height)) = (id.parse(), width.parse(), height.parse()) else {
            return Err(expected());
        };
        let values: Vec<f64> =
            values.iter().map(|value| value.parse()).collect::<std::result::Result<_, _>>().map_err(|_| expected())?;
        counter.take(path, &format!("line {number}"), "the cameras", LENS_BYTES)?;
        lenses.insert(id, lens(wrong, model, (width, height), &values)?);
    }
    Ok(lenses)
}

/// Reads the file `images.txt` at `path`. Returns its images in file order. `counter` limits the memory.
fn parse_images(path: &Path, counter: &mut MemoryCounter) -> Result<Vec<ColmapImage>> {
    let mut images = Vec::new();
    let mut lines = TextLines::open(path)?;
    while let Some((number, line)) = lines.next_line()? {
        let (at, line) = (number - 1, line.trim());
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let wrong = || {
            let expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME";
            Error::input(path, format!("line {}", at + 1), expected, quoted(line))
        };
        let mut rest = line;
        let mut word = || -> Option<&str> {
            let (word, after) = rest.split_once(char::is_whitespace)?;
            rest = after.trim_start();
            Some(word)
        };
        let mut values = [0.0; 7];
        word().and_then(|id| id.parse::<u32>().ok()).ok_or_else(wrong)?;
        for value in &mut values {
            *value = word().and_then(|word| word.parse().ok()).ok_or_else(wrong)?;
        }
        let camera = word().and_then(|word| word.parse().ok()).ok_or_else(wrong)?;
        let [w, x, y, z, tx, ty, tz] = values;
        counter.take(path, &format!("line {number}"), "the images", IMAGE_BYTES + 2 * rest.len() as u64)?;
        let name = rest.into();
        images.push(ColmapImage { quaternion: [w, x, y, z], translation: [tx, ty, tz], camera, name });
        // Skip the line with the 2D points of the image, which may be empty.
        lines.skip_line()?;
    }
    Ok(images)
}

/// Reader of little-endian numbers from a file; keeps the present position for error messages.
struct Binary<'a> {
    path: &'a Path,
    file: BufReader<File>,
    at: u64,
    len: u64,
}

impl<'a> Binary<'a> {
    fn open(path: &'a Path) -> Result<Binary<'a>> {
        let file = open_file(path)?;
        let len = file.metadata().map_err(Error::io("read the size of", path))?.len();
        Ok(Binary { path, file: BufReader::new(file), at: 0, len })
    }

    /// Returns the error for a file in which `found` is at the present position instead of `expected`.
    fn wrong(&self, expected: impl Into<String>, found: impl Into<String>) -> Error {
        Error::input(self.path, format!("byte {}", self.at), expected, found)
    }

    /// Returns the error for a file that ends before the value `what` is complete.
    fn truncated(&self, what: &str) -> Error {
        self.wrong(what, format!("the end of the file, after {} bytes", self.len))
            .hint("it is cut short: copy it again")
    }

    /// Reads the next `W` bytes. `what` names them in the error for a file that ends too early.
    fn bytes<const W: usize>(&mut self, what: &str) -> Result<[u8; W]> {
        if self.len - self.at < W as u64 {
            return Err(self.truncated(what));
        }
        let mut bytes = [0; W];
        self.file.read_exact(&mut bytes).map_err(Error::io("read", self.path))?;
        self.at += W as u64;
        Ok(bytes)
    }

    /// Reads the next `u32`. `what` names it in errors.
    fn u32(&mut self, what: &str) -> Result<u32> {
        self.bytes(what).map(u32::from_le_bytes)
    }

    /// Reads the next `u64`. `what` names it in errors.
    fn u64(&mut self, what: &str) -> Result<u64> {
        self.bytes(what).map(u64::from_le_bytes)
    }

    /// Reads the next `W` values of type `f64`. `what` names them in errors.
    fn f64s<const W: usize>(&mut self, what: &str) -> Result<[f64; W]> {
        let mut values = [0.0; W];
        for value in &mut values {
            *value = f64::from_le_bytes(self.bytes(what)?);
        }
        Ok(values)
    }

    /// Reads a text that is terminated with a zero byte. `what` names it in errors.
    fn text(&mut self, what: &str) -> Result<String> {
        let mut bytes = Vec::new();
        let most = MAX_NAME_BYTES.min(self.len - self.at);
        (&mut self.file).take(most).read_until(0, &mut bytes).map_err(Error::io("read", self.path))?;
        if bytes.pop() != Some(0) {
            return Err(self.wrong(what, format!("a text of more than {MAX_NAME_BYTES} bytes, or one without an end")));
        }
        self.at += bytes.len() as u64 + 1;
        String::from_utf8(bytes).map_err(|_| self.wrong(what, "a name that is not UTF-8"))
    }

    /// Skips the next `bytes` bytes; `what` names them in errors. `None` stands for a length that overflowed and is an
    /// error.
    fn skip(&mut self, bytes: Option<u64>, what: &str) -> Result<()> {
        let Some(bytes) = bytes.filter(|&bytes| bytes <= self.len - self.at) else { return Err(self.truncated(what)) };
        // The cast cannot overflow, because file sizes fit into i64.
        self.file.seek_relative(bytes as i64).map_err(Error::io("read", self.path))?;
        self.at += bytes;
        Ok(())
    }
}

/// Reads the file `cameras.bin` at `path`. Returns the cameras by their COLMAP numbers. `counter` limits the memory.
fn read_cameras(path: &Path, counter: &mut MemoryCounter) -> Result<HashMap<u32, Lens>> {
    let mut file = Binary::open(path)?;
    let mut lenses = HashMap::new();
    for _ in 0..file.u64("a number of cameras")? {
        let (id, model) = (file.u32("a camera")?, file.u32("a camera model")?);
        let &(name, count, _) = MODELS
            .get(model as usize)
            .ok_or_else(|| file.wrong(format!("a camera model, 0 to {}", MODELS.len() - 1), model.to_string()))?;
        let size = (file.u64("a width")?, file.u64("a height")?);
        let at = file.at;
        let values = (0..count).map(|_| Ok(file.f64s::<1>("a parameter")?[0])).collect::<Result<Vec<f64>>>()?;
        let wrong =
            |expected: String, found: String| Error::input(path, format!("byte {at}, camera {id}"), expected, found);
        counter.take(path, &format!("byte {at}"), "the cameras", LENS_BYTES)?;
        lenses.insert(id, lens(wrong, name, size, &values)?);
    }
    Ok(lenses)
}

/// Reads the file `images.bin` at `path`. Returns its images in file order. `counter` limits the memory.
fn read_images(path: &Path, counter: &mut MemoryCounter) -> Result<Vec<ColmapImage>> {
    let mut file = Binary::open(path)?;
    let mut images = Vec::new();
    for _ in 0..file.u64("a number of images")? {
        file.u32("an image")?;
        let (quaternion, translation) = (file.f64s("a rotation")?, file.f64s("a translation")?);
        let (camera, name) = (file.u32("a camera")?, file.text("an image's name")?);
        counter.take(path, &format!("byte {}", file.at), "the images", IMAGE_BYTES + 2 * name.len() as u64)?;
        let points = file.u64("a number of points")?;
        file.skip(points.checked_mul(POINT_BYTES), "the points of an image")?;
        images.push(ColmapImage { quaternion, translation, camera, name: name.into() });
    }
    Ok(images)
}
