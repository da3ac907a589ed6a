//! Data that an optimization step reads from scratch files. They do not depend on the parameters that earlier steps
//! change, so they can be read before these steps end.

use crate::render::GridStrides;

use super::linearized::{LinearizedFrames, LinearizedState};
use super::targets::Targets;
use crate::error::Result;

/// Data that an optimization step reads from scratch files.
#[derive(Debug)]
pub(super) struct StepInput {
    /// Index of the target view to which the step fits the parameters.
    pub(super) view: usize,
    /// Colors of the pixels of the target view, as integers of 16 bits ([`Targets::values`]).
    pub(super) target: Vec<u16>,
    /// State of the frame of the target view as [`LinearizedFrames::read_varying`] returns it: without the attributes
    /// that do not vary with time and without the deltas of the optimizers.
    pub(super) frame: LinearizedState,
}

/// Scratch files of optimization steps.
#[derive(Clone, Copy)]
pub(super) struct StepFiles<'a> {
    pub(super) targets: &'a Targets,
    /// Strides of the grid of pixels of training views that are read.
    pub(super) strides: GridStrides,
    /// Indices of the frames of the target views, increasing.
    pub(super) frames: &'a [usize],
    /// State of each frame in `frames`.
    pub(super) linearized: &'a LinearizedFrames,
}

impl StepInput {
    /// Reads the data of an optimization step on target view `view`. The buffers of `frame` are reused; its content has
    /// no meaning.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn read(files: StepFiles<'_>, view: usize, mut frame: LinearizedState) -> Result<StepInput> {
        let target = files.targets.values(view, files.strides)?;
        files.linearized.read_varying(files.frame_index(view), &mut frame)?;
        Ok(StepInput { view, target, frame })
    }
}

impl StepFiles<'_> {
    /// Returns the index in `self.frames` of the frame of target view `view`.
    pub(super) fn frame_index(&self, view: usize) -> usize {
        self.frames.binary_search(&self.targets.views[view].frame).unwrap_or_default()
    }
}
