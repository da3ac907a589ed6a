//! Stages of a run, one file each, listed in [`STAGES`] in the order in which they run. Their computations are in the
//! modules of their topics (`statistics`, `pruning`, `merging`, `refinement`, `archive`).

pub mod archive;
mod archive_grids;
mod archive_refinement;
pub(crate) mod bands;
pub(crate) mod bounds;
pub(crate) mod choose;
pub(crate) mod degree;
pub(crate) mod field;
pub mod measure;
pub(crate) mod merge;
pub(crate) mod photographs;
pub(crate) mod prune;
pub(crate) mod quality;
mod quantizer;
pub(crate) mod reference_views;
pub(crate) mod refine;
pub(crate) mod rounds;
pub(crate) mod scan;
pub(crate) mod size;
pub(crate) mod track;
pub mod write;

use super::planning::Planning;
use super::stage::StageList;

/// Function that adds a stage to the list of a run if the request needs it, or records the reason why the run omits it.
pub(super) type PlanStage = fn(&Planning<'_>, &mut StageList);

/// Functions that add the stages to a plan, in the order in which the stages run.
pub(super) const STAGES: &[PlanStage] = &[
    measure::plan,
    size::plan_count,
    rounds::plan,
    degree::plan,
    prune::plan,
    merge::plan,
    choose::plan,
    refine::plan,
    photographs::plan,
    field::plan,
    bands::plan,
    size::plan_shrink,
    archive::plan,
    quality::plan,
    write::plan,
    // Called by the stage that writes the output.
    quality::plan_for_output,
];
