//! Vectors of f32 in groups of eight: the arithmetic of the blend for AVX-512, AVX2 and all other machines.
//!
//! All implementations give the same bits. Every operation is a single IEEE operation. No multiply-add is fused: fused
//! ones would make renders depend on the machine, and their software form is slow without hardware support. An AVX-512
//! vector has two groups. Its groups are added to sums one after the other, like those of two narrower vectors.
//! Alternatively each group is added to its own sums ([`EvenOddSums`]), like narrower vectors in two passes.

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

/// Number of lanes of one group.
pub(super) const LANES: usize = 8;

/// Values aligned to a cache line, so that no vector of them spans two lines.
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

/// Rounding constant 1.5 · 2²³: a sum with it rounds an f32 of magnitude below 2²² to an integer in the low bits.
const ROUND: f32 = 12_582_912.0;

/// Coefficients of 2^f = 1 + f·(c₁ + f·(c₂ + …)) on |f| ≤ ½: minimax approximation of the relative error, 4e-9 before
/// rounding.
const EXP2: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_48, 0.055_503_324, 0.009_618_437, 0.001_339_887_5, 0.000_153_533_62];

/// Vector of one or more groups of eight f32 values.
///
/// A type of this trait may be used only if the machine has its instructions. Only `super::blend` chooses one, after
/// detection.
pub(super) trait Lanes: Copy {
    /// One truth value per lane.
    type Mask: Copy;
    /// Sums of one group.
    type Sums: Sums;
    /// Sums of two groups: of the groups with even index, and of those with odd index.
    type EvenOddSums: EvenOddSums<Sums = Self::Sums>;
    /// Number of groups in a vector; a power of two.
    const GROUPS: usize;

    /// Tells the processor that the value will be read soon.
    #[inline(always)]
    fn prefetch<T>(_: &T) {}
    /// Returns a vector with `value` in every lane.
    fn splat(value: f32) -> Self;
    /// Returns a vector with these eight values in every group.
    fn repeat(group: &[f32; LANES]) -> Self;
    /// Returns a vector whose group k has value `first + k` in all of its lanes. `first` is a multiple of
    /// [`Lanes::GROUPS`].
    fn splat_each<const N: usize>(values: &[[f32; LANES]; N], first: usize) -> Self;
    /// Loads the groups from `first` on. `first` is a multiple of [`Lanes::GROUPS`].
    fn load<const N: usize>(from: &[[f32; LANES]; N], first: usize) -> Self;
    /// Stores the groups from `first` on. `first` is a multiple of [`Lanes::GROUPS`].
    fn store<const N: usize>(self, to: &mut [[f32; LANES]; N], first: usize);
    /// Returns the sum.
    fn add(self, other: Self) -> Self;
    /// Returns the difference.
    fn sub(self, other: Self) -> Self;
    /// Returns the product.
    fn mul(self, other: Self) -> Self;
    /// Returns the quotient.
    fn div(self, other: Self) -> Self;
    /// Returns the smaller value; `other` if either is NaN.
    fn min(self, other: Self) -> Self;
    /// Returns the larger value; `other` if either is NaN.
    fn max(self, other: Self) -> Self;
    /// Returns the mask of `self ≥ other`; false for NaN.
    fn at_least(self, other: Self) -> Self::Mask;
    /// Returns the intersection of two masks.
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Returns the mask as bits, one per lane.
    fn bits(mask: Self::Mask) -> u32;
    /// Returns `self` where the mask is set, else 0.
    fn keep(self, mask: Self::Mask) -> Self;
    /// Returns `self` where the mask is set, else `other`.
    fn or_else(self, mask: Self::Mask, other: Self) -> Self;
    /// Returns `self` with the sign bit set where the mask is set.
    fn negate_where(self, mask: Self::Mask) -> Self;
    /// Returns whether the sign bit of every lane is set.
    fn all_negative(self) -> bool;
    /// Returns the largest lane. No lane may be NaN.
    fn largest(self) -> f32;
    /// Adds each group in turn to `sums`.
    fn add_to(self, sums: Self::Sums) -> Self::Sums;
    /// Adds each group to its own sums. A vector of one group is added to the first sums.
    fn add_to_even_odd(self, sums: Self::EvenOddSums) -> Self::EvenOddSums;
    /// Returns `self · 2ⁿ`, where the low bits of `rounded` hold n, as after adding [`ROUND`].
    fn scale(self, rounded: Self) -> Self;

    /// Computes 2^self for `self ≤ 0`. The relative error is below 1.6e-7 down to 2⁻¹²⁶; smaller results stay at or
    /// below 2⁻¹²⁶.
    #[inline(always)]
    fn exp2(self) -> Self {
        let power = self.max(Self::splat(-126.0));
        let rounded = power.add(Self::splat(ROUND));
        let f = power.sub(rounded.sub(Self::splat(ROUND)));
        // Estrin's scheme has half the latency of Horner's, which is critical for the blend.
        let pair = |k: usize| Self::splat(EXP2[k + 1]).mul(f).add(Self::splat(EXP2[k]));
        let square = f.mul(f);
        let low = pair(0).add(square.mul(pair(2)));
        let sum = low.add(square.mul(square).mul(pair(4)));
        sum.mul(f).add(Self::splat(1.0)).scale(rounded)
    }
}

/// Sums of the groups with even index and of those with odd index.
///
/// Two separate sums halve the number of dependent additions: the two groups of a vector never wait for each other. A
/// vector of one group is always added to the first sums. The two sums are swapped after all groups with even index.
pub(super) trait EvenOddSums: Copy {
    type Sums: Sums;
    /// Returns sums of 0.
    fn zero() -> Self;
    /// Returns the sums in swapped order if vectors have one group, else unchanged.
    fn swapped(self) -> Self;
    /// Returns the sum of both.
    fn combined(self) -> Self::Sums;
}

/// Sums for vectors of one group. They are swapped after the even and after the odd groups.
impl<V: Sums> EvenOddSums for [V; 2] {
    type Sums = V;
    #[inline(always)]
    fn zero() -> Self {
        [V::zero(); 2]
    }
    #[inline(always)]
    fn swapped(self) -> Self {
        [self[1], self[0]]
    }
    #[inline(always)]
    fn combined(self) -> V {
        self[0].plus(self[1])
    }
}

/// Sums in eight lanes.
pub(super) trait Sums: Copy {
    /// Returns sums of 0.
    fn zero() -> Self;
    /// Returns the lane-wise sum.
    fn plus(self, other: Self) -> Self;
    /// Returns the eight sums.
    fn values(self) -> [f32; LANES];

    /// Returns the sum of all lanes, added in a fixed order.
    #[inline(always)]
    fn total(self) -> f32 {
        let x = self.values();
        ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
    }

    /// Returns [`Sums::total`] of eight sums.
    #[inline(always)]
    fn totals(sums: [Self; LANES]) -> [f32; LANES] {
        sums.map(Self::total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_has_relative_error_below_1_6e_7() {
        let mut worst = 0.0f64;
        for step in 0..2_000_000 {
            let power = -(step as f32) * 1e-5;
            let got = Portable::splat(power).exp2().largest();
            worst = worst.max((f64::from(got) / f64::from(power).exp2() - 1.0).abs());
        }
        assert!(worst < 1.6e-7, "relative error {worst:e} over [-20, 0], expected below 1.6e-7");
    }

    #[test]
    fn exp2_of_very_negative_numbers_is_tiny_and_nonnegative() {
        for power in [-126.0, -127.3, -1e9, f32::NEG_INFINITY] {
            let got = Portable::splat(power).exp2().largest();
            assert!((0.0..=f32::MIN_POSITIVE).contains(&got), "2^{power} gave {got}");
        }
    }
}
