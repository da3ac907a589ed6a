//! Reads some Gaussians of a container. A tile holds the values of one column (attribute) for a block of consecutive
//! Gaussians and frames. As far as memory allows, each tile is decoded once for all frames that are needed from it.

use std::ops::Range;

use gseq::{Encoding, TileFrames, TileId, TouchedPages};

use super::store::{Container, TileScratch};
use crate::error::{Error, Result, ShowPath};
use crate::model::{Attributes, Gaussians};
use crate::source::{BlockReader, Ids, ReadPlan};

/// Maximum number of bytes of the memory-mapped file that a reader leaves in memory after it decoded tiles from them.
/// Above this number, it releases the pages of these tiles.
const MAX_TOUCHED_BYTES: u64 = 1 << 20;

/// Run of `len` Gaussians that are adjacent both in a tile and in the reader's list of Gaussians. `gaussian_block` is
/// the index of the tile's Gaussian block. The first Gaussian has index `tile_index` in the tile and index `list_index`
/// in the list.
struct TileRun {
    gaussian_block: u32,
    tile_index: usize,
    list_index: usize,
    len: usize,
}

/// Values of one column (attribute) that a reader keeps in memory.
pub(super) enum KeptColumn {
    Nothing,
    /// All frames of one tile. Used only if the tile holds exactly the reader's Gaussians.
    ///
    /// - The first field is the index of the tile's frame block (range of consecutive frames).
    /// - The second field holds the values: decompressed, or raw (uncompressed) in the mapped file.
    Tile(u32, TileFrames),
    Values(FrameValues),
}

/// Values of one column (attribute) of the reader's Gaussians, at some frames of one frame block (range of consecutive
/// frames that are stored together).
#[derive(Default)]
pub(super) struct FrameValues {
    /// Numbers of all frames in the frame block (range of consecutive frames that are stored together).
    block: Range<usize>,
    /// Numbers of the frames whose values are in `values`, increasing. Empty if the values are the same in all frames
    /// of the block and stored once.
    frames: Vec<usize>,
    /// Values, laid out as `[frames, width, len]`: the stored frames, the components of the column, the reader's
    /// Gaussians.
    pub(super) values: Vec<f32>,
}

impl FrameValues {
    /// Returns the index, along the first axis of `values`, of the values for `frame`; `None` if they are not stored.
    fn place(&self, frame: usize) -> Option<usize> {
        match self.frames[..] {
            [] if self.block.contains(&frame) => Some(0),
            _ => self.frames.binary_search(&frame).ok(),
        }
    }
}

/// Reader of some Gaussians of a container, frame by frame. It keeps decoded values in memory, so that a tile is not
/// decoded again for the next frame. A frame block is a range of consecutive frames that are stored together.
///
/// Memory in bytes per Gaussian and column (attribute), where width is the number of components of the column:
///
/// - 4 × width for each frame whose values are kept. These frames lie in one frame block and in the read plan (the
///   frames that will be read). There are at most as many as [`ReadPlan::with_max_kept_frames`] allows.
/// - 8 × width in addition, if all frames of a frame block are kept.
/// - For a raw (uncompressed) tile that is read whole: mapped memory of the same size if all frames of a frame block
///   may be kept, else 0.
/// - 0 if only one frame is kept, if the column does not vary over time, or if the container itself keeps the tile.
pub(super) struct TileReader<'a> {
    source: &'a Container,
    len: usize,
    runs: Vec<TileRun>,
    /// Whether the reader's Gaussians are exactly those of one tile, in the order of the tile.
    pub(super) is_whole_tile: bool,
    /// Numbers of the frames that will be read.
    plan: ReadPlan,
    /// Index of the last frame block for which the operating system was told which tiles of the file will be read next,
    /// so that it reads them ahead.
    announced_block: Option<u32>,
    /// For each column (attribute), the values that this reader keeps in memory, in the order of [`Container::places`].
    pub(super) kept: Vec<KeptColumn>,
    /// Index of the frame block (range of consecutive frames) that was read last. The pages in `raw_in_use` belong to
    /// its tiles.
    entered: u32,
    /// Mapped pages of the raw (uncompressed) tiles that are in use. They are released when the reader goes on to
    /// another frame block (range of consecutive frames).
    raw_in_use: TouchedPages,
    /// Mapped pages of tiles that have been decoded. They are released when they exceed 1 MiB ([`MAX_TOUCHED_BYTES`]).
    decoded: TouchedPages,
}

impl<'a> TileReader<'a> {
    /// Returns a reader of the Gaussians `ids` of the container `source`.
    pub(super) fn new(source: &'a Container, ids: &Ids<'_>) -> TileReader<'a> {
        let block = source.reader.layout().gaussian_block as usize;
        let mut runs: Vec<TileRun> = Vec::new();
        for (list_index, id) in ids.iter().enumerate() {
            let (tile, tile_index) = ((id / block) as u32, id % block);
            match runs.last_mut() {
                Some(run) if run.gaussian_block == tile && run.tile_index + run.len == tile_index => run.len += 1,
                _ => runs.push(TileRun { gaussian_block: tile, tile_index, list_index, len: 1 }),
            }
        }
        // Sort the runs by tile, so that each tile is decoded once even if the Gaussians are in any order.
        runs.sort_by_key(|run| run.gaussian_block);
        let is_whole_tile = match runs[..] {
            [TileRun { gaussian_block, tile_index: 0, len, .. }] => {
                let range = source.reader.layout().gaussian_range(gaussian_block);
                len as u64 == range.end - range.start
            }
            _ => false,
        };
        TileReader {
            source,
            len: ids.len(),
            runs,
            is_whole_tile,
            plan: ReadPlan::all_frames(),
            announced_block: None,
            kept: source.places.iter().map(|_| KeptColumn::Nothing).collect(),
            entered: 0,
            raw_in_use: TouchedPages::default(),
            decoded: TouchedPages::default(),
        }
    }

    /// Returns the index of the frame block (range of consecutive frames that are stored together) that contains
    /// `frame`.
    fn frame_block(&self, frame: usize) -> u32 {
        (frame / self.source.reader.layout().frame_block as usize) as u32
    }

    /// Reads one attribute of the Gaussians of this reader at frame `frame` into `out`. `out` has the shape `[width,
    /// len]`: one row per component of the attribute, one column per Gaussian. `index` is the index of the attribute in
    /// [`Container::places`].
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

    /// Tries to decode the attribute with index `index`, for `frame` and later frames of its frame block (range of
    /// consecutive frames), into the memory of this reader. Returns whether the values of `frame` are now there.
    ///
    /// Returns false if keeping the values in this reader saves no work:
    ///
    /// - The container itself keeps the tiles.
    /// - The attribute does not vary over time.
    /// - No other frame of the block is needed or may be kept.
    ///
    /// The caller then uses [`TileReader::decode`], which writes the values directly to their destination.
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
        let mut frames = self.plan.frames_between(frame, block.end);
        if frames.len() == 1 {
            return Ok(false);
        }
        if self.is_whole_tile {
            let at = TileId { column: place, gaussian_block: self.runs[0].gaussian_block, frame_block };
            let raw = reader.tile_info(at)?.encoding == Encoding::Raw;
            let keeps_whole_block = self.plan.max_kept_frames() >= block.len();
            // A decompressed tile takes the memory of all its frames, so keep one only if more than half of its frames
            // are needed.
            if raw || keeps_whole_block && 2 * frames.len() > block.len() {
                let mut tile = match std::mem::replace(&mut self.kept[index], KeptColumn::Nothing) {
                    KeptColumn::Tile(_, tile) => tile,
                    _ => TileFrames::default(),
                };
                // Copy raw tiles from the file if less than a frame block may be kept, because releasing their pages
                // frame by frame costs more.
                let touched = match (raw, keeps_whole_block) {
                    (true, true) => Some(&mut self.raw_in_use),
                    (true, false) => None,
                    (false, _) => Some(&mut self.decoded),
                };
                reader.load(at, &mut self.source.scratch().buffer, &mut tile, touched)?;
                self.kept[index] = KeptColumn::Tile(frame_block, tile);
                return Ok(true);
            }
        }
        if self.plan.max_kept_frames() == 1 {
            return Ok(false);
        }
        let mut kept = match std::mem::replace(&mut self.kept[index], KeptColumn::Nothing) {
            KeptColumn::Values(kept) => kept,
            _ => FrameValues::default(),
        };
        frames.truncate(self.plan.max_kept_frames());
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

    /// Decodes the tiles that this reader needs for one attribute and one frame block, so that the container keeps them
    /// in memory. `index` is the index of the attribute in [`Container::places`]. Returns whether all these tiles are
    /// now in memory; false if they do not fit into the memory that the container may use.
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

    /// Returns whether the values of column `column` of the container do not change within the frame block
    /// `frame_block`, for all Gaussians that the reader needs.
    fn is_constant(&self, column: u32, frame_block: u32) -> Result<bool> {
        for run in &self.runs {
            let at = TileId { column, gaussian_block: run.gaussian_block, frame_block };
            if !self.source.reader.tile_info(at)?.constant {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Decodes the values of the attribute with index `index` at `frames` into `out`, `[frames, width, len]`: the
    /// frames, the components of the attribute, the reader's Gaussians. `frames` are increasing and lie in one frame
    /// block.
    fn decode(&mut self, index: usize, frames: &[usize], out: &mut [f32]) -> Result<()> {
        let (source, reader) = (self.source, &self.source.reader);
        let layout = reader.layout();
        let (column, place) = source.places[index];
        let width = column.width(source.info.sh_degree);
        let frame_block = self.frame_block(frames[0]);
        // Copy a single frame of many from the file, which is cheaper than mapping and releasing its pages.
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
                    // A constant tile stores one frame, which holds for all frames.
                    Some(values) => &values[(within * width * len) % values.len()..][..width * len],
                    None if self.is_whole_tile => {
                        reader.read_frame(tile, within, out)?;
                        continue;
                    }
                    None => reader.frame(tile, within, plane_buffer)?,
                };
                for (from, to) in plane.chunks_exact(len).zip(out.chunks_exact_mut(self.len)) {
                    for run in runs {
                        to[run.list_index..run.list_index + run.len]
                            .copy_from_slice(&from[run.tile_index..run.tile_index + run.len]);
                    }
                }
            }
            if self.decoded.bytes() > MAX_TOUCHED_BYTES {
                reader.release(&mut self.decoded);
            }
        }
        Ok(())
    }

    /// Prepares for reading `frame`. If `frame` belongs to another frame block than the frame read last, releases the
    /// memory-mapped pages of the raw (uncompressed) tiles of the earlier block.
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

    /// Tells the operating system which tiles of the attributes `want` will be read next, so that it reads them ahead.
    /// These are the tiles of the frame block (range of consecutive frames) that will be read after the block of
    /// `frame`. The first call also announces the tiles of the block of `frame`. Further calls for the same block do
    /// nothing.
    ///
    /// Does nothing if the reader may keep the values of fewer frames than a frame block has. It then decodes each
    /// block several times, and read-ahead would evict pages that it still needs.
    fn announce_next_tiles(&mut self, frame: usize, want: Attributes) {
        let (source, reader) = (self.source, &self.source.reader);
        let frame_block = self.frame_block(frame);
        if self.announced_block == Some(frame_block)
            || self.plan.max_kept_frames() < reader.layout().frame_block as usize
        {
            return;
        }
        let now = self.announced_block.is_none().then_some((frame_block, want));
        self.announced_block = Some(frame_block);
        let end = reader.layout().frame_range(frame_block, self.source.info.times.len() as u64).end as usize;
        let next = self.plan.first_planned_from(end).map(|next| (self.frame_block(next), want & source.info.varying));
        for (frame_block, columns) in now.into_iter().chain(next) {
            let runs = self.runs.chunk_by(|a, b| a.gaussian_block == b.gaussian_block);
            reader.prefetch_in_background(
                runs.flat_map(|runs| source.unheld(columns, runs[0].gaussian_block, frame_block)),
            );
        }
    }

    /// Checks that the sequence has a frame with number `frame`.
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
            let target = out.attribute_values_mut(column);
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
}

impl Drop for TileReader<'_> {
    fn drop(&mut self) {
        self.decoded.append(&mut self.raw_in_use);
        self.source.reader.release(&mut self.decoded);
    }
}
