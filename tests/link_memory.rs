//! Test that compares the memory of opening linked frames, counted in allocated bytes, with the estimate that
//! `--memory` uses.

#[path = "corpus/memory.rs"]
mod memory;

use std::path::Path;

use splatsieve::files::ply::write::write_inria;
use splatsieve::model::Gaussians;
use splatsieve::model::hash_id;
use splatsieve::models::{OpenOptions, open};

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

const LIVING: usize = 20_000;
const FRAMES: usize = 40;
/// Number of frames for which each Gaussian is alive, before another one begins elsewhere.
const LIFE: usize = 5;

/// Returns a number evenly distributed in [0, 1) that depends only on `seed`.
fn uniform(seed: usize) -> f32 {
    (hash_id(seed as u64) >> 40) as f32 / (1u64 << 24) as f32
}

/// Writes PLY frames with equal numbers of Gaussians to `folder`. Each frame has its Gaussians in another order.
fn write_frames(folder: &Path) {
    for frame in 0..FRAMES {
        let mut out = Gaussians::zeros(LIVING, 1);
        for at in 0..LIVING {
            let place = (at + 7919 * frame) % LIVING;
            let (life, age) = ((frame + place % LIFE) / LIFE, (frame + place % LIFE) % LIFE);
            let value = |k: usize| uniform(32 * (place + LIVING * life) + k);
            out.position.set_row(at, [0, 1, 2].map(|k| 4.0 * value(k) + 0.002 * age as f32));
            out.rotation.set_row(at, [3, 4, 5, 6].map(|k| value(k) - 0.5));
            out.log_scale.set_row(at, [7, 8, 9].map(|k| -5.0 + 0.3 * value(k)));
            out.opacity_logit.set_row(at, [3.0 * value(10)]);
            out.sh.set_row::<3>(at, [11, 12, 13].map(|k| 3.0 * value(k) - 1.5));
        }
        write_inria(&out, &[], &folder.join(format!("{frame}.ply"))).unwrap();
    }
}

#[test]
fn memory_of_linking_matches_the_estimate() {
    let folder = tempfile::tempdir().unwrap();
    rayon::ThreadPoolBuilder::new().num_threads(2).build_global().unwrap();
    write_frames(folder.path());
    let options = OpenOptions { scratch: Some(folder.path().to_owned()), ..OpenOptions::default() };
    let (input, peak) = memory::peak(|| open(folder.path(), &options).unwrap().into_linked().unwrap());
    let tracks = input.source().info().count;
    assert!((LIVING * FRAMES / LIFE..LIVING * FRAMES / LIFE * 6 / 5).contains(&tracks), "{tracks}");
    let residence = input.memory_profile();
    let estimated = tracks as u64 * (residence.opening + residence.per_gaussian);
    eprintln!("{tracks} tracks: at most {peak} bytes, {estimated} stated");
    // The estimate also counts pages of files and the memory of a render.
    assert!(peak as u64 <= estimated, "{peak} bytes, {estimated} stated");
    assert!(3 * peak as u64 >= estimated, "{estimated} stated for {peak} bytes");
}
