//! As many Gaussians as so many bytes hold.

use super::emit::Emit;
use super::journal::Journal;
use crate::error::{Error, Result};
use crate::recipe;
use crate::reduction::Reduction;
use crate::scene::Scene;
use crate::stream::{VIEWS_AT_ONCE, removal_error, spread};

/// What the stage is called.
const NAME: &str = "size";
/// Part of the bytes that may stay free.
const FREE: f64 = 0.01;
/// Sizes that are written at most, to see their bytes.
const MOST_TRIED: usize = 6;
/// Pictures that say who goes, where the values of the best turn out larger than those of any.
const PICTURES: usize = 48;

/// How many of all Gaussians an output of at most `most` bytes has: as many as fit, of any of them.
///
/// # Errors
/// Not even one fits; frames that cannot be read, a failed write.
pub(super) fn count_within(
    scene: &Scene,
    emit: &Emit,
    most: u64,
    rule: &recipe::Merge,
    journal: &mut Journal,
) -> Result<usize> {
    let all = scene.source().info().count;
    journal.stage(NAME, all, scene.source(), |_| {
        let bytes = |count: usize| {
            let kept = (0..count).map(|k| (k * all / count) as u32).collect();
            emit.bytes(scene, &Reduction::pruned(kept, rule))
        };
        // Sizes and their bytes: the largest that fits, and the smallest that does not.
        let least = bytes(1.min(all))?;
        if least > most {
            return Err(Error::usage(format!(
                "--target-size: an output of one Gaussian has {least} bytes, of which all but a few hold what is not \
                 Gaussians; expected at least that, found {most}"
            )));
        }
        let (mut fits, mut over) = ((1.min(all), least), None);
        let mut next = all;
        for _ in 0..MOST_TRIED {
            let found = bytes(next)?;
            if found <= most {
                fits = (next, found);
            } else {
                over = Some((next, found));
            }
            let Some(over) = over.filter(|over: &(usize, u64)| over.0 - fits.0 > 1) else { break };
            if most - fits.1 <= (FREE * most as f64) as u64 {
                break;
            }
            let part = (most - fits.1) as f64 / (over.1 - fits.1).max(1) as f64;
            next = fits.0 + ((0.998 * part * (over.0 - fits.0) as f64) as usize).clamp(1, over.0 - fits.0 - 1);
        }
        Ok((fits.0, fits.0))
    })
}

/// `reduction`, less those that pictures lose least with as long as it has more than `most` bytes: refined values may
/// pack worse than those that the count was found by.
///
/// # Errors
/// Frames that cannot be read, a failed write.
pub(super) fn shrink(scene: &Scene, emit: &Emit, most: u64, mut reduction: Reduction) -> Result<Reduction> {
    let empty = emit.bytes(scene, &Reduction::pruned(Vec::new(), &reduction.rule))?;
    loop {
        let bytes = emit.bytes(scene, &reduction)?;
        if bytes <= most || reduction.is_empty() {
            return Ok(reduction);
        }
        let part = most.saturating_sub(empty) as f64 / (bytes - empty).max(1) as f64;
        let left = ((0.998 * part * reduction.len() as f64) as usize).min(reduction.len() - 1);
        let places: Vec<u32> = {
            let result = scene.input.reduced(&reduction)?;
            let all: Vec<u32> = (0..reduction.len() as u32).collect();
            let pictures = spread(&scene.schedule, PICTURES, VIEWS_AT_ONCE);
            let looked_at = (&scene.schedule.cameras[..], &pictures[..]);
            let errors = removal_error(&*result, &all, looked_at, scene.background, 0.0, scene.limits)?.sum;
            let mut order = all;
            // Stable: ties by id.
            order.sort_by_key(|&place| std::cmp::Reverse(errors[place as usize]));
            order.truncate(left);
            order.sort_unstable();
            order
        };
        reduction = reduction.pick(&places);
    }
}
