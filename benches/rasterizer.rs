//! Measures the time of a render, and of a render with its gradients: the derivatives of the squared error of the image
//! with respect to every attribute of every Gaussian. The inputs are 10,000 to a million synthetic Gaussians of SH
//! degree 3, images of three sizes, and one thread or all threads. Prints CSV with the median, the smallest and the
//! largest time.
//!
//! Each row also has, for comparison:
//! - the number of blend events (pairs of a pixel and a Gaussian that changes it);
//! - the shortest possible time for their arithmetic on one core;
//! - the time of the scalar reference, the slow f64 renderer that the tests compare with.
//!
//! `scripts/benchmark/rasterizer.py` runs this benchmark and writes docs/benchmarks/rasterizer.csv. `cargo bench
//! --bench rasterizer -- 200000` measures only this number of Gaussians.

mod synthetic;

use std::hint::black_box;
use std::time::Instant;

use glam::{DMat3, DVec3};
use splatsieve::diagnostics::selfcheck::oracle::render as oracle;
use splatsieve::model::{Attributes, Camera, Gaussians, Gradients};
use splatsieve::render::{Image, Renderer};

use synthetic::{blend_limit, cloud};

/// Widths and heights of the images in pixels.
const SIZES: [[u32; 2]; 3] = [[320, 240], [800, 800], [1352, 1014]];
/// Numbers of Gaussians for which renders are measured.
const COUNTS: [usize; 4] = [10_000, 50_000, 200_000, 1_000_000];
/// Number of timed renders for each row of the output.
const RENDERS: usize = 5;

fn main() {
    let only: Option<usize> = std::env::args().skip(1).find_map(|word| word.parse().ok());
    println!(
        "gaussians,width,height,threads,events,events_per_pixel,render_ms,render_ms_min,render_ms_max,gradient_ms,\
         gradient_ms_min,gradient_ms_max,limit_ms,scalar_ms,million_events_per_s"
    );
    for count in COUNTS.into_iter().filter(|count| only.is_none_or(|only| only == *count)) {
        let gaussians = cloud(count);
        for [width, height] in SIZES {
            let focal = 0.9375 * f64::from(width);
            let center = [width, height].map(|pixels| f64::from(pixels) / 2.0);
            let camera = Camera {
                width,
                height,
                fx: focal,
                fy: focal,
                cx: center[0],
                cy: center[1],
                rotation: DMat3::IDENTITY,
                translation: DVec3::ZERO,
                near: Camera::NEAR,
            };
            measure(&gaussians, &camera);
        }
    }
}

/// Measures renders of `gaussians` from `camera` and prints two rows of the CSV: for one thread, and for all threads.
fn measure(gaussians: &Gaussians, camera: &Camera) {
    let start = Instant::now();
    let events = oracle::render_view(gaussians, camera, [0.0; 3], 1).events as f64;
    let scalar = 1e3 * start.elapsed().as_secs_f64();
    let pixels = f64::from(camera.width) * f64::from(camera.height);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    for (threads, mut renderer) in [(1, Renderer::new()), (cores, Renderer::on_all_threads())] {
        let (render, gradient) = times(&mut renderer, gaussians, camera);
        println!(
            "{},{},{},{threads},{events},{:.1},{},{},{:.2},{:.1},{:.0}",
            gaussians.len(),
            camera.width,
            camera.height,
            events / pixels,
            in_columns(&render),
            in_columns(&gradient),
            1e3 * blend_limit(events),
            scalar,
            events / render[RENDERS / 2] / 1e3,
        );
    }
}

/// Returns two lists of times in milliseconds, each sorted: of renders, and of renders with gradients. Both are
/// measured in alternation, so that other load on the machine slows both.
fn times(renderer: &mut Renderer, gaussians: &Gaussians, camera: &Camera) -> ([f64; RENDERS], [f64; RENDERS]) {
    let target = renderer.render(gaussians, camera, [0.5; 3]);
    let squared_error = |image: &Image| {
        let derivative: Vec<f32> = image.data.iter().zip(&target.data).map(|(a, b)| a - b).collect();
        (0.0, Image { data: derivative, ..*image })
    };
    let mut gradients = Gradients::new(gaussians.len(), Attributes::all(), gaussians.sh_degree());
    let (mut render, mut gradient) = ([0.0; RENDERS], [0.0; RENDERS]);
    for k in 0..RENDERS {
        let start = Instant::now();
        drop(black_box(renderer.render(gaussians, camera, [0.0; 3])));
        render[k] = 1e3 * start.elapsed().as_secs_f64();
        let start = Instant::now();
        black_box(renderer.gradient(gaussians, camera, [0.0; 3], squared_error, &mut gradients));
        gradient[k] = 1e3 * start.elapsed().as_secs_f64();
    }
    render.sort_by(f64::total_cmp);
    gradient.sort_by(f64::total_cmp);
    (render, gradient)
}

/// Formats the median, the smallest and the largest of the sorted `times` as three columns of CSV.
fn in_columns(times: &[f64; RENDERS]) -> String {
    format!("{:.2},{:.2},{:.2}", times[RENDERS / 2], times[0], times[RENDERS - 1])
}
