//! Two stages, both named `size`, of a run with a requested size on disk. The first stage finds how many Gaussians fit
//! the size, before Gaussians are ranked. The second stage removes Gaussians from the result at the end, if the result
//! exceeds the size because refined values compress worse than the values with which the number was found.

use std::num::NonZeroU32;

use crate::cache::CacheKey;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::memory_plan::ResourceEstimate;
use crate::outputs::kind::OutputKind;
use crate::passes::{VIEWS_PER_FRAME, select_evenly};
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Goal;
use crate::pipeline::stage::{ByteLimitFit, EstimateInput, Phase, RunState, Stage, StageList};
use crate::pipeline::stages::archive;
use crate::pipeline::stages::field::FieldPrecisionStage;
use crate::pipeline::stages::write::WriteStage;
use crate::pruning::removal::removal_error;
use crate::pruning::score::Scored;
use crate::recipe::FieldPrecision;
use crate::scene::Scene;

/// Name of both stages in plans, progress and summaries.
const NAME: &str = "size";
/// Fraction of the byte limit (requested size on disk) that may remain unused. The search for the number of Gaussians
/// that fit the limit ends once at most this fraction is unused.
const MAX_UNUSED: f64 = 0.01;
/// Maximum number of trials in the search for the number of Gaussians that fits the byte limit. Each trial writes an
/// output with one number of Gaussians and measures its bytes.
const MAX_TRIED: usize = 8;
/// Number of views by which Gaussians are ranked to remove some of them, if the result exceeds the requested size on
/// disk.
const RANKING_VIEWS: usize = 48;

/// Adds to `stages` the stage that finds how many Gaussians fit the requested size on disk, if a size is requested.
pub(super) fn plan_count(planning: &Planning<'_>, stages: &mut StageList) {
    if let Some(limit) = ByteLimit::from_planning(planning) {
        stages.add(Phase::Rank, CountByBytes { drops_bands: planning.chooses_sh_degree(), limit });
    }
}

/// Adds to `stages` the stage that removes Gaussians from a result above the requested size on disk, if a size is
/// requested. An archive needs no such stage, because its quantization steps are adapted to the size.
pub(super) fn plan_shrink(planning: &Planning<'_>, stages: &mut StageList) {
    if let Some(limit) = ByteLimit::from_planning(planning).filter(|_| planning.output != OutputKind::Archive) {
        stages.add(Phase::Reduce, ShrinkToBytes { limit });
    }
}

/// Stage that finds how many Gaussians an output of at most the requested size on disk can hold.
#[derive(Debug)]
struct CountByBytes {
    limit: ByteLimit,
    /// Whether lower SH degrees are tried as well. The number of Gaussians that fit the byte limit is then found for
    /// each degree.
    drops_bands: bool,
}

impl Stage for CountByBytes {
    fn estimates(&self, _: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        Vec::new()
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let template = CompressedModel { field: self.limit.field, ..run.template.clone() };
        let (scored, recipe) = (run.scored()?, run.recipe.len() as u64);
        run.counts_within_bytes =
            self.limit.fits(run.scene, (&scored, recipe), &template, self.drops_bands, &mut run.journal)?;
        run.target = run.counts_within_bytes.first().map(|fit| fit.gaussians);
        Ok(())
    }
}

/// Stage that removes Gaussians from a result whose files exceed the requested size on disk.
#[derive(Debug)]
struct ShrinkToBytes {
    limit: ByteLimit,
}

impl Stage for ShrinkToBytes {
    fn estimates(&self, _: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        Vec::new()
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, result, recipe) = (run.scored()?, run.take_result(), run.recipe.len() as u64);
        run.result = self.limit.shrink(run.scene, &scored, result, recipe, &mut run.journal)?;
        Ok(())
    }
}

/// Gaussians of which samples are written to measure the size of outputs.
struct Sample<'a> {
    /// Ids of all Gaussians that an output can hold, increasing.
    ids: &'a [u32],
    /// Gaussian that every sample contains: the first one of the ranking, which is visible. `None` for outputs that may
    /// consist of invisible Gaussians only.
    best: Option<u32>,
}

impl Sample<'_> {
    /// Returns `count` of the Gaussians, evenly spaced, in increasing order. If `best` is not among them, it replaces
    /// the first.
    fn pick(&self, count: usize) -> Vec<u32> {
        let mut kept: Vec<u32> = (0..count).map(|k| self.ids[k * self.ids.len() / count]).collect();
        let best = self.best.filter(|best| kept.binary_search(best).is_err());
        if let (Some(first), Some(best)) = (kept.first_mut(), best) {
            *first = best;
            kept.sort_unstable();
        }
        kept
    }
}

/// Returns the error for a size on disk of `most` bytes, which not even one Gaussian fits. An output with one Gaussian
/// takes `least` bytes, of which `beside` are those of the files beside it.
fn too_few_bytes(least: u64, beside: u64, most: u64) -> Error {
    let written = least - beside;
    let (parts, advice) = match beside {
        0 => ("; nearly all of it is data other than Gaussians, such as a deformation network".to_owned(), ""),
        _ => (
            format!(
                ": {written} bytes of its file or folder, with the deformation network if the model has one, and \
                 {beside} of the files beside it (index map with 8 bytes for each Gaussian of the input, recipe, summary)"
            ),
            ", or write an archive (NAME.gsz): the files beside it do not count",
        ),
    };
    Error::usage(format!(
        "--size: expected at least {least} bytes, found {most}\n  {least} bytes is the size of an output with one \
         Gaussian{parts}\n  ask for more bytes{advice}"
    ))
}

/// Limit on the bytes of all output files together.
#[derive(Debug, Clone)]
struct ByteLimit {
    /// Stage that writes the output files; used to measure the size of a result.
    writer: WriteStage,
    /// Maximum number of bytes of all output files together.
    most: u64,
    /// Precision of the deformation field that is assumed when sizes are measured: half precision if the recipe allows
    /// it.
    field: FieldPrecision,
}

impl ByteLimit {
    fn from_planning(planning: &Planning<'_>) -> Option<ByteLimit> {
        let Some(Goal::Bytes(most)) = planning.request.goal else { return None };
        let is_rounded = FieldPrecisionStage::from_request(planning.request, planning.output).is_some();
        let field = if is_rounded { FieldPrecision::Half } else { FieldPrecision::Exact };
        Some(ByteLimit { writer: WriteStage::from_planning(planning), most, field })
    }

    /// Returns how many of the Gaussians in `scored` fit the byte limit ([`ByteLimit::count`]), for one or more SH
    /// degrees:
    /// - if `drops` is false, for the degree of `template` only;
    /// - if `drops` is true, also for lower degrees in decreasing order, up to the first degree at which all Gaussians
    ///   fit.
    ///
    /// `template` holds the other settings of the model. `recipe`: size of the recipe file, bytes.
    ///
    /// # Errors
    /// Fails in the cases in which [`ByteLimit::count`] fails.
    fn fits(
        &self,
        scene: &Scene,
        (scored, recipe): (&Scored, u64),
        template: &CompressedModel,
        drops: bool,
        journal: &mut Journal,
    ) -> Result<Vec<ByteLimitFit>> {
        let info = scene.source().info();
        let highest = template.sh_degree.min(info.sh_degree);
        let lowest = if drops && scene.input.reason_to_keep_sh_degree().is_none() { 0 } else { highest };
        let present = scored.present_ids();
        let needs_visible = self.writer.kind == OutputKind::Tsog;
        let best = scored.selection.ranking.order().first().copied().filter(|_| needs_visible);
        let sample = Sample { ids: &present, best };
        let mut fits: Vec<ByteLimitFit> = Vec::new();
        for sh_degree in (lowest..=highest).rev() {
            if fits.last().is_some_and(|fit| fit.gaussians == present.len()) {
                break;
            }
            let template = CompressedModel { sh_degree, ..template.clone() };
            fits.push(ByteLimitFit { sh_degree, gaussians: self.count(scene, (&sample, recipe), &template, journal)? });
        }
        Ok(fits)
    }

    /// Returns the cache key of everything on which the size of an output with the model `compressed` depends. `recipe`
    /// is the size of the recipe file beside the result, bytes.
    fn key(&self, scene: &Scene, recipe: u64, compressed: &CompressedModel) -> CacheKey {
        scene.work.key(&(self.writer.kind, self.writer.merges, self.most, recipe, compressed))
    }

    /// Returns how many Gaussians an output within the byte limit can hold. Sizes are measured on evenly spaced samples
    /// of the Gaussians in `sample`. `template` holds the other settings of the model, such as the SH degree; `recipe`
    /// is the size of the recipe file, bytes.
    ///
    /// # Errors
    /// Fails if not even one Gaussian fits, if frames cannot be read, or if a write fails.
    fn count(
        &self,
        scene: &Scene,
        (sample, recipe): (&Sample<'_>, u64),
        template: &CompressedModel,
        journal: &mut Journal,
    ) -> Result<usize> {
        let (all, most) = (sample.ids.len(), self.most);
        let beside = self.writer.companion_bytes(scene, recipe);
        let key = self.key(scene, recipe, template).extended_by(&sample.best);
        journal.run_cached_stage(NAME, all, scene, key, |_| {
            let bytes = |count: usize| {
                let some = template.with_kept(sample.pick(count));
                let written = match self.writer.kind {
                    OutputKind::Archive => archive::estimated_bytes(scene, &some)?,
                    _ => self.writer.output_bytes(scene, &some)?,
                };
                Ok::<u64, Error>(written + beside)
            };
            let one = 1.min(all);
            let least = bytes(one)?;
            if least > most {
                return Err(too_few_bytes(least, beside, most));
            }
            // Numbers of Gaussians with their bytes: `fits` is the largest number that fits, `over` the smallest that
            // does not.
            let (mut fits, mut over) = ((one, least), None);
            let (mut next, mut overs) = (all, 0);
            for _ in 0..MAX_TRIED {
                let found = bytes(next)?;
                if found <= most {
                    (fits, overs) = ((next, found), 0);
                } else {
                    (over, overs) = (Some((next, found)), overs + 1);
                }
                let Some(over) = over.filter(|over: &(usize, u64)| over.0 - fits.0 > 1) else { break };
                if most - fits.1 <= (MAX_UNUSED * most as f64) as u64 {
                    break;
                }
                let part = (most - fits.1) as f64 / (over.1 - fits.1).max(1) as f64;
                // Linear interpolation is slow if the first few Gaussians take most bytes, as in an archive.
                let part = if overs > 1 { part.min(0.5) } else { part };
                next = fits.0 + ((0.998 * part * (over.0 - fits.0) as f64) as usize).clamp(1, over.0 - fits.0 - 1);
            }
            Ok((fits.0, fits.0))
        })
    }

    /// Removes the Gaussians with the lowest removal error (squared error of renders caused by removing one) from
    /// `compressed` until the output fits the byte limit, and returns the smaller model. This is needed if refined
    /// values compress worse than the values with which the number of Gaussians was found. Gaussians that must stay are
    /// not removed. `recipe` is the size of the recipe file, bytes.
    ///
    /// # Errors
    /// Fails if the Gaussians that must stay do not fit alone, if frames cannot be read, or if a write fails.
    fn shrink(
        &self,
        scene: &Scene,
        scored: &Scored,
        mut compressed: CompressedModel,
        recipe: u64,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let key = self.key(scene, recipe, &compressed).extended_by(&scored.protected);
        journal.run_cached_stage(NAME, compressed.len(), scene, key, |_| {
            let beside = self.writer.companion_bytes(scene, recipe);
            let bytes = |some: &CompressedModel| Ok::<u64, Error>(self.writer.output_bytes(scene, some)? + beside);
            let empty = bytes(&compressed.pick(&[]))?;
            let mut tried = 0;
            loop {
                let found = bytes(&compressed)?;
                if found <= self.most {
                    let count = compressed.len();
                    return Ok((compressed, count));
                }
                let protected = scored.protected.len();
                if compressed.len() <= protected {
                    return Err(Error::usage(format!(
                        "--size: expected at least {found} bytes, the size of an output with only the \
                         {protected} Gaussians that are to be kept, found {}",
                        self.most
                    )));
                }
                let part = self.most.saturating_sub(empty) as f64 / found.saturating_sub(empty).max(1) as f64;
                let left = next_size(compressed.len(), protected, part, tried);
                tried += 1;
                let places = self.best(scene, scored, &compressed, left)?;
                compressed = compressed.pick(&places);
            }
        })
    }

    /// Chooses the `count` Gaussians of `compressed` that stay: those that must stay, then those with the highest
    /// removal errors (squared error of renders caused by removing one). Returns their indices in `compressed`.
    fn best(&self, scene: &Scene, scored: &Scored, compressed: &CompressedModel, count: usize) -> Result<Vec<u32>> {
        let result = scene.input.compressed_frames(compressed)?;
        let places: Vec<u32> = (0..compressed.len() as u32).collect();
        let views = select_evenly(&scene.schedule, RANKING_VIEWS, VIEWS_PER_FRAME);
        let looked_at = (&scene.schedule.cameras[..], &views[..]);
        let errors =
            removal_error(&*result, &places, looked_at, scene.background, (0.0, NonZeroU32::MIN), scene.limits, || ())?;
        Ok(errors.top_by_error(count, |place| scored.is_protected(compressed.kept[place])))
    }
}

/// Returns the number of Gaussians to try next if an output with `count` Gaussians takes too many bytes. `part`: number
/// of bytes that the Gaussians may take, divided by the number that they take. `protected`: number of Gaussians that
/// must stay, less than `count`. `tried`: number of sizes tried before.
///
/// The result is at least `protected` and less than `count`. Once [`MAX_TRIED`] sizes have been tried, it is at most
/// the larger of `count` / 2 and `protected`. So the search ends after at most 32 more sizes, no matter how the bytes
/// depend on the number of Gaussians.
fn next_size(count: usize, protected: usize, part: f64, tried: usize) -> usize {
    let most = if tried < MAX_TRIED { count - 1 } else { count / 2 };
    ((0.998 * part * count as f64) as usize).min(most).max(protected)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_holds_the_best_gaussian_and_is_increasing() {
        let ids = [2, 3, 5, 8, 13, 21];
        let picked = |best, count| Sample { ids: &ids, best }.pick(count);
        assert_eq!(picked(None, 3), [2, 5, 13]);
        assert_eq!(picked(Some(8), 1), [8]);
        assert_eq!(picked(Some(8), 3), [5, 8, 13]);
        assert_eq!(picked(Some(5), 3), [2, 5, 13]);
        assert_eq!(picked(Some(8), 6), ids);
        assert!(picked(Some(8), 0).is_empty());
    }

    #[test]
    fn shrinking_ends_whatever_the_bytes_are() {
        for (count, part) in
            (1..=50).chain([4_000_000_000]).flat_map(|n| [0.0, 0.5, 1.0, 1e9, f64::NAN].map(|p| (n, p)))
        {
            for protected in [0, count / 3, count - 1] {
                let (mut left, mut tried) = (count, 0);
                while left > protected {
                    let next = next_size(left, protected, part, tried);
                    assert!((protected..left).contains(&next), "{left} to {next}, {protected} protected, part {part}");
                    (left, tried) = (next, tried + 1);
                }
                assert!(tried <= MAX_TRIED + 33, "{tried} sizes of {count} tried");
            }
        }
    }
}
