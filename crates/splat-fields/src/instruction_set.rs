//! Instruction sets for which the evaluation of networks is compiled, and the choice of one when the program runs.

use super::linear::CacheLine;
#[cfg(target_arch = "x86_64")]
use splat_core::has_avx512;

/// Instruction set for which an [`Evaluation`] is compiled.
pub(super) trait InstructionSet {
    /// Whether fused multiply-adds are used. On a processor without these instructions, each would be a function call.
    const HAS_FMA: bool;
    /// Whether the processor has 32 registers of 16 values (AVX-512).
    const IS_WIDE: bool;

    /// Adds `x` · `w` to `sum` in every lane.
    #[inline(always)]
    fn add_product(sum: &mut CacheLine, x: &CacheLine, w: f32) {
        for (sum, &x) in sum.0.iter_mut().zip(&x.0) {
            *sum = if Self::HAS_FMA { x.mul_add(w, *sum) } else { x * w + *sum };
        }
    }
}

/// Instructions that every processor has.
pub(super) struct Portable;
/// AVX2 with fused multiply-adds.
#[cfg(target_arch = "x86_64")]
pub(super) struct Avx2;
/// AVX-512. Results have the same bits as those of [`Avx2`].
#[cfg(target_arch = "x86_64")]
pub(super) struct Avx512;

impl InstructionSet for Portable {
    const HAS_FMA: bool = false;
    const IS_WIDE: bool = false;
}

#[cfg(target_arch = "x86_64")]
impl InstructionSet for Avx2 {
    const HAS_FMA: bool = true;
    const IS_WIDE: bool = false;
}

#[cfg(target_arch = "x86_64")]
impl InstructionSet for Avx512 {
    const HAS_FMA: bool = true;
    const IS_WIDE: bool = true;

    #[inline(always)]
    fn add_product(sum: &mut CacheLine, x: &CacheLine, w: f32) {
        use std::arch::x86_64::{_mm512_fmadd_ps, _mm512_load_ps, _mm512_set1_ps, _mm512_store_ps};
        // SAFETY: code for this instruction set runs only after AVX-512 was detected. A `CacheLine` holds 16 values and
        // is aligned to 64 bytes.
        unsafe {
            let next = _mm512_fmadd_ps(_mm512_load_ps(x.0.as_ptr()), _mm512_set1_ps(w), _mm512_load_ps(sum.0.as_ptr()));
            _mm512_store_ps(sum.0.as_mut_ptr(), next);
        }
    }
}

/// Computation that is compiled once per instruction set.
pub(super) trait Evaluation {
    /// Runs the computation. Implementations must be `#[inline(always)]`, as all functions with long loops that they
    /// call: only inlined code is compiled for the instruction set of its caller.
    fn run<S: InstructionSet>(self);
}

/// Runs `evaluation` with the best instruction set of this processor.
pub(super) fn run_on_best<E: Evaluation>(evaluation: E) {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2,fma,avx512f,avx512dq,avx512vl")]
        fn run_avx512<E: Evaluation>(evaluation: E) {
            evaluation.run::<Avx512>();
        }
        #[target_feature(enable = "avx2,fma")]
        fn run_avx2<E: Evaluation>(evaluation: E) {
            evaluation.run::<Avx2>();
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            if has_avx512() {
                // SAFETY: the processor has all features of the function, as the conditions above checked.
                return unsafe { run_avx512(evaluation) };
            }
            // SAFETY: the processor has AVX2 and FMA, as the condition above checked.
            return unsafe { run_avx2(evaluation) };
        }
    }
    evaluation.run::<Portable>();
}
