//! Motion model of FreeTimeGS: Gaussians that move along straight lines and fade with the distance in time.
//!
//! With dt = t − times: x = means + velocities·dt; opacity = max(σ(o)·exp(−½(dt/s)²), 1e-4), where s =
//! max(exp(durations), 0.02) + 1e-8 is the standard deviation in time and σ(o) is the stored opacity. Source:
//! `compute_positions_at_time`, `compute_temporal_opacity` of FreeTimeGsVanilla. Its viewer does without the bounds
//! 1e-4 and 0.02.
//!
//! `.ftgs.ply` and `.tsog` files use the same motion, but with other bounds and another unit of time.

use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::files::ftgs::{ClipTimes, LOG_TIME_DEVIATION, TIME_CENTER, VELOCITY};
use crate::files::tsog::{TimedGaussians, Timeline};
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, StoredParams, scale_rotation};
use crate::models::in_checkpoint::ProxyRule;
use crate::models::in_checkpoint::linear::{LinearPath, match_proxies};
use crate::models::motion_model::window::{faded_logit, inverse_odds, slope};
use crate::models::motion_model::{MotionModel, MotionModelFrames, copy_stored};
use crate::recipe::MergeParams;

/// Motion model of FreeTimeGS: straight lines and a temporal window. The parameters in
/// [`StoredParams::format_specific`] are described in [`crate::files::ftgs`].
#[derive(Debug, Clone)]
pub(in crate::models) struct FreeTime {
    /// Conversion from the times of frames to the time unit of the stored parameters. In this unit, the clip lasts from
    /// 0 to 1.
    pub(in crate::models) clip: ClipTimes,
    /// Constants `[min, offset]` of the standard deviation in time of a Gaussian, in the time unit of the stored
    /// parameters. The standard deviation is max(exp(d), min) + offset, where d is the stored duration.
    pub(in crate::models) deviation_floor: [f64; 2],
    /// Minimum opacity of every Gaussian at every time. Smaller opacities are raised to it.
    pub(in crate::models) min_opacity: f64,
}

/// Temporal windows of some Gaussians: values from which the opacity at any time is computed and that do not depend on
/// time.
#[derive(Debug)]
pub(in crate::models) struct Windows {
    /// For each Gaussian 1/(2s²), where s is the standard deviation of its temporal window.
    rates: Vec<f64>,
    /// For each Gaussian exp(−o), where o is the stored opacity logit.
    inverse_odds: Vec<f64>,
}

impl FreeTime {
    /// Motion model of the trainer FreeTimeGsVanilla.
    pub(in crate::models) const TRAINED: FreeTime =
        FreeTime { clip: ClipTimes::UNIT_INTERVAL, deviation_floor: [0.02, 1e-8], min_opacity: 1e-4 };

    /// Returns the standard deviation s in time of a Gaussian, in the time unit of the stored parameters. `duration` is
    /// the stored parameter, a natural logarithm.
    fn deviation(&self, duration: f32) -> f64 {
        f64::from(duration).exp().max(self.deviation_floor[0]) + self.deviation_floor[1]
    }

    /// Returns 1/(2s²), where s is the standard deviation in time of a Gaussian with the stored parameter `duration`.
    fn rate(&self, duration: f32) -> f64 {
        0.5 / self.deviation(duration).powi(2)
    }

    /// Returns the logit of the opacity [`FreeTime::min_opacity`].
    fn min_logit(&self) -> f64 {
        (self.min_opacity / (1.0 - self.min_opacity)).ln()
    }

    /// Returns the stored parameters `raw` with each duration replaced by the natural logarithm of the standard
    /// deviation in time that this motion model computes from it. [`FreeTime::deviation_floor`] is already applied to
    /// the result; a reader of the result must not apply it again.
    pub(in crate::models) fn with_deviations(&self, raw: &StoredParams) -> StoredParams {
        let mut raw = raw.clone();
        let durations = raw.format_specific.plane_mut(LOG_TIME_DEVIATION).iter_mut();
        durations.for_each(|duration| *duration = self.deviation(*duration).ln() as f32);
        raw
    }
}

impl MotionModel for FreeTime {
    type Prepared = Windows;

    fn prepare(&self, raw: &StoredParams) -> Windows {
        let rates = raw.format_specific.plane(LOG_TIME_DEVIATION).iter().map(|&duration| self.rate(duration)).collect();
        Windows {
            rates,
            inverse_odds: raw.gaussians.opacity_logit.plane(0).iter().map(|&logit| inverse_odds(logit)).collect(),
        }
    }

    fn varying(&self) -> Attributes {
        Attributes::POSITION | Attributes::OPACITY
    }

    fn movable(&self) -> Attributes {
        Attributes::all()
    }

    #[inline(always)]
    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        windows: &Windows,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()> {
        copy_stored(raw, want.difference(self.varying()), out);
        let (time, centers) = (self.clip.to_unit(time), raw.format_specific.plane(TIME_CENTER));
        if want.contains(Attributes::POSITION) {
            for c in 0..3 {
                let (from, velocity) = (raw.gaussians.position.plane(c), raw.format_specific.plane(VELOCITY + c));
                let to = out.position.plane_mut(c).iter_mut().zip(from).zip(velocity).zip(centers);
                to.for_each(|(((to, &x), &v), &center)| {
                    *to = (f64::from(x) + f64::from(v) * (time - f64::from(center))) as f32;
                });
            }
        }
        if want.contains(Attributes::OPACITY) {
            let min_logit = self.min_logit();
            let to =
                out.opacity_logit.plane_mut(0).iter_mut().zip(centers).zip(&windows.rates).zip(&windows.inverse_odds);
            to.for_each(|(((to, &center), &rate), &inverse_odds)| {
                let exponent = -rate * (time - f64::from(center)).powi(2);
                *to = faded_logit(inverse_odds, exponent).max(min_logit) as f32;
            });
        }
        Ok(())
    }

    fn jacobian(&self, time: f64, raw: &StoredParams, windows: &Windows, want: Attributes) -> Result<Jacobian> {
        let mut jacobian = Jacobian::default();
        if want.contains(Attributes::OPACITY) {
            let min_logit = self.min_logit();
            let time = self.clip.to_unit(time);
            let centers = raw.format_specific.plane(TIME_CENTER).iter().zip(&windows.rates).zip(&windows.inverse_odds);
            let slopes = centers.map(|((&center, &rate), &inverse_odds)| {
                let exponent = -rate * (time - f64::from(center)).powi(2);
                if exponent < min_logit || faded_logit(inverse_odds, exponent) <= min_logit {
                    0.0
                } else {
                    slope(inverse_odds, exponent) as f32
                }
            });
            *jacobian.derivative_mut(Attributes::OPACITY) = AttributeValues::from_planes(1, slopes.collect());
        }
        Ok(jacobian)
    }
}

impl ProxyRule for FreeTime {
    fn propose(model: &MotionModelFrames<FreeTime>, clusters: &[Cluster], rule: &MergeParams) -> Result<StoredParams> {
        let (raw, motion) = (model.raw(), model.motion_model());
        let (ClipTimes { first, last, .. }, floor) = (motion.clip, motion.deviation_floor);
        // Paths are in the unit of the times of frames, so that they can be compared with frames.
        let span = last - first;
        let line = |id: u32| {
            let id = id as usize;
            LinearPath {
                position: raw.gaussians.position_f64(id),
                velocity: [0, 1, 2].map(|c| f64::from(raw.format_specific.plane(VELOCITY + c)[id]) / span),
                center: first + span * f64::from(raw.format_specific.plane(TIME_CENTER)[id]),
                deviation: span * motion.deviation(raw.format_specific.plane(LOG_TIME_DEVIATION)[id]),
            }
        };
        let window = |line: &LinearPath, time: f64| (-0.5 * ((time - line.center) / line.deviation).powi(2)).exp();
        let mut sh = vec![Vec::new(); clusters.len()];
        let matched = match_proxies(model, clusters, rule, line, window, Attributes::SH, |seen| {
            // The SH coefficients of a proxy are the same at every frame.
            if sh[seen.proxy].is_empty() {
                let sh_at_frame = &seen.state.sh;
                sh[seen.proxy] = (0..sh_at_frame.width()).map(|c| sh_at_frame.plane(c)[seen.row]).collect();
            }
        })?;
        let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
        let mut proxies = raw.pick(&leaders);
        for (row, (matched, sh)) in matched.iter().zip(&sh).enumerate() {
            let line = matched.line;
            let StoredParams { gaussians, format_specific: own } = &mut proxies;
            gaussians.position.set_row(row, line.position.map(|x| x as f32));
            own.plane_mut(TIME_CENTER)[row] = motion.clip.to_unit(line.center) as f32;
            own.plane_mut(LOG_TIME_DEVIATION)[row] = (line.deviation / span - floor[1]).max(floor[0]).ln() as f32;
            (0..3).for_each(|c| own.plane_mut(VELOCITY + c)[row] = (span * line.velocity[c]) as f32);
            let Some((opacity, covariance)) = matched.shape else { continue };
            let like = gaussians.rotation_f64(row);
            let (scales, rotation) = scale_rotation(covariance, like);
            gaussians.log_scale.set_row(row, scales.map(|scale| scale.ln() as f32));
            gaussians.rotation.set_row(row, rotation.map(|q| q as f32));
            gaussians.opacity_logit.set_row(row, [opacity]);
            sh.iter().enumerate().for_each(|(c, &value)| gaussians.sh.plane_mut(c)[row] = value);
        }
        Ok(proxies)
    }

    fn timed(&self, raw: &StoredParams) -> Option<TimedGaussians> {
        let params = self.with_deviations(raw);
        Some(TimedGaussians { params, timeline: Timeline::Windows, clip: self.clip })
    }
}
