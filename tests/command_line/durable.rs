//! Test of the durability of results: a result is written through to disk (`fsync`) before it gets its name (`rename`),
//! and the rename is made durable afterwards. The test checks the order of the system calls, which a preloaded library
//! records; the order decides what survives a power failure.
#![cfg(all(target_os = "linux", target_env = "gnu"))]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::scene::{Workplace, files, program, tiny};

/// C source of a library that records system calls: it passes `fsync` and `rename` on unchanged and appends each call
/// to the file that the environment variable NOTES names, in order.
const NOTES: &str = r#"
#define _GNU_SOURCE
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

static void note(const char *what, const char *from, const char *to) {
    int notes = open(getenv("NOTES"), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
    dprintf(notes, "%s\t%s\t%s\n", what, from, to);
    close(notes);
}

int fsync(int fd) {
    char link[64], path[PATH_MAX + 1];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, PATH_MAX);
    path[length < 0 ? 0 : length] = 0;
    note("sync", path, "");
    return syscall(SYS_fsync, fd);
}

int rename(const char *from, const char *to) {
    char real[PATH_MAX + 1];
    note("rename", realpath(from, real) ? real : from, to);
    return syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0);
}
"#;

/// Recorded system call of the program.
#[derive(Debug, PartialEq)]
enum Call {
    Sync(PathBuf),
    Rename(PathBuf, PathBuf),
}

/// Runs the program with the preloaded library `shim`, which records system calls. Returns all `fsync` and `rename`
/// calls of the program in order.
fn recorded_calls(workplace: &Workplace, shim: &Path, arguments: &str) -> Vec<Call> {
    let notes = workplace.path("notes");
    let _ = fs::remove_file(&notes);
    let words = arguments.split_whitespace().map(|word| if word == "{tiny}" { tiny() } else { workplace.path(word) });
    let output = Command::new(program())
        .args(arguments.split_whitespace().zip(words).map(|(word, path)| match word {
            word if word.starts_with('{') || word.contains('.') || word == "out" => path.into_os_string(),
            word => word.into(),
        }))
        .env("LD_PRELOAD", shim)
        .env("NOTES", &notes)
        .output()
        .unwrap();
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    let text = fs::read_to_string(&notes).unwrap_or_else(|_| panic!("{arguments}: neither syncs nor renames"));
    let call = |line: &str| match line.split('\t').collect::<Vec<_>>()[..] {
        ["sync", path, _] => Call::Sync(path.into()),
        ["rename", from, to] => Call::Rename(from.into(), to.into()),
        _ => panic!("{line:?}"),
    };
    text.lines().map(call).collect()
}

#[test]
fn results_are_synced_before_and_after_renaming() {
    let workplace = Workplace::new();
    let (source, shim) = (workplace.path("notes.c"), workplace.path("notes.so"));
    fs::write(&source, NOTES).unwrap();
    let compiler = std::env::var_os("CC").unwrap_or_else(|| "cc".into());
    let compiled = Command::new(compiler).args(["-shared", "-fPIC", "-o"]).args([&shim, &source]).status().unwrap();
    assert!(compiled.success(), "a C compiler is needed to build this program and to test it");
    for (arguments, results) in [
        ("convert {tiny} packed.gseq", &["packed.gseq"][..]),
        ("compress {tiny} -o out --no-refine", &["out"]),
        ("compress {tiny} -o out --no-refine --overwrite", &["out"]),
        (
            "compress packed.gseq -o small.gseq --no-refine",
            &["small.gseq", "small.gseq.recipe.toml", "small.gseq.index_map.npy", "small.gseq.summary.json"],
        ),
    ] {
        let calls = recorded_calls(&workplace, &shim, arguments);
        for result in results.iter().map(|name| workplace.path(name)) {
            let named = |call: &Call| matches!(call, Call::Rename(_, to) if *to == result);
            let at = calls.iter().position(named).unwrap_or_else(|| panic!("{arguments}: {result:?} got no name"));
            let Call::Rename(from, _) = &calls[at] else { unreachable!() };
            let mut parts = vec![from.clone()];
            if result.is_dir() {
                parts.extend(files(&result).into_keys().map(|name| from.join(name)));
                assert!(parts.len() > 4, "{arguments}: {parts:?}");
            }
            for part in parts {
                let before = calls[..at].contains(&Call::Sync(part.clone()));
                assert!(before, "{arguments}: {part:?} is not synced before it gets its name");
            }
            let folder = result.parent().unwrap().canonicalize().unwrap();
            assert!(calls[at..].contains(&Call::Sync(folder)), "{arguments}: the name of {result:?} is not synced");
        }
    }
}
