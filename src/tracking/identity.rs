//! Whether the order of Gaussians in frames tells which is which.

use super::look::ComparedAppearance;
use crate::model::Gaussians;

/// Gaussians of a pair of frames that are compared.
const COMPARED: usize = 4096;
/// The order tells nothing where what it pairs differs by more than this part of what strangers differ by.
const MOST_OF_STRANGERS: f64 = 0.5;
/// Of fewer Gaussians nobody can tell: their order is believed.
const FEWEST: usize = 16;
/// Differences within what exporters round, which say nothing: sizes, and units of cost.
const NOTHING: f64 = 1e-3;

/// What pairs of one order differ by, in the median.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrderDifference {
    /// Distance between both, in sizes.
    pub moved: f64,
    /// The same of strangers: each with the one that stands half of all further.
    pub apart: f64,
    /// Difference in size, shape, opacity and base color: A of the [module](super).
    pub unlike: f64,
    /// The same of strangers.
    pub strangers: f64,
    /// Whether the same place in both frames means the same Gaussian: neither differs by more than half of what strangers
    /// do.
    pub holds: bool,
}

/// Compares two frames of equally many Gaussians, place by place, at up to 4096 places. Fewer than 16 Gaussians hold; so do
/// frames in which strangers differ as little as anything does.
pub fn identity(before: &Gaussians, after: &Gaussians) -> OrderDifference {
    let (before, after) = (ComparedAppearance::of_all(before), ComparedAppearance::of_all(after));
    let count = before.len().min(after.len());
    let places: Vec<usize> = (0..count).step_by(count.div_ceil(COMPARED).max(1)).collect();
    let differences = |offset: usize| {
        let pairs = || places.iter().map(|&i| (&before[i], &after[(i + offset) % count]));
        (median(pairs().map(|(a, b)| distance(a, b))), median(pairs().map(|(a, b)| f64::from(a.unlike(b)))))
    };
    let ((moved, unlike), (apart, strangers)) = (differences(0), differences(count / 2));
    let is_less = |own: f64, others: f64| own <= NOTHING || own <= MOST_OF_STRANGERS * others;
    let holds = count < FEWEST || (is_less(moved, apart) && is_less(unlike, strangers));
    OrderDifference { moved, apart, unlike, strangers, holds }
}

/// In sizes of the smaller one.
fn distance(a: &ComparedAppearance, b: &ComparedAppearance) -> f64 {
    let squared: f64 = (0..3).map(|c| f64::from(a.position[c] - b.position[c]).powi(2)).sum();
    squared.sqrt() / f64::from(a.size.min(b.size))
}

/// Of an even number the upper one; 0 of none. What is not a number counts as the largest.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.map(|value| if value.is_nan() { f64::INFINITY } else { value }).collect();
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}
