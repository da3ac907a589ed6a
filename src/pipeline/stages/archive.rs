//! Stage `archive`: chooses the quantization steps of the values in an archive (compact file of the result).
//!
//! Errors of quantization add up. If one group of values (an attribute or a tensor) is quantized alone, two things
//! hold: the squared error of renders is proportional to the square of its quantization step, and each octave
//! (doubling) of the step saves about one bit per value. For a given total error, the archive has the fewest bits if
//! the error of every group is proportional to the bits that one octave saves in this group (reverse water-filling;
//! Cover & Thomas, "Elements of Information Theory", 10.3.3). So the stage measures the bits of every group and its
//! error on renders, and sets the steps by this rule. Then it makes all steps together as coarse as the quality of
//! renders of the archive allows.

use std::collections::BTreeMap;

use super::bounds;
use crate::archive::{
    self, ATTRIBUTES, ArchiveContent, EncodedArchive, QuantizationSteps, STEP_NUMBERS, TensorRole, TensorSteps,
};
use crate::compressed_model::CompressedModel;
use crate::error::{Error, ErrorKind, Result};
use crate::journal::Journal;
use crate::journal::as_toml::AsToml;
use crate::limits::{Limits, ReadLimit};
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload};
use crate::model::Attributes;
use crate::outputs::kind::OutputKind;
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Goal;
use crate::pipeline::stage::{EstimateInput, Phase, PreparedArchive, RunState, Stage, StageList};
use crate::pipeline::stages::reference_views::{
    ARCHIVE_HEADROOM, ArchiveTarget, BALANCING_ROUNDS, BYTES_OCTAVE_HALVINGS, BYTES_OCTAVE_RANGE, BYTES_PER_PIXEL,
    OCTAVE_HALVINGS, OCTAVE_RANGE, QualityTarget, ReferenceViews, bisect, check_measurable, check_met, step_change,
    view_count,
};
use crate::pipeline::summary::ArchiveSummary;
use crate::progress::Progress;
use crate::render;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "archive";
/// Maximum quantization step of a group of values (an attribute or a tensor), in standard deviations of the values; a
/// coarser step would round nearly all values to the same number.
const MAX_STEP: f64 = 4.0;
/// Lower bound of the standard deviation from which the quantization step of a further column is computed, as a
/// fraction of the largest magnitude in the column. A further column holds values of the Gaussians that belong to no
/// attribute, such as velocities. If all its values are equal, this bound gives a step about as fine as the precision
/// of f32.
const MIN_RELATIVE_DEVIATION: f64 = 1e-6;
/// The size of an archive is estimated without rendering, with the initial quantization steps made coarser by this
/// number of octaves (doublings). The estimate decides how many Gaussians a result of at most `--size` bytes keeps;
/// with this value, quantization then costs 0.5 and 1.2 dB PSNR on two trained models.
const ESTIMATE_OCTAVES: f64 = 3.3;

/// Stage that quantizes and encodes the result as an archive.
#[derive(Debug, Clone, PartialEq)]
pub struct ArchiveStage {
    /// Required PSNR, dB, of renders of the archive against renders of the result before quantization. `None`: derived
    /// from the goal of the run or from a default.
    pub psnr: Option<f64>,
}

/// Adds the stage that makes an archive to `stages` if the output is an archive.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if planning.output == OutputKind::Archive {
        stages.add(Phase::Write, ArchiveStage { psnr: planning.request.archive_psnr });
    }
}

impl Stage for ArchiveStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let asked = match (&run.goal, &run.request.goal) {
            (Some(goal), _) => ArchiveTarget::Loss(goal.searched - goal.asked),
            (None, Some(Goal::Bytes(most))) => ArchiveTarget::Bytes(*most),
            _ => ArchiveTarget::Nothing,
        };
        let (archived, archive) = self.archive(run.scene, &run.result, asked, &mut run.journal)?;
        if let Some(goal) = &mut run.goal {
            (goal.searched, goal.held) = (goal.searched - archive.loss, goal.held - archive.loss);
            run.journal.notes.push(format!(
                "archive: quantization costs {:.2} dB of the {ARCHIVE_HEADROOM} dB that the search reserved for it; at \
                 least {} dB PSNR requested, {:.2} dB on the views of the search, {:.2} dB on the other views",
                archive.loss, goal.asked, goal.searched, goal.held
            ));
        }
        (run.archived, run.archive) = (Some(archived), Some(archive));
        Ok(())
    }
}

/// Group of values that share one quantization step: an attribute (by index), a further column of the Gaussians (by
/// index and name) or a tensor of the deformation field (by name).
#[derive(Debug, Clone)]
enum ValueGroup {
    Attribute(usize),
    Column(usize, String),
    Tensor(String),
}

impl ValueGroup {
    fn name(&self) -> &str {
        match self {
            ValueGroup::Attribute(k) => ATTRIBUTES[*k],
            ValueGroup::Column(_, name) | ValueGroup::Tensor(name) => name,
        }
    }

    /// Returns the number of initial quantization steps in one standard deviation of the values of this group. The
    /// stage starts with these steps and then adapts them to the quality of renders; most final steps are coarser.
    fn initial_steps(&self) -> f64 {
        match self {
            ValueGroup::Attribute(0) => 512.0,
            ValueGroup::Attribute(_) => 24.0,
            ValueGroup::Column(..) => 64.0,
            ValueGroup::Tensor(name) if name.ends_with("bias") => 64.0,
            ValueGroup::Tensor(_) => 16.0,
        }
    }
}

impl ArchiveStage {
    /// Returns the resource estimate of the stage. Its memory holds the result, its renders, the archive and the
    /// decoded archive.
    pub fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let whole = work.state_bytes(Attributes::all());
        let count = view_count(work.pixels);
        // About forty groups of values are quantized alone in every balancing round, and all together in each halving.
        let renders = count as f64 * (2.0 * OCTAVE_HALVINGS as f64 + BALANCING_ROUNDS as f64 * 40.0);
        ResourceEstimate {
            stage: NAME,
            reads: 1.0,
            seconds: work.render_seconds(renders, 0.3 * work.gaussian_count(), RENDER_COST),
            per_gaussian: vec![
                ("states", whole),
                ("readers", work.input.reader),
                ("kept frames", work.kept_frames_bytes(limits, Attributes::all())),
                ("views", SHARED_VIEW_BYTES_PER_GAUSSIAN),
                ("contents", 4 * whole),
            ],
            fixed: vec![
                ("views", BYTES_PER_PIXEL * (2 * count + work.threads) * work.pixels),
                ("strips", work.threads * render::STRIP_BYTES as u64),
                ("fields", 4 * work.input.fixed),
                // An archive of frames also encodes a few blocks of Gaussians.
                ("blocks", bounds::storing_memory(work).iter().map(|part| part.1).sum()),
            ],
        }
    }

    /// Makes an archive of `compressed` that meets the quality or size `archive_target`. Returns its content and its
    /// summary.
    ///
    /// # Errors
    /// Fails if the input cannot be archived, if values or renders are not finite, if frames cannot be read, if the
    /// required PSNR is missed by far (`check_met`), or if even the coarsest archive of these Gaussians exceeds the
    /// byte limit.
    pub fn archive(
        &self,
        scene: &Scene,
        compressed: &CompressedModel,
        archive_target: ArchiveTarget,
        journal: &mut Journal,
    ) -> Result<(PreparedArchive, ArchiveSummary)> {
        let key = scene.work.key(&(self.psnr, archive_target, compressed));
        let (archived, AsToml(summary)) = journal.run_cached_stage(NAME, compressed.len(), scene, key, |_| {
            let (archived, summary) = match scene.input.archives_as_frames() {
                true => {
                    let left = scene.input.compressed_frames(compressed)?;
                    let (bounds, summary) = bounds::find(scene, &*left, self.psnr, archive_target)?;
                    (PreparedArchive::Frames(bounds), summary)
                }
                false => {
                    let (encoded, summary) = self.make(scene, compressed, archive_target)?;
                    (PreparedArchive::Content(encoded), summary)
                }
            };
            Ok(((archived, AsToml(summary)), compressed.len()))
        })?;
        Ok((archived, summary))
    }

    fn make(
        &self,
        scene: &Scene,
        compressed: &CompressedModel,
        archive_target: ArchiveTarget,
    ) -> Result<(EncodedArchive, ArchiveSummary)> {
        let mut content = scene.input.archive_content(compressed)?;
        let reference_views = ReferenceViews::new(scene, &*scene.input.decode_frames(&content)?)?;
        let original = ReferenceViews::new(scene, scene.source())?;
        let level = check_measurable(reference_views.psnr(scene.source())?)?;
        let quality_target = QualityTarget::new(self.psnr, archive_target, level);
        let required_psnr = quality_target.required_psnr(level);
        let mut grids = Grids::from_content(&content);
        let mut measured = Vec::new();
        let halvings =
            if matches!(quality_target, QualityTarget::Bytes(_)) { BYTES_OCTAVE_HALVINGS } else { OCTAVE_HALVINGS };
        let measurements = BALANCING_ROUNDS * grids.groups.len() + halvings;
        let progress = scene.events.task(NAME, "measurements", measurements as u64);
        for _ in 0..BALANCING_ROUNDS {
            measured =
                grids.balance(scene, &reference_views, &mut content, 10f64.powf(-0.1 * required_psnr), &progress)?;
        }
        let encoded = |added: f64| {
            progress.advance(1);
            archive::encode(&content, &grids.steps(added))
        };
        let measure_frames = |encoded: EncodedArchive, shown: Box<dyn FrameSource + '_>| -> Result<_> {
            Ok((encoded, [reference_views.psnr(&*shown)?, level - original.psnr(&*shown)?]))
        };
        let decoded = |encoded: &EncodedArchive| -> Result<Box<dyn FrameSource + '_>> {
            let (decoded, _) = archive::decode(&encoded.bytes, &scene.path, ReadLimit::NONE)?;
            scene.input.decode_frames(&decoded)
        };
        let measure_views = |encoded: EncodedArchive| {
            let shown = decoded(&encoded)?;
            measure_frames(encoded, shown)
        };
        let (encoded, [psnr, loss]) = match quality_target {
            QualityTarget::Bytes(most) => {
                // Take the finest quantization steps with which the archive fits the byte limit.
                let fits = |finer: f64| Ok(Some(encoded(-finer)?).filter(|found| found.bytes.len() as u64 <= most));
                measure_views(match bisect(BYTES_OCTAVE_RANGE.map(|added| -added), BYTES_OCTAVE_HALVINGS, fits)? {
                    Some(best) => best,
                    None => check_coarsest(encoded(BYTES_OCTAVE_RANGE[0])?, most, compressed.len())?,
                })?
            }
            QualityTarget::Close(_) | QualityTarget::Loss(_) => {
                let best = bisect(OCTAVE_RANGE, OCTAVE_HALVINGS, |added| {
                    let encoded = encoded(added)?;
                    let shown = match decoded(&encoded) {
                        // The reader of a model format may refuse values that coarse steps have made zero.
                        Err(error) if error.kind() == ErrorKind::Input => return Ok(None),
                        shown => shown?,
                    };
                    Ok(Some(measure_frames(encoded, shown)?)
                        .filter(|&(_, found)| quality_target.is_met_by(found, required_psnr)))
                })?;
                best.map_or_else(|| measure_views(encoded(OCTAVE_RANGE[0])?), Ok)?
            }
        };
        check_met(quality_target, required_psnr, psnr)?;
        let (parts, bits) = (encoded.parts, encoded.bits.clone());
        Ok((
            encoded,
            ArchiveSummary {
                asked: required_psnr,
                psnr,
                level,
                loss,
                parts: Some(parts),
                bounds: None,
                bits,
                measured,
            },
        ))
    }
}

/// Returns the estimated size, in bytes, of an archive of `compressed`: the size with fixed quantization steps or error
/// bounds, for which nothing has to be rendered.
///
/// # Errors
/// Fails if the input cannot be archived or values are not finite.
pub fn estimated_bytes(scene: &Scene, compressed: &CompressedModel) -> Result<u64> {
    if scene.input.archives_as_frames() {
        return bounds::bytes(scene, &*scene.input.compressed_frames(compressed)?);
    }
    let content = scene.input.archive_content(compressed)?;
    Ok(archive::encode(&content, &Grids::from_content(&content).steps(ESTIMATE_OCTAVES))?.bytes.len() as u64)
}

/// Checks that `encoded`, the archive of `gaussians` Gaussians with the coarsest quantization steps, has at most `most`
/// bytes, and returns it. Fails if it has more.
fn check_coarsest(encoded: EncodedArchive, most: u64, gaussians: usize) -> Result<EncodedArchive> {
    let least = encoded.bytes.len();
    if least as u64 > most {
        return Err(Error::usage(format!(
            "--size: expected at least {least} bytes, the size of an archive of {gaussians} Gaussians with the \
             coarsest quantization, found {most}"
        )));
    }
    Ok(encoded)
}

/// Quantization steps of all groups of values (attributes and tensors) in the content of an archive.
struct Grids {
    groups: Vec<ValueGroup>,
    /// Standard deviation of the values of each group (attribute, column or tensor) in `groups`.
    deviations: Vec<f64>,
    /// Log2 of the quantization step of each group (attribute, column or tensor) in `groups`.
    octaves: Vec<f64>,
    /// For each tensor, by name: offsets that are added to the log2 of its quantization step, in eighths of an octave
    /// (doubling). A feature plane has one offset per channel; a matrix has one per row, then one per column; any other
    /// tensor has one per element. All offsets are 0 for a tensor without an entry or with an empty list. See
    /// [`TensorSteps::channels`].
    offsets: BTreeMap<String, Vec<i8>>,
}

impl Grids {
    fn from_content(content: &ArchiveContent) -> Grids {
        let groups = groups(content);
        let deviations: Vec<f64> = groups.iter().map(|group| deviation(content, group)).collect();
        let first = |(group, deviation): (&ValueGroup, &f64)| (deviation / group.initial_steps()).log2();
        let octaves = groups.iter().zip(&deviations).map(first).collect();
        let space = archive::field_box(content);
        let offsets =
            archive::step_offsets(&content.field, &content.tensors, &content.cloud.position, space, content.times);
        Grids { groups, deviations, octaves, offsets }
    }

    /// Returns the quantization steps of all groups, each made coarser by `added` octaves (doublings).
    fn steps(&self, added: f64) -> QuantizationSteps {
        let mut steps = QuantizationSteps::default();
        for (group, octave) in self.groups.iter().zip(&self.octaves) {
            match group {
                ValueGroup::Attribute(k) => steps.cloud[*k] = nearest_step(octave + added),
                // The groups hold the columns in their order.
                ValueGroup::Column(..) => steps.columns.push(nearest_step(octave + added)),
                ValueGroup::Tensor(name) => _ = steps.field.0.insert(name.clone(), self.tensor(name, octave + added)),
            }
        }
        steps
    }

    fn tensor(&self, name: &str, octave: f64) -> TensorSteps {
        TensorSteps { step: nearest_step(octave), channels: self.offsets.get(name).cloned().unwrap_or_default() }
    }

    /// Measures the squared error of renders and the bits that every group of values causes. Then sets the quantization
    /// steps so that the error of each group is proportional to the bits that one octave of its step saves, and the sum
    /// of all errors is about `error`. Returns one entry per group: its name, log2 of its step before the change, its
    /// measured error, and its measured bits.
    fn balance(
        &mut self,
        scene: &Scene,
        reference_views: &ReferenceViews<'_>,
        content: &mut ArchiveContent,
        error: f64,
        progress: &Progress,
    ) -> Result<Vec<(String, f64, f64, f64)>> {
        let errors = self.errors(scene, reference_views, content, progress)?;
        let fine = archive::encode(content, &self.steps(0.0))?.bits;
        let coarse = archive::encode(content, &self.steps(0.5))?.bits;
        let bits =
            |by_name: &BTreeMap<String, f64>, group: &ValueGroup| by_name.get(group.name()).copied().unwrap_or(0.0);
        // At least 1: a group whose bits no longer fall could otherwise become coarser without end.
        let saved = |group: &ValueGroup| {
            (2.0 * (bits(&fine, group) - bits(&coarse, group))).max(1.0 + 0.05 * bits(&fine, group))
        };
        let saved: Vec<f64> = self.groups.iter().map(saved).collect();
        let all: f64 = saved.iter().sum();
        let mut measured = Vec::with_capacity(self.groups.len());
        for (g, group) in self.groups.iter().enumerate() {
            measured.push((group.name().to_owned(), self.octaves[g], errors[g], bits(&fine, group)));
            let by = step_change(error * saved[g] / all, errors[g]);
            let coarsest = (MAX_STEP * self.deviations[g]).log2();
            self.octaves[g] = (self.octaves[g] + by).min(coarsest);
        }
        Ok(measured)
    }

    /// Returns for each group of values (attribute, column or tensor) the squared error of renders if only this group
    /// is quantized and all others are exact. Changes `content` for every measurement and restores it afterward.
    fn errors(
        &self,
        scene: &Scene,
        reference_views: &ReferenceViews<'_>,
        content: &mut ArchiveContent,
        progress: &Progress,
    ) -> Result<Vec<f64>> {
        let space = archive::field_box(content);
        let one = |(group, &octave): (&ValueGroup, &f64)| -> Result<f64> {
            progress.advance(1);
            match group {
                ValueGroup::Attribute(k) => {
                    let before = content.cloud.clone();
                    let mut steps = [0; ATTRIBUTES.len()];
                    steps[*k] = nearest_step(octave);
                    archive::round_cloud(&mut content.cloud, &steps, &[*k]);
                    let found = reference_views.error(&*scene.input.decode_frames(content)?);
                    content.cloud = before;
                    found
                }
                ValueGroup::Column(k, _) => {
                    let before = content.columns[*k].clone();
                    archive::round_column(&mut content.columns[*k], nearest_step(octave));
                    let found = reference_views.error(&*scene.input.decode_frames(content)?);
                    content.columns[*k] = before;
                    found
                }
                ValueGroup::Tensor(name) => {
                    let (before, role) = (content.tensors[name].clone(), content.field[name]);
                    let steps = self.tensor(name, octave);
                    let rounded = archive::round_tensor(&before, role, &steps, &content.cloud.position, space);
                    content.tensors.insert(name.clone(), rounded);
                    let found = reference_views.error(&*scene.input.decode_frames(content)?);
                    content.tensors.insert(name.clone(), before);
                    found
                }
            }
        };
        self.groups.iter().zip(&self.octaves).map(one).collect()
    }
}

fn groups(content: &ArchiveContent) -> Vec<ValueGroup> {
    let attributes = 4 + content.cloud.sh_degree() + 1;
    let tensors = content.field.iter().filter(|(_, role)| !matches!(role, TensorRole::Exact | TensorRole::Unread));
    let columns = content.columns.iter().enumerate().map(|(k, column)| ValueGroup::Column(k, column.name.clone()));
    (0..attributes)
        .map(ValueGroup::Attribute)
        .chain(columns)
        .chain(tensors.map(|(name, _)| ValueGroup::Tensor(name.clone())))
        .collect()
}

/// Returns the standard deviation of the values of `group` in `content`, at least 1e-9.
fn deviation(content: &ArchiveContent, group: &ValueGroup) -> f64 {
    let deviation = |values: &mut dyn Iterator<Item = f32>| {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        values.for_each(|value| {
            let value = f64::from(value);
            count += 1.0;
            sum += value;
            squares += value * value;
        });
        (squares / f64::max(count, 1.0) - (sum / f64::max(count, 1.0)).powi(2)).max(0.0).sqrt()
    };
    let found = match group {
        ValueGroup::Tensor(name) => deviation(&mut content.tensors[name].data.iter().copied()),
        ValueGroup::Attribute(k) => deviation(&mut archive::attribute_values(&content.cloud, *k)),
        ValueGroup::Column(k, _) => {
            let values = content.columns[*k].values.planes();
            let largest = values.iter().fold(0.0, |largest: f32, value| largest.max(value.abs()));
            // Values that are all equal keep about the precision of f32.
            deviation(&mut values.iter().copied()).max(f64::from(largest) * MIN_RELATIVE_DEVIATION)
        }
    };
    found.max(1e-9)
}

/// Returns the number k of the quantization step 2^(k/8) that is nearest to 2^`octave`, limited to the valid numbers
/// [`STEP_NUMBERS`].
fn nearest_step(octave: f64) -> i32 {
    ((8.0 * octave).round() as i32).clamp(*STEP_NUMBERS.start(), *STEP_NUMBERS.end())
}
