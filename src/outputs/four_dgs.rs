//! A sequence as a `.4dgs`: pieces of straight motion in windows of time, written and checked by the crate `fourdgs`.
//!
//! Frames follow one another at 30 a second, whatever the source's clock; a piece lasts until the frame after its last one.
//! Base colors are cut to [0, 1], harmonics above degree 0 become bytes over [−4, 4], as the format has them. Memory: all pieces, about 600 bytes each
//! while they are encoded.

use std::path::Path;

use fourdgs::quantization::{Bounds, SH_QUANT_HI, SH_QUANT_LO, Steps, life_class, motion_step, support_k};
use fourdgs::{GaussianSet, SceneExtras, WriteOptions, write_to_vec};

use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::files::accuracy::{Accuracy, Drawn};
use crate::fit::{LinearPiece, Misfit, Tolerance, straight};
use crate::model::{Column, color};
use crate::passes::tracks;
use crate::progress::Events;
use crate::source::FrameSource;

/// Frames a second of a sequence that says nothing of it.
const FRAME_RATE: f64 = 30.0;

/// Writes all frames of `source`; says how close that is.
///
/// # Errors
/// Frames that cannot be read; values that the format cannot hold; a failed write.
pub fn write_four_dgs(source: &dyn FrameSource, path: &Path, events: &Events) -> Result<String> {
    let info = source.info();
    let progress = events.task("emit", "states", (info.count * info.times.len()) as u64);
    let tolerance = Tolerance::default();
    let starts: Vec<f64> = (0..=info.times.len()).map(|frame| frame as f64 / FRAME_RATE).collect();
    let found = tracks(source, &starts[..info.times.len()], &progress, |track| {
        let mut misfit = Misfit::default();
        (straight(track, &tolerance, &mut misfit), misfit)
    })?;
    let misfit = found.iter().map(|(_, misfit)| *misfit).fold(Misfit::default(), Misfit::and);
    let mut set = GaussianSet {
        sh_degree: info.sh_degree as u8,
        sh_coefficients: (info.sh_degree + 1).pow(2) - 1,
        sh: (info.sh_degree > 0).then(Vec::new),
        ..GaussianSet::default()
    };
    for piece in found.iter().flat_map(|(pieces, _)| pieces) {
        add(&mut set, piece, &starts);
    }
    let pieces = set.count();
    let options = WriteOptions { library: TOOL.to_owned(), ..WriteOptions::default() };
    let wanted = set.positions.clone();
    on_grid(&mut set, &options);
    let ids = found.iter().enumerate().flat_map(|(id, (pieces, _))| pieces.iter().map(move |_| id));
    check_positions(&set, &wanted, ids)?;
    let refused = |error: fourdgs::Error| Error::usage(format!("{}: no .4dgs can hold this: {error}", path.shown()));
    let bytes = write_to_vec(&set, starts[info.times.len()], &options, &SceneExtras::default()).map_err(refused)?;
    std::fs::write(path, bytes).map_err(Error::io("write", path))?;
    Ok(format!(
        "{} Gaussians became {pieces} pieces of straight motion at {FRAME_RATE} frames a second: positions are {:.3} of a \
         Gaussian's middle size off on average, {:.3} at most, opacities {:.3} at most",
        info.count,
        misfit.rms(),
        misfit.position,
        misfit.opacity
    ))
}

/// Moves positions and velocities to where the grid of the file has them. The encoder holds decoded values to its bounds
/// without allowing for their rounding to f32, which in coordinates of some units takes what is half a step off beyond.
fn on_grid(set: &mut GaussianSet, options: &WriteOptions) {
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
        let of_axis = || set.positions.iter().skip(axis).step_by(3);
        let origin = f64::from(of_axis().copied().fold(f32::INFINITY, f32::min));
        set.positions.iter_mut().skip(axis).step_by(3).for_each(|value| snap(value, origin, steps.pos));
    }
    for (i, motion) in set.motions.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let window = f64::from(set.win_hi[i]) - f64::from(set.win_lo[i]);
        let class = life_class(0, steps.sigma_log, true, window, support_k(options.cutoff));
        motion.iter_mut().for_each(|value| snap(value, 0.0, motion_step(class, steps.motion)));
    }
}

/// Confirms that the grid leaves the Gaussians `ids`, piece by piece, about where they are `wanted`.
fn check_positions(set: &GaussianSet, wanted: &[f32], ids: impl Iterator<Item = usize>) -> Result<()> {
    let planes = (0..3).flat_map(|axis| wanted.iter().skip(axis).step_by(3).copied()).collect();
    let mut accuracy = Accuracy::new(&Column::from_planes(3, planes));
    for (k, id) in ids.enumerate() {
        let three = |of: &[f32]| [0, 1, 2].map(|axis| f64::from(of[3 * k + axis]));
        let opacity = f64::from(set.colors[4 * k + 3]);
        let drawn =
            |place: &[f32]| Drawn { position: three(place), scale: three(&set.scales), opacity, color: [0.0; 3] };
        accuracy.add(id, &drawn(wanted), &drawn(&set.positions));
    }
    accuracy.check("a .4dgs")
}

/// Adds `piece`; `starts`: when each frame begins, and the last one ends.
fn add(set: &mut GaussianSet, piece: &LinearPiece, starts: &[f64]) {
    let narrow = |value: f64| value as f32;
    set.positions.extend(piece.position.map(narrow));
    set.motions.extend(piece.velocity.map(narrow));
    set.scales.extend(piece.log_scale.map(|scale| narrow(scale.exp())));
    let [w, x, y, z] = piece.rotation.map(narrow);
    set.rotations.extend([x, y, z, w]);
    set.colors.extend((0..3).map(|c| narrow(color(piece.sh[c]).clamp(0.0, 1.0))));
    set.colors.push(narrow(piece.opacity));
    set.mu_t.push(narrow(piece.at));
    set.sigma_t.push(f32::INFINITY);
    set.win_lo.push(narrow(starts[piece.frames.start]));
    set.win_hi.push(narrow(starts[piece.frames.end]));
    if let Some(sh) = &mut set.sh {
        // All coefficients of red, then of green, then of blue.
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
    use crate::diagnostics::demo_scene::Scene;
    use crate::model::{Columns, opacity};
    use crate::passes::gather_all;

    #[test]
    fn a_reader_of_the_format_finds_every_visible_gaussian_of_every_frame_where_it_is() {
        let scene = Scene::new(400, 24);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.4dgs");
        let said = write_four_dgs(&scene, &path, &Events::IGNORED).unwrap();
        assert!(said.contains("400 Gaussians became"), "{said}");
        let read = fourdgs::read_path(&path).unwrap();
        let mut scales: Vec<f64> = read.gaussians.scales.iter().map(|&scale| f64::from(scale)).collect();
        scales.sort_by(f64::total_cmp);
        let median = scales[scales.len() / 2];
        let (mut missing, mut apart, mut seen) = (0, 0.0f64, 0);
        for frame in 0..24 {
            let expected = gather_all(&scene, frame, Columns::all()).unwrap();
            // In the middle of what a frame shows; pieces are straight, so that it lies half a step on.
            let state = read.gaussians.state_at(frame as f64 / FRAME_RATE + 1e-4, read.header.cutoff);
            let seen_now = (0..400).filter(|&id| opacity(expected.opacity_logit.row::<1>(id)[0]) >= crate::fit::SEEN);
            assert_eq!(state.indices.len(), seen_now.count(), "one piece of each at a time");
            for id in 0..400 {
                let visible = opacity(expected.opacity_logit.row::<1>(id)[0]);
                if visible < crate::fit::SEEN {
                    continue;
                }
                let at = expected.position.row::<3>(id);
                // The file has no order: the nearest one that is as opaque.
                let distance =
                    |k: usize| (0..3).map(|c| f64::from(state.centers[3 * k + c] - at[c]).powi(2)).sum::<f64>();
                let alike = (0..state.indices.len()).filter(|&k| (f64::from(state.opacity[k]) - visible).abs() < 0.03);
                let Some(distance) = alike.map(distance).reduce(f64::min).map(f64::sqrt) else {
                    missing += 1;
                    continue;
                };
                seen += 1;
                let size = f64::from(expected.log_scale.row::<3>(id).map(f32::exp).iter().copied().fold(0.0, f32::max));
                // A tenth of a middle size is what the fit may be off, a twentieth of the median scale the file, twice.
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
