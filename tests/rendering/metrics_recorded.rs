//! Tests that compare PSNR, SSIM and FLIP with values of independent implementations. `scripts/record_metrics.py`
//! recorded the values and the images.

use std::fs::{self, File};
use std::path::Path;

use splatsieve::metrics::{flip, psnr, ssim};
use splatsieve::render::Image;

/// Returns the images in the fixture `name`, whose array has the shape `[images, height, width, 3]`.
fn fixture_images(folder: &Path, name: &str) -> Vec<Image> {
    let file = npyz::NpyFile::new(File::open(folder.join(name)).unwrap()).unwrap();
    let [count, height, width, 3] = file.shape() else { panic!("{name} has the wrong shape") };
    let (count, height, width) = (*count as usize, *height as u32, *width as u32);
    let data: Vec<f32> = file.into_vec().unwrap();
    data.chunks_exact(data.len() / count).map(|data| Image { width, height, data: data.to_vec() }).collect()
}

#[test]
fn metrics_agree_with_reference_implementations() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/metrics");
    let expected: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(folder.join("expected.json")).unwrap()).unwrap();
    let (a, b) = (fixture_images(&folder, "a.npy"), fixture_images(&folder, "b.npy"));
    assert_eq!(a.len(), 4);
    for (i, (a, b)) in a.iter().zip(&b).enumerate() {
        // The reference FLIP is a later version that filters rows and columns separately; ours filters in two
        // dimensions, both in f32.
        for (name, got, tolerance) in
            [("psnr", psnr(a, b), 1e-9), ("ssim", ssim(a, b), 1e-9), ("flip", flip(a, b), 1e-4)]
        {
            let expected = expected[name][i].as_f64().unwrap();
            assert!((got - expected).abs() < tolerance, "{name} of image {i}: got {got}, expected {expected}");
        }
    }
}
