//! Attacks on the program: inputs built to exhaust memory or time, links and devices in place of files, runs that
//! share outputs, signals, streams that cannot be written, and tiny or extreme numbers.
//!
//! Every test starts the program as a user would and checks the exit code, the message, the peak memory and what lies
//! in the folder afterwards. Tests that take longer than a few seconds are ignored by default:
//!
//! ```sh
//! cargo test --test hostile                                  # the short part, about a minute
//! SPLATSIEVE_PROGRAM=target/release/splatsieve cargo test --test hostile -- --ignored    # the long part
//! ```
//!
//! Random choices come from a fixed seed, which `SPLATSIEVE_SEED` replaces; a failure prints the seed.
#![cfg(target_os = "linux")]

mod files;
mod numbers;
mod outputs;
mod runner;
mod structured;
mod terminal;
