//! The program's numbers over again, slowly: definitions written out in f64 over whole arrays, sharing no code with
//! what they check.

pub mod picture;
pub(crate) mod statistics;
