//! Stages of the pipeline that call on several topics; those of one topic are in its folder (`pruning`, `refinement`).

pub mod archive;
pub(crate) mod bands;
pub(crate) mod bounds;
pub(crate) mod choose;
pub(crate) mod degree;
pub(crate) mod field;
pub mod measure;
pub(crate) mod merge;
pub(crate) mod reference_views;
pub(crate) mod scan;
pub mod write;
