//! Grid that consists of every s-th pixel of an image along x and every t-th along y. A render of these pixels alone
//! costs about 1/(s·t) of a render of all pixels.

use std::num::NonZeroU32;

use super::convention::TILE;
use splat_core::Camera;

/// Distances in pixels between neighbors of a [`PixelGrid`]: along a row (index 0) and along a column (index 1).
pub type GridStrides = [NonZeroU32; 2];

/// Strides of the grid of all pixels.
pub const ALL_PIXELS: GridStrides = [NonZeroU32::MIN; 2];

/// Grid of pixels of an image: the pixels whose column and row have given remainders when divided by the strides.
///
/// A render of a grid has the same values as the render of all pixels at these pixels: footprints are those of the full
/// image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PixelGrid {
    strides: GridStrides,
    /// Column and row of the first pixel of the grid, each below the stride of its axis.
    phase: [u32; 2],
}

impl PixelGrid {
    /// Grid of all pixels.
    pub const ALL: PixelGrid = PixelGrid { strides: ALL_PIXELS, phase: [0; 2] };

    /// Creates the grid of the pixels whose column and row have the remainders `phase[0]` and `phase[1]` when divided
    /// by `strides[0]` and `strides[1]`.
    pub fn new(strides: GridStrides, phase: [u32; 2]) -> PixelGrid {
        PixelGrid { strides, phase: [0, 1].map(|axis| phase[axis] % strides[axis]) }
    }

    /// Creates the grid of the pixels whose column and row have the remainder s / 2 when divided by the stride s
    /// of the axis.
    pub fn centered(strides: GridStrides) -> PixelGrid {
        PixelGrid::new(strides, strides.map(|stride| stride.get() / 2))
    }

    /// Returns the distance in pixels between neighbors of the grid along a row (`axis` 0) or along a column (`axis` 1).
    pub fn stride(self, axis: usize) -> u32 {
        self.strides[axis].get()
    }

    /// Returns whether the grid holds all pixels.
    pub fn has_all_pixels(self) -> bool {
        self.strides == ALL_PIXELS
    }

    /// Returns the numbers of columns and rows of the grid in an image of `size` = (width, height) pixels.
    pub fn size(self, size: [u32; 2]) -> [u32; 2] {
        [0, 1].map(|axis| size[axis].saturating_sub(self.phase[axis]).div_ceil(self.stride(axis)))
    }

    /// Returns the column of the image that is column `index` of the grid (`axis` 0), or the row of the image that is
    /// row `index` of the grid (`axis` 1).
    pub fn pixel(self, axis: usize, index: u32) -> u32 {
        self.phase[axis] + self.stride(axis) * index
    }

    /// Returns the number of columns of the grid that lie left of column `pixel` of the image (`axis` 0), or of rows of the
    /// grid above row `pixel` of the image (`axis` 1). `pixel` and the result are integers in f64, so that the compiler
    /// vectorizes loops that call this function.
    ///
    /// The result is ⌈n/s⌉, where n = `pixel` − phase (0 if that is negative) and s is the stride. It is computed as
    /// ⌈(n − ½) · (1/s)⌉: a multiplication is faster than a division, and because of the ½, rounding errors of the product
    /// never change the result.
    #[inline(always)]
    pub(super) fn count_before(self, axis: usize, pixel: f64) -> f64 {
        let reciprocal = 1.0 / f64::from(self.stride(axis));
        (((pixel - f64::from(self.phase[axis])).max(0.0) - 0.5) * reciprocal).ceil()
    }

    /// Returns the view of `camera` in which only the pixels of this grid are rendered.
    pub fn sampled_view(self, camera: &Camera) -> SampledView<'_> {
        SampledView { camera, grid: self }
    }

    /// Returns which tiles of a render of this grid a splat can change: the range (first, end) of their columns if
    /// `axis` is 0, of their rows if it is 1. Each of these tiles has 16×16 pixels of the grid. The range is empty if
    /// the splat changes no pixel of the grid. Tile numbers are integers in f64, so that the compiler vectorizes the
    /// calling loop.
    ///
    /// The splat can change only pixels that lie in the tiles of `image_range` and are at most `half` from `at`.
    ///
    /// - `image_range`: tiles of the full image (16 pixels of the image each) that the splat can change.
    /// - `at`: center of the splat in the image, pixels.
    /// - `half`: half the extent of the splat along the axis, pixels of the image.
    /// - `size`: extent of the image along the axis, pixels.
    #[inline(always)]
    pub(super) fn tile_range(self, axis: usize, (start, end): (f64, f64), at: f64, half: f64, size: f64) -> (f64, f64) {
        const TILE_PIXELS: f64 = TILE as f64;
        let first = (start * TILE_PIXELS).max((at - half).ceil());
        let last = (end * TILE_PIXELS).min(size).min((at + half).floor().max(0.0) + 1.0);
        let (first, last) = (self.count_before(axis, first), self.count_before(axis, last));
        let start = (first / TILE_PIXELS).floor();
        (start, if first < last { (last / TILE_PIXELS).ceil() } else { start })
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
                let grid = PixelGrid::new([stride; 2].map(|stride| NonZeroU32::new(stride).unwrap()), [phase, 0]);
                for width in 0..20 {
                    let expected = (0..width).filter(|x| x % stride == phase).count() as u32;
                    assert_eq!(grid.size([width, 1])[0], expected, "{width} columns, stride {stride}, phase {phase}");
                }
            }
        }
    }

    #[test]
    fn pixel_returns_the_pixels_of_the_grid_in_order() {
        let grid = PixelGrid::new([3, 2].map(|stride| NonZeroU32::new(stride).unwrap()), [5, 3]);
        assert_eq!([0, 1, 2].map(|index| grid.pixel(0, index)), [2, 5, 8]);
        assert_eq!([0, 1, 2].map(|index| grid.pixel(1, index)), [1, 3, 5]);
    }

    #[test]
    fn tile_range_holds_the_pixels_of_the_grid_within_reach() {
        const SIZE: u32 = 150;
        let mut empty = 0;
        for (stride, phase) in [(1, 0), (2, 0), (3, 2), (5, 1), (7, 6)] {
            let grid = PixelGrid::new([stride; 2].map(|stride| NonZeroU32::new(stride).unwrap()), [phase; 2]);
            for step in -40..400 {
                let at = 0.5 * f64::from(step) - 0.2;
                for half in [0.1, 1.4, 9.0, 40.0] {
                    let (start, end) = (1.0, 9.0);
                    let is_reached = |pixel: u32| (16..144).contains(&pixel) && (f64::from(pixel) - at).abs() <= half;
                    let reached = (0..grid.size([SIZE; 2])[0]).filter(|&index| is_reached(grid.pixel(0, index)));
                    let tiles: Vec<u32> = reached.map(|index| index / TILE).collect();
                    let (first, last) = grid.tile_range(0, (start, end), at, half, f64::from(SIZE));
                    empty += usize::from(tiles.is_empty());
                    let expected = tiles.first().zip(tiles.last()).map(|(&first, &last)| (first, last + 1));
                    let found = (first < last).then_some((first as u32, last as u32));
                    assert_eq!(found, expected, "stride {stride}, phase {phase}, at {at}, half {half}");
                }
            }
        }
        assert!(empty > 100, "some must reach no pixel, {empty} do");
    }
}
