//! Checks and repairs rows (Gaussians) of a `.splatv` file with values that players do not draw or treat in a special
//! way.
//!
//! The players splaTV and gsplat.js draw no row with a NaN position and none with a temporal width of 0. They draw no
//! row whose quaternion is 0 at every time, because they divide by the length of the quaternion. They show a row with
//! an infinite width at every time, because exp(−(dt/∞)²) = 1.

use half::f16;
use serde::{Deserialize, Serialize};

use super::{Splatv, SplatvGaussian, WORDS_PER_GAUSSIAN};
use crate::error::{Error, Result};
use crate::files::defects::{Defect, Defects, KEPT_ZERO_QUATERNION};

/// Treatment of rows (Gaussians) whose quaternion is 0 at every time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ZeroRotation {
    /// Rows with quaternion 0 are left out, because no player draws them.
    #[default]
    Drop,
    /// Rows with quaternion 0 are kept with the identity as rotation, as SpacetimeGaussians does in training.
    Identity,
}

const NON_FINITE_POSITION: Defect = ("NaN or infinite position", true, "no player draws them");
const INVALID_WIDTH: Defect = ("temporal width of NaN, 0 or less", true, "they are visible at no time");
const NON_FINITE_VALUE: Defect =
    ("NaN or infinite motion, scale, rotation, rate or center", true, "no player draws them");
const ZERO_QUATERNION: Defect =
    ("zero quaternion", true, "no player draws them; --zero-rotation identity keeps them without a rotation");
const INFINITE_WIDTH: Defect =
    ("infinite temporal width", false, "visible at every time, as in players; written as the largest half");

/// Returns the defects of one row (Gaussian). `zero_rotation` determines whether a row whose quaternion is 0 at every
/// time is left out or repaired.
fn defects(row: &SplatvGaussian, zero_rotation: ZeroRotation) -> Vec<Defect> {
    let is_finite = |values: &[f32]| values.iter().all(|x| x.is_finite());
    let others = [&row.motion[..], &row.rotation, &row.omega, &row.scale, &[row.center]];
    let unturned = match zero_rotation {
        ZeroRotation::Drop => ZERO_QUATERNION,
        ZeroRotation::Identity => KEPT_ZERO_QUATERNION,
    };
    let all = [
        (!is_finite(&row.position), NON_FINITE_POSITION),
        (row.width.is_nan() || row.width <= 0.0, INVALID_WIDTH),
        (!others.into_iter().all(is_finite), NON_FINITE_VALUE),
        (has_zero_quaternion(row), unturned),
        (row.width == f32::INFINITY, INFINITE_WIDTH),
    ];
    all.into_iter().filter_map(|(is_there, defect)| is_there.then_some(defect)).collect()
}

/// Returns whether the quaternion of a row (Gaussian) is 0 at every time. A quaternion that is 0 at only one instant is
/// not a defect.
pub(crate) fn has_zero_quaternion(row: &SplatvGaussian) -> bool {
    row.rotation == [0.0; 4] && row.omega == [0.0; 4]
}

/// Checks every row (Gaussian) of `file`. Returns the counts of defects, and the indices of the rows to keep,
/// increasing; `None` instead of indices if all rows are kept. `zero_rotation` determines whether rows whose quaternion
/// is 0 at every time are left out.
///
/// # Errors
/// Fails if all rows of the file would be left out.
pub fn check_rows(file: &Splatv, zero_rotation: ZeroRotation) -> Result<(Defects, Option<Vec<u32>>)> {
    let count = file.count();
    let mut found = Defects::new(count);
    let mut rows: Option<Vec<u32>> = None;
    for row in 0..count as u32 {
        let row_defects = defects(&SplatvGaussian::from_words(&file.words(row as usize)), zero_rotation);
        match (found.add_row(row, &row_defects), &mut rows) {
            // This is the first row that is left out: all rows before it are kept.
            (true, None) => rows = Some((0..row).collect()),
            (false, Some(rows)) => rows.push(row),
            _ => (),
        }
    }
    if count > 0 && found.dropped == count {
        let error = Error::input(file.path(), "its texture", "rows that a player draws", found.describe_kinds());
        return Err(match found.kinds.iter().any(|kind| kind.what == ZERO_QUATERNION.0) {
            true => error.hint("--zero-rotation identity keeps rows with a zero quaternion"),
            false => error.hint("the model did not train, or its conversion failed: export it again"),
        });
    }
    Ok((found, rows))
}

/// Repairs `words`, which store one row (Gaussian), in place. An infinite temporal width becomes the largest finite
/// half-precision value, and a quaternion that is 0 at every time becomes the identity.
pub fn repair_words(words: &mut [u32; WORDS_PER_GAUSSIAN]) {
    let row = SplatvGaussian::from_words(words);
    if row.width == f32::INFINITY {
        words[15] = (words[15] & 0xffff) | u32::from(f16::MAX.to_bits()) << 16;
    }
    if has_zero_quaternion(&row) {
        words[3] = u32::from(f16::ONE.to_bits());
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::files::splatv::write::{encode_words, write_splatv};

    /// Returns a row (Gaussian) without defects. `x` is its x coordinate.
    fn sound(x: f32) -> SplatvGaussian {
        SplatvGaussian {
            position: [x, 0.5, 2.0],
            rotation: [1.0, 0.0, 0.0, 0.0],
            scale: [0.1; 3],
            rgb: [0.5; 3],
            opacity: 0.9,
            center: 0.5,
            width: 0.25,
            ..SplatvGaussian::default()
        }
    }

    /// Writes a `.splatv` file to `folder` and opens it. Each function in `edits` makes one row (Gaussian) of the file:
    /// it receives the words of a row without defects ([`sound`]) and changes them. A function can thus set
    /// half-precision values that [`encode_words`] never stores, such as NaN.
    fn file(folder: &std::path::Path, edits: &[fn(&mut [u32; WORDS_PER_GAUSSIAN])]) -> Splatv {
        let path = folder.join("rows.splatv");
        let rows: Vec<[u32; WORDS_PER_GAUSSIAN]> = edits
            .iter()
            .enumerate()
            .map(|(k, edit)| {
                let mut row = encode_words(&sound(k as f32));
                edit(&mut row);
                row
            })
            .collect();
        write_splatv(&path, rows.len(), rows.into_iter(), &json!([])).unwrap();
        Splatv::open(&path).unwrap()
    }

    const NAN: u32 = 0x7e00;
    const INFINITE: u32 = 0x7c00;
    fn set_high(word: &mut u32, half: u32) {
        *word = (*word & 0xffff) | half << 16;
    }

    const EDITS: [fn(&mut [u32; WORDS_PER_GAUSSIAN]); 12] = [
        |_| (),
        |row| row[1] = f32::NAN.to_bits(),
        |row| row[2] = f32::NEG_INFINITY.to_bits(),
        |row| *row = [0; WORDS_PER_GAUSSIAN],
        |row| set_high(&mut row[15], 0xbc00),
        |row| set_high(&mut row[15], NAN),
        |row| set_high(&mut row[9], INFINITE),
        |row| set_high(&mut row[13], NAN),
        |row| row[3] = 0,
        |row| set_high(&mut row[15], INFINITE),
        // The quaternion is zero only at the center of the temporal window.
        |row| (row[3], row[13]) = (0, 0x3c00),
        // The row has a NaN position, a zero quaternion and an infinite width at once.
        |row| {
            (row[0], row[3]) = (f32::NAN.to_bits(), 0);
            set_high(&mut row[15], INFINITE);
        },
    ];

    #[test]
    fn every_defect_is_counted_and_dropped_or_repaired() {
        let folder = tempfile::tempdir().unwrap();
        let file = file(folder.path(), &EDITS);
        let counts = |found: &Defects| {
            let rows_with =
                |defect: Defect| found.kinds.iter().find(|kind| kind.what == defect.0).map_or(0, |kind| kind.rows);
            [NON_FINITE_POSITION, INVALID_WIDTH, NON_FINITE_VALUE, ZERO_QUATERNION, INFINITE_WIDTH].map(rows_with)
        };
        let (found, rows) = check_rows(&file, ZeroRotation::Drop).unwrap();
        // A row of zeros has the defects `INVALID_WIDTH` and `ZERO_QUATERNION`.
        assert_eq!((counts(&found), found.defective, found.dropped), ([3, 3, 2, 3, 2], 10, 9));
        assert_eq!(rows.unwrap(), [0, 9, 10]);
        let (found, rows) = check_rows(&file, ZeroRotation::Identity).unwrap();
        assert_eq!((counts(&found), found.defective, found.dropped), ([3, 3, 2, 3, 2], 10, 8));
        assert_eq!(rows.unwrap(), [0, 8, 9, 10]);
    }

    #[test]
    fn a_valid_file_has_no_defects_and_keeps_all_rows() {
        let folder = tempfile::tempdir().unwrap();
        let (found, rows) = check_rows(&file(folder.path(), &[EDITS[0]; 5]), ZeroRotation::Drop).unwrap();
        assert_eq!((found.is_empty(), rows), (true, None));
    }

    #[test]
    fn a_file_without_drawable_rows_is_refused_with_a_hint() {
        let folder = tempfile::tempdir().unwrap();
        let refusal = |edits: &[fn(&mut [u32; WORDS_PER_GAUSSIAN])]| {
            check_rows(&file(folder.path(), edits), ZeroRotation::Drop).unwrap_err().to_string()
        };
        let message = refusal(&[EDITS[8]; 3]);
        assert!(message.contains("zero quaternion in 3") && message.contains("--zero-rotation identity"), "{message}");
        let message = refusal(&[EDITS[1]; 2]);
        assert!(message.contains("NaN or infinite position in 2") && message.contains("export it again"), "{message}");
    }

    #[test]
    fn repair_changes_only_width_and_rotation() {
        for (edit, expected) in [(8, [1.0, 0.0, 0.0, 0.0]), (9, [1.0, 0.0, 0.0, 0.0]), (10, [0.0; 4])] {
            let mut row = encode_words(&sound(1.0));
            EDITS[edit](&mut row);
            let before = SplatvGaussian::from_words(&row);
            repair_words(&mut row);
            let after = SplatvGaussian::from_words(&row);
            let width = if before.width.is_finite() { before.width } else { 65504.0 };
            assert_eq!(after, SplatvGaussian { rotation: expected, width, ..before }, "edit {edit}");
        }
    }
}
