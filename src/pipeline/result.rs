//! A result's frames, as they will be once it is written.

use super::input::{Input, Scene};
use super::merging::{Cluster, Sieved};
use super::proxies::{canonical_cloud, canonical_proxies};
use super::scored::Scored;
use crate::error::Result;
use crate::pass::FrameSource;
use crate::recipe::Recipe;
use crate::stream::{MergedSequence, Recolored};

/// What is left of `scene`, merged and recoloured.
pub fn result_frames<'a>(
    scene: &'a Scene,
    scored: &Scored,
    recipe: &Recipe,
    sieved: &'a Sieved,
) -> Result<Box<dyn FrameSource + 'a>> {
    if let Input::Model(model) = &scene.input {
        let found = canonical_proxies(model, scored, sieved, &recipe.merge)?;
        return Ok(Box::new(model.with_canonical(canonical_cloud(model, sieved, &found.raw))));
    }
    Ok(Box::new(Recolored::new(Box::new(merged(scene, sieved, recipe)), &sieved.recolor)))
}

/// What is left of a scene of explicit trajectories, merged.
pub fn merged<'a>(scene: &'a Scene, sieved: &'a Sieved, recipe: &Recipe) -> MergedSequence<'a> {
    let members = sieved.clusters.iter().map(|cluster: &Cluster| (cluster.output, &cluster.members[..]));
    MergedSequence::new(scene.input.source(), &sieved.kept, members, &recipe.merge)
}
