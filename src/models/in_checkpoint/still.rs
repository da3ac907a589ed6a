//! Motion model of static Gaussians in a checkpoint.

use super::ProxyRule;
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::merging::merged_sequence::MergedSequence;
use crate::model::{Attributes, Gaussians, StoredParams};
use crate::models::motion_model::{MotionModel, MotionModelFrames, copy_stored};
use crate::passes::gather_all;
use crate::recipe::MergeParams;

/// Motion model of static Gaussians: their states are the stored values at every time.
#[derive(Debug)]
pub(in crate::models) struct Still;

impl MotionModel for Still {
    type Prepared = ();

    fn prepare(&self, _: &StoredParams) {}

    fn varying(&self) -> Attributes {
        Attributes::empty()
    }

    fn movable(&self) -> Attributes {
        Attributes::all()
    }

    fn state(&self, _: f64, raw: &StoredParams, (): &(), want: Attributes, out: &mut Gaussians) -> Result<()> {
        copy_stored(raw, want, out);
        Ok(())
    }
}

impl ProxyRule for Still {
    fn propose(model: &MotionModelFrames<Still>, clusters: &[Cluster], rule: &MergeParams) -> Result<StoredParams> {
        let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
        let members = clusters.iter().zip(0..).map(|(cluster, place)| (place, &cluster.members[..]));
        let merged = MergedSequence::new(model, &leaders, members, rule);
        let mut raw = model.raw().pick(&leaders);
        raw.gaussians = gather_all(&merged, 0, Attributes::all())?;
        Ok(raw)
    }
}
