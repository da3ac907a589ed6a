//! The order of the passes: what each verb does from input to output.

pub mod arrival;
pub mod baseline;
pub mod choose;
pub mod compress;
pub mod container;
pub(crate) mod csv;
pub mod demo;
pub mod evaluate;
pub mod evaluation;
pub mod input;
pub mod memory;
pub mod merging;
pub mod output;
pub mod overrides;
pub mod pictures;
pub mod proxies;
pub mod refit;
pub mod render;
pub mod result;
pub mod rounds;
pub mod score;
pub mod scored;
mod shelf;
pub mod summary;
pub mod sweep;
pub mod trade_off;
