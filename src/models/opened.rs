//! Result of opening an input: a model, or frames whose Gaussians have to be linked first.

use std::path::Path;

use super::linked::UnlinkedFrames;
use crate::error::Result;
use crate::models::input_model::{FoundInput, InputModel, ModelFormat, OpenOptions, TimeOrigin};

/// Opened input.
pub enum Opened {
    /// Model or sequence of frames that identifies each Gaussian across frames.
    Model(Box<dyn InputModel>),
    /// Frames whose Gaussians have to be linked into tracks (Gaussians followed through frames) before they can be used.
    Unlinked(Box<UnlinkedFrames>),
}

impl Opened {
    /// Returns the model, or `None` if the input consists of frames that are not linked yet.
    pub fn model(&self) -> Option<&dyn InputModel> {
        match self {
            Opened::Model(model) => Some(&**model),
            Opened::Unlinked(_) => None,
        }
    }

    /// Returns the input as one of another format: `wrap` is called with the model, after linking if that is needed, and
    /// returns the model of the other format.
    pub(super) fn wrapped(
        self,
        wrap: impl FnOnce(Box<dyn InputModel>) -> Box<dyn InputModel> + Send + Sync + 'static,
    ) -> Opened {
        match self {
            Opened::Model(model) => Opened::Model(wrap(model)),
            Opened::Unlinked(frames) => Opened::Unlinked(Box::new(frames.wrapped(wrap))),
        }
    }

    /// Returns where the time stamps of frames come from.
    pub fn timing(&self) -> TimeOrigin {
        match self {
            Opened::Model(model) => model.timing(),
            Opened::Unlinked(frames) => frames.timing(),
        }
    }

    /// Returns the time stamps of the frames. Empty for a model that is continuous in time and has no frames yet.
    pub fn times(&self) -> Vec<f64> {
        match self {
            Opened::Model(model) => model.source().info().times.clone(),
            Opened::Unlinked(frames) => frames.times(),
        }
    }

    /// Returns the model. Frames that are not linked yet are linked first, which reads all of them twice and renders
    /// some ([`UnlinkedFrames::link`]).
    ///
    /// # Errors
    /// Fails if the frames cannot be linked.
    pub fn into_linked(self) -> Result<Box<dyn InputModel>> {
        match self {
            Opened::Model(model) => Ok(model),
            Opened::Unlinked(frames) => frames.link(),
        }
    }
}

/// Format of frames that may have to be linked.
pub(super) type FrameFormat = ModelFormat<Opened>;

/// Format that is read from files.
pub(super) enum InputFormat {
    /// Format of models. They tell which Gaussian is which at every frame.
    Model(ModelFormat),
    /// Format of frames. They may have to be linked.
    Frames(FrameFormat),
}

impl InputFormat {
    /// Returns whether the input `found` has this format.
    pub(super) fn recognizes(&self, found: &FoundInput) -> bool {
        match self {
            InputFormat::Model(format) => (format.recognizes)(found),
            InputFormat::Frames(format) => (format.recognizes)(found),
        }
    }

    /// Opens the input at `path`, which has this format.
    ///
    /// # Errors
    /// Fails if a file is damaged, or if an option does not apply to the format.
    pub(super) fn open(&self, path: &Path, options: &OpenOptions) -> Result<Opened> {
        match self {
            InputFormat::Model(format) => (format.open)(path, options).map(Opened::Model),
            InputFormat::Frames(format) => (format.open)(path, options),
        }
    }
}
