//! Eight f32 side by side: the arithmetic of the blend, once for AVX2 and once for every other machine.
//!
//! Both give the same bits: every operation is a single IEEE one, and no multiply-add is fused, because
//! a fused one would make pictures depend on the machine (and its software form is slow where the
//! hardware has none).

/// Lanes of one vector.
pub(super) const LANES: usize = 8;

/// 1.5 · 2²³: adding it rounds an f32 of magnitude below 2²² to an integer kept in the low bits.
const ROUND: f32 = 12_582_912.0;

/// 2^f = 1 + f·(c₁ + f·(c₂ + …)) on |f| ≤ ½: minimax of relative error, 4e-9 before rounding.
const EXP2: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_48, 0.055_503_324, 0.009_618_437, 0.001_339_887_5, 0.000_153_533_62];

/// Eight f32 values, or eight masks of all or no bits.
///
/// A type of this trait may be used only where its instructions exist; `super::blend` is the one place
/// that chooses, after detection.
pub(super) trait Lanes: Copy {
    fn splat(value: f32) -> Self;
    fn load(from: &[f32; LANES]) -> Self;
    fn store(self, to: &mut [f32; LANES]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    /// `other` where either is NaN.
    fn min(self, other: Self) -> Self;
    /// `other` where either is NaN.
    fn max(self, other: Self) -> Self;
    /// Mask of `self ≥ other`; false for NaN.
    fn at_least(self, other: Self) -> Self;
    /// Bitwise and.
    fn and(self, other: Self) -> Self;
    /// Bitwise or.
    fn or(self, other: Self) -> Self;
    /// `yes` where the mask `self` is set, else `no`.
    fn select(self, yes: Self, no: Self) -> Self;
    /// One bit per lane: its sign (for a mask: whether it is set).
    fn signs(self) -> u32;
    /// Sums of all lanes of each, as [`Lanes::sum`] of each.
    fn sums(of: [Self; LANES]) -> [f32; LANES] {
        of.map(Self::sum)
    }
    /// `self · 2ⁿ` with n the low bits of `rounded`, as left there by adding [`ROUND`].
    fn scale_exponent(self, rounded: Self) -> Self;

    /// Sum of all lanes, in a fixed order.
    #[inline(always)]
    fn sum(self) -> f32 {
        let mut x = [0.0; LANES];
        self.store(&mut x);
        ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
    }

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
        sum.mul(f).add(Self::splat(1.0)).scale_exponent(rounded)
    }
}

/// The form every machine understands.
#[derive(Clone, Copy)]
pub(super) struct Portable([f32; LANES]);

impl Portable {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Portable(std::array::from_fn(|l| f(self.0[l], other.0[l])))
    }

    #[inline(always)]
    fn zip_bits(self, other: Self, f: impl Fn(u32, u32) -> u32) -> Self {
        self.zip(other, |a, b| f32::from_bits(f(a.to_bits(), b.to_bits())))
    }
}

impl Lanes for Portable {
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Portable([value; LANES])
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        Portable(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        *to = self.0;
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
    fn at_least(self, other: Self) -> Self {
        self.zip(other, |a, b| f32::from_bits(if a >= b { u32::MAX } else { 0 }))
    }
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        self.zip_bits(other, |a, b| a & b)
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        self.zip_bits(other, |a, b| a | b)
    }
    #[inline(always)]
    fn select(self, yes: Self, no: Self) -> Self {
        Portable(std::array::from_fn(|l| if self.0[l].to_bits() >> 31 == 1 { yes.0[l] } else { no.0[l] }))
    }
    #[inline(always)]
    fn signs(self) -> u32 {
        (0..LANES).map(|l| (self.0[l].to_bits() >> 31) << l).sum()
    }
    #[inline(always)]
    fn scale_exponent(self, rounded: Self) -> Self {
        self.zip_bits(rounded, |value, n| value.wrapping_add(n << 23))
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use avx2::Avx2;

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::{LANES, Lanes};

    /// One AVX2 register.
    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx2(__m256);

    // SAFETY of every block below: the instructions need AVX2 (AVX for most), and `Avx2` is named only by
    // `super::super::blend::Blend::tile`, inside a function entered after `is_x86_feature_detected!("avx2")`.
    // Loads and stores are the unaligned forms, over arrays of exactly eight f32.
    macro_rules! avx2 {
        ($e:expr) => {
            // SAFETY: as said above the macro.
            unsafe { $e }
        };
    }

    impl Lanes for Avx2 {
        #[inline(always)]
        fn splat(value: f32) -> Self {
            Avx2(avx2!(_mm256_set1_ps(value)))
        }
        #[inline(always)]
        fn load(from: &[f32; LANES]) -> Self {
            Avx2(avx2!(_mm256_loadu_ps(from.as_ptr())))
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; LANES]) {
            avx2!(_mm256_storeu_ps(to.as_mut_ptr(), self.0))
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
        fn and(self, other: Self) -> Self {
            Avx2(avx2!(_mm256_and_ps(self.0, other.0)))
        }
        #[inline(always)]
        fn or(self, other: Self) -> Self {
            Avx2(avx2!(_mm256_or_ps(self.0, other.0)))
        }
        #[inline(always)]
        fn select(self, yes: Self, no: Self) -> Self {
            Avx2(avx2!(_mm256_blendv_ps(no.0, yes.0, self.0)))
        }
        #[inline(always)]
        fn signs(self) -> u32 {
            avx2!(_mm256_movemask_ps(self.0)) as u32
        }
        /// Halves the number of registers with each addition, so that eight sums cost little more than two.
        #[inline(always)]
        fn sums(of: [Self; LANES]) -> [f32; LANES] {
            let halves = |a: Self, b: Self| {
                avx2!(_mm256_add_ps(_mm256_permute2f128_ps::<0x20>(a.0, b.0), _mm256_permute2f128_ps::<0x31>(a.0, b.0)))
            };
            let quarters = |a, b| avx2!(_mm256_add_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)));
            let [a, b, c, d, e, f, g, h] = of;
            let (ab, cd) = (quarters(halves(a, e), halves(b, f)), quarters(halves(c, g), halves(d, h)));
            // Pairs of lanes (a, b) and (c, d) of the first sums, then of the second.
            let sums = avx2!(_mm256_add_ps(_mm256_shuffle_ps::<0x44>(ab, cd), _mm256_shuffle_ps::<0xee>(ab, cd)));
            let mut out = [0.0; LANES];
            Avx2(sums).store(&mut out);
            out
        }
        #[inline(always)]
        fn scale_exponent(self, rounded: Self) -> Self {
            Avx2(avx2!(_mm256_castsi256_ps(_mm256_add_epi32(
                _mm256_castps_si256(self.0),
                _mm256_slli_epi32::<23>(_mm256_castps_si256(rounded.0)),
            ))))
        }
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
            let mut got = [0.0; LANES];
            Portable::splat(power).exp2().store(&mut got);
            worst = worst.max((f64::from(got[0]) / f64::from(power).exp2() - 1.0).abs());
        }
        assert!(worst < 1.6e-7, "relative error {worst:e} over [-20, 0], expected below 1.6e-7");
    }

    #[test]
    fn exp2_far_below_stays_tiny_and_nonnegative() {
        for power in [-126.0, -127.3, -1e9, f32::NEG_INFINITY] {
            let mut got = [0.0; LANES];
            Portable::splat(power).exp2().store(&mut got);
            assert!((0.0..=f32::MIN_POSITIVE).contains(&got[0]), "2^{power} gave {}", got[0]);
        }
    }
}
