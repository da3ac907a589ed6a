//! Gaussians and checks that the tests of several file formats share.

use crate::diagnostics::demo_scene::DemoScene;
use crate::model::{AttributeValues, Attributes, Gaussians, sh_coefficient_count};
use crate::passes::gather_all;

/// Returns `count` Gaussians with SH degree `degree`. Their values differ along all axes, so that a swapped or reversed
/// axis is noticed.
pub(super) fn gaussians_with_sh(count: usize, degree: usize) -> Gaussians {
    let mut state = gather_all(&DemoScene::new(count, 1), 0, Attributes::all()).unwrap();
    state.sh = AttributeValues::zeros(3 * sh_coefficient_count(degree), count);
    state.sh.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k as f32 * 0.618_034).fract() - 0.5);
    state
}

/// Asserts that a change of the signs of SH coefficients has the same effect as reversing axes. `signs` holds the
/// factor of each coefficient above degree 0; in `axes`, −1 marks a reversed axis. The value of each SH basis function
/// in a direction, times its sign, must equal its value in the reversed direction.
pub(super) fn assert_signs_reverse_axes(signs: [f32; 15], axes: [f64; 3]) {
    let basis = |[x, y, z]: [f64; 3]| -> [f64; 15] {
        [
            -y,
            z,
            -x,
            x * y,
            -y * z,
            2.0 * z * z - x * x - y * y,
            -x * z,
            x * x - y * y,
            -y * (3.0 * x * x - y * y),
            x * y * z,
            -y * (4.0 * z * z - x * x - y * y),
            z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
            -x * (4.0 * z * z - x * x - y * y),
            z * (x * x - y * y),
            -x * (x * x - 3.0 * y * y),
        ]
    };
    let direction = [0.48, -0.6, 0.64];
    let turned = basis([0, 1, 2].map(|axis| axes[axis] * direction[axis]));
    for (k, (a, b)) in basis(direction).iter().zip(turned).enumerate() {
        assert!((a * f64::from(signs[k]) - b).abs() < 1e-12, "function {k}");
    }
}
