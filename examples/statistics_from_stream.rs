//! Reads frames from standard input and accumulates statistics of fixed size per Gaussian, in one pass: the number of
//! frames in which a Gaussian is visible, and the length of its path.
//!
//! ```sh
//! splatsieve convert scene.gseq - | cargo run --release --example statistics_from_stream
//! ```

use std::error::Error;
use std::path::Path;

use splatsieve::files::frame_stream::FrameStream;
use splatsieve::limits::ReadLimit;
use splatsieve::model::{Gaussians, opacity};

/// Opacity below which a Gaussian is not drawn in 8-bit images.
const MIN_OPACITY: f64 = 1.0 / 255.0;

/// Statistics of one Gaussian.
#[derive(Clone, Copy, Default)]
struct PathStatistics {
    /// Number of frames in which the opacity is at least [`MIN_OPACITY`].
    visible_frames: u32,
    /// Length of the path of the center, scene units.
    path_length: f64,
    /// Center at the previous frame; `None` before the first frame.
    last: Option<[f32; 3]>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut stream = FrameStream::open(std::io::stdin(), Path::new("standard input"), ReadLimit::NONE)?;
    let count = stream.header().count;
    let mut state: Gaussians = stream.take_constant_attributes();
    let mut statistics = vec![PathStatistics::default(); count];
    let mut frames = 0;
    while stream.next_frame(&mut state)?.is_some() {
        frames += 1;
        for (id, statistics) in statistics.iter_mut().enumerate() {
            let position = state.position.row::<3>(id);
            if opacity(state.opacity_logit.row::<1>(id)[0]) >= MIN_OPACITY {
                statistics.visible_frames += 1;
            }
            if let Some(last) = statistics.last {
                let step = |axis: usize| f64::from(position[axis] - last[axis]);
                statistics.path_length += (0..3).map(|axis| step(axis).powi(2)).sum::<f64>().sqrt();
            }
            statistics.last = Some(position);
        }
    }
    let visible: u64 = statistics.iter().map(|one| u64::from(one.visible_frames)).sum();
    let longest = statistics.iter().map(|one| one.path_length).fold(0.0, f64::max);
    let mean = visible as f64 / count.max(1) as f64;
    println!("{count} Gaussians, {frames} frames; visible in {mean:.1} frames on average; longest path {longest:.3}");
    Ok(())
}
