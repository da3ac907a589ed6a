//! Writes a sequence as a `.4dgs` file: pieces of straight motion, fitted to the trajectory of every Gaussian, each
//! shown in a window of time. The crate `fourdgs` encodes and checks the pieces.
//!
//! Frames are 1/30 s apart, whatever the times of the source. A piece is shown until the start of the frame that
//! follows its last frame. As the format requires, base colors are clamped to [0, 1], and SH coefficients above degree
//! 0 are stored as bytes over [−4, 4]. Memory: all pieces, about 600 bytes each while they are encoded.

use std::path::Path;

use fourdgs::quantization::{Bounds, SH_QUANT_HI, SH_QUANT_LO, Steps, life_class, motion_step, support_k};
use fourdgs::{GaussianSet, SceneExtras, WriteOptions, write_to_vec};

use super::fit_tracks;
use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::files::accuracy::{CodingErrors, RenderedAttributes, far_gaussians};
use crate::fit::{LinearPiece, Tolerance, fit_lines};
use crate::model::{AttributeValues, color_from_sh};
use crate::progress::Events;
use crate::source::FrameSource;

/// Frame rate stored in the file, in frames per second. Sequences have no frame rate of their own.
const FRAME_RATE: f64 = 30.0;

/// Writes all frames of `source` to the `.4dgs` file `path`. Returns a message with the errors of the fitted pieces of
/// straight motion.
///
/// # Errors
/// Fails if a frame cannot be read, if the format cannot hold a value, or if the file cannot be written.
pub fn write_four_dgs(source: &dyn FrameSource, path: &Path, events: &Events) -> Result<String> {
    let info = source.info();
    let tolerance = Tolerance::default();
    let starts: Vec<f64> = (0..=info.times.len()).map(|frame| frame as f64 / FRAME_RATE).collect();
    let times = &starts[..info.times.len()];
    let (found, misfit) = fit_tracks(source, times, events, |track, misfit| fit_lines(track, &tolerance, misfit))?;
    let mut set = GaussianSet {
        sh_degree: info.sh_degree as u8,
        sh_coefficients: (info.sh_degree + 1).pow(2) - 1,
        sh: (info.sh_degree > 0).then(Vec::new),
        ..GaussianSet::default()
    };
    for piece in found.iter().flatten() {
        add_piece(&mut set, piece, &starts);
    }
    let pieces = set.count();
    let options = WriteOptions { library: TOOL.to_owned(), ..WriteOptions::default() };
    let wanted = set.positions.clone();
    snap_to_grid(&mut set, &options);
    let ids: Vec<usize> = found.iter().enumerate().flat_map(|(id, pieces)| pieces.iter().map(move |_| id)).collect();
    check_positions(&set, &wanted, ids.iter().copied())?;
    let refused = |error: fourdgs::Error| {
        let planes = (0..3).flat_map(|axis| wanted.iter().skip(axis).step_by(3).copied()).collect();
        let why = match far_gaussians(&AttributeValues::from_planes(3, planes), |piece| ids[piece]) {
            Some(far) => format!(
                "all positions must lie within a limited range\n  far from all others in the output: {far}; drop them \
                 (compress --drop-ids), or write a .ply or .gseq"
            ),
            None => format!("{error}\n  write a .ply or .gseq"),
        };
        Error::usage(format!("{}: a .4dgs file cannot hold this model: {why}", path.shown()))
    };
    let bytes = write_to_vec(&set, starts[info.times.len()], &options, &SceneExtras::default()).map_err(refused)?;
    std::fs::write(path, bytes).map_err(Error::io("write", path))?;
    Ok(format!(
        "{} Gaussians became {pieces} pieces of straight motion at {FRAME_RATE} frames a second; {}",
        info.count,
        misfit.error_note()
    ))
}

/// Rounds positions, scales, velocities, colors and opacities in `set` to the quantization grid of the file, so that
/// the encoder accepts them. The encoder checks that each decoded value differs from the given one by at most half a
/// quantization step. This check fails for some values midway between two grid points, because decoded values are
/// rounded to f32. Coordinates of a few scene units may lie midway between two grid points, odd 8-bit colors always do,
/// and about one of 100,000 scales does.
fn snap_to_grid(set: &mut GaussianSet, options: &WriteOptions) {
    // The grid of logarithms of scales does not depend on the scene. That of positions follows from the median scale.
    let log_step = Steps::of(&Bounds::for_profile(options.profile, 1.0)).scale_log;
    for scale in set.scales.iter_mut().filter(|scale| **scale > 0.0) {
        *scale = ((f64::from(*scale).ln() / log_step).round() * log_step).exp() as f32;
    }
    let mut scales: Vec<f64> = set.scales.iter().map(|&scale| f64::from(scale)).collect();
    if scales.is_empty() {
        return;
    }
    scales.sort_by(f64::total_cmp);
    let (below, above) = (scales[(scales.len() - 1) / 2], scales[scales.len() / 2]);
    let steps = Steps::of(&Bounds::for_profile(options.profile, 0.5 * (below + above)));
    let snap = |value: &mut f32, origin: f64, step: f64| {
        *value = (origin + ((f64::from(*value) - origin) / step).round() * step) as f32;
    };
    for axis in 0..3 {
        let axis_values = || set.positions.iter().skip(axis).step_by(3);
        let origin = f64::from(axis_values().copied().fold(f32::INFINITY, f32::min));
        set.positions.iter_mut().skip(axis).step_by(3).for_each(|value| snap(value, origin, steps.pos));
    }
    for (i, motion) in set.motions.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let window = f64::from(set.win_hi[i]) - f64::from(set.win_lo[i]);
        let class = life_class(0, steps.sigma_log, true, window, support_k(options.cutoff));
        motion.iter_mut().for_each(|value| snap(value, 0.0, motion_step(class, steps.motion)));
    }
    for color in set.colors.as_chunks_mut::<4>().0 {
        for (value, step) in color.iter_mut().zip([steps.rgb, steps.rgb, steps.rgb, steps.alpha]) {
            snap(value, 0.0, step);
            *value = value.clamp(0.0, 1.0);
        }
    }
}

/// Checks that the rounded positions in `set` are close to `expected`, the positions before rounding. `ids` has for
/// each piece (of straight motion) the index of its Gaussian, for the error message.
fn check_positions(set: &GaussianSet, expected: &[f32], ids: impl Iterator<Item = usize>) -> Result<()> {
    let planes = (0..3).flat_map(|axis| expected.iter().skip(axis).step_by(3).copied()).collect();
    let mut accuracy = CodingErrors::new(&AttributeValues::from_planes(3, planes));
    for (k, id) in ids.enumerate() {
        let triple = |values: &[f32]| [0, 1, 2].map(|axis| f64::from(values[3 * k + axis]));
        let opacity = f64::from(set.colors[4 * k + 3]);
        let drawn = |place: &[f32]| RenderedAttributes {
            position: triple(place),
            scale: triple(&set.scales),
            opacity,
            color: [0.0; 3],
        };
        accuracy.add(id, &drawn(expected), &drawn(&set.positions));
    }
    accuracy.check("a .4dgs")
}

/// Appends the piece of straight motion `piece` to `set`. `starts` has the start time of each frame, then the end of
/// the last frame, in seconds.
fn add_piece(set: &mut GaussianSet, piece: &LinearPiece, starts: &[f64]) {
    let to_f32 = |value: f64| value as f32;
    set.positions.extend(piece.position.map(to_f32));
    set.motions.extend(piece.velocity.map(to_f32));
    set.scales.extend(piece.log_scale.map(|scale| to_f32(scale.exp())));
    let [w, x, y, z] = piece.rotation.map(to_f32);
    set.rotations.extend([x, y, z, w]);
    set.colors.extend((0..3).map(|c| to_f32(color_from_sh(piece.sh[c]).clamp(0.0, 1.0))));
    set.colors.push(to_f32(piece.opacity));
    set.mu_t.push(to_f32(piece.mid_time));
    set.sigma_t.push(f32::INFINITY);
    set.win_lo.push(to_f32(starts[piece.frames.start]));
    set.win_hi.push(to_f32(starts[piece.frames.end]));
    if let Some(sh) = &mut set.sh {
        // Order: all coefficients of red, then of green, then of blue.
        let byte = |value: f32| {
            let place = (f64::from(value) - SH_QUANT_LO) / (SH_QUANT_HI - SH_QUANT_LO) * 255.0;
            place.round().clamp(0.0, 255.0) as u8
        };
        sh.extend((0..3).flat_map(|c| piece.sh[3..].iter().skip(c).step_by(3).map(move |&value| byte(value))));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::{Attributes, opacity};
    use crate::passes::gather_all;

    /// Returns 256 Gaussians without motion. Gaussian k has the 8-bit red value k, and all its three scales are
    /// `scale(k)`.
    fn motionless_gaussians(scale: impl Fn(usize) -> f32) -> GaussianSet {
        let byte = |k: usize| k as f32 / 255.0;
        GaussianSet {
            positions: (0..256).flat_map(|k| [k as f32, 0.0, 0.0]).collect(),
            scales: (0..256).flat_map(|k| [scale(k); 3]).collect(),
            rotations: [0.0, 0.0, 0.0, 1.0].repeat(256),
            colors: (0..256).flat_map(|k| [byte(k), byte(255 - k), byte(k), byte(k)]).collect(),
            motions: vec![0.0; 3 * 256],
            mu_t: vec![0.0; 256],
            sigma_t: vec![f32::INFINITY; 256],
            win_lo: vec![0.0; 256],
            win_hi: vec![1.0; 256],
            ..GaussianSet::default()
        }
    }

    #[test]
    fn scales_midway_between_grid_points_are_written() {
        let options = WriteOptions::default();
        let log_step = Steps::of(&Bounds::for_profile(options.profile, 1.0)).scale_log;
        let mut set = motionless_gaussians(|k| ((k as f64 - 200.5) * log_step).exp() as f32);
        let exact = set.scales.clone();
        snap_to_grid(&mut set, &options);
        write_to_vec(&set, 1.0, &options, &SceneExtras::default()).unwrap();
        let ratios = set.scales.iter().zip(&exact).map(|(a, b)| f64::from(a / b).ln().abs());
        let largest = ratios.fold(0.0, f64::max);
        assert!(largest <= 0.501 * log_step, "logarithms of scales differ by {largest}");
    }

    #[test]
    fn colors_of_eight_bits_are_written() {
        let mut set = motionless_gaussians(|_| 0.1);
        let (exact, options) = (set.colors.clone(), WriteOptions::default());
        snap_to_grid(&mut set, &options);
        write_to_vec(&set, 1.0, &options, &SceneExtras::default()).unwrap();
        let largest = set.colors.iter().zip(&exact).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(largest <= 1.0001 / 255.0, "colors differ by {largest}");
    }

    #[test]
    fn a_reader_of_the_format_finds_every_visible_gaussian() {
        let scene = DemoScene::new(400, 24);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.4dgs");
        let message = write_four_dgs(&scene, &path, &Events::IGNORED).unwrap();
        assert!(message.contains("400 Gaussians became"), "{message}");
        let read = fourdgs::read_path(&path).unwrap();
        let mut scales: Vec<f64> = read.gaussians.scales.iter().map(|&scale| f64::from(scale)).collect();
        scales.sort_by(f64::total_cmp);
        let median = scales[scales.len() / 2];
        let (mut missing, mut apart, mut seen) = (0, 0.0f64, 0);
        for frame in 0..24 {
            let expected = gather_all(&scene, frame, Attributes::all()).unwrap();
            // The state is evaluated shortly after the start of the frame. Pieces move in straight lines, so positions
            // are off by a fraction of a step.
            let state = read.gaussians.state_at(frame as f64 / FRAME_RATE + 1e-4, read.header.cutoff);
            let seen_now = (0..400)
                .filter(|&id| opacity(expected.opacity_logit.row::<1>(id)[0]) >= crate::fit::MIN_VISIBLE_OPACITY);
            assert_eq!(state.indices.len(), seen_now.count(), "one piece of each at a time");
            for id in 0..400 {
                let visible = opacity(expected.opacity_logit.row::<1>(id)[0]);
                if visible < crate::fit::MIN_VISIBLE_OPACITY {
                    continue;
                }
                let at = expected.position.row::<3>(id);
                // The file keeps no order, so the test looks for the nearest Gaussian with the same opacity.
                let distance =
                    |k: usize| (0..3).map(|c| f64::from(state.centers[3 * k + c] - at[c]).powi(2)).sum::<f64>();
                let similar =
                    (0..state.indices.len()).filter(|&k| (f64::from(state.opacity[k]) - visible).abs() < 0.03);
                let Some(distance) = similar.map(distance).reduce(f64::min).map(f64::sqrt) else {
                    missing += 1;
                    continue;
                };
                seen += 1;
                let size = f64::from(expected.log_scale.row::<3>(id).map(f32::exp).iter().copied().fold(0.0, f32::max));
                // The fit may be off by a tenth of the Gaussian's scale, and the positions in the file by twice a
                // twentieth of the median scale.
                apart = apart.max(distance / (0.1 * size + 0.2 * median));
            }
        }
        assert!(
            missing == 0 && seen > 4000 && apart < 1.0,
            "{missing} missing of {seen}, {apart} of what they may be apart"
        );
        let again = folder.path().join("again.4dgs");
        write_four_dgs(&scene, &again, &Events::IGNORED).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
    }
}
