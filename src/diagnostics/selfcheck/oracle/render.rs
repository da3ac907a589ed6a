//! Oracle (slow reference) of the rasterizer: in f64 throughout, pixel by pixel, with full matrices. As in the original
//! 3DGS kernel, a Gaussian reaches all pixels of the 16×16 tiles that its bounding square touches, without any further
//! limit.

use crate::model::{Camera, Gaussians};
use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};

/// Render of one view by the oracle (slow f64 reference), with the contributions of all Gaussians to it.
pub struct OracleRender {
    /// Colors (red, green, blue) of the `height · width` pixels, row by row.
    pub rgb: Vec<[f64; 3]>,
    /// For each pixel, whether f32 may decide differently from f64: alpha or transmittance of a Gaussian in the pixel
    /// is so close to a threshold of the renderer that their relative difference is below 1e-4.
    pub doubtful: Vec<bool>,
    /// Sum of alpha · transmittance over the sampled pixels, for each Gaussian.
    pub sum: Vec<f64>,
    /// Maximum of alpha · transmittance over the sampled pixels, for each Gaussian.
    pub max: Vec<f64>,
    /// Number of pairs of a Gaussian and a pixel into which it was blended.
    pub events: u64,
}

/// Gaussian projected to the image, with the tiles in which it is drawn.
struct Footprint {
    id: usize,
    depth: f32,
    center: DVec2,
    inverse: DMat2,
    opacity: f64,
    rgb: DVec3,
    /// Ranges of the tiles that the Gaussian may cover, along x and along y: the first tile, and one past the last.
    tiles: [[i64; 2]; 2],
}

impl Footprint {
    fn alpha(&self, pixel: DVec2) -> f64 {
        let offset = pixel - self.center;
        (self.opacity * (-0.5 * offset.dot(self.inverse * offset)).exp()).min(0.99)
    }
}

/// Returns the 16 real spherical harmonics up to degree 3 in the direction `d`, computed as polynomials in x, y and z.
fn basis(d: DVec3) -> [f64; 16] {
    let DVec3 { x, y, z } = d;
    let pi = std::f64::consts::PI;
    let root = |numerator: f64, denominator: f64| (numerator / (denominator * pi)).sqrt();
    [
        root(1.0, 4.0),
        -root(3.0, 4.0) * y,
        root(3.0, 4.0) * z,
        -root(3.0, 4.0) * x,
        root(15.0, 4.0) * x * y,
        -root(15.0, 4.0) * y * z,
        root(5.0, 16.0) * (3.0 * z * z - 1.0),
        -root(15.0, 4.0) * x * z,
        root(15.0, 16.0) * (x * x - y * y),
        -root(35.0, 32.0) * y * (3.0 * x * x - y * y),
        root(105.0, 4.0) * x * y * z,
        -root(21.0, 32.0) * y * (5.0 * z * z - 1.0),
        root(7.0, 16.0) * z * (5.0 * z * z - 3.0),
        -root(21.0, 32.0) * x * (5.0 * z * z - 1.0),
        root(105.0, 16.0) * z * (x * x - y * y),
        -root(35.0, 32.0) * x * (x * x - 3.0 * y * y),
    ]
}

/// Returns the depth (z coordinate in camera axes) of a position, computed in f32 with the terms added in the same
/// order as in the original 3DGS kernel.
fn view_depth([x, y, z]: [f32; 3], camera: &Camera) -> f32 {
    let row = camera.rotation.row(2).as_vec3();
    (row.x * x + row.y * y) + (row.z * z + camera.translation.z as f32)
}

fn footprint(gaussians: &Gaussians, id: usize, camera: &Camera) -> Option<Footprint> {
    let world = DVec3::from_array(gaussians.position_f64(id));
    let p = camera.rotation * world + camera.translation;
    if p.z <= f64::from(camera.near as f32) {
        return None;
    }
    let [w, x, y, z] = gaussians.rotation_f64(id);
    let axes = match DQuat::from_xyzw(x, y, z, w) {
        zero if zero.length() == 0.0 => DMat3::IDENTITY,
        q => DMat3::from_quat(q.normalize()),
    };
    let scale = DMat3::from_diagonal(DVec3::from_array(gaussians.scales_f64(id)));
    let covariance = axes * scale * scale * axes.transpose();
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let limit = |slope: f64, half_field: f64| slope.max(-1.3 * half_field).min(1.3 * half_field);
    let sx = limit(p.x / p.z, width / 2.0 / camera.fx);
    let sy = limit(p.y / p.z, height / 2.0 / camera.fy);
    let to_u = DVec3::new(camera.fx / p.z, 0.0, -camera.fx * sx / p.z);
    let to_v = DVec3::new(0.0, camera.fy / p.z, -camera.fy * sy / p.z);
    let seen = camera.rotation * covariance * camera.rotation.transpose();
    let (a, b, c) = (to_u.dot(seen * to_u) + 0.3, to_u.dot(seen * to_v), to_v.dot(seen * to_v) + 0.3);
    let determinant = a * c - b * b;
    let middle = (a + c) / 2.0;
    let radius = (3.0 * (middle + (middle * middle - determinant).max(0.1).sqrt()).sqrt()).ceil();
    let center = DVec2::new(camera.fx * p.x / p.z + camera.cx - 0.5, camera.fy * p.y / p.z + camera.cy - 0.5);
    let tiles = [(center.x, width), (center.y, height)].map(|(at, size)| {
        let count = (size / 16.0).ceil() as i64;
        [(((at - radius) / 16.0) as i64).clamp(0, count), (((at + radius + 15.0) / 16.0) as i64).clamp(0, count)]
    });
    let toward = (world - camera.center()).normalize();
    let coefficients = gaussians.sh.width() / 3;
    let mut rgb = DVec3::splat(0.5);
    for (k, y) in basis(toward).into_iter().enumerate().take(coefficients) {
        rgb += y * DVec3::from_array(std::array::from_fn(|ch| f64::from(gaussians.sh.plane(3 * k + ch)[id])));
    }
    Some(Footprint {
        id,
        depth: view_depth(gaussians.position.row(id), camera),
        center,
        inverse: DMat2::from_cols(DVec2::new(a, b), DVec2::new(b, c)).inverse(),
        opacity: 1.0 / (1.0 + (-f64::from(gaussians.opacity_logit.plane(0)[id])).exp()),
        rgb: rgb.max(DVec3::ZERO),
        tiles,
    })
}

/// Renders a view of `gaussians`. Only the pixels of every `stride`-th column and row count as sampled for
/// [`OracleRender::sum`] and [`OracleRender::max`]. Returns the image, and the contribution of every Gaussian to it.
pub fn render_view(gaussians: &Gaussians, camera: &Camera, background: [f32; 3], stride: u32) -> OracleRender {
    render_with(gaussians, camera, background, stride, |_, _| ())
}

/// Returns, for each pixel, the indices of the Gaussians that are blended there, nearest first. A small change of a
/// Gaussian may change these lists.
pub fn blended_indices(gaussians: &Gaussians, camera: &Camera) -> Vec<Vec<usize>> {
    let mut ids = vec![Vec::new(); camera.width as usize * camera.height as usize];
    render_with(gaussians, camera, [0.0; 3], 1, |pixel, id| ids[pixel].push(id));
    ids
}

/// Renders a view and returns the colors of its pixels. In each pixel, blends exactly the Gaussians that `blended`
/// lists for it. With fixed lists, the image is a smooth function of the parameters of the Gaussians.
pub fn render_blended(
    gaussians: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    blended: &[Vec<usize>],
) -> Vec<[f64; 3]> {
    let footprints: Vec<Option<Footprint>> = (0..gaussians.len()).map(|id| footprint(gaussians, id, camera)).collect();
    let pixel = |(at, ids): (usize, &Vec<usize>)| {
        let place = DVec2::new((at % camera.width as usize) as f64, (at / camera.width as usize) as f64);
        let (mut rgb, mut transmittance) = (DVec3::ZERO, 1.0f64);
        for footprint in ids.iter().map(|&id| footprints[id].as_ref().expect("what is blended is seen")) {
            let alpha = footprint.alpha(place);
            rgb += alpha * transmittance * footprint.rgb;
            transmittance *= 1.0 - alpha;
        }
        (rgb + transmittance * DVec3::from_array(background.map(f64::from))).to_array()
    };
    blended.iter().enumerate().map(pixel).collect()
}

fn render_with(
    gaussians: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    stride: u32,
    mut blended: impl FnMut(usize, usize),
) -> OracleRender {
    let mut footprints: Vec<Footprint> =
        (0..gaussians.len()).filter_map(|id| footprint(gaussians, id, camera)).collect();
    footprints.sort_by(|a, b| a.depth.total_cmp(&b.depth).then(a.id.cmp(&b.id)));
    let (width, height) = (camera.width as usize, camera.height as usize);
    let across = width.div_ceil(16);
    let mut tiles = vec![Vec::new(); across * height.div_ceil(16)];
    for (at, footprint) in footprints.iter().enumerate() {
        let [[x0, x1], [y0, y1]] = footprint.tiles;
        for y in y0..y1 {
            for x in x0..x1 {
                tiles[y as usize * across + x as usize].push(at);
            }
        }
    }
    let mut seen = OracleRender {
        rgb: Vec::with_capacity(width * height),
        doubtful: Vec::with_capacity(width * height),
        sum: vec![0.0; gaussians.len()],
        max: vec![0.0; gaussians.len()],
        events: 0,
    };
    let near = |value: f64, threshold: f64| (value / threshold - 1.0).abs() < 1e-4;
    for y in 0..height {
        for x in 0..width {
            let sampled = [x, y].iter().all(|&at| at as u32 % stride == stride / 2);
            let (mut rgb, mut transmittance, mut doubtful) = (DVec3::ZERO, 1.0f64, false);
            for footprint in tiles[y / 16 * across + x / 16].iter().map(|&at| &footprints[at]) {
                let alpha = footprint.alpha(DVec2::new(x as f64, y as f64));
                doubtful |= near(alpha, 1.0 / 255.0);
                if alpha < 1.0 / 255.0 {
                    continue;
                }
                let after = transmittance * (1.0 - alpha);
                doubtful |= near(after, 1e-4);
                if after < 1e-4 {
                    break;
                }
                let weight = alpha * transmittance;
                rgb += weight * footprint.rgb;
                blended(y * width + x, footprint.id);
                if sampled {
                    seen.sum[footprint.id] += weight;
                    seen.max[footprint.id] = seen.max[footprint.id].max(weight);
                }
                seen.events += 1;
                transmittance = after;
            }
            rgb += transmittance * DVec3::from_array(background.map(f64::from));
            seen.rgb.push(rgb.to_array());
            seen.doubtful.push(doubtful);
        }
    }
    seen
}
