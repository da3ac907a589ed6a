//! Code that differs between Linux, macOS and Windows: files, folders, signals, memory maps, and memory limits.
//!
//! Other crates of the workspace contain no code for one operating system. Each function of this table exists on all
//! three systems with the same signature; the columns say how it works there. **Only Linux is tested.** The code for
//! macOS and Windows is type-checked.
//!
//! | | Linux | macOS | Windows |
//! |---|---|---|---|
//! | [`read_exact_at`] | leaves the file position alone | as on Linux | moves the file position |
//! | [`FileStatus`], [`FileIdentity`] | device and inode | as on Linux | volume and file index |
//! | [`change_time`] | `st_ctime` | as on Linux | modification time |
//! | [`FileKind`] | all kinds | all kinds | file, folder, link, other |
//! | [`open_without_waiting`] | `O_NONBLOCK` | as on Linux | plain open, which never waits |
//! | [`open_stream`] | device or FIFO | as on Linux | refused: no path is recognized as a stream |
//! | [`FolderHandle`] | relative to an open descriptor | as on Linux | by path, after a check of the identity |
//! | [`FolderStatus::is_own`], [`FolderStatus::is_private`] | owner and mode | as on Linux | always false |
//! | [`create_private_folder`] | mode 0700 | as on Linux | permissions of the parent |
//! | [`sync_file`], [`sync_folder`] | both | both | files only |
//! | [`prefetch_pages`], [`release_pages`] | advice on pages | advice on pages | no effect: the system decides |
//! | [`end_on_signals`] | SIGINT, SIGTERM, SIGHUP | as on Linux | Ctrl+C, Ctrl+Break, closed console |
//! | [`report_truncated_maps`] | SIGBUS handler | no effect | no effect: a mapped file cannot be truncated |
//! | [`memory_limits`] | machine, control groups, process | machine, process | machine, job object |
//! | [`peak_memory_bytes`] | `VmHWM` | `ru_maxrss` | peak working set |
//! | [`reset_peak_memory`] | `clear_refs` | not possible | not possible |
//! | [`return_freed_memory`] | `mallopt` of glibc | no effect | no effect |
//!
//! File locks are those of [`std::fs::File`]: `flock` on Linux and macOS, `LockFileEx` on Windows.
//!
//! The crate `sysinfo` was considered for memory limits. It reads only the limit of the root control group, and misses
//! `memory.high`, the limits of the group of the process and of its parent groups, and groups that are mounted
//! elsewhere. This crate therefore reads the limits itself ([`memory_limits`]).
//!
//! ```
//! use std::fs::File;
//! use splat_platform::{FileStatus, read_exact_at};
//!
//! let path = std::env::temp_dir().join(format!("splat-platform-example-{}", std::process::id()));
//! std::fs::write(&path, b"0123456789")?;
//! let file = File::open(&path)?;
//! let mut bytes = [0; 4];
//! read_exact_at(&file, &mut bytes, 3)?;
//! assert_eq!(&bytes, b"3456");
//! assert_eq!(FileStatus::from_file(&file)?, FileStatus::from_path(&path)?);
//! std::fs::remove_file(&path)?;
//! # Ok::<(), std::io::Error>(())
//! ```

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

use std::fs::FileType;
use std::path::PathBuf;

#[cfg(target_os = "linux")]
mod linux;
#[cfg(target_os = "macos")]
mod macos;
#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(not(any(target_os = "linux", target_os = "macos", windows)))]
compile_error!("this system is not supported: expected Linux, macOS or Windows");

#[cfg(target_os = "linux")]
pub use linux::{memory_limits, peak_memory_bytes, report_truncated_maps, reset_peak_memory, return_freed_memory};
#[cfg(target_os = "macos")]
pub use macos::{memory_limits, peak_memory_bytes, report_truncated_maps, reset_peak_memory, return_freed_memory};
#[cfg(unix)]
pub use unix::{
    FolderHandle, change_time, create_private_folder, end_on_signals, is_standard_output, is_system_folder,
    open_stream, open_without_waiting, prefetch_pages, private_permissions, read_exact_at, release_pages, sync_file,
    sync_folder,
};
#[cfg(windows)]
pub use windows::{
    FolderHandle, change_time, create_private_folder, end_on_signals, is_standard_output, is_system_folder,
    memory_limits, open_stream, open_without_waiting, peak_memory_bytes, prefetch_pages, private_permissions,
    read_exact_at, release_pages, report_truncated_maps, reset_peak_memory, return_freed_memory, sync_file,
    sync_folder,
};

/// Identity of a file or folder. Two paths have the same identity if and only if both lead to the same file or folder.
///
/// The identity consists of device and inode on Linux and macOS, and of volume serial number and file index on Windows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileIdentity {
    volume: u64,
    number: u64,
}

/// Status of a file: its identity and length.
///
/// Create it with `from_file` for an open file, or with `from_path`, which follows links, for a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileStatus {
    /// Identity of the file. Differs after another file has replaced this one under the same path.
    pub identity: FileIdentity,
    /// Length of the file in bytes.
    pub length: u64,
}

/// Status of a folder: its identity, owner and permissions.
#[derive(Debug, Clone, Copy)]
pub struct FolderStatus {
    /// Identity of the folder. Differs after another folder has replaced this one under the same path.
    pub identity: FileIdentity,
    /// Whether the folder belongs to the user of this process. False if the system gives no answer, as on Windows.
    pub is_own: bool,
    /// Whether all users but the owner are denied access to the folder. False if the system gives no answer, as on
    /// Windows.
    pub is_private: bool,
}

/// Kind of an entry of a folder. On Windows, only the kinds file, folder, link and other occur.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    /// Regular file.
    File,
    /// Folder.
    Folder,
    /// Symbolic link.
    Link,
    /// Named pipe.
    Fifo,
    /// Socket.
    Socket,
    /// Device that is read or written as a sequence of bytes, such as a terminal.
    CharacterDevice,
    /// Device that is read or written in blocks, such as a disk.
    BlockDevice,
    /// Entry of any kind for which [`FileKind`] has no other variant.
    Other,
}

impl FileKind {
    /// Converts the file type `found` of the standard library to the kind of entry.
    pub fn from_type(found: FileType) -> FileKind {
        match found {
            found if found.is_file() => FileKind::File,
            found if found.is_dir() => FileKind::Folder,
            found if found.is_symlink() => FileKind::Link,
            #[cfg(unix)]
            found => unix::special_kind(found),
            #[cfg(windows)]
            _ => FileKind::Other,
        }
    }
}

/// Limit of the memory that this process may use, and where it was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemoryLimit {
    /// Limit in bytes, as the system reports it: 0 and numbers from [`UNLIMITED_BYTES`] on mean no limit.
    pub bytes: u64,
    /// Part of the system that sets the limit, such as a control group.
    pub source: LimitSource,
}

/// Part of the system that limits memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LimitSource {
    /// Physical memory of the machine.
    Machine,
    /// Linux control group. Contains the path of the file that holds the limit.
    ControlGroup(PathBuf),
    /// Windows job object.
    JobObject,
    /// Limit of the address space of the process (`ulimit -v`).
    AddressSpace,
    /// Limit of the data size of the process (`ulimit -d`).
    DataSize,
}

/// Every memory limit that the system reports for this process.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MemoryLimits {
    /// Memory limits that this process shares with other processes: the physical memory of the machine first, then
    /// control groups or job objects.
    pub shared: Vec<MemoryLimit>,
    /// Memory limits of this process alone, such as those of `ulimit`.
    pub process: Vec<MemoryLimit>,
}

/// Smallest number of bytes that means "no limit". Control groups of version 1 without a limit report a number of this
/// size or more.
pub const UNLIMITED_BYTES: u64 = 1 << 62;

/// Parts of the message that the process writes to standard error before it ends because a file was truncated while it
/// was mapped to memory. The message is `before`, the path of the file, and `after`.
#[derive(Debug, Clone, Copy)]
pub struct TruncatedMapMessage {
    /// First part of the message, directly before the path of the truncated file.
    pub before: &'static str,
    /// Text that stands in the message in place of the path of the truncated file if the path is unknown.
    pub unknown_path: &'static str,
    /// Last part of the message, directly after the path of the truncated file. Must end with a line break.
    pub after: &'static str,
}

/// Compiles the example in the README of this crate as a documentation test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
mod readme {}
