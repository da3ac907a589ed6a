//! Reads and writes Gaussians as rows of the tensors of a checkpoint.
//!
//! Input: an open checkpoint and the meaning of its tensors. Output: the stored parameters of all Gaussians, and the
//! checkpoint with fewer rows. Memory: the stored parameters, and one tensor at a time.

use std::path::Path;

use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::checkpoint::write::{GaussianRows, write_like};
use crate::files::checkpoint::{Checkpoint, NodeId, TensorView};
use crate::files::defects::INFINITE_LOGIT_REPAIR;
use crate::model::{AttributeValues, Attributes, Gaussians, StoredParams, finite_logit};
use crate::models::trajectories::state_bytes;

/// Meaning of one value in a tensor's row (the values of one Gaussian).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::models) enum RowElement {
    /// Component of an attribute: the attribute, and the index of the component in it.
    Attribute(Attributes, usize),
    /// Parameter with this index in [`StoredParams::format_specific`], which only this model format has.
    FormatSpecific(usize),
    /// Value that the states of Gaussians do not depend on.
    Unread,
}

impl RowElement {
    /// Returns the meaning of `count` consecutive values in a tensor's row: the components of the attribute `column`,
    /// beginning with component `skipped`.
    pub(in crate::models) fn all_of(column: Attributes, skipped: usize, count: usize) -> Vec<RowElement> {
        (skipped..skipped + count).map(|c| RowElement::Attribute(column, c)).collect()
    }

    /// Returns the meaning of `count` consecutive values in a tensor's row that are format-specific parameters: value k
    /// is the parameter with index `first` + k in [`StoredParams::format_specific`].
    pub(in crate::models) fn format_specific(first: usize, count: usize) -> Vec<RowElement> {
        (first..first + count).map(RowElement::FormatSpecific).collect()
    }

    /// Returns the values that `raw` holds for this element of a row, one per Gaussian; `None` for
    /// [`RowElement::Unread`].
    fn get(self, raw: &StoredParams) -> Option<&[f32]> {
        match self {
            RowElement::Attribute(column, c) => Some(raw.gaussians.attribute_values(column).plane(c)),
            RowElement::FormatSpecific(c) => Some(raw.format_specific.plane(c)),
            RowElement::Unread => None,
        }
    }
}

/// Tensor whose rows hold parameters of Gaussians: row i holds those of Gaussian i.
#[derive(Debug)]
struct Param {
    name: String,
    tensor: TensorView,
    /// Meaning of each value in a row of the tensor, in order. A row holds the values of one Gaussian.
    elements: Vec<RowElement>,
}

/// Tensors of a checkpoint that have one row per Gaussian.
#[derive(Debug)]
pub(in crate::models) struct RowTensors {
    checkpoint: Checkpoint,
    /// Number of Gaussians.
    count: usize,
    params: Vec<Param>,
    /// Tensors that only the training reads, such as the state of the optimizer. They have one row per Gaussian, too.
    training_only: Vec<TensorView>,
}

/// Reader of the parameters of Gaussians from the tensors of a checkpoint.
#[derive(Debug)]
pub(in crate::models) struct CheckpointReader {
    /// Tensors of the checkpoint that have been read so far.
    pub(in crate::models) tensors: RowTensors,
    /// Parameters of all Gaussians. Parameters from tensors that have not been read yet are zero.
    pub(in crate::models) raw: StoredParams,
    /// Number of infinite opacity logits that have been replaced so far.
    infinite_logits: usize,
}

impl CheckpointReader {
    /// Creates a reader for `count` Gaussians with `width` format-specific parameters each; all values are still zero.
    ///
    /// # Errors
    /// Fails if this needs more memory than allowed.
    pub(in crate::models) fn new(
        checkpoint: Checkpoint,
        count: usize,
        sh_degree: usize,
        width: usize,
    ) -> Result<CheckpointReader> {
        let row = state_bytes(sh_degree, Attributes::all()) + 4 * width as u64;
        checkpoint.allow("", &format!("its {count} Gaussians"), row.saturating_mul(count as u64))?;
        let raw = StoredParams {
            gaussians: Gaussians::zeros(count, sh_degree),
            format_specific: AttributeValues::zeros(width, count),
        };
        Ok(CheckpointReader {
            tensors: RowTensors { checkpoint, count, params: Vec::new(), training_only: Vec::new() },
            raw,
            infinite_logits: 0,
        })
    }

    /// Returns a note for the user on the infinite opacity logits that have been replaced; `None` if there were none.
    pub(in crate::models) fn note(&self) -> Option<String> {
        let (replaced, all) = (self.infinite_logits, self.tensors.count);
        (replaced > 0)
            .then(|| format!("{replaced} of {all} rows repaired: infinite opacity logit; {INFINITE_LOGIT_REPAIR}"))
    }

    /// Reads the tensor at the node `id` of the checkpoint. `name` names it in error messages. `row` is its expected
    /// shape without the first axis, which counts the Gaussians. `elements` is the meaning of each value in a row (the
    /// values of one Gaussian).
    ///
    /// # Errors
    /// Fails if there is no floating-point tensor of that shape, or if values are missing. Values may be NaN; infinite
    /// opacity logits become ±[`INFINITE_LOGIT`](crate::model::INFINITE_LOGIT).
    pub(in crate::models) fn read(
        &mut self,
        id: NodeId,
        name: &str,
        row: &[usize],
        elements: Vec<RowElement>,
    ) -> Result<()> {
        let checkpoint = &self.tensors.checkpoint;
        let tensor = checkpoint.float_tensor(id, name)?;
        let shape = [&[self.tensors.count], row].concat();
        if tensor.shape != shape {
            return Err(checkpoint.wrong(name, format!("shape {shape:?}"), format!("shape {:?}", tensor.shape)));
        }
        let values = checkpoint.values(&tensor, name)?;
        let width = elements.len();
        for (c, element) in elements.iter().enumerate() {
            let to = match *element {
                RowElement::Attribute(column, plane) => {
                    self.raw.gaussians.attribute_values_mut(column).plane_mut(plane)
                }
                RowElement::FormatSpecific(plane) => self.raw.format_specific.plane_mut(plane),
                RowElement::Unread => continue,
            };
            to.iter_mut().zip(values.iter().skip(c).step_by(width)).for_each(|(to, from)| *to = *from);
            if *element == RowElement::Attribute(Attributes::OPACITY, 0) {
                self.infinite_logits += to.iter().filter(|logit| logit.is_infinite()).count();
                to.iter_mut().for_each(|logit| *logit = finite_logit(*logit));
            }
        }
        self.tensors.params.push(Param { name: name.to_owned(), tensor, elements });
        Ok(())
    }

    /// Adds the tensor at the node `id` of the checkpoint to the list of tensors that only the training reads. Ignores
    /// a tensor that does not have one row per Gaussian.
    pub(in crate::models) fn add_training_tensor(&mut self, id: NodeId) {
        let tensor =
            self.tensors.checkpoint.tensor(id).filter(|tensor| tensor.shape.first() == Some(&self.tensors.count));
        self.tensors.training_only.extend(tensor);
    }
}

/// Returns the number of rows of the tensor at the node `id`, which error messages call `name`.
///
/// # Errors
/// Fails if there is no tensor with rows.
pub(in crate::models) fn row_count(checkpoint: &Checkpoint, id: NodeId, name: &str) -> Result<usize> {
    let tensor = checkpoint.float_tensor(id, name)?;
    let rows = tensor.shape.first().copied();
    rows.ok_or_else(|| checkpoint.wrong(name, "a row per Gaussian", tensor.describe()))
}

impl RowTensors {
    /// Returns, for every tensor that holds parameters of Gaussians, its name, its node in the checkpoint, and the
    /// meaning of each value of a row (the values of one Gaussian).
    pub(in crate::models) fn params(&self) -> impl Iterator<Item = (&str, NodeId, &[RowElement])> {
        self.params.iter().map(|param| (&*param.name, param.tensor.id, &param.elements[..]))
    }

    /// Returns the checkpoint nodes of the tensors that only the training reads. Each of these tensors has one row per
    /// Gaussian.
    pub(in crate::models) fn training_only(&self) -> impl Iterator<Item = NodeId> {
        self.training_only.iter().map(|tensor| tensor.id)
    }

    /// Writes the checkpoint of the compressed model `compressed` to `path`. `before` holds the parameters of the
    /// original Gaussians, `raw_left` the parameters of the Gaussians of `compressed`. The row of a Gaussian is copied
    /// byte for byte if its parameters are unchanged. In tensors that only the training reads, the rows of proxies
    /// (Gaussians that replace merged ones) become zero.
    ///
    /// # Errors
    /// Fails if a tensor cannot be read or a write fails.
    pub(in crate::models) fn write(
        &self,
        before: &StoredParams,
        raw_left: &StoredParams,
        compressed: &CompressedModel,
        path: &Path,
    ) -> Result<()> {
        let mut rows = Vec::new();
        for Param { name, tensor, elements } in &self.params {
            let pairs: Vec<_> = elements.iter().map(|element| element.get(raw_left).zip(element.get(before))).collect();
            let differs = |place: usize, row: u32| {
                pairs
                    .iter()
                    .flatten()
                    .any(|(raw_left, before)| raw_left[place].to_bits() != before[row as usize].to_bits())
            };
            let changed: Vec<u32> = (0u32..)
                .zip(&compressed.kept)
                .filter(|&(place, &row)| differs(place as usize, row))
                .map(|(place, _)| place)
                .collect();
            let unread = elements.contains(&RowElement::Unread) && !changed.is_empty();
            let stored = if unread { self.checkpoint.values(tensor, name)? } else { Vec::new() };
            let mut values = Vec::with_capacity(changed.len() * elements.len());
            for &place in &changed {
                let row = compressed.kept[place as usize] as usize * elements.len();
                values.extend(pairs.iter().enumerate().map(|(c, pair)| match pair {
                    Some((raw_left, _)) => raw_left[place as usize],
                    None => stored[row + c],
                }));
            }
            rows.push(GaussianRows { tensor: tensor.clone(), changed, values });
        }
        let mut merged: Vec<u32> = compressed.clusters.iter().map(|cluster| cluster.output).collect();
        merged.sort_unstable();
        let training_only = self.training_only.iter();
        rows.extend(training_only.map(|tensor| GaussianRows {
            tensor: tensor.clone(),
            changed: merged.clone(),
            values: Vec::new(),
        }));
        write_like(&self.checkpoint, &compressed.kept, &rows, path)
    }
}
