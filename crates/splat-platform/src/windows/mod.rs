//! Implementation for Windows: files, folders, signals, memory maps and memory limits. The code is type-checked but not
//! tested.

mod folder;
mod memory;

use std::fs::{File, Metadata, OpenOptions, Permissions};
use std::io;
use std::mem::MaybeUninit;
use std::ops::Range;
use std::os::windows::fs::{FileExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::os::windows::io::AsRawHandle as _;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use memmap2::Mmap;
use windows_sys::Win32::Storage::FileSystem::{
    BY_HANDLE_FILE_INFORMATION, FILE_FLAG_BACKUP_SEMANTICS, GetFileInformationByHandle,
};
use windows_sys::Win32::System::Console::{CTRL_BREAK_EVENT, CTRL_C_EVENT, SetConsoleCtrlHandler};
use windows_sys::core::BOOL;

use crate::{FileIdentity, FileStatus, TruncatedMapMessage};
pub use folder::FolderHandle;
pub use memory::{memory_limits, peak_memory_bytes, reset_peak_memory, return_freed_memory};

/// Fills `bytes` with the bytes of `file` from byte `offset` on. Several threads may read one file at the same time.
/// Changes the file position, from which a later `Read` continues.
///
/// # Errors
/// Fails if a read fails or the file ends before `bytes` is full.
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
    /// Returns the identity and length of an open file.
    ///
    /// # Errors
    /// Fails if the system refuses.
    pub fn from_file(file: &File) -> io::Result<FileStatus> {
        let mut found = MaybeUninit::<BY_HANDLE_FILE_INFORMATION>::uninit();
        // SAFETY: the handle is open as long as `file`. `found` has the expected size and alignment and is read only if
        // the call reports success.
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

    /// Returns the identity and length of the file at `path`. Follows links.
    ///
    /// # Errors
    /// Fails if the path does not exist or the system refuses.
    pub fn from_path(path: &Path) -> io::Result<FileStatus> {
        FileStatus::from_file(&OpenOptions::new().read(true).custom_flags(FILE_FLAG_BACKUP_SEMANTICS).open(path)?)
    }
}

/// Returns the modification time of a file, in units of 100 ns since 1601. Unlike the change time of other systems,
/// programs can set it.
pub fn change_time(found: &Metadata) -> i128 {
    i128::from(found.last_write_time())
}

/// Opens the file at `path` for reading. On Windows this never waits.
///
/// # Errors
/// Fails if the path does not exist or the system refuses.
pub fn open_without_waiting(path: &Path) -> io::Result<File> {
    File::open(path)
}

/// Always fails: on Windows no path is recognized as a device or FIFO (named pipe).
///
/// # Errors
/// Always fails, because the operation is not supported.
pub fn open_stream(_path: &Path) -> io::Result<Option<File>> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Returns false, because Windows does not tell whether `file` is the file, device or pipe of standard output.
///
/// # Errors
/// Never fails.
pub fn is_standard_output(_file: &File) -> io::Result<bool> {
    Ok(false)
}

/// Always returns false: Windows has no folder of the system whose links could be trusted, such as `/dev`.
pub fn is_system_folder(_folder: &Path) -> bool {
    false
}

/// Creates the folder `path` with the permissions of its parent.
///
/// # Errors
/// Fails if an entry named `path` exists or the system refuses.
pub fn create_private_folder(path: &Path) -> io::Result<()> {
    std::fs::create_dir(path)
}

/// Always returns `None`: on Windows a folder has the permissions of its parent.
pub fn private_permissions() -> Option<Permissions> {
    None
}

/// Makes the system write the content of the file `path` to the disk, and waits for it.
///
/// # Errors
/// Fails if the path does not exist, the file cannot be opened for writing, or a write fails.
pub fn sync_file(path: &Path) -> io::Result<()> {
    OpenOptions::new().write(true).open(path)?.sync_all()
}

/// Does nothing: Windows cannot write the entries of a folder through to the disk.
///
/// # Errors
/// Never fails.
pub fn sync_folder(_path: &Path) -> io::Result<()> {
    Ok(())
}

/// Does nothing: Windows decides by itself which pages to read ahead.
pub fn prefetch_pages(_map: &Mmap, _range: Range<usize>) {}

/// Does nothing: Windows takes pages back when it needs them.
///
/// # Safety
/// `map` must be backed by a file and not by anonymous memory, as on the other systems.
pub unsafe fn release_pages(_map: &Mmap, _range: Range<usize>) {}

/// Does nothing: on Windows a mapped file cannot be truncated.
pub fn report_truncated_maps(_message: TruncatedMapMessage) {}

/// Function that cleans up and ends the process because of a signal, whose number is its argument.
type End = Box<dyn FnOnce(u8) + Send>;

/// Function to call at the next console event, such as Ctrl+C. `None` until [`end_on_signals`] sets it, and after an
/// event has taken it.
static END: Mutex<Option<End>> = Mutex::new(None);

/// Installs a handler for Ctrl+C, Ctrl+Break and closing the console. The handler calls `clean_up` and ends the process
/// with the code that `exit_code` returns for the number that the signal has on Linux and macOS: 2 for Ctrl+C and
/// Ctrl+Break, 15 for a closed console. The value that `clean_up` returns is kept until the process ends. If the
/// process is terminated in another way, it ends without `clean_up`.
pub fn end_on_signals<T>(clean_up: impl FnOnce() -> T + Send + 'static, exit_code: fn(u8) -> u8) {
    let end = Box::new(move |signal| {
        let _kept = clean_up();
        std::process::exit(exit_code(signal).into());
    });
    *END.lock().unwrap_or_else(PoisonError::into_inner) = Some(end);
    // SAFETY: the handler is a function of the expected type that lives as long as the process. If the system refuses,
    // an event ends the process at once.
    unsafe { SetConsoleCtrlHandler(Some(handle_event), 1) };
}

/// Handles a console event: cleans up and ends the process. The system calls this function on a separate thread.
unsafe extern "system" fn handle_event(event: u32) -> BOOL {
    let signal = if matches!(event, CTRL_C_EVENT | CTRL_BREAK_EVENT) { 2 } else { 15 };
    let end = END.lock().unwrap_or_else(PoisonError::into_inner).take();
    if let Some(end) = end {
        end(signal);
    }
    // This line is reached only if another event is being handled already. The value 1 tells the system that this event
    // needs no further handling.
    1
}
