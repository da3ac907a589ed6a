//! Sinks: model folders, PLY files, containers, streams, rows, pictures.
//!
//! Writers create the file they are given; [`atomic`] hands out the temporary names to give them and
//! moves what was written to where the user asked for it.

pub mod accuracy;
pub mod atomic;
pub mod bounds;
pub(crate) mod checkpoint;
pub mod container;
pub mod curves;
pub mod film;
pub mod four_dgs;
pub mod frame_stream;
pub mod image;
pub mod index_map;
pub mod kind;
pub(crate) mod npz;
pub mod ply;
pub mod policy;
pub mod rows;
pub mod splatv;
pub mod spz;
pub(crate) mod zip_output;
