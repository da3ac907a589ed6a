//! Tests of encoding and decoding archives, and of damaged archives.

use std::path::Path;

use proptest::prelude::*;
use xxhash_rust::xxh3::xxh3_64;

use super::*;
use crate::deform::{Tensor, texel_pair};
use crate::model::AttributeValues;

/// Generator of deterministic pseudo-random numbers.
struct NoiseGenerator(u64);

impl NoiseGenerator {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

fn tensor(noise: &mut NoiseGenerator, shape: &[usize]) -> Tensor {
    let data = (0..shape.iter().product()).map(|_| noise.next()).collect();
    Tensor { shape: shape.to_vec(), data }
}

/// Returns the content of an archive with `count` Gaussians, three columns, and tensors of every role (plane, weights,
/// exact, unread). Their values are pseudo-random numbers generated from `seed`.
fn content(seed: u64, count: usize, sh_degree: usize) -> ArchiveContent {
    let mut noise = NoiseGenerator(seed);
    let mut cloud = Gaussians::zeros(count, sh_degree);
    for column in cloud.selected_attribute_values_mut(Attributes::all()) {
        column.planes_mut().iter_mut().for_each(|value| *value = 3.0 * noise.next());
    }
    let mut content = ArchiveContent { cloud, times: [0.0, 1.0], ..ArchiveContent::default() };
    let plane = [1, 3, 7, 9];
    let line = [1, 3, 6, 9];
    for (name, shape, role) in [
        ("a.plane.xy", &plane[..], TensorRole::Plane([0, 1])),
        ("a.plane.yz", &plane, TensorRole::Plane([1, 2])),
        ("a.plane.xt", &line, TensorRole::TimePlane(0)),
        ("a.plane.zt", &line, TensorRole::TimePlane(2)),
        ("a.matrix", &[5, 8], TensorRole::Weights),
        ("a.vector", &[8], TensorRole::Weights),
        ("a.scalar", &[], TensorRole::Weights),
        ("a.exact", &[2, 2, 2], TensorRole::Exact),
        ("a.unread", &[4, 4], TensorRole::Unread),
    ] {
        content.tensors.insert(name.to_owned(), tensor(&mut noise, shape));
        content.field.insert(name.to_owned(), role);
    }
    let corners = Tensor { shape: vec![2, 3], data: vec![2.5, 2.0, 3.5, -2.5, -3.0, -2.0] };
    content.tensors.insert(BOX_TENSOR.to_owned(), corners);
    content.field.insert(BOX_TENSOR.to_owned(), TensorRole::Exact);
    for (name, width) in [("motion", 2), ("window", 1), ("none", 0)] {
        let mut values = AttributeValues::zeros(width, count);
        values.planes_mut().iter_mut().for_each(|value| *value = noise.next());
        content.columns.push(Column { name: name.to_owned(), values, first_frame: None });
    }
    content.extra_bytes = (0..3 * count).map(|i| (i * 7) as u8).collect();
    content.files.insert("cfg_args".to_owned(), b"Namespace()".to_vec());
    content.files.insert("empty".to_owned(), Vec::new());
    content
}

fn some_steps(content: &ArchiveContent, octave: i32) -> QuantizationSteps {
    let step = |k: i32| TensorSteps { step: 8 * octave + k, channels: Vec::new() };
    let tensors = content.field.keys().zip(0..).map(|(name, k)| (name.clone(), step(k)));
    let mut steps = QuantizationSteps { cloud: [0; 8], columns: Vec::new(), field: FieldSteps(tensors.collect()) };
    steps.columns = (0..content.columns.len() as i32).map(|k| 8 * octave + 3 * k).collect();
    steps.cloud.iter_mut().zip(0..).for_each(|(step, k)| *step = 8 * octave - k);
    steps
}

fn near(a: f32, b: f32, step: f64) -> bool {
    f64::from(a - b).abs() <= 0.5 * step + 1e-6 * f64::from(a.abs())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn values_are_within_half_a_step_and_bytes_are_exact(
        seed in any::<u64>(), count in 0usize..60, degree in 0usize..4, octave in -8i32..2
    ) {
        let content = content(seed, count, degree);
        let steps = some_steps(&content, octave);
        let EncodedArchive { bytes, parts, order, .. } = encode(&content, &steps).unwrap();
        prop_assert_eq!(parts.total(), bytes.len() as u64);
        let (back, read) = decode(&bytes, Path::new("a.gsz"), ReadLimit::NONE).unwrap();
        prop_assert_eq!(read, parts);
        prop_assert_eq!(&encode(&content, &steps).unwrap().bytes, &bytes);

        let mut sorted = order.clone();
        sorted.sort_unstable();
        prop_assert_eq!(sorted, (0..count as u32).collect::<Vec<_>>());
        let expected = content.cloud.pick(&order);
        for (k, name) in ATTRIBUTES.iter().enumerate().take(4 + degree + 1) {
            let step = step_size(steps.cloud[k]);
            for (a, b) in attribute_values(&expected, k).zip(attribute_values(&back.cloud, k)) {
                // A rotation that would become zero errs by at most a step.
                let step = if k == 1 { 2.0 * step } else { step };
                prop_assert!(near(a, b, step), "{name}: {a} {b} of step {step}");
            }
        }
        for ((column, decoded), &step) in content.columns.iter().zip(&back.columns).zip(&steps.columns) {
            prop_assert_eq!((&column.name, column.values.width()), (&decoded.name, decoded.values.width()));
            for c in 0..column.values.width() {
                let pairs = order.iter().map(|&id| column.values.plane(c)[id as usize]).zip(decoded.values.plane(c));
                for (a, &b) in pairs {
                    prop_assert!(near(a, b, step_size(step)), "{}: {a} {b} of step {step}", column.name);
                }
            }
        }
        for (i, &id) in order.iter().enumerate() {
            prop_assert_eq!(&back.extra_bytes[3 * i..3 * i + 3], &content.extra_bytes[3 * id as usize..][..3]);
        }
        prop_assert_eq!(&back.files, &content.files);
        prop_assert_eq!(&back.field, &content.field);
        for (name, role) in &content.field {
            let (a, b) = (&content.tensors[name], &back.tensors[name]);
            prop_assert_eq!(&a.shape, &b.shape);
            match role {
                TensorRole::Exact => prop_assert_eq!(a, b),
                TensorRole::Unread => prop_assert!(b.data.iter().all(|&value| value == 0.0)),
                TensorRole::Weights => {
                    let step = step_size(steps.field.0[name].step);
                    prop_assert!(a.data.iter().zip(&b.data).all(|(&a, &b)| near(a, b, step)), "{name}");
                }
                TensorRole::Plane(_) | TensorRole::TimePlane(_) => (),
            }
        }
        // The error of a plane at a Gaussian is at most half the coarsest quantization step that its read weight
        // allows.
        let space = field_box(&content).unwrap();
        for (name, axes) in [("a.plane.xy", [0, 1]), ("a.plane.yz", [1, 2])] {
            let [rows, columns] = [7usize, 9];
            for i in 0..count {
                let u = space.normalized(back.cloud.position.row(i));
                let (p, q) = (texel_pair(u[axes[0]], columns), texel_pair(u[axes[1]], rows));
                for (row, b) in [(q.low, 1.0 - q.fraction), (q.high, q.fraction)] {
                    for (column, a) in [(p.low, 1.0 - p.fraction), (p.high, p.fraction)] {
                        let weight = f64::from(a * b);
                        for c in 0..3 {
                            let at = (c * rows + row as usize) * columns + column as usize;
                            let off = f64::from(content.tensors[name].data[at] - back.tensors[name].data[at]).abs();
                            let step = step_size(steps.field.0[name].step);
                            // If the read weight of a texel is one octave less, its step is half an octave larger;
                            // classes are whole octaves.
                            prop_assert!(off * weight <= 0.75 * step + 1e-4 * weight, "{name} {off} x {weight} of {step}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn damage_with_valid_checksums_never_panics(
        seed in any::<u64>(), places in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)
    ) {
        let content = content(seed, 20, 1);
        let mut bytes = encode(&content, &some_steps(&content, -4)).unwrap().bytes;
        for (place, value) in places {
            let at = place.index(bytes.len());
            bytes[at] ^= value;
        }
        reseal(&mut bytes);
        let _ = decode(&bytes, Path::new("a.gsz"), ReadLimit::NONE);
    }
}

/// Recomputes the checksums of the archive `bytes` after a test changed some of its bytes. If the header gives a
/// section more bytes than follow, the checksum covers the bytes up to the end of the archive.
fn reseal(bytes: &mut [u8]) {
    let long = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
    let head: usize = 12 + 4 * 24 + 8;
    let mut start = head;
    for k in 0..4 {
        let end = start.saturating_add(long(bytes, 12 + 24 * k)).min(bytes.len());
        let sum = xxh3_64(&bytes[start..end]).to_le_bytes();
        bytes[12 + 24 * k + 16..][..8].copy_from_slice(&sum);
        start = end;
    }
    let sum = xxh3_64(&bytes[..head - 8]).to_le_bytes();
    bytes[head - 8..head].copy_from_slice(&sum);
}

#[test]
fn truncated_archives_are_refused_by_name() {
    let content = content(3, 12, 0);
    let bytes = encode(&content, &some_steps(&content, -3)).unwrap().bytes;
    for length in 0..bytes.len() {
        let message = decode(&bytes[..length], Path::new("a.gsz"), ReadLimit::NONE).unwrap_err().to_string();
        assert!(message.contains("a.gsz"), "{length}: {message}");
    }
    let longer = [&bytes[..], &[0]].concat();
    assert!(
        decode(&longer, Path::new("a.gsz"), ReadLimit::NONE)
            .unwrap_err()
            .to_string()
            .contains("after the last section")
    );
}

#[test]
fn any_flipped_bit_is_detected() {
    let content = content(4, 12, 0);
    let bytes = encode(&content, &some_steps(&content, -3)).unwrap().bytes;
    for bit in 0..8 * bytes.len() {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        assert!(decode(&damaged, Path::new("a.gsz"), ReadLimit::NONE).is_err(), "bit {bit}");
    }
}

#[test]
fn impossible_lengths_are_refused_before_allocation() {
    let content = content(5, 12, 0);
    let sound = encode(&content, &some_steps(&content, -3)).unwrap().bytes;
    for place in [0, 8] {
        let mut bytes = sound.clone();
        bytes[12 + place..][..8].copy_from_slice(&(1u64 << 50).to_le_bytes());
        reseal(&mut bytes);
        assert!(decode(&bytes, Path::new("a.gsz"), ReadLimit::NONE).is_err());
    }
    // A consistent table of contents that declares too many Gaussians.
    let path = Path::new("a.gsz");
    let (Sections { table, cloud, field, blobs }, _) =
        file::read(path, &ArchiveHeader::parse(path, &sound, sound.len() as u64).unwrap(), &sound).unwrap();
    let table = String::from_utf8(table).unwrap().replace("\"gaussians\":12", "\"gaussians\":4000000000");
    let bytes = file::write(&Sections { table: table.into_bytes(), cloud, field, blobs }).unwrap().0;
    let message = decode(&bytes, path, ReadLimit::NONE).unwrap_err().to_string();
    assert!(message.contains("bytes of content"), "{message}");
}

#[test]
fn content_beyond_the_memory_limit_is_refused() {
    let content = content(7, 20_000, 0);
    let bytes = encode(&content, &some_steps(&content, -3)).unwrap().bytes;
    decode(&bytes, Path::new("a.gsz"), ReadLimit::new(64 << 20)).unwrap();
    let message = decode(&bytes, Path::new("a.gsz"), ReadLimit::new(1 << 20)).unwrap_err().to_string();
    assert!(message.contains("the archive and its content") && message.contains("--memory"), "{message}");
}

#[test]
fn archives_of_other_versions_are_refused_with_advice() {
    let content = content(6, 2, 0);
    for version in [0, 1, 3] {
        let mut bytes = encode(&content, &some_steps(&content, -3)).unwrap().bytes;
        bytes[8] = version;
        let message = decode(&bytes, Path::new("a.gsz"), ReadLimit::NONE).unwrap_err().to_string();
        for says in ["expected version 2", &format!("version {version}"), "write the archive again from its model"] {
            assert!(message.contains(says), "{message}");
        }
    }
}

#[test]
fn a_table_longer_than_readers_accept_is_not_written() {
    let mut content = content(6, 2, 0);
    (0..20_000).for_each(|k| _ = content.files.insert(format!("{k:060}"), Vec::new()));
    let message = encode(&content, &some_steps(&content, -3)).unwrap_err().to_string();
    assert!(message.contains("at most 1048576 bytes"), "{message}");
}

#[test]
fn non_finite_values_are_refused_by_name() {
    let mut bad = content(7, 3, 0);
    bad.cloud.opacity_logit.set_row(1, [f32::NAN]);
    let message = encode(&bad, &some_steps(&bad, -3)).unwrap_err().to_string();
    assert!(message.contains("opacity_logit of Gaussian 1"), "{message}");
    let mut bad = content(7, 3, 0);
    bad.tensors.get_mut("a.matrix").unwrap().data[4] = f32::INFINITY;
    assert!(encode(&bad, &some_steps(&bad, -3)).unwrap_err().to_string().contains("a.matrix"));
}

#[test]
fn coarse_steps_leave_no_rotation_at_zero() {
    let mut content = content(8, 4, 0);
    let rows = [[0.1, -0.2, 0.3, 0.1], [0.0, -0.4, 0.3, 0.1], [0.0; 4], [0.9, 0.0, 0.0, 0.1]];
    rows.iter().enumerate().for_each(|(i, row)| content.cloud.rotation.set_row(i, *row));
    // A step of 1.
    let EncodedArchive { bytes, order, .. } = encode(&content, &some_steps(&content, 0)).unwrap();
    let mut steps = [0; 8];
    steps[1] = some_steps(&content, 0).cloud[1];
    let (back, _) = decode(&bytes, Path::new("a.gsz"), ReadLimit::NONE).unwrap();
    let mut rounded = content.cloud.clone();
    round_cloud(&mut rounded, &steps, &[1]);
    assert_eq!(back.cloud.rotation, rounded.pick(&order).rotation);
    let is_zero = |i: usize| rounded.rotation.row::<4>(i) == [0.0; 4];
    assert_eq!([0, 1, 2, 3].map(is_zero), [false, false, true, false]);
    assert!(rounded.rotation.plane(2)[0] > 0.0 && rounded.rotation.plane(1)[1] < 0.0, "{rounded:?}");
}

#[test]
fn unread_texels_take_no_bits() {
    let all = content(8, 40, 0);
    let mut far = all.clone();
    // All Gaussians at one position read four texels of each plane.
    for i in 0..far.cloud.len() {
        far.cloud.position.set_row(i, [0.1, 0.2, 0.3]);
    }
    let bits = |content: &ArchiveContent, name: &str| encode(content, &some_steps(content, -6)).unwrap().bits[name];
    assert!(bits(&far, "a.plane.xy") < 0.25 * bits(&all, "a.plane.xy"));
    // Rows of times before the first are not stored: of six rows for times -1 to 1, the first two.
    let mut never = all.clone();
    let row = never.tensors.get_mut("a.plane.xt").unwrap();
    row.data.iter_mut().enumerate().filter(|(i, _)| (i / 9) % 6 < 2).for_each(|(_, value)| *value = 1e4);
    assert_eq!(bits(&all, "a.plane.xt"), bits(&never, "a.plane.xt"));
}

#[test]
fn malformed_tensors_are_refused_by_name() {
    let whole = content(5, 20, 0);
    let steps = some_steps(&whole, -4);
    for shape in [&[7][..], &[2, 1, 4, 4], &[1, 1, 0, 4]] {
        let mut odd = whole.clone();
        odd.tensors.insert("a.plane.xy".to_owned(), tensor(&mut NoiseGenerator(1), shape));
        let message = encode(&odd, &steps).map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("a.plane.xy") && message.contains(&format!("{shape:?}")), "{message}");
    }
    let mut odd = whole.clone();
    odd.tensors.get_mut("a.exact").unwrap().data[3] = f32::INFINITY;
    let encoded = encode(&odd, &steps).unwrap();
    let (back, _) = decode(&encoded.bytes, Path::new("a.gsz"), ReadLimit::NONE).unwrap();
    assert_eq!(back.tensors["a.exact"].data, odd.tensors["a.exact"].data);
}
