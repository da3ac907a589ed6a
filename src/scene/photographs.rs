//! Photographs that pictures are compared with.

use std::fs;
use std::path::{Path, PathBuf};

use hashbrown::HashMap;

use super::work::stamps;
use crate::error::{Error, Result};
use crate::ingest::image::read_png;
use crate::model::{Camera, Picture, Rig};
use crate::render::Image;

/// Where the photographs of some pictures are.
pub struct Photographs {
    /// By frame and view.
    files: HashMap<(usize, u32), PathBuf>,
}

impl Photographs {
    /// Finds the photograph of every picture: `tNNN_vNN.png`, else the file its camera names, by as
    /// much of its path as leads to one inside `folder`.
    ///
    /// # Errors
    /// A folder that cannot be read; a picture without a photograph, or that shares one with another.
    pub fn find(folder: &Path, rig: &Rig, times: &[f64], pictures: &[Picture]) -> Result<Photographs> {
        check_folder(folder)?;
        let file = |&picture: &Picture| {
            let named = rig.image(picture, times);
            let file = file_of(folder, named, picture).ok_or_else(|| {
                let named = named.and_then(Path::file_name).map(|name| format!(" or {}", name.display()));
                let expected = format!("{}.png{}", picture.name(), named.unwrap_or_default());
                Error::input(folder, place(picture), expected, "no such file")
                    .hint("--max-frames compares fewer frames, --split other pictures")
            })?;
            Ok((picture, file))
        };
        Photographs::at(folder, pictures.iter().map(file))
    }

    /// Of pictures with the file of each, inside `folder`.
    fn at(folder: &Path, found: impl Iterator<Item = Result<(Picture, PathBuf)>>) -> Result<Photographs> {
        let mut files = HashMap::new();
        let mut takers: HashMap<PathBuf, Picture> = HashMap::new();
        for found in found {
            let (picture, file) = found?;
            // The names that a time-stamped rig gives its files are shared by all of its cameras.
            if let Some(other) = takers.insert(file.clone(), picture) {
                let found = format!("{}, as for frame {}, view {}", file.display(), other.frame, other.view);
                return Err(Error::input(folder, place(picture), "a picture of its own", found)
                    .hint("give the folder that the cameras' file paths start from"));
            }
            files.insert((picture.frame, picture.view), file);
        }
        Ok(Photographs { files })
    }

    /// Those of `pictures` that have a photograph, and their photographs.
    ///
    /// # Errors
    /// A folder that cannot be read; a picture that shares its photograph with another.
    pub fn of_some(
        folder: &Path,
        rig: &Rig,
        times: &[f64],
        pictures: Vec<Picture>,
    ) -> Result<(Vec<Picture>, Photographs)> {
        check_folder(folder)?;
        let file = |picture: Picture| Some((picture, file_of(folder, rig.image(picture, times), picture)?));
        let found: Vec<(Picture, PathBuf)> = pictures.into_iter().filter_map(file).collect();
        let pictures = found.iter().map(|(picture, _)| *picture).collect();
        Ok((pictures, Photographs::at(folder, found.into_iter().map(Ok))?))
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
        return Err(Error::usage(format!("{}: --ground-truth expects a folder of pictures", folder.display())));
    }
    Ok(())
}

/// The photograph of `picture`, which its camera calls `named`.
fn file_of(folder: &Path, named: Option<&Path>, picture: Picture) -> Option<PathBuf> {
    let numbered = folder.join(format!("{}.png", picture.name()));
    if numbered.is_file() { Some(numbered) } else { inside(folder, named?) }
}

/// The file inside `folder` that ends as `image` does, by the longest such end.
fn inside(folder: &Path, image: &Path) -> Option<PathBuf> {
    let parts: Vec<_> = image.components().collect();
    let ends = (0..parts.len()).map(|start| parts[start..].iter().collect::<PathBuf>());
    ends.filter(|end| end.is_relative()).map(|end| folder.join(end)).find(|file| file.is_file())
}
