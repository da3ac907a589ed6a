use std::collections::BTreeMap;

use gseq::{Compression, TileId};
use rayon::prelude::*;

use super::tiles::KeptColumn;
use super::*;
use crate::model::Attributes;
use crate::model::Gaussians;
use crate::model::hash_id;
use crate::outputs::container::{FRAME_BLOCK, GAUSSIAN_BLOCK, write_container};
use crate::source::ReadPlan;

const COUNT: usize = 2 * GAUSSIAN_BLOCK + 77;
const FRAMES: usize = 2 * FRAME_BLOCK + 5;

/// Frame source whose tiles need every encoding of the container: positions are noise in the first Gaussian block (zstd
/// cannot compress it) and curves in the others; opacities change only in the second frame block; rotations are
/// constant in the last Gaussian block; scales and colors never change.
struct EncodingSource(SequenceInfo);

impl EncodingSource {
    fn new() -> EncodingSource {
        let varying = Attributes::POSITION | Attributes::ROTATION | Attributes::OPACITY;
        EncodingSource(SequenceInfo {
            count: COUNT,
            times: (0..FRAMES).map(|t| t as f64).collect(),
            sh_degree: 1,
            varying,
        })
    }

    fn pack(&self, compression: Compression) -> (tempfile::TempDir, Container) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("made.gseq");
        write_container(self, &path, compression, BTreeMap::new(), |_| ()).unwrap();
        let container = Container::open(&path).unwrap();
        (folder, container)
    }

    fn value(column: Attributes, id: usize, component: usize, frame: usize) -> f32 {
        let noise = |k: usize| (hash_id(k as u64) >> 32) as u32;
        let key = 64 * id + component;
        let moves = match column {
            Attributes::POSITION if id < GAUSSIAN_BLOCK => {
                return f32::from_bits(noise(key | frame << 32) & 0xbfff_ffff);
            }
            Attributes::POSITION => true,
            Attributes::ROTATION => id < 2 * GAUSSIAN_BLOCK,
            Attributes::OPACITY => frame / FRAME_BLOCK == 1,
            _ => false,
        };
        (noise(key) as f32 * 1e-9 + if moves { 0.05 * frame as f32 } else { 0.0 }).sin()
    }

    /// Returns the attributes `want` of the Gaussians `ids` at frame `frame`, computed from the formula of this test
    /// source.
    fn expected(&self, ids: &Ids<'_>, frame: usize, want: Attributes) -> Gaussians {
        let mut out = Gaussians::zeros(0, 1);
        for column in want.iter() {
            let to = out.attribute_values_mut(column);
            to.resize(ids.len());
            for c in 0..to.width() {
                to.plane_mut(c)
                    .iter_mut()
                    .zip(ids.iter())
                    .for_each(|(x, id)| *x = EncodingSource::value(column, id, c, frame));
            }
        }
        out
    }
}

impl FrameSource for EncodingSource {
    fn info(&self) -> &SequenceInfo {
        &self.0
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(EncodingReader(self, ids.iter().map(|id| id as u32).collect())))
    }
}

struct EncodingReader<'a>(&'a EncodingSource, Vec<u32>);

impl BlockReader for EncodingReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let source = self.0.expected(&Ids::List(&self.1), frame, want);
        want.iter().for_each(|column| *out.attribute_values_mut(column) = source.attribute_values(column).clone());
        Ok(())
    }
}

/// Returns five selections of Gaussians to be read in tests. A tile holds consecutive Gaussians. The selections are:
///
/// - all Gaussians of the first tile
/// - all Gaussians of the last tile, which is shorter
/// - some Gaussians of one tile
/// - some Gaussians of two adjacent tiles
/// - the Gaussians with the indices `scattered`, in any order
fn blocks(scattered: &[u32]) -> [Ids<'_>; 5] {
    let tile = GAUSSIAN_BLOCK;
    [
        Ids::Range(0..tile),
        Ids::Range(2 * tile..COUNT),
        Ids::Range(3..9),
        Ids::Range(tile - 4..tile + 4),
        Ids::List(scattered),
    ]
}

#[test]
fn frames_are_independent_of_order_and_of_held_frames() {
    let source = EncodingSource::new();
    let scattered = [COUNT as u32 - 1, 5, 6, 7, 2000, 4, 1024, 1023];
    for compression in [Compression::Zstd(1), Compression::Raw] {
        let (_folder, container) = source.pack(compression);
        for ids in blocks(&scattered) {
            for held in [1, 3, FRAME_BLOCK, usize::MAX] {
                let mut reader = container.open(ids.clone()).unwrap();
                reader.expect(&ReadPlan::all_frames().with_max_kept_frames(held));
                for k in 0..3 * FRAMES / 2 {
                    let frame = if k < FRAMES { k } else { hash_id(k as u64) as usize % FRAMES };
                    let want = if k % 7 == 0 { Attributes::all() } else { source.info().varying };
                    let mut got = Gaussians::zeros(0, 1);
                    reader.read(frame, want, &mut got).unwrap();
                    let expected = source.expected(&ids, frame, want);
                    assert!(got == expected, "{compression:?}, {ids:?}, holding {held}: frame {frame} is wrong");
                }
            }
        }
    }
}

#[test]
fn a_reader_keeps_no_more_than_allowed() {
    let source = EncodingSource::new();
    let varying = source.info().varying.width(1);
    let scattered: Vec<u32> = (0..COUNT as u32).step_by(3).collect();
    let (_folder, container) = source.pack(Compression::Zstd(1));
    for ids in blocks(&scattered) {
        for held in [1, 3, FRAME_BLOCK] {
            let mut reader = TileReader::new(&container, &ids);
            reader.expect(&ReadPlan::all_frames().with_max_kept_frames(held));
            let mut state = Gaussians::zeros(0, 1);
            for frame in 0..FRAMES {
                reader.read(frame, Attributes::all(), &mut state).unwrap();
                let values = |kept: &KeptColumn| match kept {
                    KeptColumn::Nothing => 0,
                    KeptColumn::Tile(_, frames) => frames.memory_bytes() / 4,
                    KeptColumn::Values(kept) => kept.values.capacity(),
                };
                let kept: usize = reader.kept.iter().map(values).sum();
                let frames = match held {
                    1 => 0,
                    FRAME_BLOCK if reader.is_whole_tile => FRAME_BLOCK + 2,
                    _ => held,
                };
                let most = frames * varying * ids.len();
                assert!(kept <= most, "{ids:?}, holding {held}, frame {frame}: {kept} values kept, {most} allowed");
            }
        }
    }
}

/// Returns the number of tiles that are read in one pass over all frames, and the number of bytes that these tiles take
/// in the file. A tile holds one attribute for a block of Gaussians and frames.
fn all_tiles(container: &Container) -> (u64, u64) {
    let (reader, mut found) = (container.reader(), (0, 0));
    for &(column, place) in &container.places {
        let frame_blocks = if container.info.varying.contains(column) { reader.frame_blocks() } else { 1 };
        for frame_block in 0..frame_blocks {
            for gaussian_block in 0..reader.layout().gaussian_blocks() {
                let at = TileId { column: place, gaussian_block, frame_block };
                found = (found.0 + 1, found.1 + reader.tile_info(at).unwrap().stored_bytes);
            }
        }
    }
    found
}

/// Reads every frame of each block of Gaussians, as a pass over all frames does, and asserts that all positions equal
/// those of `source`.
fn scan(source: &EncodingSource, container: &Container) {
    (0..COUNT.div_ceil(GAUSSIAN_BLOCK)).into_par_iter().for_each(|block| {
        let ids = Ids::Range(block * GAUSSIAN_BLOCK..COUNT.min((block + 1) * GAUSSIAN_BLOCK));
        let mut reader = container.open(ids.clone()).unwrap();
        let mut got = Gaussians::zeros(0, 1);
        for frame in 0..FRAMES {
            let want = if frame == 0 { Attributes::all() } else { source.info().varying };
            reader.read(frame, want, &mut got).unwrap();
            assert!(
                got.position == source.expected(&ids, frame, Attributes::POSITION).position,
                "{ids:?}, frame {frame}"
            );
        }
    });
}

#[test]
fn a_scan_reads_each_stored_byte_once() {
    let source = EncodingSource::new();
    for compression in [Compression::Zstd(1), Compression::Raw] {
        let (_folder, container) = source.pack(compression);
        assert_eq!(container.reads(), ReadCounts::default());
        let (tiles, bytes) = all_tiles(&container);
        let once = ReadCounts { bytes, tiles, states: (COUNT * FRAMES) as u64 };
        scan(&source, &container);
        assert_eq!(container.reads(), once, "{compression:?}");
        // The first scan has verified the raw (uncompressed) tiles. A second scan must read the same bytes again.
        scan(&source, &container);
        assert_eq!(container.reads() - once, once, "{compression:?}, again");
    }
}

#[test]
fn each_tile_is_read_once_for_all_planned_frames() {
    let source = EncodingSource::new();
    let scattered = [COUNT as u32 - 1, 5, 6, 7, 2000, 4, 1024, 1023];
    let wanted = [0, 3, 9, 30, 31, 33, 64, 65, 68];
    for compression in [Compression::Zstd(1), Compression::Raw] {
        for ids in blocks(&scattered) {
            let blocks: std::collections::BTreeSet<usize> = ids.iter().map(|id| id / GAUSSIAN_BLOCK).collect();
            // The three frame blocks have 5, 1 and 3 of these frames. With at most 2 frames decoded together they are
            // read 3 + 1 + 2 times.
            for (held, times) in [(usize::MAX, 3), (5, 3), (2, 6)] {
                let (_folder, container) = source.pack(compression);
                let mut reader = container.open(ids.clone()).unwrap();
                reader.expect(&ReadPlan::new(wanted).with_max_kept_frames(held));
                let mut got = Gaussians::zeros(0, 1);
                for frame in wanted {
                    reader.read(frame, Attributes::POSITION, &mut got).unwrap();
                    assert!(got.position == source.expected(&ids, frame, Attributes::POSITION).position);
                }
                let tiles = container.reads().tiles;
                assert!(
                    tiles <= (times * blocks.len()) as u64,
                    "{compression:?}, {ids:?}, holding {held}: {tiles} tiles taken, {} blocks",
                    blocks.len()
                );
            }
        }
    }
}

#[test]
fn held_tiles_are_read_once_and_have_the_same_values() {
    let source = EncodingSource::new();
    let scattered = [COUNT as u32 - 1, 5, 6, 7, 2000, 4, 1024, 1023];
    for compression in [Compression::Zstd(1), Compression::Raw] {
        let whole = source.pack(compression).1.decoded_bytes();
        for capacity in [0, whole / 3, whole] {
            let (_folder, container) = source.pack(compression);
            container.hold_decoded(capacity);
            for ids in blocks(&scattered) {
                for wanted in
                    [ReadPlan::all_frames(), ReadPlan::all_frames().with_max_kept_frames(1), ReadPlan::new([7, 8, 40])]
                {
                    let mut reader = container.open(ids.clone()).unwrap();
                    reader.expect(&wanted);
                    for frame in [0, 7, 8, 40, FRAMES - 1, 7] {
                        let mut got = Gaussians::zeros(0, 1);
                        reader.read(frame, Attributes::all(), &mut got).unwrap();
                        let expected = source.expected(&ids, frame, Attributes::all());
                        assert!(got == expected, "{compression:?}, {ids:?}, {capacity} bytes: frame {frame} is wrong");
                    }
                }
            }
            scan(&source, &container);
            let read = container.reads().bytes;
            let (_, all) = all_tiles(&container);
            assert!(capacity < whole || read == all, "{read} bytes read, of {all}");
            scan(&source, &container);
            let again = container.reads().bytes - read;
            assert!(
                if capacity == whole { again == 0 } else { again > 0 },
                "{again} bytes read again, {capacity} held"
            );
            assert!(capacity == whole || capacity == 0 || again < all, "{again} bytes of {all} read again");
        }
    }
}
