//! Gaussians as rows of a checkpoint's tensors.
//!
//! In: an open checkpoint, and which of its tensors hold what. Out: raw parameters; and the checkpoint with fewer rows. Memory:
//! the raw parameters, and one tensor at a time.

use std::path::Path;

use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::checkpoint::write::{GaussianRows, write_like};
use crate::files::checkpoint::{Checkpoint, NodeId, TensorView};
use crate::model::{Column, Columns, Gaussians, Raw};
use crate::models::trajectories::state_bytes;

/// What an element of a tensor's row is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::models) enum RowElement {
    /// A plane of a column.
    Of(Columns, usize),
    /// A plane of [`Raw::own`].
    Own(usize),
    /// Nothing that a state follows from.
    Unread,
}

impl RowElement {
    /// All planes of a column but the first `skipped`, so many.
    pub(in crate::models) fn all_of(column: Columns, skipped: usize, count: usize) -> Vec<RowElement> {
        (skipped..skipped + count).map(|c| RowElement::Of(column, c)).collect()
    }

    /// So many planes of one's own, from `first` on.
    pub(in crate::models) fn own(first: usize, count: usize) -> Vec<RowElement> {
        (first..first + count).map(RowElement::Own).collect()
    }

    fn get(self, raw: &Raw) -> Option<&[f32]> {
        match self {
            RowElement::Of(column, c) => Some(raw.gaussians.column(column).plane(c)),
            RowElement::Own(c) => Some(raw.own.plane(c)),
            RowElement::Unread => None,
        }
    }
}

/// A tensor whose rows are read.
#[derive(Debug)]
struct Param {
    name: String,
    tensor: TensorView,
    /// What the elements of a row are.
    planes: Vec<RowElement>,
}

/// Which tensors of a checkpoint have a row per Gaussian.
#[derive(Debug)]
pub(in crate::models) struct RowTensors {
    checkpoint: Checkpoint,
    count: usize,
    params: Vec<Param>,
    /// Those that only training reads.
    beside: Vec<TensorView>,
}

/// A checkpoint that is being read.
#[derive(Debug)]
pub(in crate::models) struct Reading {
    pub(in crate::models) table: RowTensors,
    pub(in crate::models) raw: Raw,
}

impl Reading {
    /// Makes room for `count` Gaussians with `own` planes beside the usual columns; all values are zero.
    ///
    /// # Errors
    /// More memory than allowed.
    pub(in crate::models) fn new(
        checkpoint: Checkpoint,
        count: usize,
        sh_degree: usize,
        own: usize,
    ) -> Result<Reading> {
        let row = state_bytes(sh_degree, Columns::all()) + 4 * own as u64;
        checkpoint.allow("", &format!("its {count} Gaussians"), row.saturating_mul(count as u64))?;
        let raw = Raw { gaussians: Gaussians::zeros(count, sh_degree), own: Column::zeros(own, count) };
        Ok(Reading { table: RowTensors { checkpoint, count, params: Vec::new(), beside: Vec::new() }, raw })
    }

    /// Reads the tensor at `id`, called `name`, whose rows have the shape `row` and are `planes`.
    ///
    /// # Errors
    /// No tensor of floating-point numbers of that shape; values that are not there or not finite.
    pub(in crate::models) fn read(
        &mut self,
        id: NodeId,
        name: &str,
        row: &[usize],
        planes: Vec<RowElement>,
    ) -> Result<()> {
        let checkpoint = &self.table.checkpoint;
        let tensor = checkpoint.float_tensor(id, name)?;
        let shape = [&[self.table.count], row].concat();
        if tensor.shape != shape {
            return Err(checkpoint.wrong(name, format!("shape {shape:?}"), format!("shape {:?}", tensor.shape)));
        }
        let values = checkpoint.floats(&tensor, name)?;
        let width = planes.len();
        for (c, plane) in planes.iter().enumerate() {
            let to = match *plane {
                RowElement::Of(column, plane) => self.raw.gaussians.column_mut(column).plane_mut(plane),
                RowElement::Own(plane) => self.raw.own.plane_mut(plane),
                RowElement::Unread => continue,
            };
            to.iter_mut().zip(values.iter().skip(c).step_by(width)).for_each(|(to, from)| *to = *from);
        }
        self.table.params.push(Param { name: name.to_owned(), tensor, planes });
        Ok(())
    }

    /// Counts the tensor at `id`, if it is one with a row per Gaussian, among those that only training reads.
    pub(in crate::models) fn beside(&mut self, id: NodeId) {
        let tensor = self.table.checkpoint.tensor(id).filter(|tensor| tensor.shape.first() == Some(&self.table.count));
        self.table.beside.extend(tensor);
    }
}

/// How many rows the tensor at `id`, called `name`, has.
///
/// # Errors
/// No tensor with rows.
pub(in crate::models) fn count_of(checkpoint: &Checkpoint, id: NodeId, name: &str) -> Result<usize> {
    let tensor = checkpoint.float_tensor(id, name)?;
    let rows = tensor.shape.first().copied();
    rows.ok_or_else(|| checkpoint.wrong(name, "a row per Gaussian", tensor.describe()))
}

impl RowTensors {
    /// Writes the rows that `reduction` leaves of the tensors to `path`: those of `left` where they differ from `before`; what
    /// training keeps of merged ones is zero.
    ///
    /// # Errors
    /// Those of the writer.
    pub(in crate::models) fn write(
        &self,
        before: &Raw,
        left: &Raw,
        reduction: &CompressedModel,
        path: &Path,
    ) -> Result<()> {
        let mut rows = Vec::new();
        for Param { name, tensor, planes } in &self.params {
            let pairs: Vec<_> = planes.iter().map(|plane| plane.get(left).zip(plane.get(before))).collect();
            let differs = |place: usize, row: u32| {
                pairs.iter().flatten().any(|(left, before)| left[place].to_bits() != before[row as usize].to_bits())
            };
            let changed: Vec<u32> = (0u32..)
                .zip(&reduction.kept)
                .filter(|&(place, &row)| differs(place as usize, row))
                .map(|(place, _)| place)
                .collect();
            let unread = planes.contains(&RowElement::Unread) && !changed.is_empty();
            let stored = if unread { self.checkpoint.floats(tensor, name)? } else { Vec::new() };
            let mut values = Vec::with_capacity(changed.len() * planes.len());
            for &place in &changed {
                let row = reduction.kept[place as usize] as usize * planes.len();
                values.extend(pairs.iter().enumerate().map(|(c, pair)| match pair {
                    Some((left, _)) => left[place as usize],
                    None => stored[row + c],
                }));
            }
            rows.push(GaussianRows { tensor: tensor.clone(), changed, values });
        }
        let mut merged: Vec<u32> = reduction.clusters.iter().map(|cluster| cluster.output).collect();
        merged.sort_unstable();
        let beside = self.beside.iter();
        rows.extend(beside.map(|tensor| GaussianRows {
            tensor: tensor.clone(),
            changed: merged.clone(),
            values: Vec::new(),
        }));
        write_like(&self.checkpoint, &reduction.kept, &rows, path)
    }
}
