//! Time that the program's own rasterizer takes for a render of either model.

use std::time::Instant;

use serde::Serialize;

use crate::error::Result;
use crate::evaluation::ModelPair;
use crate::evaluation::found::Both;
use crate::model::FrameView;

/// Number of times each render is repeated; the fastest counts.
const REPEATS: usize = 5;

/// Time of a render before and after compression. The values differ from run to run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RenderTime {
    /// Mean time of a render on all threads, milliseconds.
    pub milliseconds: Both<f64>,
    /// Number of renders that were timed of each model.
    pub renders: usize,
}

/// Times the renders numbered `places` among [`crate::evaluation::found::Evaluation::pictures`].
///
/// # Errors
/// A source that cannot be read.
pub(super) fn measure(pair: &ModelPair, places: &[usize]) -> Result<RenderTime> {
    let mut pictures: Vec<FrameView> = places.iter().map(|&place| pair.picture(place)).collect();
    pictures.sort_by_key(|picture| (picture.frame, picture.view));
    let mut sums = [0.0; 2];
    let mut renders = 0;
    pair.each(&pictures, |view| {
        for (subject, sum) in sums.iter_mut().enumerate() {
            let times = (0..REPEATS).map(|_| {
                let start = Instant::now();
                let _ = view.render(subject, pair.background());
                start.elapsed().as_secs_f64()
            });
            *sum += 1e3 * times.fold(f64::INFINITY, f64::min);
        }
        renders += 1;
        Ok(())
    })?;
    let [original, compressed] = sums.map(|sum| sum / f64::from(renders.max(1)));
    Ok(RenderTime { milliseconds: Both { original, compressed }, renders: renders as usize })
}
