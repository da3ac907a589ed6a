//! Entry point of the program `splatsieve`. The module `cli` parses the command line and runs the command.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout, clippy::disallowed_methods))]

use std::process::ExitCode;

mod cli;

fn main() -> ExitCode {
    cli::main()
}
