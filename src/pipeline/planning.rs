//! What stages are planned from: the request and the input, as far as several stages depend on them.

use super::request::{Goal, Request};
use crate::outputs::kind::OutputKind;
use crate::pruning::score::UserOverrides;
use crate::recipe::WhichBands;
use crate::refinement::RefineStage;
use crate::scene::Scene;

/// What is known of a scene before its frames are read.
#[derive(Debug, Clone, Copy)]
pub struct InputMeta {
    /// N.
    pub gaussians: usize,
    /// Whether the cameras are the scene's own, not a virtual rig.
    pub has_cameras: bool,
    /// The kind of result to which neither the user nor its name gives one.
    pub own_output: OutputKind,
}

impl InputMeta {
    /// Of an open scene.
    pub fn from_scene(scene: &Scene) -> InputMeta {
        InputMeta {
            gaussians: scene.source().info().count,
            has_cameras: scene.has_cameras,
            own_output: scene.input.own_output(),
        }
    }
}

/// What the stages are planned from: the request as far as several stages depend on it.
pub struct Planning<'a> {
    /// What was asked for.
    pub request: &'a Request,
    /// What is known of the input.
    pub input: InputMeta,
    /// What is written.
    pub output: OutputKind,
    /// Exact number of Gaussians in the output.
    pub target: Option<usize>,
    /// What the user decided about single Gaussians.
    pub user: UserOverrides,
    /// Whether views of the scene are looked at to measure what Gaussians add to them.
    pub looks: bool,
    /// Whether Gaussians are removed that were not asked to be dropped.
    pub prunes: bool,
    /// Whether survivors are merged.
    pub merges: bool,
    /// How what is left is refined.
    pub refine: Option<RefineStage>,
    /// Whether the quality of the result is measured before it is written.
    pub measures_quality: bool,
    /// What refinement goes without for lack of memory.
    pub(super) fallback: MemoryFallback,
}

impl Planning<'_> {
    /// Returns the part of the Gaussians that is asked for.
    pub fn part(&self) -> Option<f64> {
        self.target.map(|target| target as f64 / self.input.gaussians.max(1) as f64)
    }

    /// Returns whether the SH degree is chosen of which most Gaussians fit a size on disk: refinement tells which is best.
    pub fn chooses_degree(&self) -> bool {
        let has_byte_limit = matches!(self.request.goal, Some(Goal::Bytes(_)));
        has_byte_limit && self.refine.is_some() && self.request.recipe.bands.bands == WhichBands::Needed
    }

    /// Returns whether Gaussians are ranked by views of the scene and removed.
    pub fn prunes_by_views(&self) -> bool {
        self.looks && self.prunes
    }
}

/// Parts of refinement that are left out because they do not fit within the memory limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum MemoryFallback {
    /// No part is left out.
    #[default]
    Nothing,
    /// Parameter deltas are constant in time.
    ConstantInTime {
        /// Memory with which deltas could vary in time, bytes.
        required_bytes: u64,
    },
    /// SH coefficients above degree 0 are not refined either.
    WithoutHarmonics {
        /// Memory with which they could be, bytes.
        required_bytes: u64,
    },
    /// Nothing is refined.
    WithoutRefinement {
        /// Memory with which it could be, bytes.
        required_bytes: u64,
    },
}

impl MemoryFallback {
    /// Returns the parts of refinement that are left out, and the memory with which they would not be, bytes.
    pub(super) fn left_out(self) -> Vec<(&'static str, u64)> {
        match self {
            MemoryFallback::Nothing => Vec::new(),
            MemoryFallback::ConstantInTime { required_bytes } => vec![("refining along time", required_bytes)],
            MemoryFallback::WithoutHarmonics { required_bytes } => {
                vec![("refining along time", required_bytes), ("refining of harmonics above the first", required_bytes)]
            }
            MemoryFallback::WithoutRefinement { required_bytes } => vec![("refinement", required_bytes)],
        }
    }
}
