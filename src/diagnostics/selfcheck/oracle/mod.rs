//! Oracles: slow reference computations that follow the definitions in f64 over whole arrays and share no code with the
//! program that they check.

pub mod render;
pub(crate) mod statistics;
