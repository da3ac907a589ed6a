//! Scalar quantization for `.sog` files: a codebook is a list of 256 numbers, and a value is stored as the byte that is
//! the index of the nearest number.

/// Number of entries of a codebook (list of the numbers that stored bytes stand for).
pub const ENTRIES: usize = 256;
/// Number of bins of equal width into which [`Codebook::fit`] divides the range of the input values, to find out how
/// dense they are.
const BINS: usize = 1 << 14;

/// Codebook: list of at most 256 numbers (entries). A stored byte is an index in this list.
#[derive(Debug, Clone, PartialEq)]
pub struct Codebook {
    entries: Vec<f32>,
}

impl Codebook {
    /// Chooses the entries of a codebook for `values`.
    ///
    /// - If there are at most 256 different values, they are the entries.
    /// - If there are more, half of the entries are spread evenly over the range of the values. The other half are
    ///   denser where values are denser: their density is proportional to the cube root of the density of the values,
    ///   which is best for the mean squared error (P. F. Panter and W. Dite, "Quantization Distortion in Pulse-Count
    ///   Modulation with Nonuniform Spacing of Levels", 1951).
    ///
    /// The distance of any value from the nearest entry is at most 1/200 of the range. Values that are not finite are
    /// ignored; without finite values, all entries are 0.
    pub fn fit<I: Iterator<Item = f32>>(values: impl Fn() -> I) -> Codebook {
        let finite = || values().filter(|value| value.is_finite()).map(|value| value + 0.0);
        if let Some(entries) = few_different(finite()) {
            return Codebook { entries };
        }
        let (min, max) = finite().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        let per_unit = BINS as f64 / (f64::from(max) - f64::from(min));
        let bin = |value: f32| (((f64::from(value) - f64::from(min)) * per_unit) as usize).min(BINS - 1);
        let mut bins = vec![Bin { count: 0, min: f32::INFINITY, max: f32::NEG_INFINITY }; BINS];
        for value in finite() {
            let bin = &mut bins[bin(value)];
            (bin.count, bin.min, bin.max) = (bin.count + 1, bin.min.min(value), bin.max.max(value));
        }
        let total: f64 = bins.iter().map(|bin| (bin.count as f64).cbrt()).sum();
        // Two numbers grow from 0 to 1 over the range: the position of a bin, and the weight of all values below it.
        // Their mean determines the entry.
        let (mut cells, mut below) = (vec![None; ENTRIES], 0.0);
        for (at, bin) in bins.iter().enumerate().filter(|(_, bin)| bin.count > 0) {
            let weight = (bin.count as f64).cbrt() / total;
            let place = (at as f64 + 0.5) / BINS as f64;
            let share = 0.5 * place + 0.5 * (below + 0.5 * weight);
            below += weight;
            let cell = ((share * ENTRIES as f64) as usize).min(ENTRIES - 1);
            let (min, _) = cells[cell].unwrap_or((bin.min, bin.max));
            cells[cell] = Some((min, bin.max));
        }
        let middle = |(min, max): (f32, f32)| (0.5 * (f64::from(min) + f64::from(max))) as f32;
        Codebook { entries: padded(cells.into_iter().flatten().map(middle).collect()) }
    }

    /// Creates a codebook from the entries of a file, which need not be sorted.
    pub fn from_entries(entries: Vec<f32>) -> Codebook {
        Codebook { entries }
    }

    /// Returns the entries. If [`Codebook::fit`] chose them, there are 256 in increasing order.
    pub fn entries(&self) -> &[f32] {
        &self.entries
    }

    /// Returns the index of the entry nearest to `value`. If two entries are equally near, returns the lower index. The
    /// entries must be sorted.
    pub fn nearest(&self, value: f32) -> u8 {
        let after = self.entries.partition_point(|&entry| entry < value).min(self.entries.len() - 1);
        let distance = |at: usize| (f64::from(self.entries[at]) - f64::from(value)).abs();
        let nearest = if after > 0 && distance(after - 1) <= distance(after) { after - 1 } else { after };
        nearest as u8
    }

    /// Returns the number that `code` stands for; `None` if the codebook has no such entry.
    pub fn decode(&self, code: u8) -> Option<f32> {
        self.entries.get(usize::from(code)).copied()
    }
}

/// One of the bins of equal width into which [`Codebook::fit`] divides the range of the input values. Holds the number
/// of values in the bin, and the smallest and the largest of them.
#[derive(Debug, Clone, Copy)]
struct Bin {
    count: u64,
    min: f32,
    max: f32,
}

/// Returns the different numbers among `values` in increasing order, with the last one repeated so that there are 256.
/// Returns `None` if there are more than 256 different numbers.
fn few_different(values: impl Iterator<Item = f32>) -> Option<Vec<f32>> {
    let mut different: Vec<f32> = Vec::new();
    for value in values {
        if let Err(at) = different.binary_search_by(|entry| entry.total_cmp(&value)) {
            if different.len() == ENTRIES {
                return None;
            }
            different.insert(at, value);
        }
    }
    Some(padded(different))
}

/// Returns `entries` extended to 256 numbers: the last entry is repeated, and without entries all numbers are 0.
fn padded(mut entries: Vec<f32>) -> Vec<f32> {
    let last = entries.last().copied().unwrap_or(0.0);
    entries.resize(ENTRIES, last);
    entries
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn few_different_values_are_stored_exactly() {
        let values = [3.5f32, -1.0, 3.5, 0.25, -0.0, 0.0];
        let book = Codebook::fit(|| values.into_iter());
        assert_eq!(&book.entries()[..4], [-1.0, 0.0, 0.25, 3.5]);
        assert_eq!((book.entries().len(), book.entries()[255]), (256, 3.5));
        assert!(values.iter().all(|&value| book.decode(book.nearest(value)) == Some(value)));
        assert_eq!(Codebook::fit(|| [f32::NAN].into_iter()).entries(), [0.0; 256]);
    }

    proptest! {
        #[test]
        fn no_value_is_far_from_its_entry(
            dense in proptest::collection::vec(-1.0f32..1.0, 0..2000),
            wide in proptest::collection::vec(-40.0f32..90.0, 0..300),
        ) {
            let values: Vec<f32> = dense.into_iter().chain(wide).collect();
            let book = Codebook::fit(|| values.iter().copied());
            prop_assert!(book.entries().is_sorted() && book.entries().len() == 256);
            let (min, max) = values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &x| (a.min(x), b.max(x)));
            for &value in &values {
                let found = book.decode(book.nearest(value)).unwrap();
                prop_assert!((found - value).abs() <= (max - min) / 200.0, "{value}: {found}");
                let best = book.entries().iter().map(|entry| (entry - value).abs()).fold(f32::INFINITY, f32::min);
                prop_assert!((found - value).abs() <= best, "{value}: {found} is not the nearest");
            }
        }
    }
}
