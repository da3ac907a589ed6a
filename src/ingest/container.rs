//! A `gseq` container as a source of frames.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use gseq::{Reader, TileBuffer, TileId};

use crate::error::{Error, Result};
use crate::model::{Columns, Gaussians, SequenceInfo, sh_coefficients};
use crate::pass::{BlockReader, FrameSource, Ids};

/// Bytes of decoded tiles a reader keeps; one over more Gaussians decodes the others frame by frame.
const KEPT_BYTES: usize = 256 << 20;

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
        // Each tile is visited once per frame, in whatever order the Gaussians were asked for.
        runs.sort_by_key(|run| run.gaussian_block);
        let kept = VecDeque::new();
        Ok(Box::new(TileReader {
            source: self,
            len: ids.len(),
            runs,
            buffer: TileBuffer::default(),
            kept,
            kept_bytes: 0,
        }))
    }
}

/// Gaussians that lie side by side in a tile and in the block read.
struct Run {
    gaussian_block: u32,
    from: usize,
    to: usize,
    len: usize,
}

/// A decoded tile.
struct Kept {
    at: TileId,
    constant: bool,
    values: Vec<f32>,
}

struct TileReader<'a> {
    source: &'a Container,
    len: usize,
    runs: Vec<Run>,
    buffer: TileBuffer,
    /// Oldest first.
    kept: VecDeque<Kept>,
    kept_bytes: usize,
}

impl TileReader<'_> {
    /// Place in `kept` of the tile, decoded now unless it was before.
    fn tile(&mut self, at: TileId) -> Result<usize> {
        if let Some(place) = self.kept.iter().position(|kept| kept.at == at) {
            return Ok(place);
        }
        let tile = self.source.reader.tile(at, &mut self.buffer)?;
        let bytes = size_of_val(tile.values());
        let mut values = Vec::new();
        while self.kept_bytes + bytes > KEPT_BYTES
            && let Some(oldest) = self.kept.pop_front()
        {
            self.kept_bytes -= size_of_val(&oldest.values[..]);
            values = oldest.values;
        }
        values.clear();
        values.extend_from_slice(tile.values());
        self.kept_bytes += bytes;
        self.kept.push_back(Kept { at, constant: tile.is_constant(), values });
        Ok(self.kept.len() - 1)
    }
}

impl BlockReader for TileReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        let layout = self.source.reader.layout();
        if frame >= self.source.info.times.len() {
            return Err(Error::usage(format!("{}: there is no frame {frame}", self.source.path.display())));
        }
        let frame_block = (frame / layout.frame_block as usize) as u32;
        let within = frame % layout.frame_block as usize;
        let places: Vec<(Columns, u32)> =
            self.source.places.iter().copied().filter(|&(column, _)| want.contains(column)).collect();
        for (column, place) in places {
            let target = out.column_mut(column);
            target.resize(self.len);
            let width = target.width();
            for index in 0..self.runs.len() {
                let gaussian_block = self.runs[index].gaussian_block;
                let kept = self.tile(TileId { column: place, gaussian_block, frame_block })?;
                let (run, tile) = (&self.runs[index], &self.kept[kept]);
                let frame = if tile.constant { 0 } else { within };
                let tile_len = layout.gaussian_range(gaussian_block).count();
                for c in 0..width {
                    let plane = &tile.values[(frame * width + c) * tile_len..][..tile_len];
                    target.plane_mut(c)[run.to..run.to + run.len].copy_from_slice(&plane[run.from..run.from + run.len]);
                }
            }
        }
        Ok(())
    }
}
