//! Counts of the rows of a file that violate its format (defective rows), and of how the reader treated them: dropped
//! or repaired.

/// Maximum number of row indices in a note to the user about one kind of defect.
pub const MAX_LISTED_ROWS: usize = 5;
/// How an infinite opacity logit is repaired, for notes to the user.
pub const INFINITE_LOGIT_REPAIR: &str = "read as ±100, which is opaque or invisible";
/// Fraction of dropped rows that determines where the note with the total counts stands among the notes to the user:
/// first above this fraction, otherwise last.
const TOTALS_FIRST_FRACTION: f64 = 0.01;

/// Kind of defect of a row (Gaussian). The elements are its name, whether rows with it are left out, and the reason.
pub type Defect = (&'static str, bool, &'static str);

/// Zero quaternion of a row (Gaussian) that the user asks to keep.
pub const KEPT_ZERO_QUATERNION: Defect = ("zero quaternion", false, "taken as the identity, as --zero-rotation asks");

/// Counts of the rows of a file that have defects, and of the rows that the reader dropped because of defects.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Defects {
    /// Number of rows (Gaussians) of the file, not counting rows that only pad it.
    pub rows: usize,
    /// Number of rows with at least one defect.
    pub defective: usize,
    /// Number of dropped rows; a row with several defects counts once.
    pub dropped: usize,
    /// Counts per kind of defect that was found. A row with several defects counts in several entries.
    pub kinds: Vec<DefectCount>,
}

/// Count of the rows of a file that have one kind of defect.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DefectCount {
    /// Name of the defect, such as "zero quaternion".
    pub what: String,
    /// Whether rows with this defect are dropped. Otherwise they are repaired as described by `why`.
    pub dropped: bool,
    /// Reason why the rows are dropped or repaired, and advice for the user.
    pub why: String,
    /// Number of rows with this defect.
    pub rows: usize,
    /// Indices of the first five rows with this defect, for the note to the user.
    pub first: Vec<u32>,
}

impl Defects {
    /// Returns the counts for a file of `rows` rows, with no defects counted yet.
    pub fn new(rows: usize) -> Defects {
        Defects { rows, ..Defects::default() }
    }

    /// Counts the defects `row_defects` in row `row`. Returns whether the row is dropped because of them.
    pub fn add_row(&mut self, row: u32, row_defects: &[Defect]) -> bool {
        self.defective += usize::from(!row_defects.is_empty());
        let is_dropped = row_defects.iter().any(|&(_, dropped, _)| dropped);
        self.dropped += usize::from(is_dropped);
        for &(what, dropped, why) in row_defects {
            let place = self.kinds.iter().position(|kind| kind.what == what).unwrap_or_else(|| {
                let (what, why) = (what.to_owned(), why.to_owned());
                self.kinds.push(DefectCount { what, dropped, why, rows: 0, first: Vec::new() });
                self.kinds.len() - 1
            });
            let kind = &mut self.kinds[place];
            kind.rows += 1;
            if kind.first.len() < MAX_LISTED_ROWS {
                kind.first.push(row);
            }
        }
        is_dropped
    }

    /// Returns whether no row with a defect has been counted.
    pub fn is_empty(&self) -> bool {
        self.defective == 0
    }

    /// Returns the names of the defects found with their numbers of rows, for messages: "zero quaternion in 3".
    pub fn describe_kinds(&self) -> String {
        let kinds: Vec<String> = self.kinds.iter().map(|kind| format!("{} in {}", kind.what, kind.rows)).collect();
        kinds.join(", ")
    }

    /// Returns the notes for the user: one per kind of defect, and one with the total counts of rows that were dropped
    /// or repaired. The note with the totals comes first if more than 1% of the rows were dropped, otherwise last.
    pub fn notes(&self) -> Vec<String> {
        if self.is_empty() {
            return Vec::new();
        }
        let percent = |rows: usize| 100.0 * rows as f64 / self.rows.max(1) as f64;
        let note = |kind: &DefectCount| {
            format!(
                "{} of {} rows ({:.2}%) {}: {}; {} (rows {})",
                kind.rows,
                self.rows,
                percent(kind.rows),
                if kind.dropped { "left out" } else { "repaired" },
                kind.what,
                kind.why,
                first_of(&kind.first, kind.rows),
            )
        };
        let mut notes: Vec<String> = self.kinds.iter().map(note).collect();
        let total = format!(
            "{} of {} rows have defects: {} ({:.2}%) left out, {} repaired",
            self.defective,
            self.rows,
            self.dropped,
            percent(self.dropped),
            self.defective - self.dropped
        );
        let is_totals_first = self.dropped as f64 > TOTALS_FIRST_FRACTION * self.rows as f64;
        notes.insert(if is_totals_first { 0 } else { notes.len() }, total);
        notes
    }
}

/// Returns the first five row indices or ids as a list for messages, such as `3, 7, 9`, followed by dots if there are
/// more. `count` is the number of all indices; `first` holds at least the first five of them, or all if there are
/// fewer.
pub fn first_of(first: &[u32], count: usize) -> String {
    let listed: Vec<String> = first.iter().take(MAX_LISTED_ROWS).map(u32::to_string).collect();
    listed.join(", ") + if count > listed.len() { ", ..." } else { "" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_counts_once_per_defect_and_once_in_the_total() {
        let mut defects = Defects::new(1000);
        let (nan, wide) = (("NaN", true, "not drawn"), ("wide", false, "always visible"));
        defects.add_row(3, &[nan, wide]);
        defects.add_row(4, &[]);
        (10..20).for_each(|row| assert!(!defects.add_row(row, &[wide])));
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
        (20..40).for_each(|row| assert!(defects.add_row(row, &[nan])));
        assert!(defects.notes()[0].starts_with("31 of 1000 rows have defects: 21 (2.10%) left out"));
        assert_eq!(Defects::new(7).notes(), [""; 0]);
    }
}
