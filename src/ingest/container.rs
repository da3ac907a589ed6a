//! A `gseq` container as a source of frames.
//!
//! In: the file. Out: the state of any Gaussians at any frame. Memory: what a reader keeps is that of [`TileReader`],
//! what is held for all readers that of [`HeldTiles`], and each thread that decodes has one [`Scratch`].
//!
//! Raw tiles are used where they lie in the map, packed ones are decoded straight from there. Pages that were touched
//! count as resident until they are released, so a reader releases what it used of a frame block when it enters another.
//! Where it may keep less than a frame block, positioned reads stay: releasing frame by frame costs more than their
//! copy. Raw frames into the caller's state (`cargo bench --bench scan`, `raw_frames`; two threads on two cores of an
//! EPYC that others kept busy, so compare them with one another): 1.5 GB/s released by frame block, 0.6 frame by frame, 1.4
//! by positioned reads, 2.3 left mapped.
//!
//! A file that lies in memory is read block by block, and the disk works ahead by advice: when a reader that decodes
//! whole frame blocks enters one, the system is told of the next. One that does not is scanned in stages
//! ([`FrameSource::ahead`]). On the same machine, blocks and stages: from a cold page cache 95 and 71 ms (raw), 222 and
//! 232 (packed); from a disk of 300 MB/s, simulated, 158 and 162, 216 and 206; from a warm one 46 and 45, 152 and 223,
//! as a packed scan waits for no disk, but its stages for one another.

mod held;
mod tiles;

use std::ops::{Deref, DerefMut, Range};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};

use gseq::{Reader, TileBuffer, TileFrames, TileId, Touched};

use self::held::HeldTiles;
use self::tiles::TileReader;
use crate::error::{Error, Result};
use crate::model::{Columns, SequenceInfo, sh_coefficients};
use crate::pass::{Ahead, BlockReader, Count, FrameSource, Ids, Reads};

/// Places of the file that are asked about to know whether the system holds it in memory.
const SAMPLES: u64 = 64;

/// An open container with all columns of a Gaussian model.
pub struct Container {
    path: PathBuf,
    reader: Reader,
    info: SequenceInfo,
    /// Place of each column in the container, in the order of [`Columns::ALL`].
    places: Vec<(Columns, u32)>,
    /// One for each thread at most, shared by all readers.
    scratch: Mutex<Vec<Scratch>>,
    /// Made when the first tile may be held.
    held: OnceLock<HeldTiles>,
    states: Count,
}

/// What decoding a tile takes besides what is kept of it.
#[derive(Default)]
struct Scratch {
    buffer: TileBuffer,
    frames: TileFrames,
    /// One frame of the tile.
    plane: Vec<f32>,
}

/// A [`Scratch`] on loan.
struct Lent<'a> {
    from: &'a Mutex<Vec<Scratch>>,
    scratch: Scratch,
}

impl Container {
    /// Opens the container and checks that it holds Gaussians: position, rotation, log_scale,
    /// opacity_logit and sh, each of its width.
    pub fn open(path: &Path) -> Result<Container> {
        let reader = Reader::open(path)?;
        let layout = reader.layout();
        let mut places = Vec::new();
        let mut sh_degree = 0;
        for column in Columns::ALL.iter() {
            let place = layout.column(column.name()).ok_or_else(|| {
                let names: Vec<&str> = layout.columns.iter().map(|c| c.name.as_str()).collect();
                Error::input(path, "columns", format!("a column {:?}", column.name()), format!("{names:?}"))
            })?;
            let width = layout.columns[place as usize].width as usize;
            let legal = match column {
                Columns::ROTATION => width == 4,
                Columns::OPACITY => width == 1,
                Columns::SH => (0..=3).any(|degree| width == 3 * sh_coefficients(degree)),
                _ => width == 3,
            };
            if !legal {
                let place = format!("column {:?}", column.name());
                return Err(Error::input(
                    path,
                    place,
                    "the width of its kind (see SPEC.md)",
                    format!("{width} components"),
                ));
            }
            if column == Columns::SH {
                sh_degree = (0..=3).find(|&degree| width == 3 * sh_coefficients(degree)).unwrap_or(0);
            }
            places.push((column, place));
        }
        let count = usize::try_from(layout.gaussians)
            .ok()
            .filter(|&count| count <= u32::MAX as usize)
            .ok_or_else(|| Error::input(path, "header", "fewer than 2^32 Gaussians", layout.gaussians.to_string()))?;
        let mut varying = Columns::NONE;
        for &(column, place) in &places {
            if reader.varies(place) {
                varying = varying | column;
            }
        }
        let info = SequenceInfo { count, times: reader.times().to_vec(), sh_degree, varying };
        Ok(Container {
            path: path.to_owned(),
            reader,
            info,
            places,
            scratch: Mutex::default(),
            held: OnceLock::new(),
            states: Count::default(),
        })
    }

    /// The reader underneath.
    pub fn reader(&self) -> &Reader {
        &self.reader
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Hash that covers every tile, as 16 hexadecimal digits.
    pub fn digest(&self) -> String {
        format!("{:016x}", self.reader.digest())
    }

    /// Lets the values of tiles stay in memory once they have been decoded, in at most `bytes`, as long as this lives:
    /// whoever reads them later does not read the file again. Nothing is held at first; more may be allowed at any time,
    /// less has no effect. Values read are the same.
    pub fn hold_decoded(&self, bytes: u64) {
        let own = self.slots() as u64 * HeldTiles::BYTES_PER_SLOT;
        if bytes > own {
            self.held.get_or_init(|| HeldTiles::new(self.slots())).allow(bytes - own);
        }
    }

    /// Bytes that holding every tile takes ([`Container::hold_decoded`]), at most: less where tiles of a column that
    /// varies are constant.
    pub fn decoded_bytes(&self) -> u64 {
        let values = |&(column, _): &(Columns, u32)| {
            let frames = if self.info.varying.contains(column) { self.info.times.len() } else { 1 };
            (column.width(self.info.sh_degree) * frames) as u64 * self.info.count as u64
        };
        4 * self.places.iter().map(values).sum::<u64>() + self.slots() as u64 * HeldTiles::BYTES_PER_SLOT
    }

    /// Tiles that differ: of a column that does not vary those of one frame block.
    fn slots(&self) -> usize {
        self.slot(self.places.len(), 0, 0)
    }

    /// Place among the tiles that differ of that of column `index` of `places`; of one more, their number.
    fn slot(&self, index: usize, gaussian_block: u32, frame_block: u32) -> usize {
        let blocks = self.reader.layout().gaussian_blocks() as usize;
        let rows = |column| if self.info.varying.contains(column) { self.reader.frame_blocks() as usize } else { 1 };
        let before: usize = self.places[..index].iter().map(|&(column, _)| rows(column)).sum();
        let varies = self.places.get(index).is_some_and(|&(column, _)| self.info.varying.contains(column));
        (before + if varies { frame_block as usize } else { 0 }) * blocks + gaussian_block as usize
    }

    /// The values `[frames, width, len]` of a tile of column `index` of `places` (one frame of a constant tile), if they
    /// are held or can be from now on.
    fn held(&self, index: usize, at: TileId) -> Result<Option<&[f32]>> {
        let Some(held) = self.held.get() else { return Ok(None) };
        held.get_or_decode(
            self.slot(index, at.gaussian_block, at.frame_block),
            || {
                let info = self.reader.tile_info(at)?;
                let frames = if info.constant { 1 } else { info.frames as usize };
                let range = self.reader.layout().gaussian_range(at.gaussian_block);
                let width = self.places[index].0.width(self.info.sh_degree);
                Ok(frames * width * (range.end - range.start) as usize)
            },
            |values| {
                let Scratch { buffer, frames, .. } = &mut *self.scratch();
                let mut touched = Touched::default();
                self.reader.load(at, buffer, frames, Some(&mut touched))?;
                self.reader.read_frames(frames, values)?;
                self.reader.release(&mut touched);
                Ok(())
            },
        )
    }

    /// Whether a tile of column `index` of `places` is held.
    fn is_held(&self, index: usize, gaussian_block: u32, frame_block: u32) -> bool {
        self.held.get().is_some_and(|held| held.has(self.slot(index, gaussian_block, frame_block)))
    }

    /// The tiles of `columns` that would have to be read.
    fn unheld(&self, columns: Columns, gaussian_block: u32, frame_block: u32) -> impl Iterator<Item = TileId> {
        let needed = move |&(index, &(column, _)): &(usize, &(Columns, u32))| {
            columns.contains(column) && !self.is_held(index, gaussian_block, frame_block)
        };
        let at = move |(_, &(_, column)): (usize, &(Columns, u32))| TileId { column, gaussian_block, frame_block };
        self.places.iter().enumerate().filter(needed).map(at)
    }

    fn scratch(&self) -> Lent<'_> {
        let scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner).pop();
        Lent { from: &self.scratch, scratch: scratch.unwrap_or_default() }
    }
}

impl Deref for Lent<'_> {
    type Target = Scratch;
    fn deref(&self) -> &Scratch {
        &self.scratch
    }
}

impl DerefMut for Lent<'_> {
    fn deref_mut(&mut self) -> &mut Scratch {
        &mut self.scratch
    }
}

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        self.from.lock().unwrap_or_else(PoisonError::into_inner).push(std::mem::take(&mut self.scratch));
    }
}

impl FrameSource for Container {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(TileReader::new(self, &ids)))
    }

    fn reads(&self) -> Reads {
        let read = self.reader.tiles_read();
        Reads { bytes: read.bytes, tiles: read.tiles, states: self.states.get() }
    }

    /// Not for a file that lies in memory: see the figures at the top of this module.
    fn ahead(&self) -> Option<&dyn Ahead> {
        match self.reader.is_cached(SAMPLES) {
            Some(true) => None,
            _ => Some(self),
        }
    }
}

impl Ahead for Container {
    fn frame_block(&self) -> usize {
        self.reader.layout().frame_block as usize
    }

    fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Columns) {
        if gaussians.is_empty() || frames.is_empty() {
            return;
        }
        let layout = self.reader.layout();
        let block = |id: usize, of: u32| (id / of as usize) as u32;
        let of = layout.gaussian_block;
        for frame_block in block(frames.start, layout.frame_block)..=block(frames.end - 1, layout.frame_block) {
            for gaussian_block in block(gaussians.start, of)..=block(gaussians.end - 1, of) {
                let tiles = || self.unheld(want, gaussian_block, frame_block);
                // All at once, then waiting for one after the other.
                self.reader.expect(tiles());
                self.reader.fetch(tiles());
            }
        }
    }
}

#[cfg(test)]
mod tests;
