//! Trajectory magnitude D (how far a Gaussian moves per frame) and curvature κ (how much its motion turns or
//! accelerates), accumulated frame by frame from positions x(t) at frames t.
//!
//! [`recipe::MotionParams`] selects between two definitions:
//!
//! | | `Literal` (the paper) | `Runs` |
//! |---|---|---|
//! | the step into frame t counts if | t alive, t > 0 | t − 1 and t alive |
//! | D | √(Σ‖x(t) − x(t−1)‖² / life span) | √(mean ‖v(t)‖²) |
//! | the turn about frame t counts if | t alive, but not the first or last alive frame | t − 1, t and t + 1 alive |
//! | κ | Σ‖x(t+1) − 2x(t) + x(t−1)‖ / (life span − 2) | mean ‖v(t+1) − v(t)‖ / (½·(h(t) + h(t+1))) |
//!
//! Frames are numbered from 0. "t alive" means that the Gaussian is alive (opacity ≥ alpha_min) in frame t; the life
//! span is the number of such frames. Sums and means are over the steps or turns that count. h(t) is the time from
//! frame t − 1 to frame t, divided by the mean of these times. v(t) = (x(t) − x(t−1)) / h(t) is the velocity.
//!
//! The previous two positions are stored as received (f32), and all arithmetic is f64. If velocities were rounded to
//! f32, κ would have a relative error of 1e-4.

use std::mem::size_of;

use crate::model::AttributeValues;
use crate::recipe;

/// Bit in the history of a Gaussian: it was alive (opacity ≥ alpha_min) in the previous frame.
const ALIVE: u8 = 1;
/// Bit in the history of a Gaussian: it was alive (opacity ≥ alpha_min) in the frame before the previous one.
const ALIVE_BEFORE: u8 = 2;
/// Bit in the history of a Gaussian: it was alive (opacity ≥ alpha_min) in some frame before the previous one.
const BORN_BEFORE: u8 = 4;

/// Running sums over the frames added so far. The trajectory magnitude D and the curvature κ of a block of Gaussians
/// are computed from these sums.
pub(super) struct MotionSums {
    kind: recipe::MotionParams,
    frames: u32,
    /// Number of frames after the first whose opacities equal those of the first frame. They are not counted in
    /// `steps`, `turns` and `history` yet. The same Gaussians are alive in all of them (opacity ≥ alpha_min), so they
    /// are counted together later. Used only by `MotionParams::Runs`.
    steady: u32,
    /// Positions in the previous frame, x(t−1). The field `before` holds the positions one frame earlier, x(t−2). Shape
    /// `[3, len]` each.
    previous: AttributeValues,
    before: AttributeValues,
    sum_step2: Vec<f64>,
    sum_turn: Vec<f64>,
    /// Length of the turn (second difference of the position) about the last frame in which the Gaussian was alive
    /// (opacity ≥ alpha_min). It is added to `sum_turn` only if the Gaussian is alive in a later frame. Used only by
    /// `MotionParams::Literal`.
    pending: Vec<f64>,
    /// Number of steps (changes of position from frame to frame) whose squares are summed in `sum_step2`. The field
    /// `turns` counts the turns (second differences of position) summed in `sum_turn`. Used only by
    /// `MotionParams::Runs`; `MotionParams::Literal` divides by numbers that follow from the life span instead.
    steps: Vec<u32>,
    turns: Vec<u32>,
    history: Vec<u8>,
}

impl MotionSums {
    pub(super) const BYTES_PER_GAUSSIAN: usize =
        6 * size_of::<f32>() + 3 * size_of::<f64>() + 2 * size_of::<u32>() + size_of::<u8>();

    pub(super) fn new(len: usize, kind: recipe::MotionParams) -> Self {
        MotionSums {
            kind,
            frames: 0,
            steady: 0,
            previous: AttributeValues::zeros(3, len),
            before: AttributeValues::zeros(3, len),
            sum_step2: vec![0.0; len],
            sum_turn: vec![0.0; len],
            pending: vec![0.0; len],
            steps: vec![0; len],
            turns: vec![0; len],
            history: vec![0; len],
        }
    }

    /// Adds the next frame to the sums.
    ///
    /// - `position`: positions of the Gaussians, `[3, len]`.
    /// - `opacity`: their opacities. A Gaussian is alive if its opacity is at least `alpha_min`.
    /// - `steps`: duration of the time step into this frame, then of the time step before it, each divided by the mean
    ///   duration of a step.
    /// - `steady`: whether the opacities have been the same in every frame so far, this one included.
    #[inline(always)]
    pub(super) fn add_frame(
        &mut self,
        position: &AttributeValues,
        opacity: &[f64],
        alpha_min: f64,
        steps: [f64; 2],
        steady: bool,
    ) {
        let even = steps == [1.0; 2];
        match self.kind {
            recipe::MotionParams::Runs if steady && even => self.add_steady_frame::<true>(position, steps),
            recipe::MotionParams::Runs if steady => self.add_steady_frame::<false>(position, steps),
            recipe::MotionParams::Runs if even => self.add_frame_of_runs::<true>(position, opacity, alpha_min, steps),
            recipe::MotionParams::Runs => self.add_frame_of_runs::<false>(position, opacity, alpha_min, steps),
            recipe::MotionParams::Literal => self.add_frame_of_literal(position, opacity, alpha_min),
        }
        std::mem::swap(&mut self.previous, &mut self.before);
        self.previous.planes_mut().copy_from_slice(position.planes());
        self.frames += 1;
    }

    /// Adds the next frame by the definition `Runs` of motion: a step counts only if the Gaussian is alive in both of
    /// its frames.
    ///
    /// The arguments are those of [`MotionSums::add_frame`]. `EVEN` states that both durations in `steps` are 1. The
    /// divisions by them, which would take longer than the rest of the loop, are then left out.
    #[inline(always)]
    fn add_frame_of_runs<const EVEN: bool>(
        &mut self,
        position: &AttributeValues,
        opacity: &[f64],
        alpha_min: f64,
        steps: [f64; 2],
    ) {
        self.count_steady_frames();
        let n = opacity.len();
        let [x, previous, before] = [position, &self.previous, &self.before].map(|column| planes(column, n));
        let (sum_step2, sum_turn) = (&mut self.sum_step2[..n], &mut self.sum_turn[..n]);
        let (step_count, turn_count) = (&mut self.steps[..n], &mut self.turns[..n]);
        let history = &mut self.history[..n];
        for i in 0..n {
            let alive = opacity[i] >= alpha_min;
            let stepped = alive & (history[i] & ALIVE != 0);
            let turned = stepped & (history[i] & ALIVE_BEFORE != 0);
            let (step2, turn) = differences::<EVEN>([row(x, i), row(previous, i), row(before, i)], steps);
            sum_step2[i] += if stepped { step2 } else { 0.0 };
            sum_turn[i] += if turned { turn } else { 0.0 };
            step_count[i] += u32::from(stepped);
            turn_count[i] += u32::from(turned);
            history[i] = next_history(history[i], alive);
        }
    }

    /// Adds the next frame with the result of [`MotionSums::add_frame_of_runs`], for a frame whose opacities equal
    /// those of all earlier frames. The same Gaussians are then alive in all frames, so the history of each Gaussian is
    /// not needed, and half as much memory is accessed (`cargo bench --bench scan`).
    #[inline(always)]
    fn add_steady_frame<const EVEN: bool>(&mut self, position: &AttributeValues, steps: [f64; 2]) {
        self.steady += 1;
        let n = self.history.len();
        let [x, previous, before] = [position, &self.previous, &self.before].map(|column| planes(column, n));
        let (sum_step2, sum_turn) = (&mut self.sum_step2[..n], &mut self.sum_turn[..n]);
        let turned = self.frames >= 2;
        for i in 0..n {
            let (step2, turn) = differences::<EVEN>([row(x, i), row(previous, i), row(before, i)], steps);
            sum_step2[i] += step2;
            sum_turn[i] += if turned { turn } else { 0.0 };
        }
    }

    /// Counts the frames in `steady`, in which no opacity has changed. Each Gaussian that is alive (opacity ≥
    /// alpha_min) in them gets one more step per frame, and one more turn per frame but the first. The other Gaussians
    /// have not been alive in any frame yet, so their sums over steps and turns are set to 0. Must be called before
    /// results are read.
    #[inline(always)]
    pub(super) fn count_steady_frames(&mut self) {
        if self.steady == 0 {
            return;
        }
        // Such frames directly follow the first frame, so the first of them completes a step but no turn.
        for (i, history) in self.history.iter_mut().enumerate() {
            if *history & ALIVE == 0 {
                (self.sum_step2[i], self.sum_turn[i]) = (0.0, 0.0);
                continue;
            }
            self.steps[i] += self.steady;
            self.turns[i] += self.steady - 1;
            *history = ALIVE | ALIVE_BEFORE | BORN_BEFORE;
        }
        self.steady = 0;
    }

    #[inline(always)]
    fn add_frame_of_literal(&mut self, position: &AttributeValues, opacity: &[f64], alpha_min: f64) {
        let n = opacity.len();
        let [x, previous, before] = [position, &self.previous, &self.before].map(|column| planes(column, n));
        let (sum_step2, sum_turn) = (&mut self.sum_step2[..n], &mut self.sum_turn[..n]);
        let (pending, history) = (&mut self.pending[..n], &mut self.history[..n]);
        let first = self.frames == 0;
        for i in 0..n {
            let alive = opacity[i] >= alpha_min;
            let (step2, turn) = differences::<true>([row(x, i), row(previous, i), row(before, i)], [1.0; 2]);
            // The turn about the previous frame counts if the Gaussian was alive in it and it is not the first such
            // frame.
            let center = (history[i] & ALIVE != 0) & (history[i] & BORN_BEFORE != 0);
            let waiting = if center { turn } else { pending[i] };
            // The Gaussian is alive now, so the frame whose turn is pending was not the last frame in which it was
            // alive.
            sum_turn[i] += if alive { waiting } else { 0.0 };
            pending[i] = if alive { 0.0 } else { waiting };
            sum_step2[i] += if alive & !first { step2 } else { 0.0 };
            history[i] = next_history(history[i], alive);
        }
    }

    /// Returns the trajectory magnitude D of every Gaussian: the root mean square of its steps (changes of position
    /// from frame to frame), in scene units per frame. A step counts only if the Gaussian is alive (opacity ≥
    /// alpha_min) in the second of its frames and, with the definition `Runs`, also in the first. D is 0 if no step
    /// counts. `life` holds the number of frames in which each Gaussian is alive; the definition `Literal` divides by
    /// it.
    pub(super) fn magnitude(&self, life: &[u32]) -> Vec<f64> {
        let terms = |i: usize| if self.is_literal() { life[i] } else { self.steps[i] };
        (0..life.len()).map(|i| (self.sum_step2[i] / f64::from(terms(i).max(1))).sqrt()).collect()
    }

    /// Returns the curvature κ of every Gaussian: the mean length of its turns (second differences of its positions),
    /// in scene units per frame². A turn about a frame counts only if the Gaussian is alive (opacity ≥ alpha_min) in
    /// this frame; the table in the module documentation has further conditions. κ is 0 if no turn counts. `life` holds
    /// the number of frames in which each Gaussian is alive; the definition `Literal` divides by `life` − 2.
    pub(super) fn curvature(&self, life: &[u32]) -> Vec<f64> {
        let terms = |i: usize| if self.is_literal() { life[i].saturating_sub(2) } else { self.turns[i] };
        (0..life.len()).map(|i| self.sum_turn[i] / f64::from(terms(i).max(1))).collect()
    }

    fn is_literal(&self) -> bool {
        self.kind == recipe::MotionParams::Literal
    }

    #[cfg(test)]
    pub(super) fn resident_bytes(&self) -> usize {
        let MotionSums {
            kind: _,
            frames: _,
            steady: _,
            previous,
            before,
            sum_step2,
            sum_turn,
            pending,
            steps,
            turns,
            history,
        } = self;
        [previous, before].into_iter().map(|column| size_of_val(column.planes())).sum::<usize>()
            + [sum_step2, sum_turn, pending].into_iter().map(|sums| size_of_val(&sums[..])).sum::<usize>()
            + [steps, turns].into_iter().map(|counts| size_of_val(&counts[..])).sum::<usize>()
            + size_of_val(&history[..])
    }
}

/// Returns the planes of x, y and z values of `column`, each as a slice of `n` values. The compiler sees that their
/// lengths are equal, and so removes the bounds checks.
#[inline(always)]
fn planes(column: &AttributeValues, n: usize) -> [&[f32]; 3] {
    std::array::from_fn(|axis| &column.plane(axis)[..n])
}

/// Returns the position of Gaussian `i`. Written without `map` on an array, which would remain a function call in
/// functions compiled for other target features.
#[inline(always)]
fn row([x, y, z]: [&[f32]; 3], i: usize) -> [f32; 3] {
    [x[i], y[i], z[i]]
}

/// Returns two values of one Gaussian: the squared length of its last step (change of position), and the length of its
/// turn (second difference of the positions) about the previous frame. Both are scaled to time steps of the mean
/// duration.
///
/// `now`, `previous` and `before` are its positions in the current frame and in the two frames before it. `step` and
/// `step_before` are the durations of the last two time steps, divided by the mean duration; `EVEN` states that both
/// are 1. The step is meaningless in the first frame, and the turn in the first two frames.
#[inline(always)]
fn differences<const EVEN: bool>([now, previous, before]: [[f32; 3]; 3], [step, step_before]: [f64; 2]) -> (f64, f64) {
    let (mut step2, mut turn2) = (0.0, 0.0);
    for axis in 0..3 {
        let middle = f64::from(previous[axis]);
        let mut velocity = f64::from(now[axis]) - middle;
        let mut velocity_before = middle - f64::from(before[axis]);
        if !EVEN {
            velocity /= step;
            velocity_before /= step_before;
        }
        let mut turn = velocity - velocity_before;
        if !EVEN {
            turn /= 0.5 * (step + step_before);
        }
        step2 += velocity * velocity;
        turn2 += turn * turn;
    }
    (step2, turn2.sqrt())
}

/// Returns the history bits of a Gaussian that are needed in the next frame. `history` holds the bits that were needed
/// in the current frame, and `alive` says whether the Gaussian is alive in the current frame.
#[inline(always)]
fn next_history(history: u8, alive: bool) -> u8 {
    let now = if alive { ALIVE } else { 0 };
    let before = if history & ALIVE != 0 { ALIVE_BEFORE | BORN_BEFORE } else { 0 };
    now | before | (history & BORN_BEFORE)
}
