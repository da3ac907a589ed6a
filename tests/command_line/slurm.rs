//! Tests of `scripts/slurm` with a real Slurm: `tests/slurm/check.py` starts one with several nodes on this machine.
#![cfg(target_os = "linux")]

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::scene::program;

#[test]
#[ignore = "needs Slurm"]
fn slurm_shards_and_scenes_give_the_same_bytes() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let data = std::env::var_os("SPLATSIEVE_DATA").map_or_else(|| root.join("../shared/data"), PathBuf::from);
    let model = data.join("room2_big");
    let mut command = Command::new(std::env::var_os("PYTHON").unwrap_or_else(|| "python3".into()));
    command.arg(root.join("tests/slurm/check.py")).arg(program());
    if model.is_dir() {
        command.arg(model);
    }
    let output = command.output().unwrap();
    let [said, complaints] = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes));
    println!("{said}");
    assert!(output.status.success(), "{said}{complaints}");
}
