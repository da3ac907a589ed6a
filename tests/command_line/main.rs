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

use std::process::{Command, Stdio};

/// Returns `unshare` with `flags`, which give it namespaces of its own, and as a user without privileges where the system
/// refuses them to this one.
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
