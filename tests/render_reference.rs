//! The rasteriser against pictures of trained models made by a port of the original one.

mod models;

use splatsieve::render;

#[test]
fn reference_renders_reproduce_at_80_db() {
    let Some(folder) = models::folder() else { return };
    let mut compared = 0;
    for name in models::NAMES {
        let model = models::Model::open(&folder, name);
        let recorded = model.frames();
        for (frame, view) in model.renders().into_iter().filter(|(frame, _)| recorded.contains(frame)) {
            let got = render::render(&model.state(frame), &model.camera(frame, view), model.background());
            let expected = model.reference(frame, view);
            assert_eq!(got.data.len(), expected.len());
            let squares = got.data.iter().zip(&expected).map(|(a, b)| f64::from(a - b).powi(2));
            let psnr = -10.0 * (squares.sum::<f64>() / expected.len() as f64).log10();
            eprintln!("{name} frame {frame} view {view}: {psnr:.1} dB");
            assert!(psnr >= 80.0, "{name} frame {frame} view {view}: {psnr} dB, expected at least 80");
            compared += 1;
        }
    }
    assert!(compared >= models::NAMES.len(), "only {compared} pictures had a recorded state");
}
