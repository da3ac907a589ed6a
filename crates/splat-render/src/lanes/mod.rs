//! Groups of eight f32 side by side: the arithmetic of the blend, once for AVX-512, once for AVX2 and once for every
//! other machine.
//!
//! All give the same bits: every operation is a single IEEE one, and no multiply-add is fused, because
//! a fused one would make pictures depend on the machine (and its software form is slow where the
//! hardware has none). The two groups of an AVX-512 vector are added to sums one after the other, as those of two
//! narrower vectors are, or each to its own ([`Twins`]), as narrower vectors are in two goes.

mod portable;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;

use std::ops::{Deref, DerefMut};

#[cfg(target_arch = "x86_64")]
pub(super) use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub(super) use avx512::Avx512;
pub(super) use portable::Portable;

/// Lanes of one group.
pub(super) const LANES: usize = 8;

/// Values that begin with a line of the cache, so that no vector of them lies in two.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(64))]
pub(super) struct Aligned<T>(pub(super) T);

impl<T> Deref for Aligned<T> {
    type Target = T;
    #[inline(always)]
    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> DerefMut for Aligned<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut T {
        &mut self.0
    }
}

/// 1.5 · 2²³: adding it rounds an f32 of magnitude below 2²² to an integer kept in the low bits.
const ROUND: f32 = 12_582_912.0;

/// 2^f = 1 + f·(c₁ + f·(c₂ + …)) on |f| ≤ ½: minimax of relative error, 4e-9 before rounding.
const EXP2: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_48, 0.055_503_324, 0.009_618_437, 0.001_339_887_5, 0.000_153_533_62];

/// One or more groups of eight f32 values.
///
/// A type of this trait may be used only where its instructions exist; `super::blend` is the one place
/// that chooses, after detection.
pub(super) trait Lanes: Copy {
    /// One truth value per lane.
    type Mask: Copy;
    /// Sums of one group.
    type Sums: Sums;
    /// Sums of two groups, those at even and those at odd places.
    type Twins: Twins<Sums = Self::Sums>;
    /// Groups in one vector; a power of two.
    const GROUPS: usize;

    /// A hint that it will soon be read.
    #[inline(always)]
    fn fetch<T>(_: &T) {}
    fn splat(value: f32) -> Self;
    /// The same eight values in every group.
    fn repeat(group: &[f32; LANES]) -> Self;
    /// To each group one value, the first of them at place `first` among all, a multiple of [`Lanes::GROUPS`].
    fn spread<const N: usize>(values: &[[f32; LANES]; N], first: usize) -> Self;
    /// Groups `first` and those after it, a multiple of [`Lanes::GROUPS`].
    fn load<const N: usize>(from: &[[f32; LANES]; N], first: usize) -> Self;
    fn store<const N: usize>(self, to: &mut [[f32; LANES]; N], first: usize);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    /// `other` where either is NaN.
    fn min(self, other: Self) -> Self;
    /// `other` where either is NaN.
    fn max(self, other: Self) -> Self;
    /// Mask of `self ≥ other`; false for NaN.
    fn at_least(self, other: Self) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// One bit per lane.
    fn bits(mask: Self::Mask) -> u32;
    /// `self` where the mask is set, else 0.
    fn keep(self, mask: Self::Mask) -> Self;
    /// `self` where the mask is set, else `other`.
    fn or_else(self, mask: Self::Mask, other: Self) -> Self;
    /// `self`, made negative where the mask is set.
    fn negative(self, mask: Self::Mask) -> Self;
    /// Whether the sign of every lane is set.
    fn all_negative(self) -> bool;
    /// Largest of all lanes, which are no NaN.
    fn largest(self) -> f32;
    /// `sums` with each group added in turn.
    fn add_to(self, sums: Self::Sums) -> Self::Sums;
    /// `sums` with each group added to its own, one alone to the first.
    fn add_to_own(self, sums: Self::Twins) -> Self::Twins;
    /// `self · 2ⁿ` with n the low bits of `rounded`, as left there by adding [`ROUND`].
    fn scale(self, rounded: Self) -> Self;

    /// 2^self for `self ≤ 0`; relative error below 1.6e-7 down to 2⁻¹²⁶, where it stays below.
    #[inline(always)]
    fn exp2(self) -> Self {
        let power = self.max(Self::splat(-126.0));
        let rounded = power.add(Self::splat(ROUND));
        let f = power.sub(rounded.sub(Self::splat(ROUND)));
        // Estrin's pairing: half the latency of Horner's, which the blend waits for.
        let pair = |k: usize| Self::splat(EXP2[k + 1]).mul(f).add(Self::splat(EXP2[k]));
        let square = f.mul(f);
        let low = pair(0).add(square.mul(pair(2)));
        let sum = low.add(square.mul(square).mul(pair(4)));
        sum.mul(f).add(Self::splat(1.0)).scale(rounded)
    }
}

/// Sums of two groups, each of its own: half the additions, of which none waits for another of the same vector.
///
/// Vectors of one group are added to the first of both, and the two change places when all of the even ones are.
pub(super) trait Twins: Copy {
    type Sums: Sums;
    fn zero() -> Self;
    /// With the two in each other's place, where vectors are of one group.
    fn turned(self) -> Self;
    /// The sums of the odd added to those of the even.
    fn together(self) -> Self::Sums;
}

/// Of vectors of one group, turned as often as added to.
impl<V: Sums> Twins for [V; 2] {
    type Sums = V;
    #[inline(always)]
    fn zero() -> Self {
        [V::zero(); 2]
    }
    #[inline(always)]
    fn turned(self) -> Self {
        [self[1], self[0]]
    }
    #[inline(always)]
    fn together(self) -> V {
        self[0].and(self[1])
    }
}

/// Eight sums side by side.
pub(super) trait Sums: Copy {
    fn zero() -> Self;
    fn and(self, other: Self) -> Self;
    fn values(self) -> [f32; LANES];

    /// Sum of all, in a fixed order.
    #[inline(always)]
    fn total(self) -> f32 {
        let x = self.values();
        ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
    }

    /// [`Sums::total`] of each.
    #[inline(always)]
    fn totals(of: [Self; LANES]) -> [f32; LANES] {
        of.map(Self::total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_is_within_three_roundings_of_the_truth() {
        let mut worst = 0.0f64;
        for step in 0..2_000_000 {
            let power = -(step as f32) * 1e-5;
            let got = Portable::splat(power).exp2().largest();
            worst = worst.max((f64::from(got) / f64::from(power).exp2() - 1.0).abs());
        }
        assert!(worst < 1.6e-7, "relative error {worst:e} over [-20, 0], expected below 1.6e-7");
    }

    #[test]
    fn exp2_far_below_stays_tiny_and_nonnegative() {
        for power in [-126.0, -127.3, -1e9, f32::NEG_INFINITY] {
            let got = Portable::splat(power).exp2().largest();
            assert!((0.0..=f32::MIN_POSITIVE).contains(&got), "2^{power} gave {got}");
        }
    }
}
