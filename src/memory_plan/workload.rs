//! Sizes of an input from which memory and time of a run are estimated, and the measured time of common operations.

use crate::files::frame_stream::StreamHeader;
use crate::limits::Limits;
use crate::model::{Attributes, Camera, Rig, SequenceInfo, ViewSchedule};
use crate::models::MemoryProfile;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::passes::{GAUSSIANS_PER_BLOCK, VIEWS_PER_THREAD};
use crate::render::{self, GridStrides};

/// Bytes of memory per tile (stored block of values) of an open container: a flag that tells whether the tile's
/// checksum has been verified.
const PER_TILE: u64 = 1;
/// Bytes of memory for each pair of a column (attribute) and a block of Gaussians, in a container that is open or being
/// written. A constant tile is a stored block whose values are the same at all its frames. The bytes hold the index
/// entry of the last constant tile of the pair.
const PER_SLOT: u64 = 80;
/// Bytes of memory per frame of a container that is being written: its time stamp (8 bytes), counted twice because the
/// list of time stamps grows by being copied to twice its length.
const PER_WRITTEN_FRAME: u64 = 16;
/// Bytes of memory per frame of an open input: two copies of its time stamp (one in the container's index, one in the
/// sequence), and the number of Gaussians alive (opacity ≥ alpha_min) in the frame.
const PER_FRAME: u64 = 8 + 8 + 8;
/// Bytes of memory per view in a list of views.
const PER_LISTED_VIEW: u64 = 24;

/// Bytes of memory per Gaussian while all threads render one view together: the projected Gaussians of each thread, and
/// the same data joined into one list.
pub const SHARED_VIEW_BYTES_PER_GAUSSIAN: u64 = 2 * render::BYTES_PER_VISIBLE as u64;

/// Named part of a stage's memory, with its size in bytes.
pub type MemoryPart = (&'static str, u64);

/// Properties of an input and its cameras, from which the memory and time of a run are estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Workload {
    /// Number of Gaussians, N.
    pub gaussians: u64,
    /// Number of frames, T; 0 for a stream, whose length is unknown.
    pub frames: u64,
    /// SH degree of the Gaussians' colors.
    pub sh_degree: usize,
    /// Attributes that vary in time.
    pub varying: Attributes,
    /// Memory that the input and its readers take, and numbers of frames and Gaussians per tile of the input.
    pub input: MemoryProfile,
    /// Number of viewpoints: distinct view numbers among the views of all cameras. Views with the same number show the
    /// scene from one viewpoint at different times.
    pub viewpoints: u64,
    /// Number of pixels per image of the camera with the largest images.
    pub pixels: u64,
    /// Number of views of the frame with the most views.
    pub views: u64,
    /// Total number of views over all frames.
    pub frame_views: u64,
    /// Bytes of memory that the cameras and the list of the views of the scene take, see [`Rig::bytes`].
    pub rig: u64,
    /// Number of threads that share the work.
    pub threads: u64,
}

impl Workload {
    /// Creates the workload of an open input without cameras. `info` describes its sequence, `input` the memory that it
    /// takes.
    pub fn new(info: &SequenceInfo, input: MemoryProfile) -> Workload {
        Workload {
            gaussians: info.count as u64,
            frames: info.times.len() as u64,
            sh_degree: info.sh_degree,
            varying: info.varying,
            input,
            viewpoints: 0,
            pixels: 0,
            views: 0,
            frame_views: 0,
            rig: 0,
            threads: rayon::current_num_threads() as u64,
        }
    }

    /// Creates the workload of an input without Gaussians, frames and cameras.
    pub fn empty() -> Workload {
        let info = SequenceInfo { count: 0, times: Vec::new(), sh_degree: 0, varying: Attributes::empty() };
        Workload::new(&info, MemoryProfile::for_tiles(0))
    }

    /// Returns this workload with the cameras of `rig` and the views in `schedule`, which lists the views at each
    /// frame.
    pub fn with_views(self, rig: &Rig, schedule: &ViewSchedule) -> Workload {
        self.seen_by(rig, schedule.max_views_per_frame() as u64, schedule.pair_count() as u64)
    }

    fn seen_by(self, rig: &Rig, views: u64, pairs: u64) -> Workload {
        let mut numbers: Vec<u32> = rig.views.iter().map(|rig_view| rig_view.view).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let pixels = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
        Workload {
            pixels: rig.cameras.iter().map(pixels).max().unwrap_or(0),
            views,
            viewpoints: numbers.len() as u64,
            frame_views: pairs,
            rig: rig.bytes(),
            ..self
        }
    }

    /// Creates the workload of a stream of which only the header has arrived, with the cameras of `rig`. The stream
    /// will be packed into a container whose tiles hold `frame_block` frames each. `frames` is the assumed number of
    /// frames; 0: unknown.
    pub fn from_stream_header(header: &StreamHeader, frame_block: usize, rig: &Rig, frames: u64) -> Workload {
        let mut times: Vec<f64> = rig.views.iter().filter_map(|rig_view| rig_view.time).collect();
        times.sort_by(f64::total_cmp);
        let together = times.chunk_by(|a, b| a == b).map(<[f64]>::len).max().unwrap_or(0);
        let timeless = rig.views.len() - times.len();
        let views = (together + timeless) as u64;
        let pairs = if frames > 0 { timeless as u64 * frames + times.len() as u64 } else { 0 };
        let StreamHeader { count, sh_degree, varying, .. } = *header;
        let info = SequenceInfo { count, times: Vec::new(), sh_degree, varying };
        let work = Workload { frames, ..Workload::new(&info, MemoryProfile::for_tiles(frame_block as u64)) };
        work.seen_by(rig, views, pairs)
    }

    /// Returns the workload of an input without Gaussians that has `frames` frames and views of `pixels` pixels.
    #[cfg(test)]
    pub(crate) fn with_frames_and_pixels(frames: u64, pixels: u64) -> Workload {
        let info = SequenceInfo { count: 0, times: Vec::new(), sh_degree: 0, varying: Attributes::POSITION };
        Workload { frames, pixels, ..Workload::new(&info, MemoryProfile::default()) }
    }

    /// Returns whether nothing changes in time: there is a single frame, or no attribute varies. A stream, whose number
    /// of frames is unknown, counts as moving.
    pub fn is_static(&self) -> bool {
        self.frames == 1 || self.varying.is_empty()
    }

    /// Returns the number of Gaussians in the largest block if the Gaussians are divided into blocks of `block` each:
    /// `block`, or the number of all Gaussians if this is smaller.
    pub fn largest_block(&self, block: u64) -> u64 {
        block.min(self.gaussians)
    }

    /// Returns the number of frames in the largest block if the frames are divided into blocks of `block` each:
    /// `block`, or the number of all frames if this is known and smaller.
    fn frames_at_most(&self, block: u64) -> u64 {
        if self.frames == 0 { block } else { block.min(self.frames) }
    }

    /// Returns the bytes that the attributes `columns` of one Gaussian take at one frame.
    pub fn state_bytes(&self, columns: Attributes) -> u64 {
        state_bytes(self.sh_degree, columns)
    }

    /// Returns the memory, in bytes per Gaussian, of the decoded frames that a reader of the attributes `columns` keeps
    /// for later reads. Attributes that do not vary in time are not counted.
    ///
    /// Let n be the smaller of [`Limits::max_kept_frames`] and the number of frames per tile (stored block) of the
    /// input. The reader keeps n + 2 frames if n is at least 2, and no frames otherwise.
    pub fn kept_frames_bytes(&self, limits: &Limits, columns: Attributes) -> u64 {
        let frames = match (limits.max_kept_frames as u64).min(self.input.frame_block) {
            0..=1 => 0,
            some => some + 2,
        };
        frames * self.state_bytes(columns & self.varying)
    }

    /// Returns the memory in which each thread reads the values of one block of Gaussians. The buffers in which readers
    /// decode tiles (stored blocks of values) are included.
    pub fn block_buffer_memory(&self) -> MemoryPart {
        let block =
            self.largest_block(GAUSSIANS_PER_BLOCK as u64) * (self.state_bytes(Attributes::all()) + self.input.reader);
        ("arriving", self.decoding() + self.threads * block)
    }

    /// Returns the bytes of the buffers in which all threads decode or encode tiles (stored blocks of values). Each
    /// thread has three buffers: for the stored, the shuffled and the decoded bytes of the largest tile.
    fn decoding(&self) -> u64 {
        let MemoryProfile { frame_block, gaussian_block, .. } = self.input;
        let gaussian_block = self.largest_block(gaussian_block);
        let frame_block = self.frames_at_most(frame_block);
        let frames = |column| if self.varying.contains(column) { frame_block } else { 1 };
        let largest =
            Attributes::all().iter().map(|column| self.state_bytes(column) * frames(column)).max().unwrap_or(0);
        if frame_block == 0 { 0 } else { self.threads * 3 * gaussian_block * largest }
    }

    /// Returns the memory of a pass over views as two lists of parts: first, parts that grow with the number of
    /// Gaussians, in bytes per Gaussian; second, parts of fixed size, in bytes. The parts are:
    /// - frames that are ready to be rendered, with their attributes `columns`;
    /// - frames being read;
    /// - views being rendered;
    /// - results of the pass, of `sums` bytes per Gaussian. They are stored once for the whole pass, and once more for
    ///   each view being rendered.
    pub fn view_pass_memory(
        &self,
        limits: &Limits,
        columns: Attributes,
        sums: u64,
    ) -> (Vec<MemoryPart>, Vec<MemoryPart>) {
        let views_together = self.threads.min(limits.views_together as u64);
        let ready = VIEWS_PER_THREAD as u64 * self.threads;
        let per_gaussian = vec![
            ("states", ready.min(limits.frames_together as u64) * self.state_bytes(columns)),
            ("readers", self.input.reader),
            ("kept frames", self.kept_frames_bytes(limits, columns)),
            ("views", views_together * (render::BYTES_PER_VISIBLE as u64 + sums) + sums),
        ];
        let buffers = views_together * (render::STRIP_BYTES as u64 + 12 * self.pixels);
        (per_gaussian, vec![self.block_buffer_memory(), ("views", buffers)])
    }

    /// Returns the memory that a list of `views` views takes: its name in the memory plan, and its bytes.
    pub fn view_list_memory(views: f64) -> MemoryPart {
        ("view list", (PER_LISTED_VIEW as f64 * views).ceil() as u64)
    }

    /// Returns the memory of the buffers for writing the compressed model, as a container or as one file per frame.
    pub fn write_buffers(&self) -> Vec<MemoryPart> {
        self.tile_write_buffers(FRAME_BLOCK)
    }

    /// Returns the memory of the buffers for writing a container whose tiles (stored blocks of values) hold `frames`
    /// frames.
    pub fn tile_write_buffers(&self, frames: usize) -> Vec<MemoryPart> {
        let varying = self.frames_at_most(frames as u64) * self.state_bytes(self.varying);
        let block = self.largest_block(GAUSSIAN_BLOCK as u64)
            * (2 * self.state_bytes(Attributes::all()) + 3 * varying + self.input.reader);
        vec![("blocks", 2 * self.threads * block), self.block_buffer_memory(), ("index", self.written_index())]
    }

    /// Returns the memory that the zstd compressors of all threads take, at the compression level `level` and for tiles
    /// (stored blocks of values) of `frames` frames.
    pub fn compressor_memory(&self, level: i32, frames: usize) -> MemoryPart {
        let widest = Attributes::all().iter().map(|column| self.state_bytes(column)).max().unwrap_or(0);
        ("zstd", self.threads * zstd_tables(level, (GAUSSIAN_BLOCK * frames) as u64 * widest))
    }

    /// Returns the maximum number of times that the whole input is read to get `frames` evenly spread frames. It is
    /// below 1 if only a part of the input is read. A tile (stored block of Gaussians × frames) is always read as a
    /// whole. It is read several times if readers may keep only some of its frames ([`Limits::max_kept_frames`]).
    pub fn whole_input_reads(&self, frames: u64, limits: &Limits) -> f64 {
        let (all, together) = (self.frames.max(1), self.input.frame_block);
        if self.frames == 0 || together == 0 {
            return frames.min(all) as f64 / all as f64;
        }
        let blocks = self.frames.div_ceil(together);
        let of_block = frames.div_ceil(blocks).min(together);
        let again = of_block.div_ceil(limits.max_kept_frames.max(1) as u64);
        (frames.min(blocks) * again) as f64 / blocks as f64
    }

    /// Returns the maximum number of times that the whole input is read to get `frames` evenly spread frames, for a
    /// stage that reads blocks of Gaussians with arbitrary ids. It is twice [`Workload::whole_input_reads`] for an
    /// input with tiles (stored blocks): a tile may contain Gaussians of two such blocks, and is then read for each of
    /// them.
    pub fn scattered_whole_input_reads(&self, frames: u64, limits: &Limits) -> f64 {
        let shared = if self.input.frame_block == 0 { 1.0 } else { 2.0 };
        shared * self.whole_input_reads(frames, limits)
    }

    /// Returns the time in seconds on one processor core for rendering `views` views of `gaussians` Gaussians. The last
    /// argument, a [`RenderCost`], gives the time of one view per Gaussian and per pixel.
    pub fn render_seconds(&self, views: f64, gaussians: f64, RenderCost { gaussian, pixel }: RenderCost) -> f64 {
        views * (gaussians * gaussian + self.pixels as f64 * pixel)
    }

    /// Returns a copy of this workload for renders of a grid of pixels with the strides `strides`, with the number of
    /// pixels of such renders.
    pub fn on_grid(&self, strides: GridStrides) -> Workload {
        let [x, y] = strides.map(|stride| u64::from(stride.get()));
        Workload { pixels: self.pixels / (x * y), ..*self }
    }

    /// Returns the time in seconds on one processor core for reading the states of `gaussians` Gaussians at `frames`
    /// frames each.
    pub fn reading_seconds(&self, gaussians: f64, frames: f64) -> f64 {
        gaussians * frames * self.input.seconds_per_state
    }

    /// Returns the number of Gaussians N as a floating-point number, for estimates of stages that process a fraction of
    /// them.
    pub fn gaussian_count(&self) -> f64 {
        self.gaussians as f64
    }

    /// Returns the bytes of memory that an open input takes besides its memory per Gaussian: index, time stamps,
    /// cameras, and [`MemoryProfile::fixed`].
    pub(super) fn known_bytes(&self) -> u64 {
        let index = match self.input.frame_block {
            0 => 0,
            frames => {
                let slots = self.input.columns * self.gaussians.div_ceil(self.input.gaussian_block);
                slots * (PER_SLOT + PER_TILE * self.frames.div_ceil(frames))
            }
        };
        index + self.input.fixed + PER_FRAME * self.frames + self.rig
    }

    /// Returns the bytes of memory that the index of a container takes while the container is written.
    fn written_index(&self) -> u64 {
        let slots = Attributes::all().iter().count() as u64 * self.gaussians.div_ceil(GAUSSIAN_BLOCK as u64);
        PER_SLOT * slots + PER_WRITTEN_FRAME * self.frames
    }
}

/// Time for rendering one view for a certain purpose, such as finding contributions: a time per Gaussian plus a time
/// per pixel.
#[derive(Debug, Clone, Copy)]
pub struct RenderCost {
    /// Time for rendering one view, per Gaussian of the scene, in seconds on one processor core.
    gaussian: f64,
    /// Time for rendering one view, per pixel of the image, in seconds on one processor core.
    pixel: f64,
}

/// Time for finding the contribution (Σ alpha · transmittance) of every Gaussian to one view. [`CONTRIBUTION_COST`],
/// [`REMOVAL_COST`] and [`RENDER_COST`] are fitted to runs on three trained models; `scripts/estimate.py` compares
/// estimated with measured times.
pub const CONTRIBUTION_COST: RenderCost = RenderCost { gaussian: 1.6e-7, pixel: 5e-9 };
/// Time for finding the removal error of every Gaussian in one view: the squared error that removing this Gaussian
/// alone would cause.
pub const REMOVAL_COST: RenderCost = RenderCost { gaussian: 3.5e-7, pixel: 1.6e-8 };
/// Time for rendering one view and comparing the render with another one.
pub const RENDER_COST: RenderCost = RenderCost { gaussian: 3.5e-7, pixel: 3.2e-8 };

/// Returns the bytes of memory that zstd takes for its tables for finding matches, at the compression level `level`,
/// for an input of `bytes` bytes. There are two tables of 4-byte entries. Each has at most 2n entries, where n is
/// `bytes` rounded up to a power of two. Together they do not exceed a maximum, which depends on the level.
fn zstd_tables(level: i32, bytes: u64) -> u64 {
    let most_mebibytes = match level {
        ..=3 => 1,
        4..=9 => 12,
        10..=15 => 64,
        _ => 80,
    };
    (16 * bytes.next_power_of_two()).min(most_mebibytes << 20)
}
