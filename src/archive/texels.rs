//! Determines which texels of a feature plane are read by some Gaussian, and with what total weight.
//!
//! Input: canonical positions as they are stored, the box of space that the plane covers, its axes and its size.
//! Output: a class for each texel. Writer and reader of an archive both compute the classes, so classes are not stored.
//! Sums and products of f32 in a fixed order give the same classes on every machine.

use super::quantized_tensor::UNREAD;
use crate::deform::{Box3, texel_pair};
use crate::model::AttributeValues;

/// Octave of class 0, the lowest class of texels (grid elements of a feature plane). Texels of lower octaves belong to
/// class 0 too. The octave of a texel is ⌊log2 w⌋, where w is the sum of the squared interpolation weights with which
/// Gaussians read the texel.
const MIN_EXPONENT: i32 = -8;
/// Number of classes of texels. A class is a number that selects a texel's quantization grid. Texels belong to the same
/// class if their squared interpolation weights, summed over the Gaussians that read them, lie in the same octave.
pub(super) const CLASSES: usize = 16;

/// Returns the octave of the texels in the class `class`. The octave is ⌊log2 w⌋, where w is the sum of the squared
/// interpolation weights with which Gaussians read the texel. A texel that one Gaussian reads with weight 1 has octave
/// 0.
pub(super) fn octaves(class: u8) -> i32 {
    i32::from(class) + MIN_EXPONENT
}

/// Returns the class of a texel, which selects its quantization grid. `squared_weight` is the sum of the squared
/// interpolation weights with which Gaussians read the texel; if it is 0, the class is [`UNREAD`].
fn class(squared_weight: f32) -> u8 {
    if squared_weight <= 0.0 {
        return UNREAD;
    }
    let exponent = (squared_weight.to_bits() >> 23) as i32 - 127;
    (exponent - MIN_EXPONENT).clamp(0, CLASSES as i32 - 1) as u8
}

/// Returns the class (which selects the quantization grid) of each texel of a feature plane over two spatial axes (a,
/// b), as `[size_b, size_a]`. `position` holds the canonical positions, `space` is the box that the plane covers.
pub(super) fn plane_classes(position: &AttributeValues, space: &Box3, axes: [usize; 2], size: [usize; 2]) -> Vec<u8> {
    let mut squared_weights = vec![0.0f32; size[0] * size[1]];
    for i in 0..position.len() {
        let u = space.normalized(position.row(i));
        let (a, b) = (texel_pair(u[axes[0]], size[0]), texel_pair(u[axes[1]], size[1]));
        for (row, in_b) in [(b.low, 1.0 - b.fraction), (b.high, b.fraction)] {
            for (column, in_a) in [(a.low, 1.0 - a.fraction), (a.high, a.fraction)] {
                let weight = in_a * in_b;
                squared_weights[row as usize * size[0] + column as usize] += weight * weight;
            }
        }
    }
    squared_weights.into_iter().map(class).collect()
}

/// Returns the class of each of the `size` columns of a feature plane over one spatial axis and time. A class selects
/// the quantization grid of its column. `position` holds the canonical positions, `space` is the box that the plane
/// covers.
pub(super) fn time_plane_classes(position: &AttributeValues, space: &Box3, axis: usize, size: usize) -> Vec<u8> {
    let mut squared_weights = vec![0.0f32; size];
    for i in 0..position.len() {
        let a = texel_pair(space.normalized(position.row(i))[axis], size);
        for (column, weight) in [(a.low, 1.0 - a.fraction), (a.high, a.fraction)] {
            squared_weights[column as usize] += weight * weight;
        }
    }
    squared_weights.into_iter().map(class).collect()
}

/// Returns the range of rows of a feature plane that interpolation reads for times from `first` to `last`. The plane
/// has time along its `size` rows; row 0 is the time −1, the last row is the time 1.
pub(super) fn time_rows(first: f32, last: f32, size: usize) -> std::ops::Range<usize> {
    let (first, last) = (texel_pair(first, size), texel_pair(last, size));
    let end = if last.fraction > 0.0 { last.high } else { last.low };
    first.low as usize..end as usize + 1
}
