//! Starts the program under test and measures its time and memory.

#![allow(dead_code, reason = "each attack uses a part of this module")]

use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// Bytes of one MiB.
pub(crate) const MIB: u64 = 1 << 20;

/// Memory limit of every test of an oversized input: the value of `--memory`, and the same in bytes.
pub(crate) const SMALL_MEMORY: (&str, u64) = ("64MiB", 64 * MIB);

/// Returns the time limit of one run in seconds; longer for an unoptimized program.
pub(crate) fn time_limit() -> f64 {
    if is_optimized() { 10.0 } else { 60.0 }
}

/// Returns whether `SPLATSIEVE_PROGRAM` names an optimized program to test in place of the one built with the tests.
pub(crate) fn is_optimized() -> bool {
    std::env::var_os("SPLATSIEVE_PROGRAM").is_some()
}

/// Returns the path of the program under test.
pub(crate) fn program() -> PathBuf {
    match std::env::var_os("SPLATSIEVE_PROGRAM") {
        Some(named) => fs::canonicalize(named).expect("SPLATSIEVE_PROGRAM names a file"),
        None => assert_cmd::cargo::cargo_bin("splatsieve"),
    }
}

/// Returns the path of the model of 300 Gaussians in the repository.
pub(crate) fn tiny_model() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model")
}

/// Returns the seed of the random choices of a test: the value of `SPLATSIEVE_SEED`, or else `default`.
pub(crate) fn seed(default: u64) -> u64 {
    let seed = std::env::var("SPLATSIEVE_SEED").ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    println!("SPLATSIEVE_SEED={seed}");
    seed
}

/// Generator of random numbers that depend only on the seed (SplitMix64 of Steele, Lea and Flood, 2014).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Random {
        Random(seed)
    }

    /// Returns 64 random bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Returns a number from 0 to `end - 1`; `end` must not be 0.
    pub(crate) fn below(&mut self, end: u64) -> u64 {
        self.bits() % end
    }
}

/// Temporary folder in which the program runs.
pub(crate) struct Folder(TempDir);

impl Folder {
    pub(crate) fn new() -> Folder {
        Folder(tempfile::tempdir().unwrap())
    }

    /// Returns the absolute path of the file or folder `name` in this folder; an empty name gives the folder itself.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        if name.is_empty() { self.0.path().to_owned() } else { self.0.path().join(name) }
    }

    /// Writes a file and the folders above it. Returns its path.
    pub(crate) fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, bytes).unwrap();
        path
    }

    /// Returns the sorted names of all entries of this folder, including hidden ones.
    pub(crate) fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Prepares a run of the program in this folder. Arguments are separated by spaces; `{tiny}` is replaced by the
    /// path of the tiny model.
    pub(crate) fn attack(&self, arguments: &str) -> Attack {
        let tiny = tiny_model();
        let words = arguments.split_whitespace();
        let words = words.map(|word| if word == "{tiny}" { tiny.clone().into() } else { OsString::from(word) });
        Attack::new(self.0.path(), words)
    }

    /// Prepares a run of the program in this folder with arguments that may contain spaces.
    pub(crate) fn attack_with(&self, arguments: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Attack {
        Attack::new(self.0.path(), arguments)
    }
}

/// Run of the program that has not started yet.
pub(crate) struct Attack {
    command: Command,
    seconds: f64,
    shown: String,
}

impl Attack {
    fn new(folder: &Path, arguments: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Attack {
        let mut command = Command::new(program());
        command.current_dir(folder).args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let shown: Vec<String> = command.get_args().map(|word| word.to_string_lossy().into_owned()).collect();
        Attack { command, seconds: time_limit(), shown: shown.join(" ") }
    }

    /// Sets the time limit in seconds, after which the run is killed; the default is [`time_limit`].
    pub(crate) fn within(mut self, seconds: f64) -> Attack {
        self.seconds = seconds;
        self
    }

    /// Sets the standard input of the run to `file`.
    pub(crate) fn stdin(mut self, file: impl Into<Stdio>) -> Attack {
        self.command.stdin(file);
        self
    }

    /// Sends the standard output of the run to `file` instead of a pipe that is read.
    pub(crate) fn stdout(mut self, file: impl Into<Stdio>) -> Attack {
        self.command.stdout(file);
        self
    }

    /// Sends the standard error of the run to `file` instead of a pipe that is read.
    pub(crate) fn stderr(mut self, file: impl Into<Stdio>) -> Attack {
        self.command.stderr(file);
        self
    }

    /// Sets an environment variable of the run.
    pub(crate) fn env(mut self, name: &str, value: impl AsRef<OsStr>) -> Attack {
        self.command.env(name, value);
        self
    }

    /// Applies `change` to the command that starts the program, for example to start it as another user or with a limit
    /// of the system.
    pub(crate) fn with(mut self, change: impl FnOnce(&mut Command)) -> Attack {
        change(&mut self.command);
        self
    }

    /// Starts the program and returns without waiting.
    pub(crate) fn start(mut self) -> Running {
        let started = Instant::now();
        let mut child = self.command.spawn().unwrap();
        let stdout = child.stdout.take().map(collect);
        let stderr = child.stderr.take().map(collect);
        Running { child, stdout, stderr, started, seconds: self.seconds, shown: self.shown }
    }

    /// Starts the program and waits for its end.
    pub(crate) fn run(self) -> Outcome {
        self.start().wait()
    }
}

/// Reads `pipe` to its end on another thread, so that the program never waits for a reader. The thread returns the
/// text.
fn collect(mut pipe: impl Read + Send + 'static) -> thread::JoinHandle<String> {
    thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = pipe.read_to_end(&mut bytes);
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

/// Run of the program that has started.
pub(crate) struct Running {
    child: Child,
    stdout: Option<thread::JoinHandle<String>>,
    stderr: Option<thread::JoinHandle<String>>,
    started: Instant,
    seconds: f64,
    shown: String,
}

impl Running {
    /// Returns the process id of the run.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends the signal `signal` to the run, for example `libc::SIGKILL`.
    pub(crate) fn signal(&self, signal: i32) {
        // SAFETY: the child has not been waited for, so its id names no other process.
        unsafe { libc::kill(self.child.id() as i32, signal) };
    }

    /// Waits for the end of the run; kills it at its time limit. Returns its result.
    pub(crate) fn wait(self) -> Outcome {
        let id = self.child.id() as i32;
        let mut is_killed = false;
        let (status, usage) = loop {
            let mut status = 0;
            let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
            // SAFETY: both pointers are valid for writes; the child is ours and has not been waited for.
            let ended = unsafe { libc::wait4(id, &mut status, libc::WNOHANG, usage.as_mut_ptr()) };
            assert!(ended >= 0, "wait4 failed");
            if ended == id {
                // SAFETY: zeroed at first and filled in by wait4.
                break (status, unsafe { usage.assume_init() });
            }
            if !is_killed && self.started.elapsed().as_secs_f64() > self.seconds {
                is_killed = true;
                self.signal(libc::SIGKILL);
            }
            thread::sleep(Duration::from_millis(2));
        };
        let text = |pipe: Option<thread::JoinHandle<String>>| pipe.map(|pipe| pipe.join().unwrap()).unwrap_or_default();
        Outcome {
            code: libc::WIFEXITED(status).then(|| libc::WEXITSTATUS(status)),
            signal: libc::WIFSIGNALED(status).then(|| libc::WTERMSIG(status)),
            is_timed_out: is_killed,
            stdout: text(self.stdout),
            stderr: text(self.stderr),
            peak_bytes: usage.ru_maxrss as u64 * 1024,
            seconds: self.started.elapsed().as_secs_f64(),
            shown: self.shown,
        }
    }
}

/// Result of a run.
#[derive(Debug)]
pub(crate) struct Outcome {
    /// Exit code; `None` if a signal ended the run.
    pub(crate) code: Option<i32>,
    /// Signal that ended the run.
    pub(crate) signal: Option<i32>,
    /// Whether the run was killed at its time limit.
    pub(crate) is_timed_out: bool,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
    /// Largest resident memory of the run in bytes, mapped pages included. The kernel also counts the memory that the
    /// test process had when it started the run, so tests write large inputs piece by piece.
    pub(crate) peak_bytes: u64,
    pub(crate) seconds: f64,
    /// Arguments of the run, for messages.
    pub(crate) shown: String,
}

impl Outcome {
    /// Checks that the run ended by itself and without a panic.
    pub(crate) fn ended(self) -> Outcome {
        let Outcome { shown, stderr, .. } = &self;
        assert!(!self.is_timed_out, "{shown}: killed after {:.0} s\n{stderr}", self.seconds);
        assert_eq!(self.signal, None, "{shown}: ended by a signal\n{stderr}");
        assert!(!stderr.contains("panicked at") && self.code != Some(101), "{shown}: panicked\n{stderr}");
        self
    }

    /// Checks that the run succeeded.
    pub(crate) fn succeeded(self) -> Outcome {
        let outcome = self.ended();
        assert_eq!(outcome.code, Some(0), "{}\n{}", outcome.shown, outcome.stderr);
        outcome
    }

    /// Checks that the run failed with `code` and that its message contains each of `parts`.
    pub(crate) fn refused(self, code: i32, parts: &[&str]) -> Outcome {
        let outcome = self.ended();
        assert_eq!(outcome.code, Some(code), "{}\n{}{}", outcome.shown, outcome.stdout, outcome.stderr);
        for part in parts {
            assert!(
                outcome.stderr.contains(part),
                "{}: {part:?} is not in the message:\n{}",
                outcome.shown,
                outcome.stderr
            );
        }
        outcome
    }

    /// Checks that the run ended by itself, with any exit code, within `bytes` of peak memory.
    pub(crate) fn within(self, bytes: u64) -> Outcome {
        let outcome = self.ended();
        assert!(
            outcome.peak_bytes <= bytes,
            "{}: peak memory {:.1} MiB, limit {:.1} MiB\n{}",
            outcome.shown,
            outcome.peak_bytes as f64 / MIB as f64,
            bytes as f64 / MIB as f64,
            outcome.stderr
        );
        outcome
    }
}

/// Opens for writing a device that is always full.
pub(crate) fn full_device() -> File {
    File::options().write(true).open("/dev/full").unwrap()
}
