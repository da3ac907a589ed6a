//! Sources: model folders, PLY files and sequences, containers, cameras.

pub mod cameras;
