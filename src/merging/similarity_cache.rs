//! Cache of the motion similarities of pairs of Gaussians. A pair is measured only once, although several merging
//! passes and trial sizes may request it.
//!
//! Memory: [`BYTES_PER_CACHED_PAIR`] per pair.

/// Bytes of memory for one pair of Gaussians whose similarity is known.
pub const BYTES_PER_CACHED_PAIR: usize = size_of::<PairSimilarity>();

/// Pair of Gaussians, as two row indices with the smaller first, and its motion similarity
/// ([`super::motion::MotionThresholds::similarity`]).
pub type PairSimilarity = (u32, u32, f64);

/// Motion similarities of pairs of Gaussians, sorted by the row indices of the pair.
#[derive(Debug, Default)]
pub struct SimilarityCache(Vec<PairSimilarity>);

impl SimilarityCache {
    /// Returns the pairs in `pairs` whose similarity is not in the cache, sorted and without duplicates. Each returned
    /// pair has its smaller row first.
    pub fn missing(&self, pairs: impl ExactSizeIterator<Item = (u32, u32)>) -> Vec<(u32, u32)> {
        let mut missing = Vec::with_capacity(pairs.len());
        missing.extend(pairs.map(|(a, b)| (a.min(b), a.max(b))).filter(|&pair| self.position(pair).is_err()));
        missing.sort_unstable();
        missing.dedup();
        missing
    }

    /// Creates the cache from measured pairs, in any order and without duplicates.
    pub fn new(mut pairs: Vec<PairSimilarity>) -> Self {
        pairs.sort_unstable_by_key(|&(a, b, _)| (a, b));
        SimilarityCache(pairs)
    }

    /// Takes over the measured pairs `other`, none of which may be in the cache yet. If the cache already holds pairs
    /// and would then hold more than `max_pairs`, takes over nothing.
    pub fn merge_from(&mut self, mut other: SimilarityCache, max_pairs: usize) {
        if self.0.is_empty() {
            *self = other;
        } else if self.0.len() + other.0.len() <= max_pairs {
            self.0.reserve_exact(other.0.len());
            self.0.append(&mut other.0);
            self.0.sort_unstable_by_key(|&(a, b, _)| (a, b));
        }
    }

    /// Returns the motion similarity of the pair (`a`, `b`), in either order; `None` if the pair is not in the cache.
    pub fn similarity(&self, (a, b): (u32, u32)) -> Option<f64> {
        self.position((a.min(b), a.max(b))).ok().map(|position| self.0[position].2)
    }

    fn position(&self, pair: (u32, u32)) -> Result<usize, usize> {
        self.0.binary_search_by_key(&pair, |&(a, b, _)| (a, b))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pair_is_missing_once_and_known_in_either_order() {
        let mut known = SimilarityCache::default();
        let requested = [(7, 2), (2, 7), (1, 2), (7, 2)];
        assert_eq!(known.missing(requested.into_iter()), [(1, 2), (2, 7)]);
        known.merge_from(SimilarityCache::new(vec![(2, 7, 0.5), (1, 2, f64::NAN)]), 3);
        assert_eq!(known.missing([(7, 2), (9, 1)].into_iter()), [(1, 9)]);
        known.merge_from(SimilarityCache::new(vec![(1, 9, -1.0)]), 3);
        assert_eq!([(7, 2), (2, 7), (9, 1)].map(|pair| known.similarity(pair)), [0.5, 0.5, -1.0].map(Some));
        assert!(known.similarity((2, 1)).unwrap().is_nan() && known.similarity((4, 5)).is_none());
        assert!(known.missing(requested.into_iter()).is_empty());
        known.merge_from(SimilarityCache::new(vec![(4, 5, 1.0)]), 3);
        assert!(known.similarity((4, 5)).is_none(), "a fourth pair is known");
    }

    #[test]
    fn known_pairs_stay_within_the_stated_memory() {
        let mut known = SimilarityCache::default();
        known.merge_from(SimilarityCache::new((0..1000).map(|i| (i, i + 1, 0.0)).collect()), 1777);
        known.merge_from(SimilarityCache::new((0..777).map(|i| (i, i + 2, 0.0)).collect()), 1777);
        assert!(known.0.capacity() * BYTES_PER_CACHED_PAIR <= 1777 * 16, "{}", known.0.capacity());
    }
}
