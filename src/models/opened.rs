//! Result of opening an input: a model, or frames whose Gaussians have to be linked first.

use std::path::Path;

use super::linked::UnlinkedFrames;
use crate::error::Result;
use crate::models::input_model::{FoundInput, InputModel, OpenOptions, TimeOrigin};

/// Opened input.
pub enum Opened {
    /// Model or sequence of frames that identifies each Gaussian across frames.
    Model(Box<dyn InputModel>),
    /// Frames whose Gaussians have to be linked into tracks (Gaussians followed through frames) before they can be used.
    Unlinked(Box<UnlinkedFrames>),
}

impl Opened {
    /// Creates an opened input from a model, or from frames that identify each Gaussian.
    pub(super) fn from_model(model: impl InputModel + 'static) -> Opened {
        Opened::Model(Box::new(model))
    }

    /// Returns the model, or `None` if the input consists of frames that are not linked yet.
    pub fn model(&self) -> Option<&dyn InputModel> {
        match self {
            Opened::Model(model) => Some(&**model),
            Opened::Unlinked(_) => None,
        }
    }

    /// Returns where the time stamps of frames come from.
    pub fn timing(&self) -> TimeOrigin {
        match self {
            Opened::Model(model) => model.description().timing,
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

/// Function that opens the input at a path. If the model is continuous in time ([`TimeOrigin::Continuous`]), it has no
/// frames until frame times are set.
pub(super) type OpenInput = fn(&Path, &OpenOptions) -> Result<Opened>;

/// Input format: how its files are recognized and opened.
pub(super) struct InputFormat {
    /// Returns whether the input has this format, judged by the content of its files.
    pub(super) recognizes: fn(&FoundInput) -> bool,
    /// Opens the input.
    pub(super) open: OpenInput,
}
