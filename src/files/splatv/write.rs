//! Writes Gaussians on cubic paths to a `.splatv` file ([`crate::files::splatv`] describes the layout).
//!
//! Memory: one row (Gaussian). Values that are stored in half precision are rounded to the nearest; values that are
//! stored as bytes are rounded down, as in splaTV.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use half::f16;
use serde_json::{Value, json};

use crate::error::{Error, Result};
use crate::files::accuracy::{CodingErrors, RenderedAttributes};
use crate::files::cameras::virtual_rig;
use crate::files::splatv::{MAGIC, ROW_BYTES, SplatvGaussian, TEXELS_PER_ROW, WORDS_PER_GAUSSIAN};
use crate::model::RobustBox;
use crate::model::{AttributeValues, Camera};

/// Index of the camera that is the default view, among the 12 cameras that [`virtual_rig`] places around a scene. It is
/// neither at the top nor at the bottom of the scene.
const DEFAULT_CAMERA: usize = 4;
/// Distance in time from the center of the temporal window, as a multiple of its width, at which an opacity of 1 has
/// fallen to 1/255.
const VISIBLE_WIDTHS: f64 = 2.36;
/// Number of texels of the texture that store one Gaussian.
const TEXELS_PER_GAUSSIAN: usize = 4;

/// Returns the 32-bit words that store the Gaussian `row` in a `.splatv` file.
///
/// - Values beyond the range of half precision become the largest finite value; NaN becomes 0.
/// - The quaternion and its rate of change must not both be stored as 0, because players divide by the length of the
///   quaternion. If both are so small that half precision turns them into 0, both are first divided by the length of
///   the quaternion. If this length is 0, NaN or subnormal, the quaternion becomes the identity instead.
pub fn encode_words(row: &SplatvGaussian) -> [u32; WORDS_PER_GAUSSIAN] {
    let half = |value: f32| {
        let most = f16::MAX.to_f32();
        let held = if value.is_nan() { 0.0 } else { value.clamp(-most, most) };
        u32::from(f16::from_f32(held).to_bits())
    };
    let pair = |low: f32, high: f32| half(low) | half(high) << 16;
    // The cast with `as` truncates, saturates and turns NaN into 0.
    let byte = |value: f64| u32::from((255.0 * value) as u8);
    let SplatvGaussian { position, motion: m, scale: s, rgb: [r, g, b], opacity, center, width, .. } = *row;
    let (mut q, mut o) = (row.rotation, row.omega);
    if q.iter().chain(&o).all(|&x| half(x) & 0x7fff == 0) {
        let length = q.iter().map(|x| x * x).sum::<f32>().sqrt();
        (q, o) = match length.is_normal() {
            true => (q.map(|x| x / length), o.map(|x| x / length)),
            false => ([1.0, 0.0, 0.0, 0.0], o),
        };
    }
    let [x, y, z] = position.map(f32::to_bits);
    let color = byte(r) | byte(g) << 8 | byte(b) << 16 | byte(opacity) << 24;
    [
        x,
        y,
        z,
        pair(q[0], q[1]),
        pair(q[2], q[3]),
        pair(s[0], s[1]),
        pair(s[2], 0.0),
        color,
        pair(m[0], m[1]),
        pair(m[2], m[3]),
        pair(m[4], m[5]),
        pair(m[6], m[7]),
        pair(m[8], 0.0),
        pair(o[0], o[1]),
        pair(o[2], o[3]),
        pair(center, width),
    ]
}

/// Adds the coding errors of Gaussian `id` to `to`: the differences between `row` and the values that a file stores for
/// it. The position error is an upper bound of the error along the Gaussian's path while it is visible, so it includes
/// the rounding of the polynomial coefficients.
pub fn add_errors(row: &SplatvGaussian, id: usize, to: &mut CodingErrors) {
    let held = SplatvGaussian::from_words(&encode_words(row));
    let drawn = |row: &SplatvGaussian| RenderedAttributes {
        position: row.position.map(f64::from),
        scale: row.scale.map(f64::from),
        opacity: row.opacity,
        color: row.rgb,
    };
    let (wanted, mut found) = (drawn(row), drawn(&held));
    let time = (VISIBLE_WIDTHS * f64::from(row.width)).min(1.0);
    for axis in 0..3 {
        let off = |k: usize| f64::from(row.motion[3 * k + axis] - held.motion[3 * k + axis]) * time.powi(k as i32 + 1);
        found.position[axis] += (0..3).map(off).map(f64::abs).sum::<f64>();
    }
    to.add(id, &wanted, &found);
}

/// Returns a camera as a JSON object, as the list of cameras of a `.splatv` file holds it. `rotation` in it is the
/// camera-to-world matrix, as a list of rows.
pub fn camera_json(camera: &Camera) -> Value {
    let to_world = camera.rotation.transpose();
    let position = -(to_world * camera.translation);
    let rotation: Vec<[f64; 3]> = (0..3).map(|row| to_world.row(row).to_array()).collect();
    json!({
        "id": 0, "img_name": "0", "width": camera.width, "height": camera.height, "position": position.to_array(),
        "rotation": rotation, "fy": camera.fy, "fx": camera.fx,
    })
}

/// Returns the JSON list of cameras for a `.splatv` file of a model without cameras. It holds one camera, which looks
/// at the middle of the Gaussians at `positions`.
pub fn default_cameras(positions: &AttributeValues) -> Value {
    let found = RobustBox::from_positions(positions);
    virtual_rig(found.median, found.extent())
        .cameras
        .get(DEFAULT_CAMERA)
        .map_or(json!([]), |camera| json!([self::camera_json(camera)]))
}

/// Writes a `.splatv` file to `path`. `rows` yields the 32-bit words of each of the `count` Gaussians. `cameras` is a
/// JSON list; viewers begin at its first camera.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_splatv(
    path: &Path,
    count: usize,
    rows: impl Iterator<Item = [u32; WORDS_PER_GAUSSIAN]>,
    cameras: &Value,
) -> Result<()> {
    let height = (TEXELS_PER_GAUSSIAN * count).div_ceil(TEXELS_PER_ROW).max(1);
    let size = TEXELS_PER_ROW * height * ROW_BYTES / TEXELS_PER_GAUSSIAN;
    let text = json!([{
        "type": "splat", "size": size, "texwidth": TEXELS_PER_ROW, "texheight": height, "cameras": cameras,
    }]);
    let text = text.to_string();
    let write = |out: &mut dyn Write| {
        out.write_all(&MAGIC.to_le_bytes())?;
        out.write_all(&(text.len() as u32).to_le_bytes())?;
        out.write_all(text.as_bytes())?;
        for row in rows {
            row.iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))?;
        }
        let padding = [0; ROW_BYTES];
        (count..size / ROW_BYTES).try_for_each(|_| out.write_all(&padding))?;
        out.flush()
    };
    let mut out = BufWriter::with_capacity(1 << 18, File::create(path).map_err(Error::io("create", path))?);
    write(&mut out).map_err(Error::io("write", path))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::files::splatv::Splatv;

    /// Returns a Gaussian that depends on `seed`. Its values are exact in half precision or as bytes, as they are
    /// stored.
    fn row(seed: u16) -> SplatvGaussian {
        let value = |k: u16| f16::from_bits(0x3000 + (seed.wrapping_mul(31).wrapping_add(k * 977)) % 0x1000).to_f32();
        let byte = |k: u16| f64::from((seed.wrapping_mul(7).wrapping_add(k)) % 255 + 1) / 255.0 + 1e-4;
        SplatvGaussian {
            position: [value(0), -3.75 - f32::from(seed), 1e-3],
            motion: std::array::from_fn(|k| -value(k as u16)),
            rotation: std::array::from_fn(|k| value(20 + k as u16)),
            omega: std::array::from_fn(|k| value(30 + k as u16)),
            scale: std::array::from_fn(|k| value(40 + k as u16)),
            rgb: std::array::from_fn(|k| byte(k as u16)),
            opacity: byte(9),
            center: value(50),
            width: value(51),
        }
    }

    #[test]
    fn rows_are_read_back_without_the_padding() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("some.splatv");
        for count in [1, 1024, 1025] {
            let rows: Vec<SplatvGaussian> = (0..count).map(row).collect();
            write_splatv(&path, rows.len(), rows.iter().map(encode_words), &json!([{"id": 0}])).unwrap();
            let read = Splatv::open(&path).unwrap();
            assert_eq!((read.count(), read.cameras()[0]["id"].as_u64()), (count as usize, Some(0)));
            let bytes = std::fs::metadata(&path).unwrap().len();
            assert!(
                bytes > 65536 * u64::from(count.div_ceil(1024))
                    && bytes < 65536 * u64::from(count.div_ceil(1024)) + 512
            );
            for (i, expected) in rows.iter().enumerate() {
                let found = SplatvGaussian::from_words(&read.words(i));
                let close = |a: f64, b: f64| (a - b).abs() <= 1.0 / 255.0;
                assert!(
                    found.rgb.iter().zip(expected.rgb).all(|(&a, b)| close(a, b))
                        && close(found.opacity, expected.opacity)
                );
                assert_eq!(SplatvGaussian { rgb: expected.rgb, opacity: expected.opacity, ..found }, *expected);
                assert_eq!(
                    encode_words(&SplatvGaussian { rgb: expected.rgb, opacity: expected.opacity, ..found }),
                    read.words(i)
                );
            }
        }
    }

    #[test]
    fn zero_quaternions_are_never_written() {
        let rotation = |rotation| {
            SplatvGaussian::from_words(&encode_words(&SplatvGaussian { rotation, omega: [0.0; 4], ..row(1) })).rotation
        };
        assert_eq!(rotation([0.0; 4]), [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(rotation([0.0, 3e-9, 0.0, -4e-9]).map(|x| (100.0 * x).round()), [0.0, 60.0, 0.0, -80.0]);
        assert_eq!(rotation([0.0, 0.5, 0.0, 0.0]), [0.0, 0.5, 0.0, 0.0]);
    }

    #[test]
    fn values_beyond_half_precision_are_clamped() {
        let wild = SplatvGaussian { motion: [1e9, -1e9, f32::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], width: 1e6, ..row(1) };
        let found = SplatvGaussian::from_words(&encode_words(&wild));
        assert_eq!((&found.motion[..3], found.width), (&[65504.0, -65504.0, 0.0][..], 65504.0));
        assert_eq!(encode_words(&SplatvGaussian { rgb: [-1.0, 2.0, 0.5], ..row(1) })[7] & 0xffffff, 0x7f_ff_00);
    }

    #[test]
    fn a_camera_has_its_position_and_view_direction() {
        let from = glam::DVec3::new(1.0, -4.0, 2.0);
        let made = camera_json(&Camera::look_at(from, glam::DVec3::ZERO, 1.0, (8, 6)));
        for (c, expected) in from.to_array().into_iter().enumerate() {
            assert!((made["position"][c].as_f64().unwrap() - expected).abs() < 1e-12, "{made}");
            // The third column of the rotation is the view direction.
            let forward = made["rotation"][c][2].as_f64().unwrap();
            assert!((forward + expected / from.length()).abs() < 1e-12, "{made}");
        }
    }

    #[test]
    fn truncated_or_malformed_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("some.splatv");
        write_splatv(&path, 3, (0..3).map(|k| encode_words(&row(k))), &json!([])).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let header = 8 + u32::from_le_bytes(whole[4..8].try_into().unwrap()) as usize;
        for length in (0..200).chain((200..whole.len()).step_by(997)) {
            std::fs::write(&path, &whole[..length]).unwrap();
            // A file may end after a whole row (then only the padding is missing); one that ends within a row is
            // truncated.
            let rows = length.checked_sub(header).filter(|bytes| *bytes > 0 && bytes % ROW_BYTES == 0);
            if let Some(bytes) = rows {
                let file = Splatv::open(&path).unwrap();
                assert_eq!(file.count(), 3.min(bytes / ROW_BYTES), "{length}");
                let note = file.note().unwrap();
                assert!(note.starts_with(&format!("{} rows of 1024 declared", bytes / ROW_BYTES)), "{note}");
                continue;
            }
            let message = Splatv::open(&path).expect_err("cut").to_string();
            assert!(message.contains("some.splatv") && message.contains("bytes"), "{length}: {message}");
        }
        for (from, to, said) in [
            ("\"splat\"", "\"other\"", "entry of type"),
            ("\"texheight\":1", "\"texheight\":7", "size"),
            ("\"texwidth\":4096", "\"texwidth\":-4.5", "texwidth"),
            ("[{", "{{", "JSON"),
        ] {
            let text = String::from_utf8_lossy(&whole[..200]).into_owned();
            let at = text.find(from).unwrap();
            let mut wrong = whole.clone();
            let at = whole.windows(from.len()).position(|bytes| bytes == from.as_bytes()).unwrap_or(at);
            wrong[at..at + to.len()].copy_from_slice(to.as_bytes());
            std::fs::write(&path, &wrong).unwrap();
            let message = Splatv::open(&path).expect_err(said).to_string();
            assert!(message.contains(said), "{message}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_after_the_magic_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("some.splatv");
            std::fs::write(&path, [&MAGIC.to_le_bytes()[..], &bytes].concat()).unwrap();
            _ = Splatv::open(&path);
        }
    }
}
