//! Vectors for blending pixels with AVX-512 registers.

use std::arch::x86_64::*;

use super::avx2::Avx2;
use super::{EvenOddSums, LANES, Lanes};

/// Vector of two groups: sixteen f32 lanes.
#[derive(Clone, Copy)]
pub(in super::super) struct Avx512(__m512);

// SAFETY of every block below: the instructions need AVX-512 F and DQ (VL lets instructions on narrower vectors use all
// registers). `Avx512` is used only by `super::super::blend::BlendKernel::tile`, in a function entered after all of
// them were detected (with AVX2, for `Avx2`). Loads and stores use the unaligned forms, on arrays of exactly two, eight
// or sixteen f32. A prefetched address comes from a reference, and a prefetch reads nothing.
macro_rules! avx512 {
    ($e:expr) => {
        // SAFETY: see the comment above the macro.
        unsafe { $e }
    };
}

impl Lanes for Avx512 {
    type Mask = __mmask16;
    type Sums = Avx2;
    type EvenOddSums = Self;
    const GROUPS: usize = 2;

    #[inline(always)]
    fn prefetch<T>(value: &T) {
        avx512!(_mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()))
    }
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Avx512(avx512!(_mm512_set1_ps(value)))
    }
    #[inline(always)]
    fn repeat(group: &[f32; LANES]) -> Self {
        Avx512(avx512!(_mm512_broadcast_f32x8(_mm256_loadu_ps(group.as_ptr()))))
    }
    #[inline(always)]
    fn splat_each<const N: usize>(values: &[[f32; LANES]; N], first: usize) -> Self {
        let two = &values.as_flattened().as_chunks::<2>().0[first / 2];
        Avx512(avx512!({
            let which = _mm512_setr_epi32(0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1);
            let two = _mm_castsi128_ps(_mm_loadu_si64(two.as_ptr().cast()));
            _mm512_permutexvar_ps(which, _mm512_castps128_ps512(two))
        }))
    }
    #[inline(always)]
    fn load<const N: usize>(from: &[[f32; LANES]; N], first: usize) -> Self {
        let groups = &from.as_chunks::<2>().0[first / 2];
        Avx512(avx512!(_mm512_loadu_ps(groups.as_flattened().as_ptr())))
    }
    #[inline(always)]
    fn store<const N: usize>(self, to: &mut [[f32; LANES]; N], first: usize) {
        let groups = &mut to.as_chunks_mut::<2>().0[first / 2];
        avx512!(_mm512_storeu_ps(groups.as_flattened_mut().as_mut_ptr(), self.0))
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Avx512(avx512!(_mm512_add_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Avx512(avx512!(_mm512_sub_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Avx512(avx512!(_mm512_mul_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Avx512(avx512!(_mm512_fmadd_ps(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        Avx512(avx512!(_mm512_fnmadd_ps(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Avx512(avx512!(_mm512_div_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Avx512(avx512!(_mm512_min_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Avx512(avx512!(_mm512_max_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn at_least(self, other: Self) -> __mmask16 {
        avx512!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, other.0))
    }
    #[inline(always)]
    fn both(a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }
    #[inline(always)]
    fn bits(mask: __mmask16) -> u32 {
        mask.into()
    }
    #[inline(always)]
    fn keep(self, mask: __mmask16) -> Self {
        Avx512(avx512!(_mm512_maskz_mov_ps(mask, self.0)))
    }
    #[inline(always)]
    fn or_else(self, mask: __mmask16, other: Self) -> Self {
        Avx512(avx512!(_mm512_mask_blend_ps(mask, other.0, self.0)))
    }
    #[inline(always)]
    fn negate_where(self, mask: __mmask16) -> Self {
        Avx512(avx512!(_mm512_or_ps(self.0, _mm512_maskz_mov_ps(mask, _mm512_set1_ps(-0.0)))))
    }
    #[inline(always)]
    fn all_negative(self) -> bool {
        avx512!(_mm512_movepi32_mask(_mm512_castps_si512(self.0))) == __mmask16::MAX
    }
    #[inline(always)]
    fn largest(self) -> f32 {
        let [first, second] = self.groups();
        first.max(second).largest()
    }
    #[inline(always)]
    fn add_to(self, sums: Avx2) -> Avx2 {
        let [first, second] = self.groups();
        sums.add(first).add(second)
    }
    #[inline(always)]
    fn add_to_even_odd(self, sums: Self) -> Self {
        sums.add(self)
    }
    #[inline(always)]
    fn scale(self, rounded: Self) -> Self {
        Avx512(avx512!(_mm512_castsi512_ps(_mm512_add_epi32(
            _mm512_castps_si512(self.0),
            _mm512_slli_epi32::<23>(_mm512_castps_si512(rounded.0)),
        ))))
    }
}

impl EvenOddSums for Avx512 {
    type Sums = Avx2;
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }
    #[inline(always)]
    fn swapped(self) -> Self {
        self
    }
    #[inline(always)]
    fn combined(self) -> Avx2 {
        let [even, odd] = self.groups();
        even.add(odd)
    }
}

impl Avx512 {
    /// Returns the two groups of the vector, eight lanes each.
    #[inline(always)]
    fn groups(self) -> [Avx2; 2] {
        avx512!([Avx2(_mm512_castps512_ps256(self.0)), Avx2(_mm512_extractf32x8_ps::<1>(self.0))])
    }
}
