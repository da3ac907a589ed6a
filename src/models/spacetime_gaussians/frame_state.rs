//! Computes the states of Gaussians at a time from the stored parameters of a SpacetimeGaussians model.
//!
//! [`StoredParams::gaussians`] holds position, quaternion, log scales and opacity logit as stored, and the color as SH
//! of degree 0. [`StoredParams::format_specific`] holds the other parameters, at the indices that the constants of this
//! module give.

use super::decoder::{self, ColorDecoder};
use super::motion::SpacetimeMotion;
use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, StoredParams};
use crate::models::motion_model::window::{faded_logit, inverse_odds, slope};
use crate::models::motion_model::{MotionModel, Shading, copy_stored};

/// Index in [`StoredParams::format_specific`] of the center of the temporal window.
pub(super) const CENTER: usize = 0;
/// Index in [`StoredParams::format_specific`] of the natural logarithm of the width of the temporal window.
pub(super) const LOG_WIDTH: usize = 1;
/// First of nine indices in [`StoredParams::format_specific`]: coefficients of dt, dt², dt³ of the position, each for
/// x, y, z.
pub(super) const MOTION: usize = 2;
/// First of four indices in [`StoredParams::format_specific`]: change of the quaternion per unit of time.
pub(super) const OMEGA: usize = 11;
/// Number of parameters in [`StoredParams::format_specific`] that both the lite and the full model have.
pub(super) const SHARED_PARAM_COUNT: usize = 15;
/// First of six indices in [`StoredParams::format_specific`] of the full model: features that are constant in time. The
/// first three are a color before the last function ([`ColorActivation`](super::decoder::ColorActivation)) is applied.
pub(super) const FIRST_FEATURE: usize = 15;
/// First of three indices in [`StoredParams::format_specific`] of the full model: factors of dt, which give the
/// features that are proportional to the time dt since the center of the temporal window.
pub(super) const FEATURES_IN_TIME: usize = 21;
/// Number of parameters in [`StoredParams::format_specific`] of the full model.
pub(super) const FULL_PARAM_COUNT: usize = 24;

impl SpacetimeMotion {
    /// Returns the motion and temporal window of the Gaussian in row `row` of `raw`.
    pub(super) fn from_raw(raw: &StoredParams, row: usize) -> SpacetimeMotion {
        let own = |plane: usize| f64::from(raw.format_specific.plane(plane)[row]);
        let path = |k: usize| std::array::from_fn(|c| own(MOTION + 3 * k + c));
        SpacetimeMotion {
            center: own(CENTER),
            log_width: own(LOG_WIDTH),
            path: [raw.gaussians.position_f64(row), path(0), path(1), path(2)],
            rotation: raw.gaussians.rotation_f64(row),
            omega: std::array::from_fn(|c| own(OMEGA + c)),
        }
    }

    /// Stores this motion and temporal window as the parameters of the Gaussian in row `row` of `raw`, rounded to f32.
    pub(super) fn write(&self, raw: &mut StoredParams, row: usize) {
        let mut own = |plane: usize, value: f64| raw.format_specific.plane_mut(plane)[row] = value as f32;
        own(CENTER, self.center);
        own(LOG_WIDTH, self.log_width);
        for (k, terms) in self.path[1..].iter().enumerate() {
            terms.iter().enumerate().for_each(|(c, &term)| own(MOTION + 3 * k + c, term));
        }
        self.omega.iter().enumerate().for_each(|(c, &omega)| own(OMEGA + c, omega));
        raw.gaussians.position.set_row(row, self.path[0].map(|x| x as f32));
        raw.gaussians.rotation.set_row(row, self.rotation.map(|x| x as f32));
    }
}

/// Motion model of the lite and the full SpacetimeGaussians model. Colors are those in [`StoredParams::gaussians`]; for
/// the full model, they were computed without the network.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Spacetime {
    /// Whether this is the full model, where a network computes pixel colors from features.
    pub(super) is_full: bool,
    /// Network that computes pixel colors; `None` if the model has none or the network is not known.
    pub(super) decoder: Option<ColorDecoder>,
}

/// Values of a block of Gaussians that do not depend on time. They are computed once and used for every frame.
#[derive(Debug)]
pub(super) struct PreparedGaussian {
    /// For each Gaussian 1 / width², where width is the width of its temporal window.
    inverse_squared: Vec<f64>,
    /// For each Gaussian exp(−o), where o is the stored opacity logit.
    inverse_odds: Vec<f64>,
}

/// Returns the natural logarithm of the temporal window (factor of the opacity) at time `dt` from its center.
/// `inverse_squared` is 1 / width², with the width of the window.
#[inline(always)]
fn window_exponent(dt: f64, inverse_squared: f64) -> f64 {
    -dt * dt * inverse_squared
}

impl MotionModel for Spacetime {
    type Prepared = PreparedGaussian;

    fn prepare(&self, raw: &StoredParams) -> PreparedGaussian {
        PreparedGaussian {
            inverse_squared: raw
                .format_specific
                .plane(LOG_WIDTH)
                .iter()
                .map(|&log| (-2.0 * f64::from(log)).exp())
                .collect(),
            inverse_odds: raw.gaussians.opacity_logit.plane(0).iter().map(|&logit| inverse_odds(logit)).collect(),
        }
    }

    fn varying(&self) -> Attributes {
        Attributes::POSITION | Attributes::ROTATION | Attributes::OPACITY
    }

    /// Returns the attributes that the optimizer can change. These are all attributes for the lite model, and all but
    /// the colors for the full model, because its colors are computed from features and have no derivatives.
    fn movable(&self) -> Attributes {
        if self.is_full { Attributes::all().difference(Attributes::SH) } else { Attributes::all() }
    }

    #[inline(always)]
    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        prepared: &PreparedGaussian,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()> {
        let (stored, own, centers) = (&raw.gaussians, &raw.format_specific, raw.format_specific.plane(CENTER));
        let since = |center: &f32| time - f64::from(*center);
        if want.contains(Attributes::POSITION) {
            for c in 0..3 {
                let [m1, m2, m3] = [0, 1, 2].map(|k| own.plane(MOTION + 3 * k + c));
                let terms = stored.position.plane(c).iter().zip(m1).zip(m2).zip(m3);
                let to = out.position.plane_mut(c).iter_mut().zip(terms).zip(centers);
                to.for_each(|((to, (((&p0, &m1), &m2), &m3)), center)| {
                    let (dt, [p0, m1, m2, m3]) = (since(center), [p0, m1, m2, m3].map(f64::from));
                    *to = (p0 + dt * (m1 + dt * (m2 + dt * m3))) as f32;
                });
            }
        }
        if want.contains(Attributes::ROTATION) {
            for c in 0..4 {
                let terms = stored.rotation.plane(c).iter().zip(own.plane(OMEGA + c));
                let to = out.rotation.plane_mut(c).iter_mut().zip(terms).zip(centers);
                to.for_each(|((to, (&start, &omega)), center)| {
                    *to = (f64::from(start) + since(center) * f64::from(omega)) as f32;
                });
            }
        }
        if want.contains(Attributes::OPACITY) {
            let values = centers.iter().zip(&prepared.inverse_squared).zip(&prepared.inverse_odds);
            out.opacity_logit.plane_mut(0).iter_mut().zip(values).for_each(
                |(to, ((center, &inverse_squared), &inverse_odds))| {
                    *to = faded_logit(inverse_odds, window_exponent(since(center), inverse_squared)) as f32;
                },
            );
        }
        copy_stored(raw, want.difference(self.varying()), out);
        Ok(())
    }

    fn jacobian(
        &self,
        time: f64,
        raw: &StoredParams,
        prepared: &PreparedGaussian,
        want: Attributes,
    ) -> Result<Jacobian> {
        let mut found = Jacobian::default();
        if want.contains(Attributes::OPACITY) {
            let centers = raw.format_specific.plane(CENTER);
            let derivative = |row: usize| {
                let dt = time - f64::from(centers[row]);
                slope(prepared.inverse_odds[row], window_exponent(dt, prepared.inverse_squared[row])) as f32
            };
            *found.derivative_mut(Attributes::OPACITY) =
                AttributeValues::from_planes(1, (0..raw.len()).map(derivative).collect());
        }
        Ok(found)
    }

    fn shading(&self) -> Option<&dyn Shading> {
        self.decoder.as_ref().map(|_| self as &dyn Shading)
    }
}

impl Shading for Spacetime {
    /// Returns nine features for each Gaussian of `raw` at `time`: six that are constant in time, then three that are
    /// proportional to the time since the center of the temporal window.
    fn features(&self, time: f64, raw: &StoredParams) -> AttributeValues {
        let mut found = AttributeValues::zeros(decoder::FEATURE_COUNT, raw.len());
        let centers = raw.format_specific.plane(CENTER);
        for plane in 0..FEATURES_IN_TIME - FIRST_FEATURE {
            found.plane_mut(plane).copy_from_slice(raw.format_specific.plane(FIRST_FEATURE + plane));
        }
        for c in 0..FULL_PARAM_COUNT - FEATURES_IN_TIME {
            let by_time = raw.format_specific.plane(FEATURES_IN_TIME + c);
            for (row, to) in found.plane_mut(FEATURES_IN_TIME - FIRST_FEATURE + c).iter_mut().enumerate() {
                *to = ((time - f64::from(centers[row])) * f64::from(by_time[row])) as f32;
            }
        }
        found
    }

    fn color(&self, features: &[f32], center: [f32; 3], ray: [f32; 3]) -> [f32; 3] {
        self.decoder.as_ref().map_or([0.0; 3], |decoder| decoder.color(features, center, ray))
    }
}
