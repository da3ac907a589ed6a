//! Test sequence held in memory as plain bits, to compare with what a container returns.

use std::collections::BTreeMap;
use std::path::Path;

use gseq::{
    ColumnSpec, Compression, Layout, Reader, TileBuffer, TileFrames, TileId, TouchedPages, Writer, encode_tile,
};

/// Creates a temporary folder. It lies in memory (`/dev/shm`) if the system allows, because these tests flush thousands
/// of files to storage, which takes milliseconds per file on a disk.
pub(crate) fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() { tempfile::tempdir_in(memory).unwrap() } else { tempfile::tempdir().unwrap() }
}

pub(crate) struct Scene {
    pub(crate) layout: Layout,
    pub(crate) times: Vec<f64>,
    /// Bits of each column, laid out as `[frame][component][gaussian]`.
    pub(crate) bits: Vec<Vec<u32>>,
}

pub(crate) fn layout(gaussians: u64, gaussian_block: u32, frame_block: u32, widths: &[u32]) -> Layout {
    let columns = widths
        .iter()
        .enumerate()
        .map(|(i, &width)| ColumnSpec { name: format!("column_{i}"), width, max_error: 0.0 })
        .collect();
    let attributes = BTreeMap::from([("origin".into(), "a test".into()), ("unit".into(), "Ångström".into())]);
    Layout { gaussians, gaussian_block, frame_block, columns, attributes }
}

impl Scene {
    /// Builds a test sequence of `frames` frames. Values of column 0 change in every frame, column 1 is constant in
    /// time, and other columns hold pseudo-random bits from `seed`, including NaN and −0.
    pub(crate) fn new(layout: Layout, frames: usize, seed: u64) -> Scene {
        let mut state = seed;
        let mut random = move || {
            // SplitMix64 (Steele, Lea, Flood 2014).
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            (z ^ (z >> 31)) as u32
        };
        let n = layout.gaussians as usize;
        let bits = layout.columns.iter().enumerate().map(|(column, spec)| {
            let plane = n * spec.width as usize;
            match column {
                0 => (0..frames * plane)
                    .map(|i| ((i % plane.max(1)) as f32 + (i / plane.max(1)) as f32 * 0.01).to_bits())
                    .collect(),
                1 => (0..plane).map(|_| random()).collect::<Vec<_>>().repeat(frames),
                _ => (0..frames * plane)
                    .map(|_| match random() % 4 {
                        0 => 0x8000_0000,
                        1 => 0x7fc0_0000 | random() >> 10,
                        _ => random(),
                    })
                    .collect(),
            }
        });
        Scene { bits: bits.collect(), times: (0..frames).map(|t| t as f64 * 0.5 - 1.0).collect(), layout }
    }

    pub(crate) fn tiles(&self) -> Vec<TileId> {
        let blocks = self.times.len().div_ceil(self.layout.frame_block as usize) as u32;
        let mut ids = Vec::new();
        for frame_block in 0..blocks {
            for gaussian_block in 0..self.layout.gaussian_blocks() {
                for column in 0..self.layout.columns.len() as u32 {
                    ids.push(TileId { column, gaussian_block, frame_block });
                }
            }
        }
        ids
    }

    pub(crate) fn tile(&self, id: TileId) -> (Vec<u32>, u32, u32, u32) {
        let width = self.layout.columns[id.column as usize].width as usize;
        let n = self.layout.gaussians as usize;
        let gaussians = self.layout.gaussian_range(id.gaussian_block);
        let frames = self.layout.frame_range(id.frame_block, self.times.len() as u64);
        let mut out = Vec::new();
        for frame in frames.clone() {
            for component in 0..width {
                let plane = (frame as usize * width + component) * n;
                out.extend(
                    &self.bits[id.column as usize][plane + gaussians.start as usize..plane + gaussians.end as usize],
                );
            }
        }
        (out, (frames.end - frames.start) as u32, width as u32, (gaussians.end - gaussians.start) as u32)
    }

    /// Sets the error bound `max_error` for every column but the last, and writes the scene to the container `path`.
    /// Returns the original scene, then the scene as read back from the file.
    #[allow(dead_code, reason = "not every test has bounds")]
    pub(crate) fn bounded(mut self, max_error: f64, path: &Path) -> (Scene, Scene) {
        let columns = self.layout.columns.len();
        self.layout.columns[..columns - 1].iter_mut().for_each(|column| column.max_error = max_error);
        self.write(path, Compression::Zstd(1), |_| ());
        let reader = Reader::open(path).unwrap();
        let mut buffer = TileBuffer::default();
        let n = self.layout.gaussians as usize;
        let mut back = Scene { layout: self.layout.clone(), times: self.times.clone(), bits: self.bits.clone() };
        for id in self.tiles() {
            let tile = reader.read_tile(id, &mut buffer).unwrap();
            let gaussians = self.layout.gaussian_range(id.gaussian_block);
            let first = id.frame_block as usize * self.layout.frame_block as usize;
            for (frame, component) in (0..tile.frames()).flat_map(|f| (0..tile.width()).map(move |c| (f, c))) {
                let at = ((first + frame) * tile.width() + component) * n + gaussians.start as usize;
                let plane = tile.plane(frame, component).iter().map(|value| value.to_bits());
                back.bits[id.column as usize].splice(at..at + tile.len(), plane).for_each(drop);
            }
        }
        (self, back)
    }

    /// Writes the scene to the container `path`, with the tiles in the order set by `shuffle`. The time stamps of a
    /// block of frames are written before the first of its tiles. Returns the hash of the content.
    pub(crate) fn write(&self, path: &Path, compression: Compression, shuffle: impl Fn(&mut Vec<TileId>)) -> u64 {
        let mut writer = Writer::create(path, self.layout.clone()).unwrap();
        self.fill(&mut writer, compression, shuffle);
        writer.finish().unwrap()
    }

    pub(crate) fn fill(&self, writer: &mut Writer, compression: Compression, shuffle: impl Fn(&mut Vec<TileId>)) {
        let mut ids = self.tiles();
        shuffle(&mut ids);
        let mut blocks = self.times.chunks(self.layout.frame_block as usize);
        let mut appended = 0;
        if self.layout.gaussians == 0 {
            for times in blocks.by_ref() {
                writer.append_times(times).unwrap();
            }
        }
        for id in ids {
            while appended <= id.frame_block {
                assert_eq!(writer.append_times(blocks.next().unwrap()).unwrap(), appended);
                appended += 1;
            }
            let (bits, frames, width, len) = self.tile(id);
            let values: Vec<f32> = bits.into_iter().map(f32::from_bits).collect();
            let compression = match self.layout.columns[id.column as usize].max_error {
                0.0 => compression,
                max_error => Compression::Bounded { max_error, level: 1 },
            };
            writer.write_tile(id, &encode_tile(&values, frames, width, len, compression).unwrap()).unwrap();
        }
    }

    /// Asserts that `reader` has exactly the first `frames` frames of this scene, with every method of reading. Returns
    /// an error if reading fails.
    pub(crate) fn compare(&self, reader: &Reader, frames: usize) -> gseq::Result<()> {
        assert_eq!(*reader.layout(), self.layout);
        assert_eq!(reader.times(), &self.times[..frames]);
        let mut buffer = TileBuffer::default();
        for id in self.tiles().into_iter().filter(|id| id.frame_block < reader.frame_blocks()) {
            let (bits, frames, width, len) = self.tile(id);
            for in_place in [true, false] {
                let tile = if in_place { reader.tile(id, &mut buffer)? } else { reader.read_tile(id, &mut buffer)? };
                assert_eq!((tile.frames(), tile.width(), tile.len()), (frames as usize, width as usize, len as usize));
                let planes = (0..tile.frames()).flat_map(|f| (0..tile.width()).map(move |c| (f, c)));
                let got: Vec<u32> = planes.flat_map(|(f, c)| tile.plane(f, c)).map(|v| v.to_bits()).collect();
                assert!(got == bits, "{id:?}, in place {in_place}: wrong data");
            }
            for in_place in [true, false] {
                let (mut one_by_one, mut touched) = (TileFrames::default(), TouchedPages::default());
                reader.load(id, &mut buffer, &mut one_by_one, in_place.then_some(&mut touched))?;
                let (mut values, mut frame_buffer) = (vec![0.0; (width * len) as usize], Vec::new());
                for (frame, bits) in bits.chunks_exact(values.len()).enumerate() {
                    reader.read_frame(&mut one_by_one, frame, &mut values)?;
                    let lent = reader.frame(&mut one_by_one, frame, &mut frame_buffer)?;
                    for values in [&values, lent] {
                        let same = values.iter().map(|v| v.to_bits()).eq(bits.iter().copied());
                        assert!(same, "{id:?}, frame {frame}, in place {in_place}: wrong data");
                    }
                    reader.release(&mut touched);
                }
            }
        }
        Ok(())
    }
}
