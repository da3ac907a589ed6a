//! What the stages of a run have in common, and what they pass on to one another.
//!
//! A stage is one file in [`stages`](super::stages): a type that implements [`Stage`], and a function that plans it. The
//! list `STAGES` there has these functions in the order in which stages run.

use std::fmt::Debug;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::request::Request;
use super::summary::{ArchiveSummary, GoalSummary, InputSummary, MergeSummary, Summary};
use crate::archive::Encoded;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::journal::records::QualitySummary;
use crate::journal::records::Saved;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::outputs::bounds::Bounds;
use crate::pruning::Ranking;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::score::Scored;
use crate::refinement::prune_steps::PruneSteps;
use crate::refinement::start_count;
use crate::scene::Scene;
use crate::statistics::pass::Scanned;

/// Part of the Gaussians that ranking leaves where a search refines nothing.
const RANKED_BY_SEARCH: f64 = 0.02;

/// Which part of a run a stage belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// From frames to a ranking of all Gaussians.
    Rank,
    /// From a ranking to a model of one size. A search for a quality repeats these stages, once for every size it tries.
    Reduce,
    /// From the model to files.
    Write,
}

/// What estimates of memory and time depend on.
#[derive(Debug, Clone, Copy)]
pub struct EstimateInput<'a> {
    /// Size of the input and of its views.
    pub work: &'a Workload,
    /// How much is held in memory at a time.
    pub limits: &'a Limits,
    /// Part of the Gaussians in the output, above 0 and at most 1; 1 where it is not known before.
    pub left: f64,
    /// What has been measured while a stream arrived.
    pub measured: MeasuredOnArrival,
}

/// A stage of a run, with its parameters.
pub trait Stage: Debug + Send + Sync {
    /// Returns what the stage takes, one entry for each of its parts that progress lines name; none where such an input
    /// leaves it nothing to do or it takes next to nothing.
    fn estimates(&self, input: EstimateInput<'_>) -> Vec<ResourceEstimate>;

    /// Returns the parameters that decide how long the stage takes, for a person: "NAME: 3000 steps". Empty where there are
    /// none.
    fn parameters(&self) -> String {
        String::new()
    }

    /// Returns whether the stage may find nothing to do where views hardly differ without a part `hardly_seen` of the
    /// Gaussians. The shortest time of a run is estimated without such stages.
    fn may_be_skipped(&self, _input: EstimateInput<'_>, _hardly_seen: f64) -> bool {
        false
    }

    /// Returns what several processes can divide among themselves, a line each: "NAME: 12 blocks of Gaussians".
    fn shardable_units(&self, _scene: &Scene, _counts: &CountPlan) -> Vec<String> {
        Vec::new()
    }

    /// Confirms, before any work, that the scene has what the stage needs.
    ///
    /// # Errors
    /// Files that are missing or too few.
    fn check(&self, _scene: &Scene) -> Result<()> {
        Ok(())
    }

    /// Runs the stage: reads what it needs from `run`, leaves there what it finds, and records in the journal what belongs
    /// into the summary. Results are cached by the stage's own key, so that a run that was interrupted goes on from there.
    ///
    /// # Errors
    /// Input that cannot be read, output that cannot be written, requests that the input cannot meet.
    fn run(&self, run: &mut RunState<'_>) -> Result<()>;
}

/// Which statistics of a stream were taken as it arrived.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MeasuredOnArrival {
    /// Every Gaussian at every frame.
    pub scanned: bool,
    /// What views show of each.
    pub seen: bool,
}

/// What the frames say before anything is scored.
pub struct Measured {
    /// Statistics of every Gaussian.
    pub scanned: Scanned,
    /// What the pictures show of each, where they were looked at.
    pub seen: Option<VisibleContribution>,
}

impl Measured {
    /// Returns which statistics these are.
    pub fn kinds(&self) -> MeasuredOnArrival {
        MeasuredOnArrival { scanned: true, seen: self.seen.is_some() }
    }
}

/// How many Gaussians each part of a run leaves: ranking removes the first, refinement the rest between its steps.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CountPlan {
    /// Part of all Gaussians with which refinement begins at least, where it removes the rest in prune steps; none: ranking
    /// alone removes them.
    pub refinement_starts_at: Option<f64>,
    /// Whether the number in the output is searched for.
    pub searches: bool,
}

impl CountPlan {
    /// Returns how many of `all` Gaussians refinement begins with, if `wanted` are to stay.
    pub fn before_refinement(&self, wanted: usize, all: usize) -> usize {
        start_count(self.refinement_starts_at, wanted, all)
    }

    /// Returns how many of `all` Gaussians ranking goes down to, if `wanted` are to stay. A search ranks as far down as its
    /// smallest size needs.
    pub fn after_ranking(&self, wanted: usize, all: usize) -> usize {
        let smallest =
            if self.refinement_starts_at.is_some() { 0 } else { (RANKED_BY_SEARCH * all as f64).ceil() as usize };
        self.before_refinement(if self.searches { smallest } else { wanted }, all)
    }

    /// Returns both counts for a person, on the way from `all` Gaussians to `target`.
    pub(super) fn text(&self, target: Option<usize>, all: usize, merges: bool) -> String {
        let share =
            |count: usize| format!("{count} of {all} Gaussians ({:.0}%)", 100.0 * count as f64 / all.max(1) as f64);
        let alone = if merges { "ranking and merging leave" } else { "ranking leaves" };
        match (target, self.refinement_starts_at) {
            (Some(wanted), Some(_)) => {
                let ranked = self.before_refinement(wanted, all);
                let removed = ranked - wanted;
                format!("counts: ranking leaves {}, refinement removes {removed} of them; {wanted} stay", share(ranked))
            }
            (Some(wanted), None) => format!("counts: {alone} {}; refinement removes none", share(wanted)),
            (None, Some(_)) => format!(
                "counts: ranking leaves {} or more, refinement removes the rest; how many stay is found on the way",
                share(self.before_refinement(0, all))
            ),
            (None, None) => format!("counts: {alone} as many as are found on the way; refinement removes none"),
        }
    }
}

/// Returns what a stage takes for an input, within limits.
type Estimate = Box<dyn Fn(&Workload, &Limits) -> ResourceEstimate + Send + Sync>;

/// A stage that a run goes without.
struct LeftOutStage {
    what: &'static str,
    why: String,
    /// What it would take.
    estimate: Option<Estimate>,
}

/// The stages of a run in their order, and what the run goes without.
#[derive(Default)]
pub struct StageList {
    stages: Vec<(Phase, Box<dyn Stage>)>,
    left_out: Vec<LeftOutStage>,
    /// How many Gaussians ranking and refinement leave.
    pub counts: CountPlan,
    /// Whether the amount of work depends on what stages find, so that time estimates are wide.
    is_open_ended: bool,
}

impl StageList {
    /// Adds a stage behind those before.
    pub fn add(&mut self, phase: Phase, stage: impl Stage + 'static) {
        self.stages.push((phase, Box::new(stage)));
    }

    /// Records that the run goes without `what`, and why.
    pub fn leave_out(&mut self, what: &'static str, why: impl Into<String>) {
        self.left_out.push(LeftOutStage { what, why: why.into(), estimate: None });
    }

    /// Records that the run goes without `what`, which would take what `estimate` returns.
    pub fn leave_out_stage(
        &mut self,
        what: &'static str,
        why: impl Into<String>,
        estimate: impl Fn(&Workload, &Limits) -> ResourceEstimate + Send + Sync + 'static,
    ) {
        self.left_out.push(LeftOutStage { what, why: why.into(), estimate: Some(Box::new(estimate)) });
    }

    /// Records that the amount of work depends on what stages find.
    pub fn set_open_ended(&mut self) {
        self.is_open_ended = true;
    }

    /// Returns whether the amount of work depends on what stages find.
    pub fn is_open_ended(&self) -> bool {
        self.is_open_ended
    }

    /// Returns all stages.
    pub fn all(&self) -> impl Iterator<Item = &dyn Stage> {
        self.stages.iter().map(|(_, stage)| &**stage)
    }

    /// Returns the stages of `phase`.
    pub fn in_phase(&self, phase: Phase) -> impl Iterator<Item = &dyn Stage> {
        self.stages.iter().filter(move |(of, _)| *of == phase).map(|(_, stage)| &**stage)
    }

    /// Runs the stages of `phase`.
    ///
    /// # Errors
    /// Those of the stages.
    pub fn run(&self, phase: Phase, run: &mut RunState<'_>) -> Result<()> {
        self.in_phase(phase).try_for_each(|stage| stage.run(run))
    }

    /// Returns what the run goes without, a line each, for a person.
    pub fn left_out(&self) -> impl Iterator<Item = String> {
        self.left_out.iter().map(|left| format!("left out: {} ({})", left.what, left.why))
    }

    /// Writes down what the run goes without.
    pub fn record_left_out(&self, work: &Workload, limits: &Limits, journal: &mut Journal) {
        for LeftOutStage { what, why, estimate } in &self.left_out {
            match estimate.as_ref().map(|estimate| estimate(work, limits)) {
                None => journal.leave_out(*what, why),
                Some(ResourceEstimate { seconds, reads, .. }) => {
                    let seconds = seconds / work.threads as f64;
                    journal.spare(*what, why, Saved::Stage { seconds, reads });
                }
            }
        }
    }
}

/// What an archive is written from.
#[derive(Debug, Serialize, Deserialize)]
pub enum Archived {
    /// A model, or a cloud.
    Content(Encoded),
    /// What is left of frames, within bounds.
    Frames(Bounds),
}

/// What fits into so many bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ByteLimitFit {
    /// Highest SH degree.
    pub sh_degree: usize,
    /// How many Gaussians of that degree.
    pub gaussians: usize,
}

/// What a run has found so far.
pub struct RunState<'a> {
    /// The scene that is compressed.
    pub scene: &'a Scene,
    /// What was asked for.
    pub request: &'a Request,
    /// The stages, and how many Gaussians each part of the run leaves.
    pub stages: &'a StageList,
    /// What goes into the summary.
    pub journal: Journal,
    /// The input for the summary. Its digest reads the whole input, so that it is computed once.
    pub input: Option<InputSummary>,
    /// Text of the file `recipe.toml` beside the result.
    pub recipe: String,
    /// Statistics of a stream, taken as it arrived.
    pub arrived: Option<Measured>,
    /// Statistics and scores.
    pub scored: Option<Arc<Scored>>,
    /// All Gaussians that may stay, the most important first.
    pub ranking: Option<Arc<Ranking>>,
    /// Number of Gaussians in the output, where it is asked for or has been found.
    pub target: Option<usize>,
    /// Numbers of Gaussians that fit the size on disk that was asked for, by falling SH degree.
    pub fits: Vec<ByteLimitFit>,
    /// A model without Gaussians that has what all results of this run share: SH degree, rule of merging.
    pub template: CompressedModel,
    /// What is left of the scene.
    pub result: CompressedModel,
    /// Number of Gaussians that refinement leaves of [`result`](RunState::result).
    pub wanted: usize,
    /// States of a search on the way to smaller sizes, from which the next size goes on.
    pub prune_steps: Option<PruneSteps<'a>>,
    /// Counts of merging.
    pub merge: Option<MergeSummary>,
    /// What a search has found.
    pub goal: Option<GoalSummary>,
    /// The encoded archive.
    pub archived: Option<Archived>,
    /// How close the archive is.
    pub archive: Option<ArchiveSummary>,
    /// Quality of the result, where it was measured.
    pub quality: Option<QualitySummary>,
    /// The summary, and where each Gaussian of the input is in the output, once the result is written.
    pub written: Option<(Summary, Vec<Option<u32>>)>,
}

impl<'a> RunState<'a> {
    /// Returns the state before the first stage.
    pub fn new(
        scene: &'a Scene,
        request: &'a Request,
        stages: &'a StageList,
        template: CompressedModel,
    ) -> RunState<'a> {
        RunState {
            scene,
            request,
            stages,
            journal: Journal::default(),
            input: None,
            recipe: String::new(),
            arrived: None,
            scored: None,
            ranking: None,
            target: None,
            fits: Vec::new(),
            result: template.clone(),
            template,
            wanted: 0,
            prune_steps: None,
            merge: None,
            goal: None,
            archived: None,
            archive: None,
            quality: None,
            written: None,
        }
    }

    /// Returns statistics and scores.
    ///
    /// # Errors
    /// An internal error where no stage has measured before.
    pub fn scored(&self) -> Result<Arc<Scored>> {
        self.scored.clone().ok_or_else(|| Error::internal("a stage needs scores before they were computed"))
    }

    /// Returns the ranking.
    ///
    /// # Errors
    /// An internal error where no stage has ranked before.
    pub fn ranking(&self) -> Result<Arc<Ranking>> {
        self.ranking.clone().ok_or_else(|| Error::internal("a stage needs the ranking before it was computed"))
    }

    /// Takes the model out of the state, to be changed.
    pub fn take_result(&mut self) -> CompressedModel {
        std::mem::replace(&mut self.result, self.template.clone())
    }
}
