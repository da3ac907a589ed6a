//! Front-to-back blending of one tile, eight pixels at a time.
//!
//! Data in: the tile's splats, nearest first. Data out: each pixel's transmittance, and whatever an
//! [`Ink`] makes of the weights alpha · transmittance. Memory: a tile's pixels, in the first-level cache.

use super::convention::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};
use super::lanes::{LANES, Lanes, Portable};
use super::project::Splat;

const SIDE: usize = TILE as usize;
/// Groups of eight pixels in a tile: group `row + 16 · column` covers eight neighbours of one row.
pub(super) const GROUPS: usize = SIDE * SIDE / LANES;

/// One f32 per sampled pixel of a tile.
pub(super) type Plane = [[f32; LANES]; GROUPS];

/// The pixels of a tile that are sampled: every `stride`-th of the picture each way.
///
/// Samples are packed towards the tile's corner, so that a stride leaves fewer groups, not emptier ones.
pub(super) struct Lattice {
    /// Corner of the tile, pixels.
    x0: f64,
    y0: f64,
    /// Offsets of the sampled columns and rows from the corner, pixels.
    xs: [f32; SIDE],
    ys: [f32; SIDE],
    /// First and last sampled offset of either half of `xs`.
    spans: [[f32; 2]; SIDE / LANES],
    /// Number of sampled columns and rows.
    across: usize,
    down: usize,
}

impl Lattice {
    /// The lattice of tile (`tile[0]`, `tile[1]`) in a picture of `size` = (width, height).
    pub(super) fn new(tile: [u32; 2], size: [u32; 2], stride: u32) -> Self {
        let (xs, across) = samples(tile[0] * TILE, size[0], stride);
        let (ys, down) = samples(tile[1] * TILE, size[1], stride);
        let spans = std::array::from_fn(|half| {
            let last = across.clamp(half * LANES + 1, (half + 1) * LANES) - 1;
            [xs[half * LANES], xs[last]]
        });
        let corner = [f64::from(tile[0] * TILE), f64::from(tile[1] * TILE)];
        Lattice { x0: corner[0], y0: corner[1], xs, ys, spans, across, down }
    }

    /// Bits of the groups that hold a sampled pixel.
    fn groups(&self) -> u32 {
        let rows = ((1u64 << self.down) - 1) as u32;
        (0..self.across.div_ceil(LANES)).map(|half| rows << (half * SIDE)).sum()
    }

    /// Transmittance before any splat: 1, negative (ended) where no pixel is sampled.
    fn clear(&self) -> Plane {
        std::array::from_fn(|group| {
            std::array::from_fn(|lane| {
                let sampled = group / SIDE * LANES + lane < self.across && group % SIDE < self.down;
                if sampled { 1.0 } else { -1.0 }
            })
        })
    }
}

/// Offsets from `start` of the samples among the tile's pixels, and how many there are.
fn samples(start: u32, size: u32, stride: u32) -> ([f32; SIDE], usize) {
    let mut offsets = [0.0; SIDE];
    let mut count = 0;
    for offset in 0..TILE.min(size - start) {
        if (start + offset) % stride == stride / 2 {
            offsets[count] = offset as f32;
            count += 1;
        }
    }
    (offsets, count)
}

/// One splat in one group of pixels.
#[derive(Clone, Copy)]
pub(super) struct Stroke<V> {
    /// Cut at 0.99.
    pub(super) alpha: V,
    /// Mask of the pixels where it is blended.
    pub(super) blended: V,
    /// alpha · transmittance; 0 where it is not blended.
    pub(super) weight: V,
    /// Transmittance behind it, never 0; where the weight is 0, it may be negative.
    pub(super) left: V,
    /// Offset from the splat's middle of this row, pixels: dx − slope·dy of [`Splat`].
    pub(super) across: V,
    /// Offset of the row from the splat's centre, pixels: dy of [`Splat`].
    pub(super) down: f32,
}

/// What becomes of the weights alpha · transmittance.
pub(super) trait Ink {
    /// What it holds of one splat while that is drawn.
    type Drop<V: Lanes>: Copy;
    /// The next splat.
    fn begin<V: Lanes>(&self, splat: &Splat) -> Self::Drop<V>;
    /// What it does to one group of pixels.
    fn add<V: Lanes>(&mut self, drop: Self::Drop<V>, group: usize, stroke: Stroke<V>) -> Self::Drop<V>;
    /// The splat, `pair` of the tile, is done.
    fn end<V: Lanes>(&mut self, drop: Self::Drop<V>, pair: usize);
}

/// Accumulates colour: three planes.
pub(super) struct Colour {
    pub(super) planes: [Plane; 3],
}

impl Ink for Colour {
    type Drop<V: Lanes> = [V; 3];
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> [V; 3] {
        [V::splat(splat.colour[0]), V::splat(splat.colour[1]), V::splat(splat.colour[2])]
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, colour: [V; 3], group: usize, Stroke { weight, .. }: Stroke<V>) -> [V; 3] {
        for (plane, colour) in self.planes.iter_mut().zip(colour) {
            V::load(&plane[group]).add(colour.mul(weight)).store(&mut plane[group]);
        }
        colour
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, _: [V; 3], _: usize) {}
}

/// Weight of one splat in one tile.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Weight {
    /// Sum over sampled pixels, f32 rounding of at most 256 terms in a fixed order.
    pub(super) sum: f32,
    /// Largest of a pixel.
    pub(super) max: f32,
}

/// Accumulates weights: one per pair of the tile, zero at first.
pub(super) struct Weights<'a> {
    pub(super) pairs: &'a mut [Weight],
}

impl Ink for Weights<'_> {
    type Drop<V: Lanes> = [V; 2];
    #[inline(always)]
    fn begin<V: Lanes>(&self, _: &Splat) -> [V; 2] {
        [V::splat(0.0); 2]
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, [sum, max]: [V; 2], _: usize, Stroke { weight, .. }: Stroke<V>) -> [V; 2] {
        [sum.add(weight), max.max(weight)]
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, [sum, max]: [V; 2], pair: usize) {
        let mut maxima = [0.0; LANES];
        max.store(&mut maxima);
        self.pairs[pair] = Weight { sum: sum.sum(), max: maxima.into_iter().fold(0.0, f32::max) };
    }
}

/// The instructions to blend with; all give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Blend {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
}

impl Blend {
    /// The fastest this machine has.
    pub(super) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            return Blend::Avx2;
        }
        Blend::Portable
    }

    /// Blends the splats `pairs` front to back over the lattice; gives the transmittance left, its sign
    /// set where the pixel ended early.
    pub(super) fn tile(self, splats: &[Splat], pairs: &[u32], lattice: &Lattice, ink: &mut impl Ink) -> Plane {
        match self {
            Blend::Portable => blend::<Portable>(splats, pairs, lattice, ink),
            #[cfg(target_arch = "x86_64")]
            Blend::Avx2 => {
                #[target_feature(enable = "avx2")]
                fn blend_avx2(splats: &[Splat], pairs: &[u32], lattice: &Lattice, ink: &mut impl Ink) -> Plane {
                    blend::<super::lanes::Avx2>(splats, pairs, lattice, ink)
                }
                // SAFETY: `Blend::Avx2` is made by `detect` alone, after AVX2 was detected.
                unsafe { blend_avx2(splats, pairs, lattice, ink) }
            }
        }
    }
}

#[inline(always)]
fn blend<V: Lanes>(splats: &[Splat], pairs: &[u32], lattice: &Lattice, ink: &mut impl Ink) -> Plane {
    let halves = |values: &[f32; SIDE]| -> [V; 2] {
        let (first, second) = values.split_at(LANES);
        [V::load(first.try_into().unwrap()), V::load(second.try_into().unwrap())]
    };
    let (xs, ys) = (halves(&lattice.xs), halves(&lattice.ys));
    let zero = V::splat(0.0);
    let mut transmittance = lattice.clear();
    let mut live = lattice.groups();
    for (pair, &index) in pairs.iter().enumerate() {
        let splat = &splats[index as usize];
        // Relative to the tile's corner, f32 keeps a millionth of a pixel wherever the tile lies.
        let (u, v) = (V::splat((splat.u - lattice.x0) as f32), V::splat((splat.v - lattice.y0) as f32));
        let narrow = V::splat(splat.narrow);
        let floor = V::splat(-splat.reach);

        // Along each row the exponent is `level − narrow·(x − middle)²`. A group whose nearest point to
        // `middle` lies below the floor holds no visible pixel: f32 subtraction and multiplication are
        // monotone, so evaluating its pixels one by one would give alpha < 1/255 for each.
        let mut middles = [0.0f32; SIDE];
        let mut levels = [0.0f32; SIDE];
        let mut downs = [0.0f32; SIDE];
        let mut reached = 0;
        for half in 0..SIDE / LANES {
            let dy = ys[half].sub(v);
            let middle = u.add(V::splat(splat.slope).mul(dy));
            let level = zero.sub(V::splat(splat.fall).mul(dy.mul(dy)));
            for (row, rows) in [(middle, &mut middles), (level, &mut levels), (dy, &mut downs)] {
                row.store((&mut rows[half * LANES..][..LANES]).try_into().unwrap());
            }
            for (column, [first, last]) in lattice.spans.iter().enumerate() {
                let gap = V::splat(*first).sub(middle).max(middle.sub(V::splat(*last))).max(zero);
                let nearest = level.sub(narrow.mul(gap.mul(gap)));
                reached |= nearest.at_least(floor).signs() << (column * SIDE + half * LANES);
            }
        }
        reached &= live;
        if reached == 0 {
            continue;
        }

        let opacity = V::splat(splat.opacity);
        let mut drop = ink.begin::<V>(splat);
        while reached != 0 {
            let group = reached.trailing_zeros() as usize % GROUPS;
            reached &= reached - 1;
            let dx = xs[group / SIDE].sub(V::splat(middles[group % SIDE]));
            let power = V::splat(levels[group % SIDE]).sub(narrow.mul(dx.mul(dx)));
            let alpha = opacity.mul(power.exp2()).min(V::splat(MAX_ALPHA));
            let before = V::load(&transmittance[group]);
            let after = before.mul(V::splat(1.0).sub(alpha));
            // An ended pixel's transmittance is negative, so it can only end again.
            let drawn = alpha.at_least(V::splat(MIN_ALPHA));
            let blended = drawn.and(after.at_least(V::splat(MIN_TRANSMITTANCE)));
            let weight = alpha.mul(before).and(blended);
            let left = blended.select(after, before.or(drawn.and(V::splat(-0.0))));
            left.store(&mut transmittance[group]);
            if left.signs() == (1 << LANES) - 1 {
                live &= !(1 << group);
            }
            let stroke = Stroke { alpha, blended, weight, left, across: dx, down: downs[group % SIDE] };
            drop = ink.add::<V>(drop, group, stroke);
        }
        ink.end::<V>(drop, pair);
        if live == 0 {
            break;
        }
    }
    transmittance
}
