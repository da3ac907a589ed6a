//! Reader of `.glb` files with one primitive of the extension `KHR_gaussian_splatting`.

use std::path::Path;

use serde_json::Value;

use super::{AXIS_SIGNS, BINARY, EXTENSION, JSON, MAGIC, VERSION, sh_attribute};
use crate::error::{Error, Result, quoted};
use crate::files::json;
use crate::files::map::FileMap;
use crate::files::text::decode_text;
use crate::limits::ReadLimit;
use crate::model::{Gaussians, MAX_SH_DEGREE, logit, sh_coefficient_count};

/// Maximum length in bytes of the JSON text; the text of our own files takes 5 kB.
const MAX_TEXT_BYTES: usize = 1 << 20;
/// Minimum opacity of a Gaussian after reading. Opacities of the file are clamped to the range from this value to 1
/// minus this value, so that their logits are finite.
const MIN_OPACITY: f64 = 1e-6;
/// Minimum standard deviation, in scene units, of a Gaussian after reading. Smaller values of the file are raised to
/// it, so that their logarithms are finite.
const MIN_SCALE: f64 = 1e-7;

/// Stored values of one attribute of the glTF primitive: `count` values, the first at the start of `bytes`, each
/// `stride` bytes after the one before.
struct Accessor<'a> {
    bytes: &'a [u8],
    stride: usize,
    /// Number by which glTF denotes the type of the components, such as 5126 for f32.
    component: u64,
    is_normalized: bool,
    count: usize,
}

impl Accessor<'_> {
    /// Returns component `c` of the value of Gaussian `row`. Integers of a normalized attribute are scaled to a largest
    /// value of 1.
    fn value(&self, row: usize, c: usize) -> f64 {
        let at = row * self.stride + c * component_bytes(self.component).unwrap_or(1);
        let bytes = &self.bytes[at..];
        let (value, most) = match self.component {
            5120 => (f64::from(bytes[0] as i8), 127.0),
            5121 => (f64::from(bytes[0]), 255.0),
            5122 => (f64::from(i16::from_le_bytes([bytes[0], bytes[1]])), 32_767.0),
            5123 => (f64::from(u16::from_le_bytes([bytes[0], bytes[1]])), 65_535.0),
            _ => return f64::from(f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])),
        };
        if self.is_normalized { (value / most).max(-1.0) } else { value }
    }
}

/// Returns the number of bytes of a component. `component` is glTF's number for its type, such as 5126 for f32. Returns
/// `None` for types that no attribute of Gaussians has.
fn component_bytes(component: u64) -> Option<usize> {
    match component {
        5120 | 5121 => Some(1),
        5122 | 5123 => Some(2),
        5126 => Some(4),
        _ => None,
    }
}

/// Reads the Gaussians of the `.glb` file at `path`. The file must have exactly one primitive with the extension
/// `KHR_gaussian_splatting`. The node of this primitive must have no transform (positions in the axes of glTF), or the
/// rotation by 180° about z (positions in the axes of a PLY file).
///
/// # Errors
/// Fails if the file is damaged, holds no such primitive or more than one, uses another kernel or color space, holds a
/// value that is not finite, or needs more memory than `memory`.
pub fn read_glb(path: &Path, memory: ReadLimit) -> Result<Gaussians> {
    let map = FileMap::open(path)?;
    let (text, binary) = chunks(&map, path)?;
    let document: Value = json::parse(decode_text(path, text)?, path)?;
    let (mesh, primitive) = find_primitive(&document, path)?;
    let axes = axes_of(&document, mesh, path)?;
    let extension = &primitive["extensions"][EXTENSION];
    for (key, expected) in [("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")] {
        if extension[key] != expected {
            return Err(Error::input(
                path,
                format!("{EXTENSION}, {key}"),
                expected,
                quoted(&extension[key].to_string()),
            ));
        }
    }
    let accessor =
        |name: &str, kind: &str| accessor(&document, binary, &primitive["attributes"][name], (name, kind), path);
    let of_extension = |name: &str, kind: &str| accessor(&format!("{EXTENSION}:{name}"), kind);
    let position = accessor("POSITION", "VEC3")?;
    let count = position.count;
    if u32::try_from(count).is_err() {
        return Err(Error::input(path, "POSITION", "at most 4294967295 Gaussians", count.to_string()));
    }
    let decoded = 4 * (11 + 3 * sh_coefficient_count(MAX_SH_DEGREE) as u64);
    memory.check(path, "POSITION", "the Gaussians of the file", count as u64 * decoded)?;
    let [rotation, scale, opacity] =
        [("ROTATION", "VEC4"), ("SCALE", "VEC3"), ("OPACITY", "SCALAR")].map(|(name, kind)| of_extension(name, kind));
    let (rotation, scale, opacity) = (rotation?, scale?, opacity?);
    let has = |k: usize| !primitive["attributes"][&sh_attribute(k)].is_null();
    let degree = (1..=MAX_SH_DEGREE).rev().find(|&degree| has(sh_coefficient_count(degree) - 1)).unwrap_or(0);
    let sh = (0..sh_coefficient_count(degree))
        .map(|k| accessor(&sh_attribute(k), "VEC3"))
        .collect::<Result<Vec<Accessor>>>()?;
    for (found, name) in [(&rotation, "ROTATION"), (&scale, "SCALE"), (&opacity, "OPACITY")]
        .into_iter()
        .chain(sh.iter().map(|found| (found, "an SH coefficient")))
    {
        if found.count != count {
            return Err(Error::input(path, name, format!("{count} values, as of POSITION"), found.count.to_string()));
        }
    }
    let mut gaussians = Gaussians::zeros(count, degree);
    for row in 0..count {
        let vec3 = |from: &Accessor| [0, 1, 2].map(|c| from.value(row, c));
        let (place, scales, alpha) = (vec3(&position), vec3(&scale), opacity.value(row, 0));
        let q = [0, 1, 2, 3].map(|c| rotation.value(row, c));
        let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        if !place.iter().chain(&scales).chain(&[alpha, length]).all(|x| x.is_finite() && x.abs() <= f64::from(f32::MAX))
        {
            return Err(Error::input(path, format!("Gaussian {row}"), "finite attributes", "NaN or infinity")
                .hint("export the file again without this Gaussian"));
        }
        let [x, y, z] = place;
        gaussians.position.set_row(row, [axes * x, axes * y, z].map(|x| x as f32));
        let [x, y, z, w] = if length > 0.0 { q.map(|x| x / length) } else { q };
        gaussians.rotation.set_row(row, [w, axes * x, axes * y, z].map(|x| x as f32));
        gaussians.log_scale.set_row(row, scales.map(|s| s.abs().max(MIN_SCALE).ln() as f32));
        gaussians.opacity_logit.set_row(row, [logit(alpha.clamp(MIN_OPACITY, 1.0 - MIN_OPACITY)) as f32]);
    }
    for (k, from) in sh.iter().enumerate() {
        let sign = if k > 0 && axes < 0.0 { f64::from(AXIS_SIGNS[k - 1]) } else { 1.0 };
        for c in 0..3 {
            for (row, to) in gaussians.sh.plane_mut(3 * k + c).iter_mut().enumerate() {
                *to = (sign * from.value(row, c)) as f32;
                if !to.is_finite() {
                    return Err(Error::input(
                        path,
                        format!("Gaussian {row}, {}", sh_attribute(k)),
                        "a finite value",
                        to.to_string(),
                    )
                    .hint("export the file again without this Gaussian"));
                }
            }
        }
    }
    Ok(gaussians)
}

/// Returns the JSON text and the binary chunk of a `.glb` file with the bytes `map`. Fails if one of the two is missing
/// or cut short, or if the text is too long.
fn chunks<'a>(map: &'a [u8], path: &Path) -> Result<(&'a [u8], &'a [u8])> {
    let word = |at: usize| map.get(at..at + 4).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let cut = |expected: String| {
        Error::input(path, "", expected, format!("{} bytes", map.len()))
            .hint("the file is cut short; copy or export it again")
    };
    if map.len() < 20 {
        return Err(cut("a header of 20 bytes".to_owned()));
    }
    for (at, expected, what) in [(0, MAGIC, "the magic"), (4, VERSION, "version"), (16, JSON, "the JSON chunk")] {
        if word(at) != expected {
            return Err(Error::input(
                path,
                format!("byte {at}"),
                format!("{what} {expected:#010x}"),
                format!("{:#010x}", word(at)),
            ));
        }
    }
    let length = word(12) as usize;
    if length > MAX_TEXT_BYTES {
        let expected = format!("a text of at most {MAX_TEXT_BYTES} bytes");
        return Err(Error::input(path, "byte 12", expected, format!("{length} bytes")));
    }
    let text =
        map.get(20..20 + length).ok_or_else(|| cut(format!("{} bytes up to the end of its text", 20 + length)))?;
    let start = 28 + length;
    if map.len() < start || word(start - 4) != BINARY {
        return Err(Error::input(path, format!("byte {}", 20 + length), "the binary chunk", "none"));
    }
    let bytes = word(start - 8) as usize;
    let binary = start.checked_add(bytes).and_then(|end| map.get(start..end));
    Ok((text, binary.ok_or_else(|| cut(format!("{bytes} bytes in the binary chunk")))?))
}

/// Finds the only primitive with the extension [`EXTENSION`] in the JSON text `document`. Returns the index of the mesh
/// that holds the primitive, and the primitive. Fails if there is no such primitive or more than one.
fn find_primitive<'a>(document: &'a Value, path: &Path) -> Result<(usize, &'a Value)> {
    let list = |value: &'a Value| value.as_array().map_or(&[][..], Vec::as_slice);
    let meshes = list(&document["meshes"]).iter().enumerate();
    let mut found = meshes
        .flat_map(|(mesh, value)| list(&value["primitives"]).iter().map(move |primitive| (mesh, primitive)))
        .filter(|(_, primitive)| primitive["extensions"][EXTENSION].is_object());
    let expected = format!("one primitive with the extension {EXTENSION}");
    match (found.next(), found.next()) {
        (Some(only), None) => Ok(only),
        (None, _) => Err(Error::input(path, "meshes", expected, "none")
            .hint("the file holds no Gaussians, or has compressed them in a way that is not supported")),
        (Some(_), Some(_)) => Err(Error::input(path, "meshes", expected, "more than one")),
    }
}

/// Returns the sign by which x and y coordinates of the file are multiplied to convert them to the axes of a PLY.
/// `mesh` is the index of the mesh in the JSON text `document`. The sign is −1 if the node of this mesh has no
/// transform, and 1 if the node turns the mesh by 180° about z. Fails for other transforms.
fn axes_of(document: &Value, mesh: usize, path: &Path) -> Result<f64> {
    let nodes = document["nodes"].as_array().map_or(&[][..], Vec::as_slice);
    let Some(node) = nodes.iter().find(|node| node["mesh"] == mesh) else { return Ok(-1.0) };
    let is_child = nodes.iter().any(|other| {
        let children = other["children"].as_array().map_or(&[][..], Vec::as_slice);
        let is_node = |child: &Value| {
            child.as_u64().and_then(|at| nodes.get(at as usize)).is_some_and(|found| std::ptr::eq(found, node))
        };
        children.iter().any(is_node) && has_transform(other)
    });
    let turned = serde_json::json!([0.0, 0.0, 1.0, 0.0]);
    let rotation = node["rotation"].as_array().map(|q| q.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>());
    let is_turned = rotation == Some(Some(vec![0.0, 0.0, 1.0, 0.0]));
    let others = ["matrix", "translation", "scale"].iter().any(|key| !node[*key].is_null());
    match (has_transform(node), is_turned && !others) {
        _ if is_child => (),
        (false, _) => return Ok(-1.0),
        (true, true) => return Ok(1.0),
        _ => (),
    }
    let expected = format!("a node without a transform, or with the rotation {turned}");
    Err(Error::input(path, "nodes", expected, "another transform")
        .hint("apply the transform to the Gaussians in the program that wrote the file"))
}

/// Returns whether a node has a transform.
fn has_transform(node: &Value) -> bool {
    ["matrix", "translation", "rotation", "scale"].iter().any(|key| !node[*key].is_null())
}

/// Returns the values of the attribute `name`, which must have the glTF type `kind`, such as `VEC3`. `index` is the
/// index of the attribute's accessor in the JSON text `document`; the values lie in the chunk `binary`. Fails if the
/// accessor does not exist, has another type, or extends beyond the chunk.
fn accessor<'a>(
    document: &Value,
    binary: &'a [u8],
    index: &Value,
    (name, kind): (&str, &str),
    path: &Path,
) -> Result<Accessor<'a>> {
    let wrong = |expected: String, found: String| Error::input(path, name, expected, quoted(&found));
    let number = |value: &Value| value.as_u64().and_then(|value| usize::try_from(value).ok());
    let found = number(index).map(|index| &document["accessors"][index]).filter(|found| found.is_object());
    let Some(found) = found else { return Err(wrong("an accessor".to_owned(), index.to_string())) };
    if found["type"] != kind || !found["sparse"].is_null() {
        return Err(wrong(format!("values of type {kind} that are not sparse"), found["type"].to_string()));
    }
    let component = found["componentType"].as_u64().unwrap_or(0);
    let allowed: &[u64] = match name.rsplit(':').next().unwrap_or_default() {
        "ROTATION" => &[5126, 5120, 5122],
        "SCALE" | "OPACITY" => &[5126, 5121, 5123],
        _ => &[5126],
    };
    let width = component_bytes(component).filter(|_| allowed.contains(&component));
    let Some(width) = width else {
        let allowed = allowed.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        return Err(wrong(format!("one of the component types {allowed}"), component.to_string()));
    };
    let components = match kind {
        "SCALAR" => 1,
        "VEC3" => 3,
        _ => 4,
    };
    let view = number(&found["bufferView"]).map(|index| &document["bufferViews"][index]).unwrap_or(&Value::Null);
    let or_zero = |value: &Value| if value.is_null() { Some(0) } else { number(value) };
    let place = || -> Option<(usize, usize, usize)> {
        (number(&view["buffer"])? == 0).then_some(())?;
        let count = number(&found["count"])?;
        let stride = if view["byteStride"].is_null() { components * width } else { number(&view["byteStride"])? };
        let start = or_zero(&view["byteOffset"])?.checked_add(or_zero(&found["byteOffset"])?)?;
        let rows =
            count.checked_sub(1).map_or(Some(0), |rows| rows.checked_mul(stride)?.checked_add(components * width));
        let end = start.checked_add(rows?)?;
        (end <= binary.len() && stride >= components * width).then_some((start, stride, count))
    };
    let Some((start, stride, count)) = place() else {
        let expected = format!("values within the {} bytes of the binary chunk", binary.len());
        return Err(wrong(expected, format!("bufferView {view}")));
    };
    let is_normalized = found["normalized"] == true || name.ends_with(":ROTATION");
    Ok(Accessor { bytes: &binary[start..], stride, component, is_normalized, count })
}
