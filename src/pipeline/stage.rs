//! Interface of the stages of a run, and the state that they pass on to one another.
//!
//! A stage is one file in [`stages`](super::stages): a type that implements [`Stage`], and a function that plans it.
//! The list `STAGES` there holds these functions in the order in which stages run.

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
use crate::statistics::pass::ScanResult;

/// Fraction of the Gaussians that ranking leaves in a search without refinement.
const SEARCH_RANK_FRACTION: f64 = 0.02;

/// Phase of a run that a stage belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// From frames to a ranking of all Gaussians.
    Rank,
    /// From a ranking to a model of one size. A search for a quality repeats these stages, once for every size it
    /// tries.
    Reduce,
    /// From the model to files.
    Write,
}

/// Inputs of the estimates of memory and time.
#[derive(Debug, Clone, Copy)]
pub struct EstimateInput<'a> {
    /// Size of the input and of its views.
    pub work: &'a Workload,
    /// Limits on the data that is in memory at a time.
    pub limits: &'a Limits,
    /// Fraction of the Gaussians in the output, above 0 and at most 1; 1 if it is not known in advance.
    pub left: f64,
    /// Statistics that were taken while a stream arrived.
    pub measured: MeasuredOnArrival,
}

/// A stage of a run, with its parameters.
pub trait Stage: Debug + Send + Sync {
    /// Returns the estimates of the stage, one for each part that progress lines name. Empty if the stage has nothing
    /// to do for such an input or takes a negligible amount.
    fn estimates(&self, input: EstimateInput<'_>) -> Vec<ResourceEstimate>;

    /// Returns the parameters that determine the duration of the stage, for display: "NAME: 3000 steps". Empty if there
    /// are none.
    fn parameters(&self) -> String {
        String::new()
    }

    /// Returns whether the stage may find nothing to do if views hardly change when the fraction `hardly_seen` of the
    /// Gaussians is removed. The shortest time of a run is estimated without such stages.
    fn may_be_skipped(&self, _input: EstimateInput<'_>, _hardly_seen: f64) -> bool {
        false
    }

    /// Returns the work that several processes can divide among themselves, one line per unit kind: "NAME: 12 blocks of
    /// Gaussians".
    fn shardable_units(&self, _scene: &Scene, _counts: &CountPlan) -> Vec<String> {
        Vec::new()
    }

    /// Checks, before any work, that the scene has the files that the stage needs.
    ///
    /// # Errors
    /// Fails if files are missing or too few.
    fn check(&self, _scene: &Scene) -> Result<()> {
        Ok(())
    }

    /// Runs the stage. It reads its input from `run`, stores its results there, and records in the journal its part of
    /// the summary. Results are cached under the stage's own key, so that an interrupted run continues from them.
    ///
    /// # Errors
    /// Fails if the input cannot be read, the output cannot be written, or the input cannot meet the request.
    fn run(&self, run: &mut RunState<'_>) -> Result<()>;
}

/// Kinds of statistics of a stream that were taken while it arrived.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MeasuredOnArrival {
    /// Whether the scan was done: statistics of every Gaussian at every frame.
    pub scanned: bool,
    /// Whether the visible contribution of every Gaussian was measured on views.
    pub seen: bool,
}

/// Statistics of the frames before scoring.
pub struct Measured {
    /// Statistics of every Gaussian from the scan.
    pub scanned: ScanResult,
    /// Visible contribution of every Gaussian, if views were rendered.
    pub seen: Option<VisibleContribution>,
}

impl Measured {
    /// Returns the kinds of statistics that were taken.
    pub fn kinds(&self) -> MeasuredOnArrival {
        MeasuredOnArrival { scanned: true, seen: self.seen.is_some() }
    }
}

/// Number of Gaussians that each part of a run leaves: ranking removes the first ones, refinement the rest in prune
/// steps.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CountPlan {
    /// Smallest fraction of all Gaussians with which refinement begins, if it removes the rest in prune steps. `None`:
    /// ranking alone removes Gaussians.
    pub refinement_starts_at: Option<f64>,
    /// Whether the number of Gaussians in the output is searched for.
    pub searches: bool,
}

impl CountPlan {
    /// Returns the number of Gaussians, of `all`, with which refinement begins if `wanted` are to stay.
    pub fn before_refinement(&self, wanted: usize, all: usize) -> usize {
        start_count(self.refinement_starts_at, wanted, all)
    }

    /// Returns the number of Gaussians, of `all`, that ranking leaves if `wanted` are to stay. A search ranks down to
    /// the number that its smallest size needs.
    pub fn after_ranking(&self, wanted: usize, all: usize) -> usize {
        let smallest =
            if self.refinement_starts_at.is_some() { 0 } else { (SEARCH_RANK_FRACTION * all as f64).ceil() as usize };
        self.before_refinement(if self.searches { smallest } else { wanted }, all)
    }

    /// Returns both counts as text for display, for a run from `all` Gaussians to `target`.
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
                "counts: ranking leaves {} or more, refinement removes the rest; the number that stays is found \
                 during the run",
                share(self.before_refinement(0, all))
            ),
            (None, None) => format!("counts: {alone} a number that is found during the run; refinement removes none"),
        }
    }
}

/// Function that returns the resource estimate of a stage for an input, within limits.
type Estimate = Box<dyn Fn(&Workload, &Limits) -> ResourceEstimate + Send + Sync>;

/// Stage that a run omits.
struct LeftOutStage {
    what: &'static str,
    why: String,
    /// Estimate of the omitted work.
    estimate: Option<Estimate>,
}

/// Stages of a run in their order, and the stages that it omits.
#[derive(Default)]
pub struct StageList {
    stages: Vec<(Phase, Box<dyn Stage>)>,
    left_out: Vec<LeftOutStage>,
    /// Numbers of Gaussians that ranking and refinement leave.
    pub counts: CountPlan,
    /// Whether the amount of work depends on results of stages, which widens the range of time estimates.
    is_open_ended: bool,
}

impl StageList {
    /// Appends a stage to the list.
    pub fn add(&mut self, phase: Phase, stage: impl Stage + 'static) {
        self.stages.push((phase, Box::new(stage)));
    }

    /// Adds the omitted work `what` with the reason `why`.
    pub fn leave_out(&mut self, what: &'static str, why: impl Into<String>) {
        self.left_out.push(LeftOutStage { what, why: why.into(), estimate: None });
    }

    /// Adds the omitted stage `what` with the reason `why`; `estimate` returns its cost.
    pub fn leave_out_stage(
        &mut self,
        what: &'static str,
        why: impl Into<String>,
        estimate: impl Fn(&Workload, &Limits) -> ResourceEstimate + Send + Sync + 'static,
    ) {
        self.left_out.push(LeftOutStage { what, why: why.into(), estimate: Some(Box::new(estimate)) });
    }

    /// Marks the amount of work as dependent on results of stages.
    pub fn set_open_ended(&mut self) {
        self.is_open_ended = true;
    }

    /// Returns whether the amount of work depends on results of stages.
    pub fn is_open_ended(&self) -> bool {
        self.is_open_ended
    }

    /// Returns all stages.
    pub fn all(&self) -> impl Iterator<Item = &dyn Stage> {
        self.stages.iter().map(|(_, stage)| &**stage)
    }

    /// Returns the stages of `phase`.
    pub fn in_phase(&self, phase: Phase) -> impl Iterator<Item = &dyn Stage> {
        self.stages.iter().filter(move |(stage_phase, _)| *stage_phase == phase).map(|(_, stage)| &**stage)
    }

    /// Runs the stages of `phase` in order.
    ///
    /// # Errors
    /// Fails if a stage fails; later stages do not run then.
    pub fn run(&self, phase: Phase, run: &mut RunState<'_>) -> Result<()> {
        self.in_phase(phase).try_for_each(|stage| stage.run(run))
    }

    /// Returns the omitted stages for display, one line each.
    pub fn left_out(&self) -> impl Iterator<Item = String> {
        self.left_out.iter().map(|left| format!("left out: {} ({})", left.what, left.why))
    }

    /// Records the omitted stages in the journal, with the saved time and reads where an estimate exists.
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

/// Content of an archive.
#[derive(Debug, Serialize, Deserialize)]
pub enum Archived {
    /// Encoded model or point cloud.
    Content(Encoded),
    /// Error bounds within which the frames are stored.
    Frames(Bounds),
}

/// Number of Gaussians that fits a byte limit at one SH degree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ByteLimitFit {
    /// Highest SH degree of the result.
    pub sh_degree: usize,
    /// Number of Gaussians that fits at this degree.
    pub gaussians: usize,
}

/// State of a run: its inputs and the results of its stages so far.
pub struct RunState<'a> {
    /// Scene that is compressed.
    pub scene: &'a Scene,
    /// Request of the user.
    pub request: &'a Request,
    /// Stages of the run, and the numbers of Gaussians that its parts leave.
    pub stages: &'a StageList,
    /// Records for the summary.
    pub journal: Journal,
    /// Description of the input for the summary. Its digest reads the whole input, so it is computed once.
    pub input: Option<InputSummary>,
    /// Text of the file `recipe.toml` beside the result.
    pub recipe: String,
    /// Statistics of a stream that were taken while it arrived.
    pub arrived: Option<Measured>,
    /// Statistics and scores of all Gaussians.
    pub scored: Option<Arc<Scored>>,
    /// Ranking of all Gaussians that may stay, most important first.
    pub ranking: Option<Arc<Ranking>>,
    /// Number of Gaussians in the output, if it was requested or has been found.
    pub target: Option<usize>,
    /// Numbers of Gaussians that fit the requested size on disk, in order of decreasing SH degree.
    pub fits: Vec<ByteLimitFit>,
    /// Model without Gaussians that holds the settings shared by all results of this run: SH degree, merge parameters.
    pub template: CompressedModel,
    /// Compressed model so far.
    pub result: CompressedModel,
    /// Number of Gaussians of [`result`](RunState::result) that refinement leaves.
    pub wanted: usize,
    /// Refinement state of a search after its prune steps, from which the next smaller size continues.
    pub prune_steps: Option<PruneSteps<'a>>,
    /// Counts of the merge stage.
    pub merge: Option<MergeSummary>,
    /// Result of the search for a quality.
    pub goal: Option<GoalSummary>,
    /// Content of the archive, if one is written.
    pub archived: Option<Archived>,
    /// Quality and size of the archive.
    pub archive: Option<ArchiveSummary>,
    /// Quality of the result, where it was measured.
    pub quality: Option<QualitySummary>,
    /// Summary, and the index of every input Gaussian in the output; set once the result is written.
    pub written: Option<(Summary, Vec<Option<u32>>)>,
}

impl<'a> RunState<'a> {
    /// Returns the state of a run before its first stage.
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
    /// Fails with an internal error if no earlier stage has computed them.
    pub fn scored(&self) -> Result<Arc<Scored>> {
        self.scored.clone().ok_or_else(|| Error::internal("a stage needs scores before they were computed"))
    }

    /// Returns the ranking.
    ///
    /// # Errors
    /// Fails with an internal error if no earlier stage has computed it.
    pub fn ranking(&self) -> Result<Arc<Ranking>> {
        self.ranking.clone().ok_or_else(|| Error::internal("a stage needs the ranking before it was computed"))
    }

    /// Takes the model out of the state so that a stage can change it; leaves the template.
    pub fn take_result(&mut self) -> CompressedModel {
        std::mem::replace(&mut self.result, self.template.clone())
    }
}
