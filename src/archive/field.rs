//! Encodes the tensors of a deformation field, each on its own quantization grid.
//!
//! Input: a state dict (tensors by name), the role of each tensor, and the stored positions. Output: symbols and a
//! table of tensors. Of a feature plane only the texels that some Gaussian reads at some time are stored; texels that
//! are read more have finer steps. Of a weight matrix all values are stored. Tensors that nothing reads are restored as
//! zeros.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::entropy::{SymbolDecoder, SymbolEncoder};
use super::predict::PredictorWeights;
use super::quantized_tensor::{NEIGHBORS, QuantizedTensor};
use super::residual::Residuals;
use super::step::QuantizationGrid;
use super::texels;
use crate::deform::{Box3, Tensor, Tensors};
use crate::model::AttributeValues;

/// Decrease of a texel's step exponent for each doubling of its importance w. The step of a texel is 2^(k/8), with
///
/// k = exponent of its channel − 4 · ⌊log2 w⌋,
///
/// so each doubling of w divides the step by √2. w is the sum of the squared interpolation weights with which Gaussians
/// read the texel. The sum of the squared errors that an error of the texel causes at these Gaussians is proportional
/// to w.
const FINER_PER_OCTAVE: i32 = 4;

/// Class of a weight whose quantization step has no offset. A class is a number that selects the quantization step of a
/// value. For a weight, it is 100 plus the offset of the weight's step, in eighths of an octave.
const ZERO_OFFSET_CLASS: u8 = 100;

/// Use of a tensor by the deformation field. It decides how an archive stores the tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TensorRole {
    /// Feature plane `[1, channels, size_b, size_a]` over two spatial axes (a, b): 0 is x, 1 is y, 2 is z.
    Plane([usize; 2]),
    /// Feature plane `[1, channels, times, size]` over one spatial axis (0 is x, 1 is y, 2 is z) and time.
    TimePlane(usize),
    /// Weights of a layer: a matrix `[outputs, inputs]`, or a tensor of any other shape.
    Weights,
    /// Tensor whose values are stored bit for bit.
    Exact,
    /// Tensor that is never used; its values are not stored.
    Unread,
}

/// Entry of a tensor in the table of contents of an archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TensorEntry {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) role: TensorRole,
    /// Exponent `k` of the quantization step 2^(k/8) of the tensor; see [`super::step_size()`].
    pub(super) step: i32,
    /// Offsets that are added to the exponent k of `step`: the values with an offset o have the step 2^((k + o)/8). If
    /// empty, all offsets are 0. Else the number of offsets depends on the tensor:
    /// - feature plane: one per channel
    /// - matrix of weights: one per row, then one per column; a value gets the sum of both
    /// - other tensor of weights: one per element
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) channels: Vec<i8>,
    /// For a feature plane: mean of the texels (grid elements) that the deformation field reads, in quantization steps.
    /// For other tensors: 0.
    pub(super) mean: i64,
    /// Weights with which a value is predicted from its neighbors in the tensor (predictor weights).
    #[serde(rename = "parts")]
    pub(super) weights: PredictorWeights<NEIGHBORS>,
}

/// Quantization step of each tensor, by the name of the tensor.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FieldSteps(pub BTreeMap<String, TensorSteps>);

/// Quantization step of a tensor, with offsets for its channels, or for its rows and columns.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TensorSteps {
    /// Exponent `k` of the quantization step 2^(k/8) of the tensor; see [`super::step_size()`].
    pub step: i32,
    /// Offsets that are added to the exponent k of `step`: the values with an offset o have the step 2^((k + o)/8). If
    /// empty, all offsets are 0. Else the number of offsets depends on the tensor:
    /// - feature plane: one per channel
    /// - matrix of weights: one per row, then one per column; a value gets the sum of both
    /// - other tensor of weights: one per element
    pub channels: Vec<i8>,
}

/// Points in space and time at which the deformation field is evaluated. They determine which texels of its feature
/// planes are read.
#[derive(Debug)]
pub(super) struct EvaluationPoints<'a> {
    /// Canonical positions of the Gaussians.
    pub(super) position: &'a AttributeValues,
    /// Box of space that the feature planes cover; `None` if the field has no feature planes.
    pub(super) space: Option<Box3>,
    /// First and last time at which the field is evaluated.
    pub(super) times: [f32; 2],
}

impl TensorEntry {
    /// Returns the table entry of `tensor`, which has the name `name` and the role `role`. `steps` holds its
    /// quantization step and offsets; `None` means a step of 1 without offsets. The mean and the predictor weights in
    /// the entry are still zero.
    pub(super) fn new(name: &str, tensor: &Tensor, role: TensorRole, steps: Option<&TensorSteps>) -> TensorEntry {
        let TensorSteps { step, channels } = steps.cloned().unwrap_or_default();
        let (name, shape) = (name.to_owned(), tensor.shape.clone());
        TensorEntry { name, shape, role, step, channels, mean: 0, weights: [0; NEIGHBORS] }
    }

    /// Returns the number of values of the tensor; `None` if it overflows.
    pub(super) fn values(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |product, &extent| product.checked_mul(extent))
    }

    /// Returns the shape with which the tensor is coded: numbers of channels, rows and columns.
    fn extents(&self) -> [usize; 3] {
        match (self.role, &self.shape[..]) {
            (TensorRole::Plane(_) | TensorRole::TimePlane(_), &[_, channels, rows, columns]) => {
                [channels, rows, columns]
            }
            (_, &[rows, columns]) => [1, rows, columns],
            _ => [1, 1, self.values().unwrap_or(0)],
        }
    }

    /// Returns the number of moving averages that a coder of the tensor keeps: one prediction error per place (row and
    /// column), averaged over the channels. Returns 0 for a tensor with a single channel, which needs no averages.
    pub(super) fn places(&self) -> usize {
        let [channels, rows, columns] = self.extents();
        if channels > 1 { rows.saturating_mul(columns) } else { 0 }
    }

    /// Returns whether shape, role and quantization steps of this tensor fit together. An entry from an untrusted file
    /// must pass this check.
    pub(super) fn is_sound(&self) -> bool {
        let plane = |axes: &[usize]| {
            self.shape.len() == 4
                && self.shape[0] == 1
                && axes.iter().all(|&axis| axis < 3)
                // f32 represents every whole number up to this size.
                && self.shape.iter().all(|extent| (1..=1 << 24).contains(extent))
        };
        let fits = match self.role {
            TensorRole::Plane(axes) => plane(&axes),
            TensorRole::TimePlane(axis) => plane(&[axis]),
            _ => true,
        };
        let [channels, rows, columns] = self.extents();
        let wanted = match self.role {
            TensorRole::Weights if self.shape.len() == 2 => rows.saturating_add(columns),
            TensorRole::Weights => columns,
            _ => channels,
        };
        let channels = self.channels.is_empty() || self.channels.len() == wanted;
        fits && channels && super::STEP_NUMBERS.contains(&self.step)
    }

    /// Returns the key of a group of tensors that share entropy models with this tensor. Tensors with equal keys are
    /// one group:
    /// - `(0, columns)`: planes over two spatial axes, with this number of columns
    /// - `(1, columns)`: planes over one spatial axis and time, with this number of columns
    /// - `(2, 0)`: matrices
    /// - `(3, 0)`: all other tensors
    fn family(&self) -> (u8, usize) {
        match self.role {
            TensorRole::Plane(_) => (0, self.shape[3]),
            TensorRole::TimePlane(_) => (1, self.shape[3]),
            _ if self.shape.len() == 2 => (2, 0),
            _ => (3, 0),
        }
    }

    /// Returns the quantization grid of a value in channel `channel` whose class is `class`. A class is a number that
    /// writer and reader of an archive compute for each value:
    /// - for a weight: [`ZERO_OFFSET_CLASS`] plus the step offsets of its row and of its column
    /// - for a texel: a number that grows with the sum of the squared weights with which Gaussians read the texel; see
    ///   [`texels::octaves`]
    fn grid(&self, channel: usize, class: u8) -> QuantizationGrid {
        QuantizationGrid::new(match self.role {
            TensorRole::Weights => self.step + i32::from(class) - i32::from(ZERO_OFFSET_CLASS),
            _ => {
                let channel_offset = i32::from(self.channels.get(channel).copied().unwrap_or(0));
                self.step + channel_offset - FINER_PER_OCTAVE * texels::octaves(class)
            }
        })
    }

    /// Returns the class of each weight, row by row. The class determines the quantization step: it is
    /// [`ZERO_OFFSET_CLASS`] plus the step offsets of the weight's row and column.
    fn weight_classes(&self) -> Vec<u8> {
        let [_, rows, columns] = self.extents();
        let (row_offsets, column_offsets) = self.channels.split_at(self.channels.len().saturating_sub(columns));
        let class =
            |added: i32| (i32::from(ZERO_OFFSET_CLASS) + added).clamp(0, 2 * i32::from(ZERO_OFFSET_CLASS)) as u8;
        let class_at = |row: usize, column: usize| {
            class(
                [row_offsets.get(row), column_offsets.get(column)]
                    .into_iter()
                    .flatten()
                    .map(|&added| i32::from(added))
                    .sum(),
            )
        };
        (0..rows).flat_map(|row| (0..columns).map(move |column| class_at(row, column))).collect()
    }

    /// Builds the description of this tensor that its coder needs (shape, stored rows and quantization grids), passes
    /// it to `with`, and returns the result of `with`. Returns `None` without calling `with` if no value of the tensor
    /// is quantized.
    ///
    /// `points` holds the positions and times at which the deformation field is evaluated. They matter only for
    /// feature planes, whose texels (grid elements) are interpolated at these positions and times:
    /// - The positions determine the quantization grid of each texel.
    /// - The times determine which rows of a time plane are stored.
    fn with_quantized<R>(
        &self,
        points: &EvaluationPoints<'_>,
        with: impl FnOnce(&QuantizedTensor<'_>) -> R,
    ) -> Option<R> {
        if self.values() == Some(0) {
            return None;
        }
        let [channels, rows, columns] = self.extents();
        let (classes, stored) = match (self.role, points.space) {
            (TensorRole::Plane(axes), Some(space)) => {
                (texels::plane_classes(points.position, &space, axes, [columns, rows]), 0..rows)
            }
            (TensorRole::TimePlane(axis), Some(space)) => {
                let [first, last] = points.times;
                (
                    texels::time_plane_classes(points.position, &space, axis, columns),
                    texels::time_rows(first, last, rows),
                )
            }
            (TensorRole::Weights, _) => (self.weight_classes(), 0..rows),
            _ => return None,
        };
        Some(with(&QuantizedTensor {
            channels,
            rows,
            columns,
            stored,
            classes: &classes,
            grids: &|channel, class| self.grid(channel, class),
            class_count: if self.role == TensorRole::Weights {
                2 * usize::from(ZERO_OFFSET_CLASS) + 1
            } else {
                texels::CLASSES
            },
            mean: QuantizationGrid::new(self.step).value(self.mean),
        }))
    }
}

/// Entropy models that several tensors share: pairs of the key of a group of tensors ([`TensorEntry::family`]) and the
/// models of this group.
struct SharedModels(Vec<((u8, usize), Residuals)>);

impl SharedModels {
    /// Returns the entropy models that `entry` shares with all tensors of the same key ([`TensorEntry::family`]).
    /// Creates the models at the first call for this key.
    fn residuals(&mut self, entry: &TensorEntry) -> &mut Residuals {
        let family = entry.family();
        let place = self.0.iter().position(|(known, _)| *known == family).unwrap_or_else(|| {
            self.0.push((family, Residuals::new()));
            self.0.len() - 1
        });
        &mut self.0[place].1
    }
}

/// Encodes the tensors of `entries`, whose values are in `tensors`. `points` holds the positions and times at which
/// the deformation field is evaluated. Returns the entropy-coded symbols of the quantized tensors, and the values of
/// tensors with [`TensorRole::Exact`]. Sets the means and predictor weights in the entries. Adds the approximate number
/// of bits of every quantized tensor to `bits`, by name.
pub(super) fn encode(
    entries: &mut [TensorEntry],
    tensors: &Tensors,
    points: &EvaluationPoints<'_>,
    bits: &mut BTreeMap<String, f64>,
) -> (Vec<u8>, Vec<f32>) {
    let (mut encoder, mut exact) = (SymbolEncoder::default(), Vec::new());
    let mut shared = SharedModels(Vec::new());
    for entry in entries {
        let Some(tensor) = tensors.get(&entry.name) else { continue };
        if entry.role == TensorRole::Exact {
            exact.extend(&tensor.data);
        }
        if matches!(entry.role, TensorRole::Plane(_) | TensorRole::TimePlane(_)) {
            let mean = entry.with_quantized(points, |quantized| quantized.mean(&tensor.data)).unwrap_or(0.0);
            entry.mean = QuantizationGrid::new(entry.step).nearest(mean);
        }
        if let Some(weights) = entry.with_quantized(points, |quantized| quantized.fit(&mut tensor.data.clone())) {
            entry.weights = weights;
            let before = encoder.cost();
            entry.with_quantized(points, |quantized| {
                quantized.encode(&weights, shared.residuals(entry), &mut tensor.data.clone(), &mut encoder);
            });
            bits.insert(entry.name.clone(), encoder.cost() - before);
        }
    }
    (encoder.finish(), exact)
}

/// Decodes the tensors of `entries` from the symbols `bytes` and the unquantized values `exact`. `points` holds the
/// positions and times at which the deformation field is evaluated. Returns `None` if symbols or values do not match
/// the entries, whose shapes the caller has checked.
pub(super) fn decode(
    entries: &[TensorEntry],
    bytes: &[u8],
    mut exact: &[f32],
    points: &EvaluationPoints<'_>,
) -> Option<Tensors> {
    let mut decoder = SymbolDecoder::new(bytes)?;
    let mut shared = SharedModels(Vec::new());
    let mut tensors = Tensors::new();
    for entry in entries {
        let count = entry.values()?;
        let data = if entry.role == TensorRole::Exact {
            let (own, rest) = exact.split_at_checked(count)?;
            exact = rest;
            own.to_vec()
        } else {
            let mut data = vec![0.0; count];
            entry.with_quantized(points, |quantized| {
                quantized.decode(&entry.weights, shared.residuals(entry), &mut data, &mut decoder)
            });
            data
        };
        tensors.insert(entry.name.clone(), Tensor { shape: entry.shape.clone(), data });
    }
    (decoder.is_finished() && exact.is_empty()).then_some(tensors)
}

/// Returns `tensor`, whose role is `role`, as an archive would restore it: rounded to the quantization grids of
/// `steps`. `position` holds the canonical positions of the Gaussians; `space` is the box of space that the feature
/// planes cover.
///
/// Planes over time differ from those of an archive: this function rounds every row. An archive stores only the rows
/// that are read at the times of the frames, and restores each other row as a copy of the nearest stored row.
pub fn round_tensor(
    tensor: &Tensor,
    role: TensorRole,
    steps: &TensorSteps,
    position: &AttributeValues,
    space: Option<Box3>,
) -> Tensor {
    let entry = TensorEntry::new("", tensor, role, Some(steps));
    let points = EvaluationPoints { position, space, times: [-1.0, 1.0] };
    let mut data = tensor.data.clone();
    entry.with_quantized(&points, |quantized| quantized.fit(&mut data));
    Tensor { shape: tensor.shape.clone(), data }
}
