//! The one place that maps a file: what a reader needs of it, and what is promised when it changes.
//!
//! Positioned reads ([`MappedFile::read_at`]) of a file that was cut short end in an error. Access in
//! place ([`MappedFile::in_place`]) compares the file's length with the place first, so it ends in an
//! error too, unless the file shrinks after that, while the slice is in use: then the system may end
//! the process (SIGBUS). What is left of that race is the time from the comparison to the end of one
//! tile's decoding or one frame's copy. Writers of this crate never shrink or rewrite a container; they
//! replace it by renaming, which leaves maps of the old one intact.
//!
//! Pages that were touched in place count as this process's memory until they are released
//! ([`MappedFile::release`]).

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use memmap2::Mmap;

use crate::error::{Error, Fault, Result};

/// Bytes read at a time where all of a long stretch is gone through: whole records.
pub(crate) const PIECE: usize = 1 << 16;

/// Bytes about a page that is touched which the system may map with it, as Linux does.
const AROUND: u64 = 1 << 16;

pub(crate) struct MappedFile {
    path: PathBuf,
    file: File,
    map: Mmap,
}

impl MappedFile {
    pub(crate) fn open(path: &Path) -> Result<Self> {
        // Asked before opening: opening a pipe would wait for its writer.
        let metadata = fs::metadata(path).map_err(Error::io("open", path))?;
        if !metadata.is_file() {
            return Err(Fault::new(0, "a regular file", "a folder, pipe or device").at(path));
        }
        let file = File::open(path).map_err(Error::io("open", path))?;
        // SAFETY: a map is sound while nobody changes the file's bytes. Whoever holds the file keeps
        // that promise; this crate's writers do, they only ever rename finished files into place.
        // The map is private to this module, is reached only after a check of the file's current
        // length, and no bit pattern of its bytes is invalid for the types read from it (u8, f32).
        let map = unsafe { Mmap::map(&file) }.map_err(Error::io("map", path))?;
        Ok(MappedFile { path: path.to_owned(), file, map })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Length in bytes when it was opened.
    pub(crate) fn len(&self) -> u64 {
        self.map.len() as u64
    }

    /// Reads `out.len()` bytes at byte `offset` with a system call. Does not use the memory map: if another process shortens
    /// the file, this returns an error, whereas touching a mapped page would end the process.
    pub(crate) fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<()> {
        splat_platform::read_exact_at(&self.file, out, offset).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => self.too_short(offset, out.len() as u64),
            _ => Error::io("read", &self.path)(error),
        })
    }

    /// Calls `each` with the bytes of `range` in pieces of [`PIECE`] bytes, the last of what is left, and the place of
    /// each.
    pub(crate) fn read_pieces(
        &self,
        range: std::ops::Range<u64>,
        piece: &mut Vec<u8>,
        mut each: impl FnMut(u64, &[u8]) -> Result<()>,
    ) -> Result<()> {
        for offset in range.clone().step_by(PIECE) {
            piece.resize((range.end - offset).min(PIECE as u64) as usize, 0);
            self.read_at(offset, piece)?;
            each(offset, piece)?;
        }
        Ok(())
    }

    /// `len` bytes at `offset`, where they lie in the map.
    pub(crate) fn in_place(&self, offset: u64, len: u64) -> Result<&[u8]> {
        let now = self.file.metadata().map_err(Error::io("examine", &self.path))?.len();
        match offset.checked_add(len) {
            Some(end) if end <= now.min(self.len()) => Ok(&self.map[offset as usize..end as usize]),
            _ => Err(self.too_short(offset, len)),
        }
    }

    /// Tells the system that the bytes of `range` will be read soon. Where the system does not listen, reading just waits
    /// for the disk.
    pub(crate) fn expect(&self, range: std::ops::Range<u64>) {
        if !range.is_empty() {
            splat_platform::expect_pages(&self.map, range.start as usize..range.end as usize);
        }
    }

    /// Brings the bytes of `range` from the disk, and waits for them. Nothing of them stays in this process.
    pub(crate) fn fetch(&self, range: std::ops::Range<u64>, piece: &mut Vec<u8>) -> Result<()> {
        self.read_pieces(range, piece, |_, _| Ok(()))
    }

    /// Whether reading the byte at `offset` would not wait for the disk; none where the system does not tell.
    pub(crate) fn is_cached(&self, offset: u64) -> Option<bool> {
        splat_platform::is_cached(&self.file, offset)
    }

    /// Gives the pages of `range`, and those that came with them, back to the system: they no longer count as this
    /// process's memory. Whoever still reads them in place reads them from the file again.
    pub(crate) fn release(&self, range: std::ops::Range<u64>) {
        let (start, end) = (range.start.saturating_sub(AROUND), range.end.saturating_add(AROUND).min(self.len()));
        if !range.is_empty() && start < end {
            // SAFETY: the map is that of a file, and the range lies within it.
            unsafe { splat_platform::release_pages(&self.map, start as usize..end as usize) };
        }
    }

    fn too_short(&self, offset: u64, len: u64) -> Error {
        let now = self.file.metadata().map_or(0, |metadata| metadata.len());
        Fault::new(offset, format!("{len} bytes"), format!("the end of the file at byte {now}")).at(&self.path)
    }
}
