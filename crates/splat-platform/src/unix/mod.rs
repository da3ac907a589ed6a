//! Implementation for Linux and macOS: files, folders and memory maps.

mod folder;
mod signals;

use std::fs::{DirBuilder, File, FileType, Metadata, OpenOptions, Permissions};
use std::io;
use std::ops::Range;
use std::os::fd::AsFd as _;
use std::os::unix::fs::{DirBuilderExt as _, FileExt as _, FileTypeExt as _, MetadataExt as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::Path;

use memmap2::{Advice, Mmap, UncheckedAdvice};
use rustix::fs::OFlags;

use crate::{FileIdentity, FileKind, FileStatus};
pub use folder::FolderHandle;
pub use signals::end_on_signals;

/// Permissions (mode bits) of a private folder, which only its owner may enter, read or write.
const PRIVATE_MODE: u32 = 0o700;

/// Fills `bytes` with the bytes of `file` from byte `offset` on. Several threads may read one file at the same time.
///
/// # Errors
/// Fails if a read fails or the file ends before `bytes` is full.
pub fn read_exact_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    file.read_exact_at(bytes, offset)
}

impl FileIdentity {
    /// Returns the identity of the file or folder that has the metadata `found`.
    fn from_metadata(found: &Metadata) -> FileIdentity {
        FileIdentity { volume: found.dev(), number: found.ino() }
    }
}

impl FileStatus {
    /// Returns the status of the file that has the metadata `found`.
    fn from_metadata(found: &Metadata) -> FileStatus {
        FileStatus { identity: FileIdentity::from_metadata(found), length: found.len() }
    }

    /// Returns the identity and length of an open file.
    ///
    /// # Errors
    /// Fails if the system refuses.
    pub fn from_file(file: &File) -> io::Result<FileStatus> {
        Ok(FileStatus::from_metadata(&file.metadata()?))
    }

    /// Returns the identity and length of the file at `path`. Follows links.
    ///
    /// # Errors
    /// Fails if the path does not exist or the system refuses.
    pub fn from_path(path: &Path) -> io::Result<FileStatus> {
        Ok(FileStatus::from_metadata(&std::fs::metadata(path)?))
    }
}

/// Returns the time, in nanoseconds since 1970, at which the content or the metadata of a file last changed. Programs
/// cannot set it, in contrast to the modification time, so it also differs after a file was replaced by one with an
/// equal modification time.
pub fn change_time(found: &Metadata) -> i128 {
    i128::from(found.ctime()) * 1_000_000_000 + i128::from(found.ctime_nsec())
}

/// Returns the kind of a folder entry that is not a regular file, folder or link.
pub(crate) fn special_kind(found: FileType) -> FileKind {
    match found {
        found if found.is_fifo() => FileKind::Fifo,
        found if found.is_socket() => FileKind::Socket,
        found if found.is_char_device() => FileKind::CharacterDevice,
        found if found.is_block_device() => FileKind::BlockDevice,
        _ => FileKind::Other,
    }
}

/// Opens the file at `path` for reading. Does not wait if `path` is a named pipe without a writer. Later reads of a
/// regular file are not affected.
///
/// # Errors
/// Fails if the path does not exist or the system refuses.
pub fn open_without_waiting(path: &Path) -> io::Result<File> {
    OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path)
}

/// Opens the character device or FIFO (named pipe) `path` for writing. Returns `None` for a FIFO that no program has
/// opened for reading. Writes to the returned file wait until there is space.
///
/// # Errors
/// Fails if the path does not exist or the system refuses.
pub fn open_stream(path: &Path) -> io::Result<Option<File>> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
    let opened = OpenOptions::new().write(true).custom_flags(flags.bits() as i32).open(path);
    let is_fifo = || std::fs::metadata(path).is_ok_and(|found| found.file_type().is_fifo());
    if opened.as_ref().is_err_and(|error| error.raw_os_error() == Some(libc::ENXIO)) && is_fifo() {
        return Ok(None);
    }
    let file = opened?;
    let flags = rustix::fs::fcntl_getfl(&file)?;
    rustix::fs::fcntl_setfl(&file, flags - OFlags::NONBLOCK)?;
    Ok(Some(file))
}

/// Returns whether `file` is the same file, device or pipe as the standard output of this process.
///
/// # Errors
/// Fails if the status of `file` cannot be read.
pub fn is_standard_output(file: &File) -> io::Result<bool> {
    let found = FileStatus::from_file(file)?;
    let out = io::stdout().as_fd().try_clone_to_owned().and_then(|out| FileStatus::from_file(&File::from(out)));
    Ok(out.is_ok_and(|out| out.identity == found.identity))
}

/// Returns whether `folder` belongs to the system, like `/dev` and `/proc`, so that links in it, such as `/dev/stdout`,
/// can be trusted. `folder` must be a path without links. The shared memory `/dev/shm` does not count, because its
/// files belong to users.
pub fn is_system_folder(folder: &Path) -> bool {
    (folder.starts_with("/dev") && !folder.starts_with("/dev/shm")) || folder.starts_with("/proc")
}

/// Creates the folder `path`, which only its owner may enter, read or write.
///
/// # Errors
/// Fails if an entry named `path` exists or the system refuses.
pub fn create_private_folder(path: &Path) -> io::Result<()> {
    DirBuilder::new().mode(PRIVATE_MODE).create(path)
}

/// Returns the permissions of a private folder, which only its owner may access, for callers that do not create the
/// folder with [`create_private_folder`]. Returns `None` on systems on which a folder has the permissions of its
/// parent.
pub fn private_permissions() -> Option<Permissions> {
    Some(Permissions::from_mode(PRIVATE_MODE))
}

/// Makes the system write the content of the file `path` to the disk, and waits for it.
///
/// # Errors
/// Fails if the path does not exist or a write fails.
pub fn sync_file(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Makes the system write the entries of the folder `path` to the disk, so that a finished rename survives a power
/// failure.
///
/// # Errors
/// Fails if the path does not exist or a write fails.
pub fn sync_folder(path: &Path) -> io::Result<()> {
    sync_file(path)
}

/// Tells the system that the bytes `range` of the memory map `map` will be read soon. Has no effect if the system
/// refuses.
pub fn prefetch_pages(map: &Mmap, range: Range<usize>) {
    _ = map.advise_range(Advice::WillNeed, range.start, range.len());
}

/// Gives the memory of the bytes `range` of the memory map `map` back to the system, so that they no longer count as
/// memory of this process. A later access reads the file again. Has no effect if the system refuses.
///
/// # Safety
/// `map` must be backed by a file and not by anonymous memory: the content of anonymous pages would be lost.
pub unsafe fn release_pages(map: &Mmap, range: Range<usize>) {
    // SAFETY: the advice drops modified private pages. The map is read-only and, as the caller guarantees, backed by a
    // file, so every dropped page returns with the bytes of the file and slices of the map stay valid.
    _ = unsafe { map.unchecked_advise_range(UncheckedAdvice::DontNeed, range.start, range.len()) };
}
