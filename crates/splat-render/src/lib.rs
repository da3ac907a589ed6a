//! What a camera sees of one frame's Gaussians: EWA splatting on the CPU.
//!
//! Reads as a pipeline: `project` (footprints, with `color`), `bin` (tiles, front to back), `blend` (pixels), and
//! `backward` from there. Data in: [`Gaussians`](splat_core::Gaussians) in stored encoding and a
//! [`Camera`](splat_core::Camera). Data out: an [`Image`], or the [`Contribution`] or [`RemovalError`] of every
//! Gaussian, or the [`Gradients`](splat_core::Gradients) of a loss. Memory: [`BYTES_PER_VISIBLE`], and up to
//! [`STRIP_BYTES`] for pairs of a Gaussian and a 16×16 tile it can change, which are made for as many tiles at a time as
//! that takes; a tile that more Gaussians than that reach takes 12 bytes for each.
//!
//! Every convention is that of the original CUDA rasteriser (Kerbl et al., "3D Gaussian Splatting", 2023),
//! decided to the sentence because each costs tens of dB; what the reach of alpha ≥ 1/255 lets us skip
//! changes no pixel. Pixels are the same bits for any number of threads and any instruction set.
//! Gaussians with a NaN or infinite value among position, rotation, scale or opacity are not drawn.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod backward;
mod bin;
mod blend;
mod color;
mod contribution;
mod convention;
mod features;
mod lanes;
pub mod metrics;
mod project;
mod removal;
mod renderer;

pub use backward::{GRADIENT_BYTES_PER_VISIBLE, GRADIENT_STRIP_BYTES};
pub use contribution::Contribution;
pub use features::blend_features;
pub use removal::RemovalError;
pub use renderer::{BYTES_PER_VISIBLE, Image, Renderer, STRIP_BYTES, contribution, render};

/// The instruction set that pictures are made with on this machine.
pub fn instructions() -> &'static str {
    blend::Blend::fastest().name()
}
