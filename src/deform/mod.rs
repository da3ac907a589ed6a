//! The deformation field of a 4DGaussians model: HexPlane features and MLP heads, evaluated in blocks.

mod deltas;
mod field;
mod jacobian;
mod linear;
mod planes;
mod slopes;
mod tensors;
#[cfg(test)]
mod tests;
mod voxel;

pub use deltas::Deltas;
pub use field::{Field, FieldConfig, Prepared, Scratch};
pub use planes::{Box3, Tap, rows_before_zero, tap};
pub use tensors::{Tensor, Tensors};
