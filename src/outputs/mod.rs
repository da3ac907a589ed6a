//! Writers that drive passes over a sequence: containers, fitted curves, frame streams, films and tables.
//!
//! Writers create the file they are given; [`crate::files::atomic`] hands out the temporary names to give them and
//! moves what was written to where the user asked for it.

pub mod bounds;
pub mod container;
pub mod curves;
pub mod film;
pub mod four_dgs;
pub mod frame_stream;
pub mod index_map;
pub mod kind;
pub mod rows;
