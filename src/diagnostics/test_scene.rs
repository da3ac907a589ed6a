//! The built-in demo: a generated scene, compressed, and what happened to each kind of Gaussian in it.

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
use crate::pipeline::{Request, Target, compress_scene, keep_to_budget};
use crate::progress::Events;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, Scene};

/// What the demo is asked for.
#[derive(Debug)]
pub struct DemoOptions {
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// Frames of the scene.
    pub frames: usize,
    /// How many of the Gaussians stay.
    pub kept: Target,
    /// How the scene is compressed.
    pub recipe: Recipe,
    /// Folder that keeps `scene.gseq`, `cameras.json` and `compressed.gseq`; without one everything is gone afterwards.
    pub output: Option<PathBuf>,
    /// What may be replaced there.
    pub overwrite: Replace,
    /// Memory to keep to.
    pub memory: Budget,
    /// Where the events of the run go.
    pub events: Events,
}

/// What the demo did.
#[derive(Debug)]
pub struct DemoReport {
    /// The compression.
    pub summary: Summary,
    /// For every body its Gaussians: all, kept as they were or as leaders, merged away.
    pub bodies: Vec<(DemoBody, usize, usize, usize)>,
}

/// Generates the scene, packs it, compresses it.
///
/// # Errors
/// A number to keep that cannot be; those of compressing; a failed write.
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
    let made = demo_scene::Scene::new(options.gaussians, options.frames);
    let packed = folder.join("scene.gseq");
    write_sequence(&made, OutputKind::Gseq, &packed, 1, &options.events)?;
    let rig = made.rig();
    let cameras = folder.join("cameras.json");
    fs::write(&cameras, cameras_json(&rig)).map_err(Error::io("write", &cameras))?;

    let input = Box::new(Container::open(&packed)?);
    let mut scene = Scene::new(PathBuf::from("scene.gseq"), input, rig, Some(Split::Train))?;
    scene.events = options.events.clone();
    let plain = InputOptions { memory: options.memory, events: options.events.clone(), ..InputOptions::default() };
    let request = Request {
        target: Some(options.kept),
        ..Request::new(plain, folder.join("compressed.gseq"), options.recipe.clone())
    };
    keep_to_budget(&mut scene, &request)?;
    let (mut summary, map) = compress_scene(&scene, &request)?;
    // Where it lies now it does not stay.
    summary.output.clear();
    let marker = folder.join(MARKER);
    fs::write(&marker, summary.json()).map_err(Error::io("write", &marker))?;

    let mut leaders = vec![false; summary.gaussians];
    let bodies = DemoBody::ALL
        .iter()
        .map(|&body| {
            let members = made.members(body);
            // The first Gaussian to reach a place of the output stands for it here.
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

/// The cameras as 3DGS writes them: camera-to-world rotations, every camera at every frame.
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
    /// A table for a person.
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
