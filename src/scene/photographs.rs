//! Photographs that pictures are compared with.

use std::fs;
use std::path::{Path, PathBuf};

use hashbrown::HashMap;

use super::work::stamps;
use crate::error::{Error, Result, ShowPath};
use crate::files::image::read_png;
use crate::model::{Camera, Picture, Rig};
use crate::render::Image;

/// Where the photographs of some pictures are.
pub struct Photographs {
    /// By frame and view.
    files: HashMap<(usize, u32), PathBuf>,
}

impl Photographs {
    /// Of pictures with the file of each, inside `folder`.
    fn at(folder: &Path, found: impl Iterator<Item = Result<(Picture, PathBuf)>>) -> Result<Photographs> {
        let mut files = HashMap::new();
        let mut takers: HashMap<PathBuf, Picture> = HashMap::new();
        for found in found {
            let (picture, file) = found?;
            // The names that a time-stamped rig gives its files are shared by all of its cameras.
            if let Some(other) = takers.insert(file.clone(), picture) {
                let found = format!("{}, as for frame {}, view {}", file.shown(), other.frame, other.view);
                return Err(Error::input(folder, place(picture), "a picture of its own", found)
                    .hint("give the folder that the cameras' file paths start from"));
            }
            files.insert((picture.frame, picture.view), file);
        }
        Ok(Photographs { files })
    }

    /// Finds the photographs of `pictures` in `folder` and returns the pictures that have one, with their photographs.
    ///
    /// File paths that the cameras name come first: the longest end of such a path that leads to a file inside `folder`. Only if
    /// this finds no photograph of any picture, files are taken by their names: `tNNN_vNN.png` (frame, view), else
    /// `camNN/images/FFFF.png` as in DyNeRF (position of the view among the folders `cam…`, frame).
    ///
    /// # Errors
    /// A folder that cannot be read; no photograph of any; a picture that shares its photograph with another.
    pub fn of_some(
        folder: &Path,
        rig: &Rig,
        times: &[f64],
        pictures: Vec<Picture>,
    ) -> Result<(Vec<Picture>, Photographs)> {
        check_folder(folder)?;
        let rigs = camera_folders(folder)?;
        let named = |picture: Picture| Some((picture, inside(folder, rig.image(picture, times)?)?));
        let mut found: Vec<(Picture, PathBuf)> = pictures.iter().copied().filter_map(named).collect();
        if found.is_empty() {
            let numbered = |picture: Picture| Some((picture, numbered_file(folder, picture, &rigs)?));
            found = pictures.iter().copied().filter_map(numbered).collect();
        }
        if let (true, Some(&picture)) = (found.is_empty(), pictures.first()) {
            let named = rig.image(picture, times).and_then(Path::file_name);
            let named = named.map_or_else(String::new, |name| format!(", {}", name.shown()));
            let expected = format!("{}.png{named} or {}", picture.name(), in_rig(Path::new("camNN"), picture).shown());
            return Err(Error::input(folder, place(picture), expected, "no such file, nor one of another picture"));
        }
        let pictures = found.iter().map(|(picture, _)| *picture).collect();
        Ok((pictures, Photographs::at(folder, found.into_iter().map(Ok))?))
    }

    /// Whether there is one of `picture`.
    pub fn has(&self, picture: Picture) -> bool {
        self.files.contains_key(&(picture.frame, picture.view))
    }

    /// What says, without reading them, that the photographs of `pictures` are those that they were: of each its name,
    /// length, and when it was last changed, ns.
    ///
    /// # Errors
    /// A file that is not there any more.
    pub fn stamps(&self, pictures: &[Picture]) -> Result<Vec<(String, u64, u128)>> {
        let mut files = Vec::with_capacity(pictures.len());
        for picture in pictures {
            if let Some(file) = self.files.get(&(picture.frame, picture.view)) {
                stamps(&fs::canonicalize(file).map_err(Error::io("find", file))?, &mut files)?;
            }
        }
        Ok(files)
    }

    /// The photograph of `picture`, which `camera` takes, before `background` where it has transparency.
    ///
    /// # Errors
    /// A picture that none was found for; a file that is no picture of the camera's size.
    pub fn read(&self, picture: Picture, camera: &Camera, background: [f32; 3]) -> Result<Image> {
        let file = self.files.get(&(picture.frame, picture.view));
        let file = file.ok_or_else(|| Error::usage(format!("no photograph is known of {}", picture.name())))?;
        read_png(file, (camera.width, camera.height), background)
    }
}

fn place(picture: Picture) -> String {
    format!("frame {}, view {}", picture.frame, picture.view)
}

fn check_folder(folder: &Path) -> Result<()> {
    if !fs::metadata(folder).map_err(Error::io("open", folder))?.is_dir() {
        return Err(Error::usage(format!("{}: --ground-truth expects a folder of pictures", folder.shown())));
    }
    Ok(())
}

/// Returns the photograph of `picture` by its frame and view: `tNNN_vNN.png`, or in the folder of its camera among `rigs`.
fn numbered_file(folder: &Path, picture: Picture, rigs: &[PathBuf]) -> Option<PathBuf> {
    let in_camera = rigs.get(picture.view as usize).map(|camera| in_rig(camera, picture));
    let files = [Some(folder.join(format!("{}.png", picture.name()))), in_camera];
    files.into_iter().flatten().find(|file| file.is_file())
}

/// The folders of `folder` that are called `cam` and a number, by that: view after view.
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

/// Where a rig's camera has the photograph of `picture`.
fn in_rig(camera: &Path, picture: Picture) -> PathBuf {
    camera.join("images").join(format!("{:04}.png", picture.frame))
}

/// The file inside `folder` that ends as `image` does, by the longest such end.
fn inside(folder: &Path, image: &Path) -> Option<PathBuf> {
    let parts: Vec<_> = image.components().collect();
    let ends = (0..parts.len()).map(|start| parts[start..].iter().collect::<PathBuf>());
    ends.filter(|end| end.is_relative()).map(|end| folder.join(end)).find(|file| file.is_file())
}
