//! Control nodes, and the weights with which they move a Gaussian.
//!
//! A Gaussian at x with features f is moved by the K nodes nearest to [x, f]. Nearness is the squared distance d² over
//! all values; in a tie the first node counts as nearer. The weight of a node is u = exp(−d²/(2r²))·σ(weight) + 1e-7
//! with the radius r of the node and the logistic function σ, divided by the sum of u over the K nodes. The weights are
//! constant in time. Source: `cal_nn_weight` of the authors' code.

use std::path::Path;

use crate::deform::{Tensor, Tensors};
use crate::error::{Error, Result};
use crate::model::{AttributeValues, StoredParams, opacity};

/// Value added to the kernel (unnormalized weight) of every control node before the weights are normalized.
const FLOOR: f64 = 1e-7;

/// Control nodes of a model: M nodes with h features each. Features are learned values by which, with the position, the
/// nodes nearest to a Gaussian are found.
#[derive(Debug)]
pub(super) struct Nodes {
    /// Position and features (learned values) of each control node, shape `[M, 3 + h]`.
    values: Vec<f32>,
    /// Number of values per control node, 3 + h: its position and h features (learned values).
    width: usize,
    /// For each control node: 1/(2r²) with its radius r, and σ(weight) with the logistic function σ.
    kernels: Vec<[f64; 2]>,
    /// Number K of control nodes that move each Gaussian.
    nearest: usize,
}

/// Control node that moves a given Gaussian, and its weight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    /// Index of the control node.
    pub(super) node: u32,
    /// Weight of the control node, between 0 and 1; the weights of all nodes of a Gaussian sum to 1.
    pub(super) weight: f64,
    /// Kernel of the control node: exp(−d²/(2r²))·σ(weight), from which the normalized weight is computed.
    kernel: f64,
}

impl Nodes {
    /// Reads the control nodes from `tensors`, which come from `file`. `nearest` is the number K of nodes that move
    /// each Gaussian.
    ///
    /// # Errors
    /// Fails if tensors are missing, have other shapes or are not finite.
    pub(super) fn new(tensors: &Tensors, nearest: usize, file: &Path) -> Result<Nodes> {
        let get = |name: &str, expected: &str, fits: &dyn Fn(&[usize]) -> bool| -> Result<&Tensor> {
            let place = format!("tensor {name}");
            let wrong = |found: String| Error::input(file, &place, expected, found);
            let tensor = tensors.get(name).ok_or_else(|| wrong("none".to_owned()))?;
            if !fits(&tensor.shape) {
                return Err(wrong(format!("{:?}", tensor.shape)));
            }
            match tensor.data.iter().position(|value| !value.is_finite()) {
                Some(at) => {
                    Err(Error::input(file, &place, "finite values", format!("{} at element {at}", tensor.data[at])))
                }
                None => Ok(tensor),
            }
        };
        let nodes = get(
            "nodes",
            "shape [M, 3 + hyper_dim], M at least 1",
            &|shape| matches!(*shape, [count, width] if count > 0 && width >= 3 && u32::try_from(count).is_ok()),
        )?;
        let (count, width) = (nodes.shape[0], nodes.shape[1]);
        let expected = format!("shape [{count}], of {count} nodes");
        let radius = get("_node_radius", &expected, &|shape| matches!(*shape, [found] | [found, 1] if found == count))?;
        let weight = get("_node_weight", &expected, &|shape| matches!(*shape, [found] | [found, 1] if found == count))?;
        let kernel = |(&radius, &weight): (&f32, &f32)| [0.5 * (-2.0 * f64::from(radius)).exp(), opacity(weight)];
        let kernels = radius.data.iter().zip(&weight.data).map(kernel).collect();
        Ok(Nodes { values: nodes.data.clone(), width, kernels, nearest: nearest.clamp(1, count) })
    }

    /// Returns the number h of features (learned values) per control node.
    pub(super) fn features(&self) -> usize {
        self.width - 3
    }

    /// Returns the number M of control nodes.
    pub(super) fn len(&self) -> usize {
        self.kernels.len()
    }

    /// Returns the number K of control nodes that move each Gaussian.
    pub(super) fn nearest(&self) -> usize {
        self.nearest
    }

    /// Returns the canonical positions of the control nodes, `[M, 3]`.
    pub(super) fn position(&self) -> AttributeValues {
        let planes = (0..3).flat_map(|c| self.values.iter().skip(c).step_by(self.width).copied());
        AttributeValues::from_planes(3, planes.collect())
    }

    /// Appends to `out` the K control nodes that move the Gaussian in row `row` of `raw`, nearest first, with their
    /// weights.
    pub(super) fn shares(&self, raw: &StoredParams, row: usize, out: &mut Vec<Share>) {
        let mut at: Vec<f32> = raw.gaussians.position.row::<3>(row).to_vec();
        at.extend((0..self.features()).map(|k| raw.format_specific.plane(k)[row]));
        let mut nearest: Vec<(f64, u32)> = Vec::with_capacity(self.nearest + 1);
        for (node, values) in self.values.chunks_exact(self.width).enumerate() {
            let distance = values.iter().zip(&at).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum::<f64>();
            if nearest.len() < self.nearest || nearest.last().is_some_and(|last| distance < last.0) {
                let place = nearest.partition_point(|found| found.0 <= distance);
                nearest.insert(place, (distance, node as u32));
                nearest.truncate(self.nearest);
            }
        }
        let kernel = |&(distance, node): &(f64, u32)| {
            let [sharpness, weight] = self.kernels[node as usize];
            (-distance * sharpness).exp() * weight
        };
        let sum: f64 = nearest.iter().map(|found| kernel(found) + FLOOR).sum();
        out.extend(nearest.iter().map(|found| {
            let kernel = kernel(found);
            Share { node: found.1, weight: (kernel + FLOOR) / sum, kernel }
        }));
    }

    /// Returns for each node weight in `shares` its derivative with respect to the position `x` of the Gaussian.
    pub(super) fn slopes(&self, x: [f32; 3], shares: &[Share]) -> Vec<[f64; 3]> {
        let sum: f64 = shares.iter().map(|share| share.kernel + FLOOR).sum();
        let own = |share: &Share| {
            let node = &self.values[share.node as usize * self.width..][..3];
            let by = -2.0 * self.kernels[share.node as usize][0] * share.kernel;
            [0, 1, 2].map(|c| by * (f64::from(x[c]) - f64::from(node[c])))
        };
        let all: Vec<[f64; 3]> = shares.iter().map(own).collect();
        let total = [0, 1, 2].map(|c| all.iter().map(|own| own[c]).sum::<f64>());
        let slope = |(share, own): (&Share, &[f64; 3])| [0, 1, 2].map(|c| (own[c] - share.weight * total[c]) / sum);
        shares.iter().zip(&all).map(slope).collect()
    }
}
