//! Writes Gaussians to PLY files.
//!
//! Input: Gaussians, or an open PLY file and a list of its rows (Gaussians) to keep. Output: a file at the given path.
//! Memory: one row. Callers that use [`crate::files::atomic`] pass the temporary path that it gives them.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::ops::Range;
use std::path::Path;

use crate::compressed_model::{CompressedModel, ParamDelta};
use crate::error::{Error, Result, ShowPath};
use crate::files::ply::{
    PlaneSource, Ply, PlyEncoding, PlyHeader, PlyLayout, Property, Scalar, name_at_sh_degree, read_plane,
};
use crate::model::{Attributes, Gaussians, MAX_SH_DEGREE, sh_coefficient_count};

/// Row (Gaussian) to be written to the PLY file of a compressed model, and where its values come from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutputRow {
    /// Index of the row of the original file (template) that is copied: the row of the Gaussian itself. For a proxy
    /// (Gaussian that replaces a merged cluster) it is the row of the leader, the most important Gaussian of the
    /// cluster.
    pub template_row: u32,
    /// Index of the proxy (Gaussian that replaces a merged cluster) whose attributes replace those of the row; `None`
    /// for a Gaussian that was not merged.
    pub proxy: Option<u32>,
}

/// Returns the rows to be written to the PLY file of the compressed model `compressed`, in output order.
pub fn rows_of_model(compressed: &CompressedModel) -> Vec<OutputRow> {
    let mut rows: Vec<OutputRow> =
        compressed.kept.iter().map(|&template_row| OutputRow { template_row, proxy: None }).collect();
    for (proxy, cluster) in compressed.clusters.iter().enumerate() {
        rows[cluster.output as usize].proxy = Some(proxy as u32);
    }
    rows
}

/// Writes a PLY file with the `rows` of a compressed model. The header is that of the original file `template`
/// (properties, order, types, comments, line ends). Only the number of Gaussians changes, and SH coefficients above
/// `sh_degree` are removed, so that `f_rest_*` are renumbered.
///
/// - A row without a proxy keeps the bytes of the template, except that `change` (parameter deltas) is added to its
///   values. A delta of 0 leaves the bytes unchanged.
/// - A row with a proxy (Gaussian that replaces a merged cluster) is a copy of the row of the cluster's leader (most
///   important member). In this copy, position, rotation, log_scale, opacity_logit and sh are replaced by the values of
///   the proxy, converted to the types of the properties (integers: nearest, saturated). Normals and extra properties
///   are those of the leader.
///
/// A template without `scale_2` cannot store the third scale of a proxy, so callers must order the axes of proxies with
/// the largest first.
///
/// Other elements of the template and the bytes after the last element are copied. If the template is a text file, the
/// output is little-endian binary. If it is a binary file, writing all of its rows in order without proxies and changes
/// reproduces it byte for byte.
///
/// # Errors
/// Fails if a source or proxy does not exist, if the proxies have another SH degree, if `change` has another number of
/// rows, if the template was truncated since it was opened, or if the file cannot be written.
pub fn write_like_template(
    template: &Ply,
    rows: &[OutputRow],
    proxies: &Gaussians,
    change: &ParamDelta,
    sh_degree: usize,
    path: &Path,
) -> Result<()> {
    check_rows(template, rows, proxies, change)?;
    let name = |name: &str| name_at_sh_degree(name, template.layout().stored_degree, sh_degree);
    let big_endian = template.header().encoding == PlyEncoding::BigEndian;
    let sources: Vec<u32> = rows.iter().map(|row| row.template_row).collect();
    write_rows_like(template, &sources, name, path, |place, bytes| {
        if let Some(proxy) = rows[place].proxy {
            replace_attributes(bytes, template.layout(), big_endian, proxies, proxy as usize);
        }
        add_delta(bytes, template, change, place);
    })
}

/// Writes a PLY file with copies of rows (Gaussians) of the open file `template`: the rows with the indices `sources`,
/// in this order. Other elements and the bytes after the last element are copied.
///
/// - `edit` receives the index of each output row and its bytes, and may change the bytes.
/// - `name` receives the name of a property and returns its new name, or `None` to remove the property.
///
/// # Errors
/// Fails if a source does not exist, if the template was truncated since it was opened, or if the file cannot be
/// written.
pub(crate) fn write_rows_like(
    template: &Ply,
    sources: &[u32],
    name: impl Fn(&str) -> Option<String>,
    path: &Path,
    mut edit: impl FnMut(usize, &mut [u8]),
) -> Result<()> {
    template.check_unshrunk()?;
    if let Some(source) = sources.iter().find(|&&source| source as usize >= template.count()) {
        let (path, count) = (template.path().shown(), template.count());
        return Err(Error::internal(format!("{path}: Gaussian {source} is to be kept, of {count} from 0")));
    }
    let mut kept_ranges: Vec<Range<usize>> = Vec::new();
    for property in template.properties().iter().filter(|property| name(&property.name).is_some()) {
        let end = property.offset + property.scalar.bytes();
        match kept_ranges.last_mut() {
            Some(last) if last.end == property.offset => last.end = end,
            _ => kept_ranges.push(property.offset..end),
        }
    }
    create(path, |out| {
        out.write_all(&template.header().text_for(sources.len(), name))?;
        template.write_lead(out)?;
        let mut changed = Vec::new();
        for (place, &source) in sources.iter().enumerate() {
            changed.clear();
            changed.extend_from_slice(template.row(source as usize));
            edit(place, &mut changed);
            kept_ranges.iter().try_for_each(|range| out.write_all(&changed[range.clone()]))?;
        }
        template.write_tail(out)
    })
}

/// Writes `gaussians` to the file `path` in the INRIA layout: binary little-endian f32, zero normals, `comments` as
/// comment lines (line breaks in them become spaces). f32 values keep their bits.
///
/// # Errors
/// Fails if the file cannot be written, or if the number of SH coefficients belongs to no degree from 0 to 3.
pub fn write_inria(gaussians: &Gaussians, comments: &[String], path: &Path) -> Result<()> {
    write_inria_with(gaussians, comments, &[], path)
}

/// Writes a PLY file like [`write_inria`], with additional float properties `extra_properties` after the usual ones.
/// Each element of `extra_properties` is the name of a property and its values, one per Gaussian.
///
/// # Errors
/// Fails like [`write_inria`].
pub(crate) fn write_inria_with(
    gaussians: &Gaussians,
    comments: &[String],
    extra_properties: &[(&str, &[f32])],
    path: &Path,
) -> Result<()> {
    let width = gaussians.sh.width();
    if !(0..=MAX_SH_DEGREE).any(|degree| 3 * sh_coefficient_count(degree) == width) {
        return Err(Error::internal(format!("{width} SH planes belong to no degree from 0 to 3")));
    }
    let rest = width - 3;
    let mut planes: Vec<&[f32]> = Vec::new();
    let zeros = vec![0.0; gaussians.len()];
    planes.extend((0..3).map(|c| gaussians.position.plane(c)));
    planes.extend([zeros.as_slice(); 3]);
    planes.extend((0..3).map(|c| gaussians.sh.plane(c)));
    // The file stores the SH coefficients of red, then those of green, then those of blue. A plane (component) has the
    // index 3 · coefficient + channel.
    planes.extend((0..3).flat_map(|channel| (1..=rest / 3).map(move |k| gaussians.sh.plane(3 * k + channel))));
    planes.push(gaussians.opacity_logit.plane(0));
    planes.extend((0..3).map(|c| gaussians.log_scale.plane(c)));
    planes.extend((0..4).map(|c| gaussians.rotation.plane(c)));
    planes.extend(extra_properties.iter().map(|(_, values)| *values));
    let names = extra_properties.iter().map(|(name, _)| *name);
    create(path, |out| {
        out.write_all(inria_header(gaussians.len(), rest, comments, names).as_bytes())?;
        for i in 0..gaussians.len() {
            for plane in &planes {
                out.write_all(&plane[i].to_le_bytes())?;
            }
        }
        Ok(())
    })
}

/// Returns the header of a PLY file in the INRIA layout with `count` Gaussians and `rest` properties `f_rest_*`,
/// followed by the properties with the names `extra_names`. `comments` become comment lines.
fn inria_header<'a>(
    count: usize,
    rest: usize,
    comments: &[String],
    extra_names: impl Iterator<Item = &'a str>,
) -> String {
    let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
    for comment in comments {
        header += &format!("comment {}\n", comment.replace(['\n', '\r'], " "));
    }
    header += &format!("element vertex {count}\n");
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(str::to_owned).into_iter();
    let names = names.chain((0..rest).map(|k| format!("f_rest_{k}")));
    let last = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    for name in names.chain(last.map(str::to_owned)).chain(extra_names.map(str::to_owned)) {
        header += &format!("property float {name}\n");
    }
    header + "end_header\n"
}

/// Returns the stored bytes of the extra properties of some rows (Gaussians) of `template`, one row after another.
/// `rows` are the indices of the rows. Extra properties are those that hold no attribute of a Gaussian, such as
/// normals.
pub(crate) fn extra_property_bytes(template: &Ply, rows: impl Iterator<Item = u32>) -> Vec<u8> {
    let ranges = extra_ranges(template.properties(), template.layout());
    rows.flat_map(|row| ranges.iter().flat_map(move |range| template.row(row as usize)[range.clone()].to_vec()))
        .collect()
}

/// Returns how many bytes of each row (Gaussian) of `template` belong to extra properties. These are the properties
/// that hold no attribute of a Gaussian, such as normals.
pub(crate) fn extra_bytes_per_row(template: &Ply) -> usize {
    extra_ranges(template.properties(), template.layout()).iter().map(ExactSizeIterator::len).sum()
}

/// Writes a PLY file to `path` that is put together from its parts:
///
/// - `header` is the header, which was read from the file `header_path` (for error messages).
/// - `cloud` holds the attributes of the Gaussians.
/// - `extra_bytes` holds the bytes of the extra properties (those that hold no attribute, such as normals), row by row.
/// - `lead` and `tail` are the bytes before and after the rows of the Gaussians.
///
/// # Errors
/// Fails if the header does not match the rows, or if the file cannot be written.
pub(crate) fn write_rows(
    header_path: &Path,
    header: &PlyHeader,
    [lead, tail]: [&[u8]; 2],
    extra_bytes: &[u8],
    cloud: &Gaussians,
    path: &Path,
) -> Result<()> {
    let mismatch = |expected: String| Error::input(header_path, "header of the PLY", expected, "others");
    let Some(vertex) = header.vertex().filter(|vertex| vertex.count == cloud.len() as u64) else {
        return Err(mismatch(format!("{} rows", cloud.len())));
    };
    let layout = PlyLayout::from_element(header_path, vertex)?;
    let ranges = extra_ranges(&vertex.properties, &layout);
    let width: usize = ranges.iter().map(|range| range.len()).sum();
    if layout.planes(Attributes::SH).len() != cloud.sh.width() || width * cloud.len() != extra_bytes.len() {
        return Err(mismatch("the properties of the rows".to_owned()));
    }
    let big_endian = header.encoding == PlyEncoding::BigEndian;
    create(path, |out| {
        out.write_all(&header.text)?;
        out.write_all(lead)?;
        let mut row = vec![0; vertex.stride];
        for i in 0..cloud.len() {
            let mut rest = &extra_bytes[i * width..(i + 1) * width];
            for range in &ranges {
                let (own, after) = rest.split_at(range.len());
                row[range.clone()].copy_from_slice(own);
                rest = after;
            }
            replace_attributes(&mut row, &layout, big_endian, cloud, i);
            out.write_all(&row)?;
        }
        out.write_all(tail)
    })
}

/// Returns the byte ranges, in a row with the properties `properties`, of the extra properties: those that `layout`
/// does not use for an attribute of a Gaussian.
fn extra_ranges(properties: &[Property], layout: &PlyLayout) -> Vec<Range<usize>> {
    let mut used: Vec<usize> = Vec::new();
    for column in Attributes::all().iter() {
        used.extend(layout.planes(column).iter().filter_map(|plane| match plane {
            PlaneSource::Property(property) => Some(property.offset),
            PlaneSource::Thin => None,
        }));
    }
    let is_extra = |property: &&Property| !used.contains(&property.offset) && !property.name.starts_with("f_rest_");
    let extra = properties.iter().filter(is_extra);
    extra.map(|property| property.offset..property.offset + property.scalar.bytes()).collect()
}

/// Creates the file at `path` and calls `fill` to write its content.
fn create(path: &Path, fill: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<()> {
    let mut out = BufWriter::with_capacity(1 << 18, File::create(path).map_err(Error::io("create", path))?);
    fill(&mut out).and_then(|()| out.flush()).map_err(Error::io("write", path))
}

/// Checks that all proxies (Gaussians that replace merged clusters) named in `rows` exist, that `proxies` have the SH
/// degree of `template`, and that `change` has one value per row for each attribute that it changes.
fn check_rows(template: &Ply, rows: &[OutputRow], proxies: &Gaussians, change: &ParamDelta) -> Result<()> {
    for column in change.attributes().iter() {
        let changes = change.0.attribute_values(column).len();
        if changes != rows.len() {
            let message = format!("{}: {changes} changes of {} rows", column.name(), rows.len());
            return Err(Error::internal(message));
        }
    }
    let planes = template.layout().planes(Attributes::SH).len();
    if !proxies.is_empty() && proxies.sh.width() != planes {
        let width = proxies.sh.width();
        return Err(Error::internal(format!(
            "proxies have {width} SH planes, {} has {planes}",
            template.path().shown()
        )));
    }
    for row in rows {
        if let Some(proxy) = row.proxy.filter(|&proxy| proxy as usize >= proxies.len()) {
            return Err(Error::internal(format!(
                "proxy {proxy} is to be written, of {} counted from 0",
                proxies.len()
            )));
        }
    }
    Ok(())
}

/// Replaces the attributes of one output row by those of the Gaussian with index `proxy` in `proxies`, such as a proxy
/// (Gaussian that replaces a merged cluster). `row` holds the bytes of the row, `layout` locates the attributes in it,
/// and `big_endian` states the byte order.
fn replace_attributes(row: &mut [u8], layout: &PlyLayout, big_endian: bool, proxies: &Gaussians, proxy: usize) {
    for column in Attributes::all().iter() {
        for (c, plane) in layout.planes(column).iter().enumerate() {
            if let PlaneSource::Property(property) = plane {
                put(row, property, big_endian, proxies.attribute_values(column).plane(c)[proxy]);
            }
        }
    }
}

/// Adds a parameter delta to the bytes `row` of one output row, which has the layout of `template`. `change` holds the
/// deltas (changes of the stored values) of all output rows, and `place` is the index of this row.
fn add_delta(row: &mut [u8], template: &Ply, change: &ParamDelta, place: usize) {
    let big_endian = template.header().encoding == PlyEncoding::BigEndian;
    for column in change.attributes().iter() {
        let by = change.0.attribute_values(column);
        for (c, plane) in template.layout().planes(column).iter().enumerate().take(by.width()) {
            let by = by.plane(c)[place];
            if let (PlaneSource::Property(property), true) = (plane, by != 0.0) {
                put(row, property, big_endian, value(row, property, big_endian) + by);
            }
        }
    }
}

/// Returns the value of `property` in the bytes `row` of a row, rounded to the nearest f32. `big_endian` states the
/// byte order.
pub(crate) fn value(row: &[u8], property: &Property, big_endian: bool) -> f32 {
    let mut value = [0.0];
    read_plane(row, &[0], property, big_endian, &mut value);
    value[0]
}

/// Writes `value` as `property` into the bytes `row` of a row, in the type of the property. `big_endian` states the
/// byte order.
pub(crate) fn put(row: &mut [u8], property: &Property, big_endian: bool, value: f32) {
    let rounded = value.round();
    let mut bytes = [0; 8];
    let used = &mut bytes[..property.scalar.bytes()];
    // The casts with `as` saturate and turn NaN into 0.
    match property.scalar {
        Scalar::F32 => used.copy_from_slice(&value.to_le_bytes()),
        Scalar::F64 => used.copy_from_slice(&f64::from(value).to_le_bytes()),
        Scalar::I8 => used.copy_from_slice(&(rounded as i8).to_le_bytes()),
        Scalar::U8 => used.copy_from_slice(&(rounded as u8).to_le_bytes()),
        Scalar::I16 => used.copy_from_slice(&(rounded as i16).to_le_bytes()),
        Scalar::U16 => used.copy_from_slice(&(rounded as u16).to_le_bytes()),
        Scalar::I32 => used.copy_from_slice(&(rounded as i32).to_le_bytes()),
        Scalar::U32 => used.copy_from_slice(&(rounded as u32).to_le_bytes()),
    }
    if big_endian {
        used.reverse();
    }
    row[property.offset..property.offset + used.len()].copy_from_slice(used);
}

#[cfg(test)]
mod tests;
