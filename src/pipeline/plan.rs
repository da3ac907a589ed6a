//! The plan of a run: its stages with their parameters, the omitted stages with reasons, and the numbers of Gaussians
//! that ranking and refinement leave. Everything is decided in this module, before any work.

use std::iter;
use std::path::Path;

use super::ids::{check_ids, parse_ids};
use super::planning::{InputMeta, MemoryFallback, OptionalWork, Planning};
use super::request::{Goal, PruneOrMerge, Quality, Request, decibels};
use super::search::SearchStage;
use super::stage::{CountPlan, EstimateInput, MeasuredOnArrival, Phase, Stage, StageList};
use super::stages::STAGES;
use super::stages::measure::MeasureStages;
use super::stages::write::WriteStage;
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::memory_plan::{MemoryPlan, ResourceEstimate, Workload};
use crate::models::trajectories::check_frames_output;
use crate::outputs::kind::OutputKind;
use crate::pruning::score::UserOverrides;
use crate::pruning::visibility::VisibilityStage;
use crate::refinement::RefineStage;
use crate::scene::Scene;

/// Plan of a run: its stages with their parameters, and the stages that it omits.
pub struct RunPlan {
    /// Stages in the order in which they run, and the omitted stages.
    pub(super) stages: StageList,
    /// Stages that compute the statistics and scores of the Gaussians. For a stream, the statistics are computed while
    /// it arrives.
    pub measure: MeasureStages,
    /// Stage that writes the result; `None` if the run only measures and scores.
    pub output: Option<WriteStage>,
    /// Search that repeats the stages of [`Phase::Reduce`] with different numbers of Gaussians until a requested
    /// quality is met; `None` without such a request.
    pub search: Option<SearchStage>,
    /// Exact number of Gaussians in the output, if requested.
    pub target: Option<usize>,
    gaussians: usize,
    merges: bool,
    refine: Option<RefineStage>,
    fallback: MemoryFallback,
}

impl RunPlan {
    /// Returns the plan of a run for `request`, without regard to its memory limit.
    ///
    /// # Errors
    /// Fails if a parameter of the recipe is out of range, if the input has fewer Gaussians than the target, if an id
    /// that the request names does not exist in the input, or if options exclude each other.
    pub fn new(request: &Request, input: InputMeta) -> Result<RunPlan> {
        RunPlan::with_fallback(request, input, MemoryFallback::Nothing, OptionalWork::ALL)
    }

    /// Returns a plan of a run for `request` whose input is a sequence of frames that has not been read yet. Only the
    /// output of this plan is valid: the number of Gaussians is not known. `frames`: number of frames, if known.
    ///
    /// # Errors
    /// Fails like [`RunPlan::new`], except for errors that depend on the number of Gaussians. Also fails if the kind of output cannot store a sequence of `frames` frames.
    pub fn before_reading(request: &Request, frames: Option<usize>) -> Result<RunPlan> {
        [&request.keep_ids, &request.drop_ids].into_iter().flatten().try_for_each(|ids| check_ids(ids))?;
        let named = Request { keep_ids: None, drop_ids: None, ..request.clone() };
        let plan = RunPlan::new(&named, InputMeta::from_stream(u32::MAX as usize, true))?;
        if let Some(WriteStage { kind, .. }) = plan.output {
            // A stream may turn out to have only one frame.
            check_frames_output(frames.unwrap_or(1), kind, &request.output)?;
        }
        Ok(plan)
    }

    /// Returns the plan of a run that only runs `measure`, the stages that compute the statistics and scores of the
    /// Gaussians.
    pub fn measure_only(measure: MeasureStages, input: InputMeta) -> RunPlan {
        let mut plan = RunPlan::empty(measure.clone(), input.gaussians);
        plan.stages.add(Phase::Rank, measure);
        plan
    }

    /// Returns the plan of a run that stays within the memory limit of `request`. If full refinement does not fit,
    /// tries smaller plans in this order, and returns the first one that fits:
    /// - refinement begins with fewer Gaussians;
    /// - also, parameter deltas (values that refinement adds to stored parameters) are constant in time;
    /// - also, SH coefficients above degree 0 are not refined;
    /// - nothing is refined.
    ///
    /// If none of them fits, returns the plan that takes the least memory. It is refused later with an error that names
    /// the smallest sufficient limit. The plan includes the measurement of the quality of the result, and the refinement
    /// of a result for the quantization of its archive, if there is memory for them.
    ///
    /// # Errors
    /// Fails in the cases in which [`RunPlan::new`] fails.
    pub fn within_memory(request: &Request, input: InputMeta, work: &Workload) -> Result<RunPlan> {
        let fits = |plan: &RunPlan| {
            MemoryPlan::fits_budget(*work, request.input.memory, |work, limits| plan.estimates(work, limits))
        };
        let plan = RunPlan::refining_within_memory(request, input, work, fits)?;
        for archive_refinement in [true, false] {
            let more = OptionalWork { archive_refinement, ..OptionalWork::ALL };
            let with_more = RunPlan::with_fallback(request, input, plan.fallback, more)?;
            if fits(&with_more) {
                return Ok(with_more);
            }
        }
        Ok(plan)
    }

    /// Returns the plan of a run that stays within the memory limit, with as much refinement as fits (see
    /// [`RunPlan::within_memory`]). The plan has no [`OptionalWork`]. `fits` returns whether a plan
    /// stays within the memory limit.
    fn refining_within_memory(
        request: &Request,
        input: InputMeta,
        work: &Workload,
        fits: impl Fn(&RunPlan) -> bool,
    ) -> Result<RunPlan> {
        let with = |fallback| RunPlan::with_fallback(request, input, fallback, OptionalWork::NONE);
        let least =
            |plan: &RunPlan| MemoryPlan::closest(*work, 1, |work, limits| plan.estimates(work, limits)).peak_bytes();
        let full_plan = with(MemoryFallback::Nothing)?;
        if full_plan.refine.is_none() || fits(&full_plan) {
            return Ok(full_plan);
        }
        let full_bytes = least(&full_plan);
        let small_start = with(MemoryFallback::SmallStart { required_bytes: full_bytes })?;
        let small_start_bytes = least(&small_start);
        if small_start_bytes < full_bytes && fits(&small_start) {
            return Ok(small_start);
        }
        let constant = with(MemoryFallback::ConstantInTime { required_bytes: small_start_bytes })?;
        let constant_bytes = least(&constant);
        if constant_bytes < small_start_bytes && fits(&constant) {
            return Ok(constant);
        }
        let low_degree = with(MemoryFallback::WithoutHarmonics { required_bytes: constant_bytes })?;
        if work.sh_degree > 0 && fits(&low_degree) {
            return Ok(low_degree);
        }
        let unrefined = with(MemoryFallback::WithoutRefinement { required_bytes: least(&low_degree) })?;
        if fits(&unrefined) {
            return Ok(unrefined);
        }
        // None fits: the error names the memory of the smallest plan.
        let smaller = |a: RunPlan, b: RunPlan| if least(&b) < least(&a) { b } else { a };
        Ok([low_degree, constant, small_start, full_plan].into_iter().fold(unrefined, smaller))
    }

    fn empty(measure: MeasureStages, gaussians: usize) -> RunPlan {
        RunPlan {
            stages: StageList::default(),
            measure,
            output: None,
            search: None,
            target: None,
            gaussians,
            merges: false,
            refine: None,
            fallback: MemoryFallback::Nothing,
        }
    }

    fn with_fallback(
        request: &Request,
        input: InputMeta,
        fallback: MemoryFallback,
        optional: OptionalWork,
    ) -> Result<RunPlan> {
        let Request { recipe, only, .. } = request;
        let target = request.target.map(|target| target.resolve_count(input.gaussians)).transpose()?;
        recipe.validate().map_err(Error::usage)?;
        let output = checked_output(request, input.default_output_kind)?;
        let ids = |spec: &Option<String>| spec.as_deref().map_or(Ok(Vec::new()), |ids| parse_ids(ids, input.gaussians));
        let user =
            UserOverrides { keep: ids(&request.keep_ids)?, drop: ids(&request.drop_ids)?, keep_box: request.keep_box };
        let prunes = *only != PruneOrMerge::Merge;
        let renders_views = VisibilityStage::from_recipe(&recipe.scan, input.has_cameras).is_some();
        let mut planning = Planning {
            request,
            input,
            output,
            target,
            user,
            renders_views,
            prunes,
            merges: false,
            refine: None,
            measures_quality: optional.quality,
            refines_archive: optional.archive_refinement,
            fallback,
        };
        let refine = RefineStage::from_recipe(recipe, planning.target_fraction(), planning.prunes_by_views());
        // Without a target the memory is that of all Gaussians, so a smaller start saves nothing.
        let starts_smaller = fallback != MemoryFallback::Nothing && target.is_some();
        let refine = refine.map(|refine| if starts_smaller { refine.with_small_start() } else { refine });
        planning.refine = refine.and_then(|refine| match fallback {
            MemoryFallback::Nothing | MemoryFallback::SmallStart { .. } => Some(refine),
            MemoryFallback::ConstantInTime { .. } => Some(refine.with_time_independent_deltas()),
            MemoryFallback::WithoutHarmonics { .. } => {
                Some(refine.with_time_independent_deltas().with_fixed_higher_sh())
            }
            MemoryFallback::WithoutRefinement { .. } => None,
        });
        // For the same number of Gaussians, refinement keeps more quality than merging. Prune steps of refinement rank
        // anew, so the order does not matter.
        let prunes_alone =
            *only == PruneOrMerge::Prune || request.goal.is_some() || (planning.refine.is_some() && prunes);
        planning.merges = !prunes_alone && !recipe.merge.passes.is_empty();

        let mut plan = RunPlan::empty(MeasureStages::from_planning(&planning), input.gaussians);
        plan.search = SearchStage::from_planning(&planning);
        plan.output = Some(WriteStage::from_planning(&planning));
        plan.target = target;
        plan.stages.counts = CountPlan::new(planning.refine.as_ref(), plan.search.is_some());
        (plan.merges, plan.refine, plan.fallback) = (planning.merges, planning.refine.clone(), fallback);
        STAGES.iter().for_each(|add| add(&planning, &mut plan.stages));
        Ok(plan)
    }

    /// Returns the resource estimates (memory, time, reads) of all stages of the plan.
    pub fn estimates(&self, work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
        self.remaining_estimates(work, limits, MeasuredOnArrival::default())
    }

    /// Returns the resource estimates (memory, time, reads) of the stages that are still to run. `measured` states
    /// which kinds of statistics were already computed while the input, a stream, arrived; their computation is left
    /// out.
    pub fn remaining_estimates(
        &self,
        work: &Workload,
        limits: &Limits,
        measured: MeasuredOnArrival,
    ) -> Vec<ResourceEstimate> {
        self.estimates_where(self.estimate_input(work, limits, measured), |_| true)
    }

    /// Returns the resource estimates (memory, time, reads) of all stages that the run needs for its result. Leaves out
    /// optional stages, which only report something, such as the quality of the result.
    pub fn required_estimates(&self, work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
        let input = self.estimate_input(work, limits, MeasuredOnArrival::default());
        self.estimates_where(input, |stage| !stage.is_optional())
    }

    fn estimate_input<'a>(
        &self,
        work: &'a Workload,
        limits: &'a Limits,
        measured: MeasuredOnArrival,
    ) -> EstimateInput<'a> {
        let output_fraction = self.target.map_or(1.0, |target| target as f64 / self.gaussians.max(1) as f64).min(1.0);
        EstimateInput { work, limits, output_fraction, measured }
    }

    fn estimates_where(&self, input: EstimateInput<'_>, runs: impl Fn(&dyn Stage) -> bool) -> Vec<ResourceEstimate> {
        let phase_estimates = |phase: Phase| -> Vec<ResourceEstimate> {
            self.stages.in_phase(phase).filter(|stage| runs(*stage)).flat_map(|stage| stage.estimates(input)).collect()
        };
        let reduce = match &self.search {
            Some(search) => vec![search.estimate(input, &phase_estimates(Phase::Reduce))],
            None => phase_estimates(Phase::Reduce),
        };
        [phase_estimates(Phase::Rank), reduce, phase_estimates(Phase::Write)].concat()
    }

    /// Returns one line of text for each divisible stage (a stage whose work several processes can share). A line holds
    /// the name under which the stage caches its results, and its number of units of work, such as blocks of Gaussians
    /// or views.
    pub fn describe_shardable_work(&self, scene: &Scene) -> Vec<String> {
        self.stages.all().flat_map(|stage| stage.describe_shardable_work(scene, &self.stages.counts)).collect()
    }

    /// Returns a line of text for display that states how many Gaussians ranking and refinement leave.
    pub fn planned_counts_text(&self) -> String {
        self.stages.counts.text(self.target, self.gaussians, self.merges)
    }

    /// Returns the plan as text for display: numbers of Gaussians that ranking and refinement leave, parameters of the
    /// stages, and omitted stages.
    pub fn text(&self) -> String {
        let parameters = self.stages.all().map(|stage| stage.parameters()).filter(|text| !text.is_empty());
        let search = self.search.as_ref().map(SearchStage::parameters);
        let left_out = self.stages.omitted_stages_text();
        let lines = parameters.chain(search).chain(left_out).map(|line| format!("\n  {line}"));
        self.planned_counts_text() + &lines.collect::<String>()
    }

    /// Checks that a run which reads the model `input` and the cameras `cameras` may write its output. Called before the
    /// input is opened.
    ///
    /// # Errors
    /// Fails if the output exists already or cannot be created, or is the input or the camera file.
    pub fn check_target(&self, input: &Path, cameras: Option<&Path>) -> Result<()> {
        let Some(output) = &self.output else { return Ok(()) };
        // A result in a folder replaces only files of an earlier result, so cameras may lie there.
        let cameras = cameras.filter(|cameras| cameras.is_file() && !output.kind.is_folder());
        output.check_target(&iter::once(input).chain(cameras).collect::<Vec<_>>())
    }

    /// Checks, before any work, that the stages of the plan can run on the scene: the files that they need must exist,
    /// and the output format must be able to store the scene.
    ///
    /// # Errors
    /// Fails if files are missing or too few, or if the output format cannot store the scene.
    pub fn check(&self, scene: &Scene) -> Result<()> {
        if let Some(search) = &self.search {
            search.check(scene)?;
        }
        self.stages.all().try_for_each(|stage| stage.check(scene))
    }
}

/// Returns the kind of output (such as archive or model folder) that `request` asks for. `default_kind` is the kind to
/// use if neither an option nor the name of the output determines one.
///
/// # Errors
/// Fails if options exclude each other, or if no option states the kind and the name of the output ends like a kind of
/// file that the program does not write.
fn checked_output(request: &Request, default_kind: OutputKind) -> Result<OutputKind> {
    let Request { goal, archive_psnr, .. } = request;
    if goal.is_some() && (request.only == PruneOrMerge::Merge || request.target.is_some()) {
        return Err(Error::usage(
            "a quality or a size on disk is reached by pruning: it cannot be combined with --merge-only or a \
             target count or ratio",
        ));
    }
    match (goal, &request.photographs) {
        (Some(Goal::Quality(Quality::Psnr(_))), Some(_)) => {
            return Err(Error::usage(
                "--min-psnr compares with renders of the original, so it cannot be combined with --toward photographs: \
                 expected --max-loss, --count, --ratio or --size, or --toward renders",
            ));
        }
        (Some(Goal::Quality(Quality::Loss { photographs, .. })), Some(fitted)) if fitted != photographs => {
            return Err(Error::usage("the photographs of the test views and of the fit: expected one folder for both"));
        }
        _ => (),
    }
    if request.kind.is_none() {
        OutputKind::check_name(&request.output)?;
    }
    let kind = OutputKind::from_path(&request.output, request.kind, default_kind);
    let is_archive = kind == OutputKind::Archive;
    if archive_psnr.is_some() && !is_archive {
        return Err(Error::usage("--archive-psnr is for archives: write to NAME.gsz, or --as archive"));
    }
    if let Some(psnr) = archive_psnr {
        decibels("archive_psnr", *psnr).map_err(Error::usage)?;
    }
    match goal {
        Some(Goal::Quality(Quality::Loss { .. })) if is_archive => Err(Error::usage(
            "--max-loss cannot be used for an archive\n  \
             give --ratio, --count, --min-psnr or --size, or write a model folder",
        )),
        Some(Goal::Bytes(_)) if archive_psnr.is_some() => {
            Err(Error::usage("--archive-psnr and --size both determine the quantization: expected only one of them"))
        }
        _ => Ok(kind),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::journal::Journal;
    use crate::memory_plan::Budget;
    use crate::model::NO_SH_LIMIT;
    use crate::pipeline::request::Target;
    use crate::pipeline::tests::work;
    use crate::progress::Events;
    use crate::recipe::Recipe;
    use crate::scene::InputOptions;

    const INPUT: InputMeta = InputMeta {
        gaussians: 1000,
        has_cameras: true,
        archives_as_frames: false,
        default_output_kind: OutputKind::Gseq,
    };

    fn request(recipe: Recipe) -> Request {
        Request::new(InputOptions::default(), "out.gseq".into(), recipe)
    }

    fn budget(bytes: u64) -> Budget {
        Budget { bytes: Some(bytes), ..Budget::default() }
    }

    /// Returns a function that estimates memory, time and reads of all stages of a compression with the preset
    /// `preset`.
    fn all_estimates(preset: &str) -> impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate> {
        let recipe = Recipe::preset(preset).unwrap();
        let plan = RunPlan::new(&request(recipe), INPUT).unwrap();
        move |work, limits| plan.estimates(work, limits)
    }

    #[test]
    fn plan_fits_every_budget_down_to_the_smallest() {
        for preset in ["default", "strong"] {
            let least = MemoryPlan::closest(work(200_000), 1, all_estimates(preset)).peak_bytes();
            let mut before = 0;
            for bytes in [least, least + (8 << 20), 2 * least, 4 * least, 64 * least] {
                let plan =
                    MemoryPlan::fit_budget(work(200_000), budget(bytes), &Events::IGNORED, all_estimates(preset))
                        .unwrap();
                assert!((before..=bytes).contains(&plan.peak_bytes()), "{bytes}: {}", plan.text());
                before = plan.peak_bytes();
            }
            let message =
                MemoryPlan::fit_budget(work(200_000), budget(least - 1), &Events::IGNORED, all_estimates(preset))
                    .unwrap_err()
                    .to_string();
            assert!(message.contains(&format!("at least {}MiB", least.div_ceil(1 << 20))), "{message}");
        }
    }

    #[test]
    fn small_budget_omits_time_then_sh_then_refinement() {
        let mut request = request(Recipe::preset("default").unwrap());
        let work = work(200_000);
        let mut within = |bytes: u64| {
            request.input.memory = budget(bytes);
            let plan = RunPlan::within_memory(&request, INPUT, &work).unwrap();
            let mut journal = Journal::default();
            plan.stages.record_left_out(&work, &Limits::NONE, &mut journal);
            let left_out =
                |what: &str| journal.left_out.iter().find(|left| left.what == what).map(|left| left.why.clone());
            let whats =
                ["time-varying deltas of refinement", "refinement of SH coefficients above degree 0", "refinement"];
            let [time, bands, all] = whats.map(left_out);
            assert_eq!(
                plan.refine.as_ref().is_some_and(|refine| refine.keyframes > 0),
                plan.fallback == MemoryFallback::Nothing
            );
            (plan.fallback, plan.refine.map(|refine| refine.sh_degree), time.filter(|_| bands.is_none()).or(bands), all)
        };
        let least = |spared: MemoryFallback| match spared {
            MemoryFallback::SmallStart { required_bytes }
            | MemoryFallback::ConstantInTime { required_bytes }
            | MemoryFallback::WithoutHarmonics { required_bytes }
            | MemoryFallback::WithoutRefinement { required_bytes } => required_bytes,
            MemoryFallback::Nothing => 0,
        };
        let full_bytes = MemoryPlan::closest(work, 1, all_estimates("default")).peak_bytes();
        assert_eq!(within(full_bytes).0, MemoryFallback::Nothing);
        let (spared, degree, named, none) = within(full_bytes - 1);
        assert_eq!(
            (spared, degree, none),
            (MemoryFallback::ConstantInTime { required_bytes: full_bytes }, Some(NO_SH_LIMIT), None)
        );
        assert!(named.unwrap().contains(&format!("{}MiB", full_bytes.div_ceil(1 << 20))));
        let (spared, ..) = (1..).map(|k| within(full_bytes - k * (1 << 20))).find(|found| found.1 == Some(0)).unwrap();
        let all = least(spared);
        assert!(matches!(spared, MemoryFallback::WithoutHarmonics { .. }) && all < full_bytes, "{spared:?}");
        assert!(matches!(within(all).0, MemoryFallback::ConstantInTime { .. }));
        let (spared, degree, named, none) = within(all - 1);
        assert_eq!((spared, degree, none), (MemoryFallback::WithoutHarmonics { required_bytes: all }, Some(0), None));
        assert!(named.unwrap().contains(&format!("{}MiB", all.div_ceil(1 << 20))));
        let (spared, ..) = (1..).map(|k| within(all - k * (1 << 20))).find(|found| found.1.is_none()).unwrap();
        let bands = least(spared);
        assert!(matches!(spared, MemoryFallback::WithoutRefinement { .. }) && bands < all, "{spared:?}");
        assert!(matches!(within(bands).0, MemoryFallback::WithoutHarmonics { .. }));
        let (spared, refine, _, named) = within(bands - 1);
        assert_eq!((spared, refine), (MemoryFallback::WithoutRefinement { required_bytes: bands }, None));
        assert!(named.unwrap().contains(&format!("{}MiB", bands.div_ceil(1 << 20))));
        // With a limit below all reduced plans, the smallest plan is returned, which is refused later.
        assert_eq!(within(1 << 20).0, MemoryFallback::WithoutRefinement { required_bytes: bands });
    }

    #[test]
    fn small_budget_first_begins_with_fewer_gaussians() {
        let work = work(200_000);
        let fallback_below_full = |ratio: f64| {
            let mut request = request(Recipe::preset("default").unwrap());
            request.target = Some(Target::Ratio(ratio));
            let full = RunPlan::new(&request, INPUT).unwrap();
            let estimates = |work: &Workload, limits: &Limits| full.estimates(work, limits);
            let full_bytes = MemoryPlan::closest(work, 1, estimates).peak_bytes();
            request.input.memory = budget(full_bytes - 1);
            let plan = RunPlan::within_memory(&request, INPUT, &work).unwrap();
            let mut journal = Journal::default();
            plan.stages.record_left_out(&work, &Limits::NONE, &mut journal);
            let is_named = journal.left_out.iter().any(|left| left.what == "more Gaussians at the start of refinement");
            (plan.fallback == MemoryFallback::SmallStart { required_bytes: full_bytes }, is_named)
        };
        assert_eq!(fallback_below_full(0.3), (true, true));
        // 10% of the Gaussians already begin with less than 40%.
        assert_eq!(fallback_below_full(0.1), (false, false));
    }

    #[test]
    fn memory_is_linear_in_gaussians_and_constant_in_frames() {
        let least = |work: Workload| MemoryPlan::closest(work, 1, all_estimates("default"));
        let peaks = [100_000, 1_000_000, 1_900_000].map(|count| least(work(count)).peak_bytes());
        let (first, second) = (peaks[1] - peaks[0], peaks[2] - peaks[1]);
        assert!(first.abs_diff(second) <= first / 1000, "not linear: {peaks:?}");
        let (few, longer) = (least(work(100_000)), least(Workload { frames: 6000, ..work(100_000) }));
        assert!(longer.peak_bytes() as f64 / few.peak_bytes() as f64 <= 1.05, "{} {}", longer.text(), few.text());
    }

    #[test]
    fn unused_stages_cost_nothing_and_are_named() {
        let mut recipe = Recipe::preset("paper").unwrap();
        recipe.merge.passes.clear();
        let request = request(recipe);
        let plan = RunPlan::new(&request, INPUT).unwrap();
        let needs = plan.estimates(&work(1000), &Limits::NONE);
        assert_eq!(needs.iter().map(|need| need.stage).collect::<Vec<_>>(), ["scan", "score", "quality", "emit"]);
        let mut journal = Journal::default();
        plan.stages.record_left_out(&work(1000), &Limits::NONE, &mut journal);
        assert_eq!(journal.left_out.len(), 1);
        assert_eq!(journal.left_out[0].why, "the recipe has no merge pass");
    }

    #[test]
    fn plan_text_names_counts_of_ranking_and_refinement() {
        let counts = |recipe: Recipe, ratio: Option<f64>, goal: Option<Goal>| {
            let target = ratio.map(Target::Ratio);
            let request = Request { target, goal, ..request(recipe) };
            let plan = RunPlan::new(&request, INPUT).unwrap();
            let after = [
                plan.stages.counts.count_after_ranking(100, 1000),
                plan.stages.counts.count_before_refinement(100, 1000),
            ];
            (after, plan.text())
        };
        let default = || Recipe::preset("default").unwrap();
        let (refined, text) = counts(default(), Some(0.1), None);
        assert_eq!(refined, [285, 285]);
        assert!(
            text.contains("ranking leaves 285 of 1000 Gaussians (28%), refinement removes 185 of them; 100 stay"),
            "{text}"
        );
        assert!(text.contains("\n  refine: ") && text.contains("\n  left out: merging"), "{text}");
        let (unrefined, text) = counts(default().without_refinement(), Some(0.1), None);
        assert_eq!(unrefined, [100, 100]);
        assert!(text.contains("leave 100 of 1000 Gaussians (10%); refinement removes none"), "{text}");
        // A search ranks only once, down to the smallest number of Gaussians that it may try.
        let psnr = || Some(Goal::Quality(Quality::Psnr(30.0)));
        assert_eq!(counts(default(), None, psnr()).0, [128, 285]);
        assert_eq!(counts(default().without_refinement(), None, psnr()).0, [20, 100]);
    }
}
