//! Shrinks trained dynamic (4D) Gaussian-splatting models after training.
//!
//! A run is one pipeline. It opens a model as a [`scene`]; [`statistics`] and scores rank the Gaussians; [`pruning`]
//! and [`merging`] choose which Gaussians stay; [`refinement`] fits them to renders of the original; [`outputs`] and
//! [`models`] write the result. Each folder uses only folders above it in this table; `tests/layers.rs` checks this.
//!
//! | folders | contents |
//! |---|---|
//! | crates `splat-platform`, [`gseq`], `splat-core`, `splat-render`, `splat-fields` | differences between operating systems; the container; Gaussians, cameras and errors ([`model`], [`error`]); the rasterizer and image metrics ([`render`], [`metrics`]); deformation fields ([`deform`]) |
//! | [`limits`], [`machine`], [`recipe`], [`compressed_model`], [`source`] | memory limits, parameters of a run, the compressed model, and the traits by which frames are read |
//! | [`archive`], [`fit`] | the codec of `.gsz` archives; curves fitted to the states of a Gaussian |
//! | [`progress`] | events by which the library reports its work |
//! | [`files`], [`cache`] | file formats, reader beside writer; atomic outputs; cached results of stages |
//! | [`passes`] | driving a pass over frames on all threads |
//! | [`outputs`] | sequences as containers, curves, streams, films and tables |
//! | [`tracking`], [`merging`] | correspondence of Gaussians between frames; merging of similar Gaussians |
//! | [`models`] | one folder per model format: recognize, open, evaluate, write back |
//! | [`memory_plan`], [`statistics`], [`scene`], [`journal`] | the memory plan; statistics and scores; an input with its cameras; what stages record |
//! | [`pruning`], [`refinement`], [`pipeline`] | stages, and the order in which they run |
//! | [`evaluation`], [`commands`], [`report`], [`diagnostics`], [`player`] | quality of a result, the other commands, HTML pages, the self-check and experiments |
//!
//! [`method`] derives the formulas that are implemented.

#![allow(rustdoc::private_intra_doc_links, reason = "comments point to the code that implements them")]
#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout, clippy::disallowed_methods))]

/// Name and version of the program, written into results.
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
/// Derivation of the implemented formulas. Comments in the code cite the sections of this text.
#[doc = include_str!("../docs/method.md")]
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
