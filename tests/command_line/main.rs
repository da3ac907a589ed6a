//! Tests of the command line as users and scripts use it.

mod benchmark_tables;
mod beside_others;
#[path = "../browser/mod.rs"]
mod browser;
mod cli;
mod defects;
mod docs;
mod durable;
mod inputs;
mod long;
mod memory;
mod parts;
mod playcanvas;
mod players;
mod resume;
mod runs;
#[path = "../scene/mod.rs"]
mod scene;
mod scripts;
mod selfcheck;
mod slurm;
mod splatv;
mod stills;
mod stream_input;

use std::process::{Command, Stdio};

/// Returns the command `unshare` with `flags`, which create new namespaces. Adds the flags for an unprivileged user
/// namespace if the system refuses the plain call. Panics if neither works.
fn unshare(flags: &[&str]) -> Command {
    let rootless = [&["-U", "-r"], flags].concat();
    let works = |flags: &[&str]| {
        let quiet = Command::new("unshare").args(flags).arg("true").stderr(Stdio::null()).status();
        quiet.is_ok_and(|status| status.success())
    };
    let flags = [flags, &rootless].into_iter().find(|flags| works(flags));
    let mut command = Command::new("unshare");
    command.args(flags.expect("a machine that allows namespaces"));
    command
}
