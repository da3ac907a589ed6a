//! Commands beside `compress`, from input to output.

pub mod archive;
pub mod container;
pub mod convert;
pub mod converted;
pub mod render;
pub mod score;
pub mod video;
