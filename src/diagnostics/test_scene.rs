//! `splatsieve test-scene`: generates the test scene, compresses it, and counts for each body (object of the scene) how
//! many of its Gaussians were kept, merged and pruned.
//!
//! Tests and `scripts/digests.py` make their inputs with it.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use crate::diagnostics::demo_scene::{self, DemoBody, cameras_json};
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, SUMMARY_FILE, ScratchFolder, StagedFolder, TargetKind, check_target, write_text};
use crate::files::container::Container;
use crate::files::text::json_text;
use crate::memory_plan::Budget;
use crate::model::Split;
use crate::models::trajectories::write_sequence;
use crate::outputs::kind::OutputKind;
use crate::outputs::kind::check_folder_name;
use crate::pipeline::summary::Summary;
use crate::pipeline::summary::SummaryDetail;
use crate::pipeline::{CompressedScene, Request, Target, compress_scene, set_limits_within_budget};
use crate::progress::Events;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, Scene};

/// File name of the container with the frames of the scene.
const SCENE_FILE: &str = "scene.gseq";

/// Options of the command `test-scene`.
#[derive(Debug)]
pub struct TestSceneOptions {
    /// Number of Gaussians of the generated scene.
    pub gaussians: usize,
    /// Number of frames of the generated scene.
    pub frames: usize,
    /// Number or fraction of the Gaussians that the compression keeps.
    pub kept: Target,
    /// Recipe of the compression.
    pub recipe: Recipe,
    /// Path of the folder for `scene.gseq`, `cameras.json` and `compressed.gseq`; `None`: a temporary folder, which is
    /// deleted.
    pub output: Option<PathBuf>,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
    /// Limit on the memory of the run.
    pub memory: Budget,
    /// Receiver of the progress and the messages of the run.
    pub events: Events,
}

/// Result of the command `test-scene`.
#[derive(Debug)]
pub struct TestSceneReport {
    /// Summary of the compression.
    pub summary: Summary,
    /// Numbers of Gaussians of each body (object of the test scene). The elements of an entry are, in order:
    /// - the body
    /// - the number of its Gaussians
    /// - the number of its kept Gaussians: unmerged, or the first member of a merged group
    /// - the number of its Gaussians that were merged into others
    ///
    /// All other Gaussians of the body were pruned.
    pub bodies: Vec<(DemoBody, usize, usize, usize)>,
}

/// Generates the test scene, writes it to a container and compresses this container.
///
/// # Errors
/// Fails if `kept` is not a valid fraction or number of the Gaussians of the scene, if the compression fails, or if a
/// file cannot be written.
pub fn run(options: &TestSceneOptions) -> Result<TestSceneReport> {
    options.kept.resolve_count(options.gaussians)?;
    let Some(output) = &options.output else {
        return run_in(ScratchFolder::new(&std::env::temp_dir())?.path(), options);
    };
    check_folder_name(output, "test-scene")?;
    check_target(output, TargetKind::Folder, &[], options.overwrite)?;
    let staged = StagedFolder::new(output, options.overwrite)?;
    let report = run_in(staged.path(), options)?;
    staged.commit()?;
    Ok(report)
}

/// Writes the test scene `scene` into the existing folder `folder`: its frames to the container `scene.gseq`, its
/// cameras to `cameras.json`. Returns the paths of both files, in this order. Reports progress to `events`.
///
/// # Errors
/// Fails if a file cannot be written.
pub fn write_scene(scene: &demo_scene::DemoScene, folder: &Path, events: &Events) -> Result<[PathBuf; 2]> {
    let files = [SCENE_FILE, "cameras.json"].map(|name| folder.join(name));
    let [packed, cameras] = &files;
    write_sequence(scene, OutputKind::Gseq, packed, 1, events)?;
    fs::write(cameras, cameras_json(&scene.rig())).map_err(Error::io("write", cameras))?;
    Ok(files)
}

fn run_in(folder: &Path, options: &TestSceneOptions) -> Result<TestSceneReport> {
    let made = demo_scene::DemoScene::new(options.gaussians, options.frames);
    let [packed, _] = write_scene(&made, folder, &options.events)?;

    let input = Box::new(Container::open(&packed)?);
    let mut scene = Scene::new(PathBuf::from(SCENE_FILE), input, made.rig(), Some(Split::Train))?;
    scene.events = options.events.clone();
    let plain = InputOptions { memory: options.memory, events: options.events.clone(), ..InputOptions::default() };
    let request = Request {
        target: Some(options.kept),
        ..Request::new(plain, folder.join("compressed.gseq"), options.recipe.clone())
    };
    set_limits_within_budget(&mut scene, &request)?;
    let CompressedScene { mut summary, index_map: map } = compress_scene(&scene, &request)?;
    // The folder is still under its temporary name.
    summary.output.clear();
    write_text(&folder.join(SUMMARY_FILE), json_text(&summary))?;

    let mut leaders = vec![false; summary.gaussians];
    let bodies = DemoBody::ALL
        .iter()
        .map(|&body| {
            let members = made.body_ids(body);
            // The first Gaussian with an index in the output counts as kept, others with the same index as merged.
            let kept = members
                .clone()
                .filter(|&id| map[id].is_some_and(|new| !std::mem::replace(&mut leaders[new as usize], true)));
            let kept = kept.count();
            let merged = members.clone().filter(|&id| map[id].is_some()).count() - kept;
            (body, members.len(), kept, merged)
        })
        .collect();
    Ok(TestSceneReport { summary, bodies })
}

impl TestSceneReport {
    /// Returns the report as text for the terminal: the summary, and a table with the numbers of kept, merged and
    /// pruned Gaussians of each body.
    pub fn text(&self) -> String {
        let mut out = self.summary.text(SummaryDetail::Brief);
        // Writing to a String cannot fail.
        let _ = writeln!(out, "\n  {:<12} {:>9} {:>9} {:>9} {:>9}", "body", "Gaussians", "kept", "merged", "pruned");
        for &(body, all, kept, merged) in &self.bodies {
            let _ = writeln!(out, "  {:<12} {all:>9} {kept:>9} {merged:>9} {:>9}", body.name(), all - kept - merged);
        }
        out
    }
}
