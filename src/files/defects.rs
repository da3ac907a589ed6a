//! Rows of a file that are not as its format says, and what its reader did about them.

use serde::{Deserialize, Serialize};

/// Number of row ids that a note lists per defect.
const LISTED: usize = 5;
/// Fraction of a file's rows above which leaving rows out is the first thing said about the file.
const LOUD: f64 = 0.01;

/// What a reader did about the defective rows of a file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Defects {
    /// Rows of the file, without padding.
    pub rows: usize,
    /// Rows with at least one defect.
    pub defective: usize,
    /// Rows left out, each counted once.
    pub dropped: usize,
    /// One entry per kind of defect that was found. A row with several defects counts in several entries.
    pub kinds: Vec<DefectCount>,
}

/// Rows with one kind of defect.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DefectCount {
    /// Kind of the defect, such as "zero quaternion".
    pub what: String,
    /// Whether such rows are left out; else they are kept, as `why` says.
    pub dropped: bool,
    /// Why such rows are treated so, and what to do about it.
    pub why: String,
    /// Number of rows.
    pub rows: usize,
    /// Numbers of the first few rows.
    pub first: Vec<u32>,
}

impl Defects {
    /// Returns counts of zero for a file of `rows` rows.
    pub fn new(rows: usize) -> Defects {
        Defects { rows, ..Defects::default() }
    }

    /// Counts the defects `found` of row `row`, each with its name, whether it drops the row, and why.
    pub fn add(&mut self, row: u32, found: &[(&str, bool, &str)]) {
        self.defective += usize::from(!found.is_empty());
        self.dropped += usize::from(found.iter().any(|&(_, dropped, _)| dropped));
        for &(what, dropped, why) in found {
            let place = self.kinds.iter().position(|kind| kind.what == what).unwrap_or_else(|| {
                let (what, why) = (what.to_owned(), why.to_owned());
                self.kinds.push(DefectCount { what, dropped, why, rows: 0, first: Vec::new() });
                self.kinds.len() - 1
            });
            let kind = &mut self.kinds[place];
            kind.rows += 1;
            if kind.first.len() < LISTED {
                kind.first.push(row);
            }
        }
    }

    /// Returns whether no row has a defect.
    pub fn is_empty(&self) -> bool {
        self.defective == 0
    }

    /// Returns one note per kind of defect, and one with the totals, which is the first where many rows are left out.
    pub fn notes(&self) -> Vec<String> {
        if self.is_empty() {
            return Vec::new();
        }
        let percent = |rows: usize| 100.0 * rows as f64 / self.rows.max(1) as f64;
        let of_kind = |kind: &DefectCount| {
            let first: Vec<String> = kind.first.iter().map(u32::to_string).collect();
            let more = if kind.rows > first.len() { ", ..." } else { "" };
            format!(
                "{} of {} rows ({:.2}%) {}: {}; {} (rows {}{more})",
                kind.rows,
                self.rows,
                percent(kind.rows),
                if kind.dropped { "left out" } else { "repaired" },
                kind.what,
                kind.why,
                first.join(", "),
            )
        };
        let mut notes: Vec<String> = self.kinds.iter().map(of_kind).collect();
        let total = format!(
            "{} of {} rows have defects: {} ({:.2}%) left out, {} repaired",
            self.defective,
            self.rows,
            self.dropped,
            percent(self.dropped),
            self.defective - self.dropped
        );
        let is_loud = self.dropped as f64 > LOUD * self.rows as f64;
        notes.insert(if is_loud { 0 } else { notes.len() }, total);
        notes
    }
}

/// Which rows of a file became Gaussians, where its reader left some out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileRows {
    /// Number of rows of the file.
    pub count: usize,
    /// Row of each Gaussian, increasing.
    pub rows: Vec<u32>,
}

impl FileRows {
    /// Returns the Gaussians of the rows `rows`, in their order, without the rows that were left out.
    pub fn gaussians(&self, rows: &[u32]) -> Vec<u32> {
        rows.iter().filter_map(|row| self.rows.binary_search(row).ok()).map(|id| id as u32).collect()
    }

    /// Returns the first of the rows `rows` that was left out.
    pub fn first_dropped(&self, rows: &[u32]) -> Option<u32> {
        rows.iter().copied().find(|row| self.rows.binary_search(row).is_err())
    }

    /// Spreads `values`, one per Gaussian, over the rows of the file; rows that were left out get `None`.
    pub fn spread<T: Clone>(&self, values: &[Option<T>]) -> Vec<Option<T>> {
        let mut spread = vec![None; self.count];
        self.rows.iter().zip(values).for_each(|(&row, value)| spread[row as usize] = value.clone());
        spread
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_counts_once_per_defect_and_once_in_the_total() {
        let mut defects = Defects::new(1000);
        let (nan, wide) = (("NaN", true, "not drawn"), ("wide", false, "always visible"));
        defects.add(3, &[nan, wide]);
        defects.add(4, &[]);
        (10..20).for_each(|row| defects.add(row, &[wide]));
        assert_eq!((defects.defective, defects.dropped), (11, 1));
        let counts: Vec<(&str, usize)> = defects.kinds.iter().map(|kind| (&*kind.what, kind.rows)).collect();
        assert_eq!(counts, [("NaN", 1), ("wide", 11)]);
        assert_eq!(
            defects.notes(),
            [
                "1 of 1000 rows (0.10%) left out: NaN; not drawn (rows 3)",
                "11 of 1000 rows (1.10%) repaired: wide; always visible (rows 3, 10, 11, 12, 13, ...)",
                "11 of 1000 rows have defects: 1 (0.10%) left out, 10 repaired",
            ]
        );
        (20..40).for_each(|row| defects.add(row, &[nan]));
        assert!(defects.notes()[0].starts_with("31 of 1000 rows have defects: 21 (2.10%) left out"));
        assert_eq!(Defects::new(7).notes(), [""; 0]);
    }

    #[test]
    fn rows_and_gaussians_lead_to_each_other() {
        let rows = FileRows { count: 6, rows: vec![0, 2, 5] };
        assert_eq!(rows.gaussians(&[5, 1, 2]), [2, 1]);
        assert_eq!((rows.first_dropped(&[0, 5]), rows.first_dropped(&[0, 3, 4])), (None, Some(3)));
        assert_eq!(rows.spread(&[Some(7), None, Some(9)]), [Some(7), None, None, None, None, Some(9)]);
    }
}
