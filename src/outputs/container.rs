//! Writes any sequence to a `.gseq` container, one frame block (consecutive frames) after the other. A container has
//! one column per attribute. A tile has the values of one column for one block of Gaussians in one frame block.
//!
//! Memory per thread: one tile of every column, with [`GAUSSIAN_BLOCK`] × frames × components values, and the same
//! amount again while the tiles are encoded (four times the tile for a column with an error bound). In addition, the
//! index takes 80 bytes per column and block of Gaussians, and 16 bytes per frame.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::{ColumnSpec, Compression, EncodedTile, Layout, TileId, Writer, encode_tile};
use rayon::prelude::*;

use super::bounds::ErrorBounds;
use crate::cache::{CacheKey, Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Attributes, Gaussians};
use crate::source::{FrameSource, Ids};

/// Number of Gaussians per tile (values of one attribute that are encoded together), and per task when threads share a
/// pass over all frames. The number is constant, so that the bytes of a container depend only on its values.
pub const GAUSSIAN_BLOCK: usize = 1024;
/// Number of frames per tile (values that are encoded together) in a container without error bounds. Streams with large
/// frames are stored with fewer frames per tile.
pub const FRAME_BLOCK: usize = 32;
/// Number of frames per tile (values that are encoded together) in a container with error bounds. It is larger than
/// [`FRAME_BLOCK`], because with error bounds the first frame of a tile takes as much space as all its other frames
/// together, and longer tiles have fewer first frames.
pub const FRAME_BLOCK_WITH_ERROR_BOUNDS: usize = 64;

/// Encoding of the values in a container: compression and maximum errors.
#[derive(Debug, Clone, Copy)]
pub struct Packing {
    compression: Compression,
    bounds: ErrorBounds,
}

impl From<Compression> for Packing {
    /// Creates the lossless encoding that uses `compression`.
    fn from(compression: Compression) -> Packing {
        Packing { compression, bounds: ErrorBounds::default() }
    }
}

impl Packing {
    /// Creates the encoding with errors of at most `bounds`, compressed by zstd at `level`.
    pub fn with_bounds(bounds: ErrorBounds, level: i32) -> Packing {
        Packing { compression: Compression::Zstd(level), bounds }
    }

    /// Returns the number of consecutive frames whose values are encoded together (frames per tile). It is larger if
    /// there are error bounds.
    pub fn frame_block(&self) -> usize {
        if self.bounds == ErrorBounds::default() { FRAME_BLOCK } else { FRAME_BLOCK_WITH_ERROR_BOUNDS }
    }

    /// Returns the number of frame blocks (ranges of consecutive frames) into which the frames of `source` are divided.
    pub fn frame_blocks(&self, source: &dyn FrameSource) -> usize {
        source.info().times.len().div_ceil(self.frame_block())
    }

    /// Returns the range of frames of `source` in frame block (consecutive frames) number `block`.
    pub fn frames_of_block(&self, source: &dyn FrameSource, block: usize) -> Range<usize> {
        let start = block * self.frame_block();
        start..source.info().times.len().min(start + self.frame_block())
    }

    /// Returns the cache key of this encoding. The key does not depend on the values that are encoded.
    pub fn cache_key(&self) -> CacheKey {
        let column_key = |column| match self.column(column) {
            Compression::Raw => (0, 0.0, 0),
            Compression::Zstd(level) => (1, 0.0, level),
            Compression::Bounded { max_error, level } => (2, max_error, level),
        };
        let columns: Vec<(u8, f64, i32)> = Attributes::all().iter().map(column_key).collect();
        CacheKey::new(&(GAUSSIAN_BLOCK, self.frame_block(), columns))
    }

    /// Returns the compression of the values of the attribute `column`.
    fn column(&self, column: Attributes) -> Compression {
        match (self.compression, self.bounds.max_error(column)) {
            (Compression::Zstd(level), max_error) if max_error != 0.0 => Compression::Bounded { max_error, level },
            (compression, _) => compression,
        }
    }
}

/// Writes all frames of `source` to the container `path`, in the encoding `packing`, with the metadata `attributes`
/// (names and texts). The file appears only when it is complete. Calls `advance` with the number of Gaussian states
/// (Gaussians × frames) encoded since the last call.
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
        writer.append_block(source, packing.frames_of_block(source, block), &advance)?;
    }
    writer.finish()
}

/// Encodes frame blocks of `source` in the encoding `packing`, and writes them to the scratch file `to`, from which
/// [`join_container`] reads them. `blocks`: range of the numbers of these frame blocks. The file gets one record (byte
/// string with its length) per tile, in order. An empty record means that the tile equals that of the frame block
/// before. Calls `advance` with the number of Gaussian states (Gaussians × frames) encoded since the last call.
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
        let changes = uniform_changes(source, block == 0);
        encode_frames(source, packing.frames_of_block(source, block), &changes, &packing, &advance, |_, _, tile| {
            to.write_record(&tile.map_or(Vec::new(), EncodedTile::to_bytes))
        })?;
    }
    Ok(())
}

/// Writes the container `path` from the frame blocks of `source` that [`spill_blocks`] encoded with the same `packing`,
/// and with the metadata `attributes` (names and texts). The file has the same bytes as one that [`write_container`]
/// writes. `spills` lists the scratch files, each with the numbers of its frame blocks; together they must have all
/// frame blocks, in order. Memory: a tile, and the index of the container.
///
/// # Errors
/// Fails if a scratch file cannot be read back or the container cannot be written.
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
            writer.begin_block(&info.times[packing.frames_of_block(source, block)])?;
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

/// Writer of a container, which receives one frame block (consecutive frames) at a time. If it is dropped before
/// [`ContainerWriter::finish`], no file remains.
pub struct ContainerWriter {
    writer: Writer,
    packing: Packing,
    frame_blocks: usize,
}

impl ContainerWriter {
    /// Creates the container `path` for `count` Gaussians of SH degree `sh_degree`, with `frame_block` frames in a
    /// frame block, in the encoding `packing`, and with the metadata `attributes` (names and texts).
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
            max_error: packing.bounds.max_error(column),
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

    /// Creates the container `path` with the number of Gaussians, the SH degree and the frames per block that `source`
    /// and `packing` need, and with the metadata `attributes` (names and texts).
    fn from_source(
        source: &dyn FrameSource,
        path: &Path,
        packing: Packing,
        attributes: BTreeMap<String, String>,
    ) -> Result<ContainerWriter> {
        let info = source.info();
        ContainerWriter::create(path, info.count, info.sh_degree, packing.frame_block(), packing, attributes)
    }

    /// Adds the frames `frames` of `source` as the next frame block. Their number must be the number of frames per
    /// block; only the last block may have fewer. Attributes that do not vary with time must have the same values as in
    /// the blocks before. Calls `advance` with the number of Gaussian states (Gaussians × frames) encoded since the
    /// last call.
    pub fn append_block(
        &mut self,
        source: &dyn FrameSource,
        frames: Range<usize>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<()> {
        self.begin_block(&source.info().times[frames.clone()])?;
        self.add_gaussians(source, 0, frames, advance)
    }

    /// Begins a frame block with frames at the times `times`. After this call, all Gaussians must be added by one or
    /// several calls of [`ContainerWriter::add_gaussians`].
    pub fn begin_block(&mut self, times: &[f64]) -> Result<()> {
        self.writer.append_times(times)?;
        self.frame_blocks += 1;
        Ok(())
    }

    /// Adds all Gaussians of `source` to the current frame block (consecutive frames), at the frames `frames` of
    /// `source`. In the container they get consecutive indices from `first` on, which is a multiple of
    /// [`GAUSSIAN_BLOCK`]. Calls `advance` with the number of Gaussian states (Gaussians × frames) encoded since the
    /// last call.
    pub fn add_gaussians(
        &mut self,
        source: &dyn FrameSource,
        first: usize,
        frames: Range<usize>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<()> {
        let (first, packing) = ((first / GAUSSIAN_BLOCK) as u32, self.packing);
        let changes = uniform_changes(source, self.frame_blocks == 1);
        encode_frames(source, frames, &changes, &packing, advance, |gaussian_block, column, tile| {
            self.write_tile(first + gaussian_block, column, tile)
        })
    }

    /// Adds the frames `frames` of `source` as the next frame block (consecutive frames), with the time stamps `times`.
    /// `changes[k]` states how block number k of the Gaussians changes in these frames. This saves reading and
    /// encoding:
    /// - If the Gaussians are equal in all these frames, only the first frame is read and encoded.
    /// - If they also equal those of the frame block before, nothing is read or encoded.
    pub fn append_with_changes(
        &mut self,
        source: &dyn FrameSource,
        frames: Range<usize>,
        times: &[f64],
        changes: &[BlockChange],
    ) -> Result<()> {
        self.begin_block(times)?;
        let packing = self.packing;
        encode_frames(
            source,
            frames,
            changes,
            &packing,
            |_| (),
            |block, column, tile| self.write_tile(block, column, tile),
        )
    }

    /// Writes `tile`, the encoded values of the attribute with the index `column` for block number `gaussian_block` of
    /// Gaussians in the current frame block. If `tile` is `None`, records that the values equal those in the frame
    /// block before.
    fn write_tile(&mut self, gaussian_block: u32, column: u32, tile: Option<&EncodedTile>) -> Result<()> {
        let at = TileId { column, gaussian_block, frame_block: self.frame_blocks as u32 - 1 };
        match tile {
            Some(tile) => self.writer.write_tile(at, tile)?,
            None => self.writer.repeat_tile(at)?,
        }
        Ok(())
    }

    /// Completes the container and moves it to its final path.
    pub fn finish(self) -> Result<()> {
        self.writer.finish()?;
        Ok(())
    }
}

/// Change of a block of Gaussians over the frames of one frame block (consecutive frames). It decides which values of
/// these Gaussians are encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlockChange {
    /// Gaussians that change from frame to frame. Attributes that vary with time in the source are encoded for every
    /// frame. The other attributes equal those of the frame block before and are not encoded again.
    Varying,
    /// Gaussians of which every attribute may differ from the frame block before. Attributes that vary with time in the
    /// source are encoded for every frame, the other attributes for the first frame only.
    New,
    /// Gaussians that are equal in all frames of the frame block (consecutive frames), so that only its first frame is
    /// encoded.
    Still,
    /// Gaussians that are equal in all frames of the frame block (consecutive frames), and equal to the frame block
    /// before. Nothing is encoded.
    Repeating,
}

/// Returns the [`BlockChange`] of every block of Gaussians of `source` for one frame block (consecutive frames), if
/// nothing is known about how the Gaussians change. All blocks have the same value: [`BlockChange::New`] in the first
/// frame block (`is_first`), [`BlockChange::Varying`] in all later ones.
fn uniform_changes(source: &dyn FrameSource, is_first: bool) -> Vec<BlockChange> {
    // An attribute that never varies is encoded for the first frame block only.
    let changes = if is_first { BlockChange::New } else { BlockChange::Varying };
    vec![changes; source.info().count.div_ceil(GAUSSIAN_BLOCK)]
}

/// Returns the indices of the Gaussians in block number `block`, of `count` Gaussians in total.
pub fn gaussian_range(count: usize, block: usize) -> Range<usize> {
    let start = block * GAUSSIAN_BLOCK;
    start..count.min(start + GAUSSIAN_BLOCK)
}

/// Encodes the frames `frames` of `source` as one frame block (consecutive frames that are stored together). `changes`
/// states for each block of Gaussians how it changes, and so which of its values are encoded.
/// - Calls `each` for every tile in the order of the container, with the index of its block of Gaussians, the index of
///   its column, and the tile. `None` in place of the tile means that the tile equals that of the frame block before.
/// - Calls `advance` with the number of Gaussian states (Gaussians × frames) encoded since the last call.
fn encode_frames(
    source: &dyn FrameSource,
    frames: Range<usize>,
    changes: &[BlockChange],
    packing: &Packing,
    advance: impl Fn(u64) + Sync,
    mut each: impl FnMut(u32, u32, Option<&EncodedTile>) -> Result<()>,
) -> Result<()> {
    let info = source.info();
    let blocks: Vec<u32> = (0..info.count.div_ceil(GAUSSIAN_BLOCK) as u32).collect();
    // Only one batch of blocks is processed at a time, which bounds the number of tiles that wait for the writer.
    for batch in blocks.chunks(2 * rayon::current_num_threads()) {
        let tiles: Vec<Vec<Option<EncodedTile>>> = batch
            .par_iter()
            .map(|&block| {
                let gaussians = gaussian_range(info.count, block as usize);
                let count = gaussians.len();
                let (columns, frames) = match changes[block as usize] {
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

/// Returns the number of bytes that each column (attribute) would take in a container, summed over some blocks of
/// Gaussians of `source`. `blocks`: numbers of these blocks. `frames`: frames that are encoded as one frame block.
/// Encodes the values, but writes no file.
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

/// Encodes the values of the Gaussians `gaussians` of `source` at the frames `frames`. Returns one tile (encoded
/// values) per attribute; `None` for attributes that are not in `columns`.
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
            values.extend_from_slice(state.attribute_values(column).planes());
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
