//! Shrinks trained dynamic (4D) Gaussian-splatting models after training.
//!
//! The program is one pipeline; the modules are its stations, in layers that only look downward:
//!
//! | layer | modules | what lives there |
//! |---|---|---|
//! | L0 | crate [`gseq`] | bytes, columns, tiles |
//! | L1 | [`error`], [`machine`], [`model`], [`pass`], [`plan`], [`recipe`] | the vocabulary |
//! | L2 | [`deform`], [`stats`], [`score`], [`select`], [`merge`], [`render`], [`refit`], [`metrics`] | pure mathematics: slices in, values out |
//! | L3 | [`ingest`], [`stream`], [`emit`], [`demo`] | files, threads, terminals |
//! | L4 | [`pipeline`], [`report`] | the order of the passes; the page about their result |
//! | L5 | [`cli`] | arguments and exit codes |

pub mod cli;
pub mod deform;
pub mod demo;
pub mod emit;
pub mod error;
pub mod ingest;
pub mod machine;
pub mod merge;
pub mod metrics;
pub mod model;
pub mod pass;
pub mod pipeline;
pub mod plan;
pub mod recipe;
pub mod refit;
pub mod render;
pub mod report;
pub mod score;
pub mod select;
pub mod stats;
pub mod stream;
