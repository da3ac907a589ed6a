//! Writes a copy of a PyTorch checkpoint with fewer Gaussians.
//!
//! Input: an open checkpoint, and the list of its tensors that have one row per Gaussian. Output: a checkpoint with the
//! same structure, in which these tensors have fewer rows. Names, order, types, devices and everything else stay the
//! same, byte for byte. The pickle is not rebuilt: only the numbers in it that have to change are replaced. Memory: the
//! pickle (description of the objects), and one storage (block of tensor values) before and after the change. The
//! output bytes depend only on the content, because all files in the zip archive are dated 1980-01-01.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::ops::Range;
use std::path::Path;

use crate::error::{Error, Result};
use crate::files::checkpoint;
use crate::files::checkpoint::{Checkpoint, NodeId, Pickle, TensorView};
use crate::files::zip_output::{create_zip, finish_zip, stored_file_options};

/// Alignment of the contents of each file in the archive, in bytes, as in PyTorch.
const ALIGNMENT: u16 = 64;

/// Tensor with one row per Gaussian, and new values for some of its rows in the copy of the checkpoint.
#[derive(Debug)]
pub(crate) struct GaussianRows {
    /// Tensor in the original checkpoint.
    pub(crate) tensor: TensorView,
    /// Indices of the rows that get new values, increasing. They count the rows of the new file, which has only the
    /// Gaussians that are kept.
    pub(crate) changed: Vec<u32>,
    /// New values of the rows in `changed`, `[rows in changed, elements of a row]`, last index fastest. If empty, these
    /// rows are set to zeros.
    pub(crate) values: Vec<f32>,
}

/// Values of one tensor as they are written into a new storage (block of tensor values). A new storage consists of one
/// part for each tensor that uses it.
struct StoragePart<'a> {
    tensor: &'a TensorView,
    /// Changes to the rows of the tensor; `None` if all rows are copied unchanged.
    rows: Option<&'a GaussianRows>,
    shape: Vec<usize>,
    stride: Vec<usize>,
    offset: usize,
    len: usize,
}

/// Writes a copy of `checkpoint` to `path` in which each tensor in `rows` keeps only the rows with the indices `kept`
/// (increasing), with the changes given in `rows`.
///
/// # Errors
/// Fails if a tensor has elements outside its storage, if two tensors share one shape or stride object in the pickle
/// although their new shapes or strides differ, or if the file cannot be written.
pub(crate) fn write_like(checkpoint: &Checkpoint, kept: &[u32], rows: &[GaussianRows], path: &Path) -> Result<()> {
    let by_node: BTreeMap<NodeId, &GaussianRows> =
        rows.iter().filter(|rows| !rows.tensor.shape.is_empty()).map(|rows| (rows.tensor.id, rows)).collect();
    let touched: BTreeSet<&str> = rows.iter().map(|rows| rows.tensor.storage.as_str()).collect();
    let all: Vec<TensorView> = checkpoint.tensors().collect();
    let mut numbers = BTreeMap::new();
    let mut parts: BTreeMap<&str, Vec<StoragePart<'_>>> = BTreeMap::new();
    for tensor in all.iter().filter(|tensor| touched.contains(tensor.storage.as_str())) {
        checkpoint
            .check(tensor)
            .map_err(|found| checkpoint.wrong(&format!("data/{}", tensor.storage), "values for all elements", found))?;
        let rows = by_node.get(&tensor.id).copied();
        let storage_parts = parts.entry(&tensor.storage).or_default();
        if storage_parts.first().is_some_and(|first: &StoragePart<'_>| first.tensor.kind != tensor.kind) {
            return Err(checkpoint.wrong(&format!("data/{}", tensor.storage), "values of one type", "of several"));
        }
        let offset = storage_parts.last().map_or(0, |last| last.offset + last.len);
        let part = StoragePart::new(tensor, rows, kept.len(), offset);
        storage_parts.push(part);
    }
    let mut expected: BTreeMap<NodeId, (Vec<usize>, Vec<usize>, usize)> = BTreeMap::new();
    for (key, parts) in &parts {
        let total = parts.iter().map(|part| part.len).sum::<usize>();
        if total > checkpoint.max_values(key, parts[0].tensor.kind) {
            return Err(checkpoint.wrong(
                &format!("data/{key}"),
                "tensors of about as many values",
                format!("{total}"),
            ));
        }
        for part in parts {
            let places = &part.tensor.places;
            let mut set = |at: &Range<usize>, value: usize| _ = numbers.insert((at.start, at.end), value as u64);
            set(&places.numel, total);
            set(&places.offset, part.offset);
            places.shape.iter().zip(&part.shape).for_each(|(at, &value)| set(at, value));
            places.stride.iter().zip(&part.stride).for_each(|(at, &value)| set(at, value));
            expected.insert(part.tensor.id, (part.shape.clone(), part.stride.clone(), part.offset));
        }
    }
    let failed = |error| Error::io("write", path)(error);
    let mut archive = create_zip(path)?;
    checkpoint.files(|name, what, bytes| {
        let bytes = match what {
            checkpoint::CheckpointFile::Pickle => {
                let written = checkpoint.pickle().with_numbers(&bytes, &numbers);
                check_pickle(checkpoint, &written, &all, &expected)?;
                written
            }
            checkpoint::CheckpointFile::Storage(key) => match parts.get(key) {
                Some(parts) => {
                    let mut out = Vec::with_capacity(bytes.len());
                    parts.iter().for_each(|part| part.write(&bytes, kept, &mut out));
                    out
                }
                None => bytes,
            },
            checkpoint::CheckpointFile::Other => bytes,
        };
        let options = stored_file_options(bytes.len() as u64);
        archive.start_file_aligned(name, options, ALIGNMENT).map_err(|error| failed(error.into()))?;
        archive.write_all(&bytes).map_err(failed)
    })?;
    finish_zip(archive, path)
}

impl<'a> StoragePart<'a> {
    /// Lays out the values of `tensor` in a new storage (block of tensor values): computes their shape, strides and
    /// number. If `rows` is given, the tensor has one row per Gaussian, of which it keeps `kept`. If `rows` is `None`,
    /// it keeps all of its rows. `offset` is the index in the new storage of the first value.
    fn new(tensor: &'a TensorView, rows: Option<&'a GaussianRows>, kept: usize, offset: usize) -> StoragePart<'a> {
        let mut shape = tensor.shape.clone();
        if let (Some(_), Some(first)) = (rows, shape.first_mut()) {
            *first = kept;
        }
        let row: usize = tensor.shape.iter().skip(1).product();
        let mut stride = tensor.stride.clone();
        // A tensor whose rows follow one another without gaps keeps its strides. Every other tensor keeps the order of
        // its axes, but is stored without gaps.
        let is_dense = stride.first() == Some(&row) && {
            let row_view = TensorView {
                offset: 0,
                shape: tensor.shape[1..].to_vec(),
                stride: stride[1..].to_vec(),
                ..tensor.clone()
            };
            let mut seen = vec![false; row];
            row_view.each(|at| {
                if let Some(seen) = seen.get_mut(at) {
                    *seen = true;
                }
            });
            seen.into_iter().all(|seen| seen)
        };
        if !is_dense {
            let mut axes: Vec<usize> = (0..shape.len()).collect();
            axes.sort_by_key(|&axis| std::cmp::Reverse(stride[axis]));
            axes.iter().rev().fold(1, |step, &axis| {
                stride[axis] = step;
                step * shape[axis].max(1)
            });
        }
        let len = shape.iter().product();
        StoragePart { tensor, rows, shape, stride, offset, len }
    }

    /// Appends the bytes of this tensor for the new storage (block of tensor values) to `out`. `stored` holds the bytes
    /// of the old storage, and `kept` the indices of the rows of the tensor that are kept.
    fn write(&self, stored: &[u8], kept: &[u32], out: &mut Vec<u8>) {
        let (bytes, start) = (self.tensor.kind.bytes(), out.len());
        out.resize(start + self.len * bytes, 0);
        let out = &mut out[start..];
        let to =
            TensorView { offset: 0, shape: self.shape.clone(), stride: self.stride.clone(), ..self.tensor.clone() };
        let Some(rows) = self.rows else {
            let mut places = Vec::with_capacity(self.len);
            to.each(|at| places.push(at));
            let mut places = places.into_iter();
            self.tensor.each(|at| {
                if let Some(place) = places.next() {
                    out[place * bytes..][..bytes].copy_from_slice(&stored[at * bytes..][..bytes]);
                }
            });
            return;
        };
        // Returns the offset of every element of a row from the first element of the row.
        let row_offsets = |tensor: &TensorView| {
            let mut places = Vec::new();
            let row = TensorView {
                offset: 0,
                shape: tensor.shape[1..].to_vec(),
                stride: tensor.stride[1..].to_vec(),
                ..tensor.clone()
            };
            row.each(|at| places.push(at));
            places
        };
        let (from_row, to_row) = (row_offsets(self.tensor), row_offsets(&to));
        let (from_step, to_step) = (self.tensor.stride[0], self.stride[0]);
        for (place, &row) in kept.iter().enumerate() {
            let from = self.tensor.offset + row as usize * from_step;
            for (&a, &b) in from_row.iter().zip(&to_row) {
                out[(place * to_step + b) * bytes..][..bytes].copy_from_slice(&stored[(from + a) * bytes..][..bytes]);
            }
        }
        let width = to_row.len();
        for (k, &place) in rows.changed.iter().enumerate() {
            for (c, &b) in to_row.iter().enumerate() {
                let value = rows.values.get(k * width + c).copied().unwrap_or(0.0);
                self.tensor.kind.encode(value, &mut out[(place as usize * to_step + b) * bytes..][..bytes]);
            }
        }
    }
}

/// Checks the new pickle `written`: every tensor in `all` must have the right shape, strides and offset in it.
/// `expected` maps nodes of tensors to their new shape, strides and offset. A tensor that is not in `expected` must be
/// described as before. The check fails if two tensors share one shape object in the pickle although only one of them
/// gets a new shape.
fn check_pickle(
    checkpoint: &Checkpoint,
    written: &[u8],
    all: &[TensorView],
    expected: &BTreeMap<NodeId, (Vec<usize>, Vec<usize>, usize)>,
) -> Result<()> {
    let wrong = || {
        checkpoint
            .wrong("data.pkl", "tensors that have a shape each", "one that several share")
            .hint("load the checkpoint with torch.load, give each tensor a clone() of its own, and save it again")
    };
    let pickle = Pickle::read(written, u64::MAX).map_err(|_| wrong())?;
    for tensor in all {
        let numbers = |id: NodeId| -> Option<Vec<usize>> {
            pickle.elements(id)?.iter().map(|&id| usize::try_from(pickle.int(id)?).ok()).collect()
        };
        let found = pickle.call(tensor.id).and_then(|(_, arguments)| match *arguments {
            [_, offset, size, stride, ..] => {
                Some((numbers(size)?, numbers(stride)?, usize::try_from(pickle.int(offset)?).ok()?))
            }
            _ => None,
        });
        let own = (tensor.shape.clone(), tensor.stride.clone(), tensor.offset);
        if found.as_ref() != Some(expected.get(&tensor.id).unwrap_or(&own)) {
            return Err(wrong());
        }
    }
    Ok(())
}
