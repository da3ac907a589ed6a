//! Generated inputs, the same on every run.

pub mod clouds;
