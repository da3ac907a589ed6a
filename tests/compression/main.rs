//! Tests of compressed models: which Gaussians the stages keep, merge and refine, and how the result is written.

mod archive;
mod bands;
mod bounded;
mod compress;
mod families;
mod frame_streams;
mod goals;
mod half_field;
mod linked;
mod merging;
mod model_families;
mod precision;
mod refine;
#[path = "../scene/mod.rs"]
mod scene;
mod selection;
mod sweep;
mod tracked_inputs;
mod trained_models;
