//! Writers that read a sequence from beginning to end and write it as containers, fitted curves, frame streams, films
//! or tables.
//!
//! Each writer creates the file at the path it is given. Callers pass a temporary name from [`crate::files::atomic`],
//! which moves the finished file to the path that the user asked for.

pub mod bounds;
pub mod container;
pub mod curves;
pub mod film;
pub mod four_dgs;
pub mod frame_stream;
pub mod gsd;
pub mod index_map;
pub mod kind;
pub mod rows;
pub mod time_windows;
