//! Motion model of files in which each Gaussian is visible in one frame only and does not move.

use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::files::ftgs::ClipTimes;
use crate::files::tsog::{TimedGaussians, Timeline};
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, StoredParams};
use crate::models::in_checkpoint::ProxyRule;
use crate::models::motion_model::window::MAX_LOGIT;
use crate::models::motion_model::{MotionModel, MotionModelFrames, copy_stored};
use crate::recipe::MergeParams;

/// Index in [`StoredParams::format_specific`] of the frame in which a Gaussian is visible.
const FRAME: usize = 0;

/// Motion model in which each Gaussian is visible in a single frame and does not move.
#[derive(Debug, Clone)]
pub(super) struct FrameByFrame {
    /// Times of the frames, increasing.
    times: Vec<f64>,
    clip: ClipTimes,
}

impl FrameByFrame {
    /// Creates the motion model of `frames` frames with evenly spaced times.
    /// - If `clip` lasts from 0 to 1, frame i of n has the time i/n.
    /// - Otherwise the first frame has the first time of `clip`, and the last frame has its last time.
    pub(super) fn new(frames: usize, clip: ClipTimes) -> FrameByFrame {
        let is_mapped = (clip.first, clip.last) != (0.0, 1.0);
        // Frames of a converted sequence reach its last time. Without it, frame i of n begins at i/n.
        let intervals = if is_mapped { frames.max(2) - 1 } else { frames.max(1) };
        let time = |frame: usize| clip.first + (clip.last - clip.first) * frame as f64 / intervals as f64;
        FrameByFrame { times: (0..frames).map(time).collect(), clip }
    }

    /// Returns the times of the frames.
    pub(super) fn times(&self) -> &[f64] {
        &self.times
    }

    /// Returns the index of the frame whose time is nearest to `time`, the later one of two equally near ones.
    fn frame(&self, time: f64) -> usize {
        let after = self.times.partition_point(|&frame| frame < time).min(self.times.len().saturating_sub(1));
        let is_before_nearer = after > 0 && time - self.times[after - 1] < self.times[after] - time;
        if is_before_nearer { after - 1 } else { after }
    }
}

impl MotionModel for FrameByFrame {
    type Prepared = ();

    fn prepare(&self, _: &StoredParams) {}

    fn varying(&self) -> Attributes {
        Attributes::OPACITY
    }

    fn movable(&self) -> Attributes {
        Attributes::all()
    }

    #[inline(always)]
    fn state(&self, time: f64, raw: &StoredParams, (): &(), want: Attributes, out: &mut Gaussians) -> Result<()> {
        copy_stored(raw, want, out);
        if want.contains(Attributes::OPACITY) {
            let now = self.frame(time) as f32;
            let logits = out.opacity_logit.plane_mut(0).iter_mut().zip(raw.format_specific.plane(FRAME));
            logits.filter(|(_, frame)| **frame != now).for_each(|(logit, _)| *logit = -MAX_LOGIT as f32);
        }
        Ok(())
    }

    fn jacobian(&self, time: f64, raw: &StoredParams, (): &(), want: Attributes) -> Result<Jacobian> {
        let mut jacobian = Jacobian::default();
        if want.contains(Attributes::OPACITY) {
            let now = self.frame(time) as f32;
            let slopes =
                raw.format_specific.plane(FRAME).iter().map(|&frame| f32::from(u8::from(frame == now))).collect();
            *jacobian.derivative_mut(Attributes::OPACITY) = AttributeValues::from_planes(1, slopes);
        }
        Ok(jacobian)
    }
}

impl ProxyRule for FrameByFrame {
    /// Returns for each cluster the stored parameters of its leader (most important member) unchanged. A Gaussian that
    /// is visible in one frame cannot replace members of other frames. The caller compares each returned Gaussian with
    /// its cluster at every frame, and refuses it if they differ.
    fn propose(model: &MotionModelFrames<Self>, clusters: &[Cluster], _: &MergeParams) -> Result<StoredParams> {
        let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
        Ok(model.raw().pick(&leaders))
    }

    fn timed(&self, raw: &StoredParams) -> Option<TimedGaussians> {
        let timeline = Timeline::Frames(self.times.len());
        Some(TimedGaussians { params: raw.clone(), timeline, clip: self.clip })
    }

    fn for_times(&self, times: &[f64]) -> Option<FrameByFrame> {
        Some(FrameByFrame { times: times.to_vec(), clip: self.clip })
    }
}
