//! Writes a sequence as a `.gsd` file, version 1, for the plugin SplatRenderer of Unreal. Every frame is stored in full
//! and independently of other frames, as textures that are compressed by LZ4.
//!
//! Layout, little-endian: "GSD1", u32 length of a JSON text, the JSON text, then for each frame u32 length and that
//! many bytes of one LZ4 block. A block holds the textures of the table one after the other, each W × W pixels of four
//! numbers, row by row. Bytes of a texture are shuffled: byte 0 of all pixels, then byte 1, and so on.
//!
//! | texture | numbers of a pixel | type | other pixels |
//! |---|---|---|---|
//! | position | z, x, −y, 0 | f32 | 0, 0, 0, 1 |
//! | rotation | q_z, q_x, −q_y, q_w of a unit quaternion | f16 | 0, 0, 0, 1 |
//! | scale and opacity | s₂, s₀, s₁, α | f16 | 0 |
//! | color | SH coefficients of degree 0 of red, green and blue, 0 | f16 | 0 |
//!
//! The plugin shows colors of degree 0 only, so no others are written. Gaussians with an opacity below 1/255 are left
//! out, and the others are sorted along a Morton curve, which makes blocks smaller. Memory: one frame, and about 600
//! bytes per frame.

use std::fs::File;
use std::io::{BufReader, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

use half::f16;
use serde_json::{Value, json};

use crate::error::{Error, Result};
use crate::fit::MIN_VISIBLE_OPACITY;
use crate::model::{Gaussians, opacity};
use crate::passes::FrameStates;
use crate::progress::Events;
use crate::source::{FrameSource, ReadPlan};

/// Frame rate stored in the file, in frames per second. Sequences have no frame rate of their own.
const FRAME_RATE: f64 = 30.0;
/// Centimeters per scene unit, which counts as one meter. The bounds in the JSON text are in centimeters.
const CENTIMETERS: f64 = 100.0;
/// Number of bits per axis of the Morton code.
const MORTON_BITS: u32 = 10;

/// Writes all frames of `source` to the `.gsd` file `path`. Returns a message for the user: number of Gaussians and
/// frame rate of the file, and the parts of the input that it does not contain. Some sources decode several frames
/// together; at most `frames_in_memory` decoded frames are then kept in memory.
///
/// # Errors
/// Fails if a frame cannot be read or the file cannot be written.
pub fn write_gsd(source: &dyn FrameSource, path: &Path, frames_in_memory: usize, events: &Events) -> Result<String> {
    let info = source.info();
    let progress = events.task("emit", "frames", info.times.len() as u64);
    // The JSON text holds the lengths of all blocks and comes first, so blocks are collected in a scratch file.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = tempfile::tempfile_in(folder).map_err(Error::io("create a scratch file in", folder))?;
    let mut blocks = BufWriter::new(scratch);
    let mut states = FrameStates::open(source, &ReadPlan::all_frames().with_max_kept_frames(frames_in_memory))?;
    let (mut frames, mut most, mut left_out) = (Vec::<Value>::new(), 0, 0);
    for frame in 0..info.times.len() {
        let packed = PackedFrame::new(states.read(frame)?);
        let block = lz4_flex::block::compress(&packed.textures);
        let length = u32::try_from(block.len())
            .map_err(|_| Error::usage(format!("frame {frame} has more than the 4 GiB that a .gsd can store")))?;
        blocks.write_all(&length.to_le_bytes()).map_err(Error::io("write", path))?;
        blocks.write_all(&block).map_err(Error::io("write", path))?;
        frames.push(packed.describe(block.len()));
        most = most.max(packed.count);
        left_out += packed.not_finite;
        progress.advance(1);
    }
    let name = path.file_stem().map_or(String::new(), |name| name.to_string_lossy().into_owned());
    let text = describe_sequence(&name, most, &frames).to_string();
    let mut blocks = blocks.into_inner().map_err(|error| Error::io("write", path)(error.into_error()))?;
    let write = |blocks: &mut File| {
        let mut out = BufWriter::new(File::create(path)?);
        out.write_all(b"GSD1")?;
        out.write_all(&(text.len() as u32).to_le_bytes())?;
        out.write_all(text.as_bytes())?;
        blocks.seek(SeekFrom::Start(0))?;
        std::io::copy(&mut BufReader::new(blocks), &mut out)?;
        out.flush()
    };
    write(&mut blocks).map_err(Error::io("write", path))?;
    let degrees = if info.sh_degree > 0 { "; colors do not change with direction" } else { "" };
    let dropped = if left_out > 0 {
        format!("; {left_out} states left out, with values that are not finite")
    } else {
        String::new()
    };
    Ok(format!("at most {most} visible Gaussians per frame, at {FRAME_RATE} frames a second{degrees}{dropped}"))
}

/// Returns the JSON text of the file for a sequence called `name`. `most` is the largest number of Gaussians in a
/// frame, `frames` has the entry of each frame.
fn describe_sequence(name: &str, most: usize, frames: &[Value]) -> Value {
    json!({
        "version": 1, "compression": "shuffle_lz4", "sequenceName": name, "frameCount": frames.len(),
        "targetFPS": FRAME_RATE, "shDegree": 0, "textureWidth": side(most), "textureHeight": side(most),
        "gaussianCount": most, "positionPrecision": 0, "rotationPrecision": 1, "scaleOpacityPrecision": 1,
        "shPrecision": 1, "frames": frames,
    })
}

/// Returns the side length in pixels of square textures with at least one pixel per Gaussian, for `count` Gaussians.
fn side(count: usize) -> usize {
    let root = count.isqrt();
    (root + usize::from(root * root < count)).max(1)
}

/// Frame of a `.gsd` file before LZ4 compression. The bytes of its textures (images of the attributes of all Gaussians)
/// are shuffled.
struct PackedFrame {
    textures: Vec<u8>,
    /// Number of Gaussians in the textures.
    count: usize,
    /// Number of visible Gaussians that were left out because a value is not finite.
    not_finite: usize,
    /// Minimum, then maximum, of the Gaussians' positions on each of Unreal's axes, in centimeters; zeros if there are
    /// no Gaussians.
    bounds: [[f64; 3]; 2],
}

impl PackedFrame {
    /// Packs the visible Gaussians of `state` into textures and returns them. Leaves out Gaussians with a value that is
    /// not finite.
    fn new(state: &Gaussians) -> PackedFrame {
        let visible = |&row: &usize| opacity(state.opacity_logit.row::<1>(row)[0]) >= MIN_VISIBLE_OPACITY;
        let seen: Vec<usize> = (0..state.len()).filter(visible).collect();
        let rows: Vec<usize> = seen.iter().copied().filter(|&row| is_finite(state, row)).collect();
        let places: Vec<[f64; 3]> = rows.iter().map(|&row| to_unreal(state.position.row(row)).map(f64::from)).collect();
        let bounds = [f64::min, f64::max].map(|extreme| {
            let of_axis = |axis: usize| places.iter().map(|place| CENTIMETERS * place[axis]).reduce(extreme);
            [0, 1, 2].map(|axis| of_axis(axis).unwrap_or(0.0))
        });
        let mut order: Vec<(u32, usize)> =
            places.iter().zip(&rows).map(|(place, &row)| (morton(place, &bounds), row)).collect();
        order.sort_by_key(|&(code, _)| code);
        let rows: Vec<usize> = order.into_iter().map(|(_, row)| row).collect();
        let pixels = side(rows.len()).pow(2);
        let mut textures = Vec::with_capacity(pixels * (16 + 3 * 8));
        let position = |row: usize| {
            let [x, y, z] = to_unreal(state.position.row(row));
            [x, y, z, 0.0].map(f32::to_le_bytes)
        };
        add_texture(&mut textures, pixels, &rows, [0.0, 0.0, 0.0, 1.0].map(f32::to_le_bytes), position);
        let rotation = |row: usize| {
            let q = state.rotation_f64(row);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            let [w, x, y, z] = if length > 0.0 { q.map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] };
            [z, x, -y, w].map(half_bytes)
        };
        add_texture(&mut textures, pixels, &rows, [0.0, 0.0, 0.0, 1.0].map(half_bytes), rotation);
        let shape = |row: usize| {
            let [x, y, z] = state.scales_f64(row);
            [z, x, y, opacity(state.opacity_logit.row::<1>(row)[0])].map(half_bytes)
        };
        add_texture(&mut textures, pixels, &rows, [0.0; 4].map(half_bytes), shape);
        let color = |row: usize| {
            let [r, g, b] = state.sh.row::<3>(row).map(f64::from);
            [r, g, b, 0.0].map(half_bytes)
        };
        add_texture(&mut textures, pixels, &rows, [0.0; 4].map(half_bytes), color);
        PackedFrame { textures, count: rows.len(), not_finite: seen.len() - rows.len(), bounds }
    }

    /// Returns the entry of this frame in the JSON text of the file. `bytes` is the length of the frame's LZ4 block.
    fn describe(&self, bytes: usize) -> Value {
        let side = side(self.count);
        let [low, high] = self.bounds.map(|[x, y, z]| json!({ "x": x, "y": y, "z": z }));
        json!({
            "compressedSize": bytes, "textureWidth": side, "textureHeight": side, "gaussianCount": self.count,
            "minPosition": low, "maxPosition": high,
        })
    }
}

/// Returns whether position, rotation, log scale and base color (SH coefficients of degree 0) of the Gaussian in row
/// `row` of `state` are finite.
fn is_finite(state: &Gaussians, row: usize) -> bool {
    let base = state.sh.row::<3>(row).iter().all(|x| x.is_finite());
    let [position, scale] = [state.position.row::<3>(row), state.log_scale.row::<3>(row)];
    base && position.iter().chain(&scale).chain(&state.rotation.row::<4>(row)).all(|x| x.is_finite())
}

/// Converts a position from the scene's axes to Unreal's axes.
fn to_unreal([x, y, z]: [f32; 3]) -> [f32; 3] {
    [z, x, -y]
}

/// Returns the bytes of `value` as a half-precision number. A value out of range becomes the largest finite one.
fn half_bytes(value: f64) -> [u8; 2] {
    let most = f16::MAX.to_f64();
    f16::from_f64(value.clamp(-most, most)).to_le_bytes()
}

/// Returns the Morton code of the position `place` within the box from `low` to `high`. `place` is in scene units and
/// the box in centimeters; both are in Unreal's axes.
fn morton(place: &[f64; 3], [low, high]: &[[f64; 3]; 2]) -> u32 {
    let most = f64::from((1u32 << MORTON_BITS) - 1);
    (0..3).fold(0, |code, axis| {
        let part = (CENTIMETERS * place[axis] - low[axis]) / (high[axis] - low[axis]).max(f64::MIN_POSITIVE);
        let cell = (part * most).clamp(0.0, most) as u32;
        (0..MORTON_BITS).fold(code, |code, bit| code | (cell >> bit & 1) << (3 * bit + axis as u32))
    })
}

/// Appends a texture of `pixels` pixels with shuffled bytes to `textures`. Its pixels hold the numbers that `value`
/// returns for each of the Gaussians `rows`; all further pixels hold `padding`.
fn add_texture<const N: usize>(
    textures: &mut Vec<u8>,
    pixels: usize,
    rows: &[usize],
    padding: [[u8; N]; 4],
    value: impl Fn(usize) -> [[u8; N]; 4],
) {
    let start = textures.len();
    textures.resize(start + 4 * N * pixels, 0);
    for pixel in 0..pixels {
        let bytes = rows.get(pixel).map_or(padding, |&row| value(row));
        for (k, byte) in bytes.iter().flatten().enumerate() {
            textures[start + k * pixels + pixel] = *byte;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::Attributes;
    use crate::passes::gather_all;

    /// Pixels of the four textures of a frame, each pixel with the four numbers that the format describes.
    type Pixels = [Vec<[f64; 4]>; 4];

    /// Reads the `.gsd` file `path` as the format specifies, without code shared with the writer. Returns its JSON text
    /// and the pixels of each frame.
    fn read(path: &Path) -> (Value, Vec<Pixels>) {
        let bytes = std::fs::read(path).unwrap();
        assert_eq!(&bytes[..4], b"GSD1");
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        let mut at = 8 + word(4);
        let text: Value = serde_json::from_slice(&bytes[8..at]).unwrap();
        let mut frames = Vec::new();
        for frame in text["frames"].as_array().unwrap() {
            let pixels = (frame["textureWidth"].as_u64().unwrap() * frame["textureHeight"].as_u64().unwrap()) as usize;
            let length = word(at);
            assert_eq!(frame["compressedSize"], length);
            let block = lz4_flex::block::decompress(&bytes[at + 4..at + 4 + length], 40 * pixels).unwrap();
            assert_eq!(block.len(), 40 * pixels);
            at += 4 + length;
            let number = |start: usize, size: usize, pixel: usize, k: usize| {
                let byte = |b: usize| block[start + (size * k + b) * pixels + pixel];
                match size {
                    4 => f64::from(f32::from_le_bytes([byte(0), byte(1), byte(2), byte(3)])),
                    _ => f16::from_le_bytes([byte(0), byte(1)]).to_f64(),
                }
            };
            let texture = |start: usize, size: usize| {
                (0..pixels).map(|pixel| [0, 1, 2, 3].map(|k| number(start * pixels, size, pixel, k))).collect()
            };
            frames.push([texture(0, 4), texture(16, 2), texture(24, 2), texture(32, 2)]);
        }
        assert_eq!(at, bytes.len());
        (text, frames)
    }

    #[test]
    fn an_independent_reader_finds_every_visible_gaussian() {
        let scene = DemoScene::new(300, 3);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.gsd");
        write_gsd(&scene, &path, 1, &Events::IGNORED).unwrap();
        let (text, frames) = read(&path);
        assert_eq!(
            (&text["sequenceName"], &text["frameCount"], &text["shDegree"]),
            (&json!("scene"), &json!(3), &json!(0))
        );
        for (frame, [places, turns, shapes, colors]) in frames.iter().enumerate() {
            let state = gather_all(&scene, frame, Attributes::all()).unwrap();
            let alpha = |row: usize| opacity(state.opacity_logit.row::<1>(row)[0]);
            let rows: Vec<usize> = (0..300).filter(|&row| alpha(row) >= MIN_VISIBLE_OPACITY).collect();
            assert_eq!(text["frames"][frame]["gaussianCount"], rows.len());
            for row in rows {
                let [x, y, z] = state.position_f64(row);
                let pixel = places.iter().position(|place| place[..3] == [z, x, -y]).expect("position bit for bit");
                let [a, b, c] = state.scales_f64(row);
                let near = |found: [f64; 4], expected: [f64; 4]| {
                    found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= 1e-3 * b.abs().max(0.01))
                };
                assert!(near(shapes[pixel], [c, a, b, alpha(row)]), "{:?}", shapes[pixel]);
                let [r, g, b] = state.sh.row::<3>(row).map(f64::from);
                assert!(near(colors[pixel], [r, g, b, 0.0]), "{:?}", colors[pixel]);
                let q = state.rotation_f64(row);
                let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
                let [w, x, y, z] = q.map(|x| x / length);
                assert!(near(turns[pixel], [z, x, -y, w]), "{:?}", turns[pixel]);
            }
        }
    }

    #[test]
    fn bounds_are_in_centimeters_of_unreal_axes() {
        let mut state = gather_all(&DemoScene::new(2, 1), 0, Attributes::all()).unwrap();
        state.position.set_row(0, [1.0, 2.0, 3.0]);
        state.position.set_row(1, [-1.0, 5.0, 0.5]);
        state.opacity_logit.set_row(0, [3.0]);
        state.opacity_logit.set_row(1, [3.0]);
        let packed = PackedFrame::new(&state);
        assert_eq!(packed.bounds, [[50.0, -100.0, -500.0], [300.0, 100.0, -200.0]]);
        assert_eq!((packed.count, packed.textures.len()), (2, 40 * 4));
    }

    #[test]
    fn frames_without_visible_gaussians_have_one_pixel() {
        let packed = PackedFrame::new(&Gaussians::zeros(0, 0));
        assert_eq!((packed.count, packed.textures.len(), packed.bounds), (0, 40, [[0.0; 3]; 2]));
        assert_eq!([0, 1, 2, 4, 5, 9, 10].map(side), [1, 1, 2, 2, 3, 3, 4]);
    }

    #[test]
    fn gaussians_with_nan_are_left_out_and_counted() {
        let mut state = gather_all(&DemoScene::new(20, 1), 0, Attributes::all()).unwrap();
        let seen = PackedFrame::new(&state).count;
        let row = (0..20).find(|&row| opacity(state.opacity_logit.row::<1>(row)[0]) > 0.1).unwrap();
        state.position.plane_mut(1)[row] = f32::NAN;
        let packed = PackedFrame::new(&state);
        assert_eq!((packed.count, packed.not_finite), (seen - 1, 1));
    }
}
