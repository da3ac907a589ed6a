//! Compilation of loops for the vector instructions of the processor on which the program runs.

/// Returns whether the processor has the parts F, DQ and VL of AVX-512, which this project uses together.
#[cfg(target_arch = "x86_64")]
pub fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq") && is_x86_feature_detected!("avx512vl")
}

/// Runs `job`, compiled for AVX-512 or AVX2 if the processor has them, so that its loops process up to 16 values at a
/// time. The result has the same bits with every instruction set, because operations are neither fused nor reordered.
///
/// Only inlined code is compiled anew: `job` must be a closure with `#[inline(always)]`, and the functions with loops
/// that it calls must have this attribute, too.
#[inline(always)]
pub fn vectorized<R>(job: impl FnOnce() -> R) -> R {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2,avx512f,avx512dq,avx512vl")]
        fn run_avx512<R>(job: impl FnOnce() -> R) -> R {
            job()
        }
        #[target_feature(enable = "avx2")]
        fn run_avx2<R>(job: impl FnOnce() -> R) -> R {
            job()
        }
        if is_x86_feature_detected!("avx2") {
            if has_avx512() {
                // SAFETY: the processor has all features of the function, as the conditions above checked.
                return unsafe { run_avx512(job) };
            }
            // SAFETY: the processor has AVX2, as the condition above checked.
            return unsafe { run_avx2(job) };
        }
    }
    job()
}
