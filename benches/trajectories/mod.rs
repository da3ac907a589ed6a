//! Inputs of the benchmarks of containers: states of Gaussians over some frames, from trained models and from generated
//! curves.

use std::path::Path;

use splatsieve::model::hash_id;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::models::ModelFolder;
use splatsieve::passes::FramesInMemory;
use splatsieve::source::{FrameSource, Ids};

#[path = "../../tests/models/mod.rs"]
mod models;

const GAUSSIANS: usize = 4096;
/// Number of consecutive frames of a scene. Each tile (values of one attribute that are encoded together) has all of
/// them.
const FRAMES: usize = 32;
/// Number of evenly spaced times in [0, 1) at which the trained models are read; the first [`FRAMES`] are used.
const TIMES: usize = 60;

/// Returns every input scene with its name: generated curves, and the trained models if they are available.
pub(crate) fn scenes() -> Vec<(&'static str, FramesInMemory)> {
    let models =
        models::found().into_iter().flat_map(|folder| models::NAMES.map(|name| (name, trained(&folder, name))));
    std::iter::once(("curves", curves())).chain(models).collect()
}

/// Returns the states of [`FRAMES`] frames of the trained model `name` in `folder`, for Gaussians evenly spread over
/// the point cloud. Attributes that do not vary with time are zero.
fn trained(folder: &Path, name: &str) -> FramesInMemory {
    let times = (0..TIMES).map(|t| t as f64 / TIMES as f64).collect();
    let model = ModelFolder::open(&folder.join(name), None).unwrap().with_times(times).unwrap();
    let info = model.info();
    // Takes runs of 64 consecutive Gaussians, so that neighbors in a tile are as similar as neighbors in the file of
    // the model.
    let runs = GAUSSIANS / 64;
    let ids = (0..GAUSSIANS).map(|i| ((i / 64) * (info.count - 64) / runs + i % 64) as u32).collect::<Vec<_>>();
    let mut reader = model.open(Ids::List(&ids)).unwrap();
    let constant = Gaussians::zeros(GAUSSIANS, info.sh_degree);
    let mut held = FramesInMemory::new(GAUSSIANS, info.sh_degree, info.varying, constant);
    for frame in 0..FRAMES {
        let mut state = Gaussians::zeros(GAUSSIANS, info.sh_degree);
        reader.read(frame, info.varying, &mut state).unwrap();
        held.push(info.times[frame], state);
    }
    held
}

/// Returns a generated scene in which every attribute except SH follows smooth curves of amplitude 1, with noise of
/// 1e-4.
fn curves() -> FramesInMemory {
    let random = |k: usize| (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32;
    let varying = Attributes::all().difference(Attributes::SH);
    let mut held = FramesInMemory::new(GAUSSIANS, 0, varying, Gaussians::zeros(GAUSSIANS, 0));
    for frame in 0..FRAMES {
        let mut state = Gaussians::zeros(GAUSSIANS, 0);
        for (c, column) in varying.iter().enumerate() {
            for (k, x) in state.attribute_values_mut(column).planes_mut().iter_mut().enumerate() {
                let k = c << 20 | k;
                *x = (6.0 * random(k) + 0.05 * frame as f32).sin() + 1e-4 * random(k | (frame + 1) << 32);
            }
        }
        held.push(frame as f64, state);
    }
    held
}

/// Returns the values of the attribute `column` in the tiles of a container: one list `[frames, components, Gaussians]`
/// for each block of Gaussians.
pub(crate) fn tiles(scene: &FramesInMemory, column: Attributes) -> Vec<Vec<f32>> {
    const BLOCK: usize = splatsieve::outputs::container::GAUSSIAN_BLOCK;
    let mut state = Gaussians::zeros(0, scene.info().sh_degree);
    let block = |start: usize| {
        let mut reader = scene.open(Ids::Range(start..start + BLOCK)).unwrap();
        let mut values = Vec::new();
        for frame in 0..scene.len() {
            reader.read(frame, column, &mut state).unwrap();
            values.extend_from_slice(state.attribute_values(column).planes());
        }
        values
    };
    (0..GAUSSIANS).step_by(BLOCK).map(block).collect()
}
