//! Computes proxies (Gaussians that replace merged ones) for a model where positions, rotations and colors vary freely,
//! but scales and opacities are constant in time.
//!
//! Position, rotation and color of a proxy are the moment match of its members (merged Gaussians) at every frame: the
//! Gaussian with the mean and covariance of their mixture. For scale and opacity, the moment matches are averaged over
//! time.

use super::params::Params;
use crate::compressed_model::{Cluster, CompressedModel, Proxies};
use crate::error::Result;
use crate::merging::merged_sequence::MergedSequence;
use crate::model::{Attributes, Gaussians, SequenceInfo, logit, opacity};
use crate::models::trajectories::merged;
use crate::passes::{SourceWithDeltas, gather_all};
use crate::recipe::MergeParams;
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, ReadPlan};

/// Maximum number of frames over which scale and opacity of a proxy (Gaussian that replaces merged ones) are averaged.
const SAMPLED_FRAMES: usize = 16;
/// Attributes that are constant in time in this model format: scale and opacity.
const CONSTANT: Attributes = Attributes::LOG_SCALE.union(Attributes::OPACITY);

/// Returns the constant scales and opacities of one proxy (Gaussian that replaces merged ones) for each of `clusters`,
/// as rows of [`Proxies::raw`]. The moment matches (Gaussians with the mean and covariance of the members) at sampled
/// frames are averaged: scales by the geometric mean, opacities by the arithmetic mean.
///
/// # Errors
/// Fails if frames cannot be read.
pub(super) fn compute_proxies(params: &Params, clusters: &[Cluster], merge: &MergeParams) -> Result<Proxies> {
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let members = clusters.iter().zip(0..).map(|(cluster, place)| (place, &cluster.members[..]));
    let proxies = MergedSequence::new(params, &leaders, members, merge);
    let frames = params.info().times.len();
    let sampled = frames.min(SAMPLED_FRAMES);
    let mut sums = vec![[0.0; 4]; clusters.len()];
    for k in 0..sampled {
        let state = gather_all(&proxies, k * frames / sampled, CONSTANT)?;
        for (row, sum) in sums.iter_mut().enumerate() {
            let sizes = state.log_scale.row::<3>(row).map(f64::from);
            let values = [sizes[0], sizes[1], sizes[2], opacity(state.opacity_logit.row::<1>(row)[0])];
            sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
    }
    let mut raw = Gaussians::zeros(clusters.len(), 0);
    for (row, sum) in sums.iter().enumerate() {
        let [a, b, c, visible] = sum.map(|sum| sum / sampled as f64);
        raw.log_scale.set_row(row, [a, b, c].map(|size| size as f32));
        raw.opacity_logit.set_row(row, [logit(visible) as f32]);
    }
    Ok(Proxies { raw: Some(raw.into()), ..Proxies::default() })
}

/// Returns the frames of the compressed model that `compressed` describes.
pub(super) fn compressed_frames<'a>(params: &'a Params, compressed: &'a CompressedModel) -> Box<dyn FrameSource + 'a> {
    Box::new(SourceWithDeltas::new(
        Box::new(MergedSource::new(params, compressed)),
        &compressed.delta,
        &compressed.trajectory_delta,
        compressed.sh_degree,
    ))
}

/// Frames of a compressed model. Its proxies (Gaussians that replace merged ones) have the constant scales and
/// opacities that [`compute_proxies`] computes.
pub(super) struct MergedSource<'a> {
    merged: MergedSequence<'a>,
    compressed: &'a CompressedModel,
    info: SequenceInfo,
}

impl<'a> MergedSource<'a> {
    /// Creates the frames of the compressed model `compressed`, which is made from the Gaussians in `params`.
    pub(super) fn new(params: &'a Params, compressed: &'a CompressedModel) -> MergedSource<'a> {
        let info = SequenceInfo { count: compressed.len(), ..params.info().clone() };
        MergedSource { merged: merged(params, compressed), compressed, info }
    }

    /// Finds the proxies (Gaussians that replace merged ones) among the output Gaussians with the indices `places`.
    /// Returns a pair for each proxy: its position in `places`, and the index of its cluster (merged Gaussians).
    fn proxies(&self, places: impl Iterator<Item = usize>) -> Vec<(usize, usize)> {
        let clusters = &self.compressed.clusters;
        let mut by_output: Vec<(u32, usize)> =
            clusters.iter().enumerate().map(|(proxy, cluster)| (cluster.output, proxy)).collect();
        by_output.sort_unstable();
        let found = |place: usize| by_output.binary_search_by_key(&(place as u32), |&(output, _)| output).ok();
        places.enumerate().filter_map(|(row, place)| Some((row, by_output[found(place)?].1))).collect()
    }

    /// Returns a reader of the output Gaussians `ids`. It reads them with `reader`, then replaces the scales and
    /// opacities of proxies (Gaussians that replace merged ones) by their constant values.
    fn reader<'b>(&'b self, reader: Box<dyn BlockReader + 'b>, ids: Ids<'_>) -> Box<dyn BlockReader + 'b> {
        let raw = self.compressed.proxies.raw.as_ref().map(|raw| &raw.gaussians);
        Box::new(MergedReader { reader, proxies: self.proxies(ids.iter()), raw })
    }
}

impl FrameSource for MergedSource<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(self.reader(self.merged.open(ids.clone())?, ids))
    }

    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        let opened = self.merged.open_all(plan)?;
        Some(opened.map(|reader| self.reader(reader, Ids::Range(0..self.info.count))))
    }

    fn reads(&self) -> ReadCounts {
        self.merged.reads()
    }
}

/// Reader that replaces the scales and opacities of proxies (Gaussians that replace merged ones) by their constant
/// values.
struct MergedReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    /// For each proxy (Gaussian that replaces merged ones) among the Gaussians that are read: its row among them, and
    /// the index of its cluster (merged Gaussians).
    proxies: Vec<(usize, usize)>,
    raw: Option<&'a Gaussians>,
}

impl BlockReader for MergedReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        let Some(raw) = self.raw else { return Ok(()) };
        for &(row, proxy) in &self.proxies {
            if want.contains(Attributes::LOG_SCALE) {
                out.log_scale.set_row(row, raw.log_scale.row::<3>(proxy));
            }
            if want.contains(Attributes::OPACITY) {
                out.opacity_logit.set_row(row, raw.opacity_logit.row::<1>(proxy));
            }
        }
        Ok(())
    }

    fn expect(&mut self, plan: &ReadPlan) {
        self.reader.expect(plan);
    }
}
