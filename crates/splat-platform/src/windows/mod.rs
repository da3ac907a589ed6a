//! Files, signals and memory of Windows. Type-checked only.

mod folder;
mod memory;

use std::fs::{File, OpenOptions, Permissions};
use std::io;
use std::mem::MaybeUninit;
use std::ops::Range;
use std::os::windows::fs::{FileExt as _, OpenOptionsExt as _};
use std::os::windows::io::AsRawHandle as _;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use memmap2::Mmap;
use windows_sys::Win32::Storage::FileSystem::{
    BY_HANDLE_FILE_INFORMATION, FILE_FLAG_BACKUP_SEMANTICS, GetFileInformationByHandle,
};
use windows_sys::Win32::System::Console::{CTRL_BREAK_EVENT, CTRL_C_EVENT, SetConsoleCtrlHandler};
use windows_sys::core::BOOL;

use crate::{CutShortMessage, FileIdentity, FileStatus};
pub use folder::FolderHandle;
pub use memory::{memory_limits, peak_memory_bytes, reset_peak_memory};

/// Reads `bytes.len()` bytes at byte `offset` of `file`. Several threads may read one file at the same time. Changes the
/// position at which `Read` continues.
///
/// # Errors
/// A failed read; a file that ends before.
pub fn read_exact_at(file: &File, mut bytes: &mut [u8], mut offset: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        match file.seek_read(bytes, offset) {
            Ok(0) => return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "failed to fill whole buffer")),
            Ok(read) => {
                bytes = &mut bytes[read..];
                offset += read as u64;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => (),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

impl FileStatus {
    /// Status of an open file.
    ///
    /// # Errors
    /// The system refuses.
    pub fn from_file(file: &File) -> io::Result<FileStatus> {
        let mut found = MaybeUninit::<BY_HANDLE_FILE_INFORMATION>::uninit();
        // SAFETY: the handle is open as long as `file`. `found` has the size and alignment that the call expects and is
        // read only after the call has said that it was written.
        let found = unsafe {
            if GetFileInformationByHandle(file.as_raw_handle(), found.as_mut_ptr()) == 0 {
                return Err(io::Error::last_os_error());
            }
            found.assume_init()
        };
        let joined = |high: u32, low: u32| u64::from(high) << 32 | u64::from(low);
        let number = joined(found.nFileIndexHigh, found.nFileIndexLow);
        let identity = FileIdentity { volume: u64::from(found.dwVolumeSerialNumber), number };
        Ok(FileStatus { identity, length: joined(found.nFileSizeHigh, found.nFileSizeLow) })
    }

    /// Status of the file at `path`, or of the file that a link at `path` leads to.
    ///
    /// # Errors
    /// Nothing there; the system refuses.
    pub fn from_path(path: &Path) -> io::Result<FileStatus> {
        FileStatus::from_file(&OpenOptions::new().read(true).custom_flags(FILE_FLAG_BACKUP_SEMANTICS).open(path)?)
    }
}

/// Opens `path` for reading.
///
/// # Errors
/// Nothing there; the system refuses.
pub fn open_without_waiting(path: &Path) -> io::Result<File> {
    File::open(path)
}

/// Refuses: on Windows no path is known as a device or FIFO.
///
/// # Errors
/// Always.
pub fn open_stream(_path: &Path) -> io::Result<Option<File>> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Whether `file` is the same file, device or pipe as standard output: not known on Windows, false.
///
/// # Errors
/// None.
pub fn is_standard_output(_file: &File) -> io::Result<bool> {
    Ok(false)
}

/// Whether links in `folder` belong to the system: Windows has no such folder.
pub fn is_system_folder(_folder: &Path) -> bool {
    false
}

/// Creates the folder `path` with the permissions of its parent.
///
/// # Errors
/// An entry of that name; the system refuses.
pub fn create_private_folder(path: &Path) -> io::Result<()> {
    std::fs::create_dir(path)
}

/// Permissions of a private folder: `None`, the parent decides about permissions.
pub fn private_permissions() -> Option<Permissions> {
    None
}

/// Writes the content of the file `path` through to the disk.
///
/// # Errors
/// Nothing there; a file that cannot be opened for writing; a failed write.
pub fn sync_file(path: &Path) -> io::Result<()> {
    OpenOptions::new().write(true).open(path)?.sync_all()
}

/// Does nothing: Windows cannot write the names in a folder through to the disk.
///
/// # Errors
/// None.
pub fn sync_folder(_path: &Path) -> io::Result<()> {
    Ok(())
}

/// Without effect on Windows, which decides by itself what to read ahead.
pub fn expect_pages(_map: &Mmap, _range: Range<usize>) {}

/// Without effect on Windows, which takes pages back when it needs them.
///
/// # Safety
/// As on the other systems: `map` is backed by a file and not by anonymous memory.
pub unsafe fn release_pages(_map: &Mmap, _range: Range<usize>) {}

/// Whether reading the byte at `offset` would not wait for the disk: not known on Windows.
pub fn is_cached(_file: &File, _offset: u64) -> Option<bool> {
    None
}

/// Without effect on Windows, where a mapped file cannot be cut short.
pub fn report_cut_short_maps(_message: CutShortMessage) {}

/// Ends the process because of a signal with this number.
type End = Box<dyn FnOnce(u8) + Send>;

static END: Mutex<Option<End>> = Mutex::new(None);

/// From now on Ctrl+C, Ctrl+Break and closing the console call `clean_up` and end the process with the code that `exit_code`
/// returns for the number of the signal that Linux and macOS send: 2 for Ctrl+C and Ctrl+Break, 15 otherwise. The value that
/// `clean_up` returns is not dropped before. A process that is terminated otherwise ends at once.
pub fn end_on_signals<T>(clean_up: impl FnOnce() -> T + Send + 'static, exit_code: fn(u8) -> u8) {
    let end = Box::new(move |signal| {
        let _kept = clean_up();
        std::process::exit(exit_code(signal).into());
    });
    *END.lock().unwrap_or_else(PoisonError::into_inner) = Some(end);
    // SAFETY: the handler is a function of the expected type that lives as long as the process. If the system refuses, an
    // event ends the process at once.
    unsafe { SetConsoleCtrlHandler(Some(handle_event), 1) };
}

/// Cleans up and ends the process. The system calls it on a thread of its own.
unsafe extern "system" fn handle_event(event: u32) -> BOOL {
    let signal = if matches!(event, CTRL_C_EVENT | CTRL_BREAK_EVENT) { 2 } else { 15 };
    let end = END.lock().unwrap_or_else(PoisonError::into_inner).take();
    if let Some(end) = end {
        end(signal);
    }
    // Another event is being handled.
    1
}
