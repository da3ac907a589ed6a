//! Tests that the PlayCanvas engine, in a browser, draws the `.sog` files of this program as the rasterizer does.
//! `SPLATSIEVE_NODE_MODULES` names a folder `node_modules` with the package `playcanvas`.
#![cfg(unix)]

use std::fs;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::DVec3;
use serde_json::json;
use splatsieve::metrics::psnr;
use splatsieve::model::{Camera, Gaussians};
use splatsieve::render::{Image, render};

use crate::browser::{self, Browser};
use crate::players::{asymmetrical, modules, moved, reversed};
use crate::scene::Workplace;

/// Minimum PSNR of an image of the engine against a render of the rasterizer, dB. About 40 dB were measured: the engine
/// ends a Gaussian at 2.8 standard deviations and widens it by less than 3DGS does.
const MIN_PSNR: f64 = 35.0;
/// PSNR that an image of the wrong Gaussians must not reach, dB.
const WRONG_PSNR: f64 = 25.0;

/// Returns 60 Gaussians without symmetry, of SH degree 0, large enough to cover each other.
fn large_gaussians() -> Gaussians {
    let mut made = asymmetrical(0);
    (0..3).for_each(|axis| made.log_scale.plane_mut(axis).iter_mut().for_each(|x| *x += 1.4));
    made
}

/// Returns the image that the PlayCanvas engine draws of the file `sog`, seen from `camera` on a black background.
fn drawn(page: &mut Browser, workplace: &Workplace, sog: &str, camera: &Camera) -> Image {
    let engine = fs::canonicalize(modules().join("playcanvas/build/playcanvas.js")).unwrap();
    let rows = [0, 1, 2].map(|row| camera.rotation.row(row).to_array());
    let view = json!({
        "size": [camera.width, camera.height], "focal": camera.fy, "eye": camera.center().to_array(), "rotation": rows,
    });
    let bytes = STANDARD.encode(fs::read(workplace.path(sog)).unwrap());
    let text = include_str!("playcanvas.html").replace("ENGINE", &format!("file://{}", engine.display()));
    let text = text.replace("\"SOG\"", &format!("\"{bytes}\"")).replace("CAMERA", &view.to_string());
    fs::write(workplace.path("engine.html"), text).unwrap();
    page.events.clear();
    page.open(&workplace.path("engine.html"));
    let rgb = STANDARD.decode(page.value("rendered").as_str().unwrap()).unwrap();
    browser::image_from_bytes(camera.width, camera.height, &rgb)
}

#[test]
#[ignore = "needs a browser and PlayCanvas"]
fn playcanvas_draws_our_sog_sequence_as_the_rasterizer() {
    let workplace = Workplace::new();
    fs::create_dir(workplace.path("frames")).unwrap();
    let frames: Vec<Gaussians> = (0..2).map(|frame| moved(&large_gaussians(), 20 * frame)).collect();
    for (number, frame) in frames.iter().enumerate() {
        workplace.ply(&format!("frames/frame_{number:04}.ply"), frame);
    }
    workplace.done("convert frames book --as sog-sequence");
    let [eye, target] = [DVec3::new(-2.0, 5.0, 3.0), DVec3::new(5.0, -1.0, 0.5)];
    let camera = Camera::look_at(eye, target, 65f64.to_radians(), (640, 480));
    let mut page = Browser::start_drawing(&browser::installed());
    for (number, frame) in frames.iter().enumerate() {
        let image = drawn(&mut page, &workplace, &format!("book/frame_{number:04}.sog"), &camera);
        let right = psnr(&image, &render(frame, &camera, [0.0; 3]));
        assert!(right > MIN_PSNR, "frame {number}: {right:.1} dB");
        let wrong = psnr(&image, &render(&reversed(frame), &camera, [0.0; 3]));
        assert!(wrong < WRONG_PSNR, "frame {number} with reversed axes: {wrong:.1} dB");
    }
}
