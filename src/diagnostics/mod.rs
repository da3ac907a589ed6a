//! Checks and experiments of the program: the demo scene, the self-check against f64 oracles, sweeps over sizes, and
//! work-precision diagrams.

pub mod demo;
pub mod demo_scene;
pub mod precision;
pub mod selfcheck;
pub mod sweep;
pub(crate) mod whole_run;
