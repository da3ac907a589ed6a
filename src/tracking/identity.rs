//! Test whether the order of the Gaussians in frames identifies them.

use super::appearance::ComparedAppearance;
use crate::model::Gaussians;

/// Maximum number of Gaussians of a pair of frames that are compared.
const MAX_COMPARED: usize = 4096;
/// Largest difference of Gaussians at the same index, as a fraction of that of unrelated Gaussians, at which the order
/// counts as kept.
const MAX_PART_OF_UNRELATED: f64 = 0.5;
/// Minimum number of Gaussians for the test. With fewer, the order counts as kept.
const MIN_GAUSSIANS: usize = 16;
/// Difference that the rounding of exporters may cause (in sizes, and in units of cost). Smaller differences count as
/// 0.
const NEGLIGIBLE: f64 = 1e-3;

/// Median differences between Gaussians at the same index of two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrderDifference {
    /// Distance between Gaussians at the same index, in sizes.
    pub moved: f64,
    /// Distance between unrelated Gaussians, in sizes: index i of the first frame and index i + N/2 of the second.
    pub apart: f64,
    /// Difference in size, shape, opacity and base color between Gaussians at the same index: A of the [module](super).
    pub unlike: f64,
    /// Difference A between unrelated Gaussians.
    pub strangers: f64,
    /// Whether the same index in both frames means the same Gaussian: distance and difference are both at most half of
    /// those of unrelated Gaussians.
    pub holds: bool,
}

/// Compares two frames of equally many Gaussians, index by index, at up to 4096 indices. Returns that the order holds
/// if there are fewer than 16 Gaussians, or if Gaussians at the same index differ by no more than rounding does.
pub fn identity(before: &Gaussians, after: &Gaussians) -> OrderDifference {
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
    OrderDifference { moved, apart, unlike, strangers, holds }
}

/// Returns the distance between two Gaussians in units of the smaller size.
fn distance(a: &ComparedAppearance, b: &ComparedAppearance) -> f64 {
    let squared: f64 = (0..3).map(|c| f64::from(a.position[c] - b.position[c]).powi(2)).sum();
    squared.sqrt() / f64::from(a.size.min(b.size))
}

/// Returns the median, the upper one of an even number of values; 0 if there are none. NaN counts as the largest value.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.map(|value| if value.is_nan() { f64::INFINITY } else { value }).collect();
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}
