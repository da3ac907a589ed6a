//! Interface of the stages of a run, and the state of the run, through which stages pass on their results.
//!
//! A stage is one file in [`stages`](super::stages): a type that implements [`Stage`], and a function that adds it to
//! the plan of a run. The list `STAGES` in that module holds these functions in the order in which stages run.

use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::request::Request;
use super::summary::{ArchiveSummary, GoalSummary, InputSummary, MergeSummary, Summary};
use crate::archive::EncodedArchive;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::journal::records::QualitySummary;
use crate::journal::records::SavedCost;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::outputs::bounds::ErrorBounds;
use crate::pruning::Ranking;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::score::Scored;
use crate::refinement::prune_steps::PrunedModels;
use crate::refinement::{RefineStage, start_count};
use crate::scene::Scene;
use crate::statistics::pass::ScanResult;

/// In a run that searches for the smallest model with a requested quality, the last pruning round leaves as many
/// Gaussians as in a run with this fraction of the Gaussians as the target.
const SEARCH_RANK_FRACTION: f64 = 0.02;

/// Phase of a run to which a stage belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Stages that read the frames of the input and make a ranking of all Gaussians.
    Rank,
    /// Stages that make a compressed model with a given number of Gaussians from the ranking. A search for the smallest
    /// model with a requested quality repeats these stages, once for every number of Gaussians that it tries.
    Reduce,
    /// Stages that turn the compressed model into output files: quantization, measurement of the quality, and writing.
    Write,
}

/// Quantities on which the estimates of a stage's memory, time and reads depend.
#[derive(Debug, Clone, Copy)]
pub struct EstimateInput<'a> {
    /// Sizes of the input and of its views.
    pub work: &'a Workload,
    /// Limits on what stages keep in memory at a time, such as numbers of frames and views.
    pub limits: &'a Limits,
    /// Number of Gaussians in the output divided by that in the input, above 0 and at most 1; 1 if the number is not
    /// known in advance.
    pub output_fraction: f64,
    /// Kinds of statistics that were already computed while the input, a stream, arrived.
    pub measured: MeasuredOnArrival,
}

/// Stage of a run, such as the scan or merging. A type that implements this trait holds the parameters of its stage.
pub trait Stage: Debug + Send + Sync {
    /// Returns the estimates of the memory, time and reads of the stage, one for each part of the stage that is
    /// reported under a name of its own. Empty if the stage has nothing to do for the input, or needs only negligible
    /// memory and time.
    fn estimates(&self, input: EstimateInput<'_>) -> Vec<ResourceEstimate>;

    /// Returns the parameters that determine the duration of the stage, as text for display, such as "NAME: 3000
    /// steps". Empty if there are none.
    fn parameters(&self) -> String {
        String::new()
    }

    /// Returns whether the stage is optional: it only reports something, such as the quality of the result, and a run
    /// without enough memory for the stage omits it.
    fn is_optional(&self) -> bool {
        false
    }

    /// Measures the quality of the output of the run `_run`. `_path` is the temporary path to which the output has been
    /// written. Adds the time of the measurement to `_journal`. Returns `None` for stages that do not measure outputs.
    ///
    /// # Errors
    /// Fails if the output or the input cannot be read.
    fn measure_output(
        &self,
        _run: &RunState<'_>,
        _path: &Path,
        _journal: &mut Journal,
    ) -> Result<Option<QualitySummary>> {
        Ok(None)
    }

    /// Returns the work of the stage that several processes can divide among themselves, as lines of text: one line per
    /// kind of unit, such as "NAME: 12 blocks of Gaussians". `_counts` is the plan of how many Gaussians ranking and
    /// refinement leave.
    fn describe_shardable_work(&self, _scene: &Scene, _counts: &CountPlan) -> Vec<String> {
        Vec::new()
    }

    /// Checks, before any work, that the stage can run on the scene: the files that it needs must exist, and the output
    /// format must be able to store the scene.
    ///
    /// # Errors
    /// Fails if files are missing or too few, or if the output format cannot store the scene.
    fn check(&self, _scene: &Scene) -> Result<()> {
        Ok(())
    }

    /// Runs the stage: takes its input from `run`, stores its results in `run`, and adds entries to the journal of
    /// `run` (log from which the summary is made). Results are cached under a key of the stage, so that a run that is
    /// repeated after an interruption does not compute them again.
    ///
    /// # Errors
    /// Fails if the input cannot be read, the output cannot be written, or the input cannot meet the request.
    fn run(&self, run: &mut RunState<'_>) -> Result<()>;
}

/// Kinds of statistics of the Gaussians that were already computed while the input, a stream, arrived. Default, for all
/// other inputs: none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MeasuredOnArrival {
    /// Whether the scan of all frames was done. It gives all statistics of the Gaussians except their visible
    /// contributions.
    pub scanned: bool,
    /// Whether the visible contribution of every Gaussian (Σ alpha · transmittance over pixels) was measured on
    /// rendered views.
    pub visible_contribution: bool,
}

/// Statistics of all Gaussians, from which their scores are computed.
pub struct Measured {
    /// Statistics of every Gaussian from the scan of all frames.
    pub scanned: ScanResult,
    /// Visible contribution of every Gaussian to renders, if views were rendered.
    pub visible_contribution: Option<VisibleContribution>,
}

impl Measured {
    /// Returns the kinds of statistics that were computed.
    pub fn measured_statistics(&self) -> MeasuredOnArrival {
        MeasuredOnArrival { scanned: true, visible_contribution: self.visible_contribution.is_some() }
    }
}

/// Result of [`compress_scene`](super::compress_scene), besides the files that it wrote.
#[derive(Debug)]
pub struct CompressedScene {
    /// Summary of the run.
    pub summary: Summary,
    /// Index in the output of every input Gaussian; `None` if the Gaussian was removed. Merged Gaussians have the index
    /// of their proxy.
    pub index_map: Vec<Option<u32>>,
}

/// Plan of how many Gaussians ranking and refinement leave. Ranking removes some of the Gaussians. Refinement then
/// removes more of them, down to the target, in prune steps (removals of the lowest-ranked Gaussians between
/// optimization steps).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CountPlan {
    /// Largest fraction of the Gaussians with which refinement begins ([`RefineStage::max_start`]), if it removes
    /// Gaussians in prune steps until the target is reached. `None` if only ranking removes Gaussians.
    pub max_start: Option<f64>,
    /// Whether the run searches for the number of Gaussians in the output.
    pub searches: bool,
}

impl CountPlan {
    /// Creates the plan of a run with the refinement stage `refine`, if any. `searches`: as in [`CountPlan::searches`].
    pub fn new(refine: Option<&RefineStage>, searches: bool) -> CountPlan {
        CountPlan { max_start: refine.and_then(|refine| refine.prunes.then_some(refine.max_start)), searches }
    }

    /// Returns the number of Gaussians with which refinement begins. `target_count`: number of Gaussians in the output.
    /// `input_count`: number of Gaussians in the input.
    pub fn count_before_refinement(&self, target_count: usize, input_count: usize) -> usize {
        self.max_start.map_or(target_count, |max_start| start_count(target_count, input_count, max_start))
    }

    /// Returns the number of Gaussians that ranking leaves. `target_count`: number of Gaussians in the output.
    /// `input_count`: number of Gaussians in the input. A search for the smallest model with a requested quality tries
    /// several models but ranks only once. In such a run the result is the number that the smallest tried model needs,
    /// whatever `target_count` is.
    pub fn count_after_ranking(&self, target_count: usize, input_count: usize) -> usize {
        let smallest = (SEARCH_RANK_FRACTION * input_count as f64).ceil() as usize;
        self.count_before_refinement(if self.searches { smallest } else { target_count }, input_count)
    }

    /// Returns a line of text for display: how many Gaussians are left after ranking and how many refinement then
    /// removes. `input_count` is the number of Gaussians in the input, and `target` the number in the output, if known.
    /// `merges` tells whether survivors (Gaussians that are not removed) are merged.
    pub(super) fn text(&self, target: Option<usize>, input_count: usize, merges: bool) -> String {
        let share = |count: usize| {
            format!("{count} of {input_count} Gaussians ({:.0}%)", 100.0 * count as f64 / input_count.max(1) as f64)
        };
        let alone = if merges { "ranking and merging leave" } else { "ranking leaves" };
        match (target, self.max_start.is_some()) {
            (Some(target_count), true) => {
                let ranked = self.count_before_refinement(target_count, input_count);
                let removed = ranked - target_count;
                format!(
                    "counts: ranking leaves {}, refinement removes {removed} of them; {target_count} stay",
                    share(ranked)
                )
            }
            (Some(target_count), false) => format!("counts: {alone} {}; refinement removes none", share(target_count)),
            (None, true) => {
                "counts: ranking leaves more than are to stay, refinement removes the rest; the number that \
                             stays is found during the run"
                    .to_owned()
            }
            (None, false) => format!("counts: {alone} a number that is found during the run; refinement removes none"),
        }
    }
}

/// Function that returns the resource estimate (memory, time, reads) of a stage, from the sizes of the input and the
/// limits on memory use.
type Estimate = Box<dyn Fn(&Workload, &Limits) -> ResourceEstimate + Send + Sync>;

/// Stage or step that a run omits, with the reason.
struct LeftOutStage {
    name: &'static str,
    why: String,
    /// Function that estimates the memory, time and reads that omitting the stage saves; `None` if they are not known.
    estimate: Option<Estimate>,
}

/// Stages of a run in the order in which they run, and the stages that it omits.
#[derive(Default)]
pub struct StageList {
    stages: Vec<(Phase, Box<dyn Stage>)>,
    left_out: Vec<LeftOutStage>,
    /// Plan of how many Gaussians ranking and refinement leave.
    pub counts: CountPlan,
}

impl StageList {
    /// Appends `stage` to the list, as a stage of `phase`.
    pub fn add(&mut self, phase: Phase, stage: impl Stage + 'static) {
        self.stages.push((phase, Box::new(stage)));
    }

    /// Records that the run omits the work `name` (text for display) for the reason `why`. The memory and time that
    /// this saves are not known.
    pub fn leave_out(&mut self, name: &'static str, why: impl Into<String>) {
        self.left_out.push(LeftOutStage { name, why: why.into(), estimate: None });
    }

    /// Records that the run omits the stage `name` (text for display) for the reason `why`. `estimate` returns the
    /// memory, time and reads that the omission saves.
    pub fn leave_out_stage(
        &mut self,
        name: &'static str,
        why: impl Into<String>,
        estimate: impl Fn(&Workload, &Limits) -> ResourceEstimate + Send + Sync + 'static,
    ) {
        self.left_out.push(LeftOutStage { name, why: why.into(), estimate: Some(Box::new(estimate)) });
    }

    /// Removes the optional stages, which only report something (see [`Stage::is_optional`]).
    pub fn remove_optional(&mut self) {
        self.stages.retain(|(_, stage)| !stage.is_optional());
    }

    /// Returns all stages in the order in which they run.
    pub fn all(&self) -> impl Iterator<Item = &dyn Stage> {
        self.stages.iter().map(|(_, stage)| &**stage)
    }

    /// Returns the stages of `phase` in the order in which they run.
    pub fn in_phase(&self, phase: Phase) -> impl Iterator<Item = &dyn Stage> {
        self.stages.iter().filter(move |(stage_phase, _)| *stage_phase == phase).map(|(_, stage)| &**stage)
    }

    /// Runs the stages of `phase` in order on the state `run`.
    ///
    /// # Errors
    /// Fails if a stage fails; later stages do not run then.
    pub fn run(&self, phase: Phase, run: &mut RunState<'_>) -> Result<()> {
        self.in_phase(phase).try_for_each(|stage| stage.run(run))
    }

    /// Returns one line of text for display per omitted stage, with the reason.
    pub fn omitted_stages_text(&self) -> impl Iterator<Item = String> {
        self.left_out.iter().map(|stage| format!("left out: {} ({})", stage.name, stage.why))
    }

    /// Adds the omitted stages with their reasons to `journal`, the log of the run. If an estimate exists for a stage,
    /// also adds the time and the reads that are saved, for an input of the sizes `work` and the memory limits
    /// `limits`.
    pub fn record_left_out(&self, work: &Workload, limits: &Limits, journal: &mut Journal) {
        for LeftOutStage { name, why, estimate } in &self.left_out {
            match estimate.as_ref().map(|estimate| estimate(work, limits)) {
                None => journal.leave_out(*name, why),
                Some(ResourceEstimate { seconds, reads, .. }) => {
                    let seconds = seconds / work.threads as f64;
                    journal.leave_out_with_saving(*name, why, SavedCost::Stage { seconds, reads });
                }
            }
        }
    }
}

/// Content of an archive (compact file of the result, with quantized values) that has not been written to the output
/// yet.
#[derive(Debug, Serialize, Deserialize)]
pub enum PreparedArchive {
    /// Encoded model or point cloud, ready to be written.
    Content(EncodedArchive),
    /// Error bounds of the values in an archive of frames, which stores the Gaussians at every frame instead of a
    /// model. The frames are computed and rounded within these bounds only when the archive is written.
    Frames(ErrorBounds),
}

/// Number of Gaussians with which an output of a given SH degree fits the requested size on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ByteLimitFit {
    /// SH degree of the output.
    pub sh_degree: usize,
    /// Number of Gaussians in the largest output of this SH degree that fits.
    pub gaussians: usize,
}

/// State of a run: its inputs, and the results of the stages that have run.
pub struct RunState<'a> {
    /// Open input that is compressed, with its cameras.
    pub scene: &'a Scene,
    /// Request of the user.
    pub request: &'a Request,
    /// Stages of the run, with the plan ([`CountPlan`]) of how many Gaussians remain after ranking and after
    /// refinement.
    pub stages: &'a StageList,
    /// Journal of the run so far: records of the stages, omitted work and notes. The summary is made from it.
    pub journal: Journal,
    /// Description of the input for the summary. Computed only once, because its digest reads the whole input.
    pub input: Option<InputSummary>,
    /// Content of the file `recipe.toml`, which is written beside the result and holds all parameters of the run.
    pub recipe: String,
    /// Statistics of the Gaussians that were already computed while the input, a stream, arrived.
    pub arrived: Option<Measured>,
    /// Statistics of all Gaussians, and the selection of the survivors (Gaussians that are not removed) by scores.
    pub scored: Option<Arc<Scored>>,
    /// Ranking of all Gaussians except those that are always dropped, most important first.
    pub ranking: Option<Arc<Ranking>>,
    /// Number of Gaussians in the output, if it was requested or has been found.
    pub target: Option<usize>,
    /// For each SH degree that the output may have, in decreasing order: the number of Gaussians with which the output
    /// fits the requested size on disk. Empty if no size is requested.
    pub counts_within_bytes: Vec<ByteLimitFit>,
    /// Model without Gaussians that holds the settings of all models of this run, such as SH degree and merge
    /// parameters. Compressed models are made from it by adding Gaussians.
    pub template: CompressedModel,
    /// Compressed model in the state in which the last stage left it.
    pub result: CompressedModel,
    /// Number of repetitions of the reduction ([`Phase::Reduce`]) that stages have asked for so far.
    pub repeats: usize,
    /// Number of Gaussians that refinement is to leave in the model [`result`](RunState::result).
    pub refine_to: usize,
    /// Refined models after prune steps (removals of the lowest-ranked Gaussians), from which the refinement of a
    /// smaller model continues. Present only in a search for the smallest model with a requested quality.
    pub prune_steps: Option<PrunedModels<'a>>,
    /// Numbers of Gaussians that the merge stage merged, if it ran.
    pub merge: Option<MergeSummary>,
    /// Result of the search for the smallest model that has the requested quality (minimum PSNR or maximum loss of
    /// PSNR). `None` if no quality was requested, or before the search.
    pub goal: Option<GoalSummary>,
    /// Content of the archive, if the output is an archive.
    pub archived: Option<PreparedArchive>,
    /// Quality and size of the archive, if the output is an archive.
    pub archive: Option<ArchiveSummary>,
    /// Quality of the result, if it was measured.
    pub quality: Option<QualitySummary>,
    /// Result of the run. Set once the result is written.
    pub written: Option<CompressedScene>,
}

impl<'a> RunState<'a> {
    /// Returns the state of a run before its first stage. `template` is a model without Gaussians that holds the
    /// settings of all models of the run.
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
            counts_within_bytes: Vec::new(),
            result: template.clone(),
            template,
            repeats: 0,
            refine_to: 0,
            prune_steps: None,
            merge: None,
            goal: None,
            archived: None,
            archive: None,
            quality: None,
            written: None,
        }
    }

    /// Returns the statistics of all Gaussians, and the selection of the survivors (Gaussians that are not removed) by
    /// scores.
    ///
    /// # Errors
    /// Fails with an internal error if no earlier stage has computed them.
    pub fn scored(&self) -> Result<Arc<Scored>> {
        self.scored.clone().ok_or_else(|| Error::internal("a stage needs scores before they were computed"))
    }

    /// Returns the ranking of all Gaussians except those that are always dropped.
    ///
    /// # Errors
    /// Fails with an internal error if no earlier stage has computed it.
    pub fn ranking(&self) -> Result<Arc<Ranking>> {
        self.ranking.clone().ok_or_else(|| Error::internal("a stage needs the ranking before it was computed"))
    }

    /// Takes the compressed model out of the state and returns it, so that a stage can change it. Leaves the template,
    /// a model without Gaussians, in its place.
    pub fn take_result(&mut self) -> CompressedModel {
        std::mem::replace(&mut self.result, self.template.clone())
    }
}
