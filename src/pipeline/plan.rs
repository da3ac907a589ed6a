//! What a run does: which stages, with which parameters, and what is left out and why. Made once, before any work.

use super::ids::parse_ids;
use super::request::{Goal, Only, Quality, Request, decibels};
use super::search::SearchStage;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::journal::records::Saved;
use crate::limits::Limits;
use crate::memory_plan::{Plan, ResourceEstimate, Workload};
use crate::outputs::kind::OutputKind;
use crate::pipeline::stages::archive::ArchiveStage;
use crate::pipeline::stages::bands::ShDegreeStage;
use crate::pipeline::stages::choose::Choose;
use crate::pipeline::stages::degree::Degree;
use crate::pipeline::stages::field::FieldPrecisionStage;
use crate::pipeline::stages::measure::{InputMeta, Measure, Stages};
use crate::pipeline::stages::merge;
use crate::pipeline::stages::merge::MergeStage;
use crate::pipeline::stages::reference_views::LEFT_BY_SEARCH;
use crate::pipeline::stages::scan;
use crate::pipeline::stages::write::Emit;
use crate::pruning::prune::Prune;
use crate::pruning::rounds::Rounds;
use crate::pruning::score::UserOverrides;
use crate::pruning::visible;
use crate::pruning::visible::Visible;
use crate::recipe::Coverage;
use crate::refinement;
use crate::refinement::RefineStage;
use crate::scene::Scene;
use crate::statistics::pass::scan_units;

/// The stages of a run, in their order.
#[derive(Debug, Clone)]
pub struct Job {
    /// From frames to scores.
    pub measure: Measure,
    /// Ranks anew as the model shrinks.
    pub rounds: Option<Rounds>,
    /// Chooses an SH degree for so many bytes.
    pub degree: Option<Degree>,
    /// Says how many survive.
    pub prune: Prune,
    /// Merges survivors.
    pub merge: Option<MergeStage>,
    /// Lets pictures choose.
    pub choose: Option<Choose>,
    /// Moves what is stored of what is left.
    pub refine: Option<RefineStage>,
    /// Rounds the field of what is left.
    pub field: Option<FieldPrecisionStage>,
    /// Drops bands of spherical harmonics that nobody sees.
    pub bands: Option<ShDegreeStage>,
    /// Finds the size, instead of all from `prune` on.
    pub search: Option<SearchStage>,
    /// Says on which grids an archive's values lie.
    pub archive: Option<ArchiveStage>,
    /// Writes.
    pub emit: Emit,
    /// Part of the Gaussians that stays at most.
    left: f64,
    has_cameras: bool,
    spared: MemoryFallback,
}

/// Parts of refinement that are left out because they do not fit within the memory limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum MemoryFallback {
    /// No part is left out.
    #[default]
    Nothing,
    /// Parameter deltas are constant in time.
    ConstantInTime {
        /// Memory with which deltas could vary in time, bytes.
        required_bytes: u64,
    },
    /// SH coefficients above degree 0 are not refined either.
    WithoutHarmonics {
        /// Memory with which they could be, bytes.
        required_bytes: u64,
    },
    /// Nothing is refined.
    WithoutRefinement {
        /// Memory with which it could be, bytes.
        required_bytes: u64,
    },
}

impl Job {
    /// The stages that `request` takes.
    ///
    /// # Errors
    /// A recipe out of range; a target or ids that such an input does not have.
    pub fn new(request: &Request, outlook: InputMeta) -> Result<Job> {
        Job::sparing(request, outlook, MemoryFallback::Nothing)
    }

    /// [`Job::new`] without what is `spared`.
    fn sparing(request: &Request, outlook: InputMeta, spared: MemoryFallback) -> Result<Job> {
        let target = request.target.map(|target| target.count(outlook.gaussians)).transpose()?;
        Job::down_to(request, outlook, target, spared)
    }

    /// [`Job::new`] within the request's budget of memory: all times change alike, else harmonics above the first stay as they
    /// are too, else nothing is refined, where it does not reach for more. If it does not reach for that either, what is
    /// asked for stays, to be refused.
    ///
    /// # Errors
    /// Those of [`Job::new`].
    pub fn within(request: &Request, outlook: InputMeta, work: &Workload) -> Result<Job> {
        let of = |spared| Job::sparing(request, outlook, spared);
        let budget = request.input.memory;
        let asked = of(MemoryFallback::Nothing)?;
        if !asked.refines() || Plan::fits(*work, budget, |work, limits| asked.needs(work, limits)) {
            return Ok(asked);
        }
        let least = |job: &Job| Plan::closest(*work, 1, |work, limits| job.needs(work, limits)).peak();
        let of_all = least(&asked);
        let alike = of(MemoryFallback::ConstantInTime { required_bytes: of_all })?;
        let of_alike = least(&alike);
        if of_alike < of_all && Plan::fits(*work, budget, |work, limits| alike.needs(work, limits)) {
            return Ok(alike);
        }
        let bands = of(MemoryFallback::WithoutHarmonics { required_bytes: of_alike })?;
        if work.sh_degree > 0 && Plan::fits(*work, budget, |work, limits| bands.needs(work, limits)) {
            return Ok(bands);
        }
        let none = of(MemoryFallback::WithoutRefinement { required_bytes: least(&bands) })?;
        Ok(if Plan::fits(*work, budget, |work, limits| none.needs(work, limits)) { none } else { asked })
    }

    /// [`Job::sparing`] down to `target` Gaussians, whatever the request's own target.
    fn down_to(request: &Request, outlook: InputMeta, target: Option<usize>, spared: MemoryFallback) -> Result<Job> {
        let Request { recipe, only, .. } = request;
        recipe.validate().map_err(Error::usage)?;
        if request.goal.is_some() && (*only == Only::Merge || request.target.is_some()) {
            return Err(Error::usage(
                "a quality or a size on disk is found by pruning: not with --merge-only, nor beside a target",
            ));
        }
        let ids =
            |spec: &Option<String>| spec.as_deref().map_or(Ok(Vec::new()), |ids| parse_ids(ids, outlook.gaussians));
        let user =
            UserOverrides { keep: ids(&request.keep_ids)?, drop: ids(&request.drop_ids)?, keep_box: request.keep_box };
        let measure = Measure::new(recipe, outlook.has_cameras, user);
        let looks = measure.visible.is_some();
        let prunes = *only != Only::Merge;
        let part = target.map(|target| target as f64 / outlook.gaussians.max(1) as f64);
        let refine = RefineStage::from_recipe(recipe, part, looks && prunes).and_then(|refine| match spared {
            MemoryFallback::Nothing => Some(refine),
            MemoryFallback::ConstantInTime { .. } => Some(refine.without_course()),
            MemoryFallback::WithoutHarmonics { .. } => Some(refine.without_course().without_bands()),
            MemoryFallback::WithoutRefinement { .. } => None,
        });
        if request.kind.is_none() {
            OutputKind::check_name(&request.output)?;
        }
        let kind = OutputKind::from_path(&request.output, request.kind, outlook.own_output);
        let is_archive = kind == OutputKind::Archive;
        if request.archive_psnr.is_some() && !is_archive {
            return Err(Error::usage("--archive-psnr is for archives: write to NAME.gsz, or --as archive"));
        }
        if let Some(psnr) = request.archive_psnr {
            decibels("archive_psnr", psnr).map_err(Error::usage)?;
        }
        let goal = match &request.goal {
            Some(Goal::Quality(Quality::Psnr(least))) if is_archive => {
                Some(Goal::Quality(Quality::Psnr(least + LEFT_BY_SEARCH)))
            }
            Some(Goal::Quality(Quality::Loss { .. })) if is_archive => {
                return Err(Error::usage(
                    "the size of an archive is found by --target-ratio, --target-count, --min-psnr or --target-size\n  \
                     give one of these, or write a model folder",
                ));
            }
            Some(Goal::Bytes(_)) if request.archive_psnr.is_some() => {
                return Err(Error::usage("--archive-psnr and --target-size both say how coarse: expected one of them"));
            }
            goal => goal.clone(),
        };
        let searches = matches!(request.goal, Some(Goal::Quality(_)));
        // What refining gains at a count is more than merging ever did; cuts rank anew, whatever ranked before.
        let prunes_alone = *only == Only::Prune || request.goal.is_some() || (refine.is_some() && prunes);
        let merges = !prunes_alone && !recipe.merge.passes.is_empty();
        let prune = Prune { prunes, merges, target };
        let emit = Emit::new(request, outlook.own_output, merges);
        let field = FieldPrecisionStage::from_request(request, emit.kind);
        let bands = ShDegreeStage::from_request(request, emit.kind);
        Ok(Job {
            rounds: Rounds::from_recipe(&recipe.select, part).filter(|_| looks && prunes),
            degree: Degree::from_request(request, refine.as_ref()),
            merge: merges.then(|| MergeStage::after(&prune, recipe)),
            prune,
            choose: (looks && prunes && merges && recipe.select.choose_by_views)
                .then_some(Choose { has_target: target.is_some() }),
            search: match &goal {
                Some(Goal::Quality(quality)) => {
                    let (refine, field, bands) = (refine.clone(), field.clone(), bands.clone());
                    Some(SearchStage {
                        quality: quality.clone(),
                        pictures: recipe.refine.refine_pictures,
                        refine,
                        field,
                        bands,
                    })
                }
                _ => None,
            },
            refine: refine.filter(|_| !searches),
            field: field.filter(|_| !searches),
            bands: bands.filter(|_| !searches),
            archive: is_archive.then_some(ArchiveStage { psnr: request.archive_psnr }),
            emit,
            left: part.unwrap_or(1.0).min(1.0),
            measure,
            has_cameras: outlook.has_cameras,
            spared,
        })
    }

    /// Whether anything is refined.
    fn refines(&self) -> bool {
        self.refine.is_some() || self.search.as_ref().is_some_and(|search| search.refine.is_some())
    }

    /// [`Job::down_to`] `target` of the same request and within the same budget.
    ///
    /// # Errors
    /// Those of [`Job::new`].
    pub fn again(&self, request: &Request, outlook: InputMeta, target: usize) -> Result<Job> {
        Job::down_to(request, outlook, Some(target), self.spared)
    }

    /// How many of `all` Gaussians the ranking leaves, if `wanted` are to stay: a refinement lets the last ones go by
    /// itself.
    pub fn before_cuts(&self, wanted: usize, all: usize) -> usize {
        self.refine.as_ref().map_or(wanted, |refine| refine.first(wanted, all))
    }

    /// The stages that can be divided, as a work folder names them, with their units.
    pub(super) fn divided(&self, scene: &Scene) -> Vec<String> {
        let count = scene.source().info().count;
        let mut stages = vec![format!("{}: {} blocks of Gaussians", scan::NAME, scan_units(scene.source().info()))];
        if let Some(visible) = &self.measure.visible {
            let most = match visible.recipe.look_pictures {
                0 => scene.schedule.pairs(),
                most => most.min(scene.schedule.pairs()),
            };
            stages.push(format!("{}: {most} pictures", visible::NAME));
        }
        if let Some(rounds) = &self.rounds {
            let fewest = self.search.as_ref().map_or_else(
                || self.before_cuts((rounds.usual * count as f64).ceil() as usize, count),
                |search| search.fewest(count),
            );
            stages.extend(rounds.divided(count, fewest));
        }
        if let Some(merge) = &self.merge {
            stages.extend(merge.recipe.passes.iter().map(|_| format!("{}: pairs of neighbours", merge::PAIRS)));
        }
        if self.refines() {
            stages.push(format!("{}: pictures", refinement::targets::NAME));
        }
        stages
    }

    /// Writes down the stages that the request leaves out of such a workload.
    pub fn write_down(&self, request: &Request, work: &Workload, limits: &Limits, journal: &mut Journal) {
        let saved =
            |need: ResourceEstimate| Saved::Stage { seconds: need.seconds / work.threads as f64, reads: need.reads };
        if !self.prune.prunes {
            journal.leave_out("pruning", "--merge-only");
        }
        if self.merge.is_none() {
            let why = match request.only {
                Only::Prune => "--prune-only",
                _ if request.recipe.merge.passes.is_empty() => "the recipe has no merge pass",
                _ if request.goal.is_some() => "a quality or a size on disk is found by pruning",
                _ => "refining what is left gains more at the same count (--no-refine merges)",
            };
            let what = "merging, and its pass over the frames";
            match request.recipe.merge.passes.is_empty() {
                true => journal.leave_out(what, why),
                false => {
                    let merge = MergeStage::after(&self.prune, &request.recipe);
                    journal.spare(what, why, saved(merge.need(work, limits)));
                }
            }
        }
        let takes = |least: u64| format!("memory: expected at least {}MiB for it (--memory)", least.div_ceil(1 << 20));
        match self.spared {
            MemoryFallback::Nothing => (),
            MemoryFallback::ConstantInTime { required_bytes } => {
                journal.leave_out("refining along time", takes(required_bytes))
            }
            MemoryFallback::WithoutHarmonics { required_bytes } => {
                journal.leave_out("refining along time", takes(required_bytes));
                journal.leave_out("refining of harmonics above the first", takes(required_bytes));
            }
            MemoryFallback::WithoutRefinement { required_bytes } => {
                journal.leave_out("refinement", takes(required_bytes))
            }
        }
        if request.recipe.scan.coverage == Coverage::Auto && !self.has_cameras {
            let why = "no cameras given or found: a virtual rig may see only what is in front of the scene";
            let visible = Visible { recipe: request.recipe.scan.clone() };
            journal.spare("visible coverage", why, saved(visible.need(work, limits)));
        }
    }
}

impl Stages for Job {
    fn measure(&self) -> &Measure {
        &self.measure
    }

    fn needs(&self, work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
        let mut needs = self.measure.needs(work, limits);
        needs.extend(self.rounds.as_ref().map(|stage| stage.need(work, limits)));
        needs.extend(self.degree.as_ref().map(|stage| stage.need(work, limits)));
        needs.extend(self.merge.as_ref().map(|stage| stage.need(work, limits)));
        needs.extend(self.choose.as_ref().map(|stage| stage.need(work, limits, self.left)));
        needs.extend(self.refine.as_ref().map(|stage| stage.need(work, limits)));
        needs.extend(self.field.as_ref().map(|stage| stage.need(work, limits, self.left)));
        // Of degree 0 there is no band to drop.
        let bands = self.bands.as_ref().filter(|_| work.sh_degree > 0);
        needs.extend(bands.map(|stage| stage.need(work, limits, self.left)));
        needs.extend(self.search.as_ref().map(|stage| stage.need(work, limits)));
        needs.extend(self.archive.as_ref().map(|stage| stage.need(work, limits)));
        needs.push(self.emit.need(work, limits, self.left));
        needs
    }

    /// What is close enough already is not refined.
    fn easiest(&self, work: &Workload, limits: &Limits, hardly_seen: f64) -> Vec<ResourceEstimate> {
        match self.left >= 1.0 - hardly_seen {
            true => Job { refine: None, ..self.clone() }.needs(work, limits),
            false => self.needs(work, limits),
        }
    }

    fn searches(&self) -> bool {
        self.search.is_some() || self.degree.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::memory_plan::Budget;
    use crate::model::ALL_HARMONICS;
    use crate::pipeline::tests::work;
    use crate::recipe::Recipe;
    use crate::scene::InputOptions;

    const OUTLOOK: InputMeta = InputMeta { gaussians: 1000, has_cameras: true, own_output: OutputKind::Gseq };

    fn request(recipe: Recipe) -> Request {
        Request::new(InputOptions::default(), "out.gseq".into(), recipe)
    }

    fn budget(bytes: u64) -> Budget {
        Budget { bytes: Some(bytes), ..Budget::default() }
    }

    /// Everything compressing does under `preset`.
    fn everything(preset: &str) -> impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate> {
        let recipe = Recipe::preset(preset).unwrap();
        let job = Job::new(&request(recipe), OUTLOOK).unwrap();
        move |work, limits| job.needs(work, limits)
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
    fn a_small_budget_leaves_out_time_then_bands_then_refining_and_names_what_there_would_have_to_be() {
        let mut request = request(Recipe::preset("default").unwrap());
        let work = work(200_000);
        let mut within = |bytes: u64| {
            request.input.memory = budget(bytes);
            let job = Job::within(&request, OUTLOOK, &work).unwrap();
            let mut journal = Journal::default();
            job.write_down(&request, &work, &Limits::NONE, &mut journal);
            let left_out =
                |what: &str| journal.left_out.iter().find(|left| left.what == what).map(|left| left.why.clone());
            let whats = ["refining along time", "refining of harmonics above the first", "refinement"];
            let [time, bands, all] = whats.map(left_out);
            assert_eq!(
                job.refine.as_ref().is_some_and(|refine| refine.knots > 0),
                job.spared == MemoryFallback::Nothing
            );
            (job.spared, job.refine.map(|refine| refine.sh_degree), time.filter(|_| bands.is_none()).or(bands), all)
        };
        let least = |spared: MemoryFallback| match spared {
            MemoryFallback::ConstantInTime { required_bytes }
            | MemoryFallback::WithoutHarmonics { required_bytes }
            | MemoryFallback::WithoutRefinement { required_bytes } => required_bytes,
            MemoryFallback::Nothing => 0,
        };
        let whole = Plan::closest(work, 1, everything("default")).peak();
        assert_eq!(within(whole).0, MemoryFallback::Nothing);
        let (spared, degree, named, none) = within(whole - 1);
        assert_eq!(
            (spared, degree, none),
            (MemoryFallback::ConstantInTime { required_bytes: whole }, Some(ALL_HARMONICS), None)
        );
        assert!(named.unwrap().contains(&format!("{}MiB", whole.div_ceil(1 << 20))));
        let (spared, ..) = (1..).map(|k| within(whole - k * (1 << 20))).find(|found| found.1 == Some(0)).unwrap();
        let all = least(spared);
        assert!(matches!(spared, MemoryFallback::WithoutHarmonics { .. }) && all < whole, "{spared:?}");
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
        // What nothing can be done about is refused as it was asked for.
        assert_eq!(within(1 << 20).0, MemoryFallback::Nothing);
    }

    #[test]
    fn ten_times_the_gaussians_take_ten_times_the_stated_bytes_and_ten_times_the_frames_next_to_nothing() {
        let least = |work: Workload| Plan::closest(work, 1, everything("default"));
        let peaks = [100_000, 1_000_000, 1_900_000].map(|count| least(work(count)).peak());
        let (first, second) = (peaks[1] - peaks[0], peaks[2] - peaks[1]);
        assert!(first.abs_diff(second) <= first / 1000, "not linear: {peaks:?}");
        let (few, longer) = (least(work(100_000)), least(Workload { frames: 6000, ..work(100_000) }));
        assert!(longer.peak() as f64 / few.peak() as f64 <= 1.05, "{} {}", longer.text(), few.text());
    }

    #[test]
    fn what_a_recipe_does_not_do_takes_nothing_and_is_named() {
        let mut recipe = Recipe::preset("paper").unwrap();
        recipe.merge.passes.clear();
        let request = request(recipe);
        let job = Job::new(&request, OUTLOOK).unwrap();
        let needs = job.needs(&work(1000), &Limits::NONE);
        assert_eq!(needs.iter().map(|need| need.stage).collect::<Vec<_>>(), ["scan", "score", "emit"]);
        let mut journal = Journal::default();
        job.write_down(&request, &work(1000), &Limits::NONE, &mut journal);
        assert_eq!(journal.left_out.len(), 1);
        assert_eq!(journal.left_out[0].why, "the recipe has no merge pass");
    }
}
