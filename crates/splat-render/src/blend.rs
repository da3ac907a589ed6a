//! Front-to-back blending of one tile, groups of eight pixels at a time.
//!
//! Data in: the tile's splats, nearest first. Data out: each pixel's transmittance, and whatever an
//! [`BlendSink`] makes of the weights alpha · transmittance. Memory: a tile's pixels and the rows of [`AHEAD`] splats, in the
//! first-level cache. `benches/render.rs` measures how far it is from what the arithmetic alone would take.

use super::convention::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};
use super::lanes::{Aligned, LANES, Lanes, Portable, Sums};
use super::project::Splat;

const SIDE: usize = TILE as usize;
/// Groups of eight pixels in a tile: group `row + 16 · column` covers eight neighbors of one row.
pub(super) const GROUPS: usize = SIDE * SIDE / LANES;

/// Bits of the groups of even rows.
const EVEN: u32 = 0x5555_5555;

/// One f32 per sampled pixel of a tile.
pub(super) type TilePlane = Aligned<[[f32; LANES]; GROUPS]>;

/// One f32 per row or column of a tile.
type TileLine = Aligned<[[f32; LANES]; SIDE / LANES]>;

/// The pixels of a tile that are sampled: every `stride`-th of the picture each way.
///
/// Samples are packed towards the tile's corner, so that a stride leaves fewer groups, not emptier ones.
pub(super) struct SampledPixels {
    /// Corner of the tile, pixels.
    x0: f64,
    y0: f64,
    /// Offsets of the sampled columns and rows from the corner, pixels.
    xs: TileLine,
    ys: TileLine,
    /// First and last sampled offset of either half of `xs`.
    spans: [[f32; 2]; SIDE / LANES],
    /// Number of sampled columns and rows.
    across: usize,
    down: usize,
}

impl SampledPixels {
    /// The lattice of tile (`tile[0]`, `tile[1]`) in a picture of `size` = (width, height).
    pub(super) fn new(tile: [u32; 2], size: [u32; 2], stride: u32) -> Self {
        let (xs, across) = samples(tile[0] * TILE, size[0], stride);
        let (ys, down) = samples(tile[1] * TILE, size[1], stride);
        let spans = std::array::from_fn(|half| {
            let last = across.clamp(half * LANES + 1, (half + 1) * LANES) - 1;
            [xs[half][0], xs.as_flattened()[last]]
        });
        let corner = [f64::from(tile[0] * TILE), f64::from(tile[1] * TILE)];
        SampledPixels { x0: corner[0], y0: corner[1], xs, ys, spans, across, down }
    }

    /// Bits of the groups that hold a sampled pixel.
    fn groups(&self) -> u32 {
        let rows = ((1u64 << self.down) - 1) as u32;
        (0..self.across.div_ceil(LANES)).map(|half| rows << (half * SIDE)).sum()
    }

    /// Transmittance before any splat: 1, negative (ended) where no pixel is sampled.
    fn clear(&self) -> TilePlane {
        let sampled = |group: usize, lane| group / SIDE * LANES + lane < self.across && group % SIDE < self.down;
        let of = |group| std::array::from_fn(|lane| if sampled(group, lane) { 1.0 } else { -1.0 });
        Aligned(std::array::from_fn(of))
    }
}

/// Offsets from `start` of the samples among the tile's pixels, and how many there are.
fn samples(start: u32, size: u32, stride: u32) -> (TileLine, usize) {
    let mut offsets = TileLine::default();
    let mut count = 0;
    for offset in 0..TILE.min(size - start) {
        if (start + offset) % stride == stride / 2 {
            offsets.as_flattened_mut()[count] = offset as f32;
            count += 1;
        }
    }
    (offsets, count)
}

/// One splat in one vector of pixels.
#[derive(Clone, Copy)]
pub(super) struct Fragment<V: Lanes> {
    /// Cut at 0.99.
    pub(super) alpha: V,
    /// Mask of the pixels where it is blended.
    pub(super) blended: V::Mask,
    /// alpha · transmittance; 0 where it is not blended.
    pub(super) weight: V,
    /// Transmittance behind it, never 0; where the weight is 0, it may be negative.
    pub(super) left: V,
    /// Offset from the splat's middle of this row, pixels: dx − slope·dy of [`Splat`].
    pub(super) across: V,
    /// Offset of the row from the splat's center, pixels: dy of [`Splat`].
    pub(super) down: V,
}

/// What becomes of the weights alpha · transmittance.
pub(super) trait BlendSink {
    /// What it holds of one splat while that is drawn.
    type Drop<V: Lanes>: Copy;
    /// The next splat.
    fn begin<V: Lanes>(&self, splat: &Splat) -> Self::Drop<V>;
    /// What it does to `group` and, of a vector of more than one, those after it.
    fn add<V: Lanes>(&mut self, drop: Self::Drop<V>, group: usize, stroke: Fragment<V>) -> Self::Drop<V>;
    /// Whether all even groups are to come before the odd ones, with [`BlendSink::turn`] after either.
    const TURNS: bool = false;
    /// What [`Lanes`] of one group do between the even and the odd ones, and once more in the end.
    #[inline(always)]
    fn turn<V: Lanes>(&self, drop: Self::Drop<V>) -> Self::Drop<V> {
        drop
    }
    /// The splat, `pair` of the tile, is done.
    fn end<V: Lanes>(&mut self, drop: Self::Drop<V>, pair: usize);
}

/// Accumulates color: three planes.
pub(super) struct Color {
    pub(super) planes: [TilePlane; 3],
}

impl BlendSink for Color {
    type Drop<V: Lanes> = [V; 3];
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> [V; 3] {
        [V::splat(splat.color[0]), V::splat(splat.color[1]), V::splat(splat.color[2])]
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, color: [V; 3], group: usize, Fragment { weight, .. }: Fragment<V>) -> [V; 3] {
        for (plane, color) in self.planes.iter_mut().zip(color) {
            V::load(plane, group).add(color.mul(weight)).store(plane, group);
        }
        color
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

impl BlendSink for Weights<'_> {
    /// Sum and largest.
    type Drop<V: Lanes> = (V::Sums, V);
    #[inline(always)]
    fn begin<V: Lanes>(&self, _: &Splat) -> (V::Sums, V) {
        (V::Sums::zero(), V::splat(0.0))
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, (sum, max): (V::Sums, V), _: usize, stroke: Fragment<V>) -> (V::Sums, V) {
        (stroke.weight.add_to(sum), max.max(stroke.weight))
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, (sum, max): (V::Sums, V), pair: usize) {
        self.pairs[pair] = Weight { sum: sum.total(), max: max.largest() };
    }
}

/// The instructions to blend with; all give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Blend {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Blend {
    /// All that this machine has, the fastest last.
    pub(super) fn all() -> Vec<Self> {
        let mut all = vec![Blend::Portable];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            all.push(Blend::Avx2);
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
            {
                all.push(Blend::Avx512);
            }
        }
        all
    }

    /// The fastest this machine has.
    pub(super) fn fastest() -> Self {
        Self::all().pop().unwrap_or(Blend::Portable)
    }

    /// What its instructions are called.
    pub(super) fn name(self) -> &'static str {
        match self {
            Blend::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Blend::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Blend::Avx512 => "AVX-512",
        }
    }

    /// Blends the splats `pairs` front to back over the lattice; gives the transmittance left, its sign
    /// set where the pixel ended early.
    pub(super) fn tile(
        self,
        splats: &[Splat],
        pairs: &[u32],
        lattice: &SampledPixels,
        ink: &mut impl BlendSink,
    ) -> TilePlane {
        match self {
            Blend::Portable => blend::<Portable, _>(splats, pairs, lattice, ink),
            #[cfg(target_arch = "x86_64")]
            Blend::Avx2 => {
                #[target_feature(enable = "avx2")]
                fn blend_avx2(
                    splats: &[Splat],
                    pairs: &[u32],
                    lattice: &SampledPixels,
                    ink: &mut impl BlendSink,
                ) -> TilePlane {
                    blend::<super::lanes::Avx2, _>(splats, pairs, lattice, ink)
                }
                // SAFETY: `Blend::Avx2` is made by `all` alone, after AVX2 was detected.
                unsafe { blend_avx2(splats, pairs, lattice, ink) }
            }
            #[cfg(target_arch = "x86_64")]
            Blend::Avx512 => {
                #[target_feature(enable = "avx2,avx512f,avx512dq,avx512vl")]
                fn blend_avx512(
                    splats: &[Splat],
                    pairs: &[u32],
                    lattice: &SampledPixels,
                    ink: &mut impl BlendSink,
                ) -> TilePlane {
                    blend::<super::lanes::Avx512, _>(splats, pairs, lattice, ink)
                }
                // SAFETY: `Blend::Avx512` is made by `all` alone, after these were detected.
                unsafe { blend_avx512(splats, pairs, lattice, ink) }
            }
        }
    }
}

/// Splats looked at together, before any of them is blended. Which groups one reaches is known late; were it asked right
/// before blending, every wrong guess of where its groups end would wait for that, and that for memory.
const AHEAD: usize = 16;

/// Where one splat meets the rows of a tile: along each, the exponent of its alpha is `level − narrow·(x − middle)²`.
#[derive(Clone, Copy, Default)]
struct Crossing {
    /// Place among the tile's pairs.
    pair: usize,
    /// Bits of the groups where it may be visible.
    groups: u32,
    /// Center, pixels below the tile's corner.
    v: f32,
    middles: TileLine,
    levels: TileLine,
}

impl Crossing {
    #[inline(always)]
    fn new<V: Lanes>(splat: &Splat, pair: usize, lattice: &SampledPixels) -> Self {
        // Relative to the tile's corner, f32 keeps a millionth of a pixel wherever the tile lies.
        let (u, v) = ((splat.u - lattice.x0) as f32, (splat.v - lattice.y0) as f32);
        let mut crossing = Crossing { pair, v, ..Crossing::default() };
        let (zero, narrow, floor) = (V::splat(0.0), V::splat(splat.narrow), V::splat(-splat.reach));
        for first in (0..SIDE / LANES).step_by(V::GROUPS) {
            let dy = V::load(&lattice.ys, first).sub(V::splat(v));
            let middle = V::splat(u).add(V::splat(splat.slope).mul(dy));
            let level = zero.sub(V::splat(splat.fall).mul(dy.mul(dy)));
            middle.store(&mut crossing.middles, first);
            level.store(&mut crossing.levels, first);
            // A group whose nearest point to `middle` lies below the floor holds no visible pixel: f32 subtraction and
            // multiplication are monotone, so evaluating its pixels one by one would give alpha < 1/255 for each.
            for (column, [start, end]) in lattice.spans.iter().enumerate() {
                let gap = V::splat(*start).sub(middle).max(middle.sub(V::splat(*end))).max(zero);
                let nearest = level.sub(narrow.mul(gap.mul(gap)));
                crossing.groups |= V::bits(nearest.at_least(floor)) << (column * SIDE + first * LANES);
            }
        }
        crossing
    }
}

#[inline(always)]
fn blend<V: Lanes, I: BlendSink>(splats: &[Splat], pairs: &[u32], lattice: &SampledPixels, ink: &mut I) -> TilePlane {
    let xs = lattice.xs.each_ref().map(V::repeat);
    // Of groups, those that share a vector; a vector is named by its first.
    let vectors =
        |groups: u32| (0..V::GROUPS).fold(0, |all, k| all | groups >> k) & (u32::MAX / ((1 << V::GROUPS) - 1));
    let mut transmittance = lattice.clear();
    let mut live = vectors(lattice.groups());
    let mut alphas = TilePlane::default();
    let mut crossings = [Crossing::default(); AHEAD];
    for (chunk, ahead) in pairs.chunks(AHEAD).enumerate() {
        for &index in pairs.get((chunk + 1) * AHEAD..).unwrap_or_default().iter().take(AHEAD) {
            V::fetch(&splats[index as usize]);
        }
        let mut met = 0;
        for (k, &index) in ahead.iter().enumerate() {
            let crossing = Crossing::new::<V>(&splats[index as usize], chunk * AHEAD + k, lattice);
            crossings[met] = Crossing { groups: vectors(crossing.groups) & live, ..crossing };
            met += usize::from(crossings[met].groups != 0);
        }
        for crossing in &crossings[..met] {
            let splat = &splats[pairs[crossing.pair] as usize];
            let groups = crossing.groups & live;
            let (narrow, opacity) = (V::splat(splat.narrow), V::splat(splat.opacity));
            let mut drop = ink.begin::<V>(splat);
            // First what hangs on the splat alone: alphas in flight at once, then the pixels that wait for one another.
            let mut rest = groups;
            while rest != 0 {
                let group = rest.trailing_zeros() as usize % GROUPS;
                rest &= rest - 1;
                let row = group % SIDE;
                let dx = xs[group / SIDE].sub(V::spread(&crossing.middles, row));
                let power = V::spread(&crossing.levels, row).sub(narrow.mul(dx.mul(dx)));
                opacity.mul(power.exp2()).min(V::splat(MAX_ALPHA)).store(&mut alphas, group);
            }
            let mut ended = 0;
            let parts = if I::TURNS && V::GROUPS == 1 { [groups & EVEN, groups & !EVEN] } else { [groups, 0] };
            for mut groups in parts {
                while groups != 0 {
                    let group = groups.trailing_zeros() as usize % GROUPS;
                    groups &= groups - 1;
                    let row = group % SIDE;
                    let alpha = V::load(&alphas, group);
                    let before = V::load(&transmittance, group);
                    let after = before.mul(V::splat(1.0).sub(alpha));
                    // An ended pixel's transmittance is negative, so it can only end again.
                    let drawn = alpha.at_least(V::splat(MIN_ALPHA));
                    let blended = V::both(drawn, after.at_least(V::splat(MIN_TRANSMITTANCE)));
                    let weight = alpha.mul(before).keep(blended);
                    let left = after.or_else(blended, before.negative(drawn));
                    left.store(&mut transmittance, group);
                    ended |= u32::from(left.all_negative()) << group;
                    let across = xs[group / SIDE].sub(V::spread(&crossing.middles, row));
                    let down = V::spread(&lattice.ys, row).sub(V::splat(crossing.v));
                    drop = ink.add::<V>(drop, group, Fragment { alpha, blended, weight, left, across, down });
                }
                drop = ink.turn::<V>(drop);
            }
            if ended != 0 {
                live = without(live, ended);
            }
            ink.end::<V>(drop, crossing.pair);
        }
        if live == 0 {
            break;
        }
    }
    transmittance
}

/// `live` without the vectors `ended`. Apart, so that it is branched to: worked out for every splat, the groups of the
/// next one would wait for the pixels of this.
#[cold]
#[inline(never)]
fn without(live: u32, ended: u32) -> u32 {
    live & !ended
}
