//! Photographs (ground-truth images) of views, which are files in a folder.

use std::fs;
use std::path::{Path, PathBuf};

use hashbrown::HashMap;

use super::work::add_file_stamps;
use crate::error::{Error, Result, ShowPath};
use crate::files::image::{measure, read_image};
use crate::model::{Camera, FrameView, Rig};
use crate::render::Image;

/// Endings of the names of photographs that are found by the numbers of frame and view, in the order in which they are
/// tried.
const ENDINGS: [&str; 4] = ["png", "jpg", "jpeg", "JPG"];

/// Paths of the photographs of some views.
pub struct Photographs {
    /// Path of each photograph, by the frame and the view number of its view.
    files: HashMap<(usize, u32), PathBuf>,
}

impl Photographs {
    /// Creates the list of photographs from pairs of a view and the path of its photograph. `folder`, which contains
    /// all photographs, is named in error messages.
    ///
    /// # Errors
    /// Fails if two views have the same photograph, or if an item of `photographs` is an error.
    fn from_files(
        folder: &Path,
        photographs: impl Iterator<Item = Result<(FrameView, PathBuf)>>,
    ) -> Result<Photographs> {
        let mut files = HashMap::new();
        let mut view_of_file: HashMap<PathBuf, FrameView> = HashMap::new();
        for photograph in photographs {
            let (view, file) = photograph?;
            // Cameras with time stamps may give all their views the same file name.
            if let Some(other) = view_of_file.insert(file.clone(), view) {
                let found =
                    format!("{}, which also belongs to frame {}, view {}", file.shown(), other.frame, other.view);
                return Err(Error::input(folder, view_name(view), "a photograph of its own", found)
                    .hint("give the folder that the cameras' file paths start from"));
            }
            files.insert((view.frame, view.view), file);
        }
        Ok(Photographs { files })
    }

    /// Finds the photographs of `views` in `folder`. Returns the views that have a photograph, and the paths of these
    /// photographs. `rig`: cameras and their views. `times`: times of the frames.
    ///
    /// First, photographs are found by the image paths in the camera file: a photograph is the file in `folder` whose
    /// path is the longest suffix of the image path. Only if no view has such a photograph, photographs are found by
    /// names with numbers:
    /// - `tNNN_vNN.png`, with the numbers of frame and view,
    /// - else `camNN/images/FFFF.png` as in DyNeRF, with the number of the frame. The folders `cam…`, sorted by their
    ///   numbers, belong to the views 0, 1, 2 and so on.
    ///
    /// Instead of `png`, the ending may be another one of [`ENDINGS`].
    ///
    /// # Errors
    /// Fails if the folder cannot be read, if no view has a photograph, or if two views have the same photograph.
    pub fn find(
        folder: &Path,
        rig: &Rig,
        times: &[f64],
        views: Vec<FrameView>,
    ) -> Result<(Vec<FrameView>, Photographs)> {
        check_folder(folder)?;
        let cameras = camera_folders(folder)?;
        let named = |view: FrameView| Some((view, inside(folder, rig.image_path(view, times)?)?));
        let mut found: Vec<(FrameView, PathBuf)> = views.iter().copied().filter_map(named).collect();
        if found.is_empty() {
            let numbered = |view: FrameView| Some((view, numbered_file(folder, view, &cameras)?));
            found = views.iter().copied().filter_map(numbered).collect();
        }
        if let (true, Some(&view)) = (found.is_empty(), views.first()) {
            return Err(none_found(folder, view, rig.image_path(view, times)));
        }
        let views = found.iter().map(|(view, _)| *view).collect();
        Ok((views, Photographs::from_files(folder, found.into_iter().map(Ok))?))
    }

    /// Returns whether `view` has a photograph.
    pub fn has(&self, view: FrameView) -> bool {
        self.files.contains_key(&(view.frame, view.view))
    }

    /// Returns for each photograph of `views` its path, its length in bytes, and its change time
    /// ([`splat_platform::change_time`]). They show whether the photographs have changed, without reading them.
    ///
    /// # Errors
    /// Fails if a file does not exist any more.
    pub fn file_fingerprints(&self, views: &[FrameView]) -> Result<Vec<(String, u64, i128)>> {
        let mut files = Vec::with_capacity(views.len());
        for view in views {
            if let Some(file) = self.files.get(&(view.frame, view.view)) {
                add_file_stamps(&fs::canonicalize(file).map_err(Error::io("find", file))?, &mut files)?;
            }
        }
        Ok(files)
    }

    /// Checks that the photographs of `views` can be read and have the sizes of their cameras. Decodes only the first
    /// photograph; of the others, reads only the image size. `cameras`: cameras of the views, by camera index.
    ///
    /// # Errors
    /// Fails if the first file is not a PNG or JPEG, or if a file is not an image of its camera's size.
    pub fn check_files(&self, views: &[FrameView], cameras: &[Camera]) -> Result<()> {
        if let Some(&first) = views.first() {
            self.read(first, &cameras[first.camera as usize], [0.0; 3])?;
        }
        for view in views {
            let Some(file) = self.files.get(&(view.frame, view.view)) else { continue };
            let camera = &cameras[view.camera as usize];
            let expected = format!("an image of {}x{} pixels, the size of the camera", camera.width, camera.height);
            let found = match measure(file) {
                Some(size) if size == (camera.width, camera.height) => continue,
                Some((width, height)) => format!("{width}x{height} pixels"),
                None => "no image".to_owned(),
            };
            return Err(Error::input(file, view_name(*view), expected, found));
        }
        Ok(())
    }

    /// Reads the photograph of `view`, taken by `camera`. Transparent pixels are blended with `background`.
    ///
    /// # Errors
    /// Fails if the view has no photograph, or if the file is not an image of the camera's size.
    pub fn read(&self, view: FrameView, camera: &Camera, background: [f32; 3]) -> Result<Image> {
        let file = self.files.get(&(view.frame, view.view));
        let file = file.ok_or_else(|| Error::usage(format!("no photograph was found for {}", view.name())))?;
        read_image(file, (camera.width, camera.height), background)
    }
}

/// Returns the name of a view for messages, such as `frame 3, view 0`.
fn view_name(view: FrameView) -> String {
    format!("frame {}, view {}", view.frame, view.view)
}

/// Checks that `folder` is an existing folder; fails if it is not.
fn check_folder(folder: &Path) -> Result<()> {
    if !fs::metadata(folder).map_err(Error::io("open", folder))?.is_dir() {
        return Err(Error::usage(format!("{}: --ground-truth expects a folder of photographs", folder.shown())));
    }
    Ok(())
}

/// Returns the error for a folder without a photograph of any view. `view` is the first view, and `named` the path of
/// its image in the camera file.
fn none_found(folder: &Path, view: FrameView, named: Option<&Path>) -> Error {
    let numbered = format!("{}.png", view.name());
    let named = named.and_then(Path::file_name).filter(|name| *name != numbered.as_str());
    let names = named.into_iter().map(|name| name.shown().to_string()).chain([numbered]);
    let expected = format!("{} or {}", names.collect::<Vec<_>>().join(", "), in_rig(Path::new("camNN"), view).shown());
    Error::input(folder, view_name(view), expected, "no such file, and no photograph of any other view")
        .hint("name the photographs like this; they are PNG or JPEG files, and the ending may also be .jpg or .jpeg")
}

/// Finds the photograph of `view` by its frame and view number: `tNNN_vNN` (frame, view) in `folder`, else the frame's
/// file in the folder of the view number in `cameras`, each with one of [`ENDINGS`]. Returns `None` if no such file
/// exists.
fn numbered_file(folder: &Path, view: FrameView, cameras: &[PathBuf]) -> Option<PathBuf> {
    let in_camera = cameras.get(view.view as usize).map(|camera| in_rig(camera, view));
    let files = [Some(folder.join(format!("{}.png", view.name()))), in_camera];
    let mut files = files.into_iter().flatten().flat_map(|file| ENDINGS.map(|ending| file.with_extension(ending)));
    files.find(|file| file.is_file())
}

/// Returns the subfolders of `folder` whose name is `cam` and a number and that contain a folder `images`, in the order
/// of their numbers.
fn camera_folders(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).and_then(|entries| entries.collect::<std::io::Result<Vec<_>>>());
    let mut found: Vec<(u32, PathBuf)> = Vec::new();
    for entry in entries.map_err(Error::io("list", folder))? {
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| name.strip_prefix("cam")).and_then(|number| number.parse().ok());
        found.extend(number.map(|number| (number, entry.path())).filter(|(_, path)| path.join("images").is_dir()));
    }
    found.sort();
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

/// Returns the path of the photograph of `view` in the DyNeRF camera folder `camera`.
fn in_rig(camera: &Path, view: FrameView) -> PathBuf {
    camera.join("images").join(format!("{:04}.png", view.frame))
}

/// Returns the file in `folder` whose path relative to `folder` is the longest suffix of the path `image`; `None` if no
/// such file exists.
fn inside(folder: &Path, image: &Path) -> Option<PathBuf> {
    let parts: Vec<_> = image.components().collect();
    let ends = (0..parts.len()).map(|start| parts[start..].iter().collect::<PathBuf>());
    ends.filter(|end| end.is_relative()).map(|end| folder.join(end)).find(|file| file.is_file())
}
