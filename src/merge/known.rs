//! What is known of how pairs move: a pair is measured once, however often passes and trials ask.
//!
//! Memory: [`KNOWN_BYTES`] per pair.

/// Memory of one pair whose likeness is known.
pub const KNOWN_BYTES: usize = size_of::<Likeness>();

/// Two rows, the smaller first, and how alike they move ([`super::motion::MotionGate::likeness`]).
pub type Likeness = (u32, u32, f64);

/// The likeness of pairs of rows, by pair.
#[derive(Debug, Default)]
pub struct KnownPairs(Vec<Likeness>);

impl KnownPairs {
    /// Those of `pairs` that are not known yet, the smaller row first, increasing, none twice.
    pub fn missing(&self, pairs: impl ExactSizeIterator<Item = (u32, u32)>) -> Vec<(u32, u32)> {
        let mut missing = Vec::with_capacity(pairs.len());
        missing.extend(pairs.map(|(a, b)| (a.min(b), a.max(b))).filter(|&pair| self.place(pair).is_err()));
        missing.sort_unstable();
        missing.dedup();
        missing
    }

    /// Adds pairs that were missing, in any order.
    pub fn add(&mut self, mut found: Vec<Likeness>) {
        if self.0.is_empty() {
            self.0 = found;
        } else {
            self.0.reserve_exact(found.len());
            self.0.append(&mut found);
        }
        self.0.sort_unstable_by_key(|&(a, b, _)| (a, b));
    }

    /// How alike a pair moves, in either order; NaN if that is not known.
    pub fn likeness(&self, (a, b): (u32, u32)) -> f64 {
        self.place((a.min(b), a.max(b))).map_or(f64::NAN, |place| self.0[place].2)
    }

    fn place(&self, pair: (u32, u32)) -> Result<usize, usize> {
        self.0.binary_search_by_key(&pair, |&(a, b, _)| (a, b))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pair_is_missing_once_and_known_in_either_order() {
        let mut known = KnownPairs::default();
        let asked = [(7, 2), (2, 7), (1, 2), (7, 2)];
        assert_eq!(known.missing(asked.into_iter()), [(1, 2), (2, 7)]);
        known.add(vec![(2, 7, 0.5), (1, 2, f64::NAN)]);
        assert_eq!(known.missing([(7, 2), (9, 1)].into_iter()), [(1, 9)]);
        known.add(vec![(1, 9, -1.0)]);
        assert_eq!([(7, 2), (2, 7), (9, 1)].map(|pair| known.likeness(pair)), [0.5, 0.5, -1.0]);
        assert!(known.likeness((2, 1)).is_nan() && known.likeness((4, 5)).is_nan());
        assert!(known.missing(asked.into_iter()).is_empty());
    }

    #[test]
    fn a_known_pair_takes_no_more_than_is_stated() {
        let mut known = KnownPairs::default();
        known.add((0..1000).map(|i| (i, i + 1, 0.0)).collect());
        known.add((0..777).map(|i| (i, i + 2, 0.0)).collect());
        assert!(known.0.capacity() * KNOWN_BYTES <= 1777 * 16, "{}", known.0.capacity());
    }
}
