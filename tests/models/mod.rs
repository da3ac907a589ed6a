//! Trained models for tests: frame states at the recorded frames, cameras, and reference renders.
//!
//! This loader shares no code with the library, which it helps to test.

#![allow(dead_code, reason = "each test and bench uses its part")]

use std::fs::{self, File};
use std::io::BufReader;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use splatsieve::model::{Camera, Gaussians};

/// Folder names of the trained models.
pub(crate) const NAMES: [&str; 3] = ["deform2", "room2_dynerf", "room2_big"];

/// Returns the folder of trained models: `SPLATSIEVE_DATA`, or else `../shared/data`. Panics if it is missing.
pub(crate) fn folder() -> PathBuf {
    found().expect("trained models (SPLATSIEVE_DATA)")
}

/// Returns the folder of trained models; prints a note and returns `None` if it is missing.
pub(crate) fn found() -> Option<PathBuf> {
    let folder = std::env::var_os("SPLATSIEVE_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    if !folder.is_dir() {
        eprintln!("no trained models at {}", folder.display());
        return None;
    }
    Some(folder)
}

/// Trained model with recorded frame states.
pub(crate) struct Model {
    folder: PathBuf,
    cameras: serde_json::Value,
}

impl Model {
    pub(crate) fn open(folder: &Path, name: &str) -> Self {
        let folder = folder.join(name);
        let cameras =
            serde_json::from_reader(BufReader::new(File::open(folder.join("cameras.json")).unwrap())).unwrap();
        Model { folder, cameras }
    }

    pub(crate) fn background(&self) -> [f32; 3] {
        std::array::from_fn(|c| self.cameras["background"][c].as_f64().unwrap() as f32)
    }

    pub(crate) fn camera(&self, frame: u64, view: u64) -> Camera {
        let shots = self.cameras["frames"].as_array().unwrap();
        let shot = shots.iter().find(|shot| shot["t"] == frame && shot["v"] == view).unwrap();
        let m = |row: usize, column: usize| shot["w2c"][row][column].as_f64().unwrap();
        let number = |key: &str| shot[key].as_f64().unwrap();
        Camera {
            width: number("width") as u32,
            height: number("height") as u32,
            fx: number("fx"),
            fy: number("fy"),
            cx: number("cx"),
            cy: number("cy"),
            rotation: DMat3::from_cols_array_2d(&std::array::from_fn(|c| std::array::from_fn(|r| m(r, c)))),
            translation: DVec3::new(m(0, 3), m(1, 3), m(2, 3)),
            near: Camera::NEAR,
        }
    }

    /// Returns the numbers of the frames whose states are recorded.
    pub(crate) fn frames(&self) -> Vec<u64> {
        self.array::<i64>("frames").unwrap().into_iter().map(|frame| frame as u64).collect()
    }

    /// Returns the frame and the view of every reference render.
    pub(crate) fn renders(&self) -> Vec<(u64, u64)> {
        let mut renders: Vec<(u64, u64)> = fs::read_dir(self.folder.join("ref_renders"))
            .unwrap()
            .map(|entry| {
                let name = entry.unwrap().file_name().into_string().unwrap();
                (name[1..4].parse().unwrap(), name[6..8].parse().unwrap())
            })
            .collect();
        renders.sort_unstable();
        renders
    }

    /// Returns the reference render of a frame and a view, shape `[height, width, 3]`.
    pub(crate) fn reference(&self, frame: u64, view: u64) -> Vec<f32> {
        let path = self.folder.join(format!("ref_renders/t{frame:03}_v{view:02}.npy"));
        npyz::NpyFile::new(BufReader::new(File::open(path).unwrap())).unwrap().into_vec().unwrap()
    }

    /// Returns the frame state that the trainer's code gives at a recorded frame, with attributes encoded as in a PLY
    /// file.
    pub(crate) fn state(&self, frame: u64) -> Gaussians {
        let at = self.frames().iter().position(|&f| f == frame).unwrap();
        let xyz: Vec<f32> = self.array("xyz").unwrap();
        let rotation: Vec<f32> = self.array("rotation").unwrap();
        let scales: Vec<f32> = self.array("scales").unwrap();
        let opacity: Vec<f32> = self.array("opacity").unwrap();
        let count = xyz.len() / 3 / self.frames().len();
        // Shape [coefficient][channel] for each Gaussian, in the order of the planes of `Gaussians::sh`.
        let sh = self.array(&format!("sh_t{frame}")).unwrap_or_else(|| self.canonical_sh(count));
        let mut state = Gaussians::zeros(count, 3);
        for i in 0..count {
            let row = at * count + i;
            state.position.set_row(i, std::array::from_fn::<f32, 3, _>(|c| xyz[3 * row + c]));
            state.rotation.set_row(i, std::array::from_fn::<f32, 4, _>(|c| rotation[4 * row + c]));
            state
                .log_scale
                .set_row(i, std::array::from_fn::<f32, 3, _>(|c| f64::from(scales[3 * row + c]).ln() as f32));
            let opacity = f64::from(opacity[row]);
            state.opacity_logit.set_row(i, [(opacity / (1.0 - opacity)).ln() as f32]);
            state.sh.set_row(i, std::array::from_fn::<f32, 48, _>(|c| sh[48 * i + c]));
        }
        state
    }

    fn array<T: npyz::Deserialize>(&self, name: &str) -> Option<Vec<T>> {
        let mut archive = npyz::npz::NpzArchive::open(self.folder.join("states.npz")).unwrap();
        Some(archive.by_name(name).unwrap()?.into_vec().unwrap())
    }

    /// Returns the SH coefficients in the model's PLY file, shape `[count, 16, 3]`. Each row of the file has 62 floats;
    /// the colors follow position and normal, and `f_rest` is ordered by channel.
    fn canonical_sh(&self, count: usize) -> Vec<f32> {
        let iteration = fs::read_dir(self.folder.join("point_cloud")).unwrap().next().unwrap().unwrap().path();
        let bytes = fs::read(iteration.join("point_cloud.ply")).unwrap();
        let header = b"end_header\n";
        let start = bytes.windows(header.len()).position(|window| window == header).unwrap() + header.len();
        let floats: Vec<f32> =
            bytes[start..].chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().unwrap())).collect();
        assert_eq!(floats.len(), 62 * count);
        let mut sh = vec![0.0; 48 * count];
        for (row, sh) in floats.chunks_exact(62).zip(sh.chunks_exact_mut(48)) {
            for c in 0..3 {
                sh[c] = row[6 + c];
                for k in 1..16 {
                    sh[3 * k + c] = row[9 + 15 * c + k - 1];
                }
            }
        }
        sh
    }
}
