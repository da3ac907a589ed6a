//! A `gseq` container as a source of frames.

use std::path::{Path, PathBuf};

use gseq::{Reader, TileBuffer, TileId};

use crate::error::{Error, Result};
use crate::model::{Columns, Gaussians, SequenceInfo, sh_coefficients};
use crate::pass::{BlockReader, FrameSource, Ids};

/// An open container with all columns of a Gaussian model.
pub struct Container {
    path: PathBuf,
    reader: Reader,
    info: SequenceInfo,
    /// Place of each column in the container, in the order of [`Columns::ALL`].
    places: Vec<(Columns, u32)>,
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
            if varies(&reader, place)? {
                varying = varying | column;
            }
        }
        let info = SequenceInfo { count, times: reader.times().to_vec(), sh_degree, varying };
        Ok(Container { path: path.to_owned(), reader, info, places })
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
}

/// Whether a column's values differ between frames: by the index alone. Tiles that are constant each and
/// share their stored bytes are one value for all frames.
fn varies(reader: &Reader, column: u32) -> Result<bool> {
    for gaussian_block in 0..reader.layout().gaussian_blocks() {
        let mut first = None;
        for frame_block in 0..reader.frame_blocks() {
            let tile = reader.tile_info(TileId { column, gaussian_block, frame_block })?;
            if !tile.constant || *first.get_or_insert(tile.offset) != tile.offset {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

impl FrameSource for Container {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let block = self.reader.layout().gaussian_block as usize;
        let mut runs: Vec<Run> = Vec::new();
        for (to, id) in ids.iter().enumerate() {
            let (tile, from) = ((id / block) as u32, id % block);
            match runs.last_mut() {
                Some(run) if run.gaussian_block == tile && run.from + run.len == from => run.len += 1,
                _ => runs.push(Run { gaussian_block: tile, from, to, len: 1 }),
            }
        }
        // Each tile is decoded once, in whatever order the Gaussians were asked for.
        runs.sort_by_key(|run| run.gaussian_block);
        let kept = self.places.iter().map(|_| Kept::default()).collect();
        Ok(Box::new(TileReader { source: self, len: ids.len(), runs, buffer: TileBuffer::default(), kept }))
    }
}

/// Gaussians that lie side by side in a tile and in the block read.
struct Run {
    gaussian_block: u32,
    from: usize,
    to: usize,
    len: usize,
}

/// One column of a reader's Gaussians over one frame block.
#[derive(Default)]
struct Kept {
    frame_block: Option<u32>,
    /// Frames held: one if none of the tiles varies.
    frames: usize,
    /// `[frames, width, len]`
    values: Vec<f32>,
}

struct TileReader<'a> {
    source: &'a Container,
    len: usize,
    runs: Vec<Run>,
    buffer: TileBuffer,
    /// By place in [`Container::places`]. At most 4 · width · frames of a block bytes per Gaussian, however
    /// many frames there are.
    kept: Vec<Kept>,
}

impl TileReader<'_> {
    /// Fills the slot of column `index` with the frames of `frame_block`, unless it holds them.
    fn keep(&mut self, index: usize, frame_block: u32) -> Result<()> {
        let Container { reader, places, .. } = self.source;
        let kept = &mut self.kept[index];
        if kept.frame_block == Some(frame_block) {
            return Ok(());
        }
        kept.frame_block = None;
        let column = places[index].1;
        let width = reader.layout().columns[column as usize].width as usize;
        kept.frames = 1;
        for run in &self.runs {
            let info = reader.tile_info(TileId { column, gaussian_block: run.gaussian_block, frame_block })?;
            if !info.constant {
                kept.frames = info.frames as usize;
            }
        }
        kept.values.resize(kept.frames * width * self.len, 0.0);
        for runs in self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block) {
            let at = TileId { column, gaussian_block: runs[0].gaussian_block, frame_block };
            let tile = reader.tile(at, &mut self.buffer)?;
            for (plane, to) in kept.values.chunks_exact_mut(self.len).enumerate() {
                let from = tile.plane(plane / width, plane % width);
                for run in runs {
                    to[run.to..run.to + run.len].copy_from_slice(&from[run.from..run.from + run.len]);
                }
            }
        }
        kept.frame_block = Some(frame_block);
        Ok(())
    }
}

impl BlockReader for TileReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        let frame_block = self.source.reader.layout().frame_block as usize;
        if frame >= self.source.info.times.len() {
            return Err(Error::usage(format!("{}: there is no frame {frame}", self.source.path.display())));
        }
        for index in 0..self.kept.len() {
            let column = self.source.places[index].0;
            if !want.contains(column) {
                continue;
            }
            let target = out.column_mut(column);
            target.resize(self.len);
            if self.len == 0 {
                continue;
            }
            self.keep(index, (frame / frame_block) as u32)?;
            let kept = &self.kept[index];
            let frame = if kept.frames == 1 { 0 } else { frame % frame_block };
            let size = target.planes().len();
            target.planes_mut().copy_from_slice(&kept.values[frame * size..][..size]);
        }
        Ok(())
    }
}
