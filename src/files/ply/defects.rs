//! Notes for the user about a PLY file: how many rows have unusual values (such as NaN or a zero quaternion), and which
//! elements and SH coefficients are not read.

use super::write::value;
use super::{PlaneSource, Ply, PlyEncoding};
use crate::error::Result;
use crate::files::defects::{Defects, INFINITE_LOGIT_REPAIR, MAX_LISTED_ROWS, first_of};
use crate::model::{Attributes, Gaussians, INFINITE_LOGIT};

/// Number of rows (Gaussians) that are read and checked at a time.
const CHECKED_ROWS: usize = 4096;

impl Ply {
    /// Returns notes for the user about content of the file that is not read: elements with list properties, and SH
    /// coefficients of degree 4. Uses only the header.
    pub(crate) fn header_notes(&self) -> Vec<String> {
        let skipped = (!self.header.skipped.is_empty()).then(|| {
            format!(
                "left out of the PLY: element {}, which has a list property or follows one; it holds no Gaussians",
                self.header.skipped.join(", ")
            )
        });
        let degree = (self.layout.stored_degree > self.layout.sh_degree).then(|| {
            format!(
                "left out of the PLY: SH coefficients of degree {}; those up to degree {} are read",
                self.layout.stored_degree, self.layout.sh_degree
            )
        });
        skipped.into_iter().chain(degree).collect()
    }

    /// Returns whether the stored opacity logit of Gaussian `row` is infinite.
    fn has_infinite_logit(&self, row: usize) -> bool {
        let big_endian = self.header.encoding == PlyEncoding::BigEndian;
        self.layout.planes(Attributes::OPACITY).iter().any(|plane| match plane {
            PlaneSource::Property(property) => value(self.row(row), property, big_endian).is_infinite(),
            PlaneSource::Thin => false,
        })
    }

    /// Reads all rows (Gaussians) once. Returns notes for the user: how many rows have a zero quaternion, an infinite
    /// opacity logit, or other values that are not finite; then the notes of [`Ply::header_notes`].
    ///
    /// # Errors
    /// Fails if the file was truncated since it was opened.
    pub(crate) fn notes(&self) -> Result<Vec<String>> {
        let mut found = RowDefects::new(self);
        let mut block = Gaussians::zeros(0, self.sh_degree());
        for start in (0..self.count).step_by(CHECKED_ROWS) {
            let end = self.count.min(start + CHECKED_ROWS);
            self.gather_range(start..end, Attributes::all(), &mut block)?;
            found.add(start, &block);
        }
        Ok(found.notes())
    }

    /// Returns the same notes for the user as [`Ply::notes`], without reading the file. `whole` holds all attributes of
    /// all rows (Gaussians) of this file.
    pub(crate) fn notes_with(&self, whole: &Gaussians) -> Vec<String> {
        let mut found = RowDefects::new(self);
        found.add(0, whole);
        found.notes()
    }
}

/// Counts of the rows (Gaussians) of a PLY file that have unusual values, such as NaN or a zero quaternion.
struct RowDefects<'a> {
    ply: &'a Ply,
    /// Counts of the rows with values that the reader replaces: zero quaternions and infinite opacity logits.
    repaired: Defects,
    /// Rows with NaN or infinity: the indices of the first five such rows, and the number of all such rows.
    non_finite: (Vec<u32>, usize),
}

impl RowDefects<'_> {
    fn new(ply: &Ply) -> RowDefects<'_> {
        RowDefects { ply, repaired: Defects::new(ply.count), non_finite: (Vec::new(), 0) }
    }

    /// Counts the defects of some rows. `block` holds all attributes of these rows, and `start` is the index in the
    /// file of the first one.
    fn add(&mut self, start: usize, block: &Gaussians) {
        for row in 0..block.len() {
            let mut found = Vec::new();
            if block.rotation.row::<4>(row) == [0.0; 4] {
                found.push(("zero quaternion", false, "taken as the identity, as 3DGS does"));
            }
            // The reader replaces infinite logits by this value.
            let is_replaced = block.opacity_logit.row::<1>(row)[0].abs() == INFINITE_LOGIT;
            if is_replaced && self.ply.has_infinite_logit(start + row) {
                found.push(("infinite opacity logit", false, INFINITE_LOGIT_REPAIR));
            }
            self.repaired.add_row((start + row) as u32, &found);
            let is_finite = |column: Attributes| {
                let values = block.attribute_values(column);
                (0..values.width()).all(|c| values.plane(c)[row].is_finite())
            };
            if !Attributes::all().iter().all(is_finite) {
                let (first, count) = &mut self.non_finite;
                *count += 1;
                first.extend((first.len() < MAX_LISTED_ROWS).then_some((start + row) as u32));
            }
        }
    }

    /// Returns the notes for the user: about the counted rows first, then about content that is not read.
    fn notes(&self) -> Vec<String> {
        let (first, count) = &self.non_finite;
        let not_drawn = (*count > 0).then(|| {
            format!(
                "{count} of {} rows ({:.2}%) have NaN or infinity, so no renderer draws them: compress leaves \
                 them out if they are at most 1%, or with --set non_finite=drop (rows {})",
                self.ply.count,
                100.0 * *count as f64 / self.ply.count as f64,
                first_of(first, *count),
            )
        });
        self.repaired.notes().into_iter().chain(not_drawn).chain(self.ply.header_notes()).collect()
    }
}
