//! Generated inputs of the self-check, the same on every run.

pub mod clouds;
