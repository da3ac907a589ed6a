//! Everything that differs between Linux, macOS and Windows: files, folders, signals and memory limits.
//!
//! Other crates of the workspace contain no code for one operating system. Each function below exists on all three
//! systems with the same signature. **Only Linux is tested.** The code for macOS and Windows is type-checked.
//!
//! | | Linux | macOS | Windows |
//! |---|---|---|---|
//! | [`read_exact_at`] | one position for each call | as on Linux | moves the file's own position, too |
//! | [`FileStatus`], [`FileIdentity`] | device and inode | as on Linux | volume and file index |
//! | [`FileKind`] | all kinds | all kinds | file, folder, link, other |
//! | [`open_without_waiting`] | `O_NONBLOCK` | as on Linux | a plain open: nothing that is opened waits |
//! | [`open_stream`] | device or FIFO | as on Linux | refused: nothing is known as a stream |
//! | [`FolderHandle`] | relative to an open descriptor | as on Linux | by path, after a check of the identity |
//! | [`FolderStatus::is_own`], [`FolderStatus::is_private`] | owner and mode | as on Linux | never: no folder is taken over |
//! | [`create_private_folder`] | mode 0700 | as on Linux | permissions of the parent |
//! | [`sync_file`], [`sync_folder`] | both | both | files only |
//! | [`is_cached`] | `preadv2` | unknown | unknown |
//! | [`expect_pages`], [`release_pages`] | `madvise` | `madvise` | nothing: the system decides |
//! | [`end_on_signals`] | SIGINT, SIGTERM, SIGHUP | as on Linux | Ctrl+C, Ctrl+Break, closed console |
//! | [`report_cut_short_maps`] | SIGBUS handler | nothing | nothing: a mapped file cannot be cut short |
//! | [`memory_limits`] | machine, control groups, process | machine, process | machine, job object |
//! | [`peak_memory_bytes`] | `VmHWM` | `ru_maxrss` | peak working set |
//! | [`reset_peak_memory`] | `clear_refs` | not possible | not possible |
//!
//! File locks are those of [`std::fs::File`]: `flock` on Linux and macOS, `LockFileEx` on Windows.
//!
//! The crate `sysinfo` was considered for memory limits. It reads the limit at the root of the control groups only. The
//! limits of the process's own group and of the groups around it, `memory.high`, and groups that are mounted elsewhere
//! would be missed, so this crate reads them itself ([`memory_limits`]).

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
pub use linux::{is_cached, memory_limits, peak_memory_bytes, report_cut_short_maps, reset_peak_memory};
#[cfg(target_os = "macos")]
pub use macos::{is_cached, memory_limits, peak_memory_bytes, report_cut_short_maps, reset_peak_memory};
#[cfg(unix)]
pub use unix::{
    FolderHandle, create_private_folder, end_on_signals, expect_pages, is_standard_output, is_system_folder,
    open_stream, open_without_waiting, private_permissions, read_exact_at, release_pages, sync_file, sync_folder,
};
#[cfg(windows)]
pub use windows::{
    FolderHandle, create_private_folder, end_on_signals, expect_pages, is_cached, is_standard_output, is_system_folder,
    memory_limits, open_stream, open_without_waiting, peak_memory_bytes, private_permissions, read_exact_at,
    release_pages, report_cut_short_maps, reset_peak_memory, sync_file, sync_folder,
};

/// Identity of a file or folder: equal for two paths exactly if both lead to the same file or folder.
///
/// Device and inode on Linux and macOS, serial number of the volume and index of the file on Windows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileIdentity {
    volume: u64,
    number: u64,
}

/// Identity and length of a file.
///
/// The constructors are `from_file` for an open file and `from_path`, which follows links.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileStatus {
    /// Tells the file from another one that took its name.
    pub identity: FileIdentity,
    /// Length in bytes.
    pub length: u64,
}

/// Identity, owner and permissions of a folder.
#[derive(Debug, Clone, Copy)]
pub struct FolderStatus {
    /// Tells the folder from another one that took its name.
    pub identity: FileIdentity,
    /// Whether the folder belongs to the user of this process. False where the system does not tell, as on Windows.
    pub is_own: bool,
    /// Whether group and others may neither read nor write. False where the system does not tell, as on Windows.
    pub is_private: bool,
}

/// Kind of an entry of a folder. Windows knows only files, folders, links and others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    /// A regular file.
    File,
    /// A folder.
    Folder,
    /// A symbolic link.
    Link,
    /// A named pipe.
    Fifo,
    /// A socket.
    Socket,
    /// A device that is read or written as a sequence of bytes, such as a terminal.
    CharacterDevice,
    /// A device that is read or written in blocks, such as a disk.
    BlockDevice,
    /// Any other kind.
    Other,
}

impl FileKind {
    /// Kind that the standard library found.
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

/// Limit of the memory that this process may take.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemoryLimit {
    /// The limit in bytes, as the system states it: 0 and numbers from [`UNLIMITED_BYTES`] on stand for no limit.
    pub bytes: u64,
    /// Part of the system that sets the limit.
    pub source: LimitSource,
}

/// Part of the system that limits memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LimitSource {
    /// Physical memory of the machine.
    Machine,
    /// A Linux control group; the file that holds the limit.
    ControlGroup(PathBuf),
    /// A Windows job object.
    JobObject,
    /// The process's own limit of its address space (`ulimit -v`).
    AddressSpace,
    /// The process's own limit of its data (`ulimit -d`).
    DataSize,
}

/// All limits of memory that the system states.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MemoryLimits {
    /// Limits around the process: of the machine, then of control groups or job objects.
    pub around: Vec<MemoryLimit>,
    /// Limits of the process itself.
    pub own: Vec<MemoryLimit>,
}

/// No memory is as large. Control groups of version 1 without a limit state some such number.
pub const UNLIMITED_BYTES: u64 = 1 << 62;

/// Text that a process writes to standard error before it ends because a mapped file was cut short: `before`, the path,
/// `after`.
#[derive(Debug, Clone, Copy)]
pub struct CutShortMessage {
    /// Text before the path.
    pub before: &'static str,
    /// Text in place of a path that is not known.
    pub unknown_path: &'static str,
    /// Text after the path, with its line break.
    pub after: &'static str,
}
