//! Which texels of a plane are read, and how much of what is read is theirs.
//!
//! In: canonical positions as they are stored, the box, a plane's axes and size. Out: a class per texel. Writer and reader
//! of an archive both derive it, so nothing of it is stored; sums and products of f32 in a fixed order give the same
//! classes on every machine.

use super::lattice::UNREAD;
use crate::deform::{Box3, tap};
use crate::model::Column;

/// Powers of two of the part that is read, from 2^`LEAST` on, and then in octaves.
const LEAST: i32 = -8;
/// Classes of texels.
pub(super) const CLASSES: usize = 16;

/// Octaves by which the part that is read of a class is above that of one texel that is read alone and once.
pub(super) fn octaves(class: u8) -> i32 {
    i32::from(class) + LEAST
}

/// The class of a texel of which the squares of the weights, with which Gaussians read it, sum to `part`.
fn class(part: f32) -> u8 {
    if part <= 0.0 {
        return UNREAD;
    }
    let exponent = (part.to_bits() >> 23) as i32 - 127;
    (exponent - LEAST).clamp(0, CLASSES as i32 - 1) as u8
}

/// Classes `[size_b, size_a]` of a plane over two axes of space.
pub(super) fn of_plane(position: &Column, space: &Box3, axes: [usize; 2], size: [usize; 2]) -> Vec<u8> {
    let mut parts = vec![0.0f32; size[0] * size[1]];
    for i in 0..position.len() {
        let u = space.normalized(position.row(i));
        let (a, b) = (tap(u[axes[0]], size[0]), tap(u[axes[1]], size[1]));
        for (row, in_b) in [(b.low, 1.0 - b.fraction), (b.high, b.fraction)] {
            for (column, in_a) in [(a.low, 1.0 - a.fraction), (a.high, a.fraction)] {
                let weight = in_a * in_b;
                parts[row as usize * size[0] + column as usize] += weight * weight;
            }
        }
    }
    parts.into_iter().map(class).collect()
}

/// Classes `[size]` of the columns of a plane over an axis and time.
pub(super) fn of_line(position: &Column, space: &Box3, axis: usize, size: usize) -> Vec<u8> {
    let mut parts = vec![0.0f32; size];
    for i in 0..position.len() {
        let a = tap(space.normalized(position.row(i))[axis], size);
        for (column, weight) in [(a.low, 1.0 - a.fraction), (a.high, a.fraction)] {
            parts[column as usize] += weight * weight;
        }
    }
    parts.into_iter().map(class).collect()
}

/// Rows of a plane over time that are read at times from `first` to `last`.
pub(super) fn rows(first: f32, last: f32, size: usize) -> std::ops::Range<usize> {
    let (first, last) = (tap(first, size), tap(last, size));
    let end = if last.fraction > 0.0 { last.high } else { last.low };
    first.low as usize..end as usize + 1
}
