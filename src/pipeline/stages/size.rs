//! Two stages, both named `size`, of a run with a requested size on disk. The first stage finds how many Gaussians fit
//! the size, before Gaussians are refined. Refined values may take more or fewer bytes. The second stage therefore
//! measures the result, and asks for a repetition of the reduction with another number of Gaussians if too many bytes
//! are left or missing. Finally it removes Gaussians until the result fits.

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
use crate::pruning::Ranking;
use crate::pruning::removal::removal_error;
use crate::pruning::score::Scored;
use crate::recipe::FieldPrecision;
use crate::render::ALL_PIXELS;
use crate::scene::Scene;

/// Name of both stages in plans, progress and summaries.
const NAME: &str = "size";
/// Fraction of the byte limit (requested size on disk) that may remain unused. The search for the number of Gaussians
/// that fit the limit ends once at most this fraction is unused.
const MAX_UNUSED: f64 = 0.01;
/// Maximum number of trials in the search for the number of Gaussians that fits the byte limit. Each trial writes an
/// output with one number of Gaussians and measures its bytes.
const MAX_TRIED: usize = 8;
/// Range of the bytes of a refined result, divided by the byte limit, in which its number of Gaussians is accepted. From
/// 1 to 1.02, a few Gaussians are removed without another refinement, which costs little quality. Below 0.9, more
/// Gaussians would give clearly better renders.
const ACCEPTED_BYTES: std::ops::RangeInclusive<f64> = 0.9..=1.02;
/// Fraction of the bytes that are left for Gaussians at which a repetition of the reduction aims.
const REPEATED_AIM: f64 = 0.97;
/// Maximum number of repetitions of the reduction with another number of Gaussians.
const MAX_REPEATS: usize = 2;
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
        stages.add(Phase::Reduce, ShrinkToBytes { limit, repeats: planning.refine.is_some() });
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
        let scored = run.scored()?;
        let ranking = &scored.selection.ranking;
        run.counts_within_bytes = self.limit.fits(run.scene, ranking, &template, self.drops_bands, &mut run.journal)?;
        run.target = run.counts_within_bytes.first().map(|fit| fit.gaussians);
        Ok(())
    }
}

/// Stage that removes Gaussians from a result whose files exceed the requested size on disk, or asks for a repetition
/// with another number of Gaussians.
#[derive(Debug)]
struct ShrinkToBytes {
    limit: ByteLimit,
    /// Whether the reduction may be repeated. Without refinement, values take the bytes that were measured before.
    repeats: bool,
}

impl Stage for ShrinkToBytes {
    fn estimates(&self, _: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        Vec::new()
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, result) = (run.scored()?, run.take_result());
        let may_repeat = self.repeats && run.repeats < MAX_REPEATS;
        let repeat_up_to = may_repeat.then(|| scored.selection.ranking.order().len());
        let (result, next) = self.limit.shrink(run.scene, &scored, result, repeat_up_to, &mut run.journal)?;
        run.result = result;
        if next.is_some() {
            (run.target, run.repeats) = (next, run.repeats + 1);
        }
        Ok(())
    }
}

/// Returns the error for a size on disk of `most` bytes, which is less than the `least` bytes of an output with one
/// Gaussian.
fn too_few_bytes(least: u64, most: u64) -> Error {
    Error::usage(format!(
        "--size: expected at least {least} bytes, found {most}\n  {least} bytes is the size of an output with one \
         Gaussian; most of it does not depend on the number of Gaussians (file header, deformation network)\n  ask for \
         more bytes"
    ))
}

/// Limit on the bytes of the output file, or of the model files in the output folder. Recipe, index map and summary do
/// not count: no renderer reads them.
#[derive(Debug, Clone)]
struct ByteLimit {
    /// Stage that writes the output files; used to measure the size of a result.
    writer: WriteStage,
    /// Maximum number of bytes of the output.
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

    /// Returns how many Gaussians of `ranking` fit the byte limit ([`ByteLimit::count`]), for one or more SH degrees:
    /// - if `drops` is false, for the degree of `template` only;
    /// - if `drops` is true, also for lower degrees in decreasing order, up to the first degree at which all Gaussians
    ///   fit.
    ///
    /// `template` holds the other settings of the model.
    ///
    /// # Errors
    /// Fails in the cases in which [`ByteLimit::count`] fails.
    fn fits(
        &self,
        scene: &Scene,
        ranking: &Ranking,
        template: &CompressedModel,
        drops: bool,
        journal: &mut Journal,
    ) -> Result<Vec<ByteLimitFit>> {
        let highest = template.sh_degree.min(scene.source().info().sh_degree);
        let lowest = if drops && scene.input.description().reason_to_keep_sh_degree.is_none() { 0 } else { highest };
        let mut fits: Vec<ByteLimitFit> = Vec::new();
        for sh_degree in (lowest..=highest).rev() {
            if fits.last().is_some_and(|fit| fit.gaussians == ranking.order().len()) {
                break;
            }
            let template = CompressedModel { sh_degree, ..template.clone() };
            fits.push(ByteLimitFit { sh_degree, gaussians: self.count(scene, ranking, &template, journal)? });
        }
        Ok(fits)
    }

    /// Returns the cache key of everything on which the size of an output with the model `compressed` depends.
    fn key(&self, scene: &Scene, compressed: &CompressedModel) -> CacheKey {
        scene.work.key(&(self.writer.kind, self.writer.merges, self.most, compressed))
    }

    /// Returns how many Gaussians an output within the byte limit can hold. Sizes are measured with the first Gaussians
    /// of `ranking`, because the bytes of a Gaussian may depend on its motion and life span, which differ between
    /// Gaussians that stay and those that are removed. `template` holds the other settings of the model, such as the SH
    /// degree.
    ///
    /// # Errors
    /// Fails if not even one Gaussian fits, if frames cannot be read, or if a write fails.
    fn count(
        &self,
        scene: &Scene,
        ranking: &Ranking,
        template: &CompressedModel,
        journal: &mut Journal,
    ) -> Result<usize> {
        let (all, most) = (ranking.order().len(), self.most);
        let key = self.key(scene, template).extended_by(ranking);
        journal.run_cached_stage(NAME, all, scene, key, |_| {
            let bytes = |count: usize| {
                let some = template.with_kept(ranking.best_ids(count));
                match self.writer.kind {
                    OutputKind::Archive => archive::estimated_bytes(scene, &some),
                    _ => self.writer.output_bytes(scene, &some),
                }
            };
            let one = 1.min(all);
            let least = bytes(one)?;
            if least > most {
                return Err(too_few_bytes(least, most));
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
    /// not removed.
    ///
    /// If the bytes are far from the limit ([`ACCEPTED_BYTES`]) and the reduction may be repeated with up to
    /// `repeat_up_to` Gaussians, returns `compressed` as it is, and the number of Gaussians for the repetition.
    ///
    /// # Errors
    /// Fails if the Gaussians that must stay do not fit alone, if frames cannot be read, or if a write fails.
    fn shrink(
        &self,
        scene: &Scene,
        scored: &Scored,
        mut compressed: CompressedModel,
        repeat_up_to: Option<usize>,
        journal: &mut Journal,
    ) -> Result<(CompressedModel, Option<usize>)> {
        let key = self.key(scene, &compressed).extended_by(&(&scored.protected, repeat_up_to));
        journal.run_cached_stage(NAME, compressed.len(), scene, key, |_| {
            let bytes = |some: &CompressedModel| self.writer.output_bytes(scene, some);
            let empty = bytes(&compressed.pick(&[]))?;
            let (mut tried, protected) = (0, scored.protected.len());
            let mut found = bytes(&compressed)?;
            let count = compressed.len();
            let next = repeat_up_to.and_then(|most| {
                let wanted = self.repeated_count(count, found, empty)?;
                Some(wanted.clamp(protected.max(1).min(most), most))
            });
            if next.is_some_and(|next| next != count) {
                return Ok(((compressed, next), count));
            }
            loop {
                if found <= self.most {
                    let count = compressed.len();
                    return Ok(((compressed, None), count));
                }
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
                found = bytes(&compressed)?;
            }
        })
    }

    /// Returns the number of Gaussians that is expected to use the bytes left for Gaussians, up to the fraction
    /// [`REPEATED_AIM`]. The output takes `found` bytes with `count` Gaussians and `empty` bytes without any. Returns
    /// `None` if `found` is accepted, or if the output exceeds the limit even without Gaussians.
    fn repeated_count(&self, count: usize, found: u64, empty: u64) -> Option<usize> {
        let room = self.most.checked_sub(empty).filter(|&room| room > 0)?;
        let is_accepted = ACCEPTED_BYTES.contains(&(found as f64 / self.most as f64));
        let per_byte = count as f64 / found.saturating_sub(empty).max(1) as f64;
        (!is_accepted).then_some((REPEATED_AIM * room as f64 * per_byte) as usize)
    }

    /// Chooses the `count` Gaussians of `compressed` that stay: those that must stay, then those with the highest
    /// removal errors (squared error of renders caused by removing one). Returns their indices in `compressed`.
    fn best(&self, scene: &Scene, scored: &Scored, compressed: &CompressedModel, count: usize) -> Result<Vec<u32>> {
        let result = scene.input.compressed_frames(compressed)?;
        let places: Vec<u32> = (0..compressed.len() as u32).collect();
        let views = select_evenly(&scene.schedule, RANKING_VIEWS, VIEWS_PER_FRAME);
        let looked_at = (&scene.schedule.cameras[..], &views[..]);
        let errors =
            removal_error(&*result, &places, looked_at, scene.background, (0.0, ALL_PIXELS), scene.limits, || ())?;
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
