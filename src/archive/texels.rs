//! Determines which texels of a feature plane are read by some Gaussian, and with what total weight.
//!
//! Input: canonical positions as they are stored, the box of space that the plane covers, its axes and its size.
//! Output: a class for each texel. Writer and reader of an archive both compute the classes, so they are not stored.
//! Sums and products of f32 in a fixed order give the same classes on every machine.

use super::quantized_tensor::UNREAD;
use crate::deform::{Box3, tap};
use crate::model::AttributeValues;

/// Exponent of class 0: floor of log2 of the squared weights with which Gaussians read a texel, summed. Smaller sums
/// also belong to class 0.
const MIN_EXPONENT: i32 = -8;
/// Number of classes of texels; each class is an octave of the summed squared read weights.
pub(super) const CLASSES: usize = 16;

/// Returns the summed squared read weight of a class as an exponent of 2; 0 for a texel that is read once with weight
/// 1.
pub(super) fn octaves(class: u8) -> i32 {
    i32::from(class) + MIN_EXPONENT
}

/// Returns the class of a texel, which selects its quantization grid. `squared_weight` is the sum, over the Gaussians
/// that read the texel, of the squared interpolation weight.
fn class(squared_weight: f32) -> u8 {
    if squared_weight <= 0.0 {
        return UNREAD;
    }
    let exponent = (squared_weight.to_bits() >> 23) as i32 - 127;
    (exponent - MIN_EXPONENT).clamp(0, CLASSES as i32 - 1) as u8
}

/// Returns the class (which selects the quantization grid) of each texel, `[size_b, size_a]`, of a feature plane over
/// two spatial axes (a, b).
pub(super) fn plane_classes(position: &AttributeValues, space: &Box3, axes: [usize; 2], size: [usize; 2]) -> Vec<u8> {
    let mut squared_weights = vec![0.0f32; size[0] * size[1]];
    for i in 0..position.len() {
        let u = space.normalized(position.row(i));
        let (a, b) = (tap(u[axes[0]], size[0]), tap(u[axes[1]], size[1]));
        for (row, in_b) in [(b.low, 1.0 - b.fraction), (b.high, b.fraction)] {
            for (column, in_a) in [(a.low, 1.0 - a.fraction), (a.high, a.fraction)] {
                let weight = in_a * in_b;
                squared_weights[row as usize * size[0] + column as usize] += weight * weight;
            }
        }
    }
    squared_weights.into_iter().map(class).collect()
}

/// Returns the class (which selects the quantization grid) of each column, `[size]`, of a feature plane over one
/// spatial axis and time.
pub(super) fn time_plane_classes(position: &AttributeValues, space: &Box3, axis: usize, size: usize) -> Vec<u8> {
    let mut squared_weights = vec![0.0f32; size];
    for i in 0..position.len() {
        let a = tap(space.normalized(position.row(i))[axis], size);
        for (column, weight) in [(a.low, 1.0 - a.fraction), (a.high, a.fraction)] {
            squared_weights[column as usize] += weight * weight;
        }
    }
    squared_weights.into_iter().map(class).collect()
}

/// Returns the rows of a plane over time that are read at times from `first` to `last`; the plane has `size` rows.
pub(super) fn time_rows(first: f32, last: f32, size: usize) -> std::ops::Range<usize> {
    let (first, last) = (tap(first, size), tap(last, size));
    let end = if last.fraction > 0.0 { last.high } else { last.low };
    first.low as usize..end as usize + 1
}
