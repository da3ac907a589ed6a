//! Inputs made from nothing, the same on every run.

pub mod clouds;
