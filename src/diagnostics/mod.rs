//! Checks of the program and experiments with it: the demo, generated scenes, the self-check (comparison of computed
//! numbers with slow f64 references), sweeps (quality at several compressed sizes), and precision diagrams (error
//! against run time for several settings).

pub mod demo;
pub mod demo_scene;
pub mod precision;
pub mod selfcheck;
pub mod sweep;
pub mod test_scene;
pub(crate) mod whole_run;
