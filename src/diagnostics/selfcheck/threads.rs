//! Self-check cases for work that is distributed over threads.

use std::fs;

use super::case::LargestError;
use super::generated::clouds::{random_gaussians, tilted_camera};
use crate::diagnostics::test_scene;
use crate::diagnostics::test_scene::TestSceneOptions;
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, ScratchFolder};
use crate::memory_plan::Budget;
use crate::model::{Attributes, Gradients};
use crate::pipeline::Target;
use crate::progress::Events;
use crate::recipe::Recipe;
use crate::render::{Image, Renderer};

/// Compares results computed on one thread with results computed on two threads. They must be equal byte for byte.
pub(super) fn same_bytes(worst: &mut LargestError) -> Result<()> {
    let (one, two) = (run_on(1)?, run_on(2)?);
    worst.same(&two, &one);
    Ok(())
}

/// Compresses a small test scene and computes the gradients of one render, on `threads` threads. Returns the bytes of
/// the compressed file and the gradients.
fn run_on(threads: usize) -> Result<(Vec<u8>, Gradients)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|error| Error::usage(format!("{threads} threads: {error}")))?;
    pool.install(|| {
        let folder = ScratchFolder::new(&std::env::temp_dir())?;
        let output = folder.path().join("demo");
        let mut recipe = Recipe::preset("default")?;
        // Few steps are enough to run all code of refinement.
        recipe.refine.refine_steps = 10;
        test_scene::run(&TestSceneOptions {
            gaussians: 400,
            frames: 6,
            kept: Target::Ratio(0.5),
            recipe,
            output: Some(output.clone()),
            overwrite: Replace::Never,
            memory: Budget::default(),
            events: Events::IGNORED,
        })?;
        let path = output.join("compressed.gseq");
        let bytes = fs::read(&path).map_err(Error::io("read", &path))?;
        let scene = random_gaussians(31, 3000, 1);
        let mut gradients = Gradients::new(scene.len(), Attributes::all(), 1);
        let loss = |image: &Image| (0.0, image.clone());
        Renderer::on_all_threads().gradient(&scene, &tilted_camera(80, 60), [0.5; 3], loss, &mut gradients);
        Ok((bytes, gradients))
    })
}
