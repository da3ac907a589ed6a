//! Renders one view of a model on the CPU and writes it as a PNG.
//!
//! ```sh
//! cargo run --release --example render -- model data view.png    # data: the folder with the cameras
//! ```

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use splatsieve::files::image::write::{ImageFormat, write_image};
use splatsieve::model::Attributes;
use splatsieve::passes::gather_all;
use splatsieve::render::render;
use splatsieve::scene::view_selection::{ViewSet, select_views};
use splatsieve::scene::{InputOptions, open_scene};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [model, cameras, output] = &arguments[..] else { return Err("expected: MODEL CAMERAS OUTPUT.png".into()) };
    let input = InputOptions { path: model.clone(), cameras: Some(cameras.clone()), ..InputOptions::default() };
    let scene = open_scene(&input)?;
    let views = select_views(&scene.rig, &scene.source().info().times, ViewSet::HeldOut)?;
    let view = views.first().ok_or("the cameras have no view")?;
    let state = gather_all(scene.source(), view.frame, Attributes::all())?;
    let start = Instant::now();
    let image = render(&state, &scene.rig.cameras[view.camera as usize], scene.background);
    println!(
        "frame {}, view {}: {} Gaussians, {}x{} pixels, {:.1} ms",
        view.frame,
        view.view,
        state.len(),
        image.width,
        image.height,
        1e3 * start.elapsed().as_secs_f64()
    );
    write_image(&image, ImageFormat::Png, output)?;
    Ok(())
}
