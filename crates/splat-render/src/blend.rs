//! Front-to-back blending of the splats (image footprints of Gaussians) of one tile, in groups of eight pixels.
//!
//! Input: the splats of the tile, nearest first. Output: the transmittance of each pixel, and the result of a
//! [`BlendSink`], which receives the weight alpha · transmittance of each splat in each pixel. Memory: the pixels of a
//! tile and the footprints of [`LOOKAHEAD`] splats, in the first-level cache. `benches/render.rs` compares the time
//! with that of the arithmetic alone.

use super::convention::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};
use super::grid::PixelGrid;
use super::lanes::{Aligned, LANES, Lanes, Portable, Sums};
use super::project::Splat;

/// Side of a tile in pixels.
const SIDE: usize = TILE as usize;
/// Number of groups of eight pixels in a tile. Group `row + 16 · half` is the left (0) or right (1) half of a row.
pub(super) const GROUPS: usize = SIDE * SIDE / LANES;

/// Bit set of the groups of pixels in even rows of a tile.
const EVEN_ROWS: u32 = 0x5555_5555;

/// One f32 for each sampled pixel of a tile, by group of eight pixels.
pub(super) type TilePlane = Aligned<[[f32; LANES]; GROUPS]>;

/// One f32 for each sampled row, or each sampled column, of a tile.
type TileLine = Aligned<[[f32; LANES]; SIDE / LANES]>;

/// Pixels of one tile that are rendered, at most 16×16. If only every n-th pixel along x and y is rendered
/// ([`PixelGrid`]), a tile covers 16n×16n pixels of the image.
pub(super) struct SampledPixels {
    /// Column in the image of the first pixel of the tile.
    x0: f64,
    /// Row in the image of the first pixel of the tile.
    y0: f64,
    /// Which pixels of the image are rendered.
    grid: PixelGrid,
    /// Offset of each column of the tile from its first column, in pixels of the image.
    xs: TileLine,
    /// Offset of each row of the tile from its first row, in pixels of the image.
    ys: TileLine,
    /// Positions of the first and the last pixel column of the left half of the tile (up to eight columns of the
    /// render), then of the right half. A position is the offset from the first column of the tile, in pixels of the
    /// image.
    spans: [[f32; 2]; SIDE / LANES],
    /// Number of pixel columns of the tile that lie in the render. Tiles at the right edge may have fewer than 16.
    across: usize,
    /// Number of pixel rows of the tile that lie in the render. Tiles at the bottom edge may have fewer than 16.
    down: usize,
}

impl SampledPixels {
    /// Computes the positions of the pixels of one tile of a render. `tile` is the (column, row) of the tile among the
    /// tiles of the render. The render consists of the pixels of the image that belong to `grid`, and `size` is its
    /// number of (columns, rows) of pixels.
    pub(super) fn new(tile: [u32; 2], size: [u32; 2], grid: PixelGrid) -> Self {
        let line = |axis: usize| {
            let first = tile[axis] * TILE;
            let count = TILE.min(size[axis] - first) as usize;
            let mut offsets = TileLine::default();
            for (k, offset) in offsets.as_flattened_mut()[..count].iter_mut().enumerate() {
                *offset = (grid.stride(axis) * k as u32) as f32;
            }
            (f64::from(grid.pixel(axis, first)), offsets, count)
        };
        let (x0, xs, across) = line(0);
        let (y0, ys, down) = line(1);
        let spans = std::array::from_fn(|half| {
            let last = across.clamp(half * LANES + 1, (half + 1) * LANES) - 1;
            [xs[half][0], xs.as_flattened()[last]]
        });
        SampledPixels { x0, y0, grid, xs, ys, spans, across, down }
    }

    /// Returns a bit set of the groups (eight neighboring pixels in a row of the tile) that contain a pixel of the
    /// render.
    fn groups(&self) -> u32 {
        let rows = ((1u64 << self.down) - 1) as u32;
        (0..self.across.div_ceil(LANES)).map(|half| rows << (half * SIDE)).sum()
    }

    /// Returns the transmittance of each pixel of the tile before any splat is blended: 1 for pixels of the render, and
    /// −1 for pixels of the tile outside the render. The negative sign marks these pixels as ended.
    fn initial_transmittance(&self) -> TilePlane {
        let sampled = |group: usize, lane| group / SIDE * LANES + lane < self.across && group % SIDE < self.down;
        let lanes = |group| std::array::from_fn(|lane| if sampled(group, lane) { 1.0 } else { -1.0 });
        Aligned(std::array::from_fn(lanes))
    }
}

/// Values of one splat at neighboring pixels, one pixel per vector lane.
#[derive(Clone, Copy)]
pub(super) struct Fragment<V: Lanes> {
    /// Alpha (opacity of the splat at the pixel), at most 0.99.
    pub(super) alpha: V,
    /// Mask of the pixels in which the splat is blended: alpha is at least 1/255, and the transmittance behind the
    /// splat is at least [`MIN_TRANSMITTANCE`].
    pub(super) blended: V::Mask,
    /// Weight of the splat in the pixel, alpha · transmittance; 0 where the splat is not blended.
    pub(super) weight: V,
    /// Transmittance behind the splat, never 0. The sign is a flag: negative in pixels that have ended, in which no
    /// further splat is blended. The weight is 0 there.
    pub(super) transmittance_after: V,
    /// Offset along x of the pixel from the point of its row at which the alpha of the splat is largest, pixels: dx −
    /// shear·dy of [`Splat`].
    pub(super) offset_x: V,
    /// Offset along y of the pixel from the center of the splat, pixels: dy of [`Splat`].
    pub(super) offset_y: V,
}

/// Receiver of the weight alpha · transmittance of each splat in each pixel while a tile is blended. Its
/// implementations compute colors, contributions, removal errors or gradients from the weights.
pub(super) trait BlendSink {
    /// Values that are summed up for one splat over the pixels of the tile.
    type Accumulator<V: Lanes>: Copy;
    /// Returns the accumulator of `splat` as it is before any pixel of the tile is added. Its sums and maxima are 0. It
    /// may also hold constants of the splat that [`BlendSink::add`] needs, such as the color.
    fn begin<V: Lanes>(&self, splat: &Splat) -> Self::Accumulator<V>;
    /// Adds the values `fragment` of a splat in some pixels to `accumulator`, the sums of this splat so far, and
    /// returns the new sums. The pixels are those of group `group` of the tile; a group is [`LANES`] neighboring pixels
    /// of a row. If `V` has more than [`LANES`] lanes, `fragment` also holds the values in the pixels of the following
    /// groups.
    fn add<V: Lanes>(
        &mut self,
        accumulator: Self::Accumulator<V>,
        group: usize,
        fragment: Fragment<V>,
    ) -> Self::Accumulator<V>;
    /// Order in which the groups of eight pixels of a tile are processed for one splat:
    /// - true: first all groups with even index, then all groups with odd index;
    /// - false: all groups by increasing index.
    ///
    /// Matters only for vectors of a single group.
    const SPLITS_EVEN_ODD: bool = false;
    /// Swaps the two sums of an accumulator: the sum over the groups of pixels with even index, and the sum over the
    /// groups with odd index. With vectors of one group, [`BlendSink::add`] always adds to the first of the two sums,
    /// so a swap directs the following groups to the other sum. Called twice per splat: after the groups with even
    /// index, and after the groups with odd index.
    ///
    /// Returns the accumulator unchanged in two cases: for receivers without two sums (the default implementation), and
    /// for vectors of several groups, which add to both sums at once.
    #[inline(always)]
    fn swap_even_odd<V: Lanes>(&self, accumulator: Self::Accumulator<V>) -> Self::Accumulator<V> {
        accumulator
    }
    /// Stores the result for a splat, whose values in all pixels have been added to `accumulator`. `pair` is the index
    /// of the splat in the list of splats of the tile.
    fn end<V: Lanes>(&mut self, accumulator: Self::Accumulator<V>, pair: usize);
}

/// Receiver of weights (alpha · transmittance of each splat) that accumulates the colors of the pixels of a tile, one
/// plane per color channel.
pub(super) struct ColorSink {
    pub(super) planes: [TilePlane; 3],
}

impl BlendSink for ColorSink {
    type Accumulator<V: Lanes> = [V; 3];
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> [V; 3] {
        [V::splat(splat.color[0]), V::splat(splat.color[1]), V::splat(splat.color[2])]
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, color: [V; 3], group: usize, Fragment { weight, .. }: Fragment<V>) -> [V; 3] {
        for (plane, color) in self.planes.iter_mut().zip(color) {
            color.mul_add(weight, V::load(plane, group)).store(plane, group);
        }
        color
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, _: [V; 3], _: usize) {}
}

/// Weights alpha · transmittance of one splat in one tile.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Weight {
    /// Sum of the weights alpha · transmittance of the splat over the rendered pixels of the tile: at most 256 terms,
    /// added in f32 in a fixed order.
    pub(super) sum: f32,
    /// Largest weight alpha · transmittance of the splat in any rendered pixel of the tile.
    pub(super) max: f32,
}

/// Receiver of weights (alpha · transmittance of each splat in each pixel) that computes, for each splat of a tile, the
/// sum and the maximum of its weights. `pairs` has one entry per splat of the tile, which must be zero at the start.
pub(super) struct WeightSink<'a> {
    pub(super) pairs: &'a mut [Weight],
}

impl BlendSink for WeightSink<'_> {
    /// Sums of the weights of a splat so far, one per lane, and the largest weight so far in each lane.
    type Accumulator<V: Lanes> = (V::Sums, V);
    #[inline(always)]
    fn begin<V: Lanes>(&self, _: &Splat) -> (V::Sums, V) {
        (V::Sums::zero(), V::splat(0.0))
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, (sum, max): (V::Sums, V), _: usize, fragment: Fragment<V>) -> (V::Sums, V) {
        (fragment.weight.add_to(sum), max.max(fragment.weight))
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, (sum, max): (V::Sums, V), pair: usize) {
        self.pairs[pair] = Weight { sum: sum.total(), max: max.largest() };
    }
}

/// Instruction set with which tiles are blended. All variants give results with the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BlendKernel {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl BlendKernel {
    /// Returns all instruction sets that this machine supports, the fastest one last.
    pub(super) fn all() -> Vec<Self> {
        let mut all = vec![BlendKernel::Portable];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            all.push(BlendKernel::Avx2);
            if splat_core::has_avx512() {
                all.push(BlendKernel::Avx512);
            }
        }
        all
    }

    /// Returns the fastest instruction set that this machine supports.
    pub(super) fn fastest() -> Self {
        Self::all().pop().unwrap_or(BlendKernel::Portable)
    }

    /// Returns the name of the instruction set for messages.
    pub(super) fn name(self) -> &'static str {
        match self {
            BlendKernel::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            BlendKernel::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            BlendKernel::Avx512 => "AVX-512",
        }
    }

    /// Blends splats over the pixels of a tile and passes their weights to `sink`. `pairs` holds the indices in
    /// `splats` of the splats of the tile, nearest first. `sampled` are the pixels.
    ///
    /// Returns the remaining transmittance of each pixel. Its sign bit is set if the pixel has ended, that is, if a
    /// further splat would have lowered the transmittance below [`MIN_TRANSMITTANCE`].
    pub(super) fn tile(
        self,
        splats: &[Splat],
        pairs: &[u32],
        sampled: &SampledPixels,
        sink: &mut impl BlendSink,
    ) -> TilePlane {
        match self {
            BlendKernel::Portable => blend::<Portable, _>(splats, pairs, sampled, sink),
            #[cfg(target_arch = "x86_64")]
            BlendKernel::Avx2 => {
                #[target_feature(enable = "avx2,fma")]
                fn blend_avx2(
                    splats: &[Splat],
                    pairs: &[u32],
                    sampled: &SampledPixels,
                    sink: &mut impl BlendSink,
                ) -> TilePlane {
                    blend::<super::lanes::Avx2, _>(splats, pairs, sampled, sink)
                }
                // SAFETY: only `all` makes `BlendKernel::Avx2`, after AVX2 and FMA were detected.
                unsafe { blend_avx2(splats, pairs, sampled, sink) }
            }
            #[cfg(target_arch = "x86_64")]
            BlendKernel::Avx512 => {
                #[target_feature(enable = "avx2,fma,avx512f,avx512dq,avx512vl")]
                fn blend_avx512(
                    splats: &[Splat],
                    pairs: &[u32],
                    sampled: &SampledPixels,
                    sink: &mut impl BlendSink,
                ) -> TilePlane {
                    blend::<super::lanes::Avx512, _>(splats, pairs, sampled, sink)
                }
                // SAFETY: only `all` makes `BlendKernel::Avx512`, after these features were detected.
                unsafe { blend_avx512(splats, pairs, sampled, sink) }
            }
        }
    }
}

/// Number of splats whose footprints in the tile are computed together, before any of them is blended.
///
/// The footprint of a splat tells which groups of pixels the splat touches, and thus how often the loop over groups
/// runs. The processor often mispredicts the end of this loop. If a footprint were computed directly before its splat
/// is blended, the processor would notice each misprediction only after this computation and its reads from memory.
const LOOKAHEAD: usize = 16;

/// Footprint of one splat in one tile. In a row of the tile, alpha at the column x is the opacity times 2 to the power
/// of `level − falloff_x·(x − middle)²`. `level` and `middle` belong to the row and are stored here; `falloff_x` is a
/// field of [`Splat`].
#[derive(Clone, Copy, Default)]
struct TileFootprint {
    /// Index of the splat in the list of splats of the tile.
    pair: usize,
    /// Bit set of the groups (eight neighboring pixels of a row) in which the splat may be visible.
    groups: u32,
    /// Position of the center of the splat along y, relative to the first row of the tile, in pixels of the image.
    v: f32,
    /// For each row, the position along x at which alpha is largest, relative to the first column of the tile, in
    /// pixels of the image: `middle` in the formula of [`TileFootprint`].
    middles: TileLine,
    /// For each row, the exponent (of 2) of alpha where it is largest: `level` in the formula of [`TileFootprint`].
    levels: TileLine,
    /// First and last column in which the splat is drawn, as offsets from the first column of the tile in pixels of the
    /// image; `None` if no column of the tile is excluded.
    drawn_columns: Option<[f32; 2]>,
}

impl TileFootprint {
    /// Overwrites `self` with the footprint of `splat` in the tile `sampled`. `pair` is the index of the splat in the
    /// list of splats of the tile.
    #[inline(always)]
    fn fill<V: Lanes>(&mut self, splat: &Splat, pair: usize, sampled: &SampledPixels) {
        // Relative to the corner of the tile, f32 has a precision of a millionth of a pixel wherever the tile lies.
        let (u, v) = ((splat.u - sampled.x0) as f32, (splat.v - sampled.y0) as f32);
        (self.pair, self.v, self.groups, self.drawn_columns) = (pair, v, 0, None);
        let (zero, falloff_x, floor) = (V::splat(0.0), V::splat(splat.falloff_x), V::splat(-splat.cutoff));
        for first in (0..SIDE / LANES).step_by(V::GROUPS) {
            let dy = V::load(&sampled.ys, first).sub(V::splat(v));
            let middle = V::splat(splat.shear).mul_add(dy, V::splat(u));
            let level = zero.sub(V::splat(splat.falloff_y).mul(dy.mul(dy)));
            middle.store(&mut self.middles, first);
            level.store(&mut self.levels, first);
            // A group of pixels contains no visible one if the exponent at its point nearest to `middle` is below
            // `floor`. The f32 operations are monotone, so evaluating its pixels one by one would give alpha < 1/255
            // for each.
            for (column, [start, end]) in sampled.spans.iter().enumerate() {
                let gap = V::splat(*start).sub(middle).max(middle.sub(V::splat(*end))).max(zero);
                let nearest = falloff_x.neg_mul_add(gap.mul(gap), level);
                self.groups |= V::bits(nearest.at_least(floor)) << (column * SIDE + first * LANES);
            }
        }
        if splat.drawn_tiles != Splat::UNBOUNDED && self.groups != 0 {
            self.exclude_tiles(splat, sampled);
        }
    }

    /// Removes from the footprint all pixels outside the tiles in which the original CUDA rasterizer draws the splat
    /// ([`Splat::drawn_tiles`]).
    #[cold]
    fn exclude_tiles(&mut self, splat: &Splat, sampled: &SampledPixels) {
        let [x0, x1, y0, y1] = splat.drawn_tiles.map(|tile| f64::from(tile) * f64::from(TILE));
        // Returns how many of the `count` columns (`axis` 0) or rows (`axis` 1) of the tile lie before column or row `end`
        // of the image. `origin` is the position in the image of the first column or row of the tile.
        let count_before = |axis: usize, end: f64, origin: f64, count: usize| {
            let [end, origin] = [end, origin].map(|pixel| sampled.grid.count_before(axis, pixel));
            (end - origin).clamp(0.0, count as f64) as usize
        };
        let columns_before = |end: f64| count_before(0, end, sampled.x0, sampled.across);
        let rows_before = |end: f64| count_before(1, end, sampled.y0, sampled.down);
        let columns = columns_before(x0)..columns_before(x1);
        let rows = rows_before(y0)..rows_before(y1);
        if columns.is_empty() || rows.is_empty() {
            self.groups = 0;
            return;
        }
        let drawn_rows = (1u32 << rows.end) - (1 << rows.start);
        self.groups &= drawn_rows | drawn_rows << SIDE;
        // A vector of several groups may hold an excluded row beside one in which the splat is drawn.
        for row in (0..rows.start).chain(rows.end..SIDE) {
            self.levels.as_flattened_mut()[row] = EXCLUDED_LEVEL;
        }
        if columns != (0..sampled.across) {
            let xs = sampled.xs.as_flattened();
            self.drawn_columns = Some([xs[columns.start], xs[columns.end - 1]]);
        }
    }
}

/// Exponent of alpha (value of [`TileFootprint::levels`]) in a row of pixels in which a splat must not be drawn. It is
/// so low that alpha becomes 0.
const EXCLUDED_LEVEL: f32 = -1e9;

/// Blends splats over a tile like [`BlendKernel::tile`], with vectors of type `V`.
#[inline(always)]
fn blend<V: Lanes, I: BlendSink>(splats: &[Splat], pairs: &[u32], sampled: &SampledPixels, sink: &mut I) -> TilePlane {
    let xs = sampled.xs.each_ref().map(V::repeat);
    // Combines the bits of the groups that share a vector into the bit of its first group.
    let vectors =
        |groups: u32| (0..V::GROUPS).fold(0, |all, k| all | groups >> k) & (u32::MAX / ((1 << V::GROUPS) - 1));
    let mut transmittance = sampled.initial_transmittance();
    let mut live = vectors(sampled.groups());
    let mut alphas = TilePlane::default();
    let mut footprints = [TileFootprint::default(); LOOKAHEAD];
    for (chunk, chunk_pairs) in pairs.chunks(LOOKAHEAD).enumerate() {
        for &index in pairs.get((chunk + 1) * LOOKAHEAD..).unwrap_or_default().iter().take(LOOKAHEAD) {
            V::prefetch(&splats[index as usize]);
        }
        let mut visible = 0;
        for (k, &index) in chunk_pairs.iter().enumerate() {
            let footprint = &mut footprints[visible];
            footprint.fill::<V>(&splats[index as usize], chunk * LOOKAHEAD + k, sampled);
            footprint.groups = vectors(footprint.groups) & live;
            visible += usize::from(footprint.groups != 0);
        }
        for footprint in &footprints[..visible] {
            let splat = &splats[pairs[footprint.pair] as usize];
            let groups = footprint.groups & live;
            let (falloff_x, opacity) = (V::splat(splat.falloff_x), V::splat(splat.opacity));
            let mut accumulator = sink.begin::<V>(splat);
            // First computes the alphas of all groups. They do not depend on earlier splats, so the processor can
            // compute several at the same time. Then blends the pixels, whose transmittance depends on earlier splats.
            let mut rest = groups;
            while rest != 0 {
                let group = rest.trailing_zeros() as usize % GROUPS;
                rest &= rest - 1;
                let row = group % SIDE;
                let dx = xs[group / SIDE].sub(V::splat_each(&footprint.middles, row));
                let power = falloff_x.neg_mul_add(dx.mul(dx), V::splat_each(&footprint.levels, row));
                let mut alpha = opacity.mul(power.exp2()).min(V::splat(MAX_ALPHA));
                if let Some([first, last]) = footprint.drawn_columns {
                    let x = xs[group / SIDE];
                    alpha = alpha.keep(V::both(x.at_least(V::splat(first)), V::splat(last).at_least(x)));
                }
                alpha.store(&mut alphas, group);
            }
            let mut ended = 0;
            let parts = if I::SPLITS_EVEN_ODD && V::GROUPS == 1 {
                [groups & EVEN_ROWS, groups & !EVEN_ROWS]
            } else {
                [groups, 0]
            };
            for mut groups in parts {
                while groups != 0 {
                    let group = groups.trailing_zeros() as usize % GROUPS;
                    groups &= groups - 1;
                    let row = group % SIDE;
                    let alpha = V::load(&alphas, group);
                    let before = V::load(&transmittance, group);
                    let after = alpha.neg_mul_add(before, before);
                    // The transmittance of an ended pixel is negative, so the pixel stays ended.
                    let drawn = alpha.at_least(V::splat(MIN_ALPHA));
                    let blended = V::both(drawn, after.at_least(V::splat(MIN_TRANSMITTANCE)));
                    let weight = alpha.mul(before).keep(blended);
                    let transmittance_after = after.or_else(blended, before.negate_where(drawn));
                    transmittance_after.store(&mut transmittance, group);
                    ended |= u32::from(transmittance_after.all_negative()) << group;
                    let offset_x = xs[group / SIDE].sub(V::splat_each(&footprint.middles, row));
                    let offset_y = V::splat_each(&sampled.ys, row).sub(V::splat(footprint.v));
                    accumulator = sink.add::<V>(
                        accumulator,
                        group,
                        Fragment { alpha, blended, weight, transmittance_after, offset_x, offset_y },
                    );
                }
                accumulator = sink.swap_even_odd::<V>(accumulator);
            }
            if ended != 0 {
                live = remove_ended(live, ended);
            }
            sink.end::<V>(accumulator, footprint.pair);
        }
        if live == 0 {
            break;
        }
    }
    transmittance
}

/// Returns the bit set `live` without the bits of `ended`. Each bit stands for a vector of pixels. A bit of `ended`
/// means that all pixels of its vector have ended: their transmittance is used up, and no further splat is blended in
/// them.
///
/// The function is cold and not inlined, so that its call remains a branch, which the processor predicts. Without the
/// branch, `live` would depend on the result of every splat, and the next splat could not begin before all pixels of
/// this one are blended.
#[cold]
#[inline(never)]
fn remove_ended(live: u32, ended: u32) -> u32 {
    live & !ended
}
