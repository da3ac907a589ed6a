//! Measurements of settings by complete runs of the program: the effect of merging and of refinement at a given number
//! of Gaussians, and the effect of the number of threads and of the memory limit.

use std::collections::BTreeMap;
use std::path::Path;

use super::Bench;
use super::judge::JudgedQuality;
use crate::diagnostics::whole_run::{WholeRun, with_training_views};
use crate::error::{Error, Result};
use crate::evaluation::cost::Cost;
use crate::evaluation::method::MethodKind;
use crate::evaluation::precision::{
    DIFFERENT_BYTES, InaccuracySource, PrecisionCurve, PrecisionKnob, PrecisionSetting, RENDER_ERROR,
};
use crate::memory_plan::{Budget, MemoryPlan};
use crate::pipeline::planning::InputMeta;
use crate::pipeline::{PruneOrMerge, Request, RunPlan, Target};
use crate::recipe::{MergePass, Recipe};
use crate::scene::{InputOptions, open_input};

/// Merging radii that are tried, as multiples of the recipe's radius.
const RADII: [f64; 4] = [0.5, 1.0, 2.0, 4.0];
/// Numbers of merging passes that are tried.
const PASSES: [usize; 3] = [1, 2, 3];
/// Numbers of optimization steps of refinement that are tried.
const STEPS: [u32; 6] = [100, 250, 500, 1000, 1500, 3000];
/// Numbers of target views (views of the original that refinement fits) that are tried.
const TARGET_VIEW_COUNTS: [usize; 5] = [65, 130, 260, 520, 1000];
/// Memory limits that are tried, as multiples of the smallest limit with which the program can run.
const BUDGETS: [f64; 4] = [1.0, 1.5, 3.0, 10.0];

/// Maximum number of frames at which the results of complete runs are compared with the whole model.
const FRAMES_COMPARED: usize = 12;

/// Description, in the results, of the reference with which the results of complete runs are compared.
const WHOLE: &str = "renders of the whole model: every held-out view of up to 12 frames";

impl Bench<'_> {
    /// Measures complete runs that prune and then merge, with several merging radii and several numbers of merging
    /// passes. All runs end at the same number of Gaussians. Returns the measurements.
    pub(super) fn merging(&self) -> Result<PrecisionKnob> {
        let plain = self.recipe.without_refinement();
        let pass = plain.merge.passes.first().copied();
        let pass = pass.unwrap_or(MergePass { epsilon: 0.005, d0: 1.0, rho: 0.95, tau_m: 0.9 });
        let merging = |passes: Vec<MergePass>| {
            let mut recipe = plain.clone();
            recipe.select.choose_by_views = false;
            recipe.merge.passes = passes;
            recipe
        };
        let alone = self.measure_quality(&merging(Vec::new()), 0.0, 0.0)?;
        let mut by_radius = vec![alone.clone()];
        for part in RADII {
            let epsilon = part * pass.epsilon;
            by_radius.push(self.measure_quality(&merging(vec![MergePass { epsilon, ..pass }]), epsilon, epsilon)?);
        }
        let mut by_passes = vec![alone];
        let base = if plain.merge.passes.is_empty() { vec![pass] } else { plain.merge.passes.clone() };
        for passes in PASSES {
            let repeated: Vec<MergePass> = base.iter().copied().cycle().take(passes).collect();
            by_passes.push(self.measure_quality(&merging(repeated), passes as f64, passes as f64)?);
        }
        Ok(PrecisionKnob {
            name: "merging".to_owned(),
            about:
                "Merging to one count, without choosing between merging and pruning and without refining: radius ε of \
                    one pass (0: pruning alone), and passes of the recipe's own radius."
                    .to_owned(),
            source: InaccuracySource::Model,
            curves: vec![
                PrecisionCurve::new("merge radius", WHOLE, by_radius, Some(pass.epsilon), &[]),
                PrecisionCurve::new("merge passes", WHOLE, by_passes, Some(plain.merge.passes.len() as f64), &[]),
            ],
        })
    }

    /// Measures complete runs with several numbers of optimization steps of refinement, and with several numbers of
    /// target views (views of the original that refinement fits). All runs end at the same number of Gaussians. Returns
    /// `None` if the recipe does not refine.
    pub(super) fn refining(&self) -> Result<Option<PrecisionKnob>> {
        let base = &self.recipe.refine;
        if base.refine.0.is_empty() || base.refine_steps == 0 {
            return Ok(None);
        }
        let mut by_steps = vec![self.measure_quality(&self.recipe.without_refinement(), 0.0, 0.0)?];
        let mut steps: Vec<u32> = STEPS.into_iter().chain([base.refine_steps]).collect();
        steps.sort_unstable();
        steps.dedup();
        for steps in steps {
            let recipe = self.recipe.with_refinement_steps(steps);
            by_steps.push(self.measure_quality(&recipe, f64::from(steps), 1.0 / f64::from(steps))?);
        }
        let mut by_target_views = Vec::new();
        for count in TARGET_VIEW_COUNTS {
            let mut recipe = self.recipe.clone();
            recipe.refine.refine_target_views = count;
            by_target_views.push(self.measure_quality(&recipe, count as f64, 1.0 / count as f64)?);
        }
        Ok(Some(PrecisionKnob {
            name: "refining".to_owned(),
            about: "Refining to one count: steps (0: pruning alone), and the number of target views.".to_owned(),
            source: InaccuracySource::Model,
            curves: vec![
                PrecisionCurve::new("refine_steps", WHOLE, by_steps, Some(base.refine_steps.into()), &[]),
                PrecisionCurve::new(
                    "refine_target_views",
                    WHOLE,
                    by_target_views,
                    Some(base.refine_target_views as f64),
                    &[],
                ),
            ],
        }))
    }

    /// Measures complete runs with several numbers of threads and several memory limits, and checks that their results
    /// are equal byte for byte. Returns the measurements.
    pub(super) fn machine(&self) -> Result<PrecisionKnob> {
        let recipe = self.recipe.without_refinement();
        let mut expected = None;
        let mut by_threads = Vec::new();
        let max_threads = rayon::current_num_threads();
        let mut threads: Vec<usize> =
            std::iter::successors(Some(1), |n| Some(2 * n)).take_while(|&n| n < max_threads).collect();
        threads.push(max_threads);
        for threads in threads {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let pool = pool.map_err(|error| Error::usage(format!("{threads} threads: {error}")))?;
            let value = threads as f64;
            by_threads.push(pool.install(|| self.compare_bytes(&recipe, self.input, value, &mut expected))?);
        }
        let request = Request {
            target: Some(self.target()),
            ..Request::new(with_training_views(self.input), self.scratch.join(self.name), recipe.clone())
        };
        let plan = RunPlan::new(&request, InputMeta::from_scene(self.scene))?;
        let least = MemoryPlan::closest(self.work, 1, |work, limits| plan.estimates(work, limits)).peak_bytes();
        let mut by_memory = Vec::new();
        for part in BUDGETS {
            let mebibytes = (part * least as f64 / f64::from(1 << 20)).ceil();
            let memory = Budget { bytes: Some((mebibytes as u64) << 20), ..self.input.memory };
            let input = InputOptions { memory, ..self.input.clone() };
            by_memory.push(self.compare_bytes(&recipe, &input, mebibytes, &mut expected)?);
        }
        let against = "the bytes of the first of these runs";
        Ok(PrecisionKnob {
            name: "machine".to_owned(),
            about:
                "Threads, and memory in MiB from the smallest possible limit on: the result is the same, byte for byte."
                    .to_owned(),
            source: InaccuracySource::Rounding,
            curves: vec![
                PrecisionCurve::new("threads", against, by_threads, Some(max_threads as f64), &[]),
                PrecisionCurve::new("memory, MiB", against, by_memory, None, &[]),
            ],
        })
    }

    fn target(&self) -> Target {
        Target::Count(self.kept as u64)
    }

    /// Compresses the input by `recipe` in one or more complete runs. Then compares renders of the result with renders
    /// of the original. Returns the error and the mean PSNR of these renders, and the time and memory of a run.
    /// - `value`: value that the varied parameter has in `recipe`.
    /// - `step`: coarseness h of this value, such as 1 / (number of views). An error of order p is proportional to h^p.
    fn measure_quality(&self, recipe: &Recipe, value: f64, step: f64) -> Result<PrecisionSetting> {
        let (evaluation, cost) = self.run(recipe, self.input, |run, result| run.compare(result))?;
        let psnr: Vec<f64> = evaluation.views.iter().map(|view| view.loss.psnr).collect();
        let JudgedQuality { error, psnr } = JudgedQuality::from_psnr(&psnr);
        Ok(PrecisionSetting {
            value,
            step,
            cost,
            errors: BTreeMap::from([(RENDER_ERROR.to_owned(), error)]),
            psnr: Some(psnr),
        })
    }

    /// Compresses `input` by `recipe` in complete runs of the program. Returns the cost (time and memory) and the error
    /// [`DIFFERENT_BYTES`]: 0 if the result has the digest `expected`, 1 if not. `value`: value of the varied
    /// parameter. In the call for the first setting, `expected` is `None`; this call stores the digest of its result
    /// there.
    fn compare_bytes(
        &self,
        recipe: &Recipe,
        input: &InputOptions,
        value: f64,
        expected: &mut Option<String>,
    ) -> Result<PrecisionSetting> {
        let (digest, cost) = self.run(recipe, input, |_, result| {
            open_input(&InputOptions { path: result.to_owned(), ..self.input.clone() })?.input.digest()
        })?;
        let differs = *expected.get_or_insert(digest.clone()) != digest;
        let errors = BTreeMap::from([(DIFFERENT_BYTES.to_owned(), f64::from(u8::from(differs)))]);
        Ok(PrecisionSetting { value, step: value, cost, errors, psnr: None })
    }

    fn run<T>(
        &self,
        recipe: &Recipe,
        input: &InputOptions,
        inspect: impl FnOnce(&WholeRun<'_>, &Path) -> Result<T>,
    ) -> Result<(T, Cost)> {
        let run = WholeRun {
            input,
            scratch: self.scratch,
            name: self.name,
            repeats: self.repeats,
            max_frames: Some(FRAMES_COMPARED),
            background: None,
        };
        let method_kind = MethodKind::Recipe(Box::new(recipe.clone()), PruneOrMerge::Both);
        let measured = run.run(&method_kind, Some(self.target()), |result| inspect(&run, result))?;
        self.advance();
        Ok(measured)
    }
}
