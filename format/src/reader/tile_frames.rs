//! Reads the frames of a tile (one column for a block of Gaussians and frames) one by one.

use std::ops::Range;
use std::sync::atomic::Ordering;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::{MERGE_GAP_BYTES, Reader, TileBuffer, check_payload, decompress, plane_len, read_stored};
use crate::codec::{Encoding, TileDecoder};
use crate::error::Result;
use crate::layout::TileId;
use crate::record::TileRecord;

/// Frames of one tile, which are decoded one at a time. Reading them in increasing order is fastest. [`Reader::load`]
/// loads a tile.
///
/// Memory: a compressed tile takes 4 bytes per value of all its frames and 8 bytes per value of one frame. A raw tile
/// (plain f32) takes no memory; if it is read in place from the memory map, the pages that were read count as memory
/// until they are released.
#[derive(Debug, Default)]
pub struct TileFrames {
    tile: Option<TileRecord>,
    decoder: TileDecoder,
    /// Whether the loaded tile, if it is raw (plain f32), is read in place from the memory map.
    in_place: bool,
    /// Part of the loaded raw tile (plain f32) that [`Reader::tiles_read`] counts already.
    counted: Counted,
}

/// Part of a raw tile (plain f32) that has been counted as read in [`Reader::tiles_read`], so that it is not counted
/// twice.
#[derive(Debug, Default, Clone, Copy, PartialEq)]
enum Counted {
    #[default]
    Nothing,
    /// One frame of the raw tile is counted at a time; the contained index, from 0 within the tile, is that of the last
    /// counted frame. If it is read again at once, it is not counted again.
    Frame(usize),
    /// The whole raw tile is counted, because [`Reader::load`] read all of it to check its checksum.
    Tile,
}

/// Byte ranges of tiles that were read in place from the memory map and whose pages have not been released by
/// [`Reader::release`] yet.
#[derive(Debug, Default)]
pub struct TouchedPages {
    ranges: Vec<Range<u64>>,
    bytes: u64,
}

impl Reader {
    /// Loads the tile `at` into `frames`, from which its frames can then be read. A compressed tile is checked against
    /// its checksum and decompressed. A raw tile (plain f32) is checked unless an earlier call has checked it. `buffer`
    /// is used only while loading. Fails if there is no such tile, if its bytes are damaged, or if they cannot be read.
    ///
    /// `touched` selects between two ways of reading the stored bytes:
    /// - `Some`: in place, from the memory map. [`Reader::tile`] states what happens if the file changes meanwhile. The
    ///   range of the read bytes is added to `touched`, so that the caller can release their pages with
    ///   [`Reader::release`]: the pages of a compressed tile after this call, the pages of a raw tile after its last
    ///   frame was read.
    /// - `None`: by system calls, as [`Reader::read_tile`] does. This is cheaper if only one frame of a raw tile is
    ///   read before its pages are released.
    pub fn load(
        &self,
        at: TileId,
        buffer: &mut TileBuffer,
        frames: &mut TileFrames,
        touched: Option<&mut TouchedPages>,
    ) -> Result<()> {
        let (index, tile) = self.record(at)?;
        // Set at the end, so that `frames` holds no tile after an error.
        frames.tile = None;
        frames.in_place = touched.is_some();
        frames.counted = Counted::Nothing;
        let mapped = match touched {
            Some(touched) => {
                touched.add(&tile);
                Some(self.file.in_place(tile.offset, tile.stored_bytes.into())?)
            }
            None => None,
        };
        match (tile.encoding, mapped) {
            (Encoding::Raw, mapped) => {
                let verified = match mapped {
                    Some(bytes) => self.verify_in_place(index, &tile, bytes)?,
                    None => self.verify_raw(index, &tile, &mut buffer.stored)?,
                };
                self.count(1, if verified { tile.stored_bytes as usize } else { 0 });
                if verified {
                    frames.counted = Counted::Tile;
                }
            }
            (Encoding::Filtered { .. } | Encoding::Bounded { .. }, mapped) => {
                let TileBuffer { stored, zstd, .. } = buffer;
                let stored = match mapped {
                    Some(bytes) => {
                        check_payload(&tile, xxh3_64(bytes)).map_err(|fault| fault.at(self.file.path()))?;
                        bytes
                    }
                    None => {
                        read_stored(&self.file, &tile, stored)?;
                        stored
                    }
                };
                self.count(1, stored.len());
                decompress(&self.file, &self.layout, &tile, stored, zstd, &mut frames.decoder)?;
            }
        }
        frames.tile = Some(tile);
        Ok(())
    }

    /// Writes the values of frame `frame` of the loaded tile to `out`, laid out as `[width, len]`: components ×
    /// Gaussians. Of a raw tile (plain f32) only this frame is read from the file, or copied from the memory map if the
    /// tile was loaded in place. Fails if the file has become too short.
    ///
    /// # Panics
    /// Panics if `out` has another size, if no tile was loaded into `frames` by this reader, or if the tile has no such
    /// frame.
    pub fn read_frame(&self, frames: &mut TileFrames, frame: usize, out: &mut [f32]) -> Result<()> {
        let (tile, frame) = self.loaded_frame(frames, frame);
        let plane = plane_len(&self.layout, &tile);
        assert!(out.len() == plane, "{} values for a frame of {tile:?}", out.len());
        match tile.encoding {
            Encoding::Raw => {
                self.count_frame(frames, frame, 4 * plane);
                let (offset, bytes) = (frame_offset(&tile, frame, plane), bytemuck::cast_slice_mut(&mut *out));
                match frames.in_place {
                    true => bytes.copy_from_slice(self.file.in_place(offset, bytes.len() as u64)?),
                    false => self.file.read_at(offset, bytes)?,
                }
                out.iter_mut().for_each(|value| *value = f32::from_bits(u32::from_le(value.to_bits())));
            }
            Encoding::Filtered { .. } | Encoding::Bounded { .. } => {
                frames.decoder.frame(frame, bytemuck::cast_slice_mut(out));
            }
        }
        Ok(())
    }

    /// Returns the values of frame `frame` of the loaded tile, laid out as `[width, len]`: components × Gaussians. They
    /// are a slice of the memory map if the tile is raw (plain f32) and was loaded in place; otherwise they are written
    /// to `buffer`. Fails if the file has become too short.
    ///
    /// # Panics
    /// Panics if no tile was loaded into `frames` by this reader, or if the tile has no such frame.
    pub fn frame<'a>(&'a self, frames: &mut TileFrames, frame: usize, buffer: &'a mut Vec<f32>) -> Result<&'a [f32]> {
        let (tile, stored) = self.loaded_frame(frames, frame);
        let plane = plane_len(&self.layout, &tile);
        if tile.encoding == Encoding::Raw && frames.in_place && cfg!(target_endian = "little") {
            let bytes = self.file.in_place(frame_offset(&tile, stored, plane), 4 * plane as u64)?;
            if let Ok(values) = bytemuck::try_cast_slice(bytes) {
                self.count_frame(frames, stored, bytes.len());
                return Ok(values);
            }
        }
        buffer.resize(plane, 0.0);
        self.read_frame(frames, frame, buffer)?;
        Ok(buffer)
    }

    /// Writes all stored values of the loaded tile to `out`, laid out as `[frames, width, len]`: frames × components ×
    /// Gaussians. If all frames of the tile are equal, only one is stored and written. Fails if the file has become too
    /// short.
    ///
    /// # Panics
    /// Panics if `out` has another size, or no tile was loaded.
    pub fn read_frames(&self, frames: &mut TileFrames, out: &mut [f32]) -> Result<()> {
        let (tile, _) = self.loaded_frame(frames, 0);
        assert!(out.len() == tile.value_count(&self.layout), "{} values for {tile:?}", out.len());
        let planes = out.chunks_exact_mut(plane_len(&self.layout, &tile)).enumerate();
        planes.into_iter().try_for_each(|(frame, out)| self.read_frame(frames, frame, out))
    }

    /// Gives the pages of `touched`, which were read in place, back to the operating system, so that they no longer
    /// count as memory of this process.
    pub fn release(&self, touched: &mut TouchedPages) {
        touched.bytes = 0;
        touched.ranges.sort_unstable_by_key(|range| range.start);
        let mut merged: Range<u64> = 0..0;
        for range in touched.ranges.drain(..) {
            if range.start > merged.end + MERGE_GAP_BYTES {
                self.file.release(std::mem::replace(&mut merged, range));
            } else {
                merged.end = merged.end.max(range.end);
            }
        }
        self.file.release(merged);
    }

    /// Returns the index entry of the tile loaded into `frames`, and the position of its frame `frame` among its stored
    /// frames. The position is `frame`, or 0 if all frames are equal, because only one is stored then.
    fn loaded_frame(&self, frames: &TileFrames, frame: usize) -> (TileRecord, usize) {
        let Some(tile) = frames.tile else { panic!("frame {frame} of no tile") };
        assert!(frame < tile.frames as usize, "frame {frame} of {tile:?}");
        (tile, if tile.constant { 0 } else { frame })
    }

    /// Counts the `bytes` bytes of frame `frame` of a raw tile (plain f32) as read ([`Reader::tiles_read`]), unless
    /// they were counted before.
    fn count_frame(&self, frames: &mut TileFrames, frame: usize, bytes: usize) {
        if frames.counted != Counted::Tile && frames.counted != Counted::Frame(frame) {
            frames.counted = Counted::Frame(frame);
            self.count(0, bytes);
        }
    }

    /// Checks the checksum of the raw tile (plain f32) at position `index` of the index, unless an earlier call has
    /// checked it. The tile is read in chunks into the buffer `chunk`. Returns whether this call checked it.
    fn verify_raw(&self, index: usize, tile: &TileRecord, chunk: &mut Vec<u8>) -> Result<bool> {
        if self.verified[index].load(Ordering::Relaxed) {
            return Ok(false);
        }
        let mut hash = Xxh3::new();
        self.file.read_chunks(tile.offset..tile.offset + u64::from(tile.stored_bytes), chunk, |_, bytes| {
            hash.update(bytes);
            Ok(())
        })?;
        check_payload(tile, hash.digest()).map_err(|fault| fault.at(self.file.path()))?;
        self.verified[index].store(true, Ordering::Relaxed);
        Ok(true)
    }
}

impl TileFrames {
    /// Returns the bytes of memory that the loaded tile takes.
    pub fn memory_bytes(&self) -> usize {
        self.decoder.memory()
    }

    /// Returns whether the loaded tile is raw (plain f32) and is read in place, from the memory map.
    pub fn is_in_place(&self) -> bool {
        self.in_place && self.tile.is_some_and(|tile| tile.encoding == Encoding::Raw)
    }
}

impl TouchedPages {
    /// Returns the number of bytes of tiles that were read in place from the memory map and whose pages have not been
    /// released yet.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Moves all byte ranges of `other` to this list.
    pub fn append(&mut self, other: &mut TouchedPages) {
        self.ranges.append(&mut other.ranges);
        self.bytes += std::mem::take(&mut other.bytes);
    }

    /// Adds the range of file bytes in which the tile with the index entry `tile` is stored.
    fn add(&mut self, tile: &TileRecord) {
        self.bytes += u64::from(tile.stored_bytes);
        self.ranges.push(tile.offset..tile.offset + u64::from(tile.stored_bytes));
    }
}

/// Returns the offset in the file of frame `frame` of a raw tile with `plane` values per frame.
fn frame_offset(tile: &TileRecord, frame: usize, plane: usize) -> u64 {
    tile.offset + 4 * (frame * plane) as u64
}
