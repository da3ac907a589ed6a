//! What a run needs of memory, and how it keeps to a budget.
//!
//! Every stage states its bytes per Gaussian and its fixed bytes as sums of named parts; the largest stage counts.
//! [`Plan::fit`] begins with limits that cost no time and halves the one that frees most, until all stages fit.
//! A result never depends on the limits. Nothing grows with frames but time stamps, the cameras' pictures and a
//! byte per tile of a container, which are parts like any other.

use std::fmt::Write as _;
use std::fs;

use bytesize::ByteSize;

use super::compress::Only;
use super::input::{Input, Scene};
use super::output::OutputKind;
use super::scored::looks;
use super::summary::peak_memory_bytes;
use super::{choose, merging, rounds};
use crate::emit::container::{FRAME_BLOCK, GAUSSIAN_BLOCK};
use crate::error::{Error, Result};
use crate::ingest::container::Container;
use crate::ingest::frame_stream::StreamHeader;
use crate::machine::memory_limit;
use crate::model::{Camera, Columns, Rig, Rows};
use crate::plan::Limits;
use crate::recipe::Recipe;
use crate::score::Scores;
use crate::stream::{self, BLOCK, PICTURES_PER_THREAD};
use crate::{merge, metrics, refit, render, select, stats};

/// Memory that a run may take, and whether it is to say beforehand what it will take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Budget {
    /// Bytes; none: a quarter of what this process may take, see [`memory_limit`].
    pub bytes: Option<u64>,
    /// Print the plan on standard error before any work.
    pub explain: bool,
}

/// Resident before any Gaussian is: the program, its libraries, its threads' stacks and heaps, messages.
const PROGRAM: u64 = 14 << 20;
/// Per thread.
const PER_THREAD: u64 = 2 << 20;
/// Resident per tile of an open container: whether it has been verified.
const PER_TILE: u64 = 1;
/// Resident per column and block of Gaussians while a container is opened or written: its last constant tile.
const PER_SLOT: u64 = 80;
/// Resident per frame of a container that is written: its time stamp, when it finishes once more as bytes.
const PER_WRITTEN_FRAME: u64 = 16;

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
    /// Bytes per Gaussian that are resident while the input is open.
    pub resident: u64,
    /// Bytes per Gaussian of an open reader, beside the frames it holds.
    pub reader: u64,
    /// Frames that are decoded together, so that a reader may hold some; 0 where each is read by itself.
    pub frame_block: u64,
    /// Gaussians that are decoded together.
    pub gaussian_block: u64,
    /// Bytes of the input that are resident however many Gaussians there are.
    pub field: u64,
    /// Bytes per Gaussian of a file that is mapped while it is read whole.
    pub file: u64,
    /// Different views of the cameras.
    pub viewpoints: u64,
    /// Pixels of the largest picture.
    pub pixels: u64,
    /// Most pictures of one frame.
    pub views: u64,
    /// Pictures of all frames.
    pub pictures: u64,
    /// Pictures the cameras name one by one.
    pub shots: u64,
    /// Columns of a container.
    pub columns: u64,
    /// Threads to work on.
    pub threads: u64,
}

impl Workload {
    /// Of an open scene.
    pub fn of(scene: &Scene) -> Workload {
        Workload::of_input(&scene.input).seen_by(
            &scene.rig,
            scene.schedule.frames.iter().map(Vec::len).max().unwrap_or(0) as u64,
            scene.schedule.pairs() as u64,
        )
    }

    /// Of an open input that nobody looks at.
    pub fn of_input(input: &Input) -> Workload {
        let info = input.source().info();
        let whole = state_bytes(info.sh_degree, Columns::ALL);
        let unseen = Workload::new(info.count, info.sh_degree, info.varying);
        // Normals and the like stand beside the values.
        let unseen = Workload { frames: info.times.len() as u64, file: whole + 24, ..unseen };
        match input {
            Input::Model(model) => Workload {
                resident: whole,
                // A copy of the canonical values, what is prepared of them, and their changes.
                reader: 2 * whole + model.field().bytes_per_gaussian() as u64 + 128,
                // Tensors as they are read and as they are used.
                field: 2 * fs::metadata(&model.paths().deformation).map_or(0, |file| file.len()),
                ..unseen
            },
            Input::Frames(_) => unseen,
            Input::Container(container) => of_container(container, unseen),
            Input::Stream(streamed) => of_container(&streamed.container, unseen),
        }
    }

    /// Of Gaussians without frames, each of which is read by itself and which nobody looks at.
    fn new(count: usize, sh_degree: usize, varying: Columns) -> Workload {
        Workload {
            gaussians: count as u64,
            frames: 0,
            sh_degree,
            varying,
            resident: 0,
            reader: 4,
            frame_block: 0,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            field: 0,
            file: 0,
            viewpoints: 0,
            pixels: 0,
            views: 0,
            pictures: 0,
            shots: 0,
            columns: 0,
            threads: rayon::current_num_threads() as u64,
        }
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
            shots: rig.shots.len() as u64,
            ..self
        }
    }

    /// Of a stream of which only the header has arrived, as `rig` will see it.
    pub fn of_stream(header: &StreamHeader, frame_block: usize, rig: &Rig) -> Workload {
        let mut times: Vec<f64> = rig.shots.iter().filter_map(|shot| shot.time).collect();
        times.sort_by(f64::total_cmp);
        let together = times.chunk_by(|a, b| a == b).map(<[f64]>::len).max().unwrap_or(0);
        let views = (together + rig.shots.len() - times.len()) as u64;
        let unseen = Workload::new(header.count, header.sh_degree, header.varying);
        let columns = Columns::ALL.iter().count() as u64;
        let unseen = Workload { reader: 8, frame_block: frame_block as u64, columns, ..unseen };
        unseen.seen_by(rig, views, 0)
    }

    /// Bytes of one Gaussian's columns `of`.
    pub fn state(&self, of: Columns) -> u64 {
        state_bytes(self.sh_degree, of)
    }

    /// Bytes per Gaussian of the frames that a reader of the columns `of` holds: one frame is not worth holding, and
    /// a whole block takes two frames more.
    fn held(&self, limits: &Limits, of: Columns) -> u64 {
        let frames = match (limits.frames_held as u64).min(self.frame_block) {
            0..=1 => 0,
            some => some + 2,
        };
        frames * self.state(of & self.varying)
    }

    /// One block of each thread on its way from a reader, and what decoding it takes.
    pub fn arriving(&self) -> Part {
        ("arriving", self.decoding() + self.threads * BLOCK as u64 * (self.state(Columns::ALL) + self.reader))
    }

    /// Buffers of all threads that decode or encode tiles: stored, shuffled and decoded bytes of the largest one.
    fn decoding(&self) -> u64 {
        let frames = |column| if self.varying.contains(column) { self.frame_block } else { 1 };
        let largest = Columns::ALL.iter().map(|column| self.state(column) * frames(column)).max().unwrap_or(0);
        if self.frame_block == 0 { 0 } else { self.threads * 3 * self.gaussian_block * largest }
    }

    /// The whole input as it is known and seen, whatever its Gaussians hold.
    fn known(&self) -> u64 {
        let index = match self.frame_block {
            0 => 0,
            frames => {
                let slots = self.columns * self.gaussians.div_ceil(self.gaussian_block);
                slots * (PER_SLOT + PER_TILE * self.frames.div_ceil(frames))
            }
        };
        // Pictures are listed by frame, and while they are gone through once more.
        index + self.field + 112 * self.frames + 24 * self.pictures + 160 * self.shots
    }

    /// What a container knows while it is written.
    fn written_index(&self) -> u64 {
        let slots = Columns::ALL.iter().count() as u64 * self.gaussians.div_ceil(GAUSSIAN_BLOCK as u64);
        PER_SLOT * slots + PER_WRITTEN_FRAME * self.frames
    }
}

/// The tiles of a container decide what is decoded together.
fn of_container(container: &Container, unseen: Workload) -> Workload {
    let layout = container.reader().layout();
    Workload {
        reader: 8,
        frame_block: layout.frame_block.into(),
        gaussian_block: layout.gaussian_block.into(),
        columns: layout.columns.len() as u64,
        file: 0,
        ..unseen
    }
}

/// A named part of a stage's memory.
pub type Part = (&'static str, u64);

/// What a stage needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Need {
    /// The stage's name.
    pub stage: &'static str,
    /// Full reads of the frames, at most.
    pub reads: f64,
    /// Bytes per Gaussian.
    pub per_gaussian: Vec<Part>,
    /// Bytes, however many Gaussians there are.
    pub fixed: Vec<Part>,
}

impl Need {
    fn of_gaussian(&self) -> u64 {
        self.per_gaussian.iter().map(|&(_, bytes)| bytes).sum()
    }

    fn bytes(&self, work: &Workload) -> u64 {
        let fixed: u64 = self.fixed.iter().map(|&(_, bytes)| bytes).sum();
        work.gaussians.saturating_mul(work.resident + self.of_gaussian()).saturating_add(fixed)
    }
}

/// Every limit halved, first those that cost most time.
const HALVINGS: [fn(&Limits) -> Limits; 6] = [
    |limits| Limits { pictures_together: limits.pictures_together.div_ceil(2), ..*limits },
    |limits| Limits { sights_together: limits.sights_together / 2, ..*limits },
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
    needs: Vec<Need>,
}

impl Plan {
    /// The fastest limits by which every stage that `needs` names fits into `budget`; says so if that is asked for.
    ///
    /// # Errors
    /// A budget that no limits fit; the error names the least that works.
    pub fn fit(work: Workload, budget: Budget, needs: impl Fn(&Workload, &Limits) -> Vec<Need>) -> Result<Plan> {
        let plan = Self::closest(work, budget.limit(), needs);
        if budget.explain {
            eprint!("{}{}", budget.text(), plan.text());
        }
        if plan.excess() > 0 { Err(plan.refusal(budget)) } else { Ok(plan) }
    }

    /// The fastest plan that fits into `budget`, else the one that takes least.
    fn closest(work: Workload, budget: u64, needs: impl Fn(&Workload, &Limits) -> Vec<Need>) -> Plan {
        let mut limits = Limits {
            frames_held: FRAME_BLOCK,
            frames_together: PICTURES_PER_THREAD * work.threads as usize,
            pictures_together: work.threads as usize,
            sights_together: usize::MAX,
            gaussians_together: work.gaussians.max(GAUSSIAN_BLOCK as u64) as usize,
            pairs_together: 8 * work.gaussians.max(1) as usize,
            rows_aside: false,
        };
        // A model is read whole before anything else.
        let read = Need { stage: "read", reads: 0.0, per_gaussian: vec![("file", work.file)], fixed: Vec::new() };
        let all = |limits: &Limits| {
            let first = Some(read.clone()).filter(|_| work.resident > 0);
            first.into_iter().chain(needs(&work, limits)).collect::<Vec<Need>>()
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
                None => return plan,
            }
        }
    }

    /// Bytes resident at most.
    pub fn peak(&self) -> u64 {
        self.base() + self.needs.iter().map(|need| need.bytes(&self.work)).max().unwrap_or(0)
    }

    fn base(&self) -> u64 {
        PROGRAM + PER_THREAD * self.work.threads + self.work.known()
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
        Error::usage(format!(
            "--memory {}{origin}: expected at least {least}MiB, which the stage {largest:?} takes for {} Gaussians\n  \
             give it that, or fewer --threads; --explain shows what takes how much",
            size(self.budget),
            self.work.gaussians
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
            "  = {} program and threads + {} frames, cameras, index + the largest stage:",
            size(self.base() - work.known()),
            size(work.known())
        );
        for need in &self.needs {
            let parts = |parts: &[Part], unit: fn(u64) -> String| -> String {
                let some = parts.iter().filter(|&&(_, bytes)| bytes > 0);
                some.map(|&(name, bytes)| format!("{} {name}", unit(bytes))).collect::<Vec<_>>().join(" + ")
            };
            let input = [("input", work.resident)];
            let per_gaussian = [&input[..], &need.per_gaussian].concat();
            let _ = writeln!(
                out,
                "  {:<8} {:>11} = N x {} ({}) + {}",
                need.stage,
                size(need.bytes(work)),
                work.resident + need.of_gaussian(),
                parts(&per_gaussian, |bytes| bytes.to_string()),
                parts(&need.fixed, size)
            );
        }
        let _ = writeln!(
            out,
            "  at a time: {} frames held by readers, {} frames ready, {} pictures, {} pairs measured",
            limits.frames_held.min(work.frame_block as usize),
            limits.frames_together,
            limits.pictures_together,
            limits.pairs_together
        );
        let reads = self.needs.iter().filter(|need| need.reads > 0.0);
        let named: Vec<String> = reads.map(|need| format!("{:.2} {}", need.reads, need.stage)).collect();
        let sum: f64 = self.needs.iter().map(|need| need.reads).sum();
        let _ = writeln!(out, "full reads of the frames: at most {sum:.2} ({})", named.join(" + "));
        out
    }
}

impl Budget {
    /// Bytes that the run may take.
    fn limit(self) -> u64 {
        self.bytes.unwrap_or_else(|| Budget::by_default().0)
    }

    /// Bytes that a run takes unless told otherwise, and where that number comes from.
    fn by_default() -> (u64, String) {
        let (bytes, origin) = memory_limit();
        (bytes / 4, format!("a quarter of {}, {origin}", size(bytes)))
    }

    /// The budget for a person.
    fn text(self) -> String {
        match self.bytes {
            Some(bytes) => format!("budget: {}, as asked for\n", size(bytes)),
            None => {
                let (bytes, origin) = Budget::by_default();
                format!("budget: {}, {origin}\n", size(bytes))
            }
        }
    }
}

/// What this process has taken so far, for a person; none where the system does not say.
pub fn taken() -> Option<String> {
    peak_memory_bytes().map(|bytes| format!("memory: at most {} taken", size(bytes)))
}

/// Plans what is to be done with `scene` and gives it its limits.
pub fn keep_to(budget: Budget, scene: &mut Scene, needs: impl Fn(&Workload, &Limits) -> Vec<Need>) -> Result<()> {
    scene.limits = Plan::fit(Workload::of(scene), budget, needs)?.limits;
    Ok(())
}

fn size(bytes: u64) -> String {
    ByteSize(bytes).display().iec().to_string()
}

fn state_bytes(sh_degree: usize, columns: Columns) -> u64 {
    columns.iter().map(|column| 4 * column.width(sh_degree) as u64).sum()
}

/// Statistics.
const ROWS: u64 = Rows::BYTES_PER_GAUSSIAN as u64;
/// A selection, as it stays until the end.
const SELECTED: u64 = select::BYTES_PER_GAUSSIAN as u64;
/// Statistics, scores and a selection: while scores are looked at.
pub const SCORED: u64 = ROWS + Scores::BYTES_PER_GAUSSIAN as u64 + SELECTED;

/// Per Gaussian what is known of clusters, twice while alternatives are compared, and what reading members takes.
const CLUSTERED: u64 = 125;

/// Per Gaussian of a picture that is made on all threads: their shares, and these in a row.
const PICTURE_ON_ALL_THREADS: u64 = 2 * render::BYTES_PER_VISIBLE as u64;

/// What stays of scoring: the selection, and the statistics unless they are set aside.
fn scored(limits: &Limits) -> Vec<Part> {
    vec![("rows", if limits.rows_aside { 0 } else { ROWS }), ("selection", SELECTED)]
}

/// Stages that look at pictures: states that lie ready, what is on its way to them, and
/// pictures in the making with `sums` bytes per Gaussian.
fn looking(work: &Workload, limits: &Limits, columns: Columns, sums: u64) -> (Vec<Part>, Vec<Part>) {
    let pictures = work.threads.min(limits.pictures_together as u64);
    let ready = PICTURES_PER_THREAD as u64 * work.threads;
    let per_gaussian = vec![
        ("states", ready.min(limits.frames_together as u64) * work.state(columns)),
        ("readers", work.reader),
        ("held", work.held(limits, columns)),
        ("pictures", pictures * (render::BYTES_PER_VISIBLE as u64 + sums) + sums),
    ];
    let fixed = vec![work.arriving(), ("pictures", pictures * (render::STRIP_BYTES as u64 + 12 * work.pixels))];
    (per_gaussian, fixed)
}

/// What scoring takes: the scan, the look at pictures that `recipe` asks for, the scores.
pub fn scoring(work: &Workload, limits: &Limits, recipe: &Recipe, has_cameras: bool) -> Vec<Need> {
    let block = stats::BYTES_PER_GAUSSIAN as u64 + work.held(&Limits::NONE, Columns::ALL);
    let mut needs = vec![Need {
        stage: "scan",
        reads: 1.0,
        // Block by block, then joined.
        per_gaussian: vec![("rows", 2 * ROWS)],
        fixed: vec![("blocks", work.threads * BLOCK as u64 * block), work.arriving()],
    }];
    if looks(has_cameras, recipe.scan.coverage) {
        let (mut per_gaussian, fixed) = looking(work, limits, Columns::ALL.without(Columns::SH), 12);
        per_gaussian.insert(0, ("rows", ROWS + 16));
        let reads = 1.0 / f64::from(recipe.scan.frame_stride.get());
        needs.push(Need { stage: "visible", reads, per_gaussian, fixed });
    }
    needs.push(Need {
        stage: "score",
        reads: 0.0,
        per_gaussian: vec![
            ("rows", SCORED),
            ("sorting", select::WORKING_BYTES_PER_GAUSSIAN as u64),
            ("states", work.state(Columns::POSITION | Columns::LOG_SCALE)),
        ],
        fixed: vec![work.arriving()],
    });
    needs
}

/// What compressing takes: [`scoring`], and the stages that `recipe` and `only` ask for.
pub fn compressing(
    work: &Workload,
    limits: &Limits,
    recipe: &Recipe,
    only: Only,
    kind: OutputKind,
    has_cameras: bool,
) -> Vec<Need> {
    let mut needs = scoring(work, limits, recipe, has_cameras);
    let looks = looks(has_cameras, recipe.scan.coverage);
    let whole = work.state(Columns::ALL);
    let sampled = |pictures: usize| (pictures as u64).min(work.pictures) as f64 / work.frames.max(1) as f64;
    if looks && only != Only::Merge && recipe.select.round_fraction < 1.0 {
        let (looking, fixed) = looking(work, limits, Columns::ALL, 8);
        let per_gaussian = [scored(limits), vec![("ranking", 32)], looking].concat();
        // Each round reads what the round before left.
        let rounds = 1.0 / (1.0 - recipe.select.round_fraction);
        needs.push(Need { stage: "rounds", reads: rounds * sampled(rounds::PICTURES), per_gaussian, fixed });
    }
    if only != Only::Prune && !recipe.merge.passes.is_empty() {
        let pairs = merge::BYTES_PER_PAIR + stream::motion::BYTES_PER_PAIR;
        // Of the colours the first band.
        let states = state_bytes(0, Columns::ALL);
        let mut per_gaussian = scored(limits);
        // C and Vis are read back.
        per_gaussian.push(("importance", if limits.rows_aside { 16 } else { 0 }));
        needs.push(Need {
            stage: "merge",
            reads: 1.0,
            per_gaussian: [
                per_gaussian,
                vec![
                    ("pool", merging::BYTES_PER_SURVIVOR as u64),
                    // At most one for every two, before a pass and after it; then with all colours.
                    ("proxies", states.max(whole.div_ceil(2))),
                    ("survivors", merge::BYTES_PER_SURVIVOR as u64),
                    ("passing", (recipe.merge.max_neighbors * merge::BYTES_PER_PASSING) as u64),
                    ("readers", work.reader),
                    ("followed", stream::motion::bytes_per_gaussian(limits.frames_held) as u64),
                ],
            ]
            .concat(),
            fixed: vec![("pairs", (limits.pairs_together as u64).saturating_mul(pairs as u64)), work.arriving()],
        });
    }
    // A model with a field is moved as a whole: its canonical values once more.
    let result = if work.resident > 0 { 2 * whole } else { 0 };
    if looks && only != Only::Merge && recipe.select.choose_by_views {
        needs.push(Need {
            stage: "choose",
            reads: 2.0 * sampled(choose::PICTURES),
            per_gaussian: [
                scored(limits),
                vec![
                    ("alternatives", 24),
                    ("clusters", CLUSTERED),
                    ("states", 2 * whole),
                    ("result", result),
                    ("pictures", PICTURE_ON_ALL_THREADS),
                ],
            ]
            .concat(),
            fixed: vec![
                work.arriving(),
                ("pictures", render::STRIP_BYTES as u64 + 12 * work.pixels * (1 + choose::AT_ONCE as u64)),
            ],
        });
    }
    let fitted = match work.frames {
        // Of a stream nobody knows how many pictures there will be.
        0 => u64::from(recipe.refit.refit_pictures).min(1 << 16),
        _ => u64::from(recipe.refit.refit_pictures).min(work.pictures),
    };
    if looks && fitted > 0 {
        let tests = fitted.div_ceil(3);
        needs.push(Need {
            stage: "refit",
            reads: sampled((fitted + 2 * tests) as usize),
            per_gaussian: [
                scored(limits),
                vec![
                    ("kept", 24),
                    ("states", 2 * whole),
                    ("result", result),
                    ("equations", refit::BYTES_PER_GAUSSIAN as u64),
                    ("sights", fitted.min(limits.sights_together as u64) * render::BYTES_PER_VISIBLE as u64),
                    // Made at a time, with what they pull at: twice three f64.
                    ("pictures", work.threads * (render::BYTES_PER_VISIBLE as u64 + 48)),
                ],
            ]
            .concat(),
            fixed: vec![
                work.arriving(),
                ("pictures", (tests + work.views + 1) * 12 * work.pixels),
                ("pairs", (fitted.min(limits.sights_together as u64) + work.threads) * render::STRIP_BYTES as u64 / 3),
            ],
        });
    }
    needs.push(emitting(work, limits, kind, only != Only::Prune && !recipe.merge.passes.is_empty()));
    needs
}

/// What writing a result of `kind` takes, of explicit trajectories perhaps with proxies.
fn emitting(work: &Workload, limits: &Limits, kind: OutputKind, merges: bool) -> Need {
    let whole = work.state(Columns::ALL);
    let is_model = work.resident > 0;
    let mut need = Need {
        stage: "emit",
        reads: if is_model { 0.0 } else { 1.0 },
        per_gaussian: [scored(limits), vec![("kept", 40), ("result", if is_model { 2 * whole } else { 0 })]].concat(),
        fixed: writing(work),
    };
    match kind {
        OutputKind::Gseq if merges && !is_model => {
            // Of each that is merged and of each that comes of it the frames of a block, and a state.
            let mixed = Columns::ALL.without(Columns::SH) | work.varying;
            let waiting = work.held(&Limits::NONE, Columns::ALL) + FRAME_BLOCK as u64 * work.state(mixed);
            let together = (limits.gaussians_together as u64).min(work.gaussians);
            need.per_gaussian.push(("members", CLUSTERED));
            need.fixed.push(("merged", together * (waiting + 2 * whole + work.reader + 24)));
        }
        OutputKind::Gseq => (),
        // A file's rows and the proxies among them for each thread, or one state and what it is made of.
        _ => {
            need.per_gaussian.push(("files", work.threads * (work.file + 2 * whole)));
            need.per_gaussian.push(("members", CLUSTERED));
        }
    }
    need
}

/// Buffers of a container, or of a frame's file, in the making.
fn writing(work: &Workload) -> Vec<Part> {
    let block = GAUSSIAN_BLOCK as u64
        * (2 * work.state(Columns::ALL) + 3 * FRAME_BLOCK as u64 * work.state(work.varying) + work.reader);
    vec![("blocks", 2 * work.threads * block), work.arriving(), ("index", work.written_index())]
}

/// What it takes to pack a stream of which `held` frames are in memory together, and to scan it on the way unless
/// `measuring` is none; if it says so, to look at pictures too.
pub fn receiving(work: &Workload, limits: &Limits, held: u64, measuring: Option<bool>) -> Need {
    let whole = work.state(Columns::ALL);
    let mut per_gaussian =
        vec![("frames", held * work.state(work.varying)), ("constant columns", whole - work.state(work.varying))];
    let mut fixed = writing(work);
    if let Some(visible) = measuring {
        per_gaussian.push(("accumulators", stats::BYTES_PER_GAUSSIAN as u64));
        fixed.push(("blocks", work.threads * BLOCK as u64 * whole));
        if visible {
            let nothing_held = Workload { frame_block: 0, ..*work };
            let (more, pictures) = looking(&nothing_held, limits, Columns::ALL.without(Columns::SH), 12);
            per_gaussian.extend(more);
            fixed.extend(pictures);
        }
    }
    Need { stage: "receive", reads: 0.0, per_gaussian, fixed }
}

/// What it takes to write every frame as a container.
pub fn packing(work: &Workload, _: &Limits) -> Vec<Need> {
    vec![Need { stage: "pack", reads: 1.0, per_gaussian: Vec::new(), fixed: writing(work) }]
}

/// What it takes to write every frame by itself.
pub fn unpacking(work: &Workload, limits: &Limits) -> Vec<Need> {
    let per_gaussian =
        vec![("states", work.state(Columns::ALL)), ("readers", work.reader), ("held", work.held(limits, Columns::ALL))];
    vec![Need { stage: "unpack", reads: 1.0, per_gaussian, fixed: vec![work.arriving()] }]
}

/// What it takes to make pictures of a model.
pub fn picturing(work: &Workload, limits: &Limits) -> Vec<Need> {
    vec![of_pictures(work, limits, "render", 1, 12)]
}

/// What it takes to make pictures of two models, each of as many Gaussians at most, and to compare them.
pub fn picturing_both(work: &Workload, limits: &Limits) -> Vec<Need> {
    // Both models' and the photograph, and what they are compared with.
    let mut need = of_pictures(work, limits, "evaluate", 2, 3 * 12 + metrics::BYTES_PER_PIXEL as u64);
    need.per_gaussian.push(("other model", work.resident));
    need.fixed.push(("pictures before", 3 * 12 * work.viewpoints * work.pixels));
    vec![need]
}

/// Pictures of `models` models, each picture with `pixel` bytes per pixel.
fn of_pictures(work: &Workload, limits: &Limits, stage: &'static str, models: u64, pixel: u64) -> Need {
    let pictures = work.threads.min(limits.pictures_together as u64);
    Need {
        stage,
        reads: models as f64,
        per_gaussian: vec![
            ("states", models * work.state(Columns::ALL)),
            ("pictures", pictures * PICTURE_ON_ALL_THREADS),
        ],
        fixed: vec![work.arriving(), ("pictures", pictures * (render::STRIP_BYTES as u64 + pixel * work.pixels))],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn work(gaussians: u64) -> Workload {
        Workload {
            gaussians,
            frames: 600,
            sh_degree: 3,
            varying: Columns::ALL.without(Columns::SH),
            resident: 0,
            reader: 8,
            frame_block: FRAME_BLOCK as u64,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            field: 0,
            file: 0,
            pixels: 320 * 240,
            views: 2,
            viewpoints: 2,
            pictures: 1200,
            shots: 2,
            columns: 5,
            threads: 2,
        }
    }

    fn budget(bytes: u64) -> Budget {
        Budget { bytes: Some(bytes), explain: false }
    }

    /// Everything compressing does under `preset`, colours fitted too.
    fn everything(preset: &str) -> impl Fn(&Workload, &Limits) -> Vec<Need> {
        let mut recipe = Recipe::preset(preset).unwrap();
        recipe.refit.refit_pictures = 36;
        move |work, limits| compressing(work, limits, &recipe, Only::Both, OutputKind::Gseq, true)
    }

    #[test]
    fn every_plan_keeps_to_its_budget_down_to_the_least_and_no_further() {
        for preset in ["default", "strong"] {
            let least = Plan::closest(work(200_000), 1, everything(preset)).peak();
            let mut before = 0;
            for bytes in [least, least + (8 << 20), 2 * least, 4 * least, 64 * least] {
                let plan = Plan::fit(work(200_000), budget(bytes), everything(preset)).unwrap();
                assert!((before..=bytes).contains(&plan.peak()), "{bytes}: {}", plan.text());
                before = plan.peak();
            }
            let message = Plan::fit(work(200_000), budget(least - 1), everything(preset)).unwrap_err().to_string();
            assert!(message.contains(&format!("at least {}MiB", least.div_ceil(1 << 20))), "{message}");
        }
    }

    #[test]
    fn ten_times_the_gaussians_take_ten_times_the_stated_bytes_and_ten_times_the_frames_next_to_nothing() {
        let peak = |work: Workload| Plan::closest(work, 1, everything("default"));
        let (few, many) = (peak(work(100_000)), peak(work(1_000_000)));
        let most = many.needs.iter().max_by_key(|need| need.bytes(&many.work)).unwrap();
        assert_eq!(many.peak() - many.base() - (few.peak() - few.base()), 900_000 * most.of_gaussian());
        let longer = peak(Workload { frames: 6000, ..work(100_000) });
        assert!(longer.peak() as f64 / few.peak() as f64 <= 1.05, "{} {}", longer.text(), few.text());
    }

    #[test]
    fn what_a_recipe_does_not_do_takes_nothing() {
        let mut recipe = Recipe::preset("paper").unwrap();
        recipe.merge.passes.clear();
        let needs = compressing(&work(1000), &Limits::NONE, &recipe, Only::Both, OutputKind::Gseq, true);
        assert_eq!(needs.iter().map(|need| need.stage).collect::<Vec<_>>(), ["scan", "score", "emit"]);
    }
}
