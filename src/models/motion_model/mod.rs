//! Models whose frames are computed from stored parameters by a motion model: polynomials of time, networks, or
//! conditional covariances.
//!
//! Each model format provides its [`MotionModel`]. Reading in blocks, adding deltas and compressing are shared by all
//! of these formats. Memory: the stored parameters, and for each open reader a copy of the stored parameters of its
//! Gaussians with the values prepared from them.

mod proxies;
pub(super) mod window;

use std::fmt::Debug;
use std::sync::Arc;

use rayon::prelude::*;

use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, SequenceInfo, StoredParams, vectorized};
use crate::models::input_model::MemoryProfile;
use crate::models::trajectories::state_bytes;
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::passes::{BlockSlices, BlockwiseReader, GAUSSIANS_PER_BLOCK};
use crate::source::{
    BlockReader, Deformation, FeatureDecoder, FrameSource, Ids, PreparedDeformation, ReadCounts, ReadPlan,
    SharedCounter,
};

pub(super) use proxies::propose_proxies;

/// Computes the states of Gaussians at any time from their stored parameters. States are in stored encoding (see
/// [`Gaussians`]).
pub(super) trait MotionModel: Debug + Send + Sync {
    /// Values of a block of Gaussians that do not depend on time. They are computed once, by [`MotionModel::prepare`],
    /// and used for every frame.
    type Prepared: Send + Sync;

    /// Computes the values that do not depend on time from the stored parameters `raw`.
    fn prepare(&self, raw: &StoredParams) -> Self::Prepared;

    /// Returns the attributes that change with time.
    fn varying(&self) -> Attributes;

    /// Returns the attributes in [`StoredParams::gaussians`] that the optimizer can change, because
    /// [`MotionModel::jacobian`] covers them.
    fn movable(&self) -> Attributes;

    /// Computes the attributes `want` of the states at `time` of the Gaussians with the stored parameters `raw`.
    /// `prepared` holds the values that [`MotionModel::prepare`] returned for `raw`. Writes the states to `out`, whose
    /// attributes already have the right length. Called with at most [`GAUSSIANS_PER_BLOCK`] Gaussians at once, from
    /// many threads.
    ///
    /// Implementations are always inlined, so that loops over Gaussians are compiled for wider registers. No operation
    /// is fused, so the bits are the same on every machine.
    ///
    /// # Errors
    /// Fails if the model cannot be evaluated.
    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        prepared: &Self::Prepared,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()>;

    /// Returns the derivative of the attributes `want` of the states at `time` with respect to
    /// [`StoredParams::gaussians`] of the stored parameters `raw`. `prepared` holds the values that
    /// [`MotionModel::prepare`] returned for `raw`. The default is the identity: states change by as much as stored
    /// values do.
    ///
    /// # Errors
    /// Fails if the model cannot be evaluated.
    fn jacobian(&self, time: f64, raw: &StoredParams, prepared: &Self::Prepared, want: Attributes) -> Result<Jacobian> {
        let _ = (time, raw, prepared, want);
        Ok(Jacobian::default())
    }

    /// Returns the decoder of pixel colors if the model renders features instead of colors; else `None`.
    fn shading(&self) -> Option<&dyn Shading> {
        None
    }
}

/// Computes colors of pixels from rendered features.
pub(super) trait Shading: Sync {
    /// Returns the features of the Gaussians `raw` at `time`, from which the color of a pixel is computed after
    /// blending: one plane per feature, with its value for every Gaussian.
    fn features(&self, time: f64, raw: &StoredParams) -> AttributeValues;

    /// Returns the color of a pixel from its blended `features`, seen from the camera center `center` along the unit
    /// vector `ray`.
    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3];
}

/// Frames that a motion model computes from stored parameters.
#[derive(Debug)]
pub(super) struct MotionModelFrames<L> {
    motion_model: Arc<L>,
    raw: Arc<StoredParams>,
    info: SequenceInfo,
    states: SharedCounter,
}

impl<L> Clone for MotionModelFrames<L> {
    fn clone(&self) -> Self {
        let (motion_model, raw) = (Arc::clone(&self.motion_model), Arc::clone(&self.raw));
        MotionModelFrames { motion_model, raw, info: self.info.clone(), states: SharedCounter::default() }
    }
}

impl<L: MotionModel> MotionModelFrames<L> {
    /// Creates a model whose states `motion_model` computes from the stored parameters `raw`. It has no frames yet.
    /// `sh_degree` is the SH degree of its states.
    pub(super) fn new(motion_model: L, raw: StoredParams, sh_degree: usize) -> MotionModelFrames<L> {
        let info = SequenceInfo { count: raw.len(), times: Vec::new(), sh_degree, varying: motion_model.varying() };
        MotionModelFrames {
            motion_model: Arc::new(motion_model),
            raw: Arc::new(raw),
            info,
            states: SharedCounter::default(),
        }
    }

    /// Returns the motion model, which computes states from stored parameters.
    pub(super) fn motion_model(&self) -> &L {
        &self.motion_model
    }

    /// Returns the stored parameters of all Gaussians.
    pub(super) fn raw(&self) -> &StoredParams {
        &self.raw
    }

    /// Returns the memory profile of a model that keeps the stored parameters in memory. `seconds_per_state` is the
    /// approximate CPU seconds on one core to compute the state of one Gaussian at one frame.
    pub(super) fn memory_profile(&self, seconds_per_state: f64) -> MemoryProfile {
        let whole = state_bytes(self.raw.gaussians.sh_degree(), Attributes::all())
            + 4 * self.raw.format_specific.width() as u64;
        MemoryProfile {
            per_gaussian: whole,
            // A copy of the parameters while they are read.
            opening: whole,
            // A copy of the stored parameters and the values prepared from them.
            reader: whole + 16 + 8,
            compressed: 2 * whole,
            jacobian: Jacobian::BYTES_PER_GAUSSIAN as u64,
            // Besides its attributes, a Gaussian has normals and other extra properties in the file: about 24 bytes.
            file: whole + 24,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            seconds_per_state,
            ..MemoryProfile::default()
        }
    }

    /// Returns the model with frames at `times`.
    ///
    /// # Errors
    /// Fails if times are not finite or do not increase; the message names the frames.
    pub(super) fn with_times(mut self, times: Vec<f64>) -> Result<MotionModelFrames<L>> {
        self.info = self.info.with_frames_at(times)?;
        Ok(self)
    }

    /// Returns a model with the same motion model and frames, but with the stored parameters `raw`.
    pub(super) fn with_raw(&self, raw: StoredParams) -> MotionModelFrames<L> {
        let sh_degree = self.info.sh_degree.min(raw.gaussians.sh_degree());
        let info = SequenceInfo { count: raw.len(), sh_degree, ..self.info.clone() };
        MotionModelFrames {
            motion_model: Arc::clone(&self.motion_model),
            raw: Arc::new(raw),
            info,
            states: SharedCounter::default(),
        }
    }

    /// Returns the frames of the compressed model that `compressed` describes.
    pub(super) fn compressed_frames(&self, compressed: &CompressedModel) -> MotionModelFrames<L> {
        self.with_raw(compressed_raw(&self.raw, compressed))
    }

    /// Returns the time of frame `frame`; fails if the frame does not exist.
    fn frame_time(&self, frame: usize) -> Result<f64> {
        let times = &self.info.times;
        let missing = || Error::internal(format!("frame {frame} was requested; the sequence has {}", times.len()));
        times.get(frame).copied().ok_or_else(missing)
    }
}

/// Returns the stored parameters of the compressed model `compressed` of `raw`: Gaussians are removed, proxies
/// (Gaussians that replace merged ones) put in place of their leaders (the most important members of the clusters),
/// parameter deltas added, and the SH degree lowered.
pub(super) fn compressed_raw(raw: &StoredParams, compressed: &CompressedModel) -> StoredParams {
    let mut raw_left = raw.pick(&compressed.kept);
    if let Some(proxies) = &compressed.proxies.raw {
        for (proxy, cluster) in compressed.clusters.iter().enumerate() {
            raw_left.set_row(cluster.output as usize, proxies, proxy);
        }
    }
    raw_left.gaussians.truncate_sh(compressed.sh_degree);
    compressed.delta.add_to(&mut raw_left.gaussians, Attributes::all());
    raw_left
}

/// Copies the stored attributes `want` of all Gaussians of `raw` to `out`.
pub(super) fn copy_stored(raw: &StoredParams, want: Attributes, out: &mut Gaussians) {
    for column in want.iter() {
        let (from, to) = (raw.gaussians.attribute_values(column), out.attribute_values_mut(column));
        (0..to.width()).for_each(|c| to.plane_mut(c).copy_from_slice(from.plane(c)));
    }
}

impl<L: MotionModel> FrameSource for MotionModelFrames<L> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let count = self.info.count;
        if let Some(id) = ids.iter().find(|&id| id >= count) {
            return Err(Error::internal(format!("Gaussian {id} was asked for; the model has {count}")));
        }
        let rows: Vec<u32> = ids.iter().map(|id| id as u32).collect();
        let blocks = rows
            .chunks(GAUSSIANS_PER_BLOCK)
            .map(|rows| PreparedBlock::new(self.motion_model(), self.raw.pick(rows)))
            .collect();
        Ok(Box::new(MotionModelReader { model: self, blocks, count: rows.len() }))
    }

    /// Returns a reader that computes the Gaussians block by block. Frames do not depend on one another, so the reader
    /// keeps nothing between frames.
    fn open_all(&self, _: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        Some(Ok(Box::new(BlockwiseReader::new(self))))
    }

    fn deformation(&self) -> Option<&dyn Deformation> {
        Some(self)
    }

    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        self.motion_model.shading().is_some().then_some(self as &dyn FeatureDecoder)
    }

    fn reads(&self) -> ReadCounts {
        ReadCounts { states: self.states.get(), ..ReadCounts::default() }
    }
}

impl<L: MotionModel> FeatureDecoder for MotionModelFrames<L> {
    fn features(&self, frame: usize, out: &mut AttributeValues) -> Result<()> {
        let time = self.frame_time(frame)?;
        *out =
            self.motion_model.shading().map_or(AttributeValues::default(), |shading| shading.features(time, &self.raw));
        Ok(())
    }

    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3] {
        self.motion_model.shading().map_or([0.0; 3], |shading| shading.color(features, center, ray))
    }
}

/// Block of up to [`GAUSSIANS_PER_BLOCK`] Gaussians: their stored parameters, and the values prepared from them that do
/// not depend on time.
struct PreparedBlock<L: MotionModel> {
    raw: StoredParams,
    prepared: L::Prepared,
}

impl<L: MotionModel> PreparedBlock<L> {
    fn new(motion_model: &L, raw: StoredParams) -> PreparedBlock<L> {
        PreparedBlock { prepared: motion_model.prepare(&raw), raw }
    }

    /// Computes the attributes `want` of the states at `time` into `out`.
    fn state(&self, motion_model: &L, time: f64, want: Attributes, out: &mut Gaussians) -> Result<()> {
        out.selected_attribute_values_mut(want).for_each(|column| column.resize(self.raw.len()));
        vectorized(
            #[inline(always)]
            || motion_model.state(time, &self.raw, &self.prepared, want, out),
        )
    }
}

/// Reader of some Gaussians of a model, frame by frame. It computes their states a block of Gaussians at a time.
struct MotionModelReader<'a, L: MotionModel> {
    model: &'a MotionModelFrames<L>,
    blocks: Vec<PreparedBlock<L>>,
    count: usize,
}

impl<L: MotionModel> BlockReader for MotionModelReader<'_, L> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let (model, time) = (self.model, self.model.frame_time(frame)?);
        if !want.is_empty() {
            model.states.add(self.count as u64);
        }
        if let [block] = &self.blocks[..] {
            return block.state(model.motion_model(), time, want, out);
        }
        let mut state = Gaussians::zeros(0, model.info.sh_degree);
        let parts = BlockSlices::split(out, want, self.count);
        for (block, parts) in self.blocks.iter().zip(parts) {
            block.state(model.motion_model(), time, want, &mut state)?;
            parts.write(&state, want);
        }
        Ok(())
    }
}

impl<L: MotionModel> Deformation for MotionModelFrames<L> {
    fn stored(&self) -> &StoredParams {
        &self.raw
    }

    fn movable(&self) -> Attributes {
        self.motion_model.movable()
    }

    fn with_params<'a>(&'a self, stored: &'a StoredParams) -> Box<dyn PreparedDeformation + 'a> {
        Box::new(MovingGaussians { model: self, stored, ids: (0..stored.len() as u32).collect() })
    }
}

/// Gaussians with given stored parameters. Computes their states a block of Gaussians at a time, and keeps nothing
/// between frames.
struct MovingGaussians<'a, L> {
    model: &'a MotionModelFrames<L>,
    stored: &'a StoredParams,
    /// Indices of all Gaussians.
    ids: Vec<u32>,
}

impl<L: MotionModel> MovingGaussians<'_, L> {
    /// Returns the Gaussians `ids`, prepared for evaluation.
    fn block(&self, ids: &[u32]) -> PreparedBlock<L> {
        PreparedBlock::new(self.model.motion_model(), self.stored.pick(ids))
    }
}

impl<L: MotionModel> PreparedDeformation for MovingGaussians<'_, L> {
    fn state(&self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let time = self.model.frame_time(frame)?;
        let parts = BlockSlices::split(out, want, self.ids.len());
        self.ids.par_chunks(GAUSSIANS_PER_BLOCK).zip(parts).try_for_each_init(
            || Gaussians::zeros(0, self.model.info.sh_degree),
            |state, (ids, parts)| {
                self.block(ids).state(self.model.motion_model(), time, want, state)?;
                parts.write(state, want);
                Ok::<_, Error>(())
            },
        )
    }

    fn jacobian(&self, frame: usize, want: Attributes) -> Result<Jacobian> {
        let time = self.model.frame_time(frame)?;
        let of_block = |ids: &[u32]| {
            let PreparedBlock { raw, prepared } = self.block(ids);
            self.model.motion_model.jacobian(time, &raw, &prepared, want)
        };
        let blocks: Vec<Jacobian> = self.ids.par_chunks(GAUSSIANS_PER_BLOCK).map(of_block).collect::<Result<_>>()?;
        Ok(Jacobian::joined(&blocks, self.ids.len()))
    }
}

#[cfg(test)]
mod tests;
