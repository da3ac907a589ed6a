//! The `splatsieve` command.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout, clippy::disallowed_methods))]

use std::process::ExitCode;

mod cli;

fn main() -> ExitCode {
    cli::main()
}
