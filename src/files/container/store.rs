//! Opens containers (`gseq` sequence files). An open container has columns (attributes), decoded tiles that are kept in
//! memory, and buffers for decoding. A tile holds the values of one attribute for a block of consecutive Gaussians and
//! frames.

use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};

use gseq::{Reader, TileBuffer, TileFrames, TileId, TouchedPages};

use super::held::HeldTiles;
use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::{Attributes, MAX_SH_DEGREE, SequenceInfo, sh_coefficient_count};
use crate::source::SharedCounter;

/// Open container file with one column for each attribute of Gaussians.
pub struct Container {
    pub(super) path: PathBuf,
    pub(super) reader: Reader,
    pub(super) info: SequenceInfo,
    /// Attributes in the order of [`Attributes::all`], each with the index of its column in the container.
    pub(super) places: Vec<(Attributes, u32)>,
    /// Decoding buffers that are free at present, shared by all readers; at most one per thread.
    pub(super) scratch: Mutex<Vec<TileScratch>>,
    /// Decoded tiles kept in memory; created when the first tile may be kept.
    pub(super) held: OnceLock<HeldTiles>,
    /// Number of states (one Gaussian at one frame) read so far.
    pub(super) states: SharedCounter,
}

/// Buffers in which a tile is decoded.
#[derive(Default)]
pub(super) struct TileScratch {
    pub(super) buffer: TileBuffer,
    pub(super) frames: TileFrames,
    /// Values of one frame of a tile, between decoding and copying them to the caller.
    pub(super) plane: Vec<f32>,
}

/// Decoding buffers that a thread has borrowed from the container. Dropping this value gives them back.
pub(super) struct ScratchGuard<'a> {
    from: &'a Mutex<Vec<TileScratch>>,
    scratch: TileScratch,
}

impl Container {
    /// Opens the container at `path` and checks that it holds Gaussians: columns position, rotation, log_scale,
    /// opacity_logit and sh, each of the right width.
    ///
    /// # Errors
    /// Fails like [`Reader::open`]. Also fails if a column is missing or has another width, or if there are 2³²
    /// Gaussians or more.
    pub fn open(path: &Path) -> Result<Container> {
        Self::open_within(path, ReadLimit::NONE)
    }

    /// Opens the container like [`Container::open`], using at most `memory` for the index of frames and tiles.
    ///
    /// # Errors
    /// Fails like [`Container::open`], and if the index needs more memory.
    pub fn open_within(path: &Path, memory: ReadLimit) -> Result<Container> {
        let reader = Reader::open_within(path, memory.bytes())?;
        let layout = reader.layout();
        let mut places = Vec::new();
        let mut sh_degree = 0;
        for column in Attributes::all().iter() {
            let place = layout.column(column.name()).ok_or_else(|| {
                let names: Vec<&str> = layout.columns.iter().map(|c| c.name.as_str()).collect();
                Error::input(path, "columns", format!("a column {}", column.name()), names.join(", "))
            })?;
            let width = layout.columns[place as usize].width as usize;
            let legal = match column {
                Attributes::ROTATION => width == 4,
                Attributes::OPACITY => width == 1,
                Attributes::SH => (0..=MAX_SH_DEGREE).any(|degree| width == 3 * sh_coefficient_count(degree)),
                _ => width == 3,
            };
            if !legal {
                let place = format!("column {}", column.name());
                return Err(Error::input(
                    path,
                    place,
                    "the width of its kind (see SPEC.md)",
                    format!("{width} components"),
                ));
            }
            if column == Attributes::SH {
                sh_degree = (0..=MAX_SH_DEGREE).find(|&degree| width == 3 * sh_coefficient_count(degree)).unwrap_or(0);
            }
            places.push((column, place));
        }
        let count = usize::try_from(layout.gaussians)
            .ok()
            .filter(|&count| count <= u32::MAX as usize)
            .ok_or_else(|| Error::input(path, "header", "fewer than 2^32 Gaussians", layout.gaussians.to_string()))?;
        let mut varying = Attributes::empty();
        for &(column, place) in &places {
            if reader.is_varying(place) {
                varying |= column;
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
            states: SharedCounter::default(),
        })
    }

    /// Returns the reader of the underlying container file.
    pub fn reader(&self) -> &Reader {
        &self.reader
    }

    /// Returns the path of the container file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns a hash of the values of all tiles as 16 hexadecimal digits.
    pub fn digest(&self) -> String {
        format!("{:016x}", self.reader.digest())
    }

    /// Allows up to `bytes` of decoded tiles to stay in memory as long as the container is open, so that later passes
    /// over the frames do not read the file again. Without this call no tile is kept. The number may be raised at any
    /// time; a smaller one has no effect. It does not change the values that are read.
    pub fn hold_decoded(&self, bytes: u64) {
        let own = self.slots() as u64 * HeldTiles::BYTES_PER_SLOT;
        if bytes > own {
            self.held.get_or_init(|| HeldTiles::new(self.slots())).allow(bytes - own);
        }
    }

    /// Returns the bytes of memory that [`Container::hold_decoded`] needs to keep every decoded tile. Less is used if
    /// an attribute that varies over time is constant in some tiles.
    pub fn decoded_bytes(&self) -> u64 {
        let values = |&(column, _): &(Attributes, u32)| {
            let frames = if self.info.varying.contains(column) { self.info.times.len() } else { 1 };
            (column.width(self.info.sh_degree) * frames) as u64 * self.info.count as u64
        };
        4 * self.places.iter().map(values).sum::<u64>() + self.slots() as u64 * HeldTiles::BYTES_PER_SLOT
    }

    /// Returns the number of tiles in the file, each of which has a slot for its decoded values. A column (attribute)
    /// that does not vary over time has tiles in only one frame block.
    pub(super) fn slots(&self) -> usize {
        self.slot(self.places.len(), 0, 0)
    }

    /// Returns the index of a tile in the list of all tiles of the file, which are ordered by attribute, then by frame
    /// block, then by Gaussian block. `index` is the index of the tile's attribute in [`Container::places`]. An
    /// attribute that does not vary over time has tiles in only one frame block, so `frame_block` is ignored for it.
    ///
    /// Returns the number of all tiles if `index` is the number of attributes and both blocks are 0.
    pub(super) fn slot(&self, index: usize, gaussian_block: u32, frame_block: u32) -> usize {
        let blocks = self.reader.layout().gaussian_blocks() as usize;
        let rows = |column| if self.info.varying.contains(column) { self.reader.frame_blocks() as usize } else { 1 };
        let before: usize = self.places[..index].iter().map(|&(column, _)| rows(column)).sum();
        let varies = self.places.get(index).is_some_and(|&(column, _)| self.info.varying.contains(column));
        (before + if varies { frame_block as usize } else { 0 }) * blocks + gaussian_block as usize
    }

    /// Returns the decoded values of the tile `at`, as `[frames, width, len]`: the frames of the tile, the components
    /// of its attribute, the Gaussians of the tile. A tile whose values are constant over time has one frame. `index`
    /// is the index of the attribute in [`Container::places`].
    ///
    /// Decodes the tile if its values are not in memory yet, and keeps them. Returns `None` if they do not fit into the
    /// memory allowed by [`Container::hold_decoded`].
    ///
    /// # Errors
    /// Fails if the tile cannot be read or decoded.
    pub(super) fn held(&self, index: usize, at: TileId) -> Result<Option<&[f32]>> {
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
                let TileScratch { buffer, frames, .. } = &mut *self.scratch();
                let mut touched = TouchedPages::default();
                self.reader.load(at, buffer, frames, Some(&mut touched))?;
                self.reader.read_frames(frames, values)?;
                self.reader.release(&mut touched);
                Ok(())
            },
        )
    }

    /// Returns whether the decoded tile of the given Gaussian block and frame block is in memory. `index` is the index
    /// of its attribute in [`Container::places`].
    pub(super) fn is_held(&self, index: usize, gaussian_block: u32, frame_block: u32) -> bool {
        self.held.get().is_some_and(|held| held.has(self.slot(index, gaussian_block, frame_block)))
    }

    /// Returns the tiles of the attributes `columns`, in the given Gaussian block and frame block, that are not in
    /// memory and have to be read from the file.
    pub(super) fn unheld(
        &self,
        columns: Attributes,
        gaussian_block: u32,
        frame_block: u32,
    ) -> impl Iterator<Item = TileId> {
        let needed = move |&(index, &(column, _)): &(usize, &(Attributes, u32))| {
            columns.contains(column) && !self.is_held(index, gaussian_block, frame_block)
        };
        let at = move |(_, &(_, column)): (usize, &(Attributes, u32))| TileId { column, gaussian_block, frame_block };
        self.places.iter().enumerate().filter(needed).map(at)
    }

    /// Returns decoding buffers, reusing free ones if there are any.
    pub(super) fn scratch(&self) -> ScratchGuard<'_> {
        let scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner).pop();
        ScratchGuard { from: &self.scratch, scratch: scratch.unwrap_or_default() }
    }
}

impl Deref for ScratchGuard<'_> {
    type Target = TileScratch;
    fn deref(&self) -> &TileScratch {
        &self.scratch
    }
}

impl DerefMut for ScratchGuard<'_> {
    fn deref_mut(&mut self) -> &mut TileScratch {
        &mut self.scratch
    }
}

impl Drop for ScratchGuard<'_> {
    fn drop(&mut self) {
        self.from.lock().unwrap_or_else(PoisonError::into_inner).push(std::mem::take(&mut self.scratch));
    }
}
