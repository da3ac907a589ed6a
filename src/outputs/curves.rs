//! Any sequence as a `.splatv`: curves fitted to what every Gaussian does.
//!
//! Players run through [0, 1]: times beyond are scaled to it. Harmonics above degree 0 have no place in the format.
//! Memory: all curves.

use std::path::Path;

use crate::error::Result;
use crate::files::accuracy::Accuracy;
use crate::files::splatv::SplatvGaussian;
use crate::files::splatv::write::{measure, seen_whole, words, write};
use crate::fit::{CubicTrack, Misfit, Tolerance, curved};
use crate::model::{Columns, color};
use crate::passes::{gather_all, tracks};
use crate::progress::Events;
use crate::source::FrameSource;

/// Writes all frames of `source`; says how close that is.
///
/// # Errors
/// Frames that cannot be read; a failed write.
pub fn write_curves(source: &dyn FrameSource, path: &Path, events: &Events) -> Result<String> {
    let info = source.info();
    let progress = events.task("emit", "states", (info.count * info.times.len()) as u64);
    let times = within_one(&info.times);
    let tolerance = Tolerance::default();
    let found = tracks(source, &times, &progress, |track| {
        let mut misfit = Misfit::default();
        (curved(track, &tolerance, &mut misfit), misfit)
    })?;
    let misfit = found.iter().map(|(_, misfit)| *misfit).fold(Misfit::default(), Misfit::and);
    let rows: Vec<SplatvGaussian> = found.iter().flat_map(|(curves, _)| curves).map(row).collect();
    let first = gather_all(source, 0, Columns::POSITION)?;
    let mut accuracy = Accuracy::new(&first.position);
    let of_rows = found.iter().enumerate().flat_map(|(id, (curves, _))| curves.iter().map(move |_| id));
    of_rows.zip(&rows).for_each(|(id, row)| measure(row, id, &mut accuracy));
    accuracy.check("a .splatv")?;
    let rows: Vec<_> = rows.iter().map(words).collect();
    write(path, rows.len(), rows.iter().copied(), &seen_whole(&first.position))?;
    let bands = if info.sh_degree > 0 { ", in colours that do not change with direction" } else { "" };
    Ok(format!(
        "{} Gaussians became {} curves{bands}: positions are {:.3} of a Gaussian's middle size off on average, {:.3} at most, \
         opacities {:.3} at most",
        info.count,
        rows.len(),
        misfit.rms(),
        misfit.position,
        misfit.opacity
    ))
}

/// `times`, from 0 to 1 if any of them is not in between.
fn within_one(times: &[f64]) -> Vec<f64> {
    match (times.first(), times.last()) {
        (Some(&first), Some(&last)) if first < 0.0 || last > 1.0 => {
            let span = if last > first { last - first } else { 1.0 };
            times.iter().map(|time| (time - first) / span).collect()
        }
        _ => times.to_vec(),
    }
}

fn row(curve: &CubicTrack) -> SplatvGaussian {
    let narrow = |value: f64| value as f32;
    let [place, motion @ ..] = curve.position;
    SplatvGaussian {
        position: place.map(narrow),
        motion: std::array::from_fn(|k| narrow(motion[k / 3][k % 3])),
        rotation: curve.rotation[0].map(narrow),
        omega: curve.rotation[1].map(narrow),
        scale: curve.log_scale.map(|scale| narrow(scale.exp())),
        rgb: std::array::from_fn(|c| color(curve.sh[c])),
        opacity: curve.opacity,
        center: narrow(curve.center),
        // A half has no infinity that players know.
        width: narrow(curve.width.min(f64::from(half::f16::MAX.to_f32()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::Scene;
    use crate::files::splatv::Splatv;
    use crate::model::opacity;

    #[test]
    fn times_beyond_one_are_scaled_and_others_stay() {
        assert_eq!(within_one(&[0.25, 1.0]), [0.25, 1.0]);
        assert_eq!(within_one(&[-1.0, 0.0, 3.0]), [0.0, 0.25, 1.0]);
        assert_eq!(within_one(&[7.0]), [0.0]);
    }

    #[test]
    fn a_player_finds_every_gaussian_of_every_frame_about_where_it_is() {
        let scene = Scene::new(300, 30);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.splatv");
        let said = write_curves(&scene, &path, &Events::IGNORED).unwrap();
        assert!(said.starts_with("300 Gaussians became"), "{said}");
        let file = Splatv::open(&path).unwrap();
        let rows: Vec<SplatvGaussian> = (0..file.count()).map(|k| SplatvGaussian::of_words(&file.words(k))).collect();
        let (mut apart, mut depth) = (0.0, 0.0);
        let mut seen = 0;
        for frame in 0..30 {
            let time = scene.info().times[frame];
            let state = gather_all(&scene, frame, Columns::all()).unwrap();
            // What the viewer draws, by its own formulas.
            let shown: Vec<([f64; 3], f64)> = rows
                .iter()
                .map(|row| {
                    let dt = time - f64::from(row.center);
                    let place = std::array::from_fn(|c| {
                        let m = |k: usize| f64::from(row.motion[3 * k + c]);
                        f64::from(row.position[c]) + dt * (m(0) + dt * (m(1) + dt * m(2)))
                    });
                    (place, row.opacity * (-(dt / f64::from(row.width)).powi(2)).exp())
                })
                .collect();
            for id in 0..300 {
                let visible = opacity(state.opacity_logit.row::<1>(id)[0]);
                if visible < 0.1 {
                    continue;
                }
                let at = state.position.row::<3>(id).map(f64::from);
                let size = f64::from(state.log_scale.row::<3>(id).iter().copied().fold(f32::MIN, f32::max)).exp();
                let distance = |place: [f64; 3]| (0..3).map(|c| (place[c] - at[c]).powi(2)).sum::<f64>().sqrt() / size;
                let here: Vec<f64> = shown
                    .iter()
                    .filter(|(place, _)| distance(*place) < 0.5)
                    .map(|(_, alpha)| (1.0 - alpha).ln())
                    .collect();
                seen += 1;
                apart += f64::from(here.is_empty());
                // Others may lie there too, so that only too little can be told.
                depth += f64::from(1.0 - here.iter().sum::<f64>().exp() < visible - 0.1);
            }
        }
        let seen = f64::from(seen);
        assert!(seen > 3000.0 && apart / seen < 0.01 && depth / seen < 0.05, "{} {} of {seen}", apart, depth);
        let again = folder.path().join("again.splatv");
        write_curves(&scene, &again, &Events::IGNORED).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
    }
}
