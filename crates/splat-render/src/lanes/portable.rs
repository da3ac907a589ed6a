//! Vectors for blending pixels on every machine, without intrinsics.

use super::{LANES, Lanes, Sums};

/// Vector of one group: eight f32 lanes.
#[derive(Clone, Copy)]
pub(in super::super) struct Portable([f32; LANES]);

impl Portable {
    /// Returns the vector of `f` applied to each lane of `self` and the same lane of `other`.
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Portable(std::array::from_fn(|l| f(self.0[l], other.0[l])))
    }
}

impl Lanes for Portable {
    type Mask = [bool; LANES];
    type Sums = Self;
    type EvenOddSums = [Self; 2];
    const GROUPS: usize = 1;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Portable([value; LANES])
    }
    #[inline(always)]
    fn repeat(group: &[f32; LANES]) -> Self {
        Portable(*group)
    }
    #[inline(always)]
    fn splat_each<const N: usize>(values: &[[f32; LANES]; N], first: usize) -> Self {
        Self::splat(values.as_flattened()[first])
    }
    #[inline(always)]
    fn load<const N: usize>(from: &[[f32; LANES]; N], first: usize) -> Self {
        Portable(from[first])
    }
    #[inline(always)]
    fn store<const N: usize>(self, to: &mut [[f32; LANES]; N], first: usize) {
        to[first] = self.0;
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Portable(std::array::from_fn(|l| mul_add(self.0[l], factor.0[l], term.0[l])))
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        Portable(self.0.map(|value| -value)).mul_add(factor, term)
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn at_least(self, other: Self) -> [bool; LANES] {
        std::array::from_fn(|l| self.0[l] >= other.0[l])
    }
    #[inline(always)]
    fn both(a: [bool; LANES], b: [bool; LANES]) -> [bool; LANES] {
        std::array::from_fn(|l| a[l] && b[l])
    }
    #[inline(always)]
    fn bits(mask: [bool; LANES]) -> u32 {
        (0..LANES).map(|l| u32::from(mask[l]) << l).sum()
    }
    #[inline(always)]
    fn keep(self, mask: [bool; LANES]) -> Self {
        self.or_else(mask, Self::splat(0.0))
    }
    #[inline(always)]
    fn or_else(self, mask: [bool; LANES], other: Self) -> Self {
        Portable(std::array::from_fn(|l| if mask[l] { self.0[l] } else { other.0[l] }))
    }
    #[inline(always)]
    fn negate_where(self, mask: [bool; LANES]) -> Self {
        Portable(self.0.map(|value| -value.abs())).or_else(mask, self)
    }
    #[inline(always)]
    fn all_negative(self) -> bool {
        self.0.iter().all(|value| value.is_sign_negative())
    }
    #[inline(always)]
    fn largest(self) -> f32 {
        self.0.into_iter().fold(f32::NEG_INFINITY, f32::max)
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
        self.zip(rounded, |value, n| f32::from_bits(value.to_bits().wrapping_add(n.to_bits() << 23)))
    }
}

/// Returns `a · b + c`, rounded once, like [`f32::mul_add`], which is a slow function call on processors without fused
/// multiply-adds.
///
/// The product of two f32 is exact in f64. If the sum is not, it is rounded to an odd last bit instead of to the nearest
/// value, so that rounding it again, to f32, gives the same result as rounding the exact sum (Boldo and Melquiond,
/// "Emulation of FMA and correctly rounded sums: proved algorithms using rounding to odd", 2008).
#[inline(always)]
fn mul_add(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
        return a.mul_add(b, c);
    }
    let (product, c) = (f64::from(a) * f64::from(b), f64::from(c));
    let sum = product + c;
    // Exact sum minus `sum` (Knuth's two-sum).
    let added = sum - product;
    let error = (product - (sum - added)) + (c - added);
    let bits = sum.to_bits();
    let odd = if (error > 0.0) == (sum > 0.0) { bits | 1 } else { (bits - 1) | 1 };
    // False for a NaN, too: then the sum is not finite.
    (if error.abs() > 0.0 { f64::from_bits(odd) } else { sum }) as f32
}

impl Sums for Portable {
    #[inline(always)]
    fn zero() -> Self {
        Portable([0.0; LANES])
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.add(other)
    }
    #[inline(always)]
    fn values(self) -> [f32; LANES] {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::mul_add;
    use splat_core::hash_id;

    #[test]
    fn mul_add_matches_the_standard_library() {
        let mut hashes = (0..).map(hash_id);
        let mut inexact = 0;
        for round in 0..400_000 {
            // Any bits, among them NaN and infinity, or values of similar size, whose sums cancel.
            let mut value = || {
                let bits = hashes.next().unwrap() as u32;
                f32::from_bits(if round % 2 == 0 { bits } else { 0x3f00_0000 | bits >> 7 })
            };
            let (a, b, mut c) = (value(), value(), value());
            if round % 3 == 0 {
                c = -a * b;
            }
            let (found, expected) = (mul_add(a, b, c), a.mul_add(b, c));
            assert!(found.to_bits() == expected.to_bits() || found.is_nan() && expected.is_nan(), "{a} · {b} + {c}");
            inexact += usize::from(found != a * b + c);
        }
        assert!(inexact > 10_000, "{inexact} results differ from unfused ones");
    }
}
