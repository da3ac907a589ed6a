//! Stage `refine`: moving what is stored of the survivors until their pictures come closest to the original's.
//!
//! Pruning leaves holes that only what is left can fill: footprints must grow over them. So the stored values of the
//! survivors descend the gradient of the squared error of one picture after another, of the cameras that the scene is
//! scored by and of cameras in between, so that what comes out fits no view more than others. A strong reduction goes
//! there in cuts with steps between them, each ranked anew. A part of the pictures is kept apart; of the states on the
//! last way down the one that those like best stays, its start included. A field stays as it is.
//!
//! Memory: what [`Descent`] and one differentiated picture take, three states, and the best change so far. The
//! original's pictures and the states that they show wait in scratch files.

mod local;
mod loss;
pub mod optimizer;
pub(crate) mod optimizer_state;
pub(crate) mod prune_steps;
pub(crate) mod targets;

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::journal::Journal;
use crate::cache::CacheKey;
use crate::compressed_model::{CompressedModel, ParamDelta, TrajectoryDelta};
use crate::error::Result;
use crate::journal::records::RefinedSummary;
use crate::limits::Limits;
use crate::memory_plan::{MemoryPart, PICTURE_ON_ALL_THREADS, REMOVE, RENDER, ResourceEstimate, Workload, of_left};
use crate::metrics::decibels_text;
use crate::model::{ALL_HARMONICS, Columns};
use crate::progress::Progress;
use crate::pruning::score::{Scored, scored_memory};
use crate::recipe;
use crate::refinement::optimizer::RateSchedule;
use crate::refinement::optimizer_state::{OptimizerState, StepParams, knots};
use crate::render::{GRADIENT_BYTES_PER_VISIBLE, GRADIENT_STRIP_BYTES};
use crate::scene::Scene;
use crate::scene::between::SplitMix64;
use crate::source::FrameSource;
use loss::{Loss, RenderQuality};
use targets::{Parted, Targets};

/// What the stage is called.
const NAME: &str = "refine";

/// Time of a step, as times that of rendering its picture.
const STEP: f64 = 3.0;

/// Steps between two looks at the pictures kept apart: a third of all, within these.
const JUDGE_EVERY: [usize; 2] = [100, 500];
/// Time after which it is kept where a way is: so many times what keeping took, ...
const KEEP_AFTER: u32 = 40;
/// ... within these: of a run that is cut short less than a minute is lost.
const KEEP_EVERY: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(30)];
/// Decibels beyond which nothing is to be gained: less than a quarter of a step of 8 bits.
pub(crate) const CLOSE_ENOUGH: f64 = 60.0;
/// Decibels that changes along time gain at least, or they are not worth their bytes.
const LEAST_GAIN: f64 = 0.01;
/// Part of the rates to go on with, where they led away from the pictures kept apart.
const TOO_FAST: f32 = 0.3;
/// Part of the Gaussians that ranking alone leaves, before the first steps of a stronger reduction.
const CUTS_FROM: f64 = 0.4;
/// Part that a cut leaves, at least.
pub(crate) const CUT: f64 = 0.8;
/// Pictures that a cut is ranked on, others each time.
const RANKED_ON: usize = 48;
/// Pictures that tell how large steps after a cut should be.
const LOOKED_AT: usize = 16;
/// Rates of the last step, as a part of the first's: where a cut follows, and at the end.
const LAST_RATE: [f32; 2] = [1.0, 0.05];

/// The refinement of a run.
#[derive(Debug, Clone)]
pub struct RefineStage {
    /// What moves.
    pub columns: Columns,
    /// Up to which harmonics move.
    pub sh_degree: usize,
    /// What is made small.
    loss: Loss,
    /// Pictures that are stepped along, one at a time, at the size that is wanted.
    pub steps: usize,
    /// And before each cut.
    pub cut_steps: usize,
    /// Pictures that it goes through.
    pub pictures: usize,
    /// Whether a strong reduction goes there in cuts.
    pub cuts: bool,
    /// Contrast that every Gaussian is taken to have at least with what it hides, for a cut.
    pub contrast_floor: f64,
    /// Times between which what is added changes along time, at most, where states stand in every frame; 0: never.
    pub knots: usize,
    /// Part of the Gaussians that is asked for.
    pub target: Option<f64>,
}

impl RefineStage {
    /// The stage, unless `recipe` lets nothing move. Of a run that ranks by pictures (`cuts`), down to the part `target`.
    pub fn from_recipe(recipe: &recipe::Recipe, target: Option<f64>, cuts: bool) -> Option<RefineStage> {
        let recipe::RefineParams { refine, refine_steps, refine_cut_steps, refine_pictures, refine_ssim, refine_knots } =
            recipe.refine;
        let refine = RefineStage {
            columns: refine.0,
            sh_degree: ALL_HARMONICS,
            loss: Loss { ssim: refine_ssim },
            steps: refine_steps as usize,
            cut_steps: refine_cut_steps as usize,
            pictures: refine_pictures,
            cuts,
            contrast_floor: recipe.select.contrast_floor,
            knots: refine_knots,
            target,
        };
        (!refine.columns.is_empty() && refine.steps > 0).then_some(refine)
    }

    /// The same, but that colors' change with direction stays.
    pub fn without_bands(self) -> RefineStage {
        RefineStage { sh_degree: 0, ..self }
    }

    /// The same, but that all times change alike.
    pub fn without_course(self) -> RefineStage {
        RefineStage { knots: 0, ..self }
    }

    /// The same in a `part` of the steps, and all times alike.
    pub fn in_part(&self, part: f64) -> RefineStage {
        let of = |steps: usize| (part * steps as f64).ceil() as usize;
        RefineStage { steps: of(self.steps), cut_steps: of(self.cut_steps), ..self.clone() }.without_course()
    }

    /// What it does follows from this, and what it is done to.
    pub(crate) fn key(&self) -> CacheKey {
        let of_steps = (self.steps, self.cut_steps, self.pictures, self.cuts, self.knots);
        CacheKey::new(&(self.columns.bits(), self.sh_degree, self.loss, self.contrast_floor, of_steps))
    }

    fn manner(&self) -> StepParams {
        StepParams { columns: self.columns, sh_degree: self.sh_degree, loss: self.loss }
    }

    /// Steps at the end where a part `kept` of the Gaussians stays: the fewer go, the fewer.
    fn last_steps(&self, kept: f64) -> usize {
        let part = ((1.0 - kept) / (1.0 - CUTS_FROM)).clamp(0.0, 1.0);
        (part * self.steps as f64).ceil() as usize
    }

    /// Knots of the course of such an input.
    fn knots_of(&self, work: &Workload) -> usize {
        match (work.input.jacobian, work.frames) {
            // Nobody knows how many frames a stream will have.
            (0, 0) => self.knots,
            (0, frames) => knots(self.knots, frames as usize),
            _ => 0,
        }
    }

    /// Steps before a cut of what is `left`, if `wanted` are to stay: fewer where a step takes longer and more of what it
    /// does will go.
    fn steps_before(&self, left: usize, wanted: usize) -> usize {
        (self.cut_steps as f64 * (wanted as f64 / left.max(1) as f64).sqrt()).ceil() as usize
    }

    /// Returns the part of all Gaussians with which refinement begins at least, where it removes the rest in prune steps.
    pub fn starts_at(&self) -> Option<f64> {
        self.cuts.then_some(CUTS_FROM)
    }

    /// How many of `all` Gaussians to begin with, if `wanted` are to stay.
    pub fn first(&self, wanted: usize, all: usize) -> usize {
        start_count(self.starts_at(), wanted, all)
    }

    /// States, the descent, and a picture that is differentiated.
    pub fn need(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let whole = work.state(Columns::all());
        let read = [("readers", work.input.reader), ("held", work.held(limits, Columns::all()))];
        let original = [("states", whole), ("pictures", PICTURE_ON_ALL_THREADS)];
        let original: Vec<MemoryPart> = read.into_iter().chain(original).collect();
        let left = [
            ("states", (6 + work.threads) * whole),
            ("jacobians", (3 + work.threads) * work.input.jacobian),
            ("descent", whole + optimizer::bytes_per_gaussian(self.columns, work.sh_degree.min(self.sh_degree)) as u64),
            ("result", work.input.reduced),
            ("pictures", 2 * GRADIENT_BYTES_PER_VISIBLE as u64),
        ];
        // First the original is looked at, then only what is left, of which there are fewer; at the end along time.
        let of = |part: f64, more: Option<MemoryPart>| -> Vec<MemoryPart> {
            let parts = read.into_iter().chain(left).chain(more);
            parts.map(|(name, bytes)| (name, of_left(part, bytes))).collect()
        };
        let (wanted, knots) = (self.target.unwrap_or(1.0).min(1.0), self.knots_of(work));
        // And the best so far.
        let course = optimizer::bytes_per_gaussian(self.columns, 0) as u64
            + work.state(self.columns.difference(Columns::SH))
            + 12;
        let along = (knots > 0).then(|| of(wanted, Some(("course", knots as u64 * course))));
        let bytes = |parts: &Vec<MemoryPart>| parts.iter().map(|part| part.1).sum::<u64>();
        let stages = [Some(original), Some(of(wanted.max(CUTS_FROM), None)), along];
        let per_gaussian = stages.into_iter().flatten().max_by_key(bytes).unwrap_or_default();
        let [own, between] = targets::numbers(self.pictures, work.pixels);
        let (pictures, frames) = ((own + between) as f64, (own as u64).min(work.frames.max(1)));
        let wanted = self.target.unwrap_or(0.5);
        let sizes = sizes(self.first((wanted * 1e6) as usize, 1_000_000), (wanted * 1e6) as usize);
        let steps = self.last_steps(wanted) + if knots > 0 { along_time(self.last_steps(wanted)) } else { 0 };
        let judged = pictures / targets::APART_EVERY as f64 * 4.0;
        let seconds = |(k, &size): (usize, &usize)| {
            let (of, left) = (size as f64 / 1e6 * work.count(), (wanted * 1e6) as usize);
            let (steps, renders, ranked) = match k + 1 == sizes.len() {
                true => (steps, judged, 0.0),
                false => (self.steps_before(size, left), LOOKED_AT as f64, RANKED_ON as f64),
            };
            // States and twice as long again for how they change.
            let found = if work.input.jacobian > 0 {
                3.0 * steps as f64 / crate::refinement::optimizer_state::FOUND_EVERY as f64
            } else {
                0.0
            };
            work.reading(of, frames as f64 * found)
                + work.picturing(renders + STEP * steps as f64, of, RENDER)
                + work.picturing(ranked, of, REMOVE)
        };
        ResourceEstimate {
            stage: NAME,
            reads: 2.0 * work.scattered_reads(frames, limits),
            seconds: 2.0 * work.reading(work.count(), frames as f64)
                + work.picturing(pictures, work.count(), RENDER)
                + sizes.iter().enumerate().map(seconds).sum::<f64>(),
            per_gaussian: [scored_memory(limits), vec![("kept", 24)], per_gaussian].concat(),
            fixed: vec![
                work.arriving(),
                ("pairs", GRADIENT_STRIP_BYTES as u64),
                ("pictures", (work.threads + 4) * 12 * work.pixels),
                ("similarity", self.loss.bytes_per_pixel(work.threads) * work.pixels),
            ],
        }
    }

    /// Refines what is left, and cuts it down to `wanted`; at the end not further than pictures kept apart come closer
    /// to the original's. Protected Gaussians keep what is stored of them.
    ///
    /// # Errors
    /// Frames that cannot be read; a scratch file that cannot be written.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        reduction: CompressedModel,
        wanted: usize,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let count = reduction.len();
        let steps = self.last_steps(wanted as f64 / scored.count().max(1) as f64);
        if count == 0 || scene.schedule.pairs() == 0 {
            journal.leave_out("refinement", "there is nothing to be seen");
            return Ok(reduction);
        }
        if steps == 0 {
            journal.leave_out("refinement", "nothing went that what stays could stand for");
            return Ok(reduction);
        }
        let key = scene.work.key(&(self.key(), &reduction, wanted, steps, &scored.protected));
        let run = |journal: &mut Journal| {
            journal.stage(NAME, count, scene.source(), |journal| {
                let targets = Targets::new(scene, self.pictures)?;
                scene.work.not_divided(NAME)?;
                let mut walk = RefineRun::new(NAME, self, scene, scored, &targets, targets.parted(false));
                Ok((walk.all(&reduction, wanted, steps, journal)?.0, wanted))
            })
        };
        journal.kept(&scene.work, NAME, key, run)
    }

    /// How close to the original's, dB, pictures kept apart come that way, as a part of `stage`.
    ///
    /// # Errors
    /// Those of [`RefineStage::run`].
    pub(crate) fn closeness(
        &self,
        stage: &'static str,
        scene: &Scene,
        scored: &Scored,
        targets: &Targets,
        reduction: &CompressedModel,
        wanted: usize,
    ) -> Result<f64> {
        let steps = self.last_steps(wanted as f64 / scored.count().max(1) as f64);
        let mut walk = RefineRun::new(stage, self, scene, scored, targets, targets.parted(false));
        let key = walk.key(reduction, wanted, wanted).and(&steps);
        let all = || Ok(walk.all(reduction, wanted, steps, &mut Journal::default())?.1);
        scene.work.known(&format!("{stage}-size"), key, all)
    }
}

/// Returns how many of `all` Gaussians refinement begins with, if `wanted` are to stay: at least the part `starts_at`, the
/// rest of which goes in prune steps. None: as many as stay.
pub(crate) fn start_count(starts_at: Option<f64>, wanted: usize, all: usize) -> usize {
    starts_at.map_or(wanted, |part| wanted.max((part * all as f64).ceil() as usize).min(all))
}

/// Steps along time behind `steps` steps of all times together.
fn along_time(steps: usize) -> usize {
    2 * steps / 3
}

/// How many Gaussians there are from `first` to `last`, cut by cut.
fn sizes(first: usize, last: usize) -> Vec<usize> {
    let ratio = last.max(1) as f64 / first.max(1) as f64;
    let cuts = (ratio.ln() / CUT.ln() - 1e-9).ceil().max(0.0) as usize;
    let after = |k: usize| (first as f64 * ratio.powf(k as f64 / cuts as f64)).round() as usize;
    let mut sizes: Vec<usize> = std::iter::once(first).chain((1..cuts).map(after)).collect();
    sizes.extend((cuts > 0).then_some(last));
    sizes
}

/// Which picture comes next: all in an order, then all in another.
struct EpochSampler {
    pictures: Vec<usize>,
    at: usize,
    dice: SplitMix64,
    /// How many were taken.
    taken: usize,
}

impl EpochSampler {
    fn new(pictures: Vec<usize>) -> EpochSampler {
        EpochSampler { at: pictures.len(), pictures, dice: SplitMix64(1), taken: 0 }
    }

    fn next(&mut self) -> usize {
        if self.at == self.pictures.len() {
            self.dice.shuffle(&mut self.pictures);
            self.at = 0;
        }
        self.at += 1;
        self.taken += 1;
        self.pictures[self.at - 1]
    }

    /// Goes on as if so many had been taken.
    fn skip_to(&mut self, taken: usize) {
        while self.taken < taken {
            self.next();
        }
    }
}

/// What all legs of the way share.
pub(crate) struct RefineRun<'a> {
    refine: &'a RefineStage,
    scene: &'a Scene,
    scored: &'a Scored,
    targets: &'a Targets,
    turns: EpochSampler,
    /// The pictures kept apart.
    apart: Vec<usize>,
    /// The stage that goes it.
    stage: &'static str,
    progress: Progress,
    /// What every way of it follows from.
    key: CacheKey,
}

/// A way in the going, leg after leg: where it is, is kept from time to time, so that one that was cut short goes on.
struct CheckpointTimer {
    /// What it follows from.
    key: CacheKey,
    leg: usize,
    /// When it was kept last, and after how long it is again.
    kept: Instant,
    every: Duration,
}

/// Where a way was within a leg.
#[derive(Serialize, Deserialize)]
struct ResumePoint<Standing, BestState> {
    leg: usize,
    /// Steps of it that are done.
    steps: usize,
    taken: usize,
    schedule: RateSchedule,
    standing: Standing,
    /// Of the last leg.
    end: Option<BestState>,
}

/// What the last leg knows beside where it is.
#[derive(Clone, Serialize, Deserialize)]
struct BestState<Best, Along> {
    before: RenderQuality,
    best: RenderQuality,
    /// The best of all times alike.
    alike: RenderQuality,
    /// What is to be added for the best.
    kept: Best,
    /// Of the rates.
    part: f32,
    /// What is to be added along time for the best.
    course: Along,
}

/// Steps of a leg that are done, their rates, and what the last leg knows beside.
type Reached = (usize, RateSchedule, Option<BestState<ParamDelta, TrajectoryDelta>>);

impl<'a> RefineRun<'a> {
    /// Of `stage`, along the pictures of `parts`.
    pub(crate) fn new(
        stage: &'static str,
        refine: &'a RefineStage,
        scene: &'a Scene,
        scored: &'a Scored,
        targets: &'a Targets,
        parts: Parted,
    ) -> RefineRun<'a> {
        let along = (&targets.cameras, &targets.pictures, &parts.stepped, &parts.apart);
        let key = scene.work.key(&(refine.key(), along, &scored.protected));
        let (turns, apart) = (EpochSampler::new(parts.stepped), parts.apart);
        let progress = scene.events.task(stage, "steps", 0);
        RefineRun { refine, scene, scored, targets, turns, apart, stage, progress, key }
    }

    /// Shows how far it is of so many steps.
    fn expect(&mut self, steps: usize) {
        self.progress.restart(steps as u64);
    }

    /// What moves of `reduction`, which `result` shows.
    fn begin<'b>(&self, reduction: &CompressedModel, result: &'b dyn FrameSource) -> Result<OptimizerState<'b>>
    where
        'a: 'b,
    {
        let fixed = reduction.kept.iter().map(|id| self.scored.is_protected(*id)).collect();
        OptimizerState::new(self.scene, result, self.targets, self.refine.manner(), fixed)
    }

    /// What a way from `reduction` to `size`, on the way to `wanted`, follows from.
    fn key(&self, reduction: &CompressedModel, size: usize, wanted: usize) -> CacheKey {
        self.key.and(&(reduction, size, wanted, self.turns.taken))
    }

    fn trail(&self, key: CacheKey) -> CheckpointTimer {
        CheckpointTimer { key, leg: 0, kept: Instant::now(), every: KEEP_EVERY[0] }
    }

    /// Goes all the way: cuts `reduction` down to `wanted`, and `steps` steps at the end. Also gives how close to the
    /// original's, dB, pictures kept apart are then.
    fn all(
        &mut self,
        reduction: &CompressedModel,
        wanted: usize,
        steps: usize,
        journal: &mut Journal,
    ) -> Result<(CompressedModel, f64)> {
        let mut trail = self.trail(self.key(reduction, wanted, wanted).and(&steps));
        let result = self.scene.input.reduced(reduction)?;
        let mut moving = self.begin(reduction, &*result)?;
        let sizes = sizes(reduction.len(), wanted);
        let of_cuts: usize = sizes.windows(2).map(|pair| self.refine.steps_before(pair[0], wanted)).sum();
        self.expect(of_cuts + steps + self.steps_along(steps));
        let mut left = reduction.clone();
        for pair in sizes.windows(2) {
            let steps = self.refine.steps_before(pair[0], wanted);
            left = left.pick(&self.cut(&mut moving, &mut trail, steps, pair[1])?);
        }
        let BestState { kept, course, best, .. } = self.finish(&mut moving, &mut trail, steps, journal)?;
        (left.change, left.course) = (left.change.and(kept), left.course.and(course));
        Ok((left, best.psnr))
    }

    /// Cuts `reduction` down to `size`, on the way to `wanted`, after as many steps as that takes.
    pub(crate) fn cut_down(
        &mut self,
        reduction: &CompressedModel,
        size: usize,
        wanted: usize,
    ) -> Result<CompressedModel> {
        let key = self.key(reduction, size, wanted);
        let (left, taken) = self.scene.work.known(&format!("{}-cut", self.stage), key, || {
            let mut trail = self.trail(key);
            let result = self.scene.input.reduced(reduction)?;
            let mut moving = self.begin(reduction, &*result)?;
            let steps = self.refine.steps_before(reduction.len(), wanted);
            self.expect(steps);
            let mut left = reduction.pick(&self.cut(&mut moving, &mut trail, steps, size)?);
            left.change = left.change.and(moving.change());
            Ok((left, self.turns.taken))
        })?;
        self.turns.skip_to(taken);
        Ok(left)
    }

    /// `reduction` at its best: as the last steps leave it.
    pub(crate) fn best_of(&mut self, mut reduction: CompressedModel, journal: &mut Journal) -> Result<CompressedModel> {
        let steps = self.refine.last_steps(reduction.len() as f64 / self.scored.count().max(1) as f64);
        let (key, work) = (self.key(&reduction, reduction.len(), reduction.len()), &self.scene.work);
        let (change, course, taken) = journal.kept(work, &format!("{}-best", self.stage), key, |journal| {
            self.expect(steps + self.steps_along(steps));
            let mut trail = self.trail(key);
            let result = self.scene.input.reduced(&reduction)?;
            let mut moving = self.begin(&reduction, &*result)?;
            let BestState { kept, course, .. } = self.finish(&mut moving, &mut trail, steps, journal)?;
            Ok((kept, course, self.turns.taken))
        })?;
        self.turns.skip_to(taken);
        (reduction.change, reduction.course) = (reduction.change.and(change), reduction.course.and(course));
        Ok(reduction)
    }

    /// Knots of the course of what is refined.
    fn knots(&self) -> usize {
        match self.scene.input.has_explicit_frames() {
            true => knots(self.refine.knots, self.scene.source().info().times.len()),
            false => 0,
        }
    }

    /// Steps along time behind `steps` steps.
    fn steps_along(&self, steps: usize) -> usize {
        if self.knots() > 0 { along_time(steps) } else { 0 }
    }

    fn step(&mut self, moving: &mut OptimizerState<'_>, schedule: &RateSchedule) -> Result<()> {
        moving.step(self.turns.next(), schedule)?;
        self.progress.advance(1);
        Ok(())
    }

    /// What a leg that goes on from where it was kept is called.
    fn name(&self) -> String {
        format!("{}-steps", self.stage)
    }

    /// Goes to where the leg was when it was kept last, if it was.
    fn go_on(&mut self, moving: &mut OptimizerState<'_>, trail: &CheckpointTimer) -> Result<Option<Reached>> {
        let kept: Option<
            ResumePoint<crate::refinement::optimizer_state::KeptCheckpoint, BestState<ParamDelta, TrajectoryDelta>>,
        > = self.scene.work.find(&self.name(), trail.key)?;
        let Some(kept) = kept.filter(|kept| kept.leg == trail.leg) else { return Ok(None) };
        moving.go_on(kept.standing)?;
        self.turns.skip_to(kept.taken);
        self.progress.advance(kept.steps as u64);
        Ok(Some((kept.steps, kept.schedule, kept.end)))
    }

    /// Keeps where the leg is after so many steps, if it is time to.
    fn keep(
        &self,
        moving: &OptimizerState<'_>,
        trail: &mut CheckpointTimer,
        (steps, schedule): (usize, RateSchedule),
        end: Option<BestState<&ParamDelta, &TrajectoryDelta>>,
    ) -> Result<()> {
        if !self.scene.work.keeps() || trail.kept.elapsed() < trail.every {
            return Ok(());
        }
        let (leg, taken) = (trail.leg, self.turns.taken);
        let kept = ResumePoint { leg, steps, taken, schedule, standing: moving.standing(), end };
        let start = Instant::now();
        self.scene.work.keep(&self.name(), trail.key, &kept)?;
        trail.kept = Instant::now();
        trail.every = (KEEP_AFTER * (trail.kept - start)).clamp(KEEP_EVERY[0], KEEP_EVERY[1]);
        Ok(())
    }

    /// Takes `steps` steps, and lets go of all but the `size` Gaussians that pictures would lose most with; gives their
    /// places.
    fn cut(
        &mut self,
        moving: &mut OptimizerState<'_>,
        trail: &mut CheckpointTimer,
        steps: usize,
        size: usize,
    ) -> Result<Vec<u32>> {
        let (name, key, work) = (format!("{}-cut-{:02}", self.stage, trail.leg + 1), trail.key, &self.scene.work);
        let kept: Option<(crate::refinement::optimizer_state::KeptCheckpoint, Vec<u32>, usize)> =
            work.find(&name, key)?;
        let left = match kept {
            Some((standing, left, taken)) => {
                moving.go_on(standing)?;
                self.turns.skip_to(taken);
                self.progress.advance(steps as u64);
                left
            }
            None => {
                let (done, schedule) = match self.go_on(moving, trail)? {
                    Some((done, schedule, _)) => (done, schedule),
                    None => {
                        let some = self.apart.iter().step_by(self.apart.len().div_ceil(LOOKED_AT).max(1));
                        let error = moving.closeness(&some.copied().collect::<Vec<_>>())?.error;
                        (0, RateSchedule::new(steps, LAST_RATE[0], error))
                    }
                };
                for step in done..steps {
                    self.step(moving, &schedule)?;
                    self.keep(moving, trail, (step + 1, schedule), None)?;
                }
                let of: Vec<usize> = (0..RANKED_ON).map(|_| self.turns.next()).collect();
                let errors = moving.removal_error(&of, self.refine.contrast_floor as f32)?;
                let left = errors.most_missed(size, |place| moving.fixed()[place]);
                work.keep(&name, key, &(moving.standing(), &left, self.turns.taken))?;
                left
            }
        };
        trail.leg += 1;
        moving.pick(&left)?;
        Ok(left)
    }

    /// Takes `steps` steps, and some along time; gives what is to be added to what is stored for the state that the pictures
    /// kept apart like best, and how close they are then.
    fn finish(
        &mut self,
        moving: &mut OptimizerState<'_>,
        trail: &mut CheckpointTimer,
        steps: usize,
        journal: &mut Journal,
    ) -> Result<BestState<ParamDelta, TrajectoryDelta>> {
        let count = self.apart.len();
        let (done, mut schedule, mut end) = match self.go_on(moving, trail)? {
            Some((done, schedule, Some(end))) => (done, schedule, end),
            _ => {
                moving.reevaluate_states()?;
                let before = moving.closeness(&self.apart)?;
                if before.psnr.is_nan() {
                    let why = format!("{count} pictures kept apart have {}", decibels_text(before.psnr, 2));
                    journal.leave_out("refinement", why);
                    return Ok(BestState::new(before, moving.change()));
                }
                if before.psnr >= CLOSE_ENOUGH {
                    let why = format!("{count} pictures kept apart keep {:.2} dB without", before.psnr);
                    journal.leave_out("refinement", why);
                    return Ok(BestState::new(before, moving.change()));
                }
                (0, RateSchedule::new(steps, LAST_RATE[1], before.error), BestState::new(before, moving.change()))
            }
        };
        let judge_every = steps.div_ceil(3).clamp(JUDGE_EVERY[0], JUDGE_EVERY[1]);
        for step in done + 1..=steps {
            self.step(moving, &schedule)?;
            if step % judge_every == 0 || step == steps {
                moving.reevaluate_states()?;
                let now = moving.closeness(&self.apart)?;
                if self.refine.loss.is_closer(&now, &end.best) {
                    (end.best, end.kept) = (now, moving.change());
                } else if step < steps {
                    end.part *= TOO_FAST;
                    moving.turn_back(&end.kept)?;
                    schedule = RateSchedule::new(steps - step, LAST_RATE[1], end.best.error).times(end.part);
                }
            }
            end.alike = end.best;
            self.keep(moving, trail, (step, schedule), Some(end.standing()))?;
        }
        let is_along = self.follow_time(moving, trail, (done, schedule), &mut end, steps)?;
        let [start, best] = [end.before.psnr, end.best.psnr];
        if self.refine.loss.is_closer(&end.best, &end.before) {
            journal.notes.push(format!("refined: {count} pictures kept apart keep {best:.2} dB, not {start:.2}"));
            journal.refined = Some(RefinedSummary { pictures: count, before: start, result: best });
        } else {
            journal.leave_out("refinement", format!("{count} pictures kept apart never kept more than {start:.2} dB"));
        }
        if !end.course.is_empty() {
            let gain = best - end.alike.psnr;
            journal.notes.push(format!("refined along time: {gain:.2} dB of these are due to that"));
        } else if is_along {
            let why = format!("pictures kept apart never kept more than {best:.2} dB");
            journal.leave_out("changes along time", why);
        }
        Ok(end)
    }

    /// Takes steps along time behind `steps` steps, from what is best of all times alike or where it was `done` before, as far
    /// as the pictures kept apart like them; gives whether any are.
    fn follow_time(
        &mut self,
        moving: &mut OptimizerState<'_>,
        trail: &mut CheckpointTimer,
        (done, mut schedule): (usize, RateSchedule),
        end: &mut BestState<ParamDelta, TrajectoryDelta>,
        steps: usize,
    ) -> Result<bool> {
        let along = self.steps_along(steps);
        if along == 0 || end.alike.psnr >= CLOSE_ENOUGH {
            return Ok(false);
        }
        if done <= steps {
            let knots = self.knots();
            moving.turn_back(&end.kept)?;
            if !moving.enable_keyframes(knots) {
                return Ok(false);
            }
            // Each picture is a step of two knots.
            schedule = RateSchedule::new(2 * along / knots, LAST_RATE[1], end.alike.error);
        }
        let judge_every = along.div_ceil(3);
        for step in done.saturating_sub(steps) + 1..=along {
            moving.step_along(self.turns.next(), &schedule)?;
            self.progress.advance(1);
            if step % judge_every == 0 || step == along {
                let now = moving.closeness(&self.apart)?;
                let gains = self.refine.loss.ssim > 0.0 || now.psnr >= end.best.psnr + LEAST_GAIN;
                if gains && self.refine.loss.is_closer(&now, &end.best) {
                    (end.best, end.course) = (now, moving.course());
                }
            }
            self.keep(moving, trail, (steps + step, schedule), Some(end.standing()))?;
        }
        Ok(true)
    }
}

impl BestState<ParamDelta, TrajectoryDelta> {
    /// Nothing gained yet.
    fn new(before: RenderQuality, kept: ParamDelta) -> Self {
        BestState { before, best: before, alike: before, kept, part: 1.0, course: TrajectoryDelta::default() }
    }

    /// To be kept.
    fn standing(&self) -> BestState<&ParamDelta, &TrajectoryDelta> {
        let BestState { before, best, alike, ref kept, part, ref course } = *self;
        BestState { before, best, alike, kept, part, course }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cache::CacheRequest;
    use crate::diagnostics::demo_scene;
    use crate::files::container::Container;
    use crate::metrics::psnr;
    use crate::model::{Gaussians, Rig, SequenceInfo, Split};
    use crate::models::trajectories::write_sequence;
    use crate::models::{Link, OpenOptions};
    use crate::outputs::container::write_container;
    use crate::outputs::kind::OutputKind;
    use crate::passes::gather_all;
    use crate::pipeline::tests::{scene, score_scene};
    use crate::progress::Events;
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;
    use crate::render::render;
    use crate::scene::{InputOptions, open_scene};
    use crate::source::{BlockReader, Ids};

    /// The first `count` of the ranking of `scene`, refined in `steps` steps; `keep` are protected.
    fn refined(scene: &Scene, count: usize, steps: usize, keep: Vec<u32>) -> (CompressedModel, Journal) {
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(scene, &recipe, &UserOverrides { keep, ..UserOverrides::default() });
        let reduction = CompressedModel::pruned(scored.ranked().take(count), &recipe.merge);
        let mut journal = Journal::default();
        let refine = RefineStage { steps, ..RefineStage::from_recipe(&recipe, None, false).unwrap() };
        (refine.run(scene, &scored, reduction, count, &mut journal).unwrap(), journal)
    }

    /// Mean PSNR of `reduction` over the pictures of `rig` that the scene is not scored by.
    fn held_out(scene: &Scene, rig: &Rig, reduction: &CompressedModel) -> f64 {
        let schedule = rig.schedule(&scene.source().info().times, Some(Split::Test)).unwrap();
        let result = scene.input.reduced(reduction).unwrap();
        let of_frame = |(frame, views): (usize, &[(u32, u32)])| -> f64 {
            let [original, now] =
                [scene.source(), &*result].map(|source| gather_all(source, frame, Columns::all()).unwrap());
            let of_view = |&(_, camera): &(u32, u32)| {
                let made = |state| render(state, &schedule.cameras[camera as usize], scene.background);
                psnr(&made(&now), &made(&original))
            };
            views.iter().map(of_view).sum()
        };
        schedule.iter().enumerate().map(of_frame).sum::<f64>() / schedule.pairs() as f64
    }

    #[test]
    fn pictures_of_no_camera_that_was_looked_through_come_closer_by_it() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let rig = scene.rig.clone();
        let (plain, _) = refined(&scene, 300, 0, Vec::new());
        let (moved, journal) = refined(&scene, 300, 200, Vec::new());
        let [before, after] = [&plain, &moved].map(|reduction| held_out(&scene, &rig, reduction));
        assert!(after > before + 3.0, "{before:.2} dB before, {after:.2} after");
        assert_eq!((journal.left_out.len(), journal.notes.len()), (0, 1));
        assert_eq!(moved.kept, plain.kept);
    }

    #[test]
    fn what_comes_out_depends_neither_on_threads_nor_on_limits_and_what_is_protected_stays() {
        let folder = tempfile::tempdir().unwrap();
        let mut scene = scene(folder.path());
        let keep: Vec<u32> = (100..140).collect();
        let on = |threads: usize, scene: &Scene| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| refined(scene, 200, 110, keep.clone())).0
        };
        let one = on(1, &scene);
        assert!(!one.change.is_empty());
        assert!(on(3, &scene).change == one.change, "threads change it");
        scene.limits = Limits { frames_held: 1, pictures_together: 1, ..Limits::NONE };
        assert!(on(2, &scene).change == one.change, "limits change it");
        for (place, id) in one.kept.iter().enumerate().filter(|(_, id)| keep.contains(id)) {
            let moved = |column: Columns| {
                let of = one.change.0.column(column);
                (0..of.width()).any(|c| of.plane(c)[place] != 0.0)
            };
            assert!(!Columns::all().iter().any(moved), "Gaussian {id} is protected and moved");
        }
    }

    #[test]
    #[ignore = "needs time"]
    fn a_way_that_is_cut_short_anywhere_goes_on_and_ends_where_it_would_have() {
        let folder = tempfile::tempdir().unwrap();
        let model = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model");
        let long = folder.path().join("long.gseq");
        let made = demo_scene::Scene::new(900, 16);
        write_container(&made, &long, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
        let short = folder.path().join("scene.gseq");
        drop(scene(folder.path()));
        // States that follow from what is stored by a sum, by a field, and along time.
        for (number, path, steps, pictures) in [(0, short, 120, 60), (1, model, 120, 60), (2, long, 300, 300)] {
            let open = |work: Option<CacheRequest>| {
                let cameras = (number == 1).then(|| path.clone());
                let options = InputOptions { path: path.clone(), cameras, work, ..Default::default() };
                let mut opened = open_scene(&options).unwrap();
                opened.has_cameras = true;
                if number == 2 {
                    opened.schedule = made.rig().schedule(&made.info().times, Some(Split::Train)).unwrap();
                }
                opened
            };
            let run = |scene: &Scene| -> Result<CompressedModel> {
                let recipe = Recipe::preset("default").unwrap();
                let scored = crate::pipeline::score_scene(scene, &recipe, &UserOverrides::default())?;
                let count = scored.count();
                let reduction = CompressedModel::pruned(scored.ranked().take(2 * count / 5), &recipe.merge);
                let few = RefineStage {
                    steps,
                    cut_steps: 40,
                    pictures,
                    ..RefineStage::from_recipe(&recipe, None, true).unwrap()
                };
                few.run(scene, &scored, reduction, count / 4, &mut Journal::default())
            };
            let start = Instant::now();
            let expected = run(&open(None)).unwrap();
            let whole = start.elapsed();
            let (place, away) = (folder.path().join(format!("work{number}")), folder.path().join("away"));
            let asked = || Some(CacheRequest { folder: place.clone(), part: None });
            let (mut cuts, mut found) = (0, None);
            for delay in (0..40).map(|k| whole.mul_f64(0.1 * 1.15f64.powi(k))) {
                let scene = open(asked());
                // Whoever keeps something now finds no folder, and ends.
                let ended = std::thread::scope(|scope| {
                    scope.spawn(|| {
                        std::thread::sleep(delay);
                        std::fs::rename(&place, &away).unwrap();
                    });
                    run(&scene)
                });
                std::fs::rename(&away, &place).unwrap();
                match ended {
                    Ok(reduction) => {
                        found = Some(reduction);
                        break;
                    }
                    Err(error) => {
                        assert!(error.to_string().contains("work"), "{error}");
                        cuts += 1;
                    }
                }
            }
            let found = found.expect("it ends");
            assert!(cuts > 1, "it was cut short {cuts} times");
            assert!(found.change == expected.change && !found.change.is_empty(), "{number}, cut short {cuts} times");
            assert!(found.course == expected.course, "{number}, cut short {cuts} times: along time");
            assert_eq!(expected.course.is_empty(), number < 2, "{number}");
        }
    }

    /// A scene of which a third is there in any frame, and the others with that logit.
    struct ShortLives(demo_scene::Scene, SequenceInfo, f32);

    struct Reader<'a>(Box<dyn BlockReader + 'a>, Vec<usize>, f32);

    impl FrameSource for ShortLives {
        fn info(&self) -> &SequenceInfo {
            &self.1
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            let numbers = ids.iter().collect();
            Ok(Box::new(Reader(self.0.open(ids)?, numbers, self.2)))
        }
    }

    impl BlockReader for Reader<'_> {
        fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
            self.0.read(frame, want, out)?;
            if want.contains(Columns::OPACITY) {
                let logits = out.opacity_logit.plane_mut(0).iter_mut().zip(&self.1);
                logits.filter(|(_, id)| !(*id + frame).is_multiple_of(3)).for_each(|(logit, _)| *logit = self.2);
            }
            Ok(())
        }
    }

    #[test]
    fn those_that_are_not_there_are_left_out_and_what_comes_out_is_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let [away, unseen] = [-40.0, -25.0].map(|logit| {
            let made = demo_scene::Scene::new(900, 6);
            let (rig, info) = (made.rig(), SequenceInfo { varying: Columns::all(), ..made.info().clone() });
            let path = folder.path().join("scene.gseq");
            let source = ShortLives(made, info, logit);
            write_container(&source, &path, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
            let input = Box::new(Container::open(&path).unwrap());
            let scene = Scene::new(path, input, rig, Some(Split::Train)).unwrap();
            let recipe = Recipe::preset("default").unwrap();
            let scored = score_scene(&scene, &recipe, &UserOverrides::default());
            let reduction = CompressedModel::pruned(scored.ranked().take(600), &recipe.merge);
            let few =
                RefineStage { steps: 100, cut_steps: 40, ..RefineStage::from_recipe(&recipe, None, true).unwrap() };
            few.run(&scene, &scored, reduction, 250, &mut Journal::default()).unwrap()
        });
        assert!(!away.change.is_empty() && away.change == unseen.change);
        assert_eq!(away.kept, unseen.kept);
    }

    #[test]
    #[ignore = "needs time"]
    fn what_stands_in_frames_comes_closer_along_time_and_every_kind_of_it_is_written_so() {
        let folder = tempfile::tempdir().unwrap();
        let made = demo_scene::Scene::new(900, 16);
        let [packed, files] = ["scene.gseq", "frames"].map(|name| folder.path().join(name));
        write_container(&made, &packed, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
        std::fs::create_dir(&files).unwrap();
        write_sequence(&made, OutputKind::PlySequence, &files, 1, &Events::IGNORED).unwrap();
        let read = |source: &dyn FrameSource| -> Vec<Gaussians> {
            (0..16).map(|frame| gather_all(source, frame, Columns::all()).unwrap()).collect()
        };
        for (name, path, link) in
            [("packed", &packed, Link::Never), ("files", &files, Link::Never), ("linked", &files, Link::Apart)]
        {
            let input = crate::models::open(path, &OpenOptions { link, ..OpenOptions::default() }).unwrap();
            let scene = Scene::new(path.clone(), input, made.rig(), Some(Split::Train)).unwrap();
            let recipe = Recipe::preset("default").unwrap();
            let scored = score_scene(&scene, &recipe, &UserOverrides::default());
            let given = read(scene.source());
            let is_still = |states: &[Gaussians], column: Columns, row: usize| {
                let values = |frame: &Gaussians| frame.column(column).pick(&[row as u32]);
                states.iter().all(|frame| values(frame) == values(&states[0]))
            };
            // Of those that are always there half of what moves and an eighth of what does not.
            let is_there = |id: usize| given.iter().all(|frame| frame.opacity_logit.plane(0)[id] > -30.0);
            let part = |&id: &u32| {
                let one_in = if is_still(&given, Columns::POSITION, id as usize) { 8 } else { 2 };
                id % one_in == 0 && is_there(id as usize)
            };
            let kept: Vec<u32> = (0..given[0].len() as u32).filter(part).collect();
            let [alike, along] = [0, 4].map(|knots| {
                let reduction = CompressedModel::pruned(kept.clone(), &recipe.merge);
                let few = RefineStage { steps: 300, knots, ..RefineStage::from_recipe(&recipe, None, false).unwrap() };
                few.run(&scene, &scored, reduction, kept.len(), &mut Journal::default()).unwrap()
            });
            assert_eq!((alike.course.0.len(), along.course.0.len()), (0, 4));
            assert!(along.change == alike.change, "{name}");
            // Some tracks are of two Gaussians of this scene, which have colors of their own.
            assert!(link == Link::Apart || !along.course.columns().contains(Columns::SH), "{name}");
            let [before, after] = [&alike, &along].map(|reduction| held_out(&scene, &made.rig(), reduction));
            // What moves is a small part of these pictures, and the rest does not begin to.
            assert!(after > before + 0.02, "{name}: {before:.2} dB of all times alike, {after:.2} along time");
            let expected = read(&*scene.input.reduced(&along).unwrap());
            // What does not change with time does not begin to, Gaussian by Gaussian.
            let mut still = [0, 0];
            for (place, &id) in along.kept.iter().enumerate() {
                for column in Columns::all().iter() {
                    let was_still = is_still(&given, column, id as usize);
                    assert!(!was_still || is_still(&expected, column, place), "{name}: {id}, {}", column.name());
                    still[usize::from(was_still && column == Columns::POSITION)] += 1;
                }
            }
            assert!(still.iter().all(|&count| count > 20), "{name}: {still:?}");
            for (kind, out) in [(OutputKind::Gseq, "out.gseq"), (OutputKind::PlySequence, "out")] {
                let out = folder.path().join(format!("{name}_{out}"));
                if kind == OutputKind::PlySequence {
                    std::fs::create_dir(&out).unwrap();
                }
                scene.input.write(&along, kind, &out, &Limits::NONE, &Events::IGNORED).unwrap();
                let options = OpenOptions { link: Link::Never, ..OpenOptions::default() };
                let written = crate::models::open(&out, &options).unwrap();
                assert!(read(written.source()) == expected, "{name} as {kind:?}");
            }
        }
    }

    #[test]
    fn without_bands_colors_change_with_direction_as_they_did() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        let reduction = CompressedModel::pruned(scored.ranked().take(300), &recipe.merge);
        let (mut journal, count) = (Journal::default(), reduction.len());
        let refine =
            RefineStage { steps: 100, ..RefineStage::from_recipe(&recipe, None, false).unwrap() }.without_bands();
        let moved = refine.run(&scene, &scored, reduction, count, &mut journal).unwrap();
        assert_eq!((moved.change.0.sh.width(), moved.change.0.sh.len()), (3, count));
        assert!(scene.source().info().sh_degree > 0 && journal.notes.len() == 1, "{journal:?}");
    }

    #[test]
    fn what_cannot_come_closer_stays_and_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let (whole, journal) = refined(&scene, 1500, 120, Vec::new());
        assert!(whole.change.is_empty());
        assert_eq!((journal.left_out.len(), journal.left_out[0].what.as_str()), (1, "refinement"));
        let (none, journal) = refined(&scene, 0, 120, Vec::new());
        assert_eq!((none.len(), journal.left_out.len()), (0, 1));
    }

    #[test]
    fn a_descent_goes_back_to_where_it_was_and_on_with_some() {
        let folder = tempfile::tempdir().unwrap();
        let explicit = scene(folder.path());
        let model = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model");
        let options = InputOptions { path: model.clone(), cameras: Some(model), ..InputOptions::default() };
        for scene in [explicit, open_scene(&options).unwrap()] {
            let targets = Targets::new(&scene, 520).unwrap();
            let count = scene.source().info().count;
            let kept = (0..count as u32).step_by(2).collect();
            let reduction = CompressedModel::pruned(kept, &Recipe::preset("default").unwrap().merge);
            let result = scene.input.reduced(&reduction).unwrap();
            let refine = RefineStage::from_recipe(&Recipe::preset("default").unwrap(), None, false).unwrap();
            let fixed = vec![false; reduction.len()];
            let mut moving = OptimizerState::new(&scene, &*result, &targets, refine.manner(), fixed).unwrap();
            let (of, schedule) = ([0, 7, 20], RateSchedule::new(20, 1.0, 1.0));
            let start = moving.closeness(&of).unwrap().psnr;
            let nowhere = moving.change();
            let walk = |moving: &mut OptimizerState<'_>| (0..20).for_each(|k| moving.step(k, &schedule).unwrap());
            walk(&mut moving);
            moving.reevaluate_states().unwrap();
            moving.turn_back(&nowhere).unwrap();
            let back = moving.closeness(&of).unwrap().psnr;
            assert!((back - start).abs() < 1e-3, "{start:.4} dB at the start, {back:.4} when back");
            walk(&mut moving);
            moving.reevaluate_states().unwrap();
            let (there, change) = (moving.closeness(&of).unwrap().psnr, moving.change());
            assert!(there > start + 0.5, "{start:.2} dB before, {there:.2} after");
            walk(&mut moving);
            moving.turn_back(&change).unwrap();
            let back = moving.closeness(&of).unwrap().psnr;
            assert!((back - there).abs() < 1e-3, "{there:.4} dB there, {back:.4} when back");

            let some: Vec<u32> = (0..reduction.len() as u32).step_by(3).collect();
            let whole = moving.change();
            moving.pick(&some).unwrap();
            let picked = moving.closeness(&of).unwrap().psnr;
            let thinned = CompressedModel { change: whole.pick(&some), ..reduction.pick(&some) };
            let result = scene.input.reduced(&thinned).unwrap();
            let fixed = vec![false; some.len()];
            let anew = OptimizerState::new(&scene, &*result, &targets, refine.manner(), fixed).unwrap();
            let expected = anew.closeness(&of).unwrap().psnr;
            assert!((picked - expected).abs() < 1e-3, "got {picked:.4} dB, expected {expected:.4}");
        }
    }
}
