//! Descending a gradient: how far what is stored of Gaussians moves, given how a number changes with it.
//!
//! In: derivatives of one picture's loss after another ([`Gradients`]). Out: a [`ParamDelta`] of what is stored. Adam
//! (Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015) with a rate for each group of values and no
//! correction but its own. Memory: [`bytes_per_gaussian`].

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::compressed_model::ParamDelta;
use crate::model::{Column, Columns, Gaussians, Gradients, sh_coefficients};

/// Decay of the means of a derivative and of its square, and what keeps a division from 0.
const BETAS: [f32; 2] = [0.9, 0.999];
/// See [`BETAS`].
const EPSILON: f32 = 1e-15;
/// Steps over which rates grow to their full size: the first means say little.
const WARM_UP: usize = 10;
/// Root mean square error of pictures from which rates are full: what is nearly right must not be shaken.
const FULL_ERROR: f64 = 0.045;

/// How rates change from step to step.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct RateSchedule {
    steps: usize,
    last: f32,
    factor: f32,
}

impl RateSchedule {
    /// Of `steps` steps, down to `last` of the first's rates. `error` is the root mean square error of the pictures at
    /// the start.
    pub fn new(steps: usize, last: f32, error: f64) -> RateSchedule {
        RateSchedule { steps, last, factor: (error / FULL_ERROR).min(1.0) as f32 }
    }

    /// With rates that are `part` of these.
    pub fn times(self, part: f32) -> RateSchedule {
        RateSchedule { factor: part * self.factor, ..self }
    }

    /// What rates are multiplied by in step `done`.
    fn at(&self, done: usize) -> f32 {
        let [warm, late] = [(done + 1) as f32 / WARM_UP as f32, done as f32 / self.steps.max(1) as f32];
        self.factor * warm.min(1.0) * self.last.powf(late)
    }
}

/// What is stored of Gaussians on its way down.
#[derive(Debug)]
pub struct Descent {
    change: ParamDelta,
    /// Means of the derivatives, and of their squares.
    means: [Gaussians; 2],
    /// `[N]`, by what rates are multiplied: 1, and of positions four hundredths of the mean extent; 0 of what stays.
    reach: [Vec<f32>; 2],
    columns: Columns,
    done: usize,
}

/// Memory of a [`Descent`] and of the derivatives that it follows, for `columns` with harmonics up to `sh_degree`.
pub fn bytes_per_gaussian(columns: Columns, sh_degree: usize) -> usize {
    4 * 4 * columns.width(sh_degree) + 2 * size_of::<f32>()
}

impl Descent {
    /// From `start`, of which the columns `columns` may move, harmonics up to `sh_degree`, but for the Gaussians `fixed`.
    pub fn new(start: &Gaussians, columns: Columns, sh_degree: usize, fixed: &[bool]) -> Descent {
        let mut change = Gaussians::default();
        for column in columns.iter() {
            *change.column_mut(column) = Column::zeros(column.width(sh_degree), start.len());
        }
        let extent = |i: usize| start.log_scale.row::<3>(i).iter().sum::<f32>() / 3.0;
        let free: Vec<f32> = fixed.iter().map(|&fixed| if fixed { 0.0 } else { 1.0 }).collect();
        let of_positions = |(i, free): (usize, &f32)| free * 0.04 * extent(i).clamp(-80.0, 80.0).exp();
        let reach = [free.iter().enumerate().map(of_positions).collect(), free];
        Descent { means: [change.clone(), change.clone()], change: ParamDelta(change), reach, columns, done: 0 }
    }

    /// What is to be added to the start.
    pub fn change(&self) -> &ParamDelta {
        &self.change
    }

    /// Whether anything moved.
    pub fn has_moved(&self) -> bool {
        self.columns.iter().any(|column| self.change.0.column(column).planes().iter().any(|&x| x != 0.0))
    }

    /// What is to be added to the start, which from now on counts as the start's own.
    pub fn take(&mut self) -> ParamDelta {
        let moved = self.change.clone();
        self.change.0.columns_mut(self.columns).for_each(|column| column.planes_mut().fill(0.0));
        moved
    }

    /// Begins anew with `change` already added to the start; columns that it does not have are where they began.
    pub fn restart(&mut self, change: &ParamDelta) {
        self.take();
        for column in (self.columns & change.columns()).iter() {
            self.change.0.column_mut(column).clone_from(change.0.column(column));
        }
        for means in &mut self.means {
            means.columns_mut(self.columns).for_each(|column| column.planes_mut().fill(0.0));
        }
        self.done = 0;
    }

    /// How far it is: the change, the means, and the steps done, from which [`Descent::go_on`] goes on.
    pub fn standing(&self) -> (&ParamDelta, &[Gaussians; 2], usize) {
        (&self.change, &self.means, self.done)
    }

    /// Goes on from where another descent of the same start was.
    pub fn go_on(&mut self, (change, means, done): (ParamDelta, [Gaussians; 2], usize)) {
        (self.change, self.means, self.done) = (change, means, done);
    }

    /// One step against `weight` times `gradients`, at rates of `schedule`.
    ///
    /// # Panics
    /// If they are of other Gaussians or fewer columns.
    pub fn step(&mut self, gradients: &Gradients, weight: f32, schedule: &RateSchedule) {
        let factor = schedule.at(self.done);
        self.done += 1;
        // Of means that began at 0.
        let unbiased = BETAS.map(|beta| 1.0 / (1.0 - beta.powi(self.done as i32)));
        let [of_positions, of_others] = &self.reach;
        let count = of_others.len().max(1);
        let [means, squares] = &mut self.means;
        let moved = means.columns_mut(self.columns).zip(squares.columns_mut(self.columns));
        let moved = self.columns.iter().zip(moved.zip(self.change.0.columns_mut(self.columns)));
        let mut planes = Vec::new();
        for (column, ((means, squares), values)) in moved {
            let reach = if column == Columns::POSITION { of_positions } else { of_others };
            let of = gradients.column(column).planes().chunks_exact(count);
            let own = means.planes_mut().chunks_exact_mut(count).zip(squares.planes_mut().chunks_exact_mut(count));
            let own = own.zip(values.planes_mut().chunks_exact_mut(count)).zip(of).enumerate();
            planes.extend(own.map(|(c, own)| (factor * rate(column, c), reach, own)));
        }
        planes.into_par_iter().for_each(|(rate, reach, (((mean, square), value), slope))| {
            let own = mean.iter_mut().zip(square).zip(value).zip(slope).zip(reach);
            for ((((mean, square), value), &slope), &reach) in own {
                let slope = weight * slope;
                *mean += (1.0 - BETAS[0]) * (slope - *mean);
                *square += (1.0 - BETAS[1]) * (slope * slope - *square);
                let root = (*square * unbiased[1]).sqrt() + EPSILON;
                let next = *value - rate * reach * (*mean * unbiased[0]) / root;
                *value = if next.is_finite() { next } else { *value };
            }
        });
    }
}

/// How far component `c` of `column` moves in a step at first; positions in units of their reach.
fn rate(column: Columns, c: usize) -> f32 {
    match column {
        Columns::POSITION => 1.0,
        Columns::ROTATION => 0.006,
        Columns::SH if c < 3 * sh_coefficients(0) => 0.015,
        Columns::SH => 0.001_25,
        // Log scale and logit.
        _ => 0.05,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Slopes of Σ (value − aim)² / 2 in every column.
    fn slopes(state: &Gaussians, aim: f32) -> Gradients {
        let mut gradients = Gradients::new(state.len(), Columns::all(), 0);
        for column in Columns::all().iter() {
            let values = state.column(column).planes();
            gradients.column_mut(column).planes_mut().iter_mut().zip(values).for_each(|(slope, x)| *slope = x - aim);
        }
        gradients
    }

    #[test]
    fn values_come_to_rest_where_the_slope_is_zero_and_fixed_ones_do_not_move() {
        let start = Gaussians::zeros(3, 0);
        let mut descent = Descent::new(&start, Columns::all(), 0, &[false, true, false]);
        for _ in 0..2000 {
            let mut now = start.clone();
            descent.change().add_to(&mut now, Columns::all());
            descent.step(&slopes(&now, 0.25), 1.0, &RateSchedule::new(2000, 0.05, 1.0));
        }
        let mut end = start.clone();
        descent.change().add_to(&mut end, Columns::all());
        for column in Columns::all().iter() {
            for c in 0..end.column(column).width() {
                let plane = end.column(column).plane(c);
                assert_eq!(plane[1], 0.0);
                assert!((plane[0] - 0.25).abs() < 1e-3 && plane[0] == plane[2], "{column:?} {c}: {plane:?}");
            }
        }
    }

    #[test]
    fn a_step_is_that_of_adam_written_out_in_f64() {
        let start = Gaussians::zeros(1, 0);
        let (steps, error) = (50, 0.009);
        let mut descent = Descent::new(&start, Columns::OPACITY, 0, &[false]);
        let (mut value, mut mean, mut square) = (0.0f64, 0.0f64, 0.0f64);
        for k in 0..steps {
            let mut gradients = Gradients::new(1, Columns::OPACITY, 0);
            let slope = (k as f64 * 0.7).sin() + 0.3;
            gradients.column_mut(Columns::OPACITY).set_row(0, [slope as f32]);
            descent.step(&gradients, 1.0, &RateSchedule::new(steps, 0.05, error));
            mean = 0.9 * mean + 0.1 * slope;
            square = 0.999 * square + 0.001 * slope * slope;
            let t = k as i32 + 1;
            let size = (mean / (1.0 - 0.9f64.powi(t))) / (square / (1.0 - 0.999f64.powi(t))).sqrt();
            let rate = 0.05 * 0.2 * (f64::from(t) / 10.0).min(1.0) * 0.05f64.powf(k as f64 / steps as f64);
            value -= rate * size;
            let got = f64::from(descent.change().0.opacity_logit.row::<1>(0)[0]);
            assert!((got - value).abs() < 1e-5, "step {k}: got {got}, expected {value}");
        }
    }

    #[test]
    fn slopes_of_any_size_leave_every_value_finite() {
        let mut descent = Descent::new(&Gaussians::zeros(4, 0), Columns::all(), 0, &[false; 4]);
        for slope in [f32::MAX, 1e-38, -f32::MAX, 0.0, 3e20] {
            let mut gradients = Gradients::new(4, Columns::all(), 0);
            for column in Columns::all().iter() {
                gradients.column_mut(column).planes_mut().fill(slope);
            }
            descent.step(&gradients, 1.0, &RateSchedule::new(10, 0.05, 1.0));
        }
        let change = descent.change();
        assert!(Columns::all().iter().all(|column| change.0.column(column).planes().iter().all(|x| x.is_finite())));
    }
}
