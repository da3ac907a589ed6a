//! Order of Gaussians: a fixed hash of their ids, and ranks from an order. The hash orders Gaussians with equal scores,
//! so that pruning favors neither the first nor the last Gaussians of a file. It also serves as a source of
//! pseudo-random numbers.

/// Returns a hash of `id`: output number `id` (from 0) of the generator SplitMix64 (Steele, Lea and Flood 2014) with
/// seed 0.
///
/// The hash is a bijection on u64, so two ids never tie. It is the same on every machine and in every version.
pub fn hash_id(id: u64) -> u64 {
    let mut z = id.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Returns the rank of every id: its index in `order`, which contains each id from 0 to its length − 1 once.
pub fn inverse_permutation(order: &[u32]) -> Vec<u32> {
    let mut ranks = vec![0; order.len()];
    for (&id, rank) in order.iter().zip(0..) {
        ranks[id as usize] = rank;
    }
    ranks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_equals_splitmix64_seeded_with_zero() {
        // First outputs of the published generator from seed 0.
        let published = [0xe220_a839_7b1d_cdaf, 0x6e78_9e6a_a1b9_65f4, 0x06c4_5d18_8009_454f];
        assert_eq!([0, 1, 2].map(hash_id), published);
    }

    #[test]
    fn ranks_are_the_places_in_the_order() {
        assert_eq!(inverse_permutation(&[2, 0, 3, 1]), [1, 3, 0, 2]);
    }
}
