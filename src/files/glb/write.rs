//! Writer of `.glb` files.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::ops::Range;
use std::path::Path;

use serde_json::{Map, Value, json};

use super::{AXIS_SIGNS, BINARY, EXTENSION, JSON, MAGIC, VERSION, sh_attribute};
use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::files::accuracy::check_positions;
use crate::model::{Gaussians, color_from_sh, opacity};

/// Number by which glTF denotes the component type f32.
const F32: u32 = 5126;
/// Number by which glTF denotes the component type u8.
const U8: u32 = 5121;

/// Number of Gaussians whose values of an attribute are written at once.
const ROWS: usize = 4096;

/// Function that appends the values of one attribute, for the Gaussians with the given indices, to a list of bytes.
type WriteValues<'a> = Box<dyn Fn(Range<usize>, &mut Vec<u8>) + 'a>;

/// Attribute of the glTF primitive that is written, such as the positions of all Gaussians.
struct Attribute<'a> {
    name: String,
    /// Type of the values in glTF's terms, such as `VEC3`.
    kind: &'static str,
    component: u32,
    /// Number of bytes that the attribute takes per Gaussian.
    bytes: usize,
    write: WriteValues<'a>,
}

/// Writes the Gaussians `state` to a `.glb` file at `path`, with f32 values.
///
/// # Errors
/// Fails if an attribute is not finite, if the file would have 4 GiB or more, or if writing fails.
pub fn write_glb(state: &Gaussians, path: &Path) -> Result<()> {
    check_positions(state, path, "a .glb")?;
    check_finite(state, path)?;
    let attributes = attributes(state);
    let count = state.len();
    let (mut accessors, mut views, mut named, mut at) = (Vec::new(), Vec::new(), Map::new(), 0u64);
    for (index, attribute) in attributes.iter().enumerate() {
        let length = (attribute.bytes * count) as u64;
        views.push(json!({ "buffer": 0, "byteOffset": at, "byteLength": length, "target": 34962 }));
        let mut accessor = json!({ "bufferView": index, "componentType": attribute.component, "count": count, "type": attribute.kind });
        if attribute.component == U8 {
            accessor["normalized"] = json!(true);
        }
        if attribute.name == "POSITION" {
            let [mins, maxs] = bounds(state);
            (accessor["min"], accessor["max"]) = (json!(mins), json!(maxs));
        }
        accessors.push(accessor);
        named.insert(attribute.name.clone(), json!(index));
        at += length;
    }
    let extension = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
    let mut primitive = json!({ "attributes": named, "mode": 0 });
    primitive["extensions"] = Value::Object(Map::from_iter([(EXTENSION.to_owned(), extension)]));
    let document = json!({
        "asset": { "version": "2.0", "generator": TOOL },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [primitive] }],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": at }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    // Two headers of chunks follow the header of the file; every attribute has a multiple of four bytes.
    let Ok(whole) = u32::try_from(12 + 8 + text.len() as u64 + 8 + at) else {
        return Err(Error::usage(format!("{}: {count} Gaussians are too many for a .glb", path.shown())));
    };
    let mut out = BufWriter::new(File::create(path).map_err(Error::io("create", path))?);
    let mut write = || -> std::io::Result<()> {
        for word in [MAGIC, VERSION, whole, text.len() as u32, JSON] {
            out.write_all(&word.to_le_bytes())?;
        }
        out.write_all(&text)?;
        for word in [at as u32, BINARY] {
            out.write_all(&word.to_le_bytes())?;
        }
        let mut bytes = Vec::new();
        for attribute in &attributes {
            for start in (0..count).step_by(ROWS) {
                bytes.clear();
                (attribute.write)(start..(start + ROWS).min(count), &mut bytes);
                out.write_all(&bytes)?;
            }
        }
        out.flush()
    };
    write().map_err(Error::io("write", path))
}

/// Returns the attributes of the glTF primitive for the Gaussians `state`, in the order in which they are written.
fn attributes(state: &Gaussians) -> Vec<Attribute<'_>> {
    let of_extension = |name: &str| format!("{EXTENSION}:{name}");
    let rotation = move |row| {
        let q = state.rotation_f64(row);
        let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        let [w, x, y, z] = if length > 0.0 { q.map(|x| (x / length) as f32) } else { [1.0, 0.0, 0.0, 0.0] };
        [-x, -y, z, w]
    };
    let scale = move |row| state.scales_f64(row).map(|scale| scale as f32);
    let mut all = vec![
        floats("POSITION".to_owned(), "VEC3", move |row| reversed(state.position.row::<3>(row))),
        floats(of_extension("ROTATION"), "VEC4", rotation),
        floats(of_extension("SCALE"), "VEC3", scale),
        floats(of_extension("OPACITY"), "SCALAR", move |row| [opacity(state.opacity_logit.row::<1>(row)[0]) as f32]),
    ];
    for k in 0..state.sh.width() / 3 {
        let sign = if k == 0 { 1.0 } else { AXIS_SIGNS[k - 1] };
        let planes = [0, 1, 2].map(|c| state.sh.plane(3 * k + c));
        all.push(floats(sh_attribute(k), "VEC3", move |row| planes.map(|plane| sign * plane[row])));
    }
    let color = move |row| {
        let [r, g, b] = state.sh.row::<3>(row).map(|dc| byte(linear(color_from_sh(dc).clamp(0.0, 1.0))));
        [r, g, b, byte(opacity(state.opacity_logit.row::<1>(row)[0]))]
    };
    all.push(Attribute {
        name: "COLOR_0".to_owned(),
        kind: "VEC4",
        component: U8,
        bytes: 4,
        write: Box::new(move |rows, out| rows.for_each(|row| out.extend_from_slice(&color(row)))),
    });
    all
}

/// Returns an attribute named `name` with `N` f32 values per Gaussian and the glTF type `kind`. `value` returns the
/// values of the Gaussian with a given index.
fn floats<'a, const N: usize>(
    name: String,
    kind: &'static str,
    value: impl Fn(usize) -> [f32; N] + 'a,
) -> Attribute<'a> {
    let write: WriteValues = Box::new(move |rows, out| {
        rows.for_each(|row| out.extend_from_slice(value(row).map(f32::to_le_bytes).as_flattened()));
    });
    Attribute { name, kind, component: F32, bytes: 4 * N, write }
}

/// Checks that the scales and SH coefficients of `state` are finite. The caller has already checked the positions.
fn check_finite(state: &Gaussians, path: &Path) -> Result<()> {
    let scale = state.log_scale.planes().iter().position(|log| !(f64::from(*log).exp() as f32).is_finite());
    let sh = state.sh.planes().iter().position(|x| !x.is_finite());
    let (at, what) = match (scale, sh) {
        (Some(at), _) => (at, "a scale"),
        (None, Some(at)) => (at, "an SH coefficient"),
        (None, None) => return Ok(()),
    };
    let id = at % state.len();
    Err(Error::usage(format!("{}: {what} of Gaussian {id} is not finite, which a .glb cannot store", path.shown())))
}

/// Converts a position from the axes of a PLY to the axes of glTF: changes the signs of x and y.
fn reversed([x, y, z]: [f32; 3]) -> [f32; 3] {
    [-x, -y, z]
}

/// Returns the smallest and the largest coordinates of all positions in `state`, in the axes of glTF; zeros if there
/// are no Gaussians.
fn bounds(state: &Gaussians) -> [[f32; 3]; 2] {
    let (mut mins, mut maxs) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for row in 0..state.len() {
        let place = reversed(state.position.row(row));
        for axis in 0..3 {
            (mins[axis], maxs[axis]) = (mins[axis].min(place[axis]), maxs[axis].max(place[axis]));
        }
    }
    if state.is_empty() { [[0.0; 3]; 2] } else { [mins, maxs] }
}

/// Converts an sRGB value to linear light, both in [0, 1] (IEC 61966-2-1).
fn linear(value: f64) -> f64 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Converts a value in [0, 1] to a byte: 255 times the value, rounded.
fn byte(value: f64) -> u8 {
    (255.0 * value).round() as u8
}
