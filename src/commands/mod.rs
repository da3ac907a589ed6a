//! Commands other than `compress`: `convert`, `info`, `render` and `score`.

pub mod archive;
pub mod container;
pub mod convert;
pub mod converted;
pub mod render;
pub mod score;
pub mod video;
