//! Quantization steps of all groups of values (attributes and tensors) in an archive, balanced by their errors on
//! renders.

use std::collections::BTreeMap;

use crate::archive::{
    self, ATTRIBUTES, ArchiveContent, Column, FIRST_SH_ATTRIBUTE, QuantizationSteps, TensorRole, TensorSteps,
    nearest_step_number,
};
use crate::error::Result;
use crate::pipeline::stages::reference_views::{ReferenceViews, step_change};
use crate::progress::Progress;
use crate::scene::Scene;

/// Maximum quantization step of a group of values (an attribute or a tensor), in standard deviations of the values; a
/// coarser step would round nearly all values to the same number.
const MAX_STEP: f64 = 4.0;
/// Lower bound of the standard deviation from which the quantization step of a further column is computed, as a
/// fraction of the largest magnitude in the column. A further column holds values of the Gaussians that belong to no
/// attribute, such as velocities. If all its values are equal, this bound gives a step about as fine as the precision
/// of f32.
const MIN_RELATIVE_DEVIATION: f64 = 1e-6;

/// Group of values that share one quantization step.
#[derive(Debug, Clone)]
pub(super) enum ValueGroup {
    /// Attribute, by its index in [`ATTRIBUTES`].
    Attribute(usize),
    /// Further column of the Gaussians: its index, its name, and the index of an attribute that belongs to the same
    /// group. A column belongs with an attribute if the attribute holds the values at the first frame and the column
    /// those at all later frames. With a step of its own, the first frame could become far too coarse: the renders by
    /// which steps are chosen do not always show it.
    Column(usize, String, Option<usize>),
    /// Tensor of the deformation field, by name.
    Tensor(String),
}

impl ValueGroup {
    fn name(&self) -> &str {
        match self {
            ValueGroup::Attribute(k) => ATTRIBUTES[*k],
            ValueGroup::Column(_, name, _) | ValueGroup::Tensor(name) => name,
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

/// Quantization steps of all groups of values (attributes and tensors) in the content of an archive.
pub(super) struct Grids {
    /// All groups of values of the content.
    pub(super) groups: Vec<ValueGroup>,
    /// Standard deviation of the values of each group.
    deviations: Vec<f64>,
    /// Log2 of the quantization step of each group.
    octaves: Vec<f64>,
    /// For each tensor, by name: offsets that are added to the log2 of its quantization step, in eighths of an octave
    /// (doubling). A feature plane has one offset per channel; a matrix has one per row, then one per column; any other
    /// tensor has one per element. All offsets are 0 for a tensor without an entry or with an empty list. See
    /// [`TensorSteps::channels`].
    offsets: BTreeMap<String, Vec<i8>>,
}

impl Grids {
    pub(super) fn from_content(content: &ArchiveContent) -> Grids {
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
    pub(super) fn steps(&self, added: f64) -> QuantizationSteps {
        let mut steps = QuantizationSteps::default();
        for (group, octave) in self.groups.iter().zip(&self.octaves) {
            match group {
                ValueGroup::Attribute(k) => steps.cloud[*k] = nearest_step_number(octave + added),
                ValueGroup::Column(_, _, first_frame) => {
                    // The groups hold the columns in their order.
                    steps.columns.push(nearest_step_number(octave + added));
                    first_frame.iter().for_each(|&k| steps.cloud[k] = nearest_step_number(octave + added));
                }
                ValueGroup::Tensor(name) => _ = steps.field.0.insert(name.clone(), self.tensor(name, octave + added)),
            }
        }
        steps
    }

    fn tensor(&self, name: &str, octave: f64) -> TensorSteps {
        TensorSteps { step: nearest_step_number(octave), channels: self.offsets.get(name).cloned().unwrap_or_default() }
    }

    /// Measures the squared error of renders and the bits that every group of values causes. Then sets the quantization
    /// steps so that the error of each group is proportional to the bits that one octave of its step saves, and the sum
    /// of all errors is about `error`. Returns one entry per group: its name, log2 of its step before the change, its
    /// measured error, and its measured bits.
    pub(super) fn balance(
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
        let bits = |by_name: &BTreeMap<String, f64>, group: &ValueGroup| {
            let first_frame = if let ValueGroup::Column(.., Some(k)) = group { Some(ATTRIBUTES[*k]) } else { None };
            let names = [Some(group.name()), first_frame].into_iter().flatten();
            names.map(|name| by_name.get(name).copied().unwrap_or(0.0)).sum::<f64>()
        };
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
                    steps[*k] = nearest_step_number(octave);
                    archive::round_cloud(&mut content.cloud, &steps, &[*k]);
                    let found = reference_views.error(&*scene.input.decode_frames(content)?);
                    content.cloud = before;
                    found
                }
                ValueGroup::Column(k, _, first_frame) => {
                    let before = (content.columns[*k].clone(), first_frame.map(|_| content.cloud.clone()));
                    let step = nearest_step_number(octave);
                    archive::round_column(&mut content.columns[*k], step);
                    if let Some(attribute) = first_frame {
                        archive::round_cloud(&mut content.cloud, &[step; ATTRIBUTES.len()], &[*attribute]);
                    }
                    let found = reference_views.error(&*scene.input.decode_frames(content)?);
                    content.columns[*k] = before.0;
                    before.1.into_iter().for_each(|cloud| content.cloud = cloud);
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
    let attributes = FIRST_SH_ATTRIBUTE + content.cloud.sh_degree() + 1;
    let tensors = content.field.iter().filter(|(_, role)| !matches!(role, TensorRole::Exact | TensorRole::Unread));
    let column = |(k, column): (usize, &Column)| ValueGroup::Column(k, column.name.clone(), column.first_frame);
    let columns = content.columns.iter().enumerate().map(column);
    let is_in_column = |k: usize| content.columns.iter().any(|column| column.first_frame == Some(k));
    (0..attributes)
        .filter(|&k| !is_in_column(k))
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
        ValueGroup::Column(k, ..) => {
            let values = content.columns[*k].values.planes();
            let largest = values.iter().fold(0.0, |largest: f32, value| largest.max(value.abs()));
            // Values that are all equal keep about the precision of f32.
            deviation(&mut values.iter().copied()).max(f64::from(largest) * MIN_RELATIVE_DEVIATION)
        }
    };
    found.max(1e-9)
}
