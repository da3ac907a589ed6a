//! Division of the attributes of all Gaussians at one frame into slices, one set for each block of Gaussians, so that
//! several threads can write blocks at the same time.

use super::GAUSSIANS_PER_BLOCK;
use crate::model::{Attributes, Gaussians};

/// Destination of the values of one block of Gaussians: a mutable slice for every component of every attribute, in the
/// order of the attributes.
pub struct BlockSlices<'a>(Vec<&'a mut [f32]>);

impl<'a> BlockSlices<'a> {
    /// Resizes the attributes `want` of `state` to `count` Gaussians, and divides their arrays into mutable slices.
    /// Returns one set of slices for each block of [`GAUSSIANS_PER_BLOCK`] Gaussians, in the order of the blocks.
    pub fn split(state: &'a mut Gaussians, want: Attributes, count: usize) -> Vec<BlockSlices<'a>> {
        let mut parts: Vec<BlockSlices<'a>> =
            (0..count.div_ceil(GAUSSIANS_PER_BLOCK)).map(|_| BlockSlices(Vec::new())).collect();
        for column in state.selected_attribute_values_mut(want) {
            column.resize(count);
            for plane in column.planes_mut().chunks_exact_mut(count.max(1)) {
                plane.chunks_mut(GAUSSIANS_PER_BLOCK).zip(&mut parts).for_each(|(part, block)| block.0.push(part));
            }
        }
        parts
    }

    /// Copies the attributes `want` of `block`, the Gaussians of one block, into these slices. [`BlockSlices::split`]
    /// must have made the slices for the same attributes.
    pub fn write(self, block: &Gaussians, want: Attributes) {
        let columns = want.iter().map(|column| block.attribute_values(column));
        let planes = columns.flat_map(|column| (0..column.width()).map(|c| column.plane(c)));
        self.0.into_iter().zip(planes).for_each(|(part, plane)| part.copy_from_slice(plane));
    }
}
