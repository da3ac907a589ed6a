//! Notes on the defects of a PLY file: rows with unusual values, and parts of the file that are not read.

use super::write::value;
use super::{PlaneSource, Ply, PlyEncoding};
use crate::error::Result;
use crate::files::defects::Defects;
use crate::model::{Attributes, Gaussians, INFINITE_LOGIT};

/// Number of rows that are checked together.
const CHECKED_ROWS: usize = 4096;

impl Ply {
    /// Returns notes for the user on the parts of the file that are not read. Reads no rows.
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

    /// Reads all rows once, and returns notes for the user: those of [`Ply::header_notes`], and the numbers of rows with
    /// a zero quaternion, an infinite opacity logit, or other values that are not finite.
    ///
    /// # Errors
    /// Fails if the file was truncated since it was opened.
    pub(crate) fn notes(&self) -> Result<Vec<String>> {
        let mut repaired = Defects::new(self.count);
        let mut non_finite: Vec<usize> = Vec::new();
        let mut non_finite_count = 0;
        let mut block = Gaussians::zeros(0, self.sh_degree());
        for start in (0..self.count).step_by(CHECKED_ROWS) {
            let end = self.count.min(start + CHECKED_ROWS);
            self.gaussians(start..end, Attributes::all(), &mut block)?;
            for row in 0..end - start {
                let mut found = Vec::new();
                if block.rotation.row::<4>(row) == [0.0; 4] {
                    found.push(("zero quaternion", false, "taken as the identity, as 3DGS does"));
                }
                // The reader replaces infinite logits by this value.
                if block.opacity_logit.row::<1>(row)[0].abs() == INFINITE_LOGIT && self.has_infinite_logit(start + row)
                {
                    found.push(("infinite opacity logit", false, "read as ±100, which is opaque or invisible"));
                }
                repaired.add((start + row) as u32, &found);
                let is_finite = |column: Attributes| {
                    let values = block.column(column);
                    (0..values.width()).all(|c| values.plane(c)[row].is_finite())
                };
                if !Attributes::all().iter().all(is_finite) {
                    non_finite_count += 1;
                    non_finite.extend((non_finite.len() < 5).then_some(start + row));
                }
            }
        }
        let rows: Vec<String> = non_finite.iter().map(usize::to_string).collect();
        let more = if non_finite_count > rows.len() { ", ..." } else { "" };
        let not_drawn = (non_finite_count > 0).then(|| {
            format!(
                "{non_finite_count} of {} rows ({:.2}%) have NaN or infinity, so no renderer draws them: compress leaves \
                 them out if they are at most 1%, or with --set non_finite=drop (rows {}{more})",
                self.count,
                100.0 * non_finite_count as f64 / self.count as f64,
                rows.join(", "),
            )
        });
        Ok(repaired.notes().into_iter().chain(not_drawn).chain(self.header_notes()).collect())
    }
}
