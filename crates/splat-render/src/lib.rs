//! Rasterizer: renders the Gaussians of one frame from one camera by EWA splatting on the CPU.
//!
//! The modules form a pipeline: `project` computes the splat (image footprint) of each Gaussian and `color` its color,
//! `bin` assigns splats to tiles of 16×16 pixels from front to back, `blend` computes pixels, and `backward` computes
//! gradients. Input: [`Gaussians`](splat_core::Gaussians) at one frame and a [`Camera`](splat_core::Camera). Output: an
//! [`Image`], or the [`Contribution`] or [`RemovalError`] of every Gaussian, or the
//! [`Gradients`](splat_core::Gradients) of a loss.
//!
//! Memory: [`BYTES_PER_VISIBLE`] per visible Gaussian, and up to [`STRIP_BYTES`] for (Gaussian, tile) pairs: a pair
//! states that the Gaussian can change pixels of the tile. Tiles are processed in strips whose pairs fit into these
//! bytes. Only a single tile whose pairs do not fit takes more memory: 12 bytes per pair.
//!
//! All conventions are those of the original CUDA rasterizer (Kerbl et al., "3D Gaussian Splatting", 2023), in every
//! detail, because each deviation lowers the PSNR against its renders by tens of dB. For example, a Gaussian is skipped
//! in the pixels in which its alpha is below 1/255. Pixels have the same bits for any number of threads and any
//! instruction set. Gaussians with a NaN or infinite position, rotation, scale or opacity are not drawn.
//!
//! ```
//! use splat_core::{Camera, Gaussians, sh_from_color};
//! use splat_render::{metrics::psnr, render};
//!
//! let mut gaussians = Gaussians::zeros(1, 0);
//! gaussians.position.set_row(0, [0.0, 0.0, 3.0]);
//! gaussians.rotation.set_row(0, [1.0, 0.0, 0.0, 0.0]);
//! gaussians.log_scale.set_row(0, [-2.0; 3]);
//! gaussians.opacity_logit.set_row(0, [4.0]);
//! gaussians.sh.set_row(0, [sh_from_color(1.0), sh_from_color(0.0), sh_from_color(0.0)]);
//! let camera = Camera {
//!     width: 64,
//!     height: 48,
//!     fx: 60.0,
//!     fy: 60.0,
//!     cx: 32.0,
//!     cy: 24.0,
//!     rotation: glam::DMat3::IDENTITY,
//!     translation: glam::DVec3::ZERO,
//!     near: Camera::NEAR,
//! };
//!
//! let image = render(&gaussians, &camera, [0.0; 3]);
//! let center = 3 * (24 * 64 + 32);
//! assert!(image.data[center] > 0.9 && image.data[center + 1] < 0.01);
//! assert_eq!(psnr(&image, &image), splat_render::metrics::PSNR_CAP_DB);
//! ```

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod backward;
mod bin;
mod blend;
mod color;
mod contribution;
mod convention;
mod features;
mod grid;
mod lanes;
pub mod metrics;
mod project;
mod removal;
mod renderer;

pub use backward::{GRADIENT_BYTES_PER_VISIBLE, GRADIENT_STRIP_BYTES};
pub use color::ViewColors;
pub use contribution::Contribution;
pub use convention::MIN_LOGIT;
pub use features::blend_features;
pub use grid::{ALL_PIXELS, GridStrides, PixelGrid, SampledView};
pub use removal::RemovalError;
pub use renderer::{BYTES_PER_VISIBLE, Image, Renderer, STRIP_BYTES, contribution, render};

/// Returns the name of the instruction set with which this machine renders, such as "AVX2".
pub fn instruction_set() -> &'static str {
    blend::BlendKernel::fastest().name()
}

/// Compiles the example in the README of this crate as a documentation test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
mod readme {}
