//! Vectors of f32 for blending pixels, with implementations for AVX-512, AVX2 and all other machines. A vector consists
//! of groups of eight lanes, one pixel per lane.
//!
//! All implementations give the same bits, because every operation is a single IEEE operation. Some of them are fused
//! multiply-adds, which shorten the chain of operations that blending waits for. A processor without these instructions
//! (x86-64 before 2013) computes them in f64, about ten times slower.
//!
//! An AVX-512 vector has two groups, a vector of the other implementations has one. Groups are added lane by lane, so a
//! sum of groups has eight values. There are two kinds of sums. Each has the same result on all machines, because its
//! additions are made in the same order:
//! - [`Sums`]: one sum, to which all groups are added one after the other;
//! - [`EvenOddSums`]: two sums, one of the groups with even index and one of the groups with odd index.

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

/// Number of lanes (pixels) of one group.
pub(super) const LANES: usize = 8;

/// Wrapper that aligns values to a cache line, so that no vector of them spans two lines.
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

/// Rounding constant 1.5 · 2²³. Adding it to an f32 of magnitude below 2²² rounds the number to an integer, which the
/// low bits of the sum then hold.
const ROUND: f32 = 12_582_912.0;

/// Coefficients c₁, c₂, … of 2^f = 1 + f·(c₁ + f·(c₂ + …)) for |f| ≤ ½. Minimax approximation with a relative error of
/// 4e-9 before rounding.
const EXP2: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_48, 0.055_503_324, 0.009_618_437, 0.001_339_887_5, 0.000_153_533_62];

/// Vector of f32 values: one or more groups of eight lanes.
///
/// A type that implements this trait may be used only on a machine with its instructions. `super::blend` alone chooses
/// the type, after it has detected them.
pub(super) trait Lanes: Copy {
    /// Mask: one truth value per lane.
    type Mask: Copy;
    /// Type of the sum of several groups of eight lanes. Groups are added lane by lane, so the sum has eight values:
    /// value k is the sum of lane k of all groups.
    type Sums: Sums;
    /// Type of two sums of groups of eight lanes. Groups with even index are added to the first sum, groups with odd
    /// index to the second. Groups are added lane by lane, so each of the two sums has eight values.
    type EvenOddSums: EvenOddSums<Sums = Self::Sums>;
    /// Number of groups of eight lanes in a vector; a power of two.
    const GROUPS: usize;

    /// Tells the processor to load the given value into its cache, because it will be read soon.
    #[inline(always)]
    fn prefetch<T>(_: &T) {}
    /// Returns a vector with `value` in every lane.
    fn splat(value: f32) -> Self;
    /// Returns a vector in which every group has the eight values of `group`.
    fn repeat(group: &[f32; LANES]) -> Self;
    /// Returns a vector that has a different value in each group: all lanes of group k hold
    /// `values.as_flattened()[first + k]`. `first` is a multiple of [`Lanes::GROUPS`].
    fn splat_each<const N: usize>(values: &[[f32; LANES]; N], first: usize) -> Self;
    /// Loads a vector from [`Lanes::GROUPS`] consecutive groups of `from`, an array of groups of eight values. `first`
    /// is the index of the first of these groups, a multiple of [`Lanes::GROUPS`].
    fn load<const N: usize>(from: &[[f32; LANES]; N], first: usize) -> Self;
    /// Stores the vector to [`Lanes::GROUPS`] consecutive groups of `to`, an array of groups of eight values. `first`
    /// is the index of the first of these groups, a multiple of [`Lanes::GROUPS`].
    fn store<const N: usize>(self, to: &mut [[f32; LANES]; N], first: usize);
    /// Returns the sum `self + other` in each lane.
    fn add(self, other: Self) -> Self;
    /// Returns the difference `self − other` in each lane.
    fn sub(self, other: Self) -> Self;
    /// Returns the product `self · other` in each lane.
    fn mul(self, other: Self) -> Self;
    /// Returns `self · factor + term` in each lane, rounded once.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// Returns `term − self · factor` in each lane, rounded once.
    fn neg_mul_add(self, factor: Self, term: Self) -> Self;
    /// Returns the quotient `self / other` in each lane.
    fn div(self, other: Self) -> Self;
    /// Returns the smaller of the values of `self` and `other` in each lane; the value of `other` if either is NaN.
    fn min(self, other: Self) -> Self;
    /// Returns the larger of the values of `self` and `other` in each lane; the value of `other` if either is NaN.
    fn max(self, other: Self) -> Self;
    /// Returns the mask of the lanes with `self ≥ other`, which is false for NaN.
    fn at_least(self, other: Self) -> Self::Mask;
    /// Returns the mask that is set in the lanes in which both `a` and `b` are set.
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Returns `mask` as an integer with one bit per lane.
    fn bits(mask: Self::Mask) -> u32;
    /// Returns a vector with the lanes of `self` where `mask` is set, and 0 elsewhere.
    fn keep(self, mask: Self::Mask) -> Self;
    /// Returns a vector with the lanes of `self` where `mask` is set, and the lanes of `other` elsewhere.
    fn or_else(self, mask: Self::Mask, other: Self) -> Self;
    /// Returns `self` with the sign bit set to 1 in the lanes where `mask` is set.
    fn negate_where(self, mask: Self::Mask) -> Self;
    /// Returns whether the sign bit is set in every lane.
    fn all_negative(self) -> bool;
    /// Returns the largest value of all lanes. No lane may be NaN.
    fn largest(self) -> f32;
    /// Adds each group of the vector to `sums` lane by lane, one group after the other, and returns the result.
    fn add_to(self, sums: Self::Sums) -> Self::Sums;
    /// Adds the groups of the vector to `sums`, the groups with even index to one of the two sums and the groups with
    /// odd index to the other. Returns the new sums. A vector of one group is always added to the first sum; see
    /// [`EvenOddSums`].
    fn add_to_even_odd(self, sums: Self::EvenOddSums) -> Self::EvenOddSums;
    /// Returns `self · 2ⁿ` in each lane, for an integer n per lane. The same lane of `rounded` holds n + [`ROUND`], a
    /// number whose low bits are n.
    fn scale(self, rounded: Self) -> Self;

    /// Computes 2^x of each lane x ≤ 0. The relative error is below 1.6e-7 down to 2⁻¹²⁶; for smaller x, the result is
    /// at most 2⁻¹²⁶.
    #[inline(always)]
    fn exp2(self) -> Self {
        let power = self.max(Self::splat(-126.0));
        let rounded = power.add(Self::splat(ROUND));
        let f = power.sub(rounded.sub(Self::splat(ROUND)));
        // The polynomial is evaluated by Estrin's scheme, which has half the latency of Horner's; blending waits for
        // it.
        let pair = |k: usize| Self::splat(EXP2[k + 1]).mul_add(f, Self::splat(EXP2[k]));
        let square = f.mul(f);
        let low = square.mul_add(pair(2), pair(0));
        let sum = square.mul(square).mul_add(pair(4), low);
        sum.mul_add(f, Self::splat(1.0)).scale(rounded)
    }
}

/// Two sums of groups of eight lanes: one over the groups with even index, one over the groups with odd index. Groups
/// are added lane by lane, so each of the two sums has eight values.
///
/// How a vector is added ([`Lanes::add_to_even_odd`]) depends on its number of groups:
/// - Two groups (AVX-512): one group is added to each of the two sums, so that neither addition waits for the other.
/// - One group: it is added to the first of the two sums. The caller first adds all groups with even index, swaps the
///   two sums ([`EvenOddSums::swapped`]), adds all groups with odd index, and swaps them again.
pub(super) trait EvenOddSums: Copy {
    type Sums: Sums;
    /// Returns sums that are all 0.
    fn zero() -> Self;
    /// Returns the two sums in swapped order if a vector has one group, so that the next groups are added to the other
    /// sum. Returns them unchanged if a vector has two groups, which are added to both sums at once.
    fn swapped(self) -> Self;
    /// Returns the even sum plus the odd sum in each lane.
    fn combined(self) -> Self::Sums;
}

/// Two sums for vectors of one group, which are always added to the first entry. The caller swaps the entries after all
/// groups with even index, and again after all groups with odd index, so each entry sums one kind of groups.
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

/// Eight sums, one per SIMD lane: sum k is the total of lane k over all groups of eight values that were added.
pub(super) trait Sums: Copy {
    /// Returns sums that are all 0.
    fn zero() -> Self;
    /// Returns the sum of `self` and `other` in each lane.
    fn plus(self, other: Self) -> Self;
    /// Returns the eight sums, one for each lane, without adding them to one another.
    fn values(self) -> [f32; LANES];

    /// Returns the total of the eight lanes, added in a fixed order.
    #[inline(always)]
    fn total(self) -> f32 {
        let x = self.values();
        ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
    }

    /// Returns the [`Sums::total`] of each of eight `sums`.
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
