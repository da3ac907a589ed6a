//! Checks and experiments of the program itself: the demo, generated scenes, the self-check against f64 oracles, sweeps
//! over sizes, and precision diagrams.

pub mod demo;
pub mod demo_scene;
pub mod precision;
pub mod selfcheck;
pub mod sweep;
pub mod test_scene;
pub(crate) mod whole_run;
