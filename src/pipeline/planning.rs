//! Information from which the stages of a run are planned: the request of the user, and facts about the input model.

use super::request::{Goal, Request};
use crate::models::trajectories::DEFAULT_OUTPUT;
use crate::outputs::kind::OutputKind;
use crate::pruning::score::UserOverrides;
use crate::recipe::ShDegreeRule;
use crate::refinement::RefineStage;
use crate::scene::Scene;

/// Facts about a scene that are known before its frames are read.
#[derive(Debug, Clone, Copy)]
pub struct InputMeta {
    /// Number of Gaussians in the scene, N.
    pub gaussians: usize,
    /// Whether the scene has cameras of its own; `false` if the program places virtual ones.
    pub has_cameras: bool,
    /// Whether an archive of the result stores the Gaussians at every frame instead of a model.
    pub archives_as_frames: bool,
    /// Kind of output that is written if neither the user nor the name of the output determines one.
    pub default_output_kind: OutputKind,
}

impl InputMeta {
    /// Returns the facts about the open scene `scene` that are known before its frames are read.
    pub fn from_scene(scene: &Scene) -> InputMeta {
        InputMeta {
            gaussians: scene.source().info().count,
            has_cameras: scene.has_cameras,
            archives_as_frames: scene.input.description().archives_as_frames,
            default_output_kind: scene.input.description().default_output_kind,
        }
    }

    /// Returns the facts about a stream of frames of `gaussians` Gaussians.
    pub fn from_stream(gaussians: usize, has_cameras: bool) -> InputMeta {
        InputMeta { gaussians, has_cameras, archives_as_frames: true, default_output_kind: DEFAULT_OUTPUT }
    }
}

/// Information from which the stages of a run are planned: the request of the user, facts about the input, and
/// decisions that several stages depend on.
pub struct Planning<'a> {
    /// Request of the user.
    pub request: &'a Request,
    /// Facts about the input that are known before its frames are read.
    pub input: InputMeta,
    /// Kind of output that is written.
    pub output: OutputKind,
    /// Exact number of Gaussians in the output, if requested.
    pub target: Option<usize>,
    /// Gaussians that the user keeps or drops, by ids and boxes.
    pub user: UserOverrides,
    /// Whether views of the scene are rendered to measure the contribution of every Gaussian.
    pub renders_views: bool,
    /// Whether Gaussians are pruned by rank, in addition to those that the user drops.
    pub prunes: bool,
    /// Whether survivors (Gaussians that are not removed) are merged.
    pub merges: bool,
    /// Refinement stage, which fits the survivors (Gaussians left by pruning) to renders of the original; `None` if
    /// nothing is refined.
    pub refine: Option<RefineStage>,
    /// Whether the quality of the result is measured.
    pub measures_quality: bool,
    /// Whether there is memory to refine the result for the quantization of its archive.
    pub refines_archive: bool,
    /// Parts of refinement that are omitted to stay within the memory limit (`--memory`).
    pub(super) fallback: MemoryFallback,
}

impl Planning<'_> {
    /// Returns the requested number of Gaussians divided by the number of Gaussians in the input; `None` if no number
    /// was requested.
    pub fn target_fraction(&self) -> Option<f64> {
        self.target.map(|target| target as f64 / self.input.gaussians.max(1) as f64)
    }

    /// Returns whether the run chooses the SH degree for a requested size on disk. It then refines, for each degree, as
    /// many Gaussians as fit the size, and takes the degree with the best quality.
    pub fn chooses_sh_degree(&self) -> bool {
        let has_byte_limit = matches!(self.request.goal, Some(Goal::Bytes(_)));
        has_byte_limit && self.refine.is_some() && self.request.recipe.bands.bands == ShDegreeRule::Needed
    }

    /// Returns whether the run searches for the smallest model with a requested quality.
    pub fn searches(&self) -> bool {
        matches!(self.request.goal, Some(Goal::Quality(_)))
    }

    /// Returns whether Gaussians are pruned in the order of a ranking that is measured on rendered views.
    pub fn prunes_by_views(&self) -> bool {
        self.renders_views && self.prunes
    }
}

/// Optional work that a run does if there is memory for it.
#[derive(Debug, Clone, Copy)]
pub(super) struct OptionalWork {
    /// Measurement of the quality of the result.
    pub(super) quality: bool,
    /// Refinement of the result for the quantization of its archive.
    pub(super) archive_refinement: bool,
}

impl OptionalWork {
    /// All optional work.
    pub(super) const ALL: OptionalWork = OptionalWork { quality: true, archive_refinement: true };
    /// No optional work.
    pub(super) const NONE: OptionalWork = OptionalWork { quality: false, archive_refinement: false };
}

/// Parts of refinement that are omitted because they do not fit within the memory limit (`--memory`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum MemoryFallback {
    /// Full refinement; no part is omitted.
    #[default]
    Nothing,
    /// Refinement that begins with fewer Gaussians.
    SmallStart {
        /// Smallest memory limit, bytes, with which refinement would begin with more Gaussians.
        required_bytes: u64,
    },
    /// Refinement that also has no time-varying deltas: the values that it adds to stored parameters are constant in
    /// time.
    ConstantInTime {
        /// Smallest memory limit, bytes, with which refinement would also add values that vary in time.
        required_bytes: u64,
    },
    /// Refinement that also leaves out SH coefficients above degree 0.
    WithoutHarmonics {
        /// Smallest memory limit, bytes, with which SH coefficients above degree 0 would be refined.
        required_bytes: u64,
    },
    /// No refinement.
    WithoutRefinement {
        /// Smallest memory limit, bytes, with which at least a part of refinement would run.
        required_bytes: u64,
    },
}

impl MemoryFallback {
    /// Returns the names of the omitted parts of refinement, each with the smallest memory limit, bytes, with which it
    /// would be included. Leaves out that refinement begins with fewer Gaussians, because this depends on the target.
    pub(super) fn left_out(self) -> Vec<(&'static str, u64)> {
        match self {
            MemoryFallback::Nothing | MemoryFallback::SmallStart { .. } => Vec::new(),
            MemoryFallback::ConstantInTime { required_bytes } => {
                vec![("time-varying deltas of refinement", required_bytes)]
            }
            MemoryFallback::WithoutHarmonics { required_bytes } => {
                vec![
                    ("time-varying deltas of refinement", required_bytes),
                    ("refinement of SH coefficients above degree 0", required_bytes),
                ]
            }
            MemoryFallback::WithoutRefinement { required_bytes } => vec![("refinement", required_bytes)],
        }
    }
}
