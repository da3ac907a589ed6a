//! Models whose frames follow from raw parameters by a law: polynomials of time, networks, conditional covariances.
//!
//! A family gives its [`MotionModel`]; reading in blocks, changing and reducing are the same for all of them. Memory: the raw
//! parameters, and per open reader those of its Gaussians once more with what is prepared of them.

mod proxies;
pub(super) mod window;

use std::fmt::Debug;
use std::sync::Arc;

use rayon::prelude::*;

use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::model::{Column, Columns, Gaussians, Jacobian, Raw, SequenceInfo};
use crate::passes::{BLOCK, BlockSlices, InBlocks};
use crate::source::{BlockReader, Count, Deformation, FeatureDecoder, FrameSource, Ids, ReadPlan, Reads};

pub(super) use proxies::solve;

/// How states follow from raw parameters. States are in stored encoding, as [`Gaussians`] says.
pub(super) trait MotionModel: Debug + Send + Sync {
    /// What follows from some Gaussians' raw parameters once for all times.
    type Prepared: Send + Sync;

    /// That of `raw`.
    fn prepare(&self, raw: &Raw) -> Self::Prepared;

    /// Columns that change with time.
    fn varying(&self) -> Columns;

    /// Columns of [`Raw::gaussians`] that a derivative leads to.
    fn movable(&self) -> Columns;

    /// Writes the columns `want` of the states at `time` into `out`, which has room for them: at most [`BLOCK`] at once,
    /// from many threads. Loops over planes are compiled for wider registers where this is always inlined; no operation is
    /// fused, so the same bits.
    ///
    /// # Errors
    /// What cannot be evaluated.
    fn state(&self, time: f64, raw: &Raw, prepared: &Self::Prepared, want: Columns, out: &mut Gaussians) -> Result<()>;

    /// How the columns `want` of those states change with [`Raw::gaussians`]: by as much, unless a law says otherwise.
    ///
    /// # Errors
    /// What cannot be evaluated.
    fn jacobian(&self, time: f64, raw: &Raw, prepared: &Self::Prepared, want: Columns) -> Result<Jacobian> {
        let _ = (time, raw, prepared, want);
        Ok(Jacobian::default())
    }

    /// How pixels get their colors, where Gaussians have features in the place of these.
    fn shading(&self) -> Option<&dyn Shading> {
        None
    }
}

/// Features in the place of colors.
pub(super) trait Shading: Sync {
    /// Those of `raw` at `time`, a plane for each.
    fn features(&self, time: f64, raw: &Raw) -> Column;

    /// The color of a pixel that has blended `features`, seen from `center` along the unit `ray`.
    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3];
}

/// A model of a law.
#[derive(Debug)]
pub(super) struct MotionModelFrames<L> {
    law: Arc<L>,
    raw: Arc<Raw>,
    info: SequenceInfo,
    states: Count,
}

impl<L> Clone for MotionModelFrames<L> {
    fn clone(&self) -> Self {
        let (law, raw) = (Arc::clone(&self.law), Arc::clone(&self.raw));
        MotionModelFrames { law, raw, info: self.info.clone(), states: Count::default() }
    }
}

impl<L: MotionModel> MotionModelFrames<L> {
    /// A model without frames yet, whose states have harmonics of `sh_degree`.
    pub(super) fn new(law: L, raw: Raw, sh_degree: usize) -> MotionModelFrames<L> {
        let info = SequenceInfo { count: raw.len(), times: Vec::new(), sh_degree, varying: law.varying() };
        MotionModelFrames { law: Arc::new(law), raw: Arc::new(raw), info, states: Count::default() }
    }

    /// The law.
    pub(super) fn law(&self) -> &L {
        &self.law
    }

    /// The raw parameters.
    pub(super) fn raw(&self) -> &Raw {
        &self.raw
    }

    /// The same model with frames at `times`.
    ///
    /// # Errors
    /// Times that are not finite or do not increase, naming the frames.
    pub(super) fn with_times(mut self, times: Vec<f64>) -> Result<MotionModelFrames<L>> {
        self.info = self.info.at(times)?;
        Ok(self)
    }

    /// The same law and frames with other Gaussians.
    pub(super) fn with_raw(&self, raw: Raw) -> MotionModelFrames<L> {
        let sh_degree = self.info.sh_degree.min(raw.gaussians.sh_degree());
        let info = SequenceInfo { count: raw.len(), sh_degree, ..self.info.clone() };
        MotionModelFrames { law: Arc::clone(&self.law), raw: Arc::new(raw), info, states: Count::default() }
    }

    /// The model that `reduction` leaves.
    pub(super) fn reduced(&self, reduction: &CompressedModel) -> MotionModelFrames<L> {
        self.with_raw(left(&self.raw, reduction))
    }

    fn time_of(&self, frame: usize) -> Result<f64> {
        let times = &self.info.times;
        let missing = || Error::internal(format!("frame {frame} was asked for; the sequence has {}", times.len()));
        times.get(frame).copied().ok_or_else(missing)
    }
}

/// The raw parameters of what `reduction` leaves of `raw`, with its proxies in their places, changed, and with what stays of
/// their harmonics.
pub(super) fn left(raw: &Raw, reduction: &CompressedModel) -> Raw {
    let mut left = raw.pick(&reduction.kept);
    if let Some(proxies) = &reduction.proxies.raw {
        for (proxy, cluster) in reduction.clusters.iter().enumerate() {
            left.set_row(cluster.output as usize, proxies, proxy);
        }
    }
    left.gaussians.drop_bands(reduction.sh_degree);
    reduction.change.add_to(&mut left.gaussians, Columns::all());
    left
}

/// Makes the columns `want` of `out` those that `raw` has.
pub(super) fn copy_stored(raw: &Raw, want: Columns, out: &mut Gaussians) {
    for column in want.iter() {
        let (from, to) = (raw.gaussians.column(column), out.column_mut(column));
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
        let blocks = rows.chunks(BLOCK).map(|rows| PreparedBlock::new(self.law(), self.raw.pick(rows))).collect();
        Ok(Box::new(MotionModelReader { model: self, blocks, count: rows.len() }))
    }

    /// Nothing is decoded together.
    fn open_all(&self, _: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        Some(Ok(Box::new(InBlocks::new(self))))
    }

    fn deformation(&self) -> Option<&dyn Deformation> {
        Some(self)
    }

    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        self.law.shading().is_some().then_some(self as &dyn FeatureDecoder)
    }

    fn reads(&self) -> Reads {
        Reads { states: self.states.get(), ..Reads::default() }
    }
}

impl<L: MotionModel> FeatureDecoder for MotionModelFrames<L> {
    fn features(&self, frame: usize, out: &mut Column) -> Result<()> {
        let time = self.time_of(frame)?;
        *out = self.law.shading().map_or(Column::default(), |shading| shading.features(time, &self.raw));
        Ok(())
    }

    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3] {
        self.law.shading().map_or([0.0; 3], |shading| shading.color(features, center, ray))
    }
}

/// Some Gaussians, ready to be evaluated.
struct PreparedBlock<L: MotionModel> {
    raw: Raw,
    prepared: L::Prepared,
}

impl<L: MotionModel> PreparedBlock<L> {
    fn new(law: &L, raw: Raw) -> PreparedBlock<L> {
        PreparedBlock { prepared: law.prepare(&raw), raw }
    }

    fn state(&self, law: &L, time: f64, want: Columns, out: &mut Gaussians) -> Result<()> {
        out.columns_mut(want).for_each(|column| column.resize(self.raw.len()));
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the line above saw that this processor has AVX2.
            return unsafe { self.state_avx2(law, time, want, out) };
        }
        law.state(time, &self.raw, &self.prepared, want, out)
    }

    /// [`MotionModel::state`] compiled for AVX2.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn state_avx2(&self, law: &L, time: f64, want: Columns, out: &mut Gaussians) -> Result<()> {
        law.state(time, &self.raw, &self.prepared, want, out)
    }
}

struct MotionModelReader<'a, L: MotionModel> {
    model: &'a MotionModelFrames<L>,
    blocks: Vec<PreparedBlock<L>>,
    count: usize,
}

impl<L: MotionModel> BlockReader for MotionModelReader<'_, L> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        let (model, time) = (self.model, self.model.time_of(frame)?);
        if !want.is_empty() {
            model.states.add(self.count as u64);
        }
        if let [block] = &self.blocks[..] {
            return block.state(model.law(), time, want, out);
        }
        let mut state = Gaussians::zeros(0, model.info.sh_degree);
        let parts = BlockSlices::split(out, want, self.count);
        for (block, parts) in self.blocks.iter().zip(parts) {
            block.state(model.law(), time, want, &mut state)?;
            parts.write(&state, want);
        }
        Ok(())
    }
}

/// Blocks at once.
impl<L: MotionModel> Deformation for MotionModelFrames<L> {
    fn stored(&self) -> &Raw {
        &self.raw
    }

    fn movable(&self) -> Columns {
        self.law.movable()
    }

    fn state(&self, frame: usize, stored: &Raw, want: Columns, out: &mut Gaussians) -> Result<()> {
        let time = self.time_of(frame)?;
        let ids: Vec<u32> = (0..stored.len() as u32).collect();
        let parts = BlockSlices::split(out, want, ids.len());
        ids.par_chunks(BLOCK).zip(parts).try_for_each_init(
            || Gaussians::zeros(0, self.info.sh_degree),
            |state, (ids, parts)| {
                PreparedBlock::new(self.law(), stored.pick(ids)).state(self.law(), time, want, state)?;
                parts.write(state, want);
                Ok::<_, Error>(())
            },
        )
    }

    fn jacobian(&self, frame: usize, stored: &Raw, want: Columns) -> Result<Jacobian> {
        let time = self.time_of(frame)?;
        let ids: Vec<u32> = (0..stored.len() as u32).collect();
        let of_block = |ids: &[u32]| {
            let PreparedBlock { raw, prepared } = PreparedBlock::<L>::new(self.law(), stored.pick(ids));
            self.law.jacobian(time, &raw, &prepared, want)
        };
        let blocks: Vec<Jacobian> = ids.par_chunks(BLOCK).map(of_block).collect::<Result<_>>()?;
        Ok(Jacobian::joined(&blocks, ids.len()))
    }
}

#[cfg(test)]
mod tests;
