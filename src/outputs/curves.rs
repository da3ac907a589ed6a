//! Writes any sequence as a `.splatv` file: curves with cubic motion, fitted to the trajectory of every Gaussian.
//!
//! Players of the format show times from 0 to 1, so other times are scaled to that range. The format has no SH
//! coefficients above degree 0. Memory: all curves.

use std::path::Path;

use super::fit_tracks;
use crate::error::Result;
use crate::files::accuracy::CodingErrors;
use crate::files::splatv::SplatvGaussian;
use crate::files::splatv::write::{add_errors, default_cameras, encode_words, write_splatv};
use crate::fit::{CubicTrack, CurveForm, Tolerance, fit_curves};
use crate::model::{Attributes, color_from_sh};
use crate::passes::gather_all;
use crate::progress::Events;
use crate::source::FrameSource;

/// Writes all frames of `source` to the `.splatv` file `path`. Returns a message with the errors of the fitted
/// positions and opacities.
///
/// # Errors
/// Fails if a frame cannot be read or the file cannot be written.
pub fn write_fitted_splatv(source: &dyn FrameSource, path: &Path, events: &Events) -> Result<String> {
    let info = source.info();
    let tolerance = Tolerance::default();
    let (found, misfit) = fit_tracks(source, &scale_to_unit(&info.times), events, |track, misfit| {
        fit_curves(track, CurveForm::CUBIC, &tolerance, misfit)
    })?;
    let rows: Vec<SplatvGaussian> = found.iter().flatten().map(splatv_gaussian).collect();
    let first = gather_all(source, 0, Attributes::POSITION)?;
    let mut accuracy = CodingErrors::new(&first.position);
    let row_ids = found.iter().enumerate().flat_map(|(id, curves)| curves.iter().map(move |_| id));
    row_ids.zip(&rows).for_each(|(id, row)| add_errors(row, id, &mut accuracy));
    accuracy.check("a .splatv")?;
    let rows: Vec<_> = rows.iter().map(encode_words).collect();
    write_splatv(path, rows.len(), rows.iter().copied(), &default_cameras(&first.position))?;
    let sh_loss = if info.sh_degree > 0 { ", in colors that do not change with direction" } else { "" };
    Ok(format!("{} Gaussians became {} curves{sh_loss}; {}", info.count, rows.len(), misfit.error_note()))
}

/// Returns `times` unchanged if all of them are in the range from 0 to 1. Otherwise scales them, so that the first
/// becomes 0 and the last 1.
///
/// A `.splatv` file that is made from a sequence with the frame times `times` stores its motion at the returned times.
pub fn scale_to_unit(times: &[f64]) -> Vec<f64> {
    match (times.first(), times.last()) {
        (Some(&first), Some(&last)) if first < 0.0 || last > 1.0 => {
            let span = if last > first { last - first } else { 1.0 };
            times.iter().map(|time| (time - first) / span).collect()
        }
        _ => times.to_vec(),
    }
}

fn splatv_gaussian(curve: &CubicTrack) -> SplatvGaussian {
    let narrow = |value: f64| value as f32;
    let [place, motion @ ..] = curve.position;
    SplatvGaussian {
        position: place.map(narrow),
        motion: std::array::from_fn(|k| narrow(motion[k / 3][k % 3])),
        rotation: curve.rotation[0].map(narrow),
        omega: curve.rotation[1].map(narrow),
        scale: curve.log_scale.map(|scale| narrow(scale.exp())),
        rgb: std::array::from_fn(|c| color_from_sh(curve.sh[c])),
        opacity: curve.opacity,
        center: narrow(curve.center),
        // Players do not support infinity in half precision.
        width: narrow(curve.width.min(f64::from(half::f16::MAX.to_f32()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::files::splatv::Splatv;
    use crate::outputs::tests::{blended, opacities_near};

    #[test]
    fn only_times_outside_0_to_1_are_scaled() {
        assert_eq!(scale_to_unit(&[0.25, 1.0]), [0.25, 1.0]);
        assert_eq!(scale_to_unit(&[-1.0, 0.0, 3.0]), [0.0, 0.25, 1.0]);
        assert_eq!(scale_to_unit(&[7.0]), [0.0]);
    }

    #[test]
    fn the_viewer_formulas_reproduce_every_gaussian() {
        let scene = DemoScene::new(300, 30);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.splatv");
        let message = write_fitted_splatv(&scene, &path, &Events::IGNORED).unwrap();
        assert!(message.starts_with("300 Gaussians became"), "{message}");
        let file = Splatv::open(&path).unwrap();
        let rows: Vec<SplatvGaussian> = (0..file.count()).map(|k| SplatvGaussian::from_words(&file.words(k))).collect();
        let (mut missing, mut too_faint) = (0.0, 0.0);
        let mut seen = 0;
        for frame in 0..30 {
            let time = scene.info().times[frame];
            let state = gather_all(&scene, frame, Attributes::all()).unwrap();
            // States of the curves at this time, computed by the formulas of the viewer.
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
                let Some((visible, near)) = opacities_near(&state, id, &shown) else { continue };
                seen += 1;
                missing += f64::from(near.is_empty());
                too_faint += f64::from(blended(&near) < visible - 0.1);
            }
        }
        let seen = f64::from(seen);
        assert!(
            seen > 3000.0 && missing / seen < 0.01 && too_faint / seen < 0.05,
            "{} {} of {seen}",
            missing,
            too_faint
        );
        let again = folder.path().join("again.splatv");
        write_fitted_splatv(&scene, &again, &Events::IGNORED).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
    }
}
