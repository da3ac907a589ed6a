use super::*;
use proptest::prelude::*;

/// Generates f32 bit patterns, including −0, NaN payloads and infinity.
fn bits() -> impl Strategy<Value = u32> {
    prop_oneof![
        any::<u32>(),
        (-2.0f32..2.0).prop_map(f32::to_bits),
        Just((-0.0f32).to_bits()),
        Just(0xffc0_1234),
        Just(0x7f80_0001),
        Just(f32::INFINITY.to_bits()),
    ]
}

fn decode(tile: &EncodedTile) -> Vec<u32> {
    let frames = if tile.constant { 1 } else { tile.frames as usize };
    let plane = tile.width as usize * tile.len as usize;
    let once: Vec<u32> = match tile.encoding {
        Encoding::Raw => tile.bytes.as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect(),
        encoding => {
            let mut decoder = TileDecoder::default();
            let stored = StoredTile { bytes: &tile.bytes, encoding, frames, plane, max_error: tile.max_error };
            decoder.load(stored, &mut Decompressor::new().unwrap()).unwrap();
            decode_frames(&mut decoder, plane, 0..frames)
        }
    };
    if tile.constant { once.repeat(tile.frames as usize) } else { once }
}

fn decode_frames(decoder: &mut TileDecoder, plane: usize, frames: impl Iterator<Item = usize>) -> Vec<u32> {
    let mut one = vec![0; plane];
    frames
        .flat_map(|frame| {
            decoder.frame(frame, &mut one);
            one.clone()
        })
        .collect()
}

/// Returns a decoder that has loaded `values`, frames of `plane` values each, filtered with prediction order `order`.
fn loaded(values: &[u32], plane: usize, order: u8) -> TileDecoder {
    let shuffled = filter(values, plane, order);
    TileDecoder { order, shuffled, recent: [vec![0; plane], vec![0; plane]], ..TileDecoder::default() }
}

proptest! {
    #[test]
    fn integer_maps_are_ordered_bijections(a: u32, b: u32) {
        prop_assert_eq!(unordered(ordered(a)), a);
        prop_assert_eq!(unzigzag(zigzag(a)), a);
        let (x, y) = (f32::from_bits(a), f32::from_bits(b));
        if x < y { prop_assert!(ordered(a) < ordered(b), "{x} < {y}"); }
    }

    #[test]
    fn every_bit_pattern_survives_every_filter(
        (frames, plane, values) in (1usize..6, 1usize..9)
            .prop_flat_map(|(t, p)| (Just(t), Just(p), prop::collection::vec(bits(), t * p))),
    ) {
        for order in 0..=2 {
            let out = decode_frames(&mut loaded(&values, plane, order), plane, 0..frames);
            prop_assert_eq!(&out, &values, "order {}, {} frames", order, frames);
        }
    }

    #[test]
    fn frames_decode_in_any_order(
        (plane, values, asked) in (1usize..9, 1usize..9).prop_flat_map(|(t, p)| {
            (Just(p), prop::collection::vec(bits(), t * p), prop::collection::vec(0..t, 1..12))
        }),
    ) {
        for order in 0..=2 {
            let got = decode_frames(&mut loaded(&values, plane, order), plane, asked.iter().copied());
            let expected: Vec<u32> =
                asked.iter().flat_map(|frame| values[frame * plane..][..plane].to_vec()).collect();
            prop_assert_eq!(got, expected, "order {}, frames {:?}", order, &asked);
        }
    }

    #[test]
    fn every_bit_pattern_survives_every_compression(
        (frames, len, values) in (1u32..6, 1u32..40)
            .prop_flat_map(|(t, n)| (Just(t), Just(n), prop::collection::vec(bits(), (t * n * 2) as usize))),
        level in prop_oneof![Just(Compression::Raw), Just(Compression::Zstd(1)), Just(Compression::Zstd(-3))],
    ) {
        let floats: Vec<f32> = values.iter().map(|&b| f32::from_bits(b)).collect();
        let tile = encode_tile(&floats, frames, 2, len, level).unwrap();
        prop_assert_eq!(decode(&tile), values);
    }
}

#[test]
fn a_straight_line_is_predicted_from_two_frames() {
    let values: Vec<f32> =
        (0..16 * 500).map(|i| 1.0 + (i / 500) as f32 * 0.0078125 + (i % 500) as f32 * 1e-4).collect();
    let tile = encode_tile(&values, 16, 1, 500, Compression::Zstd(1)).unwrap();
    assert_eq!(tile.encoding, Encoding::Filtered { order: 2 });
    assert!(tile.stored_bytes() < 3 * 500, "{} bytes for 16 frames of 500", tile.stored_bytes());
}

#[test]
fn constant_tile_stores_one_frame_and_minus_zero_breaks_it() {
    let still = encode_tile(&[0.0, 2.0, 0.0, 2.0], 2, 1, 2, Compression::Raw).unwrap();
    assert!(still.is_constant());
    assert_eq!(still.stored_bytes(), 8);
    let moved = encode_tile(&[0.0, 2.0, -0.0, 2.0], 2, 1, 2, Compression::Raw).unwrap();
    assert!(!moved.is_constant());
}

#[test]
fn stats_cover_finite_values_only() {
    let got = stats(&[f32::NAN, -3.5, f32::INFINITY, 7.0, f32::NEG_INFINITY].map(f32::to_bits));
    assert_eq!(got, TileStats { min: -3.5, max: 7.0, non_finite: 3 });
    let none = stats(&[f32::NAN.to_bits()]);
    assert_eq!(none, TileStats { min: f32::INFINITY, max: f32::NEG_INFINITY, non_finite: 1 });
    let zero = stats(&[(-0.0f32).to_bits()]);
    assert_eq!((zero.min.to_bits(), zero.max.to_bits()), (0, 0));
}

#[test]
fn decompressed_size_must_be_exact() {
    let mut decoder = TileDecoder::default();
    for len in [0usize, 39, 41, 1 << 24] {
        let bomb = zstd::bulk::compress(&vec![0; len], 1).unwrap();
        let stored = StoredTile {
            bytes: &bomb,
            encoding: Encoding::Filtered { order: 0 },
            frames: 1,
            plane: 10,
            max_error: 0.0,
        };
        let got = decoder.load(stored, &mut Decompressor::new().unwrap());
        assert!(got.is_err(), "{len} bytes passed for 40");
    }
    assert!(decoder.shuffled.capacity() <= 40);
}

#[test]
fn wrong_shapes_and_levels_are_refused() {
    for (frames, width, len) in [(0, 1, 0), (1, 1, 3), (u32::MAX, u32::MAX, u32::MAX)] {
        assert!(encode_tile(&[1.0, 2.0], frames, width, len, Compression::Raw).is_err());
    }
    assert!(encode_tile(&[], 1, 1, 0, Compression::Raw).is_err());
    assert!(encode_tile(&[1.0], 1, 1, 1, Compression::Zstd(99)).is_err());
}
