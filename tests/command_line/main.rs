//! The command line as users and scripts meet it.

mod beside_others;
mod cli;
mod durable;
mod inputs;
mod long;
mod memory;
mod parts;
mod resume;
mod runs;
#[path = "../scene/mod.rs"]
mod scene;
mod scripts;
mod selfcheck;
mod slurm;
mod splatv;
mod stream_input;
