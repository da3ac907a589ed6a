//! Rows of a `.splatv` as players treat them: padding, rows that no player draws, and windows without an end.
//!
//! splaTV and gsplat.js draw no row with a NaN position, none with a width of 0, and none whose quaternion is 0 at every
//! time, because they divide by its length. They show a row with an infinite width at every time: exp(−(dt/∞)²) = 1.

use half::f16;
use serde::{Deserialize, Serialize};

use super::{Splatv, SplatvGaussian, WORDS};
use crate::error::{Error, Result};
use crate::files::defects::Defects;

/// What becomes of rows whose quaternion is 0 at every time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ZeroRotation {
    /// They are left out: no player draws them.
    #[default]
    Drop,
    /// They are not turned, as in the training of SpacetimeGaussians.
    Identity,
}

/// A kind of defect: its name, whether rows with it are left out, and why.
type Defect = (&'static str, bool, &'static str);

const POSITION: Defect = ("NaN or infinite position", true, "no player draws them");
const WIDTH: Defect = ("temporal width of NaN, 0 or less", true, "they are visible at no time");
const VALUE: Defect = ("NaN or infinite motion, scale, rotation, rate or center", true, "no player draws them");
const UNTURNED: Defect =
    ("zero quaternion", true, "no player draws them; --zero-rotation identity keeps them without a rotation");
const IDENTITY: Defect = ("zero quaternion", false, "taken as the identity, as --zero-rotation asks");
const UNBOUNDED: Defect =
    ("infinite temporal width", false, "visible at every time, as in players; written as the largest half");

/// Finds the defects of a row.
fn defects(row: &SplatvGaussian, zero_rotation: ZeroRotation) -> Vec<Defect> {
    let is_finite = |values: &[f32]| values.iter().all(|x| x.is_finite());
    let others = [&row.motion[..], &row.rotation, &row.omega, &row.scale, &[row.center]];
    let unturned = match zero_rotation {
        ZeroRotation::Drop => UNTURNED,
        ZeroRotation::Identity => IDENTITY,
    };
    let all = [
        (!is_finite(&row.position), POSITION),
        (row.width.is_nan() || row.width <= 0.0, WIDTH),
        (!others.into_iter().all(is_finite), VALUE),
        (is_unturned(row), unturned),
        (row.width == f32::INFINITY, UNBOUNDED),
    ];
    all.into_iter().filter_map(|(is_there, defect)| is_there.then_some(defect)).collect()
}

/// Returns whether a row's quaternion is 0 at every time. One that is 0 at one instant only is no defect.
pub(crate) fn is_unturned(row: &SplatvGaussian) -> bool {
    row.rotation == [0.0; 4] && row.omega == [0.0; 4]
}

/// Looks at every row of `file`. Returns the defects found and, where some rows are left out, the numbers of the others,
/// increasing.
///
/// # Errors
/// A file all of whose rows would be left out.
pub fn inspect(file: &Splatv, zero_rotation: ZeroRotation) -> Result<(Defects, Option<Vec<u32>>)> {
    let count = file.count();
    let mut found = Defects::new(count);
    let mut rows: Option<Vec<u32>> = None;
    for row in 0..count as u32 {
        let of_row = defects(&SplatvGaussian::of_words(&file.words(row as usize)), zero_rotation);
        found.add(row, &of_row);
        match (of_row.iter().any(|&(_, dropped, _)| dropped), &mut rows) {
            // The first row that is left out: all rows before it stay.
            (true, None) => rows = Some((0..row).collect()),
            (false, Some(rows)) => rows.push(row),
            _ => (),
        }
    }
    if count > 0 && found.dropped == count {
        let kinds: Vec<String> = found.kinds.iter().map(|kind| format!("{} in {}", kind.what, kind.rows)).collect();
        let error = Error::input(file.path(), "its texture", "rows that a player draws", kinds.join(", "));
        let is_zero = |kind: &str| kind == UNTURNED.0;
        return Err(match found.kinds.iter().any(|kind| is_zero(&kind.what)) {
            true => error.hint("--zero-rotation identity keeps rows with a zero quaternion"),
            false => error.hint("the model did not train, or its conversion failed: export it again"),
        });
    }
    Ok((found, rows))
}

/// Repairs the words of a row that is kept: an infinite width becomes the largest half, a quaternion that is 0 at every time
/// the identity.
pub fn repair(words: &mut [u32; WORDS]) {
    let row = SplatvGaussian::of_words(words);
    if row.width == f32::INFINITY {
        words[15] = (words[15] & 0xffff) | u32::from(f16::MAX.to_bits()) << 16;
    }
    if is_unturned(&row) {
        words[3] = u32::from(f16::ONE.to_bits());
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::files::splatv::write::{words, write};

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

    /// A file with one row of each kind; the halves are set as other programs write them.
    fn file(folder: &std::path::Path, edits: &[fn(&mut [u32; WORDS])]) -> Splatv {
        let path = folder.join("rows.splatv");
        let rows: Vec<[u32; WORDS]> = edits
            .iter()
            .enumerate()
            .map(|(k, edit)| {
                let mut row = words(&sound(k as f32));
                edit(&mut row);
                row
            })
            .collect();
        write(&path, rows.len(), rows.into_iter(), &json!([])).unwrap();
        Splatv::open(&path).unwrap()
    }

    const NAN: u32 = 0x7e00;
    const INFINITE: u32 = 0x7c00;
    fn set_high(word: &mut u32, half: u32) {
        *word = (*word & 0xffff) | half << 16;
    }

    const EDITS: [fn(&mut [u32; WORDS]); 12] = [
        |_| (),
        |row| row[1] = f32::NAN.to_bits(),
        |row| row[2] = f32::NEG_INFINITY.to_bits(),
        |row| *row = [0; WORDS],
        |row| set_high(&mut row[15], 0xbc00),
        |row| set_high(&mut row[15], NAN),
        |row| set_high(&mut row[9], INFINITE),
        |row| set_high(&mut row[13], NAN),
        |row| row[3] = 0,
        |row| set_high(&mut row[15], INFINITE),
        // Zero at its center only.
        |row| (row[3], row[13]) = (0, 0x3c00),
        // NaN, unturned and wide at once.
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
            let of = |defect: Defect| found.kinds.iter().find(|kind| kind.what == defect.0).map_or(0, |kind| kind.rows);
            [POSITION, WIDTH, VALUE, UNTURNED, UNBOUNDED].map(of)
        };
        let (found, rows) = inspect(&file, ZeroRotation::Drop).unwrap();
        // A row of zeros has neither a width nor a rotation.
        assert_eq!((counts(&found), found.defective, found.dropped), ([3, 3, 2, 3, 2], 10, 9));
        assert_eq!(rows.unwrap(), [0, 9, 10]);
        let (found, rows) = inspect(&file, ZeroRotation::Identity).unwrap();
        assert_eq!((counts(&found), found.defective, found.dropped), ([3, 3, 2, 3, 2], 10, 8));
        assert_eq!(rows.unwrap(), [0, 8, 9, 10]);
    }

    #[test]
    fn a_sound_file_has_no_defects_and_all_its_rows() {
        let folder = tempfile::tempdir().unwrap();
        let (found, rows) = inspect(&file(folder.path(), &[EDITS[0]; 5]), ZeroRotation::Drop).unwrap();
        assert_eq!((found.is_empty(), rows), (true, None));
    }

    #[test]
    fn a_file_without_a_row_to_draw_is_refused_with_the_way_out() {
        let folder = tempfile::tempdir().unwrap();
        let refusal = |edits: &[fn(&mut [u32; WORDS])]| {
            inspect(&file(folder.path(), edits), ZeroRotation::Drop).unwrap_err().to_string()
        };
        let said = refusal(&[EDITS[8]; 3]);
        assert!(said.contains("zero quaternion in 3") && said.contains("--zero-rotation identity"), "{said}");
        let said = refusal(&[EDITS[1]; 2]);
        assert!(said.contains("NaN or infinite position in 2") && said.contains("export it again"), "{said}");
    }

    #[test]
    fn repaired_words_have_a_finite_width_and_a_rotation_and_nothing_else_changed() {
        for (edit, expected) in [(8, [1.0, 0.0, 0.0, 0.0]), (9, [1.0, 0.0, 0.0, 0.0]), (10, [0.0; 4])] {
            let mut row = words(&sound(1.0));
            EDITS[edit](&mut row);
            let before = SplatvGaussian::of_words(&row);
            repair(&mut row);
            let after = SplatvGaussian::of_words(&row);
            let width = if before.width.is_finite() { before.width } else { 65504.0 };
            assert_eq!(after, SplatvGaussian { rotation: expected, width, ..before }, "edit {edit}");
        }
    }
}
