//! Poster: an image of the scene, which the page shows until the scene itself is drawn.

use std::io;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::error::{Error, Result};
use crate::files::image::write::jpeg_bytes;
use crate::limits::Limits;
use crate::memory_plan::{MemoryPart, SHARED_VIEW_BYTES_PER_GAUSSIAN};
use crate::model::{Camera, FrameView, Rig};
use crate::passes::{BatchLimits, RenderedSource, for_each_view_batch};
use crate::render;
use crate::source::FrameSource;

/// Maximum number of pixels of a poster.
const MAX_PIXELS: f64 = 160_000.0;
/// JPEG quality of a poster, from 1 to 100.
const QUALITY: u8 = 80;

/// Renders the first view of `rig` over the color `background`, and returns the image as a JPEG in a data URI. The
/// frame of `source` is the one nearest to the time of the view, or the first frame if the view has no time. Returns
/// `None` if there are no views or no frames.
///
/// # Errors
/// Fails if a frame cannot be read.
pub fn render_poster(
    source: &dyn FrameSource,
    rig: &Rig,
    background: [f32; 3],
    limits: &Limits,
) -> Result<Option<String>> {
    let Some(rig_view) = rig.views.first() else { return Ok(None) };
    let times = &source.info().times;
    let away = |frame: &usize| rig_view.time.map_or(0.0, |time| (times[*frame] - time).abs());
    let Some(frame) = (0..times.len()).min_by(|a, b| away(a).total_cmp(&away(b))) else { return Ok(None) };
    let camera = smaller(&rig.cameras[rig_view.camera as usize]);
    let frame_view = FrameView { frame, view: rig_view.view, camera: 0 };
    let mut uri = None;
    for_each_view_batch(
        [RenderedSource::all_gaussians(source)],
        &[camera],
        &[frame_view],
        BatchLimits::one_frame(limits),
        |views| {
            for view in views {
                let bytes = jpeg_bytes(&view.render(0, background), QUALITY)
                    .map_err(|error: io::Error| Error::internal(format!("the poster cannot be written: {error}")))?;
                uri = Some(format!("data:image/jpeg;base64,{}", STANDARD.encode(bytes)));
            }
            Ok(())
        },
    )?;
    Ok(uri)
}

/// Returns the memory for rendering a poster, in bytes, as two parts: an amount per Gaussian, and an amount for the
/// render itself.
pub fn poster_memory() -> [MemoryPart; 2] {
    // 16 bytes per pixel: three channels of f32, their 8-bit values, and the JPEG.
    [("poster", SHARED_VIEW_BYTES_PER_GAUSSIAN), ("poster", render::STRIP_BYTES as u64 + 16 * MAX_PIXELS as u64)]
}

/// Returns `camera` with its resolution reduced so that renders have at most about [`MAX_PIXELS`] pixels.
fn smaller(camera: &Camera) -> Camera {
    let pixels = f64::from(camera.width) * f64::from(camera.height);
    let scale = (MAX_PIXELS / pixels).sqrt().min(1.0);
    let side = |pixels: u32| (f64::from(pixels) * scale).floor().max(1.0);
    let (width, height) = (side(camera.width), side(camera.height));
    // Width and height are rounded to whole pixels, so x and y have different scales.
    let (across, down) = (width / f64::from(camera.width), height / f64::from(camera.height));
    Camera {
        width: width as u32,
        height: height as u32,
        fx: across * camera.fx,
        fy: down * camera.fy,
        cx: across * camera.cx,
        cy: down * camera.cy,
        ..camera.clone()
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;

    #[test]
    fn a_poster_is_a_jpeg_of_few_pixels() {
        let scene = DemoScene::new(400, 3);
        let mut rig = scene.rig();
        let uri = render_poster(&scene, &rig, [0.0; 3], &Limits::NONE).unwrap().unwrap();
        let bytes = STANDARD.decode(uri.strip_prefix("data:image/jpeg;base64,").unwrap()).unwrap();
        assert_eq!(bytes[..2], [0xff, 0xd8]);
        rig.views.clear();
        assert!(render_poster(&scene, &rig, [0.0; 3], &Limits::NONE).unwrap().is_none());
    }

    #[test]
    fn a_large_camera_is_made_smaller_and_keeps_its_field_of_view() {
        let camera = Camera::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::ZERO, 1.0, (1920, 1080));
        let small = smaller(&camera);
        assert!(f64::from(small.width * small.height) <= MAX_PIXELS, "{}x{}", small.width, small.height);
        let angle = |camera: &Camera| f64::from(camera.width) / camera.fx;
        assert!((angle(&small) - angle(&camera)).abs() < 1e-9);
        let tiny = Camera::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::ZERO, 1.0, (64, 48));
        assert_eq!((smaller(&tiny).width, smaller(&tiny).height), (64, 48));
    }
}
