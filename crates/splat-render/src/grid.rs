//! Grid that consists of every s-th pixel of an image along x and y. A render of these pixels alone costs about 1/s² of
//! a render of all pixels.

use std::num::NonZeroU32;

use super::convention::TILE;
use super::project::TileRect;
use splat_core::Camera;

/// Grid of pixels of an image: the pixels whose column and row have given remainders when divided by the stride.
///
/// A render of a grid has the same values as the render of all pixels at these pixels: footprints are those of the full
/// image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PixelGrid {
    stride: u32,
    /// Column and row of the first pixel of the grid, each below `stride`.
    phase: [u32; 2],
}

impl PixelGrid {
    /// Grid of all pixels.
    pub const ALL: PixelGrid = PixelGrid { stride: 1, phase: [0; 2] };

    /// Creates the grid of the pixels whose column and row have the remainders `phase[0]` and `phase[1]` when divided
    /// by `stride`.
    pub fn new(stride: NonZeroU32, phase: [u32; 2]) -> PixelGrid {
        PixelGrid { stride: stride.get(), phase: phase.map(|phase| phase % stride) }
    }

    /// Creates the grid of the pixels whose column and row have the remainder `stride / 2` when divided by `stride`.
    pub fn centered(stride: NonZeroU32) -> PixelGrid {
        PixelGrid::new(stride, [stride.get() / 2; 2])
    }

    /// Returns the distance in pixels between neighbors of the grid, along a row and along a column.
    pub fn stride(self) -> u32 {
        self.stride
    }

    /// Returns the numbers of columns and rows of the grid in an image of `size` = (width, height) pixels.
    pub fn size(self, size: [u32; 2]) -> [u32; 2] {
        [0, 1].map(|axis| size[axis].saturating_sub(self.phase[axis]).div_ceil(self.stride))
    }

    /// Returns the column of the image that is column `index` of the grid (`axis` 0), or the row of the image that is
    /// row `index` of the grid (`axis` 1).
    pub fn pixel(self, axis: usize, index: u32) -> u32 {
        self.phase[axis] + self.stride * index
    }

    /// Returns the view of `camera` in which only the pixels of this grid are rendered.
    pub fn sampled_view(self, camera: &Camera) -> SampledView<'_> {
        SampledView { camera, grid: self }
    }

    /// Returns the tiles of a render of this grid in which a splat can change a pixel. Each of these tiles has 16×16
    /// pixels of the grid. The result is empty if the splat changes no pixel of the grid.
    ///
    /// The splat can change only pixels that lie in `rect` and are at most `half` from `at` along x and along y.
    ///
    /// - `rect`: tiles of the full image (16×16 pixels of the image each) that the splat can change.
    /// - `at`: center of the splat in the image, pixels.
    /// - `half`: half the width and half the height of the splat, pixels of the image.
    /// - `size`: width and height of the image, pixels.
    #[inline(always)]
    pub(super) fn tiles(self, rect: TileRect, at: [f64; 2], half: [f64; 2], size: [u32; 2]) -> TileRect {
        if self.stride == 1 {
            return rect;
        }
        let range = |axis: usize, start: u32, end: u32| {
            // A float-to-integer cast saturates: values below 0 become 0.
            let first = start.saturating_mul(TILE).max((at[axis] - half[axis]).ceil() as u32);
            let last = end
                .saturating_mul(TILE)
                .min(size[axis])
                .min(((at[axis] + half[axis]).floor() as u32).saturating_add(1));
            let [first, last] = [first, last].map(|pixel| self.count_before(axis, pixel));
            (first / TILE, if first < last { last.div_ceil(TILE) } else { first / TILE })
        };
        let (x0, x1) = range(0, rect.x0, rect.x1);
        let (y0, y1) = range(1, rect.y0, rect.y1);
        TileRect { x0, x1, y0, y1 }
    }

    /// Returns how many columns of the grid lie to the left of column `pixel` of the image (`axis` 0), or how many rows
    /// of the grid lie above row `pixel` of the image (`axis` 1).
    #[inline(always)]
    fn count_before(self, axis: usize, pixel: u32) -> u32 {
        pixel.saturating_sub(self.phase[axis]).div_ceil(self.stride)
    }
}

/// View of a camera in which only the pixels of a grid are rendered.
#[derive(Debug, Clone, Copy)]
pub struct SampledView<'a> {
    /// Camera with the size of the full image.
    pub camera: &'a Camera,
    /// Pixels of the image that are rendered.
    pub grid: PixelGrid,
}

impl<'a> From<&'a Camera> for SampledView<'a> {
    fn from(camera: &'a Camera) -> Self {
        PixelGrid::ALL.sampled_view(camera)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_counts_the_pixels_of_the_grid() {
        for stride in 1..6 {
            for phase in 0..stride {
                let grid = PixelGrid::new(NonZeroU32::new(stride).unwrap(), [phase, 0]);
                for width in 0..20 {
                    let expected = (0..width).filter(|x| x % stride == phase).count() as u32;
                    assert_eq!(grid.size([width, 1])[0], expected, "{width} columns, stride {stride}, phase {phase}");
                }
            }
        }
    }

    #[test]
    fn pixel_returns_the_pixels_of_the_grid_in_order() {
        let grid = PixelGrid::new(NonZeroU32::new(3).unwrap(), [5, 1]);
        assert_eq!([0, 1, 2].map(|index| grid.pixel(0, index)), [2, 5, 8]);
        assert_eq!([0, 1, 2].map(|index| grid.pixel(1, index)), [1, 4, 7]);
    }
}
