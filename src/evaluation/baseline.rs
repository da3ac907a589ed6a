//! Static baselines of the literature, to which the methods of this project are compared. A baseline prunes the
//! Gaussians by one property at one frame, without regard to time or visibility (the paper's "opacity/scale
//! thresholds"), or at random.

use std::path::Path;

use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::limits::Limits;
use crate::model::hash_id;
use crate::model::{Attributes, Gaussians};
use crate::outputs::kind::OutputKind;
use crate::passes::gather;
use crate::pipeline::Target;
use crate::pipeline::stages::write::write_without_companions;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, open_scene};

/// Pruning baseline, named after the property by which it ranks the Gaussians. A baseline keeps the Gaussians with the
/// largest values; ties are ordered by a hash of the id.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Baseline {
    /// Ranking by opacity, largest first.
    Opacity,
    /// Ranking by the largest of the three scales of a Gaussian, largest first.
    Scale,
    /// Ranking in random order: by a hash of the id of the Gaussian.
    Random,
}

/// Prunes an input to `target` Gaussians by `baseline`, writes the result to `output` and returns its size in bytes. If
/// `target` is `None`, all Gaussians are kept. The canonical Gaussians are ranked if the model has a deformation field,
/// otherwise the Gaussians at the first frame.
///
/// # Errors
/// Fails if the input cannot be opened or read, if it cannot be written in the format of `output`, or if writing fails.
pub fn prune_by(baseline: Baseline, options: &InputOptions, target: Option<Target>, output: &Path) -> Result<u64> {
    let scene = open_scene(options)?;
    let source = scene.source();
    let count = source.info().count;
    let target_count = target.map_or(Ok(count), |target| target.resolve_count(count))?;
    let ids: Vec<u32> = (0..count as u32).collect();
    let state = match scene.input.canonical() {
        Some(canonical) => canonical.clone(),
        None if count == 0 => Gaussians::default(),
        None => gather(source, &ids, 0, Attributes::OPACITY | Attributes::LOG_SCALE)?,
    };
    let kept = largest(baseline, &state, ids, target_count);
    let kind = OutputKind::from_path(output, None, scene.input.description().default_output_kind);
    scene.input.check_output(kind, output)?;
    let compressed = CompressedModel::pruned(kept, &Recipe::preset("default")?.merge);
    write_without_companions(&*scene.input, &compressed, kind, output, &Limits::NONE, &scene.events)
}

/// Returns the `target_count` ids out of `ids` that `baseline` keeps, in increasing order: those of the Gaussians with
/// the largest values of the property by which it ranks. Row i of `state` holds the attributes of the Gaussian with the
/// id i.
fn largest(baseline: Baseline, state: &Gaussians, mut ids: Vec<u32>, target_count: usize) -> Vec<u32> {
    let value = |id: u32| -> f32 {
        let row = id as usize;
        let value = match baseline {
            // The order of logits is the order of opacities.
            Baseline::Opacity => state.opacity_logit.plane(0)[row],
            Baseline::Scale => state.log_scale.row::<3>(row).into_iter().fold(f32::NEG_INFINITY, f32::max),
            Baseline::Random => 0.0,
        };
        if value.is_nan() { f32::NEG_INFINITY } else { value }
    };
    ids.sort_unstable_by(|&a, &b| {
        value(b).total_cmp(&value(a)).then_with(|| hash_id(a.into()).cmp(&hash_id(b.into())))
    });
    ids.truncate(target_count);
    ids.sort_unstable();
    ids
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> Gaussians {
        let mut state = Gaussians::zeros(4, 0);
        state.opacity_logit.plane_mut(0).copy_from_slice(&[1.0, f32::NAN, 3.0, 2.0]);
        for (row, scales) in
            [[0.0, 0.0, 9.0], [5.0, 5.0, 5.0], [1.0, 1.0, 1.0], [0.0, 6.0, 0.0]].into_iter().enumerate()
        {
            state.log_scale.set_row::<3>(row, scales);
        }
        state
    }

    #[test]
    fn each_baseline_keeps_the_largest_of_its_property() {
        let kept = |baseline, target_count| largest(baseline, &state(), (0..4).collect(), target_count);
        assert_eq!(kept(Baseline::Opacity, 2), [2, 3]);
        assert_eq!(kept(Baseline::Opacity, 3), [0, 2, 3]);
        assert_eq!(kept(Baseline::Scale, 2), [0, 3]);
        let mut by_hash: Vec<u32> = (0..4).collect();
        by_hash.sort_unstable_by_key(|&id| hash_id(id.into()));
        by_hash.truncate(2);
        by_hash.sort_unstable();
        assert_eq!(kept(Baseline::Random, 2), by_hash);
    }
}
