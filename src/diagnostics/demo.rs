//! The built-in demo: generates a scene, compresses it, and reports the result for each kind of body in the scene.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use crate::diagnostics::demo_scene;
use crate::diagnostics::demo_scene::DemoBody;
use crate::error::{Error, Result};
use crate::files::atomic::{Kind, MARKER, Replace, ScratchFolder, StagedFolder, check_target};
use crate::files::container::Container;
use crate::memory_plan::Budget;
use crate::model::{Camera, Rig, Split};
use crate::models::trajectories::write_sequence;
use crate::outputs::kind::OutputKind;
use crate::outputs::kind::check_folder_name;
use crate::pipeline::summary::Detail;
use crate::pipeline::summary::Summary;
use crate::pipeline::{Request, Target, compress_scene, set_limits_within_budget};
use crate::progress::Events;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, Scene};

/// Options of the demo.
#[derive(Debug)]
pub struct DemoOptions {
    /// Number of Gaussians of the scene.
    pub gaussians: usize,
    /// Number of frames of the scene.
    pub frames: usize,
    /// Number or fraction of Gaussians to keep.
    pub kept: Target,
    /// Recipe of the compression.
    pub recipe: Recipe,
    /// Folder that gets `scene.gseq`, `cameras.json` and `compressed.gseq`. `None`: a temporary folder, which is
    /// deleted at the end.
    pub output: Option<PathBuf>,
    /// Policy if the output folder already exists.
    pub overwrite: Replace,
    /// Memory limit of the run.
    pub memory: Budget,
    /// Receiver of the events of the run.
    pub events: Events,
}

/// Result of the demo.
#[derive(Debug)]
pub struct DemoReport {
    /// Summary of the compression run.
    pub summary: Summary,
    /// For every body of the scene the numbers of Gaussians: all, kept (unchanged or as leader of a merged cluster),
    /// and merged into another.
    pub bodies: Vec<(DemoBody, usize, usize, usize)>,
}

/// Generates the demo scene, writes it as a container and compresses the container.
///
/// # Errors
/// Fails if the number of Gaussians to keep is impossible, if the compression fails, or if a file cannot be written.
pub fn run(options: &DemoOptions) -> Result<DemoReport> {
    options.kept.count(options.gaussians)?;
    let Some(output) = &options.output else {
        return run_in(ScratchFolder::new(&std::env::temp_dir())?.path(), options);
    };
    check_folder_name(output, "demo")?;
    check_target(output, Kind::Folder, &[], options.overwrite)?;
    let staged = StagedFolder::new(output, options.overwrite)?;
    let report = run_in(staged.path(), options)?;
    staged.commit()?;
    Ok(report)
}

fn run_in(folder: &Path, options: &DemoOptions) -> Result<DemoReport> {
    let demo = demo_scene::Scene::new(options.gaussians, options.frames);
    let packed = folder.join("scene.gseq");
    write_sequence(&demo, OutputKind::Gseq, &packed, 1, &options.events)?;
    let rig = demo.rig();
    let cameras = folder.join("cameras.json");
    fs::write(&cameras, cameras_json(&rig)).map_err(Error::io("write", &cameras))?;

    let input = Box::new(Container::open(&packed)?);
    let mut scene = Scene::new(PathBuf::from("scene.gseq"), input, rig, Some(Split::Train))?;
    scene.events = options.events.clone();
    let input_options =
        InputOptions { memory: options.memory, events: options.events.clone(), ..InputOptions::default() };
    let request = Request {
        target: Some(options.kept),
        ..Request::new(input_options, folder.join("compressed.gseq"), options.recipe.clone())
    };
    set_limits_within_budget(&mut scene, &request)?;
    let (mut summary, map) = compress_scene(&scene, &request)?;
    // The path is temporary, so it is not reported.
    summary.output.clear();
    let marker = folder.join(MARKER);
    fs::write(&marker, summary.json()).map_err(Error::io("write", &marker))?;

    let mut leaders = vec![false; summary.gaussians];
    let bodies = DemoBody::ALL
        .iter()
        .map(|&body| {
            let members = demo.members(body);
            // The first Gaussian of each output index counts as kept; later ones with the same output index count as
            // merged.
            let kept = members
                .clone()
                .filter(|&id| map[id].is_some_and(|new| !std::mem::replace(&mut leaders[new as usize], true)));
            let kept = kept.count();
            let merged = members.clone().filter(|&id| map[id].is_some()).count() - kept;
            (body, members.len(), kept, merged)
        })
        .collect();
    Ok(DemoReport { summary, bodies })
}

/// Returns the cameras of `rig` as JSON in the form that 3DGS writes: with camera-to-world rotations, and every camera
/// at every frame.
fn cameras_json(rig: &Rig) -> String {
    let camera = |(id, camera): (usize, &Camera)| {
        let to_world = camera.rotation.transpose();
        let rows = [0, 1, 2].map(|row| to_world.row(row).to_array());
        serde_json::json!({
            "id": id,
            "img_name": format!("view_{id:02}"),
            "width": camera.width,
            "height": camera.height,
            "position": camera.center().to_array(),
            "rotation": rows,
            "fx": camera.fx,
            "fy": camera.fy,
        })
    };
    let all: Vec<serde_json::Value> = rig.cameras.iter().enumerate().map(camera).collect();
    format!("{:#}\n", serde_json::Value::from(all))
}

impl DemoReport {
    /// Returns the report as a text table.
    pub fn text(&self) -> String {
        let mut out = self.summary.text(Detail::Most);
        // Writing to a String cannot fail.
        let _ = writeln!(out, "\n  {:<12} {:>9} {:>9} {:>9} {:>9}", "body", "Gaussians", "kept", "merged", "pruned");
        for &(body, all, kept, merged) in &self.bodies {
            let _ = writeln!(out, "  {:<12} {all:>9} {kept:>9} {merged:>9} {:>9}", body.name(), all - kept - merged);
        }
        out
    }
}
