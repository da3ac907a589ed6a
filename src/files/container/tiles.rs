//! Reading some Gaussians of a container: each tile once for all frames that are wanted of it, as far as memory goes.

use std::ops::Range;

use gseq::{Encoding, TileFrames, TileId, Touched};

use super::store::{Container, TileScratch};
use crate::error::{Error, Result, ShowPath};
use crate::model::{Columns, Gaussians};
use crate::source::{BlockReader, Ids, ReadPlan};

/// Bytes of the map that a reader touches, at most, before it releases what it no longer needs.
const TOUCHED: u64 = 1 << 20;

/// Gaussians that lie side by side in a tile and in the block read.
struct TileRun {
    gaussian_block: u32,
    from: usize,
    to: usize,
    len: usize,
}

/// What a reader keeps of a column.
pub(super) enum KeptColumn {
    Nothing,
    /// The one tile that a reader of just its Gaussians needs in a frame block: decompressed, or raw in the file.
    Tile(u32, TileFrames),
    Values(FrameValues),
}

/// Values at some frames of a frame block.
#[derive(Default)]
pub(super) struct FrameValues {
    block: Range<usize>,
    /// Increasing; none if one frame stands for all of the block.
    frames: Vec<usize>,
    /// `[frames, width, len]`.
    pub(super) values: Vec<f32>,
}

impl FrameValues {
    /// Which of the frames kept stands for `frame`.
    fn place(&self, frame: usize) -> Option<usize> {
        match self.frames[..] {
            [] if self.block.contains(&frame) => Some(0),
            _ => self.frames.binary_search(&frame).ok(),
        }
    }
}

/// Reads some Gaussians of a container.
///
/// Memory per Gaussian: 4 bytes × width × frames held for each column that varies, `frames held` being those wanted of a
/// frame block or what [`ReadPlan::holding`] allows; 8 × width more where that is a whole block. Of raw tiles that are read
/// whole as much, in the map, if a whole block may be held, else nothing. Nothing if just one frame is held, nothing of
/// columns that do not vary, nothing of tiles that the container holds.
pub(super) struct TileReader<'a> {
    source: &'a Container,
    len: usize,
    runs: Vec<TileRun>,
    /// Whether the Gaussians are those of one tile, in its order.
    pub(super) whole: bool,
    wanted: ReadPlan,
    /// The last frame block for which the system was told of what comes next.
    told: Option<u32>,
    /// By place in [`Container::places`].
    pub(super) kept: Vec<KeptColumn>,
    /// The frame block that `staying` belongs to.
    entered: u32,
    /// Raw tiles in use, to be released when another frame block is entered.
    staying: Touched,
    /// Tiles that have been decoded, to be released soon.
    passing: Touched,
}

impl<'a> TileReader<'a> {
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
        // Each tile is decoded once, in whatever order the Gaussians were asked for.
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
            wanted: ReadPlan::every(),
            told: None,
            kept: source.places.iter().map(|_| KeptColumn::Nothing).collect(),
            entered: 0,
            staying: Touched::default(),
            passing: Touched::default(),
        }
    }

    fn frame_block(&self, frame: usize) -> u32 {
        (frame / self.source.reader.layout().frame_block as usize) as u32
    }

    /// Writes column `index` at `frame` to `out`, `[width, len]`.
    fn read_column(&mut self, index: usize, frame: usize, out: &mut [f32]) -> Result<()> {
        if !self.keep(index, frame)? {
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

    /// Sees to it that column `index` at `frame` is kept; gives false if keeping it is not worth it or it is held by the
    /// container: then it goes where it is wanted by [`TileReader::decode`].
    fn keep(&mut self, index: usize, frame: usize) -> Result<bool> {
        let frame_block = self.frame_block(frame);
        if self.hold(index, frame_block)? {
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
        let mut frames = self.wanted.between(frame, block.end);
        if frames.len() == 1 {
            return Ok(false);
        }
        if self.whole {
            let at = TileId { column: place, gaussian_block: self.runs[0].gaussian_block, frame_block };
            let raw = reader.tile_info(at)?.encoding == Encoding::Raw;
            let all = self.wanted.held() >= block.len();
            // Decompressed, a tile is as large as all of its frames.
            if raw || all && 2 * frames.len() > block.len() {
                let mut tile = match std::mem::replace(&mut self.kept[index], KeptColumn::Nothing) {
                    KeptColumn::Tile(_, tile) => tile,
                    _ => TileFrames::default(),
                };
                // Releasing a raw tile frame by frame costs more than copying from the file does.
                let touched = match (raw, all) {
                    (true, true) => Some(&mut self.staying),
                    (true, false) => None,
                    (false, _) => Some(&mut self.passing),
                };
                reader.load(at, &mut self.source.scratch().buffer, &mut tile, touched)?;
                self.kept[index] = KeptColumn::Tile(frame_block, tile);
                return Ok(true);
            }
        }
        if self.wanted.held() == 1 {
            return Ok(false);
        }
        let mut kept = match std::mem::replace(&mut self.kept[index], KeptColumn::Nothing) {
            KeptColumn::Values(kept) => kept,
            _ => FrameValues::default(),
        };
        frames.truncate(self.wanted.held());
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

    /// Has the container hold all tiles of column `index` that are needed in a frame block, as far as it may; gives
    /// whether it does.
    fn hold(&self, index: usize, frame_block: u32) -> Result<bool> {
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

    /// Writes column `index` at `frames`, increasing and of one frame block, to `out`: `[frames, width, len]`.
    fn decode(&mut self, index: usize, frames: &[usize], out: &mut [f32]) -> Result<()> {
        let (source, reader) = (self.source, &self.source.reader);
        let layout = reader.layout();
        let (column, place) = source.places[index];
        let width = column.width(source.info.sh_degree);
        let frame_block = self.frame_block(frames[0]);
        // One frame of many is rather copied from the file than mapped and released.
        let in_place = frames.len() > 1 || !source.info.varying.contains(column);
        let mut lent = source.scratch();
        let TileScratch { buffer, frames: tile, plane: room } = &mut *lent;
        for runs in self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block) {
            let gaussian_block = runs[0].gaussian_block;
            let range = layout.gaussian_range(gaussian_block);
            let len = (range.end - range.start) as usize;
            let at = TileId { column: place, gaussian_block, frame_block };
            let held = source.held(index, at)?;
            if held.is_none() {
                reader.load(at, buffer, tile, in_place.then_some(&mut self.passing))?;
            }
            for (&frame, out) in frames.iter().zip(out.chunks_exact_mut(width * self.len)) {
                let within = frame % layout.frame_block as usize;
                let plane = match held {
                    // One frame stands for all of a constant tile.
                    Some(values) => &values[(within * width * len) % values.len()..][..width * len],
                    None if self.whole => {
                        reader.read_frame(tile, within, out)?;
                        continue;
                    }
                    None => reader.frame(tile, within, room)?,
                };
                for (from, to) in plane.chunks_exact(len).zip(out.chunks_exact_mut(self.len)) {
                    for run in runs {
                        to[run.to..run.to + run.len].copy_from_slice(&from[run.from..run.from + run.len]);
                    }
                }
            }
            if self.passing.bytes() > TOUCHED {
                reader.release(&mut self.passing);
            }
        }
        Ok(())
    }

    /// Leaves the frame block before that of `frame`, if there was one: what was used of it in the map is released.
    fn enter(&mut self, frame: usize) {
        let frame_block = self.frame_block(frame);
        if frame_block != self.entered {
            for kept in &mut self.kept {
                if matches!(kept, KeptColumn::Tile(_, tile) if tile.is_in_place()) {
                    *kept = KeptColumn::Nothing;
                }
            }
            self.source.reader.release(&mut self.staying);
            self.entered = frame_block;
        }
    }

    /// Tells the system of the tiles of `want` that come next, once per frame block. A reader that decodes a block
    /// again and again would have their bytes take the place of those it still needs.
    fn tell(&mut self, frame: usize, want: Columns) {
        let (source, reader) = (self.source, &self.source.reader);
        let frame_block = self.frame_block(frame);
        if self.told == Some(frame_block) || self.wanted.held() < reader.layout().frame_block as usize {
            return;
        }
        let now = self.told.is_none().then_some((frame_block, want));
        self.told = Some(frame_block);
        let end = reader.layout().frame_range(frame_block, self.source.info.times.len() as u64).end as usize;
        let next = self.wanted.next(end).map(|next| (self.frame_block(next), want & source.info.varying));
        for (frame_block, columns) in now.into_iter().chain(next) {
            let runs = self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block);
            reader.expect(runs.flat_map(|runs| source.unheld(columns, runs[0].gaussian_block, frame_block)));
        }
    }

    fn check(&self, frame: usize) -> Result<()> {
        match frame < self.source.info.times.len() {
            true => Ok(()),
            false => Err(Error::internal(format!("{}: there is no frame {frame}", self.source.path.shown()))),
        }
    }
}

impl BlockReader for TileReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.check(frame)?;
        if self.len > 0 && !want.is_empty() {
            self.tell(frame, want);
            self.enter(frame);
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
        self.source.reader.release(&mut self.passing);
        Ok(())
    }

    fn expect(&mut self, wanted: &ReadPlan) {
        self.wanted = wanted.clone();
        self.kept.fill_with(|| KeptColumn::Nothing);
        self.source.reader.release(&mut self.staying);
    }

    fn prepare(&mut self, frame: usize, want: Columns) -> Result<()> {
        self.check(frame)?;
        if self.len > 0 {
            // Whoever prepares has what comes next brought.
            self.told = Some(self.frame_block(frame));
            self.enter(frame);
            for index in 0..self.kept.len() {
                if want.contains(self.source.places[index].0) {
                    self.keep(index, frame)?;
                }
            }
            self.source.reader.release(&mut self.passing);
        }
        Ok(())
    }
}

impl Drop for TileReader<'_> {
    fn drop(&mut self) {
        self.passing.append(&mut self.staying);
        self.source.reader.release(&mut self.passing);
    }
}
