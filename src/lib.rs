//! Shrinks trained dynamic (4D) Gaussian-splatting models after training.
//!
//! The program is one pipeline: a model is opened as a [`scene`], [`statistics`] and scores rank its Gaussians,
//! [`pruning`] and [`merging`] choose which stay, [`refinement`] fits them to renders of the original, and [`outputs`]
//! writes what is left. Each folder uses only folders above it in this table, which `tests/layers.rs` checks.
//!
//! | folders | what is in them |
//! |---|---|
//! | crates `splat-platform`, [`gseq`], `splat-core`, `splat-render`, `splat-fields` | what differs between systems; the container; Gaussians, cameras and errors ([`model`], [`error`]); the rasterizer and image metrics ([`render`], [`metrics`]); deformation fields ([`deform`]) |
//! | [`limits`], [`machine`], [`recipe`], [`compressed_model`], [`source`] | memory limits, parameters of a run, what is left of a model, and how frames are read |
//! | [`archive`], [`fit`] | the codec of `.gsz` archives; curves fitted to the states of a Gaussian |
//! | [`progress`] | the events by which the library tells what it is doing |
//! | [`files`], [`cache`] | file formats, reader beside writer; atomic outputs; results that stages keep |
//! | [`passes`] | driving a pass over frames on all threads |
//! | [`outputs`] | sequences as containers, curves, streams, films and tables |
//! | [`tracking`], [`merging`] | which Gaussian of one frame is which of the next; which Gaussians become one |
//! | [`models`] | one folder per model format: recognize, open, evaluate, write back |
//! | [`memory_plan`], [`statistics`], [`scene`], [`journal`] | the memory plan; statistics and scores; an input with its cameras; what stages record |
//! | [`pruning`], [`refinement`], [`pipeline`] | stages, and the order they run in |
//! | [`evaluation`], [`commands`], [`report`], [`diagnostics`], [`player`] | measuring a result, the other commands, pages for people, the self-check and experiments |
//!
//! [`method`] derives what is computed.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout, clippy::disallowed_methods))]

/// Program and version, by which results name what made them.
pub const TOOL: &str = concat!("splatsieve ", env!("CARGO_PKG_VERSION"));

pub mod archive;
pub mod cache;
pub mod commands;
pub mod compressed_model;
pub mod evaluation;
pub mod files;
pub mod fit;
pub mod journal;
pub mod machine;
pub mod memory_plan;
pub mod merging;
pub mod models;
pub mod outputs;
pub mod passes;
pub mod pipeline;
pub mod progress;
pub mod pruning;
pub mod refinement;
pub mod statistics;
pub mod tracking;
/// How what is computed follows from what is wanted; comments elsewhere cite its sections.
#[doc = include_str!("method.md")]
pub mod method {}
pub mod limits;
pub mod player;
pub mod recipe;
pub mod report;
pub mod scene;
pub mod source;

pub mod diagnostics;

pub use splat_core as model;
pub use splat_core::error;
pub use splat_fields as deform;
pub use splat_render as render;
pub use splat_render::metrics;
