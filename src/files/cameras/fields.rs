//! Reads values of expected types (numbers, texts, vectors, matrices) from one JSON object of a camera file. Errors
//! name the image and the key.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::MAX_SIDE_PX;
use crate::error::{Error, Result};
use crate::files::json::small::{Object, SmallValue};

/// Expected content of a pose matrix, for error messages.
pub(super) const POSE: &str = "3 or 4 rows of 4 finite numbers";

/// Reader of the keys of one JSON object in a camera file: the object of an image, or the top-level object.
#[derive(Clone, Copy)]
pub(super) struct CameraFields<'a> {
    path: &'a Path,
    /// Index of the image in the file; `None` for the top-level object.
    frame: Option<usize>,
    map: &'a Object,
}

impl<'a> CameraFields<'a> {
    /// Returns a reader of the keys of the JSON object `value` in the file at `path`. `frame` is the index of the
    /// image; `None` for the top-level object.
    ///
    /// # Errors
    /// Fails if `value` is not an object.
    pub(super) fn new(path: &'a Path, frame: Option<usize>, value: &'a SmallValue) -> Result<Self> {
        match value {
            SmallValue::Object(map) => Ok(CameraFields { path, frame, map }),
            other => Err(Error::input(path, place(frame), "an object", other.describe())),
        }
    }

    /// Returns the error for a value under `key` that is not as `expected` describes.
    pub(super) fn wrong(&self, key: &str, expected: impl Into<String>) -> Error {
        let found = self.map.get(key).map_or_else(|| "nothing".to_owned(), SmallValue::describe);
        let place = match self.frame {
            Some(frame) => format!("frame {frame}, key \"{key}\""),
            None => format!("key \"{key}\""),
        };
        Error::input(self.path, place, expected, found)
    }

    /// Returns the finite number under `key`, or `None` if the key is missing or null. Fails for other values.
    pub(super) fn optional_number(&self, key: &str) -> Result<Option<f64>> {
        match self.map.get(key) {
            None | Some(SmallValue::Null) => Ok(None),
            Some(value) => match value.as_f64().filter(|number| number.is_finite()) {
                Some(number) => Ok(Some(number)),
                None => Err(self.wrong(key, "a finite number")),
            },
        }
    }

    /// Returns the finite number under `key`. Fails if there is none.
    pub(super) fn number(&self, key: &str) -> Result<f64> {
        self.optional_number(key)?.ok_or_else(|| self.wrong(key, "a finite number"))
    }

    /// Returns the image width or height in pixels under `key`, or `None` if the key is missing or null. Accepts 800.0,
    /// as some programs write it. Fails if the value is not a whole number from 1 to [`MAX_SIDE_PX`].
    pub(super) fn optional_side(&self, key: &str) -> Result<Option<u32>> {
        match self.optional_number(key)? {
            None => Ok(None),
            Some(side) if side.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE_PX)).contains(&side) => {
                Ok(Some(side as u32))
            }
            Some(_) => Err(self.wrong(key, format!("a whole number of pixels, 1 to {MAX_SIDE_PX}"))),
        }
    }

    /// Returns the image width or height in pixels under `key`. Fails if there is none.
    pub(super) fn side(&self, key: &str) -> Result<u32> {
        self.optional_side(key)?.ok_or_else(|| self.wrong(key, "a number of pixels"))
    }

    /// Returns the text under `key`, or `None` if the key is missing or null. Fails for other values.
    pub(super) fn optional_text(&self, key: &str) -> Result<Option<&'a str>> {
        match self.map.get(key) {
            None | Some(SmallValue::Null) => Ok(None),
            Some(SmallValue::Text(text)) => Ok(Some(text)),
            Some(_) => Err(self.wrong(key, "a text")),
        }
    }

    /// Returns whether the value under `key` is `true`.
    pub(super) fn is_true(&self, key: &str) -> bool {
        matches!(self.map.get(key), Some(SmallValue::Bool(true)))
    }

    /// Returns the non-negative whole number under `key`, or `None` if the key is missing or null. Fails for other
    /// values, and for numbers that do not fit into 32 bits.
    pub(super) fn optional_index(&self, key: &str) -> Result<Option<u32>> {
        match self.map.get(key) {
            None | Some(SmallValue::Null) => Ok(None),
            Some(value) => match value.as_u64().and_then(|number| u32::try_from(number).ok()) {
                Some(number) => Ok(Some(number)),
                None => Err(self.wrong(key, "a whole number, 0 or more")),
            },
        }
    }

    /// Returns the image width and height in pixels, which are the two elements of the list under `key`. Fails if the
    /// list is missing or invalid.
    pub(super) fn sides(&self, key: &str) -> Result<[u32; 2]> {
        let side = |value: f64| {
            (value.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE_PX)).contains(&value)).then_some(value as u32)
        };
        let found = self.map.get(key).and_then(numbers).and_then(|[w, h]| Some([side(w)?, side(h)?]));
        found.ok_or_else(|| self.wrong(key, format!("width and height, 1 to {MAX_SIDE_PX} pixels")))
    }

    /// Returns the three numbers of the list under `key`, or `None` if the key is missing or null. Fails for other
    /// values.
    pub(super) fn optional_vector(&self, key: &str) -> Result<Option<[f64; 3]>> {
        match self.map.get(key) {
            None | Some(SmallValue::Null) => Ok(None),
            Some(value) => numbers(value).map(Some).ok_or_else(|| self.wrong(key, "3 finite numbers")),
        }
    }

    /// Returns the three numbers of the list under `key`. Fails if there is no such list.
    pub(super) fn vector(&self, key: &str) -> Result<[f64; 3]> {
        self.optional_vector(key)?.ok_or_else(|| self.wrong(key, "3 finite numbers"))
    }

    /// Returns the row-major 3 × 3 matrix under `key`. Fails if there is no such matrix.
    pub(super) fn matrix3(&self, key: &str) -> Result<DMat3> {
        let rows = self.map.get(key).and_then(SmallValue::elements).filter(|rows| rows.len() == 3);
        rows.and_then(|rows| Some(from_rows([numbers(&rows[0])?, numbers(&rows[1])?, numbers(&rows[2])?])))
            .ok_or_else(|| self.wrong(key, "3 rows of 3 finite numbers"))
    }

    /// Returns the rotation and translation of the pose `[R | t]` under `key`, a row-major 3 × 4 or 4 × 4 matrix. Fails
    /// if there is no such matrix.
    pub(super) fn pose(&self, key: &str) -> Result<(DMat3, DVec3)> {
        let rows = self.map.get(key).and_then(SmallValue::elements).filter(|rows| matches!(rows.len(), 3 | 4));
        let rows: Option<Vec<[f64; 4]>> = rows.and_then(|rows| rows.iter().map(numbers).collect());
        let rows = rows.ok_or_else(|| self.wrong(key, POSE))?;
        if rows.get(3).is_some_and(|last| *last != [0.0, 0.0, 0.0, 1.0]) {
            return Err(self
                .wrong(key, "0 0 0 1 as its last row")
                .hint("a transposed matrix has the position there: write it row by row"));
        }
        let rotation = from_rows([0, 1, 2].map(|r| [rows[r][0], rows[r][1], rows[r][2]]));
        Ok((rotation, DVec3::new(rows[0][3], rows[1][3], rows[2][3])))
    }

    /// Returns the number of elements of the list under `key`. Fails if there is no list.
    pub(super) fn list_len(&self, key: &str) -> Result<usize> {
        match self.map.get(key) {
            Some(SmallValue::List(_, total)) => Ok(*total),
            _ => Err(self.wrong(key, "a list")),
        }
    }
}

/// Returns the text that names the image with index `frame` in error messages: "frame 12", or an empty text for `None`.
pub(super) fn place(frame: Option<usize>) -> String {
    frame.map_or_else(String::new, |frame| format!("frame {frame}"))
}

/// Returns the elements of `value` if it is a list of exactly `W` finite numbers; `None` for other values.
fn numbers<const W: usize>(value: &SmallValue) -> Option<[f64; W]> {
    let elements: &[SmallValue; W] = value.elements()?.try_into().ok()?;
    let mut out = [0.0; W];
    for (to, from) in out.iter_mut().zip(elements) {
        *to = from.as_f64().filter(|number| number.is_finite())?;
    }
    Some(out)
}

/// Returns the matrix whose rows are `rows`.
fn from_rows(rows: [[f64; 3]; 3]) -> DMat3 {
    DMat3::from_cols_array_2d(&rows).transpose()
}
