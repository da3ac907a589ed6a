//! Reads some Gaussians of a container. Each tile is decoded once for all frames that are needed from it, as far as
//! memory allows.

use std::ops::Range;

use gseq::{Encoding, TileFrames, TileId, TouchedPages};

use super::store::{Container, TileScratch};
use crate::error::{Error, Result, ShowPath};
use crate::model::{Attributes, Gaussians};
use crate::source::{BlockReader, Ids, ReadPlan};

/// Maximum number of bytes of the memory map that a reader touches before it releases pages that it no longer needs.
const MAX_TOUCHED_BYTES: u64 = 1 << 20;

/// Gaussians that are adjacent both in a tile and in the reader's block: `len` of them, from `from` in the tile, `to`
/// in the block.
struct TileRun {
    gaussian_block: u32,
    from: usize,
    to: usize,
    len: usize,
}

/// Data that a reader keeps of one column.
pub(super) enum KeptColumn {
    Nothing,
    /// Frame block, and the one tile that holds exactly the reader's Gaussians: decompressed, or raw in the file.
    Tile(u32, TileFrames),
    Values(FrameValues),
}

/// Values at some frames of a frame block.
#[derive(Default)]
pub(super) struct FrameValues {
    /// Frames of the frame block.
    block: Range<usize>,
    /// Frames whose values are stored, increasing; empty if one frame stands for the whole block.
    frames: Vec<usize>,
    /// Values, `[frames, width, len]`.
    pub(super) values: Vec<f32>,
}

impl FrameValues {
    /// Returns the index in `frames` of the values for `frame`.
    fn place(&self, frame: usize) -> Option<usize> {
        match self.frames[..] {
            [] if self.block.contains(&frame) => Some(0),
            _ => self.frames.binary_search(&frame).ok(),
        }
    }
}

/// Reader of some Gaussians of a container.
///
/// Memory per Gaussian: 4 bytes × width × frames held for each column that varies. "Frames held" are the needed frames
/// of a frame block, at most the limit of [`ReadPlan::holding`]. Add 8 bytes × width if this is a whole block. Raw
/// tiles that are read whole take as much of the memory map if a whole block may be held, else nothing. There is no
/// such memory if only one frame is held, for columns that do not vary, and for tiles that the container holds.
pub(super) struct TileReader<'a> {
    source: &'a Container,
    len: usize,
    runs: Vec<TileRun>,
    /// Whether the Gaussians are exactly those of one tile, in its order.
    pub(super) whole: bool,
    /// Frames that will be read.
    plan: ReadPlan,
    /// Last frame block for which the operating system was told which tiles come next.
    announced_block: Option<u32>,
    /// Data kept of each column, in the order of [`Container::places`].
    pub(super) kept: Vec<KeptColumn>,
    /// Frame block of the raw tiles in `raw_in_use`.
    entered: u32,
    /// Raw tiles in use, to be released when another frame block is entered.
    raw_in_use: TouchedPages,
    /// Tiles that have been decoded, to be released soon.
    decoded: TouchedPages,
}

impl<'a> TileReader<'a> {
    /// Returns a reader of the Gaussians `ids`.
    pub(super) fn new(source: &'a Container, ids: &Ids<'_>) -> TileReader<'a> {
        let block = source.reader.layout().gaussian_block as usize;
        let mut runs: Vec<TileRun> = Vec::new();
        for (to, id) in ids.iter().enumerate() {
            let (tile, from) = ((id / block) as u32, id % block);
            match runs.last_mut() {
                Some(run) if run.gaussian_block == tile && run.from + run.len == from => run.len += 1,
                _ => runs.push(TileRun { gaussian_block: tile, from, to, len: 1 }),
            }
        }
        // Sorted, so that each tile is decoded once for Gaussians in any order.
        runs.sort_by_key(|run| run.gaussian_block);
        let whole = match runs[..] {
            [TileRun { gaussian_block, from: 0, len, .. }] => {
                let range = source.reader.layout().gaussian_range(gaussian_block);
                len as u64 == range.end - range.start
            }
            _ => false,
        };
        TileReader {
            source,
            len: ids.len(),
            runs,
            whole,
            plan: ReadPlan::every(),
            announced_block: None,
            kept: source.places.iter().map(|_| KeptColumn::Nothing).collect(),
            entered: 0,
            raw_in_use: TouchedPages::default(),
            decoded: TouchedPages::default(),
        }
    }

    /// Returns the index of the frame block that contains `frame`.
    fn frame_block(&self, frame: usize) -> u32 {
        (frame / self.source.reader.layout().frame_block as usize) as u32
    }

    /// Writes column `index` at `frame` to `out`, `[width, len]`.
    fn read_column(&mut self, index: usize, frame: usize, out: &mut [f32]) -> Result<()> {
        if !self.try_keep(index, frame)? {
            return self.decode(index, &[frame], out);
        }
        match &mut self.kept[index] {
            KeptColumn::Tile(_, tile) => {
                let within = frame % self.source.reader.layout().frame_block as usize;
                self.source.reader.read_frame(tile, within, out)?;
            }
            KeptColumn::Values(kept) => {
                let at = kept.place(frame).unwrap_or_default() * out.len();
                out.copy_from_slice(&kept.values[at..][..out.len()]);
            }
            KeptColumn::Nothing => (),
        }
        Ok(())
    }

    /// Makes the reader keep column `index` at `frame`, if that is worth its memory. Returns false if it is not, or if
    /// the container holds the tiles; [`TileReader::decode`] then writes the values to their destination.
    fn try_keep(&mut self, index: usize, frame: usize) -> Result<bool> {
        let frame_block = self.frame_block(frame);
        if self.try_hold(index, frame_block)? {
            return Ok(false);
        }
        match &self.kept[index] {
            KeptColumn::Tile(of, _) if *of == frame_block => return Ok(true),
            KeptColumn::Values(values) if values.place(frame).is_some() => return Ok(true),
            _ => (),
        }
        let (column, place) = self.source.places[index];
        if !self.source.info.varying.contains(column) {
            return Ok(false);
        }
        let reader = &self.source.reader;
        let block = reader.layout().frame_range(frame_block, self.source.info.times.len() as u64);
        let block = block.start as usize..block.end as usize;
        let mut frames = self.plan.between(frame, block.end);
        if frames.len() == 1 {
            return Ok(false);
        }
        if self.whole {
            let at = TileId { column: place, gaussian_block: self.runs[0].gaussian_block, frame_block };
            let raw = reader.tile_info(at)?.encoding == Encoding::Raw;
            let all = self.plan.held() >= block.len();
            // A decompressed tile is as large as all of its frames.
            if raw || all && 2 * frames.len() > block.len() {
                let mut tile = match std::mem::replace(&mut self.kept[index], KeptColumn::Nothing) {
                    KeptColumn::Tile(_, tile) => tile,
                    _ => TileFrames::default(),
                };
                // Releasing a raw tile frame by frame costs more than copying from the file.
                let touched = match (raw, all) {
                    (true, true) => Some(&mut self.raw_in_use),
                    (true, false) => None,
                    (false, _) => Some(&mut self.decoded),
                };
                reader.load(at, &mut self.source.scratch().buffer, &mut tile, touched)?;
                self.kept[index] = KeptColumn::Tile(frame_block, tile);
                return Ok(true);
            }
        }
        if self.plan.held() == 1 {
            return Ok(false);
        }
        let mut kept = match std::mem::replace(&mut self.kept[index], KeptColumn::Nothing) {
            KeptColumn::Values(kept) => kept,
            _ => FrameValues::default(),
        };
        frames.truncate(self.plan.held());
        let constant = self.is_constant(place, frame_block)?;
        if constant {
            frames.truncate(1);
        }
        kept.values.resize(frames.len() * column.width(self.source.info.sh_degree) * self.len, 0.0);
        self.decode(index, &frames, &mut kept.values)?;
        if constant {
            frames.clear();
        }
        self.kept[index] = KeptColumn::Values(FrameValues { block, frames, values: kept.values });
        Ok(true)
    }

    /// Makes the container hold all tiles of column `index` that are needed in a frame block. Returns whether it holds
    /// them.
    fn try_hold(&self, index: usize, frame_block: u32) -> Result<bool> {
        if self.source.held.get().is_none() {
            return Ok(false);
        }
        let column = self.source.places[index].1;
        for runs in self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block) {
            let at = TileId { column, gaussian_block: runs[0].gaussian_block, frame_block };
            if self.source.held(index, at)?.is_none() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Returns whether no value of the column changes within the frame block.
    fn is_constant(&self, column: u32, frame_block: u32) -> Result<bool> {
        for run in &self.runs {
            let at = TileId { column, gaussian_block: run.gaussian_block, frame_block };
            if !self.source.reader.tile_info(at)?.constant {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Writes column `index` at `frames`, which are increasing and in one frame block, to `out`: `[frames, width,
    /// len]`.
    fn decode(&mut self, index: usize, frames: &[usize], out: &mut [f32]) -> Result<()> {
        let (source, reader) = (self.source, &self.source.reader);
        let layout = reader.layout();
        let (column, place) = source.places[index];
        let width = column.width(source.info.sh_degree);
        let frame_block = self.frame_block(frames[0]);
        // A single frame of many is copied from the file, which is cheaper than mapping and releasing its pages.
        let in_place = frames.len() > 1 || !source.info.varying.contains(column);
        let mut lent = source.scratch();
        let TileScratch { buffer, frames: tile, plane: plane_buffer } = &mut *lent;
        for runs in self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block) {
            let gaussian_block = runs[0].gaussian_block;
            let range = layout.gaussian_range(gaussian_block);
            let len = (range.end - range.start) as usize;
            let at = TileId { column: place, gaussian_block, frame_block };
            let held = source.held(index, at)?;
            if held.is_none() {
                reader.load(at, buffer, tile, in_place.then_some(&mut self.decoded))?;
            }
            for (&frame, out) in frames.iter().zip(out.chunks_exact_mut(width * self.len)) {
                let within = frame % layout.frame_block as usize;
                let plane = match held {
                    // A constant tile has one frame for all frames.
                    Some(values) => &values[(within * width * len) % values.len()..][..width * len],
                    None if self.whole => {
                        reader.read_frame(tile, within, out)?;
                        continue;
                    }
                    None => reader.frame(tile, within, plane_buffer)?,
                };
                for (from, to) in plane.chunks_exact(len).zip(out.chunks_exact_mut(self.len)) {
                    for run in runs {
                        to[run.to..run.to + run.len].copy_from_slice(&from[run.from..run.from + run.len]);
                    }
                }
            }
            if self.decoded.bytes() > MAX_TOUCHED_BYTES {
                reader.release(&mut self.decoded);
            }
        }
        Ok(())
    }

    /// Releases the raw tiles of the previous frame block if `frame` belongs to another one.
    fn enter_frame_block(&mut self, frame: usize) {
        let frame_block = self.frame_block(frame);
        if frame_block != self.entered {
            for kept in &mut self.kept {
                if matches!(kept, KeptColumn::Tile(_, tile) if tile.is_in_place()) {
                    *kept = KeptColumn::Nothing;
                }
            }
            self.source.reader.release(&mut self.raw_in_use);
            self.entered = frame_block;
        }
    }

    /// Tells the operating system, once per frame block, which tiles of the columns `want` come next. Does nothing for
    /// a reader that holds less than a frame block: it decodes a block several times, and read-ahead would evict pages
    /// that it still needs.
    fn announce_next_tiles(&mut self, frame: usize, want: Attributes) {
        let (source, reader) = (self.source, &self.source.reader);
        let frame_block = self.frame_block(frame);
        if self.announced_block == Some(frame_block) || self.plan.held() < reader.layout().frame_block as usize {
            return;
        }
        let now = self.announced_block.is_none().then_some((frame_block, want));
        self.announced_block = Some(frame_block);
        let end = reader.layout().frame_range(frame_block, self.source.info.times.len() as u64).end as usize;
        let next = self.plan.next(end).map(|next| (self.frame_block(next), want & source.info.varying));
        for (frame_block, columns) in now.into_iter().chain(next) {
            let runs = self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block);
            reader.expect(runs.flat_map(|runs| source.unheld(columns, runs[0].gaussian_block, frame_block)));
        }
    }

    /// Checks that there is a frame `frame`.
    fn check(&self, frame: usize) -> Result<()> {
        match frame < self.source.info.times.len() {
            true => Ok(()),
            false => Err(Error::internal(format!("{}: there is no frame {frame}", self.source.path.shown()))),
        }
    }
}

impl BlockReader for TileReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.check(frame)?;
        if self.len > 0 && !want.is_empty() {
            self.announce_next_tiles(frame, want);
            self.enter_frame_block(frame);
            self.source.states.add(self.len as u64);
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
        self.source.reader.release(&mut self.decoded);
        Ok(())
    }

    fn expect(&mut self, plan: &ReadPlan) {
        self.plan = plan.clone();
        self.kept.fill_with(|| KeptColumn::Nothing);
        self.source.reader.release(&mut self.raw_in_use);
    }

    fn prepare(&mut self, frame: usize, want: Attributes) -> Result<()> {
        self.check(frame)?;
        if self.len > 0 {
            // The caller of `prepare` fetches the next tiles itself.
            self.announced_block = Some(self.frame_block(frame));
            self.enter_frame_block(frame);
            for index in 0..self.kept.len() {
                if want.contains(self.source.places[index].0) {
                    self.try_keep(index, frame)?;
                }
            }
            self.source.reader.release(&mut self.decoded);
        }
        Ok(())
    }
}

impl Drop for TileReader<'_> {
    fn drop(&mut self) {
        self.decoded.append(&mut self.raw_in_use);
        self.source.reader.release(&mut self.decoded);
    }
}
