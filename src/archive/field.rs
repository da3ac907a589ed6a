//! The tensors of a deformation field, each on its grid.
//!
//! In: a state dict, what of it is read and how, the stored positions. Out: symbols and a table of tensors. Planes store
//! the texels that some Gaussian reads at some time, on finer grids where more of what is read is theirs; matrices store
//! all of their values; what nothing reads comes back as zeros.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::entropy::{SymbolDecoder, SymbolEncoder};
use super::lattice::{NEIGHBOURS, QuantizedTensor};
use super::predict::PredictorWeights;
use super::residual::Residuals;
use super::step::QuantizationGrid;
use super::texels;
use crate::deform::{Box3, Tensor, Tensors};
use crate::model::Column;

/// Eighths of an octave by which a grid is finer for each octave that more is read of a texel: the square of its error
/// counts by that.
const FINER_PER_OCTAVE: i32 = 4;

/// Class of a weight to whose step nothing is added; others by so many eighths of an octave.
const MIDDLE: u8 = 100;

/// What a tensor is to those that read it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// `[1, channels, size_b, size_a]` over two axes of space: (a, b).
    Plane([usize; 2]),
    /// `[1, channels, times, size]` over an axis of space and time.
    TimePlane(usize),
    /// Weights: `[outputs, inputs]` or any other shape.
    Weights,
    /// Kept to the bit.
    Exact,
    /// Read by nobody.
    Unread,
}

/// A tensor in the archive's table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TensorEntry {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) role: Role,
    /// Its grid; see [`super::step()`].
    pub(super) step: i32,
    /// What is added to it: by channel of a plane, by row and then by column of a matrix; none: nothing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) channels: Vec<i8>,
    /// Its mean, in steps.
    pub(super) mean: i64,
    /// How its values are expected from their neighbors.
    pub(super) parts: PredictorWeights<NEIGHBOURS>,
}

/// How finely tensors are to be stored, by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FieldSteps(pub BTreeMap<String, TensorSteps>);

/// How finely a tensor is to be stored.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TensorSteps {
    /// Its grid; see [`super::step()`].
    pub step: i32,
    /// What is added to it: by channel of a plane, by row and then by column of a matrix, by place of any other tensor of
    /// weights; none: nothing.
    pub channels: Vec<i8>,
}

/// Where planes are read.
#[derive(Debug)]
pub(super) struct Readers<'a> {
    pub(super) position: &'a Column,
    pub(super) space: Option<Box3>,
    /// First and last time.
    pub(super) times: [f32; 2],
}

impl TensorEntry {
    pub(super) fn new(name: &str, tensor: &Tensor, role: Role, steps: Option<&TensorSteps>) -> TensorEntry {
        let TensorSteps { step, channels } = steps.cloned().unwrap_or_default();
        let (name, shape) = (name.to_owned(), tensor.shape.clone());
        TensorEntry { name, shape, role, step, channels, mean: 0, parts: [0; NEIGHBOURS] }
    }

    /// Values, unless so many have no number.
    pub(super) fn values(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |product, &extent| product.checked_mul(extent))
    }

    /// Channels, rows and columns.
    fn extents(&self) -> [usize; 3] {
        match (self.role, &self.shape[..]) {
            (Role::Plane(_) | Role::TimePlane(_), &[_, channels, rows, columns]) => [channels, rows, columns],
            (_, &[rows, columns]) => [1, rows, columns],
            _ => [1, 1, self.values().unwrap_or(0)],
        }
    }

    /// Whether shape, role and grids go together, whatever an archive says.
    pub(super) fn is_sound(&self) -> bool {
        let plane = |axes: &[usize]| {
            self.shape.len() == 4
                && self.shape[0] == 1
                && axes.iter().all(|&axis| axis < 3)
                // Up to there f32 holds every whole number.
                && self.shape.iter().all(|extent| (1..=1 << 24).contains(extent))
        };
        let fits = match self.role {
            Role::Plane(axes) => plane(&axes),
            Role::TimePlane(axis) => plane(&[axis]),
            _ => true,
        };
        let [channels, rows, columns] = self.extents();
        let wanted = match self.role {
            Role::Weights if self.shape.len() == 2 => rows.saturating_add(columns),
            Role::Weights => columns,
            _ => channels,
        };
        let channels = self.channels.is_empty() || self.channels.len() == wanted;
        fits && channels && super::STEPS.contains(&self.step)
    }

    /// Which models it shares: planes of a kind and size, matrices, vectors.
    fn family(&self) -> (u8, usize) {
        match self.role {
            Role::Plane(_) => (0, self.shape[3]),
            Role::TimePlane(_) => (1, self.shape[3]),
            _ if self.shape.len() == 2 => (2, 0),
            _ => (3, 0),
        }
    }

    /// The grid of a class of a channel.
    fn grid(&self, channel: usize, class: u8) -> QuantizationGrid {
        QuantizationGrid::new(match self.role {
            Role::Weights => self.step + i32::from(class) - i32::from(MIDDLE),
            _ => {
                let of_channel = i32::from(self.channels.get(channel).copied().unwrap_or(0));
                self.step + of_channel - FINER_PER_OCTAVE * texels::octaves(class)
            }
        })
    }

    /// Classes of weights: what is added to their step.
    fn weight_classes(&self) -> Vec<u8> {
        let [_, rows, columns] = self.extents();
        let (of_rows, of_columns) = self.channels.split_at(self.channels.len().saturating_sub(columns));
        let class = |added: i32| (i32::from(MIDDLE) + added).clamp(0, 2 * i32::from(MIDDLE)) as u8;
        let of = |row: usize, column: usize| {
            class([of_rows.get(row), of_columns.get(column)].into_iter().flatten().map(|&added| i32::from(added)).sum())
        };
        (0..rows).flat_map(|row| (0..columns).map(move |column| of(row, column))).collect()
    }

    /// Calls `with` with how the tensor lies on its grids; nothing where nothing of it is stored so.
    fn lay<R>(&self, readers: &Readers<'_>, with: impl FnOnce(&QuantizedTensor<'_>) -> R) -> Option<R> {
        if self.values() == Some(0) {
            return None;
        }
        let [channels, rows, columns] = self.extents();
        let (classes, stored) = match (self.role, readers.space) {
            (Role::Plane(axes), Some(space)) => {
                (texels::of_plane(readers.position, &space, axes, [columns, rows]), 0..rows)
            }
            (Role::TimePlane(axis), Some(space)) => {
                let [first, last] = readers.times;
                (texels::of_line(readers.position, &space, axis, columns), texels::rows(first, last, rows))
            }
            (Role::Weights, _) => (self.weight_classes(), 0..rows),
            _ => return None,
        };
        Some(with(&QuantizedTensor {
            channels,
            rows,
            columns,
            stored,
            classes: &classes,
            grids: &|channel, class| self.grid(channel, class),
            class_count: if self.role == Role::Weights { 2 * usize::from(MIDDLE) + 1 } else { texels::CLASSES },
            mean: QuantizationGrid::new(self.step).value(self.mean),
        }))
    }
}

/// Models by what shares them.
struct Shared(Vec<((u8, usize), Residuals)>);

impl Shared {
    fn residuals(&mut self, entry: &TensorEntry) -> &mut Residuals {
        let family = entry.family();
        let place = self.0.iter().position(|(known, _)| *known == family).unwrap_or_else(|| {
            self.0.push((family, Residuals::new()));
            self.0.len() - 1
        });
        &mut self.0[place].1
    }
}

/// Writes the tensors of `entries`, whose means and parts are found; gives the symbols and the values that are exact.
/// The bits of every tensor are added to `bits`.
pub(super) fn encode(
    entries: &mut [TensorEntry],
    tensors: &Tensors,
    readers: &Readers<'_>,
    bits: &mut BTreeMap<String, f64>,
) -> (Vec<u8>, Vec<f32>) {
    let (mut encoder, mut exact) = (SymbolEncoder::default(), Vec::new());
    let mut shared = Shared(Vec::new());
    for entry in entries {
        let Some(tensor) = tensors.get(&entry.name) else { continue };
        if entry.role == Role::Exact {
            exact.extend(&tensor.data);
        }
        if matches!(entry.role, Role::Plane(_) | Role::TimePlane(_)) {
            let mean = entry.lay(readers, |lattice| lattice.mean(&tensor.data)).unwrap_or(0.0);
            entry.mean = QuantizationGrid::new(entry.step).nearest(mean);
        }
        if let Some(parts) = entry.lay(readers, |lattice| lattice.fit(&mut tensor.data.clone())) {
            entry.parts = parts;
            let before = encoder.cost();
            entry.lay(readers, |lattice| {
                lattice.encode(&parts, shared.residuals(entry), &mut tensor.data.clone(), &mut encoder);
            });
            bits.insert(entry.name.clone(), encoder.cost() - before);
        }
    }
    (encoder.finish(), exact)
}

/// Reads the tensors of `entries`; none where the bytes are of other tensors. Shapes have been checked.
pub(super) fn decode(
    entries: &[TensorEntry],
    bytes: &[u8],
    mut exact: &[f32],
    readers: &Readers<'_>,
) -> Option<Tensors> {
    let mut decoder = SymbolDecoder::new(bytes)?;
    let mut shared = Shared(Vec::new());
    let mut tensors = Tensors::new();
    for entry in entries {
        let count = entry.values()?;
        let data = if entry.role == Role::Exact {
            let (own, rest) = exact.split_at_checked(count)?;
            exact = rest;
            own.to_vec()
        } else {
            let mut data = vec![0.0; count];
            entry
                .lay(readers, |lattice| lattice.decode(&entry.parts, shared.residuals(entry), &mut data, &mut decoder));
            data
        };
        tensors.insert(entry.name.clone(), Tensor { shape: entry.shape.clone(), data });
    }
    (decoder.is_finished() && exact.is_empty()).then_some(tensors)
}

/// What a tensor comes back as where its grid is that of `steps`, its neighbors aside.
pub fn rounded(tensor: &Tensor, role: Role, steps: &TensorSteps, position: &Column, space: Option<Box3>) -> Tensor {
    let entry = TensorEntry::new("", tensor, role, Some(steps));
    let readers = Readers { position, space, times: [-1.0, 1.0] };
    let mut data = tensor.data.clone();
    entry.lay(&readers, |lattice| lattice.fit(&mut data));
    Tensor { shape: tensor.shape.clone(), data }
}
