//! Adam optimizer of the stored parameters of Gaussians.
//!
//! Input: derivatives of the loss of one view after another ([`Gradients`]). Output: a [`ParamDelta`], which is added
//! to the stored parameters. The method is Adam (Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015)
//! with one learning rate for each kind of parameter and without corrections other than Adam's own bias correction.
//! Memory: [`bytes_per_gaussian`].

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::compressed_model::ParamDelta;
use crate::model::{AttributeValues, Attributes, Gaussians, Gradients, sh_coefficient_count, vectorized};

/// Adam's decay rates β₁, of the running mean of the derivative, and β₂, of the running mean of its square.
const BETAS: [f32; 2] = [0.9, 0.999];
/// Small term in the denominator of Adam's update, against division by 0.
const EPSILON: f32 = 1e-15;
/// Number of steps at the beginning during which learning rates grow to full size, because Adam's running means are not
/// reliable yet.
const WARM_UP_STEPS: usize = 10;
/// Error of the renders at the start at or above which learning rates have full size. For a smaller error the rates are
/// reduced in proportion, so that nearly correct parameters are not disturbed. The error is the geometric mean of the
/// root mean square errors of the views, with color values from 0 to 1.
const FULL_ERROR: f64 = 0.036;

/// Learning rate of the position of a Gaussian, divided by the geometric mean of its scales.
const POSITION_RATE: f32 = 0.04;
/// Largest scale that counts for the learning rate of a position, divided by the median scale of all Gaussians. A
/// Gaussian that encloses the scene, such as haze or a sky, would otherwise cross the scene in one step and change the
/// order in which Gaussians are blended. In trained scenes without such Gaussians the ratio is at most 360.
const MAX_SCALE_RATIO: f32 = 400.0;

/// Factor on all learning rates as a function of the optimization step.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct RateSchedule {
    steps: usize,
    last: f32,
    factor: f32,
}

impl RateSchedule {
    /// Creates the schedule of `steps` optimization steps. At the end the rates have fallen to the fraction `last` of
    /// the rates at the beginning. `error`: geometric mean of the root mean square errors of the views at the start.
    pub fn new(steps: usize, last: f32, error: f64) -> RateSchedule {
        RateSchedule { steps, last, factor: (error / FULL_ERROR).min(1.0) as f32 }
    }

    /// Returns a copy of this schedule with all rates multiplied by `part`.
    pub fn scaled_by(self, part: f32) -> RateSchedule {
        RateSchedule { factor: part * self.factor, ..self }
    }

    /// Returns the factor on all learning rates for the step that follows `done` steps.
    fn at(&self, done: usize) -> f32 {
        let [warm, late] = [(done + 1) as f32 / WARM_UP_STEPS as f32, done as f32 / self.steps.max(1) as f32];
        self.factor * warm.min(1.0) * self.last.powf(late)
    }
}

/// Adam optimizer of the stored parameters of Gaussians.
#[derive(Debug)]
pub struct Adam {
    change: ParamDelta,
    /// Running mean of the derivatives, and running mean of the squared derivatives.
    means: [Gaussians; 2],
    /// Two lists of factors on the learning rates, each with one factor per Gaussian. First list: factors for positions
    /// ([`position_rates`]), in scene units. Second list: factors for all other attributes, 1. Both factors are 0 for
    /// Gaussians that are not optimized.
    reach: [Vec<f32>; 2],
    columns: Attributes,
    done: usize,
}

/// Returns the bytes of memory per Gaussian of an [`Adam`] and of the derivatives it uses, if it optimizes the
/// attributes `columns` with SH coefficients up to `sh_degree`.
pub fn bytes_per_gaussian(columns: Attributes, sh_degree: usize) -> usize {
    4 * 4 * columns.width(sh_degree) + 2 * size_of::<f32>()
}

impl Adam {
    /// Creates an optimizer with the start parameters `start`. The optimizer changes the attributes `columns`, with SH
    /// coefficients up to `sh_degree`, of all Gaussians for which `fixed` is false.
    pub fn new(start: &Gaussians, columns: Attributes, sh_degree: usize, fixed: &[bool]) -> Adam {
        let mut change = Gaussians::default();
        for column in columns.iter() {
            *change.attribute_values_mut(column) = AttributeValues::zeros(column.width(sh_degree), start.len());
        }
        let free: Vec<f32> = fixed.iter().map(|&fixed| if fixed { 0.0 } else { 1.0 }).collect();
        let position_rates = position_rates(start).into_iter().zip(&free).map(|(rate, free)| free * rate).collect();
        let reach = [position_rates, free];
        Adam { means: [change.clone(), change.clone()], change: ParamDelta(change), reach, columns, done: 0 }
    }

    /// Returns the delta: current parameters minus start parameters.
    pub fn delta(&self) -> &ParamDelta {
        &self.change
    }

    /// Returns whether the delta (current parameters minus start parameters) has any value other than 0.
    pub fn has_moved(&self) -> bool {
        self.columns.iter().any(|column| self.change.0.attribute_values(column).planes().iter().any(|&x| x != 0.0))
    }

    /// Returns the delta and resets it to 0. The caller has to add the returned delta to the start parameters.
    pub fn take_delta(&mut self) -> ParamDelta {
        let moved = self.change.clone();
        self.change.0.selected_attribute_values_mut(self.columns).for_each(|column| column.planes_mut().fill(0.0));
        moved
    }

    /// Restarts the optimizer: sets the current parameters to the start parameters plus `change`, and the running means
    /// to 0. Attributes without values in `change` are set to the start parameters.
    pub fn restart(&mut self, change: &ParamDelta) {
        self.take_delta();
        for column in (self.columns & change.attributes()).iter() {
            self.change.0.attribute_values_mut(column).clone_from(change.0.attribute_values(column));
        }
        for means in &mut self.means {
            means.selected_attribute_values_mut(self.columns).for_each(|column| column.planes_mut().fill(0.0));
        }
        self.done = 0;
    }

    /// Returns the values that a checkpoint stores and [`Adam::resume`] takes: delta, running means of the gradient and
    /// its square, and number of steps.
    pub fn checkpoint(&self) -> (&ParamDelta, &[Gaussians; 2], usize) {
        (&self.change, &self.means, self.done)
    }

    /// Restores the values that [`Adam::checkpoint`] returned for an optimizer with the same start parameters: delta,
    /// running means, and number of steps.
    pub fn resume(&mut self, (change, means, done): (ParamDelta, [Gaussians; 2], usize)) {
        (self.change, self.means, self.done) = (change, means, done);
    }

    /// Makes one optimization step with the derivatives `weight` · `gradients` and the learning rates of `schedule`.
    ///
    /// # Panics
    /// Panics if `gradients` has a different number of Gaussians or lacks an optimized attribute.
    pub fn step(&mut self, gradients: &Gradients, weight: f32, schedule: &RateSchedule) {
        let factor = schedule.at(self.done);
        self.done += 1;
        // Adam's correction of the bias that running means have because they started at 0.
        let unbiased = BETAS.map(|beta| 1.0 / (1.0 - beta.powi(self.done as i32)));
        let [position_reach, other_reach] = &self.reach;
        let count = other_reach.len().max(1);
        let [means, squares] = &mut self.means;
        let moved =
            means.selected_attribute_values_mut(self.columns).zip(squares.selected_attribute_values_mut(self.columns));
        let moved = self.columns.iter().zip(moved.zip(self.change.0.selected_attribute_values_mut(self.columns)));
        let mut planes = Vec::new();
        for (column, ((means, squares), values)) in moved {
            let reach = if column == Attributes::POSITION { position_reach } else { other_reach };
            let slopes_of_column = gradients.derivatives(column).planes().chunks_exact(count);
            let state = means.planes_mut().chunks_exact_mut(count).zip(squares.planes_mut().chunks_exact_mut(count));
            let state = state.zip(values.planes_mut().chunks_exact_mut(count)).zip(slopes_of_column).enumerate();
            planes.extend(state.map(|(c, state)| (factor * rate(column, c), reach, state)));
        }
        planes.into_par_iter().for_each(|(rate, reach, (((mean, square), value), slope))| {
            let state = mean.iter_mut().zip(square).zip(value).zip(slope).zip(reach);
            vectorized(
                #[inline(always)]
                || {
                    for ((((mean, square), value), &slope), &reach) in state {
                        let slope = weight * slope;
                        *mean += (1.0 - BETAS[0]) * (slope - *mean);
                        *square += (1.0 - BETAS[1]) * (slope * slope - *square);
                        let root = (*square * unbiased[1]).sqrt() + EPSILON;
                        let change = rate * reach * (*mean * unbiased[0]) / root;
                        // Subtracts 0 instead of skipping the store: a store that depends on a condition is slow.
                        *value -= if (*value - change).is_finite() { change } else { 0.0 };
                    }
                },
            );
        });
    }
}

/// Returns the learning rate of the position of each Gaussian of `start`, scene units: [`POSITION_RATE`] times the
/// geometric mean of its scales, which counts at most as [`MAX_SCALE_RATIO`] times the median of all Gaussians.
fn position_rates(start: &Gaussians) -> Vec<f32> {
    let scale = |i: usize| (start.log_scale.row::<3>(i).iter().sum::<f32>() / 3.0).clamp(-80.0, 80.0).exp();
    let scales: Vec<f32> = (0..start.len()).map(scale).collect();
    let mut sorted = scales.clone();
    sorted.sort_unstable_by(f32::total_cmp);
    let largest = MAX_SCALE_RATIO * sorted.get(sorted.len() / 2).copied().unwrap_or_default();
    // A comparison keeps a NaN, which `min` would replace: such a Gaussian does not move.
    scales.into_iter().map(|scale| POSITION_RATE * if scale > largest { largest } else { scale }).collect()
}

/// Returns the learning rate of component `c` of the attribute `column`. For positions it is 1, because `Adam::reach`
/// contains their learning rate, which depends on the size of the Gaussian.
fn rate(column: Attributes, c: usize) -> f32 {
    match column {
        Attributes::POSITION => 1.0,
        Attributes::ROTATION => 0.006,
        Attributes::SH if c < 3 * sh_coefficient_count(0) => 0.015,
        Attributes::SH => 0.001_25,
        // Log scale and opacity logit.
        _ => 0.05,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn giant_gaussians_do_not_cross_the_scene() {
        let mut start = Gaussians::zeros(101, 0);
        start.log_scale.set_row(7, [1.0, 2.0, 3.0]);
        start.log_scale.set_row(50, [12.0; 3]);
        let rates = position_rates(&start);
        assert_eq!(rates[0], POSITION_RATE);
        assert!((rates[7] - POSITION_RATE * 2f32.exp()).abs() < 1e-6);
        assert_eq!(rates[50], POSITION_RATE * MAX_SCALE_RATIO);
        assert!(position_rates(&Gaussians::zeros(0, 0)).is_empty());
    }

    /// Returns the derivatives of Σ (value − `aim`)² / 2 with respect to every attribute value of `state`.
    fn slopes(state: &Gaussians, aim: f32) -> Gradients {
        let mut gradients = Gradients::new(state.len(), Attributes::all(), 0);
        for column in Attributes::all().iter() {
            let values = state.attribute_values(column).planes();
            gradients
                .derivatives_mut(column)
                .planes_mut()
                .iter_mut()
                .zip(values)
                .for_each(|(slope, x)| *slope = x - aim);
        }
        gradients
    }

    #[test]
    fn values_converge_to_zero_slope_and_fixed_ones_stay() {
        let start = Gaussians::zeros(3, 0);
        let mut descent = Adam::new(&start, Attributes::all(), 0, &[false, true, false]);
        for _ in 0..2000 {
            let mut now = start.clone();
            descent.delta().add_to(&mut now, Attributes::all());
            descent.step(&slopes(&now, 0.25), 1.0, &RateSchedule::new(2000, 0.05, 1.0));
        }
        let mut end = start.clone();
        descent.delta().add_to(&mut end, Attributes::all());
        for column in Attributes::all().iter() {
            for c in 0..end.attribute_values(column).width() {
                let plane = end.attribute_values(column).plane(c);
                assert_eq!(plane[1], 0.0);
                assert!((plane[0] - 0.25).abs() < 1e-3 && plane[0] == plane[2], "{column:?} {c}: {plane:?}");
            }
        }
    }

    #[test]
    fn steps_equal_adam_in_f64() {
        let start = Gaussians::zeros(1, 0);
        let (steps, error) = (50, 0.009);
        let mut descent = Adam::new(&start, Attributes::OPACITY, 0, &[false]);
        let (mut value, mut mean, mut square) = (0.0f64, 0.0f64, 0.0f64);
        for k in 0..steps {
            let mut gradients = Gradients::new(1, Attributes::OPACITY, 0);
            let slope = (k as f64 * 0.7).sin() + 0.3;
            gradients.derivatives_mut(Attributes::OPACITY).set_row(0, [slope as f32]);
            descent.step(&gradients, 1.0, &RateSchedule::new(steps, 0.05, error));
            mean = 0.9 * mean + 0.1 * slope;
            square = 0.999 * square + 0.001 * slope * slope;
            let t = k as i32 + 1;
            let size = (mean / (1.0 - 0.9f64.powi(t))) / (square / (1.0 - 0.999f64.powi(t))).sqrt();
            let rate = 0.05 * 0.25 * (f64::from(t) / 10.0).min(1.0) * 0.05f64.powf(k as f64 / steps as f64);
            value -= rate * size;
            let got = f64::from(descent.delta().0.opacity_logit.row::<1>(0)[0]);
            assert!((got - value).abs() < 1e-5, "step {k}: got {got}, expected {value}");
        }
    }

    #[test]
    fn extreme_slopes_leave_values_finite() {
        let mut descent = Adam::new(&Gaussians::zeros(4, 0), Attributes::all(), 0, &[false; 4]);
        for slope in [f32::MAX, 1e-38, -f32::MAX, 0.0, 3e20] {
            let mut gradients = Gradients::new(4, Attributes::all(), 0);
            for column in Attributes::all().iter() {
                gradients.derivatives_mut(column).planes_mut().fill(slope);
            }
            descent.step(&gradients, 1.0, &RateSchedule::new(10, 0.05, 1.0));
        }
        let change = descent.delta();
        assert!(
            Attributes::all().iter().all(|column| change
                .0
                .attribute_values(column)
                .planes()
                .iter()
                .all(|x| x.is_finite()))
        );
    }
}
