//! Any sequence into a container, tile by tile.
//!
//! Memory: for every thread one tile of every column, [`GAUSSIAN_BLOCK`] × [`FRAME_BLOCK`] values of
//! each of its components, and as much again while it is encoded; nothing grows with N or T but the
//! index, 64 bytes per tile.

use std::collections::BTreeMap;
use std::path::Path;

use gseq::{ColumnSpec, Compression, EncodedTile, Layout, TileId, Writer, encode_tile};
use rayon::prelude::*;

use crate::error::Result;
use crate::model::{Columns, Gaussians};
use crate::pass::{FrameSource, Ids};

/// Gaussians per tile: what one task of a scan reads. Fixed, so that the bytes depend on nothing but
/// the content.
pub const GAUSSIAN_BLOCK: usize = 1024;
/// Frames per tile.
pub const FRAME_BLOCK: usize = 32;

/// Writes `source` to the container `path`, which appears complete or not at all. `advance` is told
/// the number of Gaussian frames done.
pub fn write_container(
    source: &dyn FrameSource,
    path: &Path,
    compression: Compression,
    attributes: BTreeMap<String, String>,
    advance: impl Fn(u64) + Sync,
) -> Result<()> {
    let info = source.info();
    let columns: Vec<Columns> = Columns::ALL.iter().collect();
    let layout = Layout {
        gaussians: info.count as u64,
        gaussian_block: GAUSSIAN_BLOCK as u32,
        frame_block: FRAME_BLOCK as u32,
        columns: columns
            .iter()
            .map(|&column| ColumnSpec { name: column.name().to_owned(), width: column.width(info.sh_degree) as u32 })
            .collect(),
        attributes,
    };
    let blocks: Vec<u32> = (0..layout.gaussian_blocks()).collect();
    let mut writer = Writer::create(path, layout)?;
    for (index, times) in info.times.chunks(FRAME_BLOCK).enumerate() {
        let frame_block = writer.append_times(times)?;
        let frames = index * FRAME_BLOCK..index * FRAME_BLOCK + times.len();
        // One batch of blocks at a time bounds the tiles that wait for the writer.
        for batch in blocks.chunks(2 * rayon::current_num_threads()) {
            let tiles: Vec<Vec<EncodedTile>> = batch
                .par_iter()
                .map(|&block| {
                    let start = block as usize * GAUSSIAN_BLOCK;
                    let end = (start + GAUSSIAN_BLOCK).min(info.count);
                    let tiles = encode_block(source, start..end, frames.clone(), &columns, compression);
                    advance(((end - start) * times.len()) as u64);
                    tiles
                })
                .collect::<Result<_>>()?;
            for (&gaussian_block, tiles) in batch.iter().zip(&tiles) {
                for (column, tile) in tiles.iter().enumerate() {
                    writer.write_tile(TileId { column: column as u32, gaussian_block, frame_block }, tile)?;
                }
            }
        }
    }
    writer.finish()?;
    Ok(())
}

/// The tiles of every column of one block of Gaussians over `frames`.
fn encode_block(
    source: &dyn FrameSource,
    gaussians: std::ops::Range<usize>,
    frames: std::ops::Range<usize>,
    columns: &[Columns],
    compression: Compression,
) -> Result<Vec<EncodedTile>> {
    let info = source.info();
    let len = gaussians.len();
    let mut reader = source.open(Ids::Range(gaussians))?;
    let mut state = Gaussians::zeros(len, info.sh_degree);
    let mut values: Vec<Vec<f32>> = vec![Vec::new(); columns.len()];
    for frame in frames.clone() {
        // A column that never varies is one frame for all; the container stores it once.
        let want = if frame == frames.start { Columns::ALL } else { info.varying };
        reader.read(frame, want, &mut state)?;
        for (values, &column) in values.iter_mut().zip(columns).filter(|(_, column)| want.contains(**column)) {
            values.extend_from_slice(state.column(column).planes());
        }
    }
    values
        .iter()
        .zip(columns)
        .map(|(values, &column)| {
            let width = column.width(info.sh_degree) as u32;
            let stored = if info.varying.contains(column) { frames.len() } else { 1 };
            Ok(encode_tile(values, stored as u32, width, len as u32, compression)?)
        })
        .collect()
}
