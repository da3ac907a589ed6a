//! Checks and experiments of the program: the demo scene, the self-check against slow f64 reference computations, runs
//! over several sizes (sweep), and diagrams of work against precision.

pub mod demo;
pub mod demo_scene;
pub mod precision;
pub mod selfcheck;
pub mod sweep;
pub(crate) mod whole_run;
