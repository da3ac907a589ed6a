//! Trajectory magnitude D and curvature κ, streamed.
//!
//! | | literal (the paper) | runs |
//! |---|---|---|
//! | a step into t counts | t in life, t not the first frame | t − 1 and t in life |
//! | D | √(Σ‖x(t) − x(t−1)‖² / life) | √(mean ‖x(t) − x(t−1)‖²/h²) |
//! | a turn about t counts | t in life, neither its first nor its last frame | t − 1, t and t + 1 in life |
//! | κ | Σ‖x(t+1) − 2x(t) + x(t−1)‖ / (life − 2) | mean of the second divided difference |
//!
//! h is the step in units of the mean step. The previous two positions are kept as received (f32)
//! and all arithmetic is f64: velocities rounded to f32 would lose 1e-4 of κ.

use std::mem::size_of;

use crate::model::Column;
use crate::recipe;

/// History bit: alive in the previous frame.
const ALIVE: u8 = 1;
/// History bit: alive in the frame before the previous one.
const ALIVE_BEFORE: u8 = 2;
/// History bit: alive in some frame before the previous one.
const BORN_BEFORE: u8 = 4;

/// Running sums of a block.
pub(super) struct Motion {
    kind: recipe::Motion,
    frames: u32,
    /// x(t−1) and x(t−2), `[3, len]` each.
    previous: Column,
    before: Column,
    sum_step2: Vec<f64>,
    sum_turn: Vec<f64>,
    /// Literal only: the turn about a life frame that may yet prove to be the last one.
    pending: Vec<f64>,
    /// Runs only: terms of the two sums; the literal divisors follow from the life span.
    steps: Vec<u32>,
    turns: Vec<u32>,
    history: Vec<u8>,
}

impl Motion {
    pub(super) const BYTES_PER_GAUSSIAN: usize =
        6 * size_of::<f32>() + 3 * size_of::<f64>() + 2 * size_of::<u32>() + size_of::<u8>();

    pub(super) fn new(len: usize, kind: recipe::Motion) -> Self {
        Motion {
            kind,
            frames: 0,
            previous: Column::zeros(3, len),
            before: Column::zeros(3, len),
            sum_step2: vec![0.0; len],
            sum_turn: vec![0.0; len],
            pending: vec![0.0; len],
            steps: vec![0; len],
            turns: vec![0; len],
            history: vec![0; len],
        }
    }

    /// Adds a frame: positions `[3, len]`, opacities, and the durations, in mean steps, of the last
    /// step and of the one before it.
    pub(super) fn frame(&mut self, position: &Column, opacity: &[f64], alpha_min: f64, step: f64, step_before: f64) {
        match self.kind {
            recipe::Motion::Runs => self.frame_of_runs(position, opacity, alpha_min, step, step_before),
            recipe::Motion::Literal => self.frame_of_literal(position, opacity, alpha_min),
        }
        std::mem::swap(&mut self.previous, &mut self.before);
        self.previous.planes_mut().copy_from_slice(position.planes());
        self.frames += 1;
    }

    fn frame_of_runs(&mut self, position: &Column, opacity: &[f64], alpha_min: f64, step: f64, step_before: f64) {
        for (i, &alpha) in opacity.iter().enumerate() {
            let history = self.history[i];
            let alive = alpha >= alpha_min;
            if alive && history & ALIVE != 0 {
                let (last, turn) = self.differences(position, i, step, step_before);
                self.sum_step2[i] += last;
                self.steps[i] += 1;
                if history & ALIVE_BEFORE != 0 {
                    self.sum_turn[i] += turn;
                    self.turns[i] += 1;
                }
            }
            self.history[i] = next(history, alive);
        }
    }

    fn frame_of_literal(&mut self, position: &Column, opacity: &[f64], alpha_min: f64) {
        for (i, &alpha) in opacity.iter().enumerate() {
            let history = self.history[i];
            let alive = alpha >= alpha_min;
            let (last, turn) = self.differences(position, i, 1.0, 1.0);
            // The previous frame is a centre if it lives and is not the first that does.
            if history & ALIVE != 0 && history & BORN_BEFORE != 0 {
                self.pending[i] = turn;
            }
            if alive {
                // Life goes on, so the centre in waiting was not its last frame.
                self.sum_turn[i] += std::mem::take(&mut self.pending[i]);
                if self.frames > 0 {
                    self.sum_step2[i] += last;
                }
            }
            self.history[i] = next(history, alive);
        }
    }

    /// ‖last step‖² and ‖turn about the previous frame‖, per mean step; meaningless where the
    /// history is shorter.
    fn differences(&self, position: &Column, i: usize, step: f64, step_before: f64) -> (f64, f64) {
        let (mut step2, mut turn2) = (0.0, 0.0);
        for axis in 0..3 {
            let x = f64::from(position.plane(axis)[i]);
            let previous = f64::from(self.previous.plane(axis)[i]);
            let before = f64::from(self.before.plane(axis)[i]);
            let velocity = (x - previous) / step;
            let velocity_before = (previous - before) / step_before;
            // Both are 1 for even frames, which leaves x − 2·previous + before.
            let turn = (velocity - velocity_before) / (0.5 * (step + step_before));
            step2 += velocity * velocity;
            turn2 += turn * turn;
        }
        (step2, turn2.sqrt())
    }

    /// D of every Gaussian, given its life frames; 0 where no step counts.
    pub(super) fn magnitude(&self, life: &[u32]) -> Vec<f64> {
        let terms = |i: usize| if self.is_literal() { life[i] } else { self.steps[i] };
        (0..life.len()).map(|i| (self.sum_step2[i] / f64::from(terms(i).max(1))).sqrt()).collect()
    }

    /// κ of every Gaussian, given its life frames; 0 where no turn counts.
    pub(super) fn curvature(&self, life: &[u32]) -> Vec<f64> {
        let terms = |i: usize| if self.is_literal() { life[i].saturating_sub(2) } else { self.turns[i] };
        (0..life.len()).map(|i| self.sum_turn[i] / f64::from(terms(i).max(1))).collect()
    }

    fn is_literal(&self) -> bool {
        self.kind == recipe::Motion::Literal
    }

    #[cfg(test)]
    pub(super) fn resident_bytes(&self) -> usize {
        let Motion { kind: _, frames: _, previous, before, sum_step2, sum_turn, pending, steps, turns, history } = self;
        [previous, before].into_iter().map(|column| size_of_val(column.planes())).sum::<usize>()
            + [sum_step2, sum_turn, pending].into_iter().map(|sums| size_of_val(&sums[..])).sum::<usize>()
            + [steps, turns].into_iter().map(|counts| size_of_val(&counts[..])).sum::<usize>()
            + size_of_val(&history[..])
    }
}

/// History once the current frame has become the previous one.
fn next(history: u8, alive: bool) -> u8 {
    let now = if alive { ALIVE } else { 0 };
    let before = if history & ALIVE != 0 { ALIVE_BEFORE | BORN_BEFORE } else { 0 };
    now | before | (history & BORN_BEFORE)
}
