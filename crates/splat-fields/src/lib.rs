//! Deformation fields of dynamic Gaussian-splatting models, evaluated in blocks of Gaussians.
//!
//! [`Field`] is the field of a 4DGaussians model: HexPlane features followed by MLP heads. [`Network`] is the deep MLP of
//! position and time that Deformable-3D-Gaussians trains. Both also give derivatives with respect to the stored Gaussians.
//!
//! [`oracle`] evaluates a [`Field`] in f64, and [`synthetic`] makes fields of random weights to test with.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod deltas;
mod field;
mod jacobian;
mod linear;
mod network;
pub mod oracle;
mod planes;
mod slopes;
pub mod synthetic;
mod tensors;
#[cfg(test)]
mod tests;
mod voxel;

pub use deltas::Deltas;
pub use field::{Field, FieldConfig, Prepared, Scratch};
pub use network::{Encoded, Network, PredictedMotion};
pub use planes::{Box3, Tap, rows_before_zero, tap};
pub use tensors::{Tensor, Tensors};
