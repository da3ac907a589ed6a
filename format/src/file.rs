//! Memory-mapped files: reading them by system calls and in place, and the behavior when a file changes meanwhile.
//!
//! [`MappedFile::read_at`] reads by a system call; if the file was cut short, it returns an error.
//! [`MappedFile::in_place`] returns a slice of the map. It compares the range with the current length of the file first
//! and returns an error if the file is too short. If the file shrinks after this check, while the slice is in use, the
//! system may end the process (SIGBUS). The race lasts from the check to the end of decoding one tile or copying one
//! frame. The writers of this crate never shrink or rewrite a container; they replace it by renaming, which leaves maps
//! of the old file intact.
//!
//! Pages that were read in place count as memory of this process until [`MappedFile::release`].

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use memmap2::Mmap;

use crate::error::{Error, Fault, Result};

/// Bytes read at a time where a long range is read in chunks; a multiple of the record length.
pub(crate) const CHUNK_BYTES: usize = 1 << 16;

/// Bytes around a touched page that the system may map together with it (Linux: fault-around of 64 KiB).
const FAULT_AROUND_BYTES: u64 = 1 << 16;
/// Open file with a memory map of its whole length at opening.

pub(crate) struct MappedFile {
    path: PathBuf,
    file: File,
    map: Mmap,
}

impl MappedFile {
    /// Opens and maps the regular file at `path`. Fails for folders, pipes and devices.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        // Check before opening: opening a pipe would wait for its writer.
        let metadata = fs::metadata(path).map_err(Error::io("open", path))?;
        if !metadata.is_file() {
            return Err(Fault::new(0, "a regular file", "a folder, pipe or device").at(path));
        }
        let file = File::open(path).map_err(Error::io("open", path))?;
        // SAFETY: the map is sound as long as nobody changes the bytes of the file. Whoever has write access to the
        // file must uphold this; the writers of this crate do, as they only rename finished files into place. The map
        // is private to this module, is reached only after a check of the current length of the file, and every bit
        // pattern is valid for the types read from it (u8, f32).
        let map = unsafe { Mmap::map(&file) }.map_err(Error::io("map", path))?;
        Ok(MappedFile { path: path.to_owned(), file, map })
    }

    /// Returns the path the file was opened by.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the length of the file in bytes at opening.
    pub(crate) fn len(&self) -> u64 {
        self.map.len() as u64
    }

    /// Reads `out.len()` bytes at byte `offset` with a system call. Does not use the memory map: if another process
    /// shortens the file, this returns an error, whereas touching a mapped page would end the process.
    pub(crate) fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<()> {
        splat_platform::read_exact_at(&self.file, out, offset).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => self.too_short(offset, out.len() as u64),
            _ => Error::io("read", &self.path)(error),
        })
    }

    /// Calls `each` with the offset and the bytes of successive chunks of `range`. Every chunk has [`CHUNK_BYTES`]
    /// bytes except the last one, which may be shorter.
    pub(crate) fn read_chunks(
        &self,
        range: std::ops::Range<u64>,
        chunk: &mut Vec<u8>,
        mut each: impl FnMut(u64, &[u8]) -> Result<()>,
    ) -> Result<()> {
        for offset in range.clone().step_by(CHUNK_BYTES) {
            chunk.resize((range.end - offset).min(CHUNK_BYTES as u64) as usize, 0);
            self.read_at(offset, chunk)?;
            each(offset, chunk)?;
        }
        Ok(())
    }

    /// Returns `len` bytes at `offset` as a slice of the map. Fails if the file is now too short.
    pub(crate) fn in_place(&self, offset: u64, len: u64) -> Result<&[u8]> {
        let now = self.file.metadata().map_err(Error::io("examine", &self.path))?.len();
        match offset.checked_add(len) {
            Some(end) if end <= now.min(self.len()) => Ok(&self.map[offset as usize..end as usize]),
            _ => Err(self.too_short(offset, len)),
        }
    }

    /// Tells the system that the bytes of `range` will be read soon. If the system ignores the advice, later reads wait
    /// for the disk.
    pub(crate) fn will_need(&self, range: std::ops::Range<u64>) {
        if !range.is_empty() {
            splat_platform::expect_pages(&self.map, range.start as usize..range.end as usize);
        }
    }

    /// Reads the bytes of `range` from the disk into the page cache of the system and waits for them. Keeps none of
    /// them in this process.
    pub(crate) fn fetch(&self, range: std::ops::Range<u64>, chunk: &mut Vec<u8>) -> Result<()> {
        self.read_chunks(range, chunk, |_, _| Ok(()))
    }

    /// Returns whether the byte at `offset` can be read without waiting for the disk; `None` if the system does not
    /// tell.
    pub(crate) fn is_cached(&self, offset: u64) -> Option<bool> {
        splat_platform::is_cached(&self.file, offset)
    }

    /// Gives the pages of `range`, and the neighboring pages mapped with them, back to the system. They no longer count
    /// as memory of this process. Slices of these pages stay valid: their bytes are read from the file again.
    pub(crate) fn release(&self, range: std::ops::Range<u64>) {
        let (start, end) = (
            range.start.saturating_sub(FAULT_AROUND_BYTES),
            range.end.saturating_add(FAULT_AROUND_BYTES).min(self.len()),
        );
        if !range.is_empty() && start < end {
            // SAFETY: the map is that of a file, so released pages are read again, and the range lies within the map
            // (clamped to its length above).
            unsafe { splat_platform::release_pages(&self.map, start as usize..end as usize) };
        }
    }

    /// Builds the error for `len` bytes at `offset` that reach past the end of the file.
    fn too_short(&self, offset: u64, len: u64) -> Error {
        let now = self.file.metadata().map_or(0, |metadata| metadata.len());
        Fault::new(offset, format!("{len} bytes"), format!("the end of the file at byte {now}")).at(&self.path)
    }
}
