//! Slow, independent reference evaluation (oracle) of a deformation field in f64, one Gaussian at a time, directly from
//! the definition.

use crate::{FieldConfig, Tensors};
use splat_core::{AttributeValues, Attributes, Gaussians};

/// Attributes of one Gaussian in f64, as stored or as deformed at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Position: 3 values, scene units.
    pub position: Vec<f64>,
    /// Rotation: quaternion, 4 values in the order w, x, y, z.
    pub rotation: Vec<f64>,
    /// Natural logarithm of the scales: 3 values; scales are in scene units.
    pub log_scale: Vec<f64>,
    /// Logit of the opacity: 1 value.
    pub opacity_logit: Vec<f64>,
    /// SH coefficients of the color: 3·(degree + 1)² values.
    pub sh: Vec<f64>,
}

impl Parameters {
    /// Returns the attributes of Gaussian `i` of `raw`.
    pub fn from_row(raw: &Gaussians, i: usize) -> Parameters {
        let values = |column: &AttributeValues| (0..column.width()).map(|c| f64::from(column.plane(c)[i])).collect();
        Parameters {
            position: values(&raw.position),
            rotation: values(&raw.rotation),
            log_scale: values(&raw.log_scale),
            opacity_logit: values(&raw.opacity_logit),
            sh: values(&raw.sh),
        }
    }

    /// Returns the values of all attributes in one list, in the order in which this type declares them.
    pub fn values(&self) -> Vec<f64> {
        [&self.position[..], &self.rotation, &self.log_scale, &self.opacity_logit, &self.sh].concat()
    }
}

/// Slow f64 evaluation (oracle) of the deformation field that a state dict defines.
#[derive(Debug)]
pub struct Oracle<'a> {
    /// State dict of the field.
    pub tensors: &'a Tensors,
    /// Options with which the field was trained.
    pub config: &'a FieldConfig,
}

impl Oracle<'_> {
    /// Returns the shape and the values of the tensor `deformation_net.{name}`.
    fn tensor(&self, name: &str) -> (&[usize], Vec<f64>) {
        let tensor = &self.tensors[&format!("deformation_net.{name}")];
        (&tensor.shape, tensor.data.iter().map(|&x| f64::from(x)).collect())
    }

    /// Returns the output W·x + b of the fully connected layer `name` for the input `x`.
    fn linear(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let (shape, weight) = self.tensor(&format!("{name}.weight"));
        let (_, bias) = self.tensor(&format!("{name}.bias"));
        (0..shape[0]).map(|o| bias[o] + (0..shape[1]).map(|i| weight[o * shape[1] + i] * x[i]).sum::<f64>()).collect()
    }

    /// Returns the output of the head (small MLP of one attribute) `name` for the input `x`: ReLU, linear layer, ReLU,
    /// linear layer.
    fn head(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let hidden = self.linear(&format!("{name}.1"), &relu(x));
        self.linear(&format!("{name}.3"), &relu(&hidden))
    }

    /// Returns the HexPlane features at position `p` (scene units) and `time`.
    fn plane_features(&self, p: &[f64], time: f64) -> Vec<f64> {
        let (_, aabb) = self.tensor("grid.aabb");
        let mut u: Vec<f64> = (0..3).map(|a| (p[a] - aabb[a]) * 2.0 / (aabb[3 + a] - aabb[a]) - 1.0).collect();
        u.push(time);
        let mut features = Vec::new();
        for level in 0.. {
            if !self.tensors.contains_key(&format!("deformation_net.grid.grids.{level}.0")) {
                return features;
            }
            let mut product: Vec<f64> = Vec::new();
            for (plane, (a, b)) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)].into_iter().enumerate() {
                let (shape, grid) = self.tensor(&format!("grid.grids.{level}.{plane}"));
                let (rows, cols) = (shape[2], shape[3]);
                let x = ((u[a] + 1.0) / 2.0 * (cols - 1) as f64).clamp(0.0, (cols - 1) as f64);
                let y = ((u[b] + 1.0) / 2.0 * (rows - 1) as f64).clamp(0.0, (rows - 1) as f64);
                product.resize(shape[1], 1.0);
                for (channel, product) in product.iter_mut().enumerate() {
                    let mut sample = 0.0;
                    for row in 0..rows {
                        for col in 0..cols {
                            let hat = |d: f64| (1.0 - d.abs()).max(0.0);
                            let weight = hat(x - col as f64) * hat(y - row as f64);
                            sample += weight * grid[(channel * rows + row) * cols + col];
                        }
                    }
                    *product *= sample;
                }
            }
            features.extend(product);
        }
        unreachable!("the loop ends at the first absent level")
    }

    /// Returns the mask (factor on stored attributes) at position `p`, scene units, by interpolation in the voxel grid
    /// of the option `empty_voxel`.
    fn voxel_mask(&self, p: &[f64]) -> f64 {
        let (shape, grid) = self.tensor("empty_voxel.grid");
        let (_, low) = self.tensor("empty_voxel.xyz_min");
        let (_, high) = self.tensor("empty_voxel.xyz_max");
        let at: Vec<f64> = (0..3).map(|a| (p[a] - low[a]) / (high[a] - low[a]) * (shape[2 + a] - 1) as f64).collect();
        let mut sum = 0.0;
        for i in 0..shape[2] {
            for j in 0..shape[3] {
                for k in 0..shape[4] {
                    let weight: f64 =
                        [i, j, k].iter().zip(&at).map(|(&n, at)| (1.0 - (at - n as f64).abs()).max(0.0)).product();
                    sum += weight * grid[(i * shape[3] + j) * shape[4] + k];
                }
            }
        }
        sum
    }

    /// Returns the attributes at `time` of the Gaussian whose stored attributes are `raw`.
    pub fn state(&self, raw: &Parameters, time: f64) -> Parameters {
        let config = self.config;
        let mut features = if config.no_grid {
            vec![raw.position[0], raw.position[1], raw.position[2], time]
        } else {
            self.plane_features(&raw.position, time)
        };
        if config.grid_pe > 1 && !config.no_grid {
            let p = config.grid_pe as f64;
            let sines: Vec<f64> = features.iter().map(|f| (p * f).sin()).collect();
            let cosines: Vec<f64> = features.iter().map(|f| (p * f).cos()).collect();
            features = [features, sines, cosines].concat();
        }
        let mut hidden = self.linear("feature_out.0", &features);
        for layer in (2..).step_by(2) {
            if !self.tensors.contains_key(&format!("deformation_net.feature_out.{layer}.weight")) {
                break;
            }
            hidden = self.linear(&format!("feature_out.{layer}"), &relu(&hidden));
        }
        let mask = if config.static_mlp {
            self.head("static_mlp", &hidden)[0]
        } else if config.empty_voxel {
            self.voxel_mask(&raw.position)
        } else {
            1.0
        };
        let deform = |column: Attributes, name: &str, raw: &[f64]| -> Vec<f64> {
            if !config.deformed_attributes.contains(column) {
                return raw.to_vec();
            }
            let delta = self.head(name, &hidden);
            if column != Attributes::ROTATION {
                return raw.iter().zip(&delta).map(|(raw, delta)| raw * mask + delta).collect();
            }
            if !config.apply_rotation {
                return raw.iter().zip(&delta).map(|(raw, delta)| raw + delta).collect();
            }
            let (u, v) = (glam::DVec3::from_slice(&raw[1..]), glam::DVec3::from_slice(&delta[1..]));
            let vector = raw[0] * v + delta[0] * u + u.cross(v);
            let q = vector.extend(raw[0] * delta[0] - u.dot(v)).normalize();
            vec![q.w, q.x, q.y, q.z]
        };
        Parameters {
            position: deform(Attributes::POSITION, "pos_deform", &raw.position),
            rotation: deform(Attributes::ROTATION, "rotations_deform", &raw.rotation),
            log_scale: deform(Attributes::LOG_SCALE, "scales_deform", &raw.log_scale),
            opacity_logit: deform(Attributes::OPACITY, "opacity_deform", &raw.opacity_logit),
            sh: deform(Attributes::SH, "shs_deform", &raw.sh),
        }
    }
}

/// Returns max(x, 0) of every value x.
fn relu(x: &[f64]) -> Vec<f64> {
    x.iter().map(|x| x.max(0.0)).collect()
}
