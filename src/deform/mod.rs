//! What deforms Gaussians, evaluated in blocks: the field of a 4DGaussians model, HexPlane features and MLP heads; a deep
//! network of positions and times.

mod deltas;
mod field;
mod jacobian;
mod linear;
mod network;
mod planes;
mod slopes;
mod tensors;
#[cfg(test)]
mod tests;
mod voxel;

pub use deltas::Deltas;
pub use field::{Field, FieldConfig, Prepared, Scratch};
#[cfg(test)]
pub(crate) use network::tests as made_network;
pub use network::{Encoded, Motion, Network};
pub use planes::{Box3, Tap, rows_before_zero, tap};
pub use tensors::{Tensor, Tensors};
