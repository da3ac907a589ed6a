//! Makes the content of an archive from the files of a model.
//!
//! Input: a model that was written in its own format, and the kind of content of each file. Output: [`ArchiveContent`]
//! with the values of the Gaussians as attributes and columns, the tensors of networks, and the layout of the files
//! ([`super::layout`]). Memory: the files and their values.

use std::fs;
use std::io::{Cursor, Read, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use zip::write::FileOptions;
use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter};

use super::files::yaml_without_folders;
use super::layout::{
    Field, FileLayout, LAYOUT, Layout, Span, Values, first_column_plane, first_plane, plain_path, rest_name,
};
use crate::archive::{self, ATTRIBUTES, ArchiveContent, Column, TensorRole};
use crate::deform::Tensor;
use crate::error::{Error, Result};
use crate::files::checkpoint::{Checkpoint, TensorView, ValueType};
use crate::files::npz::Npz;
use crate::files::npz::write::GaussianAxis;
use crate::files::open::sorted_entries;
use crate::files::ply::{Ply, PlyEncoding, Property, Scalar};
use crate::files::splatv::{ROW_BYTES, Splatv};
use crate::limits::ReadLimit;
use crate::model::{AttributeValues, Attributes, Gaussians, sh_coefficient_count};
use crate::models::cfg_args;
use crate::models::in_checkpoint::rows::{RowElement, RowTensors};

/// Kind of content of a file of a model. It determines which bytes of the file an archive stores as values; all other
/// bytes are stored unchanged.
pub(in crate::models) enum FileContent<'a> {
    /// Gaussians as rows of a PLY.
    Ply,
    /// Gaussians of a `.splatv`.
    Splatv,
    /// Weights of a network: a PyTorch state dict.
    Weights,
    /// Training checkpoint with Gaussians as rows of tensors. The argument names these tensors in the checkpoint from
    /// which the model was read. It also applies to this file, a copy of that checkpoint with the same tree of objects.
    Checkpoint(&'a RowTensors),
    /// NumPy archive with Gaussians in its arrays. For an array, the function returns the axis that counts the
    /// Gaussians, and the attribute that the array holds.
    Npz(fn(&crate::files::npz::NpzArray) -> (GaussianAxis, Option<Attributes>)),
    /// File without values. Its bytes are stored unchanged, except that folders are removed from the paths in
    /// `cfg_args` and YAML files.
    Other,
}

impl FileContent<'_> {
    /// Returns the kind of content of a file called `name`, in a model whose Gaussians are in PLY or `.splatv` files.
    pub(in crate::models) fn from_name(name: &str) -> FileContent<'static> {
        match name.rsplit('.').next() {
            Some("ply") => FileContent::Ply,
            Some("splatv") => FileContent::Splatv,
            Some("pth" | "pt") => FileContent::Weights,
            _ => FileContent::Other,
        }
    }
}

/// Place in the content of an archive where a value of each Gaussian is stored.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Target {
    /// Component of an attribute: the attribute, and the index of the component.
    Attribute(Attributes, usize),
    /// Component of the column with this name. Columns hold values of Gaussians that belong to no attribute.
    Column(String),
    /// Extra bytes ([`ArchiveContent::extra_bytes`]): the bytes of the value are stored unchanged, not quantized.
    Bytes,
    /// Nowhere: the value is not stored, because no evaluation of the model reads it. It is restored as zero.
    Zeros,
}

/// Field of the rows of a file, where each row holds the values of one Gaussian.
#[derive(Debug, Clone)]
struct RowField {
    /// Constructor of the [`Field`] that describes this field in an archive. Its argument is the index of a plane
    /// (scalar component of all Gaussians), or a number of bytes.
    to_field: fn(usize) -> Field,
    /// Number of bytes of the field in each row.
    bytes: usize,
    target: Target,
}

impl RowField {
    fn f32(target: Target) -> RowField {
        RowField { to_field: Field::F32, bytes: 4, target }
    }

    fn half(target: Target) -> RowField {
        RowField { to_field: Field::Half, bytes: 2, target }
    }

    fn octaves(target: Target) -> RowField {
        RowField { to_field: Field::Octaves, bytes: 2, target }
    }

    fn byte(target: Target) -> RowField {
        RowField { to_field: Field::Byte, bytes: 1, target }
    }

    /// Creates a field of `bytes` bytes that an archive stores unchanged.
    fn exact(bytes: usize) -> RowField {
        RowField { to_field: Field::Bytes, bytes, target: Target::Bytes }
    }

    /// Creates a field of `bytes` bytes that an archive does not store, and restores as zeros.
    fn zeros(bytes: usize) -> RowField {
        RowField { to_field: Field::Zeros, bytes, target: Target::Zeros }
    }
}

/// Builder of the content of an archive, to which the files of a model are added.
pub(in crate::models) struct Packer {
    content: ArchiveContent,
    layout: Layout,
    memory: ReadLimit,
    /// Bytes that the archive stores unchanged. Each entry is one field: its number of bytes per Gaussian, and the
    /// bytes of all Gaussians.
    extra_bytes: Vec<(usize, Vec<u8>)>,
}

impl Packer {
    /// Creates a builder for an archive of `count` Gaussians of SH degree `sh_degree`, without files yet. Reading files
    /// may use at most `memory`.
    pub(in crate::models) fn new(count: usize, sh_degree: usize, memory: ReadLimit) -> Packer {
        let content = ArchiveContent {
            cloud: Gaussians::zeros(count, sh_degree),
            times: [0.0, 1.0],
            ..ArchiveContent::default()
        };
        Packer { content, layout: Layout { folder: false, files: Vec::new() }, memory, extra_bytes: Vec::new() }
    }

    /// Adds the model at `path`, a folder or a file, and returns the complete content of the archive. `holds` returns
    /// the kind of content of a file, given its path relative to the folder.
    ///
    /// # Errors
    /// Fails if a file cannot be read or has a layout that an archive cannot hold.
    pub(in crate::models) fn pack<'a>(
        mut self,
        path: &Path,
        holds: impl Fn(&str) -> FileContent<'a>,
    ) -> Result<ArchiveContent> {
        self.layout.folder = path.is_dir();
        let mut files = Vec::new();
        match self.layout.folder {
            true => list_files(path, path, &mut files)?,
            false => files.push((path.file_name().unwrap_or_default().to_string_lossy().into_owned(), path.to_owned())),
        }
        files.sort();
        for (name, file) in files {
            self.add_file(name.clone(), &file, holds(&name))?;
        }
        let Packer { mut content, layout, extra_bytes, .. } = self;
        let count = content.cloud.len();
        for i in 0..count {
            extra_bytes
                .iter()
                .for_each(|(width, bytes)| content.extra_bytes.extend(&bytes[i * width..(i + 1) * width]));
        }
        let text = serde_json::to_vec(&layout).map_err(|error| Error::internal(error.to_string()))?;
        content.files.insert(LAYOUT.to_owned(), text);
        Ok(content)
    }

    /// Adds a file of the model to the archive's content.
    /// - `name`: path of the file relative to the model folder.
    /// - `file`: path by which the file is read.
    /// - `holds`: kind of its content, which determines the bytes that become quantized values.
    fn add_file(&mut self, name: String, file: &Path, holds: FileContent<'_>) -> Result<()> {
        let path = plain_path(&name).filter(|path| !self.layout.files.iter().any(|known| known.has_path(path)));
        let path = path.ok_or_else(|| cannot_hold(file, "the name of a file that archives do not allow"))?;
        let length = fs::metadata(file).map_err(Error::io("read", file))?.len();
        self.memory.check(file, "", "the file and its values", 2 * length)?;
        let mut bytes = fs::read(file).map_err(Error::io("read", file))?;
        let mut spans = match holds {
            FileContent::Ply => self.add_ply(file, &bytes)?,
            FileContent::Splatv => self.add_splatv(file, &bytes)?,
            FileContent::Weights => self.add_weights(&name, file)?,
            FileContent::Checkpoint(rows) => self.add_checkpoint(rows, file, &bytes)?,
            FileContent::Npz(axis) => {
                if let Some(stored) = without_compression(&bytes).map_err(Error::io("read", file))? {
                    fs::write(file, &stored).map_err(Error::io("write", file))?;
                    bytes = stored;
                }
                self.add_npz(file, &bytes, axis)?
            }
            FileContent::Other if name == "cfg_args" => {
                bytes = cfg_args::without_folder_paths(&cfg_args::read(file)?, file)?.into_bytes();
                Vec::new()
            }
            FileContent::Other => {
                if let (true, Ok(text)) = (name.ends_with(".yaml") || name.ends_with(".yml"), str::from_utf8(&bytes)) {
                    bytes = yaml_without_folders(text).into_bytes();
                }
                Vec::new()
            }
        };
        spans.retain(|(span, length)| *length > 0 || !matches!(span.of, Values::Zeros(_)));
        spans.sort_by_key(|(span, _)| span.at);
        let (mut rest, mut end) = (Vec::new(), 0);
        for (span, length) in &spans {
            let at = span.at as usize;
            if at < end || at + length > bytes.len() {
                return Err(cannot_hold(file, "values that overlap"));
            }
            rest.extend_from_slice(&bytes[end..at]);
            end = at + length;
        }
        rest.extend_from_slice(&bytes[end..]);
        self.content.files.insert(rest_name(self.layout.files.len()), rest);
        let spans = spans.into_iter().map(|(span, _)| span).collect();
        self.layout.files.push(FileLayout { path, spans });
        Ok(())
    }

    /// Adds the rows of a file to the archive, one row per Gaussian. `bytes` is the content of the file, `at` the
    /// offset of the first row in it, and `fields` describes the fields of a row in order. Returns the [`Span`] (part
    /// of a file with values) that describes the rows, and their length in bytes.
    fn add_rows(&mut self, file: &Path, bytes: &[u8], at: usize, fields: &[RowField]) -> Result<(Span, usize)> {
        let count = self.content.cloud.len();
        let stride: usize = fields.iter().map(|field| field.bytes).sum();
        let length = count * stride;
        let stored = bytes.get(at..at + length).ok_or_else(|| cannot_hold(file, "fewer rows than Gaussians"))?;
        let mut coded = Vec::with_capacity(fields.len());
        let mut offset = 0;
        let mut first = 0;
        while first < fields.len() {
            // Fields of one column follow one another.
            let target = &fields[first].target;
            let together = match target {
                Target::Column(_) => fields[first..].iter().take_while(|field| field.target == *target).count(),
                _ => 1,
            };
            let group = &fields[first..first + together];
            let width: usize = group.iter().map(|field| field.bytes).sum();
            let rows = || stored.chunks_exact(stride.max(1)).map(|row| &row[offset..offset + width]);
            let decoded = |field: &RowField, from: usize| -> Vec<f32> {
                rows().filter_map(|row| (field.to_field)(0).decode(&row[from..from + field.bytes])).collect()
            };
            let mut from = 0;
            let mut planes = Vec::with_capacity(together);
            for field in group {
                planes.push(decoded(field, from));
                from += field.bytes;
            }
            let is_finite = planes.iter().flatten().all(|value: &f32| value.is_finite());
            match target {
                Target::Attribute(attribute, c) => {
                    self.content.cloud.attribute_values_mut(*attribute).plane_mut(*c).copy_from_slice(&planes[0]);
                    coded.push((group[0].to_field)(first_plane(*attribute) + c));
                }
                Target::Column(name) if is_finite => {
                    let plane = self.add_column(name, planes, None);
                    coded.extend(group.iter().enumerate().map(|(c, field)| (field.to_field)(plane + c)));
                }
                Target::Zeros => coded.push(Field::Zeros(width)),
                Target::Column(_) | Target::Bytes => {
                    self.extra_bytes.push((width, rows().flatten().copied().collect()));
                    coded.push(Field::Bytes(width));
                }
            }
            offset += width;
            first += together;
        }
        Ok((Span { at: at as u64, of: Values::Rows(coded) }, length))
    }

    /// Adds a column called `name`, with one plane (scalar component of all Gaussians) for each entry of `planes`. If
    /// another column has this name, a number is appended to it. `first_frame`: attribute of which the column holds the
    /// later frames, if any ([`Column::first_frame`]). Returns the index of the first plane of the column; indices count
    /// the planes of all attributes, then those of all columns.
    fn add_column(&mut self, name: &str, planes: Vec<Vec<f32>>, first_frame: Option<Attributes>) -> usize {
        let columns = &mut self.content.columns;
        let first = columns.iter().map(|column| column.values.width()).sum::<usize>();
        let is_taken = |name: &str| columns.iter().any(|column| column.name == name);
        let mut unique = name.to_owned();
        let mut number = 1;
        while is_taken(&unique) {
            number += 1;
            unique = format!("{name}.{number}");
        }
        let mut values = AttributeValues::zeros(planes.len(), self.content.cloud.len());
        planes.iter().enumerate().for_each(|(c, plane)| values.plane_mut(c).copy_from_slice(plane));
        let first_frame = first_frame.and_then(|found| (0..ATTRIBUTES.len()).find(|&k| archive::attribute(k) == found));
        columns.push(Column { name: unique, values, first_frame });
        first_column_plane(self.content.cloud.sh_degree()) + first
    }

    /// Adds the Gaussians of a PLY to the archive. Returns the added spans (parts of the file with values), each with
    /// its length in bytes.
    fn add_ply(&mut self, file: &Path, bytes: &[u8]) -> Result<Vec<(Span, usize)>> {
        let ply = Ply::open(file)?;
        if ply.header().encoding != PlyEncoding::LittleEndian {
            return Err(cannot_hold(file, "a PLY that is not little-endian binary"));
        }
        let at = ply.header().text.len() + ply.bytes_around()[0];
        let degree = self.content.cloud.sh_degree();
        let rest = ply.properties().iter().filter(|property| property.name.starts_with("f_rest_")).count();
        let has_all_degrees = rest == 3 * (sh_coefficient_count(degree) - 1);
        let field = |property: &Property| match property.scalar {
            Scalar::F32 => RowField::f32(ply_target(&property.name, degree, has_all_degrees)),
            other => RowField::exact(other.bytes()),
        };
        let fields: Vec<RowField> = ply.properties().iter().map(field).collect();
        Ok(vec![self.add_rows(file, bytes, at, &fields)?])
    }

    /// Adds the Gaussians of a `.splatv` file to the archive; see [`crate::files::splatv`] for their layout. Returns
    /// the added spans (parts of the file with values), each with its length in bytes.
    fn add_splatv(&mut self, file: &Path, bytes: &[u8]) -> Result<Vec<(Span, usize)>> {
        let splatv = Splatv::open(file)?;
        let at = splatv.start();
        let attribute = Target::Attribute;
        let column = |name: &str| Target::Column(name.to_owned());
        let mut fields: Vec<RowField> = Vec::new();
        fields.extend((0..3).map(|c| RowField::f32(attribute(Attributes::POSITION, c))));
        fields.extend((0..4).map(|c| RowField::half(attribute(Attributes::ROTATION, c))));
        fields.extend((0..3).map(|c| RowField::octaves(attribute(Attributes::LOG_SCALE, c))));
        fields.push(RowField::zeros(2));
        fields.extend((0..3).map(|c| RowField::byte(attribute(Attributes::SH, c))));
        fields.push(RowField::byte(attribute(Attributes::OPACITY, 0)));
        fields.extend((0..9).map(|c| RowField::half(column(["motion_1", "motion_2", "motion_3"][c / 3]))));
        fields.push(RowField::zeros(2));
        fields.extend((0..4).map(|_| RowField::half(column("omega"))));
        fields.push(RowField::half(column("center")));
        fields.push(RowField::octaves(column("width")));
        debug_assert_eq!(fields.iter().map(|field| field.bytes).sum::<usize>(), ROW_BYTES);
        Ok(vec![self.add_rows(file, bytes, at, &fields)?])
    }

    /// Adds the tensors of the state dict `file` to the archive as values. Returns the added spans (parts of the file
    /// with values), each with its length in bytes. A tensor is stored as unchanged bytes instead if it
    /// - is not f32, or has values that are not finite,
    /// - is empty or not stored contiguously,
    /// - shares bytes of the file with an earlier tensor.
    fn add_weights(&mut self, name: &str, file: &Path) -> Result<Vec<(Span, usize)>> {
        let checkpoint = Checkpoint::open(file, self.memory)?;
        let mut spans: Vec<(Span, usize)> = Vec::new();
        for (k, tensor) in checkpoint.tensors().enumerate() {
            let place = place_of(&checkpoint, &tensor).filter(|place| !place.is_empty() && is_dense(&tensor));
            let Some(place) = place.filter(|_| tensor.kind == ValueType::F32) else { continue };
            if spans
                .iter()
                .any(|(span, length)| place.start < span.at as usize + length && (span.at as usize) < place.end)
            {
                continue;
            }
            let data = checkpoint.values(&tensor, &tensor.storage)?;
            if data.iter().any(|value| !value.is_finite()) {
                continue;
            }
            let key = format!("{}.{k:03}", name.rsplit('/').next().unwrap_or(name));
            self.content.tensors.insert(key.clone(), Tensor { shape: tensor.shape.clone(), data });
            self.content.field.insert(key.clone(), TensorRole::Weights);
            spans.push((Span { at: place.start as u64, of: Values::Tensor(key) }, place.len()));
        }
        Ok(spans)
    }

    /// Adds the tensors of the checkpoint at `file`, whose content is `bytes`, to the archive. Returns the added spans
    /// (parts of the file with values), each with its length in bytes. `rows` describes the tensors of the checkpoint
    /// from which the model was read. The description also applies to `file`, which was written as a copy of that
    /// checkpoint with the same tree of objects.
    fn add_checkpoint(&mut self, rows: &RowTensors, file: &Path, bytes: &[u8]) -> Result<Vec<(Span, usize)>> {
        let checkpoint = Checkpoint::open(file, self.memory)?;
        let mut spans = Vec::new();
        let find = |id| checkpoint.tensor(id).ok_or_else(|| cannot_hold(file, "a tensor that was not written"));
        for (name, id, elements) in rows.params() {
            let tensor = find(id)?;
            let bytes_per_value = tensor.kind.bytes();
            let place = place_of(&checkpoint, &tensor)
                .filter(|_| has_dense_rows(&tensor))
                .ok_or_else(|| cannot_hold(file, "rows of Gaussians that are not stored one after the other"))?;
            if place.is_empty() {
                continue;
            }
            // Elements of a row in the order in which they are stored.
            let mut stored = vec![RowElement::Unread; elements.len()];
            let row = TensorView {
                offset: 0,
                shape: tensor.shape[1..].to_vec(),
                stride: tensor.stride[1..].to_vec(),
                ..tensor.clone()
            };
            let mut element = elements.iter();
            row.each(|at| {
                if let (Some(to), Some(from)) = (stored.get_mut(at), element.next()) {
                    *to = *from;
                }
            });
            let target = |element: &RowElement| match element {
                RowElement::Unread => Target::Zeros,
                _ if tensor.kind != ValueType::F32 => Target::Bytes,
                RowElement::Attribute(attribute, c) => Target::Attribute(*attribute, *c),
                RowElement::FormatSpecific(_) => Target::Column(name.to_owned()),
            };
            let field = |element: &RowElement| RowField { bytes: bytes_per_value, ..RowField::f32(target(element)) };
            let fields: Vec<RowField> = stored.iter().map(field).collect();
            spans.push(self.add_rows(file, bytes, place.start, &fields)?);
        }
        for id in rows.training_only() {
            let tensor = find(id)?;
            let place = place_of(&checkpoint, &tensor).filter(|_| has_dense_rows(&tensor));
            let place = place.ok_or_else(|| cannot_hold(file, "optimizer values that are not stored by rows"))?;
            if !spans.iter().any(|(span, _): &(Span, usize)| span.at == place.start as u64) {
                spans.push((Span { at: place.start as u64, of: Values::Zeros(place.len() as u64) }, place.len()));
            }
        }
        Ok(spans)
    }

    /// Adds the arrays of a NumPy archive without compression to the archive. `axis` returns for an array which of its
    /// axes counts the Gaussians, and the attribute that the array holds. Returns the added spans (parts of the file
    /// with values), each with its length in bytes.
    fn add_npz(
        &mut self,
        file: &Path,
        bytes: &[u8],
        axis: fn(&crate::files::npz::NpzArray) -> (GaussianAxis, Option<Attributes>),
    ) -> Result<Vec<(Span, usize)>> {
        let npz = Npz::open(file)?;
        let count = self.content.cloud.len();
        let mut spans = Vec::new();
        for entry in npz.entries() {
            let (axis, attribute) = axis(entry);
            let frames = match axis {
                GaussianAxis::None => continue,
                GaussianAxis::Axis0 => 1,
                GaussianAxis::Axis1 => entry.shape[0],
            };
            let width = entry.len() / (frames * count).max(1);
            let Some(value_bytes) = entry.float.map(|float| float.bytes) else {
                return Err(cannot_hold(file, "an array of Gaussians that holds no numbers"));
            };
            let frame_bytes = count * width * value_bytes;
            let at = entry.start();
            if !entry.is_little_f32() {
                let bytes_of = |k: usize| bytes.get(at + k * frame_bytes..at + (k + 1) * frame_bytes);
                for frame in 0..frames {
                    bytes_of(frame).ok_or_else(|| cannot_hold(file, "an array that is cut short"))?;
                    let fields = [RowField::exact(width * value_bytes)];
                    spans.push(self.add_rows(file, bytes, at + frame * frame_bytes, &fields)?);
                }
                continue;
            }
            let stored = bytes.get(at..at + frames * frame_bytes);
            let stored = stored.ok_or_else(|| cannot_hold(file, "an array that is cut short"))?;
            let value = |frame: usize, i: usize, c: usize| {
                let start = frame * frame_bytes + (i * width + c) * 4;
                f32::from_le_bytes(std::array::from_fn(|k| stored[start + k]))
            };
            // The first frame of an attribute is the canonical state; the later frames are a column, whose planes are
            // ordered by component, then frame, so that neighboring planes hold neighboring frames.
            let start = usize::from(attribute.is_some());
            let plane = |frame: usize, c: usize| (0..count).map(|i| value(frame, i, c)).collect::<Vec<f32>>();
            let columns: Vec<Vec<f32>> = (0..width)
                .flat_map(|c| (start..frames).map(move |frame| (frame, c)))
                .map(|(frame, c)| plane(frame, c))
                .collect();
            let first = if columns.is_empty() { 0 } else { self.add_column(&entry.name, columns, attribute) };
            for frame in 0..frames {
                let field = |c: usize| match attribute.filter(|_| frame == 0) {
                    Some(attribute) => Field::F32(first_plane(attribute) + c),
                    None => Field::F32(first + c * (frames - start) + frame - start),
                };
                if let Some(attribute) = attribute.filter(|_| frame == 0) {
                    let to = self.content.cloud.attribute_values_mut(attribute);
                    (0..width).for_each(|c| to.plane_mut(c).copy_from_slice(&plane(0, c)));
                }
                let at = (at + frame * frame_bytes) as u64;
                spans.push((Span { at, of: Values::Rows((0..width).map(field).collect()) }, frame_bytes));
            }
        }
        Ok(spans)
    }
}

/// Returns the attribute or the column in which an archive stores the PLY property `name`. `degree` is the SH degree of
/// the model. `has_all_degrees` states whether the file has as many properties `f_rest_*` as this degree requires; only
/// then are they stored as SH coefficients.
fn ply_target(name: &str, degree: usize, has_all_degrees: bool) -> Target {
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    let number: Option<usize> = name[stem.len()..].parse().ok();
    let rest = sh_coefficient_count(degree) - 1;
    match (stem, number) {
        ("x", None) => Target::Attribute(Attributes::POSITION, 0),
        ("y", None) => Target::Attribute(Attributes::POSITION, 1),
        ("z", None) => Target::Attribute(Attributes::POSITION, 2),
        ("opacity", None) => Target::Attribute(Attributes::OPACITY, 0),
        ("rot_", Some(c @ 0..4)) => Target::Attribute(Attributes::ROTATION, c),
        ("scale_", Some(c @ 0..3)) => Target::Attribute(Attributes::LOG_SCALE, c),
        ("f_dc_", Some(c @ 0..3)) => Target::Attribute(Attributes::SH, c),
        // The file orders these coefficients by channel, then coefficient.
        ("f_rest_", Some(k)) if has_all_degrees && k < 3 * rest => {
            Target::Attribute(Attributes::SH, 3 * (1 + k % rest) + k / rest)
        }
        ("motion_", Some(k)) => Target::Column(format!("motion_{}", k / 3 + 1)),
        (_, Some(_)) => Target::Column(stem.trim_end_matches('_').to_owned()),
        _ => Target::Column(name.to_owned()),
    }
}

/// Returns the error for the file at `file`, which cannot be stored in an archive. `found` names the part of its
/// content that prevents this.
fn cannot_hold(file: &Path, found: &str) -> Error {
    Error::input(file, "", "a layout that an archive can hold", found)
        .hint("write the model in its own format, or a .gseq of its frames")
}

/// Returns the range of bytes of the checkpoint file that the values of `tensor` take if they are stored without gaps.
/// Returns `None` if the file does not hold all of this range.
fn place_of(checkpoint: &Checkpoint, tensor: &TensorView) -> Option<Range<usize>> {
    let stored = checkpoint.storage_range(&tensor.storage)?;
    let bytes = tensor.kind.bytes();
    let start = stored.start.checked_add(tensor.offset.checked_mul(bytes)?)?;
    let end = start.checked_add(tensor.len()?.checked_mul(bytes)?)?;
    (end <= stored.end).then_some(start..end)
}

/// Returns whether the elements of `tensor` are stored one after the other, the last axis fastest.
fn is_dense(tensor: &TensorView) -> bool {
    let mut expected = 1;
    tensor.shape.iter().zip(&tensor.stride).rev().all(|(&length, &stride)| {
        let fits = length == 1 || stride == expected;
        expected *= length;
        fits
    })
}

/// Returns whether the rows of `tensor` are stored one after the other without gaps; the elements of a row may have any
/// order.
fn has_dense_rows(tensor: &TensorView) -> bool {
    let row: usize = tensor.shape.iter().skip(1).product();
    let inside = tensor.shape.iter().zip(&tensor.stride).skip(1);
    let last: usize = inside.map(|(&length, &stride)| length.saturating_sub(1).saturating_mul(stride)).sum();
    row == 0 || tensor.shape.first().is_some_and(|&rows| rows <= 1 || tensor.stride[0] == row) && last + 1 == row
}

/// Adds every file below `folder` to `files`: its path relative to `root`, with `/` between names, and the path by
/// which it can be opened. Leaves out the list of cameras, which renderers do not need.
fn list_files(root: &Path, folder: &Path, files: &mut Vec<(String, PathBuf)>) -> Result<()> {
    for path in sorted_entries(folder)? {
        if path.is_dir() {
            list_files(root, &path, files)?;
            continue;
        }
        let relative = path.strip_prefix(root).unwrap_or(&path);
        let names: Vec<_> = relative.iter().map(|name| name.to_string_lossy().into_owned()).collect();
        if names != ["cameras.json"] {
            files.push((names.join("/"), path.clone()));
        }
    }
    Ok(())
}

/// Returns the zip archive `bytes` with all its files uncompressed; `None` if none of its files is compressed.
fn without_compression(bytes: &[u8]) -> std::io::Result<Option<Vec<u8>>> {
    let mut archive = ZipArchive::new(Cursor::new(bytes))?;
    let mut is_compressed = false;
    for index in 0..archive.len() {
        is_compressed |= archive.by_index_raw(index)?.compression() != CompressionMethod::Stored;
    }
    if !is_compressed {
        return Ok(None);
    }
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index)?;
        let options = FileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .last_modified_time(DateTime::default())
            .large_file(entry.size() > u64::from(u32::MAX));
        writer.start_file(entry.name(), options)?;
        let mut content = Vec::new();
        entry.read_to_end(&mut content)?;
        writer.write_all(&content)?;
    }
    Ok(Some(writer.finish()?.into_inner()))
}
