//! What each verb beside `compress` does from input to output.

pub mod archive;
pub mod baseline;
pub mod container;
pub mod convert;
pub mod cost;
pub(crate) mod csv;
pub mod demo;
pub mod evaluate;
pub mod evaluation;
pub mod method;
pub mod precision;
pub mod render;
pub mod score;
pub mod sweep;
pub mod trade_off;
pub mod video;
pub mod view;
mod whole_run;
