//! Scratch file with the frame states (attributes of all Gaussians at one frame) at the frames of the target views, and
//! with the derivatives of these states with respect to the stored parameters. A frame in which most Gaussians are
//! invisible is stored sparsely: only its visible Gaussians are written.

use std::path::Path;

use crate::cache::{Spill, SpillWriter};
use crate::compressed_model::ParamDelta;
use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian};

/// Opacity logit below which a Gaussian counts as invisible in a frame. Its opacity is below 10⁻¹³ then, so nothing
/// that refinement adds makes it visible.
const ABSENT_LOGIT: f32 = -30.0;
/// Divisor of the number of Gaussians: a frame is stored sparsely (only its visible Gaussians) if at most
/// 1/[`SPARSE_DIVISOR`] of the Gaussians are visible in it.
const SPARSE_DIVISOR: usize = 2;

/// Attributes of the Gaussians at one frame, and their derivatives (Jacobian) with respect to the stored parameters.
#[derive(Debug, Clone, Default)]
pub(super) struct LinearizedState {
    /// Increasing indices, in the model, of the Gaussians in `state` if `state` leaves out invisible Gaussians; `None`
    /// if it holds all Gaussians.
    pub(super) present: Option<Vec<u32>>,
    pub(super) state: Gaussians,
    pub(super) jacobian: Jacobian,
}

impl LinearizedState {
    /// Creates an empty state (no Gaussians) for SH coefficients of degrees up to `sh_degree`.
    pub(super) fn none(sh_degree: usize) -> LinearizedState {
        LinearizedState { present: None, state: Gaussians::zeros(0, sh_degree), jacobian: Jacobian::default() }
    }

    /// Returns the state of only the Gaussians with the indices `places` in the model, which must be increasing. The
    /// result belongs to the smaller model of only these Gaussians, in which the Gaussian `places[i]` has the index i.
    pub(super) fn pick(&self, places: &[u32]) -> LinearizedState {
        let Some(present) = &self.present else { return self.rows(places, None) };
        let stays = |(to, place): (u32, &u32)| Some((present.binary_search(place).ok()? as u32, to));
        let (rows, present): (Vec<u32>, Vec<u32>) = (0..).zip(places).filter_map(stays).unzip();
        self.rows(&rows, Some(present))
    }

    /// Returns a copy with only the visible Gaussians, for sparse storage. Returns `None` if more than
    /// 1/[`SPARSE_DIVISOR`] of the Gaussians are visible, or if this state already leaves out invisible Gaussians.
    fn to_sparse(&self) -> Option<LinearizedState> {
        let logits = self.state.opacity_logit.plane(0);
        let is_present = |&(_, &logit): &(u32, &f32)| logit >= ABSENT_LOGIT;
        let present: Vec<u32> = (0..).zip(logits).filter(is_present).map(|(row, _)| row).collect();
        let is_sparse = self.present.is_none() && SPARSE_DIVISOR * present.len() <= logits.len();
        is_sparse.then(|| self.rows(&present, Some(present.clone())))
    }

    /// Returns a copy with only the Gaussians that have the indices `rows` in this state. The argument `present` is
    /// stored as [`LinearizedState::present`] of the copy: the index of each Gaussian in the model if invisible ones
    /// are left out, otherwise `None`.
    fn rows(&self, rows: &[u32], present: Option<Vec<u32>>) -> LinearizedState {
        LinearizedState { present, state: self.state.pick(rows), jacobian: self.jacobian.pick(rows) }
    }

    /// Returns the arrays that the scratch file stores for every frame: the attributes in `varying`, and the Jacobian.
    fn stored_columns(&mut self, varying: Attributes) -> impl Iterator<Item = &mut AttributeValues> {
        self.state.selected_attribute_values_mut(varying).chain(self.jacobian.derivatives_mut())
    }
}

/// Reader of the scratch file that holds the attributes of the Gaussians, and their derivatives, at each frame of the
/// target views ([`LinearizedState`]). Memory: the state at one frame, and 24 bytes per frame.
#[derive(Debug)]
pub(super) struct LinearizedFrames {
    file: Spill,
    varying: Attributes,
    /// State of all Gaussians at the first frame. Attributes that do not vary with time have these values in all
    /// frames. Of attributes that vary, the other frames have other values, but arrays of the same size (number of
    /// components × number of Gaussians).
    first: Option<LinearizedState>,
    frames: Vec<StoredFrame>,
}

/// Position of a frame in the scratch file. `at`: byte offset. `present`: number of stored Gaussians if invisible ones
/// are left out, otherwise `None`. If Gaussians are left out, the bytes at `at` begin with the indices of the stored
/// Gaussians; their values follow.
#[derive(Debug, Clone, Copy)]
struct StoredFrame {
    at: u64,
    present: Option<usize>,
}

/// Writer of the scratch file that holds the attributes of the Gaussians, and their derivatives, at each frame of the
/// target views ([`LinearizedState`]).
pub(super) struct LinearizedFramesWriter {
    file: SpillWriter,
    varying: Attributes,
    first: Option<LinearizedState>,
    frames: Vec<StoredFrame>,
    end: u64,
}

impl LinearizedFramesWriter {
    /// Creates a writer without frames; the scratch file is created in the folder `scratch`. The attributes `varying`
    /// are stored for every frame, all others for the first frame only.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be created.
    pub(super) fn new(scratch: &Path, varying: Attributes) -> Result<LinearizedFramesWriter> {
        Ok(LinearizedFramesWriter {
            file: SpillWriter::new(scratch)?,
            varying,
            first: None,
            frames: Vec::new(),
            end: 0,
        })
    }

    /// Returns whether no frame has been written yet.
    pub(super) fn is_empty(&self) -> bool {
        self.first.is_none()
    }

    /// Returns the state of the frame that was written first, or `None` if no frame has been written yet.
    pub(super) fn first(&self) -> Option<&LinearizedState> {
        self.first.as_ref()
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.end += bytes.len() as u64;
        self.file.write(bytes)
    }

    /// Appends `next`, the state of the next frame, to the scratch file. All frames but the first are stored sparsely
    /// if few Gaussians are visible in them.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be written.
    pub(super) fn push(&mut self, next: &mut LinearizedState) -> Result<()> {
        let mut to_sparse = if self.is_empty() { None } else { next.to_sparse() };
        self.first.get_or_insert_with(|| next.clone());
        let next = to_sparse.as_mut().unwrap_or(next);
        self.frames.push(StoredFrame { at: self.end, present: next.present.as_ref().map(Vec::len) });
        self.write(bytemuck::cast_slice(next.present.as_deref().unwrap_or_default()))?;
        next.stored_columns(self.varying).try_for_each(|column| self.write(bytemuck::cast_slice(column.planes())))
    }

    /// Finishes the scratch file and returns its reader.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be written.
    pub(super) fn finish(self) -> Result<LinearizedFrames> {
        Ok(LinearizedFrames {
            file: self.file.finish()?,
            varying: self.varying,
            first: self.first,
            frames: self.frames,
        })
    }
}

impl LinearizedFrames {
    /// Returns the state of all Gaussians at the first frame, or `None` if no frame was written.
    pub(super) fn first(&self) -> Option<&LinearizedState> {
        self.first.as_ref()
    }

    /// Reads into `to` what the scratch file holds of frame `k`, counted from 0 in the order in which the frames were
    /// written: the attributes that vary with time, and the derivatives. [`LinearizedFrames::add_change`] then fills in
    /// the other attributes, whose values are unspecified until then.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be read.
    pub(super) fn read_varying(&self, k: usize, to: &mut LinearizedState) -> Result<()> {
        let Some(first) = &self.first else { return Ok(()) };
        let StoredFrame { mut at, present } = self.frames[k];
        let mut read = |values: &mut [u8]| {
            at += values.len() as u64;
            self.file.read(at - values.len() as u64, values)
        };
        to.present = present.map(|count| vec![0; count]);
        read(bytemuck::cast_slice_mut(to.present.as_deref_mut().unwrap_or_default()))?;
        let shape = |to: &mut AttributeValues, of: &AttributeValues| {
            if to.width() != of.width() {
                *to = AttributeValues::zeros(of.width(), 0);
            }
            to.resize(if of.is_empty() { 0 } else { present.unwrap_or(of.len()) });
        };
        for column in Attributes::all().iter() {
            shape(to.state.attribute_values_mut(column), first.state.attribute_values(column));
        }
        to.jacobian.derivatives_mut().iter_mut().zip(first.jacobian.derivatives()).for_each(|(to, of)| shape(to, of));
        to.stored_columns(self.varying).try_for_each(|column| read(bytemuck::cast_slice_mut(column.planes_mut())))
    }

    /// Completes `to`, a result of [`LinearizedFrames::read_varying`] that was not completed before: fills in the
    /// attributes that do not vary with time, and adds to all attributes their change to first order if the stored
    /// parameters of the model change by `change`.
    pub(super) fn add_change(&self, change: &ParamDelta, to: &mut LinearizedState) {
        let Some(first) = &self.first else { return };
        let LinearizedState { present, state, jacobian } = to;
        let picked = present.as_ref().map(|present| change.pick(present));
        let change = &picked.as_ref().unwrap_or(change).0;
        let mut remaining = Attributes::all();
        for column in Attributes::all().difference(self.varying).iter() {
            let (from, to) = (first.state.attribute_values(column), state.attribute_values_mut(column));
            match present {
                Some(present) => *to = from.pick(present),
                // The derivative is the identity. One pass over memory instead of a copy and `add_to`, because most
                // values are SH coefficients, which do not vary.
                None if jacobian.derivative(column).width() == 0 => {
                    remaining = remaining.difference(column);
                    // Planes after the end of `delta` are SH coefficients of degrees that refinement does not change.
                    let delta = change.attribute_values(column).planes();
                    let (changed, unchanged) = to.planes_mut().split_at_mut(delta.len());
                    let (changed_from, unchanged_from) = from.planes().split_at(delta.len());
                    changed.iter_mut().zip(changed_from).zip(delta).for_each(|((to, from), by)| *to = from + by);
                    unchanged.copy_from_slice(unchanged_from);
                }
                None => to.planes_mut().copy_from_slice(from.planes()),
            }
        }
        jacobian.add_to(change, remaining, state);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates a test state of `len` Gaussians whose position values count up from 0. Only the Gaussians with the
    /// indices `present` are visible.
    fn linearized_state(len: usize, present: &[usize]) -> LinearizedState {
        let mut linearized_state = LinearizedState { state: Gaussians::zeros(len, 0), ..LinearizedState::default() };
        linearized_state.state.position.planes_mut().iter_mut().zip(0..).for_each(|(x, k)| *x = k as f32);
        linearized_state.state.opacity_logit.planes_mut().fill(-40.0);
        present.iter().for_each(|&row| linearized_state.state.opacity_logit.plane_mut(0)[row] = 1.0);
        *linearized_state.jacobian.derivative_mut(Attributes::OPACITY) =
            AttributeValues::from_planes(1, (0..len).map(|k| k as f32).collect());
        linearized_state
    }

    #[test]
    fn frames_after_the_first_are_stored_sparsely() {
        let folder = tempfile::tempdir().unwrap();
        let varying = Attributes::POSITION | Attributes::OPACITY;
        let mut keeping = LinearizedFramesWriter::new(folder.path(), varying).unwrap();
        let mut pushed = [
            linearized_state(6, &[1]),
            linearized_state(6, &[1, 4]),
            linearized_state(6, &[]),
            linearized_state(6, &[0, 1, 2, 5]),
            linearized_state(6, &[3]),
        ];
        pushed[0].state.log_scale.planes_mut().iter_mut().zip(0..).for_each(|(x, k)| *x = k as f32);
        pushed.iter_mut().for_each(|linearized_state| keeping.push(linearized_state).unwrap());
        let linearized = keeping.finish().unwrap();
        let mut read = LinearizedState::none(0);
        let change =
            ParamDelta(Gaussians { log_scale: AttributeValues::from_planes(3, vec![0.5; 18]), ..Gaussians::default() });
        for (k, present) in [(4, Some(vec![3])), (0, None), (1, Some(vec![1, 4])), (2, Some(vec![])), (3, None)] {
            linearized.read_varying(k, &mut read).unwrap();
            linearized.add_change(&change, &mut read);
            assert_eq!(read.present, present, "frame {k}");
            let rows = present.unwrap_or_else(|| (0..6).collect());
            let expected = &pushed[k];
            assert_eq!(read.state.position, expected.state.position.pick(&rows));
            assert_eq!(read.state.opacity_logit, expected.state.opacity_logit.pick(&rows));
            assert_eq!(read.jacobian, expected.jacobian.pick(&rows));
            // Attributes that do not vary with time come from the first frame.
            let mut log_scale = pushed[0].state.log_scale.pick(&rows);
            log_scale.planes_mut().iter_mut().for_each(|x| *x += 0.5);
            assert_eq!(read.state.log_scale, log_scale);
        }
        let stored_columns = [6, 2, 0, 6, 1].into_iter().map(|rows| 4 * rows * (3 + 1 + 1)).sum::<u64>() + 4 * (2 + 1);
        assert_eq!(linearized.frames[4].at + 4 + 4 * 5, stored_columns);
    }

    #[test]
    fn picked_gaussians_are_found_at_their_new_rows() {
        let whole = linearized_state(8, &[1, 4, 6]);
        let picked = [0, 1, 5, 6, 7];
        let (from_sparse, from_all) = (whole.to_sparse().unwrap().pick(&picked), whole.pick(&picked));
        assert_eq!((from_sparse.present.as_deref(), from_all.present.as_deref()), (Some(&[1, 3][..]), None));
        assert_eq!(from_sparse.state, from_all.state.pick(&[1, 3]));
        assert_eq!(from_sparse.jacobian, from_all.jacobian.pick(&[1, 3]));
        assert!(linearized_state(4, &[0, 2, 3]).to_sparse().is_none());
    }
}
