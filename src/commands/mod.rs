//! Commands other than `compress`: `convert`, `info`, `render` and `score`.

pub mod archive;
pub mod container;
pub mod convert;
pub mod convert_report;
pub mod render;
pub mod score;
pub mod video;
