//! Choice of the Gaussians that a prune step removes.

use crate::merging::tree::{NearestPoints, Tree, TreePoint};
use crate::model::AttributeValues;

/// Number of candidates for removal, as a multiple of the number of Gaussians to remove.
const CANDIDATE_RATIO: f64 = 1.6;

/// Returns the indices of the `count` Gaussians that a prune step keeps, in increasing order. `errors` are the removal
/// errors of all Gaussians (the squared error of renders without the Gaussian), `fixed` marks Gaussians that must stay
/// if possible, and `positions` are the centers of the Gaussians in scene units.
/// Gaussians are removed in order of increasing error; of equal errors, the higher index goes first. A removed Gaussian
/// protects its nearest neighbor: each error assumes that all other Gaussians remain, so two neighbors that cover for
/// each other would otherwise both be removed.
///
/// Only the Gaussians with the smallest errors are candidates, [`CANDIDATE_RATIO`] times as many as have to be removed.
/// If too few of the candidates are unprotected, more Gaussians are removed in the same order without regard to
/// protection.
pub(super) fn survivors(errors: &[u64], count: usize, fixed: &[bool], positions: &AttributeValues) -> Vec<u32> {
    let removed_count = errors.len().saturating_sub(count);
    let mut ranked: Vec<u32> = (0..errors.len() as u32).collect();
    ranked.sort_by_key(|&i| (fixed[i as usize], errors[i as usize], std::cmp::Reverse(i)));
    let candidates = &ranked[..((CANDIDATE_RATIO * removed_count as f64) as usize).min(ranked.len())];
    let point = |index: u32| TreePoint { position: positions.row(index as usize), index };
    let mut points: Vec<TreePoint> = (0..errors.len() as u32).map(point).collect();
    points.retain(|point| point.position.iter().all(|x| x.is_finite()));
    let (tree, mut nearest) = (Tree::new(&mut points), NearestPoints::default());
    let mut is_protected = vec![false; errors.len()];
    let mut is_removed = vec![false; errors.len()];
    let mut left_to_remove = removed_count;
    for &i in candidates {
        if left_to_remove == 0 {
            break;
        }
        if is_protected[i as usize] || fixed[i as usize] {
            continue;
        }
        is_removed[i as usize] = true;
        left_to_remove -= 1;
        nearest.start_query(i, positions.row(i as usize), 1, f64::INFINITY);
        tree.search(&points, &mut nearest);
        if let Some(&(_, neighbor)) = nearest.sort_by_distance().first() {
            is_protected[neighbor as usize] = true;
        }
    }
    for &i in &ranked {
        if left_to_remove > 0 && !is_removed[i as usize] {
            is_removed[i as usize] = true;
            left_to_remove -= 1;
        }
    }
    (0..errors.len() as u32).filter(|&i| !is_removed[i as usize]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns positions on the x axis; their x coordinates are `along`.
    fn line(along: &[f32]) -> AttributeValues {
        AttributeValues::from_planes(3, [along, &vec![0.0; 2 * along.len()]].concat())
    }

    #[test]
    fn nearest_neighbor_of_a_removed_gaussian_stays() {
        // Gaussians 0 and 1 are close together and have the smallest errors; so are 2 and 3.
        let positions = line(&[0.0, 0.1, 5.0, 9.0, 20.0, 40.0, 60.0, 80.0]);
        let errors = [1, 2, 3, 4, 50, 60, 70, 80];
        assert_eq!(survivors(&errors, 6, &[false; 8], &positions), [1, 3, 4, 5, 6, 7]);
        // Of the four candidates for three removals, 0 protects 1, and 2 protects 3. The lower of these goes too.
        assert_eq!(survivors(&errors, 5, &[false; 8], &positions), [3, 4, 5, 6, 7]);
    }

    #[test]
    fn count_is_exact_and_fixed_gaussians_stay() {
        let positions = line(&(0..100).map(|i| (i as f32 * 0.618).fract()).collect::<Vec<_>>());
        let errors: Vec<u64> = (0..100).map(|i| i * 37 % 101).collect();
        let fixed: Vec<bool> = (0..100).map(|i| i % 10 == 3).collect();
        for count in 0..=100 {
            let kept = survivors(&errors, count, &fixed, &positions);
            assert_eq!(kept.len(), count);
            let fixed_kept = kept.iter().filter(|&&i| fixed[i as usize]).count();
            assert_eq!(fixed_kept, count.min(10), "of {count}");
        }
    }

    #[test]
    fn positions_that_are_not_finite_are_accepted() {
        let positions = line(&[f32::NAN, f32::INFINITY, 0.0, 0.0]);
        assert_eq!(survivors(&[1, 2, 3, 4], 2, &[false; 4], &positions), [2, 3]);
    }
}
