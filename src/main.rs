//! The `splatsieve` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    splatsieve::cli::main()
}
