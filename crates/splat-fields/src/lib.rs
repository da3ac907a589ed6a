//! Deformation fields of dynamic Gaussian-splatting models: networks that compute how Gaussians change with time. They
//! are evaluated for blocks of Gaussians.
//!
//! [`Field`] is the field of a 4DGaussians model: HexPlane features, followed by an MLP (the trunk) and one small MLP
//! (a head) per attribute. [`Network`] is the deep MLP of position and time that Deformable-3D-Gaussians trains. Both
//! also compute derivatives of their results with respect to the stored Gaussians.
//!
//! [`oracle`] is a slow, independent evaluation of a [`Field`] in f64. [`synthetic`] makes fields with random weights.
//! Both serve tests.
//!
//! ```
//! use std::path::Path;
//! use splat_core::{Attributes, Gaussians};
//! use splat_fields::{Deltas, Field, LayerBuffers, synthetic};
//!
//! let config = synthetic::plain_config();
//! let field = Field::new(&synthetic::random_tensors(&config, 1), config, 3, Path::new("deformation.pth"))?;
//! let canonical = Gaussians::zeros(100, 3);
//! let prepared = field.prepare(&canonical.position);
//!
//! let (mut deltas, mut scratch) = (Deltas::new(3), LayerBuffers::default());
//! field.deltas(&prepared, 0.25, Attributes::all(), &mut scratch, &mut deltas)?;
//! let mut state = Gaussians::zeros(0, 3);
//! deltas.apply(&canonical, Attributes::all(), &mut state);
//! assert_eq!(state.len(), 100);
//! # splat_core::error::Result::Ok(())
//! ```

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod deltas;
mod field;
mod instruction_set;
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
pub use field::{Field, FieldConfig, LayerBuffers, PreparedPositions};
pub use network::{EncodedPositions, Network, PredictedMotion};
pub use planes::{Box3, TexelPair, count_unread_time_rows, texel_pair};
pub use tensors::{Tensor, Tensors};

/// Compiles the example in the README of this crate as a documentation test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
mod readme {}
