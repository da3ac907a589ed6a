//! Compressed archive of a model (`.gsz`): canonical Gaussians and deformation field, quantized with steps that the
//! caller chooses, and entropy coded.
//!
//! Input: [`ArchiveContent`] and [`QuantizationSteps`]. Output: bytes in the format of `format/ARCHIVE.md`, and back.
//! Memory: twice the content. Every quantized value is restored with an error of at most half a quantization step,
//! every other byte exactly. Texels that no Gaussian reads are restored as the nearest stored texels or an average of
//! their neighbors; tensors that nothing reads are restored as zeros.

mod cloud;
mod entropy;
mod field;
mod file;
mod importance;
mod predict;
mod quantized_tensor;
mod residual;
mod step;
#[cfg(test)]
mod tests;
mod texels;

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

pub(crate) use cloud::interleave_zeros;
pub use cloud::{
    ATTRIBUTES, CloudSteps, Column, FIRST_SH_ATTRIBUTE, attribute, attribute_values, round_cloud, round_column,
};
pub use field::{FieldSteps, TensorRole, TensorSteps, round_tensor};
pub use file::{ArchiveSize, HEADER_BYTES, MAGIC, VERSION};
pub use importance::step_offsets;
pub use step::{STEP_NUMBERS, nearest_step_number, step_size};

use crate::deform::{Box3, Tensor, Tensors};
use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::{Attributes, Gaussians};
use field::{EvaluationPoints, TensorEntry};
use file::{ArchiveHeader, Sections, damage};

/// Name of the tensor that holds the box of space that the feature planes cover.
pub const BOX_TENSOR: &str = "deformation_net.grid.aabb";

/// Content of an archive, in decoded form.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ArchiveContent {
    /// Canonical Gaussians.
    pub cloud: Gaussians,
    /// Columns: values of the Gaussians that belong to no attribute, for example velocities. A column has one row per
    /// Gaussian.
    pub columns: Vec<Column>,
    /// Use of each tensor by the deformation field, by the name of the tensor. Empty if the model has no deformation
    /// field.
    pub field: BTreeMap<String, TensorRole>,
    /// Tensors of the deformation field, by name.
    pub tensors: Tensors,
    /// First and last time at which the deformation field is evaluated. They determine which texels are stored.
    pub times: [f32; 2],
    /// Bytes of every Gaussian that are stored unchanged, for example those of PLY properties that are not f32. Each
    /// Gaussian has the same number of such bytes; they are stored one Gaussian after another.
    pub extra_bytes: Vec<u8>,
    /// Blocks of bytes that are stored unchanged, by name: whole files of the model, such as `cfg_args`, and the parts
    /// of its other files that are not values, such as headers.
    pub files: BTreeMap<String, Vec<u8>>,
}

/// Quantization steps with which an [`ArchiveContent`] is encoded.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct QuantizationSteps {
    /// Quantization step of each attribute of the Gaussians, as an exponent; see [`step_size()`].
    pub cloud: CloudSteps,
    /// Quantization step of each of [`ArchiveContent::columns`], as an exponent; see [`step_size()`].
    pub columns: Vec<i32>,
    /// Quantization step of each tensor of the deformation field.
    pub field: FieldSteps,
}

/// Encoded archive, with the number of bytes and bits that its contents take.
#[derive(Debug, Serialize, Deserialize)]
pub struct EncodedArchive {
    /// Bytes of the archive file.
    pub bytes: Vec<u8>,
    /// Size of the archive in bytes, divided by purpose.
    pub parts: ArchiveSize,
    /// For each Gaussian of the archive, in order: the index that it had in the [`ArchiveContent`] before encoding.
    pub order: Vec<u32>,
    /// Approximate number of bits that each attribute, column and quantized tensor takes, by name.
    pub bits: BTreeMap<String, f64>,
}

/// Table of contents of an archive: everything except entropy-coded symbols and plain bytes (blobs).
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    cloud: cloud::PointCloudShape,
    /// Bit patterns (f32) of the first and the last time at which the deformation field is evaluated; decimal text
    /// would round these times.
    times: [u32; 2],
    tensors: Vec<TensorEntry>,
    /// Number of bytes per Gaussian in [`ArchiveContent::extra_bytes`]: bytes that are stored unchanged, for example
    /// those of PLY properties that are not f32.
    beside: usize,
    /// Name and length in bytes of each entry of [`ArchiveContent::files`], in the order in which their bytes are
    /// stored.
    files: Vec<(String, usize)>,
}

/// Encodes `content` with the quantization steps `steps`.
///
/// # Errors
/// Fails if a value is not finite, or if a step or tensor is not allowed in an archive; the error names it.
pub fn encode(content: &ArchiveContent, steps: &QuantizationSteps) -> Result<EncodedArchive> {
    check(content, steps)?;
    let mut bits = BTreeMap::new();
    let grids = (&steps.cloud, &steps.columns[..]);
    let (shape, cloud, order) = cloud::encode(&content.cloud, &content.columns, grids, &mut bits);
    // Positions as a reader of the archive will decode them.
    let (stored, _) =
        cloud::decode(&shape, &cloud).ok_or_else(|| Error::internal("the encoded Gaussians cannot be decoded"))?;
    let points = EvaluationPoints { position: &stored.position, space: field_box(content), times: content.times };
    let entry = |(name, tensor): (&String, &Tensor)| {
        let role = content.field.get(name).copied().unwrap_or(TensorRole::Unread);
        TensorEntry::new(name, tensor, role, steps.field.0.get(name))
    };
    let mut entries: Vec<TensorEntry> = content.tensors.iter().map(entry).collect();
    if let Some(entry) = entries.iter().find(|entry| !entry.is_sound()) {
        let TensorEntry { name, shape, .. } = entry;
        return Err(Error::usage(format!(
            "an archive cannot hold tensor {name} of shape {shape:?}: its shape does not fit its use"
        )));
    }
    let (field, exact) = field::encode(&mut entries, &content.tensors, &points, &mut bits);
    let width = content.extra_bytes.len() / content.cloud.len().max(1);
    let table = Table {
        cloud: shape,
        times: content.times.map(f32::to_bits),
        tensors: entries,
        beside: width,
        files: content.files.iter().map(|(name, bytes)| (name.clone(), bytes.len())).collect(),
    };
    let mut blobs: Vec<u8> = exact.iter().flat_map(|value| value.to_le_bytes()).collect();
    // Store the first extra byte of all Gaussians, then the second of all, and so on, so that similar bytes are
    // adjacent.
    for at in 0..width {
        blobs.extend(order.iter().map(|&id| content.extra_bytes[id as usize * width + at]));
    }
    content.files.values().for_each(|bytes| blobs.extend(bytes));
    let table = serde_json::to_vec(&table).map_err(|error| Error::internal(error.to_string()))?;
    let (bytes, parts) = file::write(&Sections { table, cloud, field, blobs })?;
    let parts = if content.tensors.is_empty() { parts.without_field() } else { parts };
    Ok(EncodedArchive { bytes, parts, order, bits })
}

/// Decodes the archive `bytes`, which was read from `path`. Returns its content and its size by purpose.
///
/// # Errors
/// Fails if the bytes are not an archive, are truncated or damaged, have another version, or declare more content than
/// the file can hold or than `memory` allows. Declared sizes are checked before anything is allocated.
pub fn decode(bytes: &[u8], path: &Path, memory: ReadLimit) -> Result<(ArchiveContent, ArchiveSize)> {
    let head = ArchiveHeader::parse(path, bytes, bytes.len() as u64)?;
    head.check_memory(path, memory)?;
    let (sections, parts) = file::read(path, &head, bytes)?;
    let table = table(path, &sections, bytes.len())?;
    let values = table.tensors.iter().filter_map(TensorEntry::values).chain(table.cloud.values()).sum::<usize>() as u64;
    // While decoding, a coder keeps two values and one mean error size (12 bytes) for each Gaussian. While decoding a
    // tensor, a coder keeps one mean error size (4 bytes) for each place of the tensor.
    let places = table.tensors.iter().map(TensorEntry::places).max().unwrap_or(0) as u64;
    let needed = head.bytes() + 4 * values + 4 * places + 12 * table.cloud.gaussians as u64;
    memory.check(path, "table", "the archive and its content", needed)?;
    let parts = if table.tensors.is_empty() { parts.without_field() } else { parts };
    Ok((decode_sections(path, sections, table)?, parts))
}

/// Checks the header of the archive at `path` before the other bytes of the file are read. `head` holds the first
/// [`HEADER_BYTES`] bytes of the file, `whole` is the length of the file in bytes.
///
/// # Errors
/// Fails if `head` is not the header of an archive of this length, or if decoding the archive takes more memory than
/// `memory`.
pub fn check_header(head: &[u8], whole: u64, path: &Path, memory: ReadLimit) -> Result<()> {
    ArchiveHeader::parse(path, head, whole)?.check_memory(path, memory)
}

/// Parses the table of contents of the archive at `path`, which has `length` bytes. Fails if its numbers are
/// inconsistent or too large for a file of this length.
fn table(path: &Path, sections: &Sections, length: usize) -> Result<Table> {
    let table: Table = serde_json::from_slice(&sections.table)
        .map_err(|error| damage(path, "table", "a table of this version", error.to_string()))?;
    let unsound = |place: &str| damage(path, place, "consistent numbers", "inconsistent ones");
    if !table.cloud.is_sound() {
        return Err(unsound("table of the Gaussians"));
    }
    if let Some(entry) = table.tensors.iter().find(|entry| !entry.is_sound()) {
        return Err(unsound(&format!("tensor {}", entry.name)));
    }
    let values = table
        .tensors
        .iter()
        .try_fold(table.cloud.values(), |sum, entry| Some(sum.and_then(|sum| sum.checked_add(entry.values()?))));
    file::check_size(path, values.flatten().and_then(|values| values.checked_mul(4)), length as u64)?;
    Ok(table)
}

/// Decodes the sections `sections` of the archive at `path`, whose table of contents `table` has been checked. Returns
/// the content of the archive. Fails if the sections do not match the table.
fn decode_sections(path: &Path, sections: Sections, table: Table) -> Result<ArchiveContent> {
    let Sections { cloud, field, blobs, .. } = sections;
    let unsound = |place: &str| damage(path, place, "consistent numbers", "inconsistent ones");
    let (cloud, columns) = cloud::decode(&table.cloud, &cloud).ok_or_else(|| unsound("Gaussians"))?;

    let count = |entry: &&TensorEntry| entry.role == TensorRole::Exact;
    let exact = table.tensors.iter().filter(count).filter_map(TensorEntry::values).sum::<usize>() * 4;
    let beside = table.beside.checked_mul(cloud.len());
    let files = table.files.iter().try_fold(0usize, |sum, &(_, length)| sum.checked_add(length));
    let all = beside.zip(files).and_then(|(beside, files)| beside.checked_add(files)?.checked_add(exact));
    if all != Some(blobs.len()) {
        return Err(unsound("blobs"));
    }
    let (exact, rest) = blobs.split_at(exact);
    let (planes, mut rest) = rest.split_at(beside.unwrap_or(0));
    let exact: Vec<f32> = exact.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
    let mut content = ArchiveContent { times: table.times.map(f32::from_bits), ..ArchiveContent::default() };
    if !content.times.iter().all(|time| time.is_finite()) {
        return Err(unsound("times"));
    }
    content.extra_bytes = vec![0; planes.len()];
    for (at, plane) in planes.chunks_exact(cloud.len().max(1)).enumerate() {
        for (i, &byte) in plane.iter().enumerate() {
            content.extra_bytes[i * table.beside + at] = byte;
        }
    }
    for (name, length) in table.files {
        let (own, after) = rest.split_at(length);
        content.files.insert(name, own.to_vec());
        rest = after;
    }
    // The box of space is one of the exact tensors; it is needed before planes are decoded.
    let before = table.tensors.iter().take_while(|entry| entry.name != BOX_TENSOR).filter(count);
    let start: usize = before.filter_map(TensorEntry::values).sum();
    let has_box = table.tensors.iter().any(|entry| entry.name == BOX_TENSOR && entry.role == TensorRole::Exact);
    let space = exact.get(start..).filter(|_| has_box).and_then(|values| Box3::new(values.get(..6)?));
    if space.is_none()
        && table.tensors.iter().any(|entry| matches!(entry.role, TensorRole::Plane(_) | TensorRole::TimePlane(_)))
    {
        return Err(unsound("box of the field"));
    }
    let points = EvaluationPoints { position: &cloud.position, space, times: content.times };
    content.tensors = field::decode(&table.tensors, &field, &exact, &points).ok_or_else(|| unsound("field"))?;
    content.field = table.tensors.into_iter().map(|entry| (entry.name, entry.role)).collect();
    (content.cloud, content.columns) = (cloud, columns);
    Ok(content)
}

/// Returns the box of space that the feature planes of the deformation field cover; `None` if there are no feature
/// planes.
pub fn field_box(content: &ArchiveContent) -> Option<Box3> {
    content.tensors.get(BOX_TENSOR).and_then(|tensor| Box3::new(&tensor.data))
}

/// Checks that every value that will be quantized is finite and that every quantization step is within
/// [`STEP_NUMBERS`]. The error names the value or the step.
fn check(content: &ArchiveContent, steps: &QuantizationSteps) -> Result<()> {
    for column in Attributes::all().iter() {
        let values = content.cloud.attribute_values(column);
        if let Some(at) = values.planes().iter().position(|value| !value.is_finite()) {
            let (id, value) = (at % values.len(), values.planes()[at]);
            return Err(Error::usage(format!(
                "an archive holds finite values: {} of Gaussian {id} of the result is {value}\n  \
                 drop it (compress --drop-ids), or write a .ply or .gseq",
                column.name()
            )));
        }
    }
    if content.columns.len() != steps.columns.len() {
        return Err(Error::internal("the columns of an archive have no quantization steps"));
    }
    for Column { name, values, .. } in &content.columns {
        if values.len() != content.cloud.len() {
            return Err(Error::internal(format!("{} values of {name} for {}", values.len(), content.cloud.len())));
        }
        if let Some(value) = values.planes().iter().find(|value| !value.is_finite()) {
            return Err(Error::usage(format!("an archive holds finite values: {name} of a Gaussian is {value}")));
        }
    }
    for (name, tensor) in &content.tensors {
        if matches!(content.field.get(name), Some(TensorRole::Exact | TensorRole::Unread)) {
            continue;
        }
        if let Some(value) = tensor.data.iter().find(|value| !value.is_finite()) {
            return Err(Error::usage(format!("an archive holds finite values: tensor {name} has {value}")));
        }
    }
    let coarse = steps.cloud.iter().chain(&steps.columns).chain(steps.field.0.values().map(|steps| &steps.step));
    match coarse.into_iter().find(|step| !STEP_NUMBERS.contains(step)) {
        Some(step) => Err(Error::usage(format!(
            "the steps of an archive are {} to {}; found {step}",
            STEP_NUMBERS.start(),
            STEP_NUMBERS.end()
        ))),
        None => Ok(()),
    }
}
