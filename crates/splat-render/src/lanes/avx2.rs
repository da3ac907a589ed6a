//! Vectors for blending pixels with AVX2 registers.

use std::arch::x86_64::*;

use super::{LANES, Lanes, Sums};

/// Vector of one group: eight f32 lanes. Also serves as a mask, in which each lane has all bits set (true) or none
/// (false).
#[derive(Clone, Copy)]
pub(in super::super) struct Avx2(pub(super) __m256);

// SAFETY of every block below: the instructions need AVX2 (most only AVX) or FMA. `Avx2` is used only by
// `super::super::blend::BlendKernel::tile` and by `super::avx512`, in functions entered after both were detected. Loads
// and stores use the unaligned forms, on arrays of exactly eight f32. A prefetched address comes from a reference, and
// a prefetch reads nothing.
macro_rules! avx2 {
    ($e:expr) => {
        // SAFETY: see the comment above the macro.
        unsafe { $e }
    };
}

impl Lanes for Avx2 {
    type Mask = Self;
    type Sums = Self;
    type EvenOddSums = [Self; 2];
    const GROUPS: usize = 1;

    #[inline(always)]
    fn prefetch<T>(value: &T) {
        avx2!(_mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()))
    }
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Avx2(avx2!(_mm256_set1_ps(value)))
    }
    #[inline(always)]
    fn repeat(group: &[f32; LANES]) -> Self {
        Avx2(avx2!(_mm256_loadu_ps(group.as_ptr())))
    }
    #[inline(always)]
    fn splat_each<const N: usize>(values: &[[f32; LANES]; N], first: usize) -> Self {
        Self::splat(values.as_flattened()[first])
    }
    #[inline(always)]
    fn load<const N: usize>(from: &[[f32; LANES]; N], first: usize) -> Self {
        Self::repeat(&from[first])
    }
    #[inline(always)]
    fn store<const N: usize>(self, to: &mut [[f32; LANES]; N], first: usize) {
        avx2!(_mm256_storeu_ps(to[first].as_mut_ptr(), self.0))
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_add_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_sub_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_mul_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Avx2(avx2!(_mm256_fmadd_ps(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        Avx2(avx2!(_mm256_fnmadd_ps(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_div_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_min_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_max_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn at_least(self, other: Self) -> Self {
        Avx2(avx2!(_mm256_cmp_ps::<_CMP_GE_OQ>(self.0, other.0)))
    }
    #[inline(always)]
    fn both(a: Self, b: Self) -> Self {
        Avx2(avx2!(_mm256_and_ps(a.0, b.0)))
    }
    #[inline(always)]
    fn bits(mask: Self) -> u32 {
        avx2!(_mm256_movemask_ps(mask.0)) as u32
    }
    #[inline(always)]
    fn keep(self, mask: Self) -> Self {
        Avx2(avx2!(_mm256_and_ps(self.0, mask.0)))
    }
    #[inline(always)]
    fn or_else(self, mask: Self, other: Self) -> Self {
        Avx2(avx2!(_mm256_blendv_ps(other.0, self.0, mask.0)))
    }
    #[inline(always)]
    fn negate_where(self, mask: Self) -> Self {
        Avx2(avx2!(_mm256_or_ps(self.0, _mm256_and_ps(mask.0, _mm256_set1_ps(-0.0)))))
    }
    #[inline(always)]
    fn all_negative(self) -> bool {
        Self::bits(self) == (1 << LANES) - 1
    }
    #[inline(always)]
    fn largest(self) -> f32 {
        self.values().into_iter().fold(f32::NEG_INFINITY, f32::max)
    }
    #[inline(always)]
    fn add_to(self, sums: Self) -> Self {
        sums.add(self)
    }
    #[inline(always)]
    fn add_to_even_odd(self, [own, other]: [Self; 2]) -> [Self; 2] {
        [own.add(self), other]
    }
    #[inline(always)]
    fn scale(self, rounded: Self) -> Self {
        Avx2(avx2!(_mm256_castsi256_ps(_mm256_add_epi32(
            _mm256_castps_si256(self.0),
            _mm256_slli_epi32::<23>(_mm256_castps_si256(rounded.0)),
        ))))
    }
}

impl Sums for Avx2 {
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.add(other)
    }
    #[inline(always)]
    fn values(self) -> [f32; LANES] {
        let mut values = [[0.0; LANES]];
        self.store(&mut values, 0);
        values[0]
    }
    /// Returns eight totals, each over the eight lanes of one of the `sums`. They are computed together: each addition
    /// halves the number of registers, so eight totals cost little more than two.
    #[inline(always)]
    fn totals(sums: [Self; LANES]) -> [f32; LANES] {
        let halves = |a: Self, b: Self| {
            avx2!(_mm256_add_ps(_mm256_permute2f128_ps::<0x20>(a.0, b.0), _mm256_permute2f128_ps::<0x31>(a.0, b.0)))
        };
        let quarters = |a, b| avx2!(_mm256_add_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)));
        let [a, b, c, d, e, f, g, h] = sums;
        let (ab, cd) = (quarters(halves(a, e), halves(b, f)), quarters(halves(c, g), halves(d, h)));
        // Adds lanes 0 and 1 of `ab` and `cd` to their lanes 2 and 3, in both halves of the registers.
        Avx2(avx2!(_mm256_add_ps(_mm256_shuffle_ps::<0x44>(ab, cd), _mm256_shuffle_ps::<0xee>(ab, cd)))).values()
    }
}
