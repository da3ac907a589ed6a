//! Tests whether Gaussians at equal indices in two frames are the same Gaussian. Such frames need not be linked by
//! tracking.

use super::appearance::ComparedAppearance;
use crate::model::Gaussians;

/// Maximum number of indices at which the Gaussians of two frames are compared; they are evenly spread over all
/// indices.
const MAX_COMPARED: usize = 4096;
/// Threshold of the test whether two frames have the same order of Gaussians. The median difference between Gaussians
/// at the same index may be at most this fraction of the median difference between unrelated Gaussians.
const MAX_PART_OF_UNRELATED: f64 = 0.5;
/// Number of Gaussians from which on two frames are tested for the same order of Gaussians. Without a test, frames with
/// fewer Gaussians count as being in the same order.
const MIN_GAUSSIANS: usize = 16;
/// Difference up to which two Gaussians count as equal (difference 0), because it may come from rounding by the program
/// that wrote the frames. Applies to distances, as multiples of a Gaussian's size, and to differences in appearance
/// (`ComparedAppearance::difference`).
const NEGLIGIBLE: f64 = 1e-3;

/// Median differences between the Gaussians of two frames: once between the Gaussians at the same index, and once
/// between unrelated Gaussians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrderDifference {
    /// Median distance between the positions of Gaussians at the same index, in units of the smaller Gaussian's size.
    pub position_difference: f64,
    /// Median distance between the positions of unrelated Gaussians (index i of the first frame and i + N/2 of the
    /// second), in units of the smaller Gaussian's size.
    pub unrelated_position_difference: f64,
    /// Median difference in appearance between Gaussians at the same index: the sum of (difference / unit)² over size,
    /// shape, opacity and base color. The units are those in which the costs of links are measured.
    pub appearance_difference: f64,
    /// Median difference in appearance, in the unit of `appearance_difference`, between unrelated Gaussians (index i of
    /// the first frame and i + N/2 of the second).
    pub unrelated_appearance_difference: f64,
    /// Whether equal indices in the two frames denote the same Gaussian. This is true in two cases:
    ///
    /// - There are fewer than 16 Gaussians.
    /// - Both differences at the same index, `position_difference` and `appearance_difference`, are small: each is at
    ///   most half of the corresponding difference between unrelated Gaussians, or at most 1e-3 (rounding).
    pub is_common: bool,
}

/// Tests whether two frames of N Gaussians each have the same order of Gaussians. Compares the Gaussians of `before`
/// and `after` at the same index, at up to 4096 indices. For comparison, also measures the differences between
/// Gaussians whose indices are N/2 apart, which are unrelated.
///
/// The order always counts as the same if there are fewer than 16 Gaussians, or if Gaussians at the same index differ
/// by no more than rounding.
pub fn compare_order(before: &Gaussians, after: &Gaussians) -> OrderDifference {
    let (before, after) = (ComparedAppearance::all_from_state(before), ComparedAppearance::all_from_state(after));
    let count = before.len().min(after.len());
    let indices: Vec<usize> = (0..count).step_by(count.div_ceil(MAX_COMPARED).max(1)).collect();
    let differences = |offset: usize| {
        let pairs = || indices.iter().map(|&i| (&before[i], &after[(i + offset) % count]));
        (median(pairs().map(|(a, b)| distance(a, b))), median(pairs().map(|(a, b)| f64::from(a.difference(b)))))
    };
    let ((moved, unlike), (apart, strangers)) = (differences(0), differences(count / 2));
    let is_less = |own: f64, unrelated: f64| own <= NEGLIGIBLE || own <= MAX_PART_OF_UNRELATED * unrelated;
    let holds = count < MIN_GAUSSIANS || (is_less(moved, apart) && is_less(unlike, strangers));
    OrderDifference {
        position_difference: moved,
        unrelated_position_difference: apart,
        appearance_difference: unlike,
        unrelated_appearance_difference: strangers,
        is_common: holds,
    }
}

/// Returns the distance between the positions of `a` and `b`, divided by the smaller of their sizes.
fn distance(a: &ComparedAppearance, b: &ComparedAppearance) -> f64 {
    let squared: f64 = (0..3).map(|c| f64::from(a.position[c] - b.position[c]).powi(2)).sum();
    squared.sqrt() / f64::from(a.size.min(b.size))
}

/// Returns the median of `values`: the upper one of the two middle values if their number is even, 0 if there are none.
/// NaN counts as the largest value.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.map(|value| if value.is_nan() { f64::INFINITY } else { value }).collect();
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}
