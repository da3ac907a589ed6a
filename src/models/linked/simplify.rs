//! Joins tracks (Gaussians followed through frames) and makes attributes constant along tracks, as far as the PSNR of
//! renders allows.

use std::ops::Range;
use std::path::Path;

use super::memory::SAMPLED_FRAMES;
use super::steady::{Bound, Steady, TrackSums};
use super::tracks::LinkedTracks;
use crate::error::Result;
use crate::files::cameras::virtual_rig;
use crate::metrics::psnr;
use crate::model::RobustBox;
use crate::model::{Attributes, Gaussians};
use crate::render::Renderer;
use crate::tracking::{Joiner, Linker};

/// Minimum PSNR in dB of renders after a change (tracks of one Gaussian joined, attributes made constant) against
/// renders before it.
const MIN_PSNR_DB: f64 = 40.0;
/// Number of virtual cameras from which each sampled frame is rendered, to compare renders before and after a change of
/// the tracks.
const VIEWS: usize = 3;
/// Maximum root mean square deviations of an attribute from its mean along a track (Gaussian followed through frames).
/// An attribute that deviates less becomes constant.
/// - `color` limits colors, which range from 0 to 1.
/// - `other` limits natural logarithms of scales, rotations in radians, and opacities.
///
/// The entries are tried in this order until renders reach [`MIN_PSNR_DB`]. The first entry is about as large as the
/// differences that trainers leave between tracks of one Gaussian; the second is half as large.
const STEADY_BOUNDS: [Bound; 2] = [Bound { color: 0.04, other: 0.02 }, Bound { color: 0.02, other: 0.01 }];

/// Attempt to simplify the tracks (Gaussians followed through frames) of frames.
pub(super) struct Simplification {
    /// Note for the user.
    pub(super) note: String,
    /// Mean PSNR, dB, of a few renders after the change against renders before it; `None` if no render changed.
    pub(super) psnr: Option<f64>,
}

/// Joins those of `tracks` (Gaussians followed through frames) that seem to be the same Gaussian. `joiner` proposes two
/// ways to join them. The proposals are tried in order, and the first one with which renders reach [`MIN_PSNR_DB`] is
/// kept; if there is none, no tracks are joined. `linker` is the linker that made the tracks. Returns `None` if neither
/// proposal joins any tracks.
///
/// # Errors
/// Fails if a frame cannot be read.
pub(super) fn join(joiner: Joiner, linker: &Linker, tracks: &mut LinkedTracks) -> Result<Option<Simplification>> {
    let (before, median_length) = (tracks.count(), tracks.lengths()?.median());
    let mut note = None;
    for (joined_tracks, count) in joiner.finish(linker) {
        if count == before {
            continue;
        }
        tracks.join(joined_tracks, count);
        let psnr = joining_psnr(tracks)?;
        if psnr.is_none_or(|psnr| psnr >= MIN_PSNR_DB) {
            let cost = psnr_note(psnr.unwrap_or(f64::INFINITY));
            let separate = format!("{before} tracks with a median length of {median_length} frames");
            return Ok(Some(Simplification {
                note: format!("{separate} were joined to {count} tracks: {cost}"),
                psnr,
            }));
        }
        tracks.undo_join();
        let psnr = psnr.unwrap_or_default();
        let text = format!(
            "tracks that may be the same Gaussian were not joined: renders with joined tracks reach only {psnr:.1} dB \
             PSNR"
        );
        note = Some(Simplification { note: text, psnr: None });
    }
    Ok(note)
}

/// Replaces nearly constant attributes of `tracks` (Gaussians followed through frames) by their means, with the first
/// of [`STEADY_BOUNDS`] with which renders reach [`MIN_PSNR_DB`]. Returns `None` if no attribute became constant.
///
/// # Errors
/// Fails if a frame cannot be read or a write to the folder `scratch` fails.
pub(super) fn hold_steady(tracks: &mut LinkedTracks, scratch: &Path) -> Result<Option<Simplification>> {
    let first = tracks.first();
    for bound in STEADY_BOUNDS {
        // Tracks are numbered in the order of their first frames, so none of the range begins earlier.
        let sums = |range: Range<usize>| sums(tracks, first[range.start].frame as usize, range);
        let steady = Steady::from_sums(tracks.count(), tracks.frames().sh_degree(), sums, bound, scratch)?;
        let parts = steady.fractions();
        if parts == [0.0; 4] {
            return Ok(None);
        }
        let frames: Vec<u32> = (0..tracks.frames().paths().len() as u32).collect();
        let states = |tracks: &LinkedTracks, frame: usize| {
            tracks.states(&tracks.frames().frame(frame)?, &tracks.rows(frame, 0..tracks.count())?)
        };
        let before = sampled_frames(&frames).map(|frame| states(tracks, frame)).collect::<Result<Vec<_>>>()?;
        tracks.set_steady(Some(steady));
        let after = sampled_frames(&frames).map(|frame| states(tracks, frame)).collect::<Result<Vec<_>>>()?;
        let psnr = mean_psnr(&before, &after);
        if psnr >= MIN_PSNR_DB {
            let [colors, scales, rotations, opacities] = parts.map(|part| format!("{:.0}%", 100.0 * part));
            let Bound { color, other } = bound;
            let note = format!(
                "nearly constant attributes of tracks were replaced by their means: {colors} of the colors (within \
                 {color}), {scales} of the scales, {rotations} of the rotations and {opacities} of the opacities \
                 (within {other}): {}",
                psnr_note(psnr)
            );
            return Ok(Some(Simplification { note, psnr: Some(psnr) }));
        }
        tracks.set_steady(None);
    }
    Ok(None)
}

/// Returns the sums over all frames from which the means of attributes are computed, for each track (Gaussian followed
/// through frames) with an index in `range`. Reads only frames from `born` on, because none of these tracks begins
/// before frame `born`.
fn sums(tracks: &LinkedTracks, born: usize, range: Range<usize>) -> Result<TrackSums> {
    let sh_degree = tracks.frames().sh_degree();
    let (mut sums, mut state) = (TrackSums::new(range.len(), sh_degree), Gaussians::zeros(0, sh_degree));
    for frame in born..tracks.frames().paths().len() {
        let rows = tracks.rows(frame, range.clone())?;
        for at in tracks.blended(&tracks.frames().frame(frame)?, &rows, &mut state)? {
            sums.add(rows[at].track as usize - range.start, &state, at);
        }
    }
    Ok(sums)
}

/// Returns the PSNR in dB of renders with joined tracks (Gaussians followed through frames) against renders with
/// separate tracks. Returns `None` if joining changes no frame, because no joined track has several Gaussians in one
/// frame.
fn joining_psnr(tracks: &LinkedTracks) -> Result<Option<f64>> {
    let frames = tracks.lengths()?.blended;
    if frames.is_empty() {
        return Ok(None);
    }
    let (mut apart, mut joined) = (Vec::new(), Vec::new());
    for frame in sampled_frames(&frames) {
        let ply = tracks.frames().frame(frame)?;
        let mut all = Gaussians::zeros(0, tracks.frames().sh_degree());
        ply.gather_range(0..ply.count(), Attributes::all(), &mut all)?;
        apart.push(all);
        joined.push(tracks.states(&ply, &tracks.rows(frame, 0..tracks.count())?)?);
    }
    Ok(Some(mean_psnr(&apart, &joined)))
}

/// Returns up to [`SAMPLED_FRAMES`] of the frame numbers `frames`, evenly spread.
fn sampled_frames(frames: &[u32]) -> impl Iterator<Item = usize> {
    let count = frames.len().min(SAMPLED_FRAMES);
    (0..count).map(move |k| frames[(2 * k + 1) * frames.len() / (2 * count)] as usize)
}

/// Returns the PSNR in dB of renders of the frames `b` against renders of the frames `a`: the mean over all frames and
/// some views around the scene.
fn mean_psnr(a: &[Gaussians], b: &[Gaussians]) -> f64 {
    let mut renderer = Renderer::on_all_threads();
    let mut found = Vec::new();
    for (a, b) in a.iter().zip(b) {
        let around = RobustBox::from_positions(&a.position);
        let rig = virtual_rig(around.median, around.extent());
        for view in 0..VIEWS {
            let camera = &rig.cameras[view * rig.cameras.len() / VIEWS];
            let [a, b] = [a, b].map(|state| renderer.render(state, camera, [0.0; 3]));
            found.push(psnr(&a, &b));
        }
    }
    found.iter().sum::<f64>() / found.len() as f64
}

/// Formats the mean PSNR in dB of [`mean_psnr`] for notes to the user.
fn psnr_note(psnr: f64) -> String {
    match psnr.is_finite() {
        true => {
            format!("{psnr:.1} dB PSNR, mean of renders of at most {SAMPLED_FRAMES} frames in {VIEWS} virtual views")
        }
        false => "renders are unchanged".to_owned(),
    }
}
