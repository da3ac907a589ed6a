//! What a camera sees of one frame's Gaussians: EWA splatting on the CPU.
//!
//! Reads as a pipeline: `project` (footprints, with `colour`), `bin` (tiles, front to back), `blend`
//! (pixels). Data in: [`Gaussians`] in stored encoding and a [`Camera`]. Data out: an [`Image`], or the
//! [`Contribution`] or [`RemovalError`] of every Gaussian, or a [`Sight`], the picture as a linear map from
//! colours. Memory: 80 bytes per visible Gaussian and 4 (for contributions 12)
//! per pair of a Gaussian and a 16×16 tile it can change.
//!
//! Every convention is that of the original CUDA rasteriser (Kerbl et al., "3D Gaussian Splatting", 2023),
//! decided to the sentence because each costs tens of dB; what the reach of alpha ≥ 1/255 lets us skip
//! changes no pixel. Pixels are the same bits for any number of threads and any instruction set.
//! Gaussians with a NaN or infinite value among position, rotation, scale or opacity are not drawn.

mod bin;
mod blend;
mod colour;
mod contribution;
mod lanes;
mod project;
mod removal;
mod sight;

use std::num::NonZeroU32;

use rayon::prelude::*;

pub use contribution::Contribution;
pub use removal::RemovalError;
pub use sight::{Pull, Sight};

use crate::model::{Camera, Gaussians};
use bin::Bins;
use blend::{Blend, Colour, GROUPS, Lattice, Plane, Weight, Weights};
use project::{BLOCK, Splat, Splats, View};
use removal::Removal;

/// Side of a tile in pixels; part of the result, for a Gaussian reaches whole tiles.
const TILE: u32 = 16;
/// Alphas below this are skipped.
const MIN_ALPHA: f32 = 1.0 / 255.0;
/// Alphas are cut to this.
const MAX_ALPHA: f32 = 0.99;
/// A Gaussian that would leave less transmittance than this ends the pixel, unblended.
const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Gaussians projected by one task: enough to outweigh handing it out.
const SPAN: usize = 32 * BLOCK;

/// A picture: red, green, blue per pixel, row by row from the top, 1 = white, not clamped.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// `[height, width, 3]`.
    pub data: Vec<f32>,
}

/// Renders `gaussians` before `background` as `camera` sees them, on all threads of the pool.
///
/// A camera without pixels gives an empty image; no Gaussians give the background. Scales are taken
/// within e^±80. A zero quaternion is the identity; a NaN colour counts as 0.
///
/// # Panics
/// If the columns of `gaussians` differ in length.
pub fn render(gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Image {
    Renderer::with(true).render(gaussians, camera, background)
}

/// Adds what `camera` sees of each Gaussian to `seen`, on all threads of the pool; reads no colour.
///
/// Only every `stride`-th pixel each way is looked at (those whose coordinates leave `stride / 2` when
/// divided by it), with footprints at full resolution; the sums are over the looked-at pixels, so a
/// stride of s gives about 1/s² of the full sums.
///
/// # Panics
/// If `seen` is not of as many Gaussians, or the columns of `gaussians` differ in length.
pub fn contribution(gaussians: &Gaussians, camera: &Camera, stride: NonZeroU32, seen: &mut Contribution) {
    Renderer::with(true).contribution(gaussians, camera, stride, seen);
}

/// Renders on the calling thread alone and keeps its buffers: for loops that run pictures in parallel.
///
/// Gives the same bits as [`render`] and [`contribution`].
#[derive(Debug)]
pub struct Renderer {
    parallel: bool,
    blend: Blend,
    splats: Splats,
    bins: Bins,
    weights: Vec<Weight>,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer::new()
    }
}

impl Renderer {
    /// A renderer with empty buffers.
    pub fn new() -> Self {
        Renderer::with(false)
    }

    fn with(parallel: bool) -> Self {
        Renderer {
            parallel,
            blend: Blend::detect(),
            splats: Splats::default(),
            bins: Bins::default(),
            weights: Vec::new(),
        }
    }

    /// As [`render`], on this thread.
    pub fn render(&mut self, gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Image {
        let view = View::new(camera);
        self.prepare(gaussians, &view, true);
        let row_len = camera.width as usize * 3;
        let mut data = vec![0.0; row_len * camera.height as usize];
        let across = view.tiles[0] as usize;
        let paint_row = |(y, rows): (usize, &mut [f32])| {
            for x in 0..across {
                let lattice = Lattice::new([x as u32, y as u32], view.size, 1);
                let pairs = &self.bins.pairs()[self.bins.range(y * across + x..y * across + x + 1)];
                let planes = paint(self.blend, &self.splats.splats, pairs, &lattice, background);
                for (v, row) in rows.chunks_exact_mut(row_len).enumerate() {
                    let start = x * TILE as usize;
                    let pixels = row[start * 3..].chunks_exact_mut(3).take(TILE as usize);
                    for (u, pixel) in pixels.enumerate() {
                        let (group, lane) = (v + u / 8 * TILE as usize, u % 8);
                        for c in 0..3 {
                            pixel[c] = planes[c][group][lane];
                        }
                    }
                }
            }
        };
        // Without pixels there are no rows, and chunks must not be empty.
        let tile_row_len = (row_len * TILE as usize).max(1);
        if self.parallel {
            data.par_chunks_mut(tile_row_len).enumerate().for_each(paint_row);
        } else {
            data.chunks_mut(tile_row_len).enumerate().for_each(paint_row);
        }
        Image { width: camera.width, height: camera.height, data }
    }

    /// As [`contribution`], on this thread.
    ///
    /// # Panics
    /// If `seen` is not of as many Gaussians, or the columns of `gaussians` differ in length.
    pub fn contribution(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        stride: NonZeroU32,
        seen: &mut Contribution,
    ) {
        assert_eq!(seen.len(), gaussians.len(), "contribution of another model");
        let view = View::new(camera);
        self.prepare(gaussians, &view, false);
        self.weights.clear();
        self.weights.resize(self.bins.pairs().len(), Weight::default());
        let across = view.tiles[0] as usize;
        let mut rest = &mut self.weights[..];
        let mut rows = Vec::with_capacity(view.tiles[1] as usize);
        for y in 0..view.tiles[1] as usize {
            let (row, after) = rest.split_at_mut(self.bins.range(y * across..(y + 1) * across).len());
            rows.push((y, row));
            rest = after;
        }
        let weigh_row = |(y, mut weights): (usize, &mut [Weight])| {
            for x in 0..across {
                let lattice = Lattice::new([x as u32, y as u32], view.size, stride.get());
                let pairs = &self.bins.pairs()[self.bins.range(y * across + x..y * across + x + 1)];
                let (tile, after) = weights.split_at_mut(pairs.len());
                self.blend.tile(&self.splats.splats, pairs, &lattice, &mut Weights { pairs: tile });
                weights = after;
            }
        };
        if self.parallel {
            rows.into_par_iter().for_each(weigh_row);
        } else {
            rows.into_iter().for_each(weigh_row);
        }
        for (&splat, weight) in self.bins.pairs().iter().zip(&self.weights) {
            if weight.max > 0.0 {
                seen.add(self.splats.splats[splat as usize].id as usize, weight.sum, weight.max);
            }
        }
    }

    /// Adds what removing each Gaussian alone would change in `camera`'s picture to `errors`, on this thread.
    ///
    /// # Panics
    /// If `errors` is not of as many Gaussians, or the columns of `gaussians` differ in length.
    pub fn removal_error(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        errors: &mut RemovalError,
    ) {
        assert_eq!(errors.len(), gaussians.len(), "errors of another model");
        let view = View::new(camera);
        self.prepare(gaussians, &view, true);
        let splats = &self.splats.splats;
        let mut sums = Vec::new();
        for y in 0..view.tiles[1] {
            for x in 0..view.tiles[0] {
                let tile = (y * view.tiles[0] + x) as usize;
                let pairs = &self.bins.pairs()[self.bins.range(tile..tile + 1)];
                let lattice = Lattice::new([x, y], view.size, 1);
                let rest = paint(self.blend, splats, pairs, &lattice, background);
                sums.clear();
                sums.resize(pairs.len(), 0.0);
                let mut ink = Removal { rest, contrast_floor: errors.contrast_floor, pairs: &mut sums };
                self.blend.tile(splats, pairs, &lattice, &mut ink);
                for (&splat, &sum) in pairs.iter().zip(&sums) {
                    errors.add(splats[splat as usize].id as usize, sum);
                }
            }
        }
    }

    /// Projects and bins.
    fn prepare(&mut self, gaussians: &Gaussians, view: &View, coloured: bool) {
        let count = gaussians.len();
        self.splats.clear();
        if self.parallel {
            let spans: Vec<Splats> = (0..count.div_ceil(SPAN))
                .into_par_iter()
                .map(|span| {
                    let mut splats = Splats::default();
                    project::project(
                        gaussians,
                        span * SPAN..((span + 1) * SPAN).min(count),
                        view,
                        coloured,
                        &mut splats,
                    );
                    splats
                })
                .collect();
            spans.into_iter().for_each(|span| self.splats.append(span));
        } else {
            project::project(gaussians, 0..count, view, coloured, &mut self.splats);
        }
        self.bins.fill(&self.splats, view.tiles, self.parallel);
    }
}

/// The colours of one tile's sampled pixels.
fn paint(blend: Blend, splats: &[Splat], pairs: &[u32], lattice: &Lattice, background: [f32; 3]) -> [Plane; 3] {
    let mut colour = Colour { planes: [[[0.0; 8]; GROUPS]; 3] };
    let left = blend.tile(splats, pairs, lattice, &mut colour);
    for (plane, background) in colour.planes.iter_mut().zip(background) {
        for (pixel, left) in plane.as_flattened_mut().iter_mut().zip(left.as_flattened()) {
            *pixel += left.abs() * background;
        }
    }
    colour.planes
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;

    #[test]
    fn the_portable_blend_gives_the_bits_of_the_fastest() {
        let mut scene = Gaussians::zeros(3000, 0);
        for i in 0..scene.len() {
            // Low-discrepancy steps: every Gaussian elsewhere, of another size and opacity.
            let step = |k: f64| (i as f64 * k).fract() as f32;
            scene.position.set_row(i, [2.0 * step(0.618_034) - 1.0, 2.0 * step(0.754_878) - 1.0, 1.5 + step(0.569_84)]);
            scene.rotation.set_row(i, [1.0, step(0.819_173), step(0.671_044), step(0.549_701)]);
            scene.log_scale.set_row(i, [-6.0 + 4.0 * step(0.380_2), -3.0, -4.0]);
            scene.opacity_logit.set_row(i, [10.0 * step(0.856_675) - 5.0]);
            scene.sh.set_row(i, [step(0.733_892), step(0.628_71), step(0.538_6)]);
        }
        let camera = Camera {
            width: 99,
            height: 70,
            fx: 80.0,
            fy: 80.0,
            cx: 49.5,
            cy: 35.0,
            rotation: DMat3::IDENTITY,
            translation: DVec3::ZERO,
        };
        let [fast, portable] = [Blend::detect(), Blend::Portable].map(|blend| {
            let mut renderer = Renderer { blend, ..Renderer::new() };
            let mut seen = Contribution::new(scene.len());
            renderer.contribution(&scene, &camera, NonZeroU32::MIN, &mut seen);
            (renderer.render(&scene, &camera, [0.3; 3]), seen)
        });
        assert!(fast == portable, "the instruction sets differ");
    }
}
