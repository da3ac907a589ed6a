//! File formats, each reader beside its writer (PLY, NumPy and PyTorch files, `.spz`, `.splatv`, containers, frame
//! streams, cameras, images), and [`atomic`], through which every output is written.

pub mod accuracy;
pub mod atomic;
pub mod cameras;
pub(crate) mod checkpoint;
pub mod compressed_ply;
pub mod container;
pub(crate) mod csv;
pub mod defects;
pub(crate) mod digest;
pub mod frame_stream;
pub mod ftgs;
pub mod glb;
pub mod image;
pub(crate) mod json;
mod map;
pub mod names;
pub(crate) mod npy;
pub(crate) mod npz;
pub(crate) mod open;
pub mod page_policy;
#[doc(hidden)]
pub mod parser_checks;
mod pickle;
pub mod ply;
pub mod ply_frames;
pub mod ply_sequence;
pub(crate) mod python_literal;
pub mod sog;
pub mod splat;
pub mod splatv;
pub mod spz;
pub(crate) mod state_dict;
#[cfg(test)]
mod tests;
pub mod text;
pub mod tsog;
pub mod webp;
mod zip_directory;
pub(crate) mod zip_output;
