//! Slow oracles: the definitions written out in f64 over whole arrays, sharing no code with the code that they check.

pub mod picture;
pub(crate) mod statistics;
