//! The `splatsieve` command.

fn main() {}
