//! Reads JSON camera files. The text of a file is in memory. The list of its images is not parsed as a whole, but one
//! image after another; of each image only the wanted keys are parsed. Errors name the image and the key.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use glam::{DMat3, DVec3};
use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::value::RawValue;

use super::MAX_SIDE_PX;
use super::memory::MemoryCounter;
use crate::error::{Error, Result};
use crate::files::json::parse;
use crate::files::text::read_text;

/// Keys that camera files of any format may have. Other keys are ignored.
const KNOWN_KEYS: [&[&str]; 7] = [
    // `cameras.json` of this project and of 3DGS.
    &["frames", "w2c", "background", "split", "width", "height", "fx", "fy", "cx", "cy", "time", "image", "v"],
    &["img_name", "rotation", "position"],
    // `transforms*.json`.
    &["file_path", "transform_matrix", "train_filenames", "val_filenames", "test_filenames"],
    &["w", "h", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y"],
    &["k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "is_fisheye"],
    // `train_meta.json` and `test_meta.json`.
    &["k", "fn", "cam_id"],
    // Files of NeRFies and HyperNeRF.
    &["ids", "val_ids", "train_ids", "warp_id", "image_size", "focal_length", "orientation"],
];
/// Bytes of memory per element of a list of unparsed values: the values, and a copy of them while the list grows.
const ELEMENT_BYTES: u64 = 3 * size_of::<&RawValue>() as u64;
/// Maximum number of characters of a value that a message shows.
const MAX_SHOWN: usize = 120;

/// Reads the text of the camera file at `path`. `counter` limits the memory.
///
/// # Errors
/// Fails if the text exceeds the memory limit or is not UTF-8, or if reading fails.
pub(super) fn read_camera_text(path: &Path, counter: &mut MemoryCounter) -> Result<String> {
    let bytes = path.metadata().map_err(Error::io("read the size of", path))?.len();
    // Count the bytes twice: they are in memory once as read, and once as text.
    counter.take(path, "", "the text of the camera file", bytes.saturating_mul(2))?;
    read_text(path, bytes)
}

/// Returns the elements of the JSON list `text` in the camera file at `path`, each as unparsed text. `counter` limits
/// the memory.
///
/// # Errors
/// Fails if `text` is not a list or exceeds the memory limit.
pub(super) fn elements<'a>(path: &Path, text: &'a str, counter: &mut MemoryCounter) -> Result<Vec<&'a RawValue>> {
    let count = parse::<Vec<IgnoredAny>>(text, path)?.len() as u64;
    counter.take(path, "", &format!("a list of {count} values"), ELEMENT_BYTES * count)?;
    parse(text, path)
}

/// Returns the beginning of the JSON text `text` for a message.
pub(super) fn shorten(text: &str) -> String {
    let (shown, rest) = match text.char_indices().nth(MAX_SHOWN) {
        Some((end, _)) => (&text[..end], "…"),
        None => (text, ""),
    };
    shown.split_whitespace().collect::<Vec<_>>().join(" ") + rest
}

/// Value of a key of a JSON object.
struct RawEntry<'a> {
    /// Unparsed text of the value; of the last one if the key is repeated.
    text: &'a str,
    is_repeated: bool,
}

/// Entries of a JSON object that have one of the [`KNOWN_KEYS`].
#[derive(Default)]
struct KnownEntries<'a>(BTreeMap<&'static str, RawEntry<'a>>);

impl<'de> Deserialize<'de> for KnownEntries<'de> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> std::result::Result<Self, D::Error> {
        from.deserialize_map(KnownEntries::default())
    }
}

impl<'de> Visitor<'de> for KnownEntries<'de> {
    type Value = Self;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(mut self, mut map: A) -> std::result::Result<Self, A::Error> {
        while let Some(key) = map.next_key::<String>()? {
            match KNOWN_KEYS.into_iter().flatten().find(|known| **known == key) {
                Some(known) => {
                    let text = map.next_value::<&RawValue>()?.get();
                    let is_repeated = self.0.contains_key(known);
                    self.0.insert(known, RawEntry { text, is_repeated });
                }
                None => drop(map.next_value::<IgnoredAny>()?),
            }
        }
        Ok(self)
    }
}

/// Reader of the keys of one JSON object in a camera file: the object of an image, or the top-level object.
pub(super) struct CameraFields<'a> {
    path: &'a Path,
    /// Index of the image in the file; `None` for the top-level object.
    frame: Option<usize>,
    entries: KnownEntries<'a>,
}

impl<'a> CameraFields<'a> {
    /// Returns a reader of the keys of the JSON object `text` in the file at `path`. `frame` is the index of the image;
    /// `None` for the top-level object.
    ///
    /// # Errors
    /// Fails if `text` is not a JSON object.
    pub(super) fn new(path: &'a Path, frame: Option<usize>, text: &'a str) -> Result<Self> {
        match (parse(text, path), frame) {
            (Ok(entries), _) => Ok(CameraFields { path, frame, entries }),
            (Err(error), None) => Err(error),
            (Err(_), Some(_)) => Err(Error::input(path, place(frame), "an object", shorten(text))),
        }
    }

    /// Returns a reader of `entries`, keys with their values, that belong to one image of frame number `frame` of the
    /// file at `path`.
    pub(super) fn from_entries(
        path: &'a Path,
        frame: usize,
        entries: impl Iterator<Item = (&'static str, &'a RawValue)>,
    ) -> Self {
        let entries = entries.map(|(key, value)| (key, RawEntry { text: value.get(), is_repeated: false }));
        CameraFields { path, frame: Some(frame), entries: KnownEntries(entries.collect()) }
    }

    /// Returns the text of the value under `key`, or `None` if the key is missing or null.
    fn text(&self, key: &str) -> Option<&'a str> {
        self.entries.0.get(key).map(|entry| entry.text).filter(|text| *text != "null")
    }

    /// Returns whether there is a value other than null under `key`.
    pub(super) fn has(&self, key: &str) -> bool {
        self.text(key).is_some()
    }

    /// Returns the error for a value under `key` that is not as `expected` describes.
    pub(super) fn wrong(&self, key: &str, expected: impl Into<String>) -> Error {
        let found = self.entries.0.get(key).map_or_else(|| "nothing".to_owned(), |entry| shorten(entry.text));
        let place = match self.frame {
            Some(frame) => format!("frame {frame}, key \"{key}\""),
            None => format!("key \"{key}\""),
        };
        Error::input(self.path, place, expected, found)
    }

    /// Returns the value under `key`, or `None` if the key is missing or null. Fails if the value is not a `T`;
    /// `expected` describes a `T` for the message.
    fn optional<T: Deserialize<'a>>(&self, key: &str, expected: &str) -> Result<Option<T>> {
        let Some(text) = self.text(key) else { return Ok(None) };
        serde_json::from_str(text).map(Some).map_err(|_| self.wrong(key, expected))
    }

    /// Returns the value under `key`. Fails if there is none or if it is not a `T`; `expected` describes a `T`.
    fn required<T: Deserialize<'a>>(&self, key: &str, expected: &str) -> Result<T> {
        self.optional(key, expected)?.ok_or_else(|| self.wrong(key, expected))
    }

    /// Returns the finite number under `key`, or `None` if the key is missing or null. Fails for other values.
    pub(super) fn optional_number(&self, key: &str) -> Result<Option<f64>> {
        self.optional(key, "a finite number")
    }

    /// Returns the finite number under `key`. Fails if there is none.
    pub(super) fn number(&self, key: &str) -> Result<f64> {
        self.required(key, "a finite number")
    }

    /// Returns the image width or height in pixels under `key`, or `None` if the key is missing or null. Accepts 800.0,
    /// as some programs write it. Fails if the value is not a whole number from 1 to [`MAX_SIDE_PX`].
    pub(super) fn optional_side(&self, key: &str) -> Result<Option<u32>> {
        let Some(value) = self.optional_number(key)? else { return Ok(None) };
        let expected = || format!("a whole number of pixels, 1 to {MAX_SIDE_PX}");
        side(value).map(Some).ok_or_else(|| self.wrong(key, expected()))
    }

    /// Returns the image width or height in pixels under `key`. Fails if there is none.
    pub(super) fn side(&self, key: &str) -> Result<u32> {
        self.optional_side(key)?.ok_or_else(|| self.wrong(key, "a number of pixels"))
    }

    /// Returns the image width and height in pixels, which are the two elements of the list under `key`. Fails if the
    /// list is missing or invalid.
    pub(super) fn sides(&self, key: &str) -> Result<(u32, u32)> {
        let expected = format!("width and height, 1 to {MAX_SIDE_PX} pixels");
        let [width, height] = self.required(key, &expected)?;
        side(width).zip(side(height)).ok_or_else(|| self.wrong(key, expected))
    }

    /// Returns the text under `key`, or `None` if the key is missing or null. Fails for other values.
    pub(super) fn optional_text(&self, key: &str) -> Result<Option<String>> {
        self.optional(key, "a text")
    }

    /// Returns whether the value under `key` is `true`.
    pub(super) fn is_true(&self, key: &str) -> bool {
        self.text(key) == Some("true")
    }

    /// Returns the non-negative whole number under `key`, or `None` if the key is missing or null. Fails for other
    /// values, and for numbers that do not fit into 32 bits.
    pub(super) fn optional_index(&self, key: &str) -> Result<Option<u32>> {
        self.optional(key, "a whole number, 0 or more")
    }

    /// Returns the three numbers of the list under `key`, or `None` if the key is missing or null. Fails for other
    /// values.
    pub(super) fn optional_vector(&self, key: &str) -> Result<Option<[f64; 3]>> {
        self.optional(key, "3 finite numbers")
    }

    /// Returns the three numbers of the list under `key`. Fails if there is no such list.
    pub(super) fn vector(&self, key: &str) -> Result<DVec3> {
        self.required(key, "3 finite numbers").map(DVec3::from_array)
    }

    /// Returns the row-major 3 × 3 matrix under `key`. Fails if there is no such matrix.
    pub(super) fn matrix3(&self, key: &str) -> Result<DMat3> {
        self.required(key, "3 rows of 3 finite numbers").map(from_rows)
    }

    /// Returns the rotation and translation of the pose `[R | t]` under `key`, a row-major 3 × 4 or 4 × 4 matrix. Fails
    /// if there is no such matrix.
    pub(super) fn pose(&self, key: &str) -> Result<(DMat3, DVec3)> {
        let expected = "3 or 4 rows of 4 finite numbers";
        let rows: Vec<[f64; 4]> = self.required(key, expected)?;
        let [x, y, z, last @ ..] = &rows[..] else { return Err(self.wrong(key, expected)) };
        match last {
            [] | [[0.0, 0.0, 0.0, 1.0]] => {}
            [_] => {
                return Err(self
                    .wrong(key, "0 0 0 1 as its last row")
                    .hint("a transposed matrix has the position there: write it row by row"));
            }
            _ => return Err(self.wrong(key, expected)),
        }
        let rotation = from_rows([x, y, z].map(|row| [row[0], row[1], row[2]]));
        Ok((rotation, DVec3::new(x[3], y[3], z[3])))
    }

    /// Returns whether the value under `key` is a list.
    pub(super) fn is_list(&self, key: &str) -> bool {
        self.text(key).is_some_and(|text| text.starts_with('['))
    }

    /// Returns the elements of the list under `key`, each as unparsed text. `counter` limits the memory. Fails if there
    /// is no list or if the key is repeated.
    pub(super) fn list(&self, key: &str, counter: &mut MemoryCounter) -> Result<Vec<&'a RawValue>> {
        match self.entries.0.get(key) {
            Some(RawEntry { is_repeated: true, .. }) => {
                Err(Error::input(self.path, format!("key \"{key}\""), "this key once", "twice"))
            }
            Some(RawEntry { text, .. }) if text.starts_with('[') => elements(self.path, text, counter),
            _ => Err(self.wrong(key, "a list")),
        }
    }

    /// Returns the texts in the list under `key`. `counter` limits the memory; `text_bytes` is the number of bytes per
    /// text in addition to its characters. Fails if there is no list, or if an element is not a text.
    pub(super) fn texts(&self, key: &str, text_bytes: u64, counter: &mut MemoryCounter) -> Result<Vec<String>> {
        let mut texts = Vec::new();
        for (index, element) in self.list(key, counter)?.into_iter().enumerate() {
            let place = format!("key \"{key}\", element {index}");
            counter.take(self.path, &place, "the names of images", element.get().len() as u64 + text_bytes)?;
            let wrong = |_| Error::input(self.path, place, "the name of an image", shorten(element.get()));
            texts.push(serde_json::from_str(element.get()).map_err(wrong)?);
        }
        Ok(texts)
    }
}

/// Returns the text that names the image with index `frame` in error messages: "frame 12", or an empty text for `None`.
pub(super) fn place(frame: Option<usize>) -> String {
    frame.map_or_else(String::new, |frame| format!("frame {frame}"))
}

/// Returns the width or height `value` of an image as an integer; `None` if it is not a whole number from 1 to
/// [`MAX_SIDE_PX`].
pub(super) fn side(value: f64) -> Option<u32> {
    (value.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE_PX)).contains(&value)).then_some(value as u32)
}

/// Returns the matrix whose rows are `rows`.
fn from_rows(rows: [[f64; 3]; 3]) -> DMat3 {
    DMat3::from_cols_array_2d(&rows).transpose()
}
