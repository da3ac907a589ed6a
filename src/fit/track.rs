//! Type [`FittedTrack`]: the track of one Gaussian, that is, its attributes at every frame.

use crate::model::{Gaussians, opacity};

/// Opacity below which a Gaussian is not drawn (1/255). Fits ignore the frames in which a Gaussian has a lower opacity.
pub const MIN_VISIBLE_OPACITY: f64 = 1.0 / 255.0;

/// Attributes of one Gaussian at all frames.
#[derive(Debug, Clone, Default)]
pub struct FittedTrack {
    /// Times of the frames, increasing.
    pub times: Vec<f64>,
    /// Position at each frame, in scene units.
    pub position: Vec<[f64; 3]>,
    /// Rotation at each frame: a unit quaternion (w, x, y, z). A quaternion and its negative are the same rotation; the
    /// one nearer to the quaternion of the previous frame is used.
    pub rotation: Vec<[f64; 4]>,
    /// Natural logarithms of the three scales (scene units) at each frame.
    pub log_scale: Vec<[f64; 3]>,
    /// Opacity at each frame, in [0, 1].
    pub opacity: Vec<f64>,
    /// SH coefficients, one row per frame. If they are the same in all frames, there is only one row.
    pub sh: Vec<Vec<f32>>,
}

impl FittedTrack {
    /// Returns the track (states at all frames) of the Gaussian in row `row` of `states`. `states` holds all Gaussians
    /// at each of the `times`. `has_varying_sh` states whether SH coefficients may differ between the states. If it is
    /// false, only the SH coefficients of the first state are read.
    pub fn from_states(times: &[f64], states: &[Gaussians], row: usize, has_varying_sh: bool) -> FittedTrack {
        let mut track = FittedTrack { times: times.to_vec(), ..FittedTrack::default() };
        let mut last = [1.0, 0.0, 0.0, 0.0];
        for state in states {
            track.position.push(state.position_f64(row));
            let q = state.rotation_f64(row);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            let dot: f64 = q.iter().zip(last).map(|(a, b)| a * b).sum();
            // A quaternion of length zero or infinity is replaced by the previous rotation.
            if length > 0.0 && length.is_finite() {
                last = q.map(|x| if dot < 0.0 { -x / length } else { x / length });
            }
            track.rotation.push(last);
            track.log_scale.push(state.log_scale.row::<3>(row).map(f64::from));
            track.opacity.push(opacity(state.opacity_logit.row::<1>(row)[0]));
            if !has_varying_sh && !track.sh.is_empty() {
                continue;
            }
            let sh = || (0..state.sh.width()).map(|c| state.sh.plane(c)[row]);
            if !track.sh.last().is_some_and(|last| sh().eq(last.iter().copied())) {
                track.sh.resize(track.position.len() - 1, track.sh.last().cloned().unwrap_or_default());
                track.sh.push(sh().collect());
            }
        }
        if track.sh.len() > 1 {
            let last = track.sh[track.sh.len() - 1].clone();
            track.sh.resize(track.position.len(), last);
        }
        track
    }

    /// Returns the number of frames.
    pub fn len(&self) -> usize {
        self.times.len()
    }

    /// Returns whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.times.is_empty()
    }

    /// Returns whether the Gaussian is visible at `frame` and its values are finite.
    pub fn is_visible(&self, frame: usize) -> bool {
        let finite = |values: &[f64]| values.iter().all(|x| x.is_finite());
        self.opacity[frame] >= MIN_VISIBLE_OPACITY && finite(&self.position[frame]) && finite(&self.log_scale[frame])
    }

    /// Returns whether the SH coefficients are the same in all frames.
    pub fn has_constant_sh(&self) -> bool {
        self.sh.len() == 1
    }

    /// Returns the SH coefficients of the Gaussian at `frame`.
    pub fn sh(&self, frame: usize) -> &[f32] {
        &self.sh[frame.min(self.sh.len() - 1)]
    }

    /// Returns the mean over frames of every SH coefficient. `mean(f)` returns the mean of the value f(frame); the
    /// caller chooses the frames and their weights. It is not called if the coefficients are the same in all frames.
    pub fn mean_sh(&self, mean: impl Fn(&dyn Fn(usize) -> f64) -> f64) -> Vec<f32> {
        match self.sh.as_slice() {
            [constant] => constant.clone(),
            _ => (0..self.sh(0).len()).map(|c| mean(&|frame| f64::from(self.sh(frame)[c])) as f32).collect(),
        }
    }

    /// Returns the middle one of the three scales at `frame`, scene units; at least 1e-12.
    pub fn middle_scale(&self, frame: usize) -> f64 {
        let mut scales = self.log_scale[frame];
        scales.sort_by(f64::total_cmp);
        scales[1].exp().max(1e-12)
    }

    /// Returns the distance between `position` and the position of the Gaussian at `frame`, in scene units.
    pub fn distance(&self, frame: usize, position: [f64; 3]) -> f64 {
        position.iter().zip(self.position[frame]).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    /// Returns the distance between `position` and the position of the Gaussian at `frame`, in units of the Gaussian's
    /// middle scale at `frame`.
    pub fn distance_in_middle_scales(&self, frame: usize, position: [f64; 3]) -> f64 {
        self.distance(frame, position) / self.middle_scale(frame)
    }

    /// Returns the angle between `rotation` and the rotation of the Gaussian at `frame`, radians; 0 for a nearly round
    /// Gaussian, whose log scales all differ by less than 0.1.
    pub fn rotation_error(&self, frame: usize, rotation: [f64; 4]) -> f64 {
        let scales = self.log_scale[frame];
        let [least, most] =
            [scales.iter().copied().fold(f64::MAX, f64::min), scales.iter().copied().fold(f64::MIN, f64::max)];
        if most - least < 0.1 {
            return 0.0;
        }
        2.0 * self.half_angle_cosine(frame, rotation).acos()
    }

    /// Returns an upper bound, in radians, of the angle that [`FittedTrack::rotation_error`] returns. The bound is
    /// faster to compute. It follows from acos x ≤ π/2·√(1 − x) for 0 ≤ x ≤ 1.
    pub fn max_rotation_error(&self, frame: usize, rotation: [f64; 4]) -> f64 {
        // The factor 1 + 1e-9 covers rounding errors.
        std::f64::consts::PI * (1.0 - self.half_angle_cosine(frame, rotation)).sqrt() * (1.0 + 1e-9)
    }

    /// Returns the cosine, at most 1, of half of the angle between `rotation` and the rotation of the Gaussian at
    /// `frame`.
    fn half_angle_cosine(&self, frame: usize, rotation: [f64; 4]) -> f64 {
        let length = rotation.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-300);
        let dot: f64 = rotation.iter().zip(self.rotation[frame]).map(|(a, b)| a * b).sum();
        (dot.abs() / length).min(1.0)
    }
}
