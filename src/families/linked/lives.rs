//! Which lives are made one, and what that costs in pictures.

use super::tracks::{Tracks, read_rows};
use crate::error::Result;
use crate::ingest::cameras::virtual_rig;
use crate::link::{Joiner, Linker};
use crate::metrics::psnr;
use crate::model::{Columns, Gaussians};
use crate::render::Renderer;
use crate::stats::RobustBox;

/// Pictures with joined lives are at least as near to those of lives apart, dB.
const LEAST_DB: f64 = 40.0;
/// Frames that are looked at, and views of each.
const FRAMES: usize = 3;
const VIEWS: usize = 3;

/// Joins the lives of `tracks` that `joiner` has seen as loosely as pictures allow, if any may be; gives what a person should
/// know of that.
///
/// # Errors
/// A frame that cannot be read.
pub(super) fn join(joiner: Joiner, linker: &Linker, tracks: &mut Tracks) -> Result<Option<String>> {
    let (before, median_length) = (tracks.count(), tracks.lengths()?.median());
    let mut note = None;
    for (of_tracks, count) in joiner.finish(linker) {
        if count == before {
            continue;
        }
        tracks.join(of_tracks, count);
        let psnr = cost(tracks)?;
        if psnr.is_none_or(|psnr| psnr >= LEAST_DB) {
            let cost =
                psnr.map_or("no picture changes".to_owned(), |psnr| format!("pictures stay within {psnr:.1} dB"));
            let lives = format!("{before} lives of {median_length} frames in the median");
            return Ok(Some(format!("{lives} were joined to these tracks: {cost}")));
        }
        tracks.part();
        let psnr = psnr.unwrap_or_default();
        note =
            Some(format!("lives that may be one stay apart: with joined ones pictures stay within {psnr:.1} dB only"));
    }
    Ok(note)
}

/// PSNR of pictures of joined lives against those of lives apart, where any are blended: the mean of some views around the
/// scene at frames, evenly spread, in which some are.
fn cost(tracks: &Tracks) -> Result<Option<f64>> {
    let frames = tracks.lengths()?.blended;
    if frames.is_empty() {
        return Ok(None);
    }
    let looked_at = frames.len().min(FRAMES);
    let mut renderer = Renderer::on_all_threads();
    let (mut apart, mut part) = [(); 2].map(|()| Gaussians::zeros(0, tracks.frames().sh_degree())).into();
    let mut found = Vec::new();
    for k in 0..looked_at {
        let frame = frames[(2 * k + 1) * frames.len() / (2 * looked_at)] as usize;
        let ply = tracks.frames().frame(frame)?;
        ply.gaussians(0..ply.count(), Columns::all(), &mut apart)?;
        let firsts: Vec<u32> =
            read_rows(&ply, &tracks.rows(frame)?, &mut part)?.into_iter().map(|first| first as u32).collect();
        let joined = part.pick(&firsts);
        let around = RobustBox::of(&apart.position);
        let rig = virtual_rig(around.middle, around.extent());
        for view in 0..VIEWS {
            let camera = &rig.cameras[view * rig.cameras.len() / VIEWS];
            let [a, b] = [&apart, &joined].map(|state| renderer.render(state, camera, [0.0; 3]));
            found.push(psnr(&a, &b));
        }
    }
    Ok(Some(found.iter().sum::<f64>() / found.len() as f64))
}
