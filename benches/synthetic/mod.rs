//! Synthetic Gaussians for the benchmarks of the rasterizer, and the lower bound of a blend's time on this machine.

use std::hint::black_box;
use std::time::Instant;

use splatsieve::model::Gaussians;

/// Number of vector operations that blend one Gaussian into one vector of pixels, without loads and stores: 6 for the
/// exponent, 20 for the power of 2 with this exponent, 10 for weight and transmittance, 6 for the color.
const OPERATIONS: f64 = 42.0;
/// Number of pixels that the widest vector register holds.
const LANES: f64 = 16.0;

/// Returns the shortest time in seconds in which one core can do the arithmetic of `events` blend events (a blend event
/// is a pixel and a Gaussian that changes it). Assumes two vector operations per cycle of the measured clock.
pub(crate) fn blend_limit(events: f64) -> f64 {
    events / LANES * OPERATIONS / 2.0 / clock()
}

/// Returns the clock rate of the processor in cycles per second. It is measured with a chain of dependent operations:
/// an exclusive or takes one cycle, an integer product three.
fn clock() -> f64 {
    const LINKS: u32 = 10_000_000;
    fastest(|| {
        let chain = (0..LINKS).fold(black_box(1u64), |x, k| (x ^ u64::from(k)).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        black_box(chain);
        4.0 * f64::from(LINKS)
    })
}

/// Calls `amount` seven times. The function does some work and returns the amount of it, such as a number of bytes.
/// Returns the highest amount per second.
pub(crate) fn fastest(amount: impl Fn() -> f64) -> f64 {
    let rate = |_| {
        let start = Instant::now();
        amount() / start.elapsed().as_secs_f64()
    };
    (0..7).map(rate).fold(0.0, f64::max)
}

/// Returns `count` Gaussians that fill a box in front of the camera. Their size falls with `count`, so that the opacity
/// of the image stays about the same.
pub(crate) fn cloud(count: usize) -> Gaussians {
    let mut cloud = Gaussians::zeros(count, 3);
    let size = -1.2 - (count as f32).ln() / 3.0;
    for i in 0..count {
        // Additive recurrence with irrational steps: evenly distributed, and the same on every machine.
        let step = |k: f64| (i as f64 * k).fract() as f32;
        let position = [4.0 * step(0.819_172_51) - 2.0, 3.2 * step(0.671_043_61) - 1.6, 2.0 + 3.0 * step(0.549_700_48)];
        cloud.position.set_row(i, position);
        cloud.rotation.set_row(i, [1.0, step(0.618_034), step(0.754_877_67), step(0.569_840_3)]);
        cloud.log_scale.set_row(i, [size + step(0.380_278), size - step(0.733_891_86), size]);
        cloud.opacity_logit.set_row(i, [8.0 * step(0.856_674_88) - 4.0]);
        for c in 0..48 {
            cloud.sh.plane_mut(c)[i] = 0.3 * step(0.1 + 0.017 * f64::from(c as u8)) - 0.1;
        }
    }
    cloud
}
