//! Oracle (slow reference) of the statistics: the definitions of method.md written out in f64, over whole sequences in
//! memory, without any code of the streaming scan.

use crate::model::{Camera, Gaussians, ViewSchedule};
use crate::recipe::{MotionParams, ScanParams};

/// Statistics of one Gaussian by the oracle (slow f64 reference).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct OracleRow {
    /// Trajectory magnitude D: root mean square step from frame to frame, scene units.
    pub(crate) d: f64,
    /// Curvature κ: mean length of the second differences of the position, scene units.
    pub(crate) kappa: f64,
    /// Variance V of the opacity over the frames in which the Gaussian is alive.
    pub(crate) v: f64,
    /// Number of frames in which the Gaussian is alive (opacity ≥ alpha_min).
    pub(crate) life: u32,
    /// Contribution C: projected area times opacity, pixels, mean over all views.
    pub(crate) c: f64,
    /// Visibility: fraction of all views in which the Gaussian is alive and touches the image.
    pub(crate) vis: f64,
}

/// Computes the statistics of Gaussian `i` over `frames`, which are evenly spaced in time. `schedule` lists the views
/// of each frame.
pub(crate) fn row(i: usize, frames: &[Gaussians], schedule: &ViewSchedule, scan: &ScanParams) -> OracleRow {
    let last = frames.len() - 1;
    let x = |t: usize| frames[t].position_f64(i);
    let alpha: Vec<f64> =
        frames.iter().map(|frame| 1.0 / (1.0 + (-f64::from(frame.opacity_logit.plane(0)[i])).exp())).collect();
    let alive = |t: usize| alpha[t] >= scan.alpha_min;
    let life: Vec<usize> = (0..=last).filter(|&t| alive(t)).collect();
    let step = |t: usize| norm(sub(x(t), x(t - 1)));
    let turn = |t: usize| norm(sub(sub(x(t + 1), x(t)), sub(x(t), x(t - 1))));
    let (d, kappa) = match scan.motion {
        MotionParams::Literal => {
            let steps: f64 = life.iter().filter(|&&t| t > 0).map(|&t| step(t).powi(2)).sum();
            let centers = life.get(1..life.len().max(2) - 1).unwrap_or(&[]);
            let turns: f64 = centers.iter().map(|&t| turn(t)).sum();
            ((steps / life.len().max(1) as f64).sqrt(), turns / centers.len().max(1) as f64)
        }
        MotionParams::Runs => {
            let steps: Vec<f64> = (1..=last).filter(|&t| alive(t) && alive(t - 1)).map(|t| step(t).powi(2)).collect();
            let turns: Vec<f64> =
                (1..last.max(1)).filter(|&t| alive(t - 1) && alive(t) && alive(t + 1)).map(turn).collect();
            (mean(&steps).sqrt(), mean(&turns))
        }
    };
    let lived: Vec<f64> = life.iter().map(|&t| alpha[t]).collect();
    let deviations: Vec<f64> = lived.iter().map(|a| (a - mean(&lived)).powi(2)).collect();

    let (mut c, mut touched) = (0.0, 0);
    for (t, views) in schedule.iter().enumerate() {
        for &(_, camera) in views {
            let area = area(&frames[t], i, &schedule.cameras[camera as usize]);
            c += area * alpha[t];
            touched += u32::from(alive(t) && area > 0.0);
        }
    }
    let pairs = schedule.pair_count().max(1) as f64;
    OracleRow { d, kappa, v: mean(&deviations), life: life.len() as u32, c: c / pairs, vis: f64::from(touched) / pairs }
}

/// Returns the projected area of Gaussian `i` within the image, in px²: the area of its 3σ ellipse, times the fraction
/// of the bounding box of this ellipse that lies inside the image. The ellipse is found by projecting the 3-D
/// covariance. Returns 0 if the Gaussian is not beyond the near plane.
pub(crate) fn area(frame: &Gaussians, i: usize, camera: &Camera) -> f64 {
    let w: [[f64; 3]; 3] = std::array::from_fn(|r| camera.rotation.row(r).to_array());
    let world = frame.position_f64(i);
    let p: [f64; 3] = std::array::from_fn(|r| (0..3).map(|k| w[r][k] * world[k]).sum::<f64>() + camera.translation[r]);
    if p[2] <= camera.near {
        return 0.0;
    }
    let q = frame.rotation_f64(i);
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    let q = if length == 0.0 { [1.0, 0.0, 0.0, 0.0] } else { q.map(|x| x / length) };
    let s = frame.scales_f64(i);
    // Column k of the rotation matrix R is the k-th unit vector, rotated by the quaternion q.
    let axes: [[f64; 3]; 3] = std::array::from_fn(|k| rotated_unit_vector(q, k));
    let sigma: [[f64; 3]; 3] =
        std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| axes[k][r] * s[k] * s[k] * axes[k][c]).sum()));
    let limit_x = 1.3 * f64::from(camera.width) / (2.0 * camera.fx);
    let limit_y = 1.3 * f64::from(camera.height) / (2.0 * camera.fy);
    let tx = (p[0] / p[2]).clamp(-limit_x, limit_x) * p[2];
    let ty = (p[1] / p[2]).clamp(-limit_y, limit_y) * p[2];
    let jacobian = [
        [camera.fx / p[2], 0.0, -camera.fx * tx / (p[2] * p[2])],
        [0.0, camera.fy / p[2], -camera.fy * ty / (p[2] * p[2])],
    ];
    let t: [[f64; 3]; 2] =
        std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| jacobian[r][k] * w[k][c]).sum()));
    let projected = |r: usize, c: usize| -> f64 {
        (0..3).flat_map(|a| (0..3).map(move |b| (a, b))).map(|(a, b)| t[r][a] * sigma[a][b] * t[c][b]).sum()
    };
    let (xx, xy, yy) = (projected(0, 0) + 0.3, projected(0, 1), projected(1, 1) + 0.3);
    // The center of pixel (i, j) has the coordinates i and j, so the image extends from −½ to size − ½.
    let u = camera.fx * p[0] / p[2] + camera.cx - 0.5;
    let v = camera.fy * p[1] / p[2] + camera.cy - 0.5;
    let share = |center: f64, reach: f64, size: f64| {
        ((center + reach).min(size - 0.5) - (center - reach).max(-0.5)).max(0.0) / (2.0 * reach)
    };
    let fraction =
        share(u, 3.0 * xx.sqrt(), f64::from(camera.width)) * share(v, 3.0 * yy.sqrt(), f64::from(camera.height));
    9.0 * std::f64::consts::PI * (xx * yy - xy * xy).sqrt() * fraction
}

/// Returns the unit vector e_k along axis `k`, rotated by the quaternion `q`: the quaternion product q e_k q*.
fn rotated_unit_vector(q: [f64; 4], k: usize) -> [f64; 3] {
    let mut e = [0.0; 4];
    e[k + 1] = 1.0;
    let turned = hamilton(hamilton(q, e), [q[0], -q[1], -q[2], -q[3]]);
    [turned[1], turned[2], turned[3]]
}

fn hamilton(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

fn norm(a: [f64; 3]) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}
