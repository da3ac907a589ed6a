//! Self-check cases for percentiles, by which statistics are normalized and the scene extent is measured.

use super::case::LargestError;
use super::generated::clouds::Random;
use crate::error::Result;
use crate::model::AttributeValues;
use crate::model::RobustBox;
use crate::statistics::score::FloatSketch;

/// Compares the percentiles that the program finds by a histogram with the values of the same rank in the sorted list
/// of all values. They must be equal to the bit.
pub(super) fn percentiles(worst: &mut LargestError) -> Result<()> {
    for count in [1, 2, 50, 99, 100, 101, 1000, 20_011] {
        let values = values(count);
        let sketch = FloatSketch::from_values(values.iter().copied());
        for p in [0, 1, 50, 99, 100] {
            let got = sketch.percentile(p as f64, values.iter().copied());
            worst.same(&got, &Some(sorted_percentile(&values, p)));
        }
    }
    Ok(())
}

/// Compares the percentiles 1, 50 and 99 of the positions along each axis, which form a [`RobustBox`], with the values
/// of the same rank in the sorted list of all positions. They must be equal to the bit.
pub(super) fn robust_box(worst: &mut LargestError) -> Result<()> {
    for count in [1, 100, 1003] {
        let axes = [7, 8, 9].map(|seed| (0..count).map(|i| values(count)[(i * seed) % count] as f32).collect());
        let axes: [Vec<f32>; 3] = axes;
        let found = RobustBox::from_positions(&AttributeValues::from_planes(3, axes.concat()));
        for (axis, values) in axes.iter().enumerate() {
            let values: Vec<f64> = values.iter().map(|&x| x.into()).collect();
            for (got, p) in [(found.low, 1), (found.median, 50), (found.high, 99)] {
                worst.same(&got[axis], &sorted_percentile(&values, p));
            }
        }
    }
    Ok(())
}

/// Returns the `p`-th percentile of the n numbers in `values`: the number at rank ⌈p·n/100⌉, but at least rank 1, after
/// sorting.
fn sorted_percentile(values: &[f64], p: usize) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[(sorted.len() * p).div_ceil(100).max(1) - 1]
}

/// Returns `count` random numbers of both signs whose magnitudes spread over 46 powers of ten, including subnormal
/// numbers of f32.
fn values(count: usize) -> Vec<f64> {
    let mut random = Random(count as u64);
    let value = |_| {
        let sign = if random.next_f32() < 0.2 { -1.0 } else { 1.0 };
        sign * f64::from(random.next_in(0.5, 1.0)) * 10f64.powi(random.next_in(-42.0, 4.0) as i32)
    };
    (0..count).map(value).collect()
}
