//! A result's frames, as they will be once it is written.

use super::input::Input;
use super::merging::{Cluster, Sieved};
use super::proxies::{canonical_cloud, canonical_proxies};
use super::scored::Reference;
use crate::error::Result;
use crate::pass::FrameSource;
use crate::recipe::Merge;
use crate::stream::{MergedSequence, Recolored};

/// What is left of `input`, merged and recoloured.
pub fn result_frames<'a>(
    input: &'a Input,
    reference: Reference,
    merge: &'a Merge,
    sieved: &'a Sieved,
) -> Result<Box<dyn FrameSource + 'a>> {
    if let Input::Model(model) = input {
        let found = canonical_proxies(model, reference, sieved, merge)?;
        return Ok(Box::new(model.with_canonical(canonical_cloud(model, sieved, &found.raw))));
    }
    Ok(Box::new(Recolored::new(Box::new(merged(input, sieved, merge)), &sieved.recolor)))
}

/// What is left of an input of explicit trajectories, merged.
pub fn merged<'a>(input: &'a Input, sieved: &'a Sieved, merge: &'a Merge) -> MergedSequence<'a> {
    let members = sieved.clusters.iter().map(|cluster: &Cluster| (cluster.output, &cluster.members[..]));
    MergedSequence::new(input.source(), &sieved.kept, members, merge)
}
