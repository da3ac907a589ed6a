//! Memory-mapped files: reading by system calls or in place from the memory map, also while another process changes the
//! file.
//!
//! [`MappedFile::read_at`] reads by a system call and returns an error if the file was cut short.
//! [`MappedFile::in_place`] returns a slice of the memory map. It first compares the range with the current length of
//! the file, and returns an error if the file is too short. If the file shrinks after this check, while the slice is in
//! use, the operating system may end the process (SIGBUS). This can happen from the check until one tile has been
//! decoded or one frame has been copied. The writers of this crate never shrink or rewrite a container; they replace it
//! by renaming, which leaves memory maps of the old file intact.
//!
//! Pages that were read in place count as memory of this process until [`MappedFile::release`].

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use memmap2::Mmap;

use crate::error::{Error, Fault, Result};

/// Number of bytes that one system call reads from a long range of a file; a multiple of 64, the length of a record.
pub(crate) const CHUNK_BYTES: usize = 1 << 16;

/// Number of bytes around a page that the operating system may map together with it when it is first read (Linux:
/// fault-around of 64 KiB).
const FAULT_AROUND_BYTES: u64 = 1 << 16;

/// Open file, with a memory map of the length that it had when it was opened.
pub(crate) struct MappedFile {
    path: PathBuf,
    file: File,
    map: Mmap,
}

impl MappedFile {
    /// Opens and maps the regular file at `path`. Fails for folders, pipes and devices.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        // Checked before opening, because opening a pipe would wait for its writer.
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

    /// Returns the path by which the file was opened.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the length in bytes that the file had when it was opened.
    pub(crate) fn len(&self) -> u64 {
        self.map.len() as u64
    }

    /// Reads `out.len()` bytes from byte `offset` on, with a system call. If another process shortens the file, this
    /// returns an error, whereas reading a page of the memory map would end the process.
    pub(crate) fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<()> {
        splat_platform::read_exact_at(&self.file, out, offset).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => self.too_short(offset, out.len() as u64),
            _ => Error::io("read", &self.path)(error),
        })
    }

    /// Reads `range` in successive chunks and calls `each` with the offset and the bytes of every chunk. Every chunk
    /// has [`CHUNK_BYTES`] bytes except the last one, which may be shorter. The bytes are read into the buffer `chunk`.
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

    /// Returns `len` bytes from byte `offset` on as a slice of the memory map. Fails if the file has become too short.
    pub(crate) fn in_place(&self, offset: u64, len: u64) -> Result<&[u8]> {
        let now = self.file.metadata().map_err(Error::io("examine", &self.path))?.len();
        match offset.checked_add(len) {
            Some(end) if end <= now.min(self.len()) => Ok(&self.map[offset as usize..end as usize]),
            _ => Err(self.too_short(offset, len)),
        }
    }

    /// Tells the operating system that the bytes of `range` will be read soon. If the system ignores this advice, later
    /// reads wait for the disk.
    pub(crate) fn will_need(&self, range: std::ops::Range<u64>) {
        if !range.is_empty() {
            splat_platform::prefetch_pages(&self.map, range.start as usize..range.end as usize);
        }
    }

    /// Gives the pages of `range`, and the neighboring pages mapped with them, back to the operating system, so that
    /// they no longer count as memory of this process. Slices of these pages stay valid: their bytes are read from the
    /// file again.
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

    /// Returns the error for `len` bytes at `offset` that reach past the end of the file.
    fn too_short(&self, offset: u64, len: u64) -> Error {
        let now = self.file.metadata().map_or(0, |metadata| metadata.len());
        Fault::new(offset, format!("{len} bytes"), format!("the end of the file at byte {now}")).at(&self.path)
    }
}
