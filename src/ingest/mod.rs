//! Formats that files come in: PLY files and sequences, containers, streams, cameras, pictures.

pub mod cameras;
pub(crate) mod checkpoint;
pub mod container;
pub(crate) mod digest;
pub mod frame_stream;
pub mod image;
#[doc(hidden)]
pub mod in_memory;
pub(crate) mod json;
mod map;
pub mod names;
pub(crate) mod npy;
pub(crate) mod npz;
pub(crate) mod open;
mod pickle;
pub mod ply;
pub mod ply_frames;
pub mod ply_sequence;
mod shared_file;
pub mod splatv;
pub mod text;
mod zip_directory;
