//! A `gseq` container as a source of frames.
//!
//! In: the file. Out: the state of any Gaussians at any frame. Memory: of the file nothing stays mapped; what a
//! reader keeps is that of [`TileReader`], and each thread that decodes has one [`Scratch`].
//!
//! Stored bytes are read, not mapped: pages that were touched count as resident until they are released, and
//! releasing them costs more than the copy (raw frames into the caller's state, two cores of an EPYC 7003: 6.3 GB/s
//! by positioned reads; 5.8 mapped and released tile by tile, 2.0 frame by frame; 14 left mapped).
//!
//! The disk works ahead by advice: when a reader that decodes whole frame blocks enters one, the system is told of
//! the next. Measured on 32,768 Gaussians × 320 frames on two threads, from a cold page cache: 1.1 to 1.7 s with the
//! advice, 2.5 to 3.2 without, 0.8 to 0.9 from a warm one (raw); 2.4 to 2.5, 2.8 to 3.1, 2.0 to 2.1 (packed). What is left
//! is mostly the first frame block of each block of Gaussians. Threads that fetch, over channels, could win no
//! more than that, and would need a copy of their own of what they fetched.

use std::ops::{Deref, DerefMut, Range};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use gseq::{Encoding, Reader, TileBuffer, TileFrames, TileId};

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
    /// One for each thread at most, shared by all readers.
    scratch: Mutex<Vec<Scratch>>,
}

/// What decoding a tile takes besides what is kept of it: about three times the tile.
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
        Ok(Container { path: path.to_owned(), reader, info, places, scratch: Mutex::default() })
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
        Ok(Box::new(self.tile_reader(&ids)))
    }
}

impl Container {
    fn tile_reader(&self, ids: &Ids<'_>) -> TileReader<'_> {
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
        let whole = match runs[..] {
            [Run { gaussian_block, from: 0, len, .. }] => {
                let range = self.reader.layout().gaussian_range(gaussian_block);
                len as u64 == range.end - range.start
            }
            _ => false,
        };
        let kept = self.places.iter().map(|_| Kept::Nothing).collect();
        TileReader { source: self, len: ids.len(), runs, whole, held: usize::MAX, expected: None, kept }
    }
}

/// Gaussians that lie side by side in a tile and in the block read.
struct Run {
    gaussian_block: u32,
    from: usize,
    to: usize,
    len: usize,
}

/// What a reader keeps of a column.
enum Kept {
    Nothing,
    /// The one tile that a reader of just its Gaussians needs in a frame block, decompressed.
    Tile(u32, TileFrames),
    /// Values at some frames, `[frames, width, len]`; one frame for all of them if they are the same.
    Values(Range<usize>, Vec<f32>),
}

/// Reads some Gaussians of a container.
///
/// Memory per Gaussian: 4 bytes × width × frames held for each column that varies, `frames held` being those of a
/// frame block or what [`BlockReader::hold`] allows; 8 × width more where that is a whole block. Nothing if just one
/// frame is held, nothing of raw tiles that are read whole, nothing of columns that do not vary.
struct TileReader<'a> {
    source: &'a Container,
    len: usize,
    runs: Vec<Run>,
    /// Whether the Gaussians are those of one tile, in its order.
    whole: bool,
    /// Most frames to hold.
    held: usize,
    /// The last frame block whose tiles the system was told of.
    expected: Option<u32>,
    /// By place in [`Container::places`].
    kept: Vec<Kept>,
}

impl TileReader<'_> {
    /// Writes column `index` at `frame` to `out`, `[width, len]`.
    fn read_column(&mut self, index: usize, frame: usize, out: &mut [f32]) -> Result<()> {
        let reader = &self.source.reader;
        let frame_block = (frame / reader.layout().frame_block as usize) as u32;
        match &mut self.kept[index] {
            Kept::Tile(of, frames) if *of == frame_block => {
                return Ok(reader.read_frame(frames, frame % reader.layout().frame_block as usize, out)?);
            }
            Kept::Values(frames, values) if frames.contains(&frame) => {
                let at = if values.len() == out.len() { 0 } else { (frame - frames.start) * out.len() };
                out.copy_from_slice(&values[at..][..out.len()]);
                return Ok(());
            }
            _ => (),
        }
        // What is not read again, or would be decoded again for its next frame anyway, goes where it is wanted.
        let (column, place) = self.source.places[index];
        if !self.source.info.varying.contains(column) {
            return self.decode(place, frame..frame + 1, out);
        }
        let of_block = reader.layout().frame_range(frame_block, self.source.info.times.len() as u64);
        let of_block = of_block.start as usize..of_block.end as usize;
        if self.whole {
            let at = TileId { column: place, gaussian_block: self.runs[0].gaussian_block, frame_block };
            if (self.held > 1 && self.held >= of_block.len()) || reader.tile_info(at)?.encoding == Encoding::Raw {
                let mut frames = match std::mem::replace(&mut self.kept[index], Kept::Nothing) {
                    Kept::Tile(_, frames) => frames,
                    _ => TileFrames::default(),
                };
                reader.load(at, &mut self.source.scratch().buffer, &mut frames)?;
                reader.read_frame(&mut frames, frame - of_block.start, out)?;
                self.kept[index] = Kept::Tile(frame_block, frames);
                return Ok(());
            }
        }
        if self.held == 1 {
            return self.decode(place, frame..frame + 1, out);
        }
        let mut values = match std::mem::replace(&mut self.kept[index], Kept::Nothing) {
            Kept::Values(_, values) => values,
            _ => Vec::new(),
        };
        let mut frames = frame..of_block.end.min(frame.saturating_add(self.held));
        let constant = self.is_constant(place, frame_block)?;
        let stored = if constant { 1 } else { frames.len() };
        values.resize(stored * out.len(), 0.0);
        self.decode(place, frame..frame + stored, &mut values)?;
        if constant {
            frames = of_block;
        }
        out.copy_from_slice(&values[..out.len()]);
        self.kept[index] = Kept::Values(frames, values);
        Ok(())
    }

    /// Whether no Gaussian's value changes within the frame block.
    fn is_constant(&self, column: u32, frame_block: u32) -> Result<bool> {
        for run in &self.runs {
            let at = TileId { column, gaussian_block: run.gaussian_block, frame_block };
            if !self.source.reader.tile_info(at)?.constant {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Writes a column at `frames`, of one frame block, to `out`: `[frames, width, len]`.
    fn decode(&self, column: u32, frames: Range<usize>, out: &mut [f32]) -> Result<()> {
        let reader = &self.source.reader;
        let layout = reader.layout();
        let width = layout.columns[column as usize].width as usize;
        let frame_block = (frames.start / layout.frame_block as usize) as u32;
        let first = frames.start % layout.frame_block as usize;
        let mut lent = self.source.scratch();
        let Scratch { buffer, frames: tile, plane } = &mut *lent;
        for runs in self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block) {
            let gaussian_block = runs[0].gaussian_block;
            let range = layout.gaussian_range(gaussian_block);
            let len = (range.end - range.start) as usize;
            reader.load(TileId { column, gaussian_block, frame_block }, buffer, tile)?;
            for (k, out) in out.chunks_exact_mut(width * self.len).enumerate() {
                if self.whole {
                    reader.read_frame(tile, first + k, out)?;
                    continue;
                }
                plane.resize(width * len, 0.0);
                reader.read_frame(tile, first + k, plane)?;
                for (from, to) in plane.chunks_exact(len).zip(out.chunks_exact_mut(self.len)) {
                    for run in runs {
                        to[run.to..run.to + run.len].copy_from_slice(&from[run.from..run.from + run.len]);
                    }
                }
            }
        }
        Ok(())
    }

    /// Tells the system of the tiles of `want` that come next, once per frame block. A reader that decodes a block
    /// again and again would have their bytes take the place of those it still needs.
    fn expect(&mut self, frame_block: u32, want: Columns) {
        let reader = &self.source.reader;
        if self.expected == Some(frame_block) || self.held < reader.layout().frame_block as usize {
            return;
        }
        let varying = want & self.source.info.varying;
        let blocks = match self.expected {
            Some(_) => vec![(frame_block + 1, varying)],
            None => vec![(frame_block, want), (frame_block + 1, varying)],
        };
        self.expected = Some(frame_block);
        for (frame_block, columns) in blocks {
            let of = |gaussian_block: u32| {
                let places = self.source.places.iter().filter(move |(column, _)| columns.contains(*column));
                places.map(move |&(_, column)| TileId { column, gaussian_block, frame_block })
            };
            let runs = self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block);
            reader.expect(runs.flat_map(|runs| of(runs[0].gaussian_block)));
        }
    }
}

impl BlockReader for TileReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        if frame >= self.source.info.times.len() {
            return Err(Error::usage(format!("{}: there is no frame {frame}", self.source.path.display())));
        }
        if self.len > 0 {
            self.expect((frame / self.source.reader.layout().frame_block as usize) as u32, want);
        }
        for index in 0..self.kept.len() {
            let column = self.source.places[index].0;
            if !want.contains(column) {
                continue;
            }
            let target = out.column_mut(column);
            target.resize(self.len);
            if self.len > 0 {
                self.read_column(index, frame, target.planes_mut())?;
            }
        }
        Ok(())
    }

    fn hold(&mut self, frames: usize) {
        self.held = frames.max(1);
        self.kept.fill_with(|| Kept::Nothing);
    }
}

#[cfg(test)]
mod tests;
