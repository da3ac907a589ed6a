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
    let (info, packing) = (source.info(), packing.into());
    let together = packing.frame_block();
    let mut writer = ContainerWriter::create(path, info.count, info.sh_degree, together, packing, attributes)?;
    for start in (0..info.times.len()).step_by(together) {
        let end = info.times.len().min(start + together);
        writer.append(source, start..end, &advance)?;
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
        let info = source.info();
        let frame_block = self.frame_blocks as u32 - 1;
        // A column that never varies is encoded for the first block alone.
        let columns = if frame_block == 0 { Columns::all() } else { info.varying };
        let first = (first / GAUSSIAN_BLOCK) as u32;
        let blocks: Vec<u32> = (0..info.count.div_ceil(GAUSSIAN_BLOCK) as u32).collect();
        // One batch of blocks at a time bounds the tiles that wait for the writer.
        for batch in blocks.chunks(2 * rayon::current_num_threads()) {
            let tiles: Vec<Vec<Option<EncodedTile>>> = batch
                .par_iter()
                .map(|&block| {
                    let start = block as usize * GAUSSIAN_BLOCK;
                    let end = (start + GAUSSIAN_BLOCK).min(info.count);
                    let tiles = encode_block(source, start..end, frames.clone(), columns, &self.packing);
                    advance(((end - start) * frames.len()) as u64);
                    tiles
                })
                .collect::<Result<_>>()?;
            for (&block, tiles) in batch.iter().zip(&tiles) {
                for (column, tile) in tiles.iter().enumerate() {
                    let at = TileId { column: column as u32, gaussian_block: first + block, frame_block };
                    match tile {
                        Some(tile) => self.writer.write_tile(at, tile)?,
                        None => self.writer.repeat_tile(at)?,
                    }
                }
            }
        }
        Ok(())
    }

    /// Completes the container and gives it its name.
    pub fn finish(self) -> Result<()> {
        self.writer.finish()?;
        Ok(())
    }
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
