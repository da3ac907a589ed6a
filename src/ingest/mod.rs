//! Sources: model folders, PLY files and sequences, containers, cameras.

mod map;
pub mod ply;
pub mod ply_sequence;
