//! Any sequence into a container, frame block by frame block, tile by tile.
//!
//! Memory: for every thread one tile of every column, [`GAUSSIAN_BLOCK`] × frames of a block values of
//! each of its components, and as much again while it is encoded (of a column with a bound, four times its tile); 80 bytes per column and block of Gaussians,
//! 16 per frame.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::{ColumnSpec, Compression, EncodedTile, Layout, TileId, Writer, encode_tile};
use rayon::prelude::*;

use super::bounds::Bounds;
use crate::cache::{CacheKey, Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Columns, Gaussians};
use crate::source::{FrameSource, Ids};

/// Gaussians per tile: what one task of a scan reads. Fixed, so that the bytes depend on nothing but
/// the content.
pub const GAUSSIAN_BLOCK: usize = 1024;
/// Frames per tile, but for streams whose frames are large.
pub const FRAME_BLOCK: usize = 32;
/// Frames per tile within bounds, of which the first takes as much as all others together.
pub const BOUNDED_FRAME_BLOCK: usize = 64;

/// How a container stores its values.
#[derive(Debug, Clone, Copy)]
pub struct Packing {
    compression: Compression,
    bounds: Bounds,
}

impl From<Compression> for Packing {
    /// Every bit of every value.
    fn from(compression: Compression) -> Packing {
        Packing { compression, bounds: Bounds::default() }
    }
}

impl Packing {
    /// Values within `bounds`, by zstd at `level`.
    pub fn within(bounds: Bounds, level: i32) -> Packing {
        Packing { compression: Compression::Zstd(level), bounds }
    }

    /// Frames per tile.
    pub fn frame_block(&self) -> usize {
        if self.bounds == Bounds::default() { FRAME_BLOCK } else { BOUNDED_FRAME_BLOCK }
    }

    /// How many frame blocks `source` has.
    pub fn frame_blocks(&self, source: &dyn FrameSource) -> usize {
        source.info().times.len().div_ceil(self.frame_block())
    }

    /// Frames of one of them.
    pub fn frames(&self, source: &dyn FrameSource, block: usize) -> Range<usize> {
        let start = block * self.frame_block();
        start..source.info().times.len().min(start + self.frame_block())
    }

    /// What tiles follow from, beside their values.
    pub fn key(&self) -> CacheKey {
        let of_column = |column| match self.column(column) {
            Compression::Raw => (0, 0.0, 0),
            Compression::Zstd(level) => (1, 0.0, level),
            Compression::Bounded { max_error, level } => (2, max_error, level),
        };
        let columns: Vec<(u8, f64, i32)> = Columns::all().iter().map(of_column).collect();
        CacheKey::new(&(GAUSSIAN_BLOCK, self.frame_block(), columns))
    }

    /// How a column is encoded.
    fn column(&self, column: Columns) -> Compression {
        match (self.compression, self.bounds.column(column)) {
            (Compression::Zstd(level), max_error) if max_error != 0.0 => Compression::Bounded { max_error, level },
            (compression, _) => compression,
        }
    }
}

/// Writes `source` to the container `path`, which appears complete or not at all. `advance` is told
/// the number of Gaussian frames done.
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

/// Encodes some frame blocks of `source` and writes them to `to`, for [`join_container`]: a record of every tile, in
/// order, which is empty if it is the tile of the block before.
///
/// # Errors
/// Frames that cannot be read; a failed write.
pub fn spill_blocks(
    source: &dyn FrameSource,
    packing: Packing,
    blocks: Range<usize>,
    to: &mut SpillWriter,
    advance: impl Fn(u64) + Sync,
) -> Result<()> {
    for block in blocks {
        let lives = all_blocks(source, block == 0);
        encode_frames(source, packing.frames(source, block), &lives, &packing, &advance, |_, _, tile| {
            to.write_record(&tile.map_or(Vec::new(), EncodedTile::to_bytes))
        })?;
    }
    Ok(())
}

/// The container that [`write_container`] writes, of all frame blocks, encoded by [`spill_blocks`]. Memory: a tile, and
/// what a container has.
///
/// # Errors
/// What cannot be read back; a failed write.
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
                for column in 0..Columns::all().iter().count() {
                    at = spill.read_record(at, &mut bytes)?;
                    let tile = if bytes.is_empty() { None } else { Some(EncodedTile::from_bytes(&bytes)?) };
                    writer.put(gaussian_block as u32, column as u32, tile.as_ref())?;
                }
            }
        }
    }
    writer.finish()
}

/// A container that grows by one frame block at a time. Dropped unfinished, it leaves nothing.
pub struct ContainerWriter {
    writer: Writer,
    packing: Packing,
    frame_blocks: usize,
}

impl ContainerWriter {
    /// Starts the container `path` of `count` Gaussians in blocks of `frame_block` frames.
    pub fn create(
        path: &Path,
        count: usize,
        sh_degree: usize,
        frame_block: usize,
        packing: impl Into<Packing>,
        attributes: BTreeMap<String, String>,
    ) -> Result<ContainerWriter> {
        let packing = packing.into();
        let column = |column: Columns| ColumnSpec {
            name: column.name().to_owned(),
            width: column.width(sh_degree) as u32,
            max_error: packing.bounds.column(column),
        };
        let layout = Layout {
            gaussians: count as u64,
            gaussian_block: GAUSSIAN_BLOCK as u32,
            frame_block: frame_block as u32,
            columns: Columns::all().iter().map(column).collect(),
            attributes,
        };
        Ok(ContainerWriter { writer: Writer::create(path, layout)?, packing, frame_blocks: 0 })
    }

    /// Starts that of `source`.
    fn from_source(
        source: &dyn FrameSource,
        path: &Path,
        packing: Packing,
        attributes: BTreeMap<String, String>,
    ) -> Result<ContainerWriter> {
        let info = source.info();
        ContainerWriter::create(path, info.count, info.sh_degree, packing.frame_block(), packing, attributes)
    }

    /// Adds the next frame block: `frames` of `source`, as many as a block has; fewer end the sequence.
    /// Columns that do not vary must hold what they held in the blocks before.
    pub fn append(
        &mut self,
        source: &dyn FrameSource,
        frames: Range<usize>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<()> {
        self.begin(&source.info().times[frames.clone()])?;
        self.add(source, 0, frames, advance)
    }

    /// Begins the next frame block, to which [`ContainerWriter::add`] adds all Gaussians, part by part.
    pub fn begin(&mut self, times: &[f64]) -> Result<()> {
        self.writer.append_times(times)?;
        self.frame_blocks += 1;
        Ok(())
    }

    /// Adds to the frame block the Gaussians of `source` at its `frames`: they are those of the container from number
    /// `first` on, a multiple of [`GAUSSIAN_BLOCK`].
    pub fn add(
        &mut self,
        source: &dyn FrameSource,
        first: usize,
        frames: Range<usize>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<()> {
        let (first, packing) = ((first / GAUSSIAN_BLOCK) as u32, self.packing);
        let lives = all_blocks(source, self.frame_blocks == 1);
        encode_frames(source, frames, &lives, &packing, advance, |gaussian_block, column, tile| {
            self.put(first + gaussian_block, column, tile)
        })
    }

    /// [`ContainerWriter::append`] of `frames` of `source` at `times`, where `lives` says of every block of Gaussians
    /// whether it changes: what does not is read and encoded once for all frames, or not at all.
    pub fn append_lives(
        &mut self,
        source: &dyn FrameSource,
        frames: Range<usize>,
        times: &[f64],
        lives: &[BlockPresence],
    ) -> Result<()> {
        self.begin(times)?;
        let packing = self.packing;
        encode_frames(source, frames, lives, &packing, |_| (), |block, column, tile| self.put(block, column, tile))
    }

    /// Adds a tile to the frame block; none: it is that of the block before.
    fn put(&mut self, gaussian_block: u32, column: u32, tile: Option<&EncodedTile>) -> Result<()> {
        let at = TileId { column, gaussian_block, frame_block: self.frame_blocks as u32 - 1 };
        match tile {
            Some(tile) => self.writer.write_tile(at, tile)?,
            None => self.writer.repeat_tile(at)?,
        }
        Ok(())
    }

    /// Completes the container and gives it its name.
    pub fn finish(self) -> Result<()> {
        self.writer.finish()?;
        Ok(())
    }
}

/// How a block of Gaussians goes through a block of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlockPresence {
    /// It changes in its columns that vary; others are those of the frame block before.
    Varying,
    /// It changes in its columns that vary, and others are new.
    New,
    /// It is as in the first of the frames.
    Still,
    /// It is as in the frame block before, where it was still.
    Repeating,
}

/// Every block of Gaussians of `source`, in the first block of frames or a later one.
fn all_blocks(source: &dyn FrameSource, is_first: bool) -> Vec<BlockPresence> {
    // A column that never varies is encoded for the first block alone.
    let lives = if is_first { BlockPresence::New } else { BlockPresence::Varying };
    vec![lives; source.info().count.div_ceil(GAUSSIAN_BLOCK)]
}

/// The Gaussians of a block, of `count`.
pub fn of_block(count: usize, block: usize) -> Range<usize> {
    let start = block * GAUSSIAN_BLOCK;
    start..count.min(start + GAUSSIAN_BLOCK)
}

/// Encodes `source` at the `frames` of a block, of which `lives` says how each block of Gaussians goes through it, and hands
/// every tile to `each` in the order of the container, with its block of Gaussians and its column; none: it is that of the
/// block before.
fn encode_frames(
    source: &dyn FrameSource,
    frames: Range<usize>,
    lives: &[BlockPresence],
    packing: &Packing,
    advance: impl Fn(u64) + Sync,
    mut each: impl FnMut(u32, u32, Option<&EncodedTile>) -> Result<()>,
) -> Result<()> {
    let info = source.info();
    let blocks: Vec<u32> = (0..info.count.div_ceil(GAUSSIAN_BLOCK) as u32).collect();
    // One batch of blocks at a time bounds the tiles that wait for the writer.
    for batch in blocks.chunks(2 * rayon::current_num_threads()) {
        let tiles: Vec<Vec<Option<EncodedTile>>> = batch
            .par_iter()
            .map(|&block| {
                let gaussians = of_block(info.count, block as usize);
                let count = gaussians.len();
                let (columns, frames) = match lives[block as usize] {
                    BlockPresence::New => (Columns::all(), frames.clone()),
                    BlockPresence::Varying => (info.varying, frames.clone()),
                    BlockPresence::Still => (Columns::all(), frames.start..frames.start + 1),
                    BlockPresence::Repeating => (Columns::empty(), 0..0),
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

/// Bytes that every column takes of some `blocks` of Gaussians of `source` over `frames`, those of a block.
///
/// # Errors
/// Frames that cannot be read.
pub fn column_bytes(
    source: &dyn FrameSource,
    blocks: &[usize],
    frames: Range<usize>,
    packing: &Packing,
) -> Result<Vec<usize>> {
    let count = source.info().count;
    let encode = |&block: &usize| encode_block(source, of_block(count, block), frames.clone(), Columns::all(), packing);
    let mut bytes = vec![0; Columns::all().iter().count()];
    for tiles in blocks.par_iter().map(encode).collect::<Result<Vec<_>>>()? {
        bytes.iter_mut().zip(tiles).for_each(|(bytes, tile)| *bytes += tile.map_or(0, |tile| tile.to_bytes().len()));
    }
    Ok(bytes)
}

/// The tiles of one block of Gaussians over `frames`, one entry per column; none for those not in `columns`.
fn encode_block(
    source: &dyn FrameSource,
    gaussians: Range<usize>,
    frames: Range<usize>,
    columns: Columns,
    packing: &Packing,
) -> Result<Vec<Option<EncodedTile>>> {
    let info = source.info();
    if columns.is_empty() {
        return Ok(Columns::all().iter().map(|_| None).collect());
    }
    let len = gaussians.len();
    let mut reader = source.open(Ids::Range(gaussians))?;
    let mut state = Gaussians::zeros(len, info.sh_degree);
    let mut values: Vec<Vec<f32>> = Columns::all().iter().map(|_| Vec::new()).collect();
    for frame in frames.clone() {
        // A column that never varies is one frame for all; the container stores it once.
        let want = if frame == frames.start { columns } else { info.varying };
        reader.read(frame, want, &mut state)?;
        for (values, column) in
            values.iter_mut().zip(Columns::all().iter()).filter(|(_, column)| want.contains(*column))
        {
            values.extend_from_slice(state.column(column).planes());
        }
    }
    let encode = |(values, column): (&Vec<f32>, Columns)| {
        if !columns.contains(column) {
            return Ok(None);
        }
        let width = column.width(info.sh_degree) as u32;
        let stored = if info.varying.contains(column) { frames.len() } else { 1 };
        Ok(Some(encode_tile(values, stored as u32, width, len as u32, packing.column(column))?))
    };
    values.iter().zip(Columns::all().iter()).map(encode).collect()
}
