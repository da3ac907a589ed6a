//! Shrinks trained dynamic (4D) Gaussian-splatting models after training.
//!
//! The program is one pipeline; the modules are its stations, in layers that only look downward:
//!
//! | layer | modules | what lives there |
//! |---|---|---|
//! | L0 | crate [`gseq`] | bytes, columns, tiles |
//! | L1 | [`error`], [`machine`], [`limits`], [`model`], [`recipe`], [`reduction`], [`source`] | the vocabulary |
//! | L2 | [`deform`], [`stats`], [`score`], [`select`], [`merge`], [`link`], [`render`], [`metrics`], [`archive`], [`fit`] | pure mathematics: slices in, values out |
//! | L3 | [`ingest`], [`stream`], [`emit`], [`work`], [`families`], [`demo`], [`player`] | files, threads, terminals |
//! | L4 | [`budget`], [`scene`], [`compress`], [`verbs`], [`report`], [`selfcheck`] | memory, the order of the passes, what verbs do |
//!
//! [`method`] derives what is computed.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout, clippy::disallowed_methods))]

/// Program and version, by which results name what made them.
pub const TOOL: &str = concat!("splatsieve ", env!("CARGO_PKG_VERSION"));

pub mod archive;
pub mod budget;
pub mod compress;
pub mod demo;
pub mod emit;
pub mod families;
pub mod fit;
pub mod ingest;
pub mod machine;
pub mod merge;
/// How what is computed follows from what is wanted; comments elsewhere cite its sections.
#[doc = include_str!("method.md")]
pub mod method {}
pub mod limits;
pub mod link;
pub mod player;
pub mod recipe;
pub mod reduction;
pub mod refine;
pub mod report;
pub mod scene;
pub mod score;
pub mod select;
pub mod selfcheck;
pub mod source;
pub mod stats;
pub mod stream;
pub mod verbs;
pub mod work;

pub use splat_core as model;
pub use splat_core::error;
pub use splat_fields as deform;
pub use splat_render as render;
pub use splat_render::metrics;
