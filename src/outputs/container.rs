//! Writes any sequence to a container: frame block by frame block, tile by tile.
//!
//! Memory: for every thread one tile of every column ([`GAUSSIAN_BLOCK`] × frames of a block values of each of its
//! components), and as much again while it is encoded (four times the tile for a column with an error bound); 80 bytes
//! per column and block of Gaussians, 16 per frame.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::{ColumnSpec, Compression, EncodedTile, Layout, TileId, Writer, encode_tile};
use rayon::prelude::*;

use super::bounds::Bounds;
use crate::cache::{CacheKey, Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Attributes, Gaussians};
use crate::source::{FrameSource, Ids};

/// Number of Gaussians per tile, which one task of a scan reads. Fixed, so that the bytes depend on nothing but the
/// content.
pub const GAUSSIAN_BLOCK: usize = 1024;
/// Number of frames per tile, except for streams with large frames.
pub const FRAME_BLOCK: usize = 32;
/// Number of frames per tile with error bounds, where the first frame takes as much space as all others together.
pub const BOUNDED_FRAME_BLOCK: usize = 64;

/// Encoding of the values in a container.
#[derive(Debug, Clone, Copy)]
pub struct Packing {
    compression: Compression,
    bounds: Bounds,
}

impl From<Compression> for Packing {
    /// Returns the lossless encoding with `compression`.
    fn from(compression: Compression) -> Packing {
        Packing { compression, bounds: Bounds::default() }
    }
}

impl Packing {
    /// Returns the encoding with errors within `bounds`, compressed by zstd at `level`.
    pub fn within(bounds: Bounds, level: i32) -> Packing {
        Packing { compression: Compression::Zstd(level), bounds }
    }

    /// Returns the number of frames per tile.
    pub fn frame_block(&self) -> usize {
        if self.bounds == Bounds::default() { FRAME_BLOCK } else { BOUNDED_FRAME_BLOCK }
    }

    /// Returns the number of frame blocks of `source`.
    pub fn frame_blocks(&self, source: &dyn FrameSource) -> usize {
        source.info().times.len().div_ceil(self.frame_block())
    }

    /// Returns the frames of frame block `block`.
    pub fn frames(&self, source: &dyn FrameSource, block: usize) -> Range<usize> {
        let start = block * self.frame_block();
        start..source.info().times.len().min(start + self.frame_block())
    }

    /// Returns the cache key of this encoding; the values are not included.
    pub fn key(&self) -> CacheKey {
        let column_key = |column| match self.column(column) {
            Compression::Raw => (0, 0.0, 0),
            Compression::Zstd(level) => (1, 0.0, level),
            Compression::Bounded { max_error, level } => (2, max_error, level),
        };
        let columns: Vec<(u8, f64, i32)> = Attributes::all().iter().map(column_key).collect();
        CacheKey::new(&(GAUSSIAN_BLOCK, self.frame_block(), columns))
    }

    /// Returns the encoding of one attribute.
    fn column(&self, column: Attributes) -> Compression {
        match (self.compression, self.bounds.column(column)) {
            (Compression::Zstd(level), max_error) if max_error != 0.0 => Compression::Bounded { max_error, level },
            (compression, _) => compression,
        }
    }
}

/// Writes `source` to the container `path`, which appears complete or not at all. `advance` is called with the number
/// of Gaussian states encoded since the last call.
pub fn write_container(
    source: &dyn FrameSource,
    path: &Path,
    packing: impl Into<Packing>,
    attributes: BTreeMap<String, String>,
    advance: impl Fn(u64) + Sync,
) -> Result<()> {
    let packing = packing.into();
    let mut writer = ContainerWriter::from_source(source, path, packing, attributes)?;
    for block in 0..packing.frame_blocks(source) {
        writer.append(source, packing.frames(source, block), &advance)?;
    }
    writer.finish()
}

/// Encodes the frame blocks `blocks` of `source` and writes them to `to`, for [`join_container`]: one record per tile,
/// in order. An empty record repeats the tile of the block before.
///
/// # Errors
/// Fails if a frame cannot be read or written.
pub fn spill_blocks(
    source: &dyn FrameSource,
    packing: Packing,
    blocks: Range<usize>,
    to: &mut SpillWriter,
    advance: impl Fn(u64) + Sync,
) -> Result<()> {
    for block in blocks {
        let presence = uniform_presence(source, block == 0);
        encode_frames(source, packing.frames(source, block), &presence, &packing, &advance, |_, _, tile| {
            to.write_record(&tile.map_or(Vec::new(), EncodedTile::to_bytes))
        })?;
    }
    Ok(())
}

/// Writes the container that [`write_container`] would write from the frame blocks that [`spill_blocks`] encoded.
/// `spills` must hold all frame blocks, in order. Memory: a tile, and the index of the container.
///
/// # Errors
/// Fails if a spill cannot be read back or the container cannot be written.
pub fn join_container(
    source: &dyn FrameSource,
    path: &Path,
    packing: Packing,
    attributes: BTreeMap<String, String>,
    spills: &[(Range<usize>, Spill)],
) -> Result<()> {
    let info = source.info();
    let mut writer = ContainerWriter::from_source(source, path, packing, attributes)?;
    let mut bytes = Vec::new();
    for (blocks, spill) in spills {
        let mut at = 0;
        for block in blocks.clone() {
            writer.begin(&info.times[packing.frames(source, block)])?;
            for gaussian_block in 0..info.count.div_ceil(GAUSSIAN_BLOCK) {
                for column in 0..Attributes::all().iter().count() {
                    at = spill.read_record(at, &mut bytes)?;
                    let tile = if bytes.is_empty() { None } else { Some(EncodedTile::from_bytes(&bytes)?) };
                    writer.write_tile(gaussian_block as u32, column as u32, tile.as_ref())?;
                }
            }
        }
    }
    writer.finish()
}

/// Writer of a container, one frame block at a time. If it is dropped before [`ContainerWriter::finish`], no file
/// remains.
pub struct ContainerWriter {
    writer: Writer,
    packing: Packing,
    frame_blocks: usize,
}

impl ContainerWriter {
    /// Creates the container `path` of `count` Gaussians in blocks of `frame_block` frames.
    pub fn create(
        path: &Path,
        count: usize,
        sh_degree: usize,
        frame_block: usize,
        packing: impl Into<Packing>,
        attributes: BTreeMap<String, String>,
    ) -> Result<ContainerWriter> {
        let packing = packing.into();
        let column = |column: Attributes| ColumnSpec {
            name: column.name().to_owned(),
            width: column.width(sh_degree) as u32,
            max_error: packing.bounds.column(column),
        };
        let layout = Layout {
            gaussians: count as u64,
            gaussian_block: GAUSSIAN_BLOCK as u32,
            frame_block: frame_block as u32,
            columns: Attributes::all().iter().map(column).collect(),
            attributes,
        };
        Ok(ContainerWriter { writer: Writer::create(path, layout)?, packing, frame_blocks: 0 })
    }

    /// Creates the container of `source`.
    fn from_source(
        source: &dyn FrameSource,
        path: &Path,
        packing: Packing,
        attributes: BTreeMap<String, String>,
    ) -> Result<ContainerWriter> {
        let info = source.info();
        ContainerWriter::create(path, info.count, info.sh_degree, packing.frame_block(), packing, attributes)
    }

    /// Adds the next frame block: `frames` of `source`, as many as a block has; a block with fewer frames ends the
    /// sequence. Attributes that do not vary must have the same values as in the blocks before.
    pub fn append(
        &mut self,
        source: &dyn FrameSource,
        frames: Range<usize>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<()> {
        self.begin(&source.info().times[frames.clone()])?;
        self.add(source, 0, frames, advance)
    }

    /// Begins the next frame block, to which [`ContainerWriter::add`] adds all Gaussians in several parts.
    pub fn begin(&mut self, times: &[f64]) -> Result<()> {
        self.writer.append_times(times)?;
        self.frame_blocks += 1;
        Ok(())
    }

    /// Adds Gaussians to the frame block: those of `source` at its `frames`, which are Gaussians `first` and following
    /// of the container. `first` is a multiple of [`GAUSSIAN_BLOCK`].
    pub fn add(
        &mut self,
        source: &dyn FrameSource,
        first: usize,
        frames: Range<usize>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<()> {
        let (first, packing) = ((first / GAUSSIAN_BLOCK) as u32, self.packing);
        let presence = uniform_presence(source, self.frame_blocks == 1);
        encode_frames(source, frames, &presence, &packing, advance, |gaussian_block, column, tile| {
            self.write_tile(first + gaussian_block, column, tile)
        })
    }

    /// Adds a frame block, `frames` of `source` at `times`, like [`ContainerWriter::append`]. `presence` says for every
    /// block of Gaussians whether it changes. A block that does not change is read and encoded once for all frames, or
    /// not at all.
    pub fn append_with_presence(
        &mut self,
        source: &dyn FrameSource,
        frames: Range<usize>,
        times: &[f64],
        presence: &[BlockChange],
    ) -> Result<()> {
        self.begin(times)?;
        let packing = self.packing;
        encode_frames(
            source,
            frames,
            presence,
            &packing,
            |_| (),
            |block, column, tile| self.write_tile(block, column, tile),
        )
    }

    /// Writes a tile of the frame block; `None` repeats the tile of the block before.
    fn write_tile(&mut self, gaussian_block: u32, column: u32, tile: Option<&EncodedTile>) -> Result<()> {
        let at = TileId { column, gaussian_block, frame_block: self.frame_blocks as u32 - 1 };
        match tile {
            Some(tile) => self.writer.write_tile(at, tile)?,
            None => self.writer.repeat_tile(at)?,
        }
        Ok(())
    }

    /// Completes the container, which then appears under its name.
    pub fn finish(self) -> Result<()> {
        self.writer.finish()?;
        Ok(())
    }
}

/// Change of a block of Gaussians within a block of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlockChange {
    /// Varying attributes change; the others are those of the frame block before.
    Varying,
    /// Varying attributes change; the others are written anew.
    New,
    /// Every frame is equal to the first one.
    Still,
    /// Every frame is equal to the frame block before, in which every frame was equal.
    Repeating,
}

/// Returns the change of every block of Gaussians of `source`, in the first block of frames or a later one.
fn uniform_presence(source: &dyn FrameSource, is_first: bool) -> Vec<BlockChange> {
    // An attribute that never varies is encoded for the first block only.
    let presence = if is_first { BlockChange::New } else { BlockChange::Varying };
    vec![presence; source.info().count.div_ceil(GAUSSIAN_BLOCK)]
}

/// Returns the Gaussians of block `block`, of `count` Gaussians.
pub fn gaussian_range(count: usize, block: usize) -> Range<usize> {
    let start = block * GAUSSIAN_BLOCK;
    start..count.min(start + GAUSSIAN_BLOCK)
}

/// Encodes `source` at the `frames` of a block; `presence` gives the change of each block of Gaussians. Passes every
/// tile to `each` in the order of the container, with its block of Gaussians and its column; `None` stands for the tile
/// of the block before.
fn encode_frames(
    source: &dyn FrameSource,
    frames: Range<usize>,
    presence: &[BlockChange],
    packing: &Packing,
    advance: impl Fn(u64) + Sync,
    mut each: impl FnMut(u32, u32, Option<&EncodedTile>) -> Result<()>,
) -> Result<()> {
    let info = source.info();
    let blocks: Vec<u32> = (0..info.count.div_ceil(GAUSSIAN_BLOCK) as u32).collect();
    // Processing one batch of blocks at a time bounds the number of tiles that wait for the writer.
    for batch in blocks.chunks(2 * rayon::current_num_threads()) {
        let tiles: Vec<Vec<Option<EncodedTile>>> = batch
            .par_iter()
            .map(|&block| {
                let gaussians = gaussian_range(info.count, block as usize);
                let count = gaussians.len();
                let (columns, frames) = match presence[block as usize] {
                    BlockChange::New => (Attributes::all(), frames.clone()),
                    BlockChange::Varying => (info.varying, frames.clone()),
                    BlockChange::Still => (Attributes::all(), frames.start..frames.start + 1),
                    BlockChange::Repeating => (Attributes::empty(), 0..0),
                };
                let tiles = encode_block(source, gaussians, frames.clone(), columns, packing);
                advance((count * frames.len()) as u64);
                tiles
            })
            .collect::<Result<_>>()?;
        for (&block, tiles) in batch.iter().zip(&tiles) {
            for (column, tile) in tiles.iter().enumerate() {
                each(block, column as u32, tile.as_ref())?;
            }
        }
    }
    Ok(())
}

/// Returns the bytes of every column for the blocks `blocks` of Gaussians of `source` over `frames`, the frames of one
/// frame block.
///
/// # Errors
/// Fails if a frame cannot be read.
pub fn column_bytes(
    source: &dyn FrameSource,
    blocks: &[usize],
    frames: Range<usize>,
    packing: &Packing,
) -> Result<Vec<usize>> {
    let count = source.info().count;
    let encode_tiles =
        |&block: &usize| encode_block(source, gaussian_range(count, block), frames.clone(), Attributes::all(), packing);
    let mut bytes = vec![0; Attributes::all().iter().count()];
    for tiles in blocks.par_iter().map(encode_tiles).collect::<Result<Vec<_>>>()? {
        bytes.iter_mut().zip(tiles).for_each(|(bytes, tile)| *bytes += tile.map_or(0, |tile| tile.to_bytes().len()));
    }
    Ok(bytes)
}

/// Encodes the tiles of one block of Gaussians over `frames`: one entry per column, `None` for columns not in
/// `columns`.
fn encode_block(
    source: &dyn FrameSource,
    gaussians: Range<usize>,
    frames: Range<usize>,
    columns: Attributes,
    packing: &Packing,
) -> Result<Vec<Option<EncodedTile>>> {
    let info = source.info();
    if columns.is_empty() {
        return Ok(Attributes::all().iter().map(|_| None).collect());
    }
    let len = gaussians.len();
    let mut reader = source.open(Ids::Range(gaussians))?;
    let mut state = Gaussians::zeros(len, info.sh_degree);
    let mut values: Vec<Vec<f32>> = Attributes::all().iter().map(|_| Vec::new()).collect();
    for frame in frames.clone() {
        // An attribute that never varies is encoded from one frame; the container stores it once.
        let want = if frame == frames.start { columns } else { info.varying };
        reader.read(frame, want, &mut state)?;
        for (values, column) in
            values.iter_mut().zip(Attributes::all().iter()).filter(|(_, column)| want.contains(*column))
        {
            values.extend_from_slice(state.column(column).planes());
        }
    }
    let encode_column = |(values, column): (&Vec<f32>, Attributes)| {
        if !columns.contains(column) {
            return Ok(None);
        }
        let width = column.width(info.sh_degree) as u32;
        let stored = if info.varying.contains(column) { frames.len() } else { 1 };
        Ok(Some(encode_tile(values, stored as u32, width, len as u32, packing.column(column))?))
    };
    values.iter().zip(Attributes::all().iter()).map(encode_column).collect()
}
