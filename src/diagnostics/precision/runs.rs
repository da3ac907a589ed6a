//! Whole runs: what merging and refining do to a model of one size, and what threads and memory do to a run.

use std::collections::BTreeMap;
use std::path::Path;

use super::Bench;
use super::judge::JudgedQuality;
use crate::diagnostics::whole_run::{WholeRun, trained};
use crate::error::{Error, Result};
use crate::evaluation::cost::Cost;
use crate::evaluation::method::MethodKind;
use crate::evaluation::precision::{BYTES, PICTURES, PrecisionCurve, PrecisionKnob, PrecisionSetting, Source};
use crate::memory_plan::{Budget, Plan};
use crate::pipeline::planning::InputMeta;
use crate::pipeline::{Only, Request, RunPlan, Target};
use crate::recipe::{MergePass, Recipe};
use crate::scene::{InputOptions, open_input};

/// Merge radii, in parts of the recipe's own.
const RADII: [f64; 4] = [0.5, 1.0, 2.0, 4.0];
/// Merge passes.
const PASSES: [usize; 3] = [1, 2, 3];
/// Steps of refinement.
const STEPS: [u32; 6] = [100, 250, 500, 1000, 1500, 3000];
/// Pictures that refinement goes through.
const PICTURES_REFINED_BY: [usize; 5] = [32, 65, 130, 260, 520];
/// Budgets of memory, in parts of the least that works.
const BUDGETS: [f64; 4] = [1.0, 1.5, 3.0, 10.0];

/// Frames that results of whole runs are compared on at most.
const FRAMES_COMPARED: usize = 12;

/// What errors of whole runs are measured against.
const WHOLE: &str = "the whole model's pictures: every held-out view of up to 12 frames";

impl Bench<'_> {
    /// Merging after pruning, to one count.
    pub(super) fn merging(&self) -> Result<PrecisionKnob> {
        let plain = self.recipe.unrefined();
        let pass = plain.merge.passes.first().copied();
        let pass = pass.unwrap_or(MergePass { epsilon: 0.005, d0: 1.0, rho: 0.95, tau_m: 0.9 });
        let merging = |passes: Vec<MergePass>| {
            let mut recipe = plain.clone();
            recipe.select.choose_by_views = false;
            recipe.merge.passes = passes;
            recipe
        };
        let alone = self.ran(&merging(Vec::new()), 0.0, 0.0)?;
        let mut by_radius = vec![alone.clone()];
        for part in RADII {
            let epsilon = part * pass.epsilon;
            by_radius.push(self.ran(&merging(vec![MergePass { epsilon, ..pass }]), epsilon, epsilon)?);
        }
        let mut by_passes = vec![alone];
        let own = if plain.merge.passes.is_empty() { vec![pass] } else { plain.merge.passes.clone() };
        for passes in PASSES {
            let some: Vec<MergePass> = own.iter().copied().cycle().take(passes).collect();
            by_passes.push(self.ran(&merging(some), passes as f64, passes as f64)?);
        }
        Ok(PrecisionKnob {
            name: "merging".to_owned(),
            about:
                "Merging to one count, whatever pictures say of it, without refining: radius ε of one pass (0: pruning \
                    alone), and passes of the recipe's own radius."
                    .to_owned(),
            source: Source::Model,
            curves: vec![
                PrecisionCurve::new("merge radius", WHOLE, by_radius, Some(pass.epsilon), &[]),
                PrecisionCurve::new("merge passes", WHOLE, by_passes, Some(plain.merge.passes.len() as f64), &[]),
            ],
        })
    }

    /// Refining at one count. None of a recipe that refines nothing.
    pub(super) fn refining(&self) -> Result<Option<PrecisionKnob>> {
        let own = &self.recipe.refine;
        if own.refine.0.is_empty() || own.refine_steps == 0 {
            return Ok(None);
        }
        let mut by_steps = vec![self.ran(&self.recipe.unrefined(), 0.0, 0.0)?];
        let mut steps: Vec<u32> = STEPS.into_iter().chain([own.refine_steps]).collect();
        steps.sort_unstable();
        steps.dedup();
        for steps in steps {
            let recipe = self.recipe.refining_by(steps);
            by_steps.push(self.ran(&recipe, f64::from(steps), 1.0 / f64::from(steps))?);
        }
        let mut by_pictures = Vec::new();
        for pictures in PICTURES_REFINED_BY {
            let mut recipe = self.recipe.clone();
            recipe.refine.refine_pictures = pictures;
            by_pictures.push(self.ran(&recipe, pictures as f64, 1.0 / pictures as f64)?);
        }
        Ok(Some(PrecisionKnob {
            name: "refining".to_owned(),
            about: "Refining to one count: steps (0: pruning alone), and the pictures that they go through.".to_owned(),
            source: Source::Model,
            curves: vec![
                PrecisionCurve::new("refine_steps", WHOLE, by_steps, Some(own.refine_steps.into()), &[]),
                PrecisionCurve::new("refine_pictures", WHOLE, by_pictures, Some(own.refine_pictures as f64), &[]),
            ],
        }))
    }

    /// Threads and memory, which must not change a byte.
    pub(super) fn machine(&self) -> Result<PrecisionKnob> {
        let recipe = self.recipe.unrefined();
        let mut expected = None;
        let mut by_threads = Vec::new();
        let most = rayon::current_num_threads();
        let mut threads: Vec<usize> =
            std::iter::successors(Some(1), |n| Some(2 * n)).take_while(|&n| n < most).collect();
        threads.push(most);
        for threads in threads {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let pool = pool.map_err(|error| Error::usage(format!("{threads} threads: {error}")))?;
            let value = threads as f64;
            by_threads.push(pool.install(|| self.same(&recipe, self.input, value, &mut expected))?);
        }
        let request = Request {
            target: Some(self.target()),
            ..Request::new(trained(self.input), self.scratch.join(self.name), recipe.clone())
        };
        let plan = RunPlan::new(&request, InputMeta::from_scene(self.scene))?;
        let least = Plan::closest(self.work, 1, |work, limits| plan.estimates(work, limits)).peak();
        let mut by_memory = Vec::new();
        for part in BUDGETS {
            let mebibytes = (part * least as f64 / f64::from(1 << 20)).ceil();
            let memory = Budget { bytes: Some((mebibytes as u64) << 20), ..self.input.memory };
            let input = InputOptions { memory, ..self.input.clone() };
            by_memory.push(self.same(&recipe, &input, mebibytes, &mut expected)?);
        }
        let against = "the bytes of the first of these runs";
        Ok(PrecisionKnob {
            name: "machine".to_owned(),
            about: "Threads, and MiB of memory from the least that works on: the result is the same, byte for byte."
                .to_owned(),
            source: Source::Rounding,
            curves: vec![
                PrecisionCurve::new("threads", against, by_threads, Some(most as f64), &[]),
                PrecisionCurve::new("memory, MiB", against, by_memory, None, &[]),
            ],
        })
    }

    fn target(&self) -> Target {
        Target::Count(self.kept as u64)
    }

    /// A whole run by `recipe`.
    fn ran(&self, recipe: &Recipe, value: f64, step: f64) -> Result<PrecisionSetting> {
        let (evaluation, cost) = self.run(recipe, self.input, |run, result| run.compared(result))?;
        let psnr: Vec<f64> = evaluation.pictures.iter().map(|picture| picture.loss.psnr).collect();
        let JudgedQuality { error, psnr } = JudgedQuality::from_psnr(&psnr);
        Ok(PrecisionSetting {
            value,
            step,
            cost,
            errors: BTreeMap::from([(PICTURES.to_owned(), error)]),
            psnr: Some(psnr),
        })
    }

    /// The same, and whether its bytes are `expected`: those of the first.
    fn same(
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
        let errors = BTreeMap::from([(BYTES.to_owned(), f64::from(u8::from(differs)))]);
        Ok(PrecisionSetting { value, step: value, cost, errors, psnr: None })
    }

    fn run<T>(
        &self,
        recipe: &Recipe,
        input: &InputOptions,
        look: impl FnOnce(&WholeRun<'_>, &Path) -> Result<T>,
    ) -> Result<(T, Cost)> {
        let run = WholeRun {
            input,
            scratch: self.scratch,
            name: self.name,
            repeats: self.repeats,
            max_frames: Some(FRAMES_COMPARED),
            background: None,
        };
        let means = MethodKind::Recipe(Box::new(recipe.clone()), Only::Both);
        let ran = run.run(&means, Some(self.target()), |result| look(&run, result))?;
        self.advance();
        Ok(ran)
    }
}
