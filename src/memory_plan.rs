//! What a run needs of memory and about how long it takes, and how it keeps to a budget. Names no stage: each states its
//! own [`ResourceEstimate`].
//!
//! A need is a number of bytes per Gaussian and a fixed one, both as sums of named parts; the largest stage counts.
//! [`Plan::fit`] begins with limits that cost no time and halves the one that frees most, until all stages fit.
//! A result never depends on the limits. Nothing grows with frames but time stamps, lists of pictures, how many Gaussians
//! live in each, and a byte per tile of a container, which are parts like any other.

use std::fmt::Write as _;

use bytesize::ByteSize;

use crate::error::{Error, Result};
use crate::files::frame_stream::StreamHeader;
use crate::limits::{Limits, ReadLimit};
use crate::machine::{memory_limit, peak_memory_bytes};
use crate::model::{Camera, Columns, Rig, Schedule, SequenceInfo};
use crate::models::MemoryProfile;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::passes::{BLOCK, VIEWS_PER_THREAD};
use crate::progress::{Events, Message, duration};
use crate::render;

/// What a run says of itself before it begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Verbosity {
    /// Nothing.
    #[default]
    Nothing,
    /// About how long it will take, and how much memory at most.
    Time,
    /// What takes how much memory, how often frames are read, and about how long it will take.
    Plan,
}

/// Memory that a run may take, and whether it is to say beforehand what it will take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Budget {
    /// Bytes; none: a quarter of what this process may take, see [`memory_limit`].
    pub bytes: Option<u64>,
    /// What to print on standard error before any work.
    pub tell: Verbosity,
}

/// Resident before any Gaussian is: the program (12.5 MiB of it where it is not optimized), its libraries (3.6), its threads'
/// stacks and heaps, messages.
const PROGRAM: u64 = 18 << 20;
/// Tiles of a container are held if they take at most one part in so many of the budget: the file system's cache holds
/// what is stored anyway, and a larger part would leave less to others without saving more than decoding.
const HELD_PART: u64 = 16;
/// Per thread.
const PER_THREAD: u64 = 2 << 20;
/// Resident per tile of an open container: whether it has been verified.
const PER_TILE: u64 = 1;
/// Resident per column and block of Gaussians while a container is opened or written: its last constant tile.
const PER_SLOT: u64 = 80;
/// Resident per frame of a container that is written: its time stamp, in a list that grows by being copied to twice its length.
const PER_WRITTEN_FRAME: u64 = 16;
/// Resident per frame of an open input: its time stamp, as a container has it and as everybody does, and how many Gaussians
/// live in it.
const PER_FRAME: u64 = 8 + 8 + 8;
/// Resident per picture in a list of those to be made.
const PER_PICTURE: u64 = 24;

/// What the need for memory depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Workload {
    /// N.
    pub gaussians: u64,
    /// T; of a stream 0, for nobody knows.
    pub frames: u64,
    /// Degree of the spherical harmonics.
    pub sh_degree: usize,
    /// Columns that differ between frames.
    pub varying: Columns,
    /// What the input keeps in memory.
    pub input: MemoryProfile,
    /// Different views of the cameras.
    pub viewpoints: u64,
    /// Pixels of the largest picture.
    pub pixels: u64,
    /// Most pictures of one frame.
    pub views: u64,
    /// Pictures of all frames.
    pub pictures: u64,
    /// Bytes of the cameras and of the pictures that they name one by one, see [`Rig::bytes`].
    pub rig: u64,
    /// Threads to work on.
    pub threads: u64,
    /// How fast they are.
    pub pace: Throughput,
}

impl Workload {
    /// Of an open input that nobody looks at.
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
            pictures: 0,
            rig: 0,
            threads: rayon::current_num_threads() as u64,
            pace: Throughput::UNKNOWN,
        }
    }

    /// Of no Gaussians.
    pub fn nothing() -> Workload {
        let info = SequenceInfo { count: 0, times: Vec::new(), sh_degree: 0, varying: Columns::empty() };
        Workload::new(&info, MemoryProfile::of_tiles(0))
    }

    /// The same as the cameras of `schedule`, of `rig`, see it.
    pub fn seen(self, rig: &Rig, schedule: &Schedule) -> Workload {
        self.seen_by(rig, schedule.most_views() as u64, schedule.pairs() as u64)
    }

    fn seen_by(self, rig: &Rig, views: u64, pairs: u64) -> Workload {
        let mut numbers: Vec<u32> = rig.shots.iter().map(|shot| shot.view).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let pixels = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
        Workload {
            pixels: rig.cameras.iter().map(pixels).max().unwrap_or(0),
            views,
            viewpoints: numbers.len() as u64,
            pictures: pairs,
            rig: rig.bytes(),
            ..self
        }
    }

    /// Of a stream of which only the header has arrived, as `rig` will see it once it is packed into tiles of
    /// `frame_block` frames, if there prove to be `frames` of them; 0: nobody knows.
    pub fn of_stream(header: &StreamHeader, frame_block: usize, rig: &Rig, frames: u64) -> Workload {
        let mut times: Vec<f64> = rig.shots.iter().filter_map(|shot| shot.time).collect();
        times.sort_by(f64::total_cmp);
        let together = times.chunk_by(|a, b| a == b).map(<[f64]>::len).max().unwrap_or(0);
        let timeless = rig.shots.len() - times.len();
        let views = (together + timeless) as u64;
        let pairs = if frames > 0 { timeless as u64 * frames + times.len() as u64 } else { 0 };
        let StreamHeader { count, sh_degree, varying, .. } = *header;
        let info = SequenceInfo { count, times: Vec::new(), sh_degree, varying };
        let work = Workload { frames, ..Workload::new(&info, MemoryProfile::of_tiles(frame_block as u64)) };
        work.seen_by(rig, views, pairs)
    }

    /// Gaussians of a block: there may be fewer in all.
    pub fn at_most(&self, block: u64) -> u64 {
        block.min(self.gaussians)
    }

    /// Frames of a block: there may be fewer in all, if their number is known.
    fn frames_at_most(&self, block: u64) -> u64 {
        if self.frames == 0 { block } else { block.min(self.frames) }
    }

    /// Bytes of one Gaussian's columns `of`.
    pub fn state(&self, of: Columns) -> u64 {
        state_bytes(self.sh_degree, of)
    }

    /// Bytes per Gaussian of the frames that a reader of the columns `of` holds: one frame is not worth holding, and
    /// a whole block takes two frames more.
    pub fn held(&self, limits: &Limits, of: Columns) -> u64 {
        let frames = match (limits.frames_held as u64).min(self.input.frame_block) {
            0..=1 => 0,
            some => some + 2,
        };
        frames * self.state(of & self.varying)
    }

    /// One block of each thread on its way from a reader, and what decoding it takes.
    pub fn arriving(&self) -> MemoryPart {
        let block = self.at_most(BLOCK as u64) * (self.state(Columns::all()) + self.input.reader);
        ("arriving", self.decoding() + self.threads * block)
    }

    /// Buffers of all threads that decode or encode tiles: stored, shuffled and decoded bytes of the largest one.
    fn decoding(&self) -> u64 {
        let MemoryProfile { frame_block, gaussian_block, .. } = self.input;
        let gaussian_block = self.at_most(gaussian_block);
        let frame_block = self.frames_at_most(frame_block);
        let frames = |column| if self.varying.contains(column) { frame_block } else { 1 };
        let largest = Columns::all().iter().map(|column| self.state(column) * frames(column)).max().unwrap_or(0);
        if frame_block == 0 { 0 } else { self.threads * 3 * gaussian_block * largest }
    }

    /// Looking at pictures: states of the columns `of` that lie ready, what is on its way to them, and pictures in
    /// the making with `sums` bytes per Gaussian. Per Gaussian, and however many there are.
    pub fn looking(&self, limits: &Limits, of: Columns, sums: u64) -> (Vec<MemoryPart>, Vec<MemoryPart>) {
        let pictures = self.threads.min(limits.pictures_together as u64);
        let ready = VIEWS_PER_THREAD as u64 * self.threads;
        let per_gaussian = vec![
            ("states", ready.min(limits.frames_together as u64) * self.state(of)),
            ("readers", self.input.reader),
            ("held", self.held(limits, of)),
            ("pictures", pictures * (render::BYTES_PER_VISIBLE as u64 + sums) + sums),
        ];
        let of_pictures = pictures * (render::STRIP_BYTES as u64 + 12 * self.pixels);
        (per_gaussian, vec![self.arriving(), ("pictures", of_pictures)])
    }

    /// A list of so many pictures.
    pub fn listed(pictures: f64) -> MemoryPart {
        ("list", (PER_PICTURE as f64 * pictures).ceil() as u64)
    }

    /// Buffers of a container, or of a frame's file, in the making.
    pub fn writing(&self) -> Vec<MemoryPart> {
        self.writing_together(FRAME_BLOCK)
    }

    /// Buffers of a container of `frames` frames per tile in the making.
    pub fn writing_together(&self, frames: usize) -> Vec<MemoryPart> {
        let varying = self.frames_at_most(frames as u64) * self.state(self.varying);
        let block =
            self.at_most(GAUSSIAN_BLOCK as u64) * (2 * self.state(Columns::all()) + 3 * varying + self.input.reader);
        vec![("blocks", 2 * self.threads * block), self.arriving(), ("index", self.written_index())]
    }

    /// What zstd takes at a level where tiles of `frames` frames are compressed.
    pub fn compressing(&self, level: i32, frames: usize) -> MemoryPart {
        let widest = Columns::all().iter().map(|column| self.state(column)).max().unwrap_or(0);
        ("zstd", self.threads * zstd_tables(level, (GAUSSIAN_BLOCK * frames) as u64 * widest))
    }

    /// Full reads of the input that reading `frames` frames, evenly spread, takes at most: whole tiles, again and
    /// again where readers may hold too few of their frames.
    pub fn reads(&self, frames: u64, limits: &Limits) -> f64 {
        let (all, together) = (self.frames.max(1), self.input.frame_block);
        if self.frames == 0 || together == 0 {
            return frames.min(all) as f64 / all as f64;
        }
        let blocks = self.frames.div_ceil(together);
        let of_block = frames.div_ceil(blocks).min(together);
        let again = of_block.div_ceil(limits.frames_held.max(1) as u64);
        (frames.min(blocks) * again) as f64 / blocks as f64
    }

    /// [`Workload::reads`] of Gaussians that lie anywhere, block by block: a tile at the border of two blocks is read
    /// for each.
    pub fn scattered_reads(&self, frames: u64, limits: &Limits) -> f64 {
        let shared = if self.input.frame_block == 0 { 1.0 } else { 2.0 };
        shared * self.reads(frames, limits)
    }

    /// Seconds that `pictures` pictures of `gaussians` Gaussians take to be made in some way.
    pub fn picturing(&self, pictures: f64, gaussians: f64, RenderCost { gaussian, pixel, pace }: RenderCost) -> f64 {
        pace(&self.pace) * pictures * (gaussians * gaussian + self.pixels as f64 * pixel)
    }

    /// Seconds that the states of `gaussians` Gaussians at `frames` frames take to read.
    pub fn reading(&self, gaussians: f64, frames: f64) -> f64 {
        self.pace.states * gaussians * frames * self.input.seconds_per_state
    }

    /// N, as a part of which later stages are timed.
    pub fn count(&self) -> f64 {
        self.gaussians as f64
    }

    /// The whole input as it is known and seen, whatever its Gaussians hold.
    fn known(&self) -> u64 {
        let index = match self.input.frame_block {
            0 => 0,
            frames => {
                let slots = self.input.columns * self.gaussians.div_ceil(self.input.gaussian_block);
                slots * (PER_SLOT + PER_TILE * self.frames.div_ceil(frames))
            }
        };
        index + self.input.fixed + PER_FRAME * self.frames + self.rig
    }

    /// What a container knows while it is written.
    fn written_index(&self) -> u64 {
        let slots = Columns::all().iter().count() as u64 * self.gaussians.div_ceil(GAUSSIAN_BLOCK as u64);
        PER_SLOT * slots + PER_WRITTEN_FRAME * self.frames
    }
}

/// What a scene takes on this machine, as times what the constants here name: by a calibration, else 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Throughput {
    /// Reading states, and what is done with each of them.
    pub states: f64,
    /// See [`LOOK`].
    pub look: f64,
    /// See [`REMOVE`].
    pub remove: f64,
    /// See [`RENDER`].
    pub render: f64,
    /// Processors that this process got at a time while that was measured; none: nothing was measured.
    pub processors: Option<f64>,
}

impl Throughput {
    /// Of a machine and a scene that nobody measured.
    pub const UNKNOWN: Throughput = Throughput { states: 1.0, look: 1.0, remove: 1.0, render: 1.0, processors: None };
}

/// A way of making pictures.
#[derive(Debug, Clone, Copy)]
pub struct RenderCost {
    /// Seconds of one processor for each Gaussian.
    gaussian: f64,
    /// And for each pixel.
    pixel: f64,
    pace: fn(&Throughput) -> f64,
}

/// Looking at a picture, fitted to runs on three trained models (`scripts/estimate.py` shows how well such times tell
/// that of a run).
pub const LOOK: RenderCost = RenderCost { gaussian: 1.6e-7, pixel: 5e-9, pace: |pace| pace.look };
/// Finding what a picture loses without each of its Gaussians.
pub const REMOVE: RenderCost = RenderCost { gaussian: 3.5e-7, pixel: 1.6e-8, pace: |pace| pace.remove };
/// Rendering a picture and comparing it.
pub const RENDER: RenderCost = RenderCost { gaussian: 3.5e-7, pixel: 3.2e-8, pace: |pace| pace.render };

/// Per Gaussian of a picture that is made on all threads: their shares, and these in a row.
pub const PICTURE_ON_ALL_THREADS: u64 = 2 * render::BYTES_PER_VISIBLE as u64;

/// A named part of a stage's memory.
pub type MemoryPart = (&'static str, u64);

/// `bytes` per Gaussian of what is left, of which there are a part `left` of all, per Gaussian of the input.
pub fn of_left(left: f64, bytes: u64) -> u64 {
    (left * bytes as f64).ceil() as u64
}

/// What a stage needs.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceEstimate {
    /// The stage's name.
    pub stage: &'static str,
    /// Full reads of the frames, at most.
    pub reads: f64,
    /// Seconds of one processor, about: what is done so many times, by what doing it once took where it was timed.
    pub seconds: f64,
    /// Bytes per Gaussian.
    pub per_gaussian: Vec<MemoryPart>,
    /// Bytes, however many Gaussians there are.
    pub fixed: Vec<MemoryPart>,
}

impl ResourceEstimate {
    fn of_gaussian(&self) -> u64 {
        self.per_gaussian.iter().map(|&(_, bytes)| bytes).sum()
    }

    /// Bytes that the stage takes for such an input.
    pub(crate) fn bytes(&self, work: &Workload) -> u64 {
        let fixed: u64 = self.fixed.iter().map(|&(_, bytes)| bytes).sum();
        work.gaussians.saturating_mul(work.input.per_gaussian + self.of_gaussian()).saturating_add(fixed)
    }
}

/// Every limit halved, first those that cost most time.
const HALVINGS: [fn(&Limits) -> Limits; 5] = [
    |limits| Limits { pictures_together: limits.pictures_together.div_ceil(2), ..*limits },
    |limits| Limits { pairs_together: limits.pairs_together.div_ceil(2), ..*limits },
    |limits| Limits { gaussians_together: (limits.gaussians_together / 2).max(GAUSSIAN_BLOCK), ..*limits },
    |limits| Limits { frames_together: limits.frames_together.div_ceil(2), ..*limits },
    |limits| Limits { frames_held: limits.frames_held.div_ceil(2), ..*limits },
];

/// How a run keeps to its budget.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    work: Workload,
    budget: u64,
    /// What stages keep at a time.
    pub limits: Limits,
    needs: Vec<ResourceEstimate>,
}

impl Plan {
    /// The fastest limits by which every stage that `needs` names fits into `budget`. Sends the plan to `events` if the
    /// budget asks for it, whether it fits or not.
    ///
    /// # Errors
    /// A budget that no limits fit; the error names the least that works.
    pub fn fit(
        work: Workload,
        budget: Budget,
        events: &Events,
        needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<Plan> {
        let plan = Self::closest(work, budget.limit(), needs);
        let fits = plan.excess() == 0;
        if budget.tell == Verbosity::Plan {
            events.send(Message::Plan(format!("budget: {}\n{}", budget.named(), plan.text()).trim_end()));
        }
        if fits { Ok(plan) } else { Err(plan.refusal(budget)) }
    }

    /// Whether there are limits by which every stage that `needs` names fits into `budget`.
    pub fn fits(work: Workload, budget: Budget, needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>) -> bool {
        Self::closest(work, budget.limit(), needs).excess() == 0
    }

    /// The fastest plan that fits into `budget`, else the one that takes least.
    pub(crate) fn closest(
        work: Workload,
        budget: u64,
        needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Plan {
        let mut limits = Limits {
            frames_held: FRAME_BLOCK,
            frames_together: VIEWS_PER_THREAD * work.threads as usize,
            pictures_together: work.threads as usize,
            gaussians_together: work.gaussians.max(GAUSSIAN_BLOCK as u64) as usize,
            pairs_together: 8 * work.gaussians.max(1) as usize,
            rows_aside: false,
            tiles_held: false,
        };
        // A model is read whole before anything else.
        let opening = vec![("file", work.input.opening)];
        let read =
            ResourceEstimate { stage: "read", reads: 0.0, seconds: 0.0, per_gaussian: opening, fixed: Vec::new() };
        let all = |limits: &Limits| {
            let first = Some(read.clone()).filter(|_| work.input.opening > 0);
            first.into_iter().chain(needs(&work, limits)).collect::<Vec<ResourceEstimate>>()
        };
        // Costs next to no time.
        let [excess, less] = [false, true].map(|rows_aside| {
            let limits = Limits { rows_aside, ..limits };
            Plan { work, budget, limits, needs: all(&limits) }.excess()
        });
        limits.rows_aside = less < excess;
        loop {
            let plan = Plan { work, budget, limits, needs: all(&limits) };
            let excess = plan.excess();
            let saved = |other: &Limits| excess - Plan { limits: *other, needs: all(other), ..plan.clone() }.excess();
            let halved = HALVINGS.iter().filter_map(|halve| {
                let smaller = std::iter::successors(Some(limits), |limits| Some(halve(limits)));
                smaller.take(usize::BITS as usize).find(|other| saved(other) > 0)
            });
            // Of equals the last one: what is cheapest to do without.
            match halved.max_by_key(saved) {
                Some(other) => limits = other,
                None => return plan.with_held_tiles(),
            }
        }
    }

    /// The same plan, all tiles of the container held besides if that takes a small part of the budget: then nothing is
    /// read twice.
    fn with_held_tiles(mut self) -> Plan {
        let decoded = self.work.input.decoded;
        let fits = self.excess() == 0 && self.peak().saturating_add(decoded) <= self.budget;
        self.limits.tiles_held = decoded > 0 && fits && decoded <= self.budget / HELD_PART;
        self
    }

    /// Full reads of the input at most, all stages together.
    pub fn reads(&self) -> f64 {
        let sum: f64 = self.needs.iter().map(|need| need.reads).sum();
        if self.limits.tiles_held { sum.min(1.0) } else { sum }
    }

    /// Bytes resident at most.
    pub fn peak(&self) -> u64 {
        self.base() + self.needs.iter().map(|need| need.bytes(&self.work)).max().unwrap_or(0)
    }

    fn base(&self) -> u64 {
        let held = if self.limits.tiles_held { self.work.input.decoded } else { 0 };
        PROGRAM + PER_THREAD * self.work.threads + self.work.known() + held
    }

    /// Bytes by which stages pass the budget, all together.
    fn excess(&self) -> u64 {
        let room = self.budget.saturating_sub(self.base());
        let beyond = self.needs.iter().map(|need| need.bytes(&self.work).saturating_sub(room));
        beyond.sum::<u64>() + self.base().saturating_sub(self.budget)
    }

    fn refusal(&self, budget: Budget) -> Error {
        let largest = self.needs.iter().max_by_key(|need| need.bytes(&self.work)).map_or("", |need| need.stage);
        // Rounded up to what a person would write.
        let least = self.peak().div_ceil(1 << 20);
        let origin = if budget.bytes.is_none() { format!(" ({})", Budget::by_default().1) } else { String::new() };
        Error::MemoryLimit(format!(
            "--memory {}{origin}: expected at least {least}MiB, which the stage \"{largest}\" takes for {} Gaussians{}\n  \
             give it that, or fewer --threads; --explain shows what takes how much",
            size(self.budget),
            self.work.gaussians,
            if self.work.frames > 0 { format!(" x {} frames", self.work.frames) } else { String::new() }
        ))
    }

    /// The plan for a person: stages with their parts, limits, reads.
    pub fn text(&self) -> String {
        let Plan { work, limits, .. } = self;
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "memory: at most {} of {} for {} Gaussians x {} frames of {} pictures, {} threads",
            size(self.peak()),
            size(self.budget),
            work.gaussians,
            work.frames,
            work.pictures,
            work.threads
        );
        let _ = writeln!(
            out,
            "  = {} program and threads + {} frames, cameras, index + {} tiles held + the largest stage:",
            size(PROGRAM + PER_THREAD * work.threads),
            size(work.known()),
            size(self.base() - PROGRAM - PER_THREAD * work.threads - work.known())
        );
        for need in &self.needs {
            let parts = |parts: &[MemoryPart], unit: fn(u64) -> String| -> String {
                let some = parts.iter().filter(|&&(_, bytes)| bytes > 0);
                some.map(|&(name, bytes)| format!("{} {name}", unit(bytes))).collect::<Vec<_>>().join(" + ")
            };
            let input = [("input", work.input.per_gaussian)];
            let per_gaussian = [&input[..], &need.per_gaussian].concat();
            let _ = writeln!(
                out,
                "  {:<8} {:>11} = N x {} ({}) + {}",
                need.stage,
                size(need.bytes(work)),
                work.input.per_gaussian + need.of_gaussian(),
                parts(&per_gaussian, |bytes| bytes.to_string()),
                parts(&need.fixed, size)
            );
        }
        let _ = writeln!(
            out,
            "  at a time: {} frames held by readers, {} frames ready, {} pictures, {} pairs measured",
            limits.frames_held.min(work.input.frame_block as usize),
            limits.frames_together,
            limits.pictures_together,
            limits.pairs_together
        );
        let reads = self.needs.iter().filter(|need| need.reads > 0.0);
        let named: Vec<String> = reads.map(|need| format!("{:.2} {}", need.reads, need.stage)).collect();
        let held = if limits.tiles_held { "every tile stays in memory once it is decoded; else " } else { "" };
        let named = named.join(" + ");
        let _ = writeln!(out, "full reads of the input: at most {:.2} ({held}{named})", self.reads());
        out
    }

    /// Sends to `events` how long it will take, by what was measured elsewhere, if `tell` asks for the plan.
    pub fn tell_time(&self, tell: Verbosity, events: &Events) {
        if tell == Verbosity::Plan {
            let stages = seconds(&self.work, &self.needs);
            let whole: f64 = stages.iter().map(|(_, seconds)| seconds).sum();
            let named = stages.iter().map(|(stage, seconds)| format!("{} {stage}", duration(*seconds)));
            let text = format!("time: about {} ({})", duration(whole), named.collect::<Vec<_>>().join(" + "));
            events.send(Message::Plan(&text));
        }
    }
}

impl Budget {
    /// Bytes that the run may take.
    pub fn limit(self) -> u64 {
        self.bytes.unwrap_or_else(|| Budget::by_default().0)
    }

    /// Memory that opening an input may take: what the program itself leaves of the budget, and at least 4 MiB, so that
    /// small inputs open and the memory plan says what a run needs.
    pub fn read_limit(self) -> ReadLimit {
        let program = PROGRAM + PER_THREAD * rayon::current_num_threads() as u64;
        ReadLimit::new(self.limit().saturating_sub(program).max(4 << 20))
    }

    /// Bytes that a run takes unless told otherwise, and where that number comes from.
    fn by_default() -> (u64, String) {
        let (bytes, origin) = memory_limit();
        (bytes / 4, format!("a quarter of {}, {origin}", size(bytes)))
    }

    /// The budget for a person.
    pub fn named(self) -> String {
        match self.bytes {
            Some(bytes) => format!("{}, as asked for", size(bytes)),
            None => {
                let (bytes, origin) = Budget::by_default();
                format!("{}, {origin}", size(bytes))
            }
        }
    }
}

/// Names of stages and the seconds that each takes on all threads, about.
pub fn seconds(work: &Workload, needs: &[ResourceEstimate]) -> Vec<(&'static str, f64)> {
    needs.iter().map(|need| (need.stage, need.seconds / work.threads as f64)).collect()
}

/// What this process has taken so far, for a person; none where the system does not say.
pub fn taken() -> Option<String> {
    peak_memory_bytes().map(|bytes| format!("memory: at most {} taken", size(bytes)))
}

/// Bytes of the tables by which zstd, at a level, finds matches in `bytes` bytes: at most those of each level's group, and
/// 4 for each entry of two tables that have no more than twice as many entries as there are bytes.
fn zstd_tables(level: i32, bytes: u64) -> u64 {
    let most_mebibytes = match level {
        ..=3 => 1,
        4..=9 => 12,
        10..=15 => 64,
        _ => 80,
    };
    (16 * bytes.next_power_of_two()).min(most_mebibytes << 20)
}

/// Bytes for a person.
pub fn size(bytes: u64) -> String {
    ByteSize(bytes).display().iec().to_string()
}
