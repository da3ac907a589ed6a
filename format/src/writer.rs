//! Writer of containers. The file has a temporary name until it is complete.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use crate::codec::EncodedTile;
use crate::error::{Error, Result};
use crate::file::CHUNK_BYTES;
use crate::layout::{ColumnSpec, Layout, TileId};
use crate::record::{Digest, FooterRecord, RECORD_BYTES, Record, TileRecord, TimesRecord, align, trailer_to_bytes};
use crate::text::ShowPath;

/// Writer of a container. For each frame block, append its time stamps ([`Writer::append_times`]) and write its tiles
/// ([`Writer::write_tile`]); then call [`Writer::finish`].
///
/// Tiles may be written in any order once the time stamps of their frame block have been appended. If all tiles of a
/// frame block are written before the next one begins, [`crate::recover`] saves the most after a crash. The order of
/// writing changes the bytes of the file, but not its content, and not the hash of the content
/// ([`crate::Reader::digest`]).
///
/// A constant tile (all frames equal) is not stored again if its bytes equal those of the last constant tile written
/// for its column and Gaussian block. A column that never changes therefore takes 128 bytes per further tile: a record
/// of 64 bytes before the index, and the same record in the index.
///
/// Memory: 8 bytes per frame, twice as many in [`Writer::finish`]; 80 bytes per column and Gaussian block; the stored
/// bytes of the largest constant tile. The index (table of tiles), 64 bytes per tile, is kept in an unnamed temporary
/// file in the same folder until the end.
///
/// The file grows under a hidden name ending in `.tmp`, in the folder of its final name. Dropping an unfinished writer
/// removes the file. A killed process leaves it behind; [`crate::recover`] can read it.
pub struct Writer {
    path: PathBuf,
    temporary: PathBuf,
    file: File,
    layout: Layout,
    header: Vec<u8>,
    /// Offset in the file at which the next record (of time stamps, of a tile or of the footer) is written; a multiple
    /// of 64.
    position: u64,
    times: Vec<f64>,
    /// Unnamed temporary file that contains the index: the 64-byte record of tile i at byte 64·i, or zeros if the tile
    /// is not written yet.
    index: File,
    /// Number of all tiles, written or not, of the frame blocks whose time stamps have been appended so far.
    tiles: u64,
    /// Number of tiles written so far.
    written: u64,
    /// Last constant tile written for each column and Gaussian block; empty before the first frame block.
    constants: Vec<Option<TileRecord>>,
    stored: Vec<u8>,
    finished: bool,
}

impl Writer {
    /// Creates a container that will get the name `path` when it is finished. Fails if the layout exceeds a limit of
    /// the format, or if the folder does not accept a new file.
    pub fn create(path: impl AsRef<Path>, layout: Layout) -> Result<Writer> {
        let path = path.as_ref();
        let mut header = layout.to_header()?;
        let (temporary, file) = create_beside(path)?;
        let index = tempfile::tempfile_in(folder_of(path)).map_err(|error| {
            // The error below is reported; a failure to remove the empty file is not.
            let _ = fs::remove_file(&temporary);
            Error::io("create the index of", path)(error)
        })?;
        let mut writer = Writer {
            path: path.to_owned(),
            temporary,
            file,
            constants: Vec::new(),
            layout,
            header: Vec::new(),
            position: 0,
            times: Vec::new(),
            index,
            tiles: 0,
            written: 0,
            stored: Vec::new(),
            finished: false,
        };
        writer.append_padded(&[&header])?;
        header.shrink_to_fit();
        writer.header = header;
        Ok(writer)
    }

    /// Returns the shape of the container: number of Gaussians, columns and block lengths.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Appends the next frame block and returns its number. `times` holds the time stamps of the frames of this block.
    /// Every block has [`Layout::frame_block`] frames; only the last one may have fewer, at least one.
    ///
    /// Fails if a time stamp is not finite or not greater than the previous one, if there are no or too many time
    /// stamps, or if the previous frame block has fewer than [`Layout::frame_block`] frames.
    pub fn append_times(&mut self, times: &[f64]) -> Result<u32> {
        let most = self.layout.frame_block as usize;
        let first = self.times.len();
        if !first.is_multiple_of(most) {
            return Err(Error::usage(format!(
                "frame {first}: no frames can follow a frame block of fewer than {most}"
            )));
        }
        if times.is_empty() || times.len() > most {
            return Err(Error::usage(format!(
                "frame {first}: a frame block has 1 to {most} frames, not {}",
                times.len()
            )));
        }
        let before = self.times.last().copied();
        check_times(before, times).map_err(|(frame, found)| {
            Error::usage(format!(
                "frame {}: time stamps must be finite and strictly increasing, {found}",
                first + frame
            ))
        })?;
        let block = u32::try_from(first / most).ok().filter(|&block| block < u32::MAX);
        let block = block.ok_or_else(|| Error::usage("a container has fewer than 2³² frame blocks"))?;
        let payload: Vec<u8> = times.iter().flat_map(|time| time.to_le_bytes()).collect();
        let record = TimesRecord { frame_block: block, frames: times.len() as u32, checksum: xxh3_64(&payload) };
        self.append_padded(&[&Record::Times(record).to_bytes(), &payload])?;
        self.times.extend(times);
        self.tiles += self.layout.tiles_per_frame_block();
        self.constants.resize(self.layout.tiles_per_frame_block() as usize, None);
        Ok(block)
    }

    /// Writes `tile` as the tile `at` (one column for a block of Gaussians and frames). Fails if there is no such tile,
    /// if its time stamps have not been appended, if it was written before, or if `tile` has another shape or a larger
    /// error bound than its column.
    pub fn write_tile(&mut self, at: TileId, tile: &EncodedTile) -> Result<()> {
        let (index, frames) = self.unwritten_entry(at)?;
        let &ColumnSpec { width, max_error, .. } = &self.layout.columns[at.column as usize];
        let len = self.layout.block_len(at.gaussian_block);
        let shape = |frames, width, len| format!("{frames} frames × {width} components × {len} Gaussians");
        if (tile.width, tile.len) != (width, len) || (tile.frames != frames && !tile.constant) {
            return Err(Error::usage(format!(
                "{at} holds {}, not {}",
                shape(frames, width, len),
                shape(tile.frames, tile.width, tile.len)
            )));
        }
        if tile.max_error > max_error {
            let found = tile.max_error;
            return Err(Error::usage(format!("{at} may be off by {max_error}, the bound of its column, not {found}")));
        }
        let mut record = TileRecord {
            id: at,
            frames,
            encoding: tile.encoding,
            constant: tile.constant,
            offset: self.position + RECORD_BYTES,
            stored_bytes: tile.bytes.len() as u32,
            checksum: tile.checksum,
            stats: tile.stats,
        };
        let slot = index as usize % self.constants.len();
        let start = self.position;
        match self.shared_payload(slot, &record, &tile.bytes)? {
            Some(offset) => {
                record.offset = offset;
                self.append_padded(&[&Record::Tile(record).to_bytes()])?;
            }
            None => self.append_padded(&[&Record::Tile(record).to_bytes(), &tile.bytes])?,
        }
        self.add_entry(index, record, start)?;
        if record.constant {
            self.constants[slot] = Some(record);
        }
        Ok(())
    }

    /// Writes the tile `at` as a copy of the last constant tile of its column and Gaussian block. The file gets the
    /// same bytes as if the values had been encoded again and given to [`Writer::write_tile`]. Fails if the layout has
    /// no tile `at`, if its time stamps have not been appended, if it was written before, or if no constant tile of its
    /// column and Gaussian block was written before.
    pub fn repeat_tile(&mut self, at: TileId) -> Result<()> {
        let (index, frames) = self.unwritten_entry(at)?;
        let slot = index as usize % self.constants.len();
        let Some(earlier) = self.constants[slot] else {
            return Err(Error::usage(format!("{at} has no constant tile before it to repeat")));
        };
        let record = TileRecord { id: at, frames, ..earlier };
        let start = self.position;
        self.append_padded(&[&Record::Tile(record).to_bytes()])?;
        self.add_entry(index, record, start)?;
        self.constants[slot] = Some(record);
        Ok(())
    }

    /// Returns the position of the tile `at` in the index, and its number of frames. Fails if the tile does not exist
    /// yet or was written before.
    fn unwritten_entry(&mut self, at: TileId) -> Result<(u64, u32)> {
        let Some(index) = self.layout.index_of(at).filter(|&index| index < self.tiles) else {
            return Err(Error::usage(format!("{at} does not exist after {} frames", self.times.len())));
        };
        if self.has_entry(index)? {
            return Err(Error::usage(format!("{at} was written already")));
        }
        let frames = self.layout.frame_range(at.frame_block, self.times.len() as u64);
        Ok((index, (frames.end - frames.start) as u32))
    }

    /// Returns whether the tile at position `index` of the index has been written.
    fn has_entry(&mut self, index: u64) -> Result<bool> {
        let mut bytes = Vec::new();
        let read = self.index.seek(SeekFrom::Start(RECORD_BYTES * index));
        let read = read.and_then(|_| (&self.index).take(RECORD_BYTES).read_to_end(&mut bytes));
        read.map_err(Error::io("read back the index of", &self.temporary))?;
        Ok(bytes.iter().any(|&byte| byte != 0))
    }

    /// Stores `record` at position `index` of the index, and counts its tile as written. The caller has already
    /// appended the tile to the file, from offset `start` on. If this function fails, it sets the writing position back
    /// to `start`, so that the next tile overwrites the appended one.
    fn add_entry(&mut self, index: u64, record: TileRecord, start: u64) -> Result<()> {
        let written = self.index.seek(SeekFrom::Start(RECORD_BYTES * index));
        let written = written.and_then(|_| self.index.write_all(&Record::Tile(record).to_bytes()));
        written.map_err(|error| {
            self.position = start;
            Error::io("write the index of", &self.temporary)(error)
        })?;
        self.written += 1;
        Ok(())
    }

    /// Reads the index from its temporary file. Calls `each` with this writer and the bytes of successive chunks of the
    /// index.
    fn for_each_index_chunk(&mut self, mut each: impl FnMut(&mut Writer, &[u8]) -> Result<()>) -> Result<()> {
        let end = RECORD_BYTES * self.tiles;
        let mut chunk = Vec::new();
        for offset in (0..end).step_by(CHUNK_BYTES) {
            chunk.resize((end - offset).min(CHUNK_BYTES as u64) as usize, 0);
            let read = self.index.seek(SeekFrom::Start(offset)).and_then(|_| self.index.read_exact(&mut chunk));
            read.map_err(Error::io("read back the index of", &self.temporary))?;
            each(self, &chunk)?;
        }
        Ok(())
    }

    /// Writes the footer, syncs the file to disk, renames it to its final name (replacing an existing file), and syncs
    /// the folder. Returns the hash of the content; see [`crate::Reader::digest`].
    ///
    /// Fails if a tile is missing; then no file appears under the final name.
    pub fn finish(mut self) -> Result<u64> {
        if self.written != self.tiles {
            let mut first = 0;
            while self.has_entry(first)? {
                first += 1;
            }
            return Err(Error::usage(format!(
                "{} of {} tiles are missing, the first is {}",
                self.tiles - self.written,
                self.tiles,
                self.layout.tile_at(first)
            )));
        }
        let times: Vec<u8> = self.times.iter().flat_map(|time| time.to_le_bytes()).collect();
        let mut checksum = Xxh3::new();
        checksum.update(&times);
        let mut digest = Digest::new(&self.header, &self.times);
        self.for_each_index_chunk(|writer, chunk| {
            checksum.update(chunk);
            for entry in chunk.as_chunks().0 {
                match Record::from_bytes(entry, 0) {
                    Ok(Record::Tile(tile)) => digest.tile(&tile),
                    _ => {
                        return Err(Error::io("read back the index of", &writer.temporary)(
                            io::ErrorKind::InvalidData.into(),
                        ));
                    }
                }
            }
            Ok(())
        })?;
        let footer = FooterRecord {
            frames: self.times.len() as u64,
            tiles: self.tiles,
            checksum: checksum.digest(),
            header_checksum: xxh3_64(&self.header),
        };
        let trailer = trailer_to_bytes(self.position);
        // The lengths of time stamps and index are multiples of 8. The trailer follows them without padding and ends
        // the file.
        self.append(&[&Record::Footer(footer).to_bytes(), &times])?;
        self.for_each_index_chunk(|writer, chunk| writer.append(&[chunk]))?;
        self.append(&[&trailer])?;
        // Removes bytes that a failed write may have left behind the end.
        self.file.set_len(self.position).map_err(Error::io("cut", &self.temporary))?;
        self.file.sync_all().map_err(Error::io("sync", &self.temporary))?;
        fs::rename(&self.temporary, &self.path).map_err(Error::io("rename", &self.temporary))?;
        self.finished = true;
        sync_folder(&self.path)?;
        Ok(digest.value())
    }

    /// Returns the offset in the file of stored bytes that equal `bytes`, if `record` is a constant tile and the last
    /// constant tile of `slot` (its column and Gaussian block) has such bytes. Equal checksums are only a hint; the
    /// bytes are read back and compared.
    fn shared_payload(&mut self, slot: usize, record: &TileRecord, bytes: &[u8]) -> Result<Option<u64>> {
        let Some(earlier) = self.constants[slot] else { return Ok(None) };
        if !record.may_share(&TileRecord { offset: record.offset, ..earlier }) {
            return Ok(None);
        }
        self.stored.resize(bytes.len(), 0);
        let read = self.file.seek(SeekFrom::Start(earlier.offset)).and_then(|_| self.file.read_exact(&mut self.stored));
        read.map_err(Error::io("read back from", &self.temporary))?;
        Ok((self.stored == bytes).then_some(earlier.offset))
    }

    /// Appends `parts` to the file, then zeros up to the next multiple of 64 bytes.
    fn append_padded(&mut self, parts: &[&[u8]]) -> Result<()> {
        let end = self.position + parts.iter().map(|part| part.len() as u64).sum::<u64>();
        let zeros = [0; RECORD_BYTES as usize];
        self.append(&[parts, &[&zeros[..(align(end) - end) as usize]]].concat())
    }

    /// Appends `parts` to the file. After an error the position is unchanged, so the call may be repeated.
    fn append(&mut self, parts: &[&[u8]]) -> Result<()> {
        let written = self
            .file
            .seek(SeekFrom::Start(self.position))
            .and_then(|_| parts.iter().try_for_each(|part| self.file.write_all(part)));
        written.map_err(Error::io("write", &self.temporary))?;
        self.position += parts.iter().map(|part| part.len() as u64).sum::<u64>();
        Ok(())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        if !self.finished {
            // A failure cannot be reported from here, and the name shows that the file is a temporary one.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

/// Checks that `times` are finite, strictly increasing and greater than `before`, the time stamp of the frame before
/// them (`None` if there is none). The error holds the index of the first time that violates this, and a description of
/// that time.
pub(crate) fn check_times(before: Option<f64>, times: &[f64]) -> std::result::Result<(), (usize, String)> {
    let mut last = before;
    for (frame, &time) in times.iter().enumerate() {
        if !time.is_finite() {
            return Err((frame, format!("not {time}")));
        }
        if let Some(last) = last.filter(|&last| last >= time) {
            return Err((frame, format!("not {time} after {last}")));
        }
        last = Some(time);
    }
    Ok(())
}

/// Creates the hidden file `.NAME.PID-N.tmp` in the folder of `path`, with the file name of `path`, the id of this
/// process, and a number that makes the name unique. Returns the path of the hidden file, and the open file.
fn create_beside(path: &Path) -> Result<(PathBuf, File)> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let Some(name) = path.file_name() else {
        return Err(Error::usage(format!("{} names no file", path.shown())));
    };
    loop {
        let number = COUNTER.fetch_add(1, Ordering::Relaxed);
        let mut hidden = std::ffi::OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}-{number}.tmp", std::process::id()));
        let temporary = path.with_file_name(hidden);
        match OpenOptions::new().read(true).write(true).create_new(true).open(&temporary) {
            // A killed process with the same id left this file behind: try the next number.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
            opened => return opened.map_err(Error::io("create", &temporary)).map(|file| (temporary, file)),
        }
    }
}

/// Returns the folder that contains the file `path`.
fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Syncs the folder of `path` to disk, so that a rename in it survives a power failure on systems that support this.
fn sync_folder(path: &Path) -> Result<()> {
    let folder = folder_of(path);
    splat_platform::sync_folder(folder).map_err(Error::io("sync", folder))
}
