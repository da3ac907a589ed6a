//! `splatsieve demo`: generates a dynamic scene, compresses it to a tenth and to a twentieth of its Gaussians, and
//! writes a player page, a report page and a film of the results.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::commands::video::FilmSource;
use crate::diagnostics::demo_scene::Playground;
use crate::error::{Error, Result, ShowPath};
use crate::evaluation::EvaluateOptions;
use crate::files::atomic::{Replace, StagedFolder, TargetKind, check_target, write_summary};
use crate::files::container::Container;
use crate::limits::Limits;
use crate::memory_plan::Budget;
use crate::model::{Camera, FrameView, Rig, Split};
use crate::models::trajectories::write_sequence;
use crate::outputs::film::{FilmFormat, FilmOutput};
use crate::outputs::kind::{OutputKind, check_folder_name};
use crate::passes::RenderedSource;
use crate::pipeline::{Request, Target, compress_scene, set_limits_within_budget};
use crate::player::view::{ViewOptions, view};
use crate::progress::Events;
use crate::recipe::{Effort, Recipe};
use crate::report::{self, ReportOptions};
use crate::scene::view_selection::ViewSet;
use crate::scene::{InputOptions, Scene};
use crate::source::FrameSource;

/// File name of the generated scene.
pub const SCENE_FILE: &str = "scene.gseq";
/// File name of the cameras of the generated scene.
pub const CAMERAS_FILE: &str = "cameras.json";
/// File name of the scene compressed to a tenth of its Gaussians and refined.
pub const COMPRESSED_10X_FILE: &str = "compressed_10x.gseq";
/// File name of the scene compressed to a twentieth of its Gaussians and refined.
pub const COMPRESSED_20X_FILE: &str = "compressed_20x.gseq";
/// File name of the scene compressed to a tenth of its Gaussians without refinement.
pub const PRUNED_10X_FILE: &str = "pruned_10x.gseq";
/// File name of the page that plays the scene beside [`COMPRESSED_10X_FILE`].
pub const PLAYER_FILE: &str = "player.html";
/// Name of the folder with the report.
pub const REPORT_FOLDER: &str = "report";
/// File name of the film (an animated GIF) that shows the scene, [`PRUNED_10X_FILE`] and [`COMPRESSED_10X_FILE`] side
/// by side.
pub const FILM_FILE: &str = "comparison.gif";

/// Width and height of one render in the film, pixels. Three renders of this size, side by side, fit the width of a
/// page of text.
const FILM_RENDER: (u32, u32) = (280, 210);
/// Width of the white line between neighboring renders in the film, pixels.
const FILM_GAP: u32 = 6;
/// Maximum number of frames of the film.
const FILM_FRAMES: usize = 24;
/// Speed at which the film plays, frames per second.
const FILM_RATE: u32 = 8;
/// View number of the camera from which the film is rendered. This test view is near the middle of the arc of cameras.
const FILM_VIEW: u32 = 5;

/// Options of the command `demo`.
#[derive(Debug)]
pub struct DemoOptions {
    /// Number of Gaussians of the scene.
    pub gaussians: usize,
    /// Number of frames of the scene.
    pub frames: usize,
    /// Number of optimization steps of each refinement; `None`: the number in the default recipe at [`Effort::Fast`].
    pub steps: Option<u32>,
    /// Path of the output folder.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
    /// Limit on the memory of the run.
    pub memory: Budget,
    /// Receiver of the progress and the messages of the run.
    pub events: Events,
}

/// Size and quality of one model that the demo writes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DemoModel {
    /// File name of the model.
    pub name: &'static str,
    /// Number of Gaussians of the model.
    pub gaussians: usize,
    /// Size of the model's file in bytes.
    pub bytes: u64,
    /// Mean PSNR over the test views, dB, of renders of this model against renders of the uncompressed scene; `None`
    /// for the scene itself.
    pub psnr: Option<f64>,
    /// Mean SSIM over the test views of renders of this model against renders of the uncompressed scene; `None` for the
    /// scene itself.
    pub ssim: Option<f64>,
}

/// Result of the command `demo`.
#[derive(Debug, Serialize)]
pub struct DemoReport {
    /// Written models: the uncompressed scene first, then its compressed versions.
    pub models: Vec<DemoModel>,
    /// Number of renders (test views at all frames) over which PSNR and SSIM are averaged.
    pub renders: usize,
    /// Written files, each with its path in the output folder and a description, in the order in which a user may want
    /// to open them.
    pub written: Vec<(&'static str, &'static str)>,
}

/// Generates the demo scene and compresses it. Writes the scene, its cameras, the compressed models, the player page,
/// the report and the film to the output folder.
///
/// # Errors
/// Fails if the output exists and may not be replaced, if the compression fails, or if a file cannot be written.
pub fn run(options: &DemoOptions) -> Result<DemoReport> {
    let output = &options.output;
    check_folder_name(output, "demo")?;
    check_target(output, TargetKind::Folder, &[], options.overwrite)?;
    let staged = StagedFolder::new(output, options.overwrite)?;
    let report = run_in(staged.path(), options)?;
    staged.commit()?;
    Ok(report)
}

fn run_in(folder: &Path, options: &DemoOptions) -> Result<DemoReport> {
    let made = Playground::new(options.gaussians, options.frames);
    write_sequence(&made, OutputKind::Gseq, &folder.join(SCENE_FILE), 1, &options.events)?;
    let cameras = folder.join(CAMERAS_FILE);
    fs::write(&cameras, cameras_json(&made.rig())).map_err(Error::io("write", &cameras))?;

    let fast = Recipe::preset("default")?.with_effort(Effort::Fast);
    let refined = options.steps.map_or(fast.clone(), |steps| fast.with_refinement_steps(steps));
    let models = [
        (COMPRESSED_10X_FILE, 0.1, refined.clone()),
        (COMPRESSED_20X_FILE, 0.05, refined),
        (PRUNED_10X_FILE, 0.1, fast.without_refinement()),
    ];
    let mut limits = Limits::NONE;
    for (name, ratio, recipe) in models {
        limits = compress(folder, name, Target::Ratio(ratio), &recipe, options)?;
    }
    film(folder, &made.rig(), &limits, &options.events)?;
    let original = InputOptions {
        path: folder.join(SCENE_FILE),
        cameras: Some(cameras),
        memory: options.memory,
        events: options.events.clone(),
        scratch: Some(folder.to_owned()),
        ..InputOptions::default()
    };
    view(&ViewOptions {
        original: original.clone(),
        compressed: Some(folder.join(COMPRESSED_10X_FILE)),
        max_frames: options.frames,
        original_frames: None,
        original_degree: None,
        background: None,
        page_limit: u64::MAX,
        output: folder.join(PLAYER_FILE),
        overwrite: Replace::Never,
    })?;
    let found = report::report_whole(&ReportOptions {
        evaluate: EvaluateOptions {
            original,
            compressed: folder.join(COMPRESSED_10X_FILE),
            ground_truth: None,
            views: ViewSet::HeldOut,
            max_frames: None,
            max_views: None,
            background: None,
            flip: false,
            csv: None,
            overwrite: Replace::Never,
        },
        further_compressed: vec![folder.join(COMPRESSED_20X_FILE), folder.join(PRUNED_10X_FILE)],
        sweep: None,
        precision: None,
        render_time: false,
        output: folder.join(REPORT_FOLDER),
        overwrite: Replace::Never,
    })?;
    write_summary(folder, &serde_json::json!({ "tool": crate::TOOL, "verdict": found.result.verdict }))?;
    Ok(DemoReport::new(&found))
}

/// Compresses the scene file in `folder` by `recipe` to the number or fraction of Gaussians `target`, and writes the
/// result to the file `name` in the same folder. Returns the limits (maximum numbers of frames, views and Gaussians in
/// memory at a time) with which the run fits into the memory limit.
fn compress(folder: &Path, name: &str, target: Target, recipe: &Recipe, options: &DemoOptions) -> Result<Limits> {
    let input = Box::new(Container::open(&folder.join(SCENE_FILE))?);
    let rig = Playground::new(options.gaussians, options.frames).rig();
    let mut scene = Scene::new(PathBuf::from(SCENE_FILE), input, rig, Some(Split::Train))?;
    scene.events = options.events.clone();
    let plain = InputOptions { memory: options.memory, events: options.events.clone(), ..InputOptions::default() };
    let request = Request { target: Some(target), ..Request::new(plain, folder.join(name), recipe.clone()) };
    set_limits_within_budget(&mut scene, &request)?;
    compress_scene(&scene, &request)?;
    Ok(scene.limits)
}

/// Returns a JSON text with the cameras of `rig` and the split (training or test) of each view. The text gives no
/// times: every camera sees every frame.
fn cameras_json(rig: &Rig) -> String {
    let frame = |rig_view: &crate::model::RigView| {
        let camera = &rig.cameras[rig_view.camera as usize];
        let mut rows: Vec<[f64; 4]> = (0..3)
            .map(|row| {
                let [a, b, c] = camera.rotation.row(row).to_array();
                [a, b, c, camera.translation[row]]
            })
            .collect();
        rows.push([0.0, 0.0, 0.0, 1.0]);
        serde_json::json!({
            "v": rig_view.view,
            "split": if rig_view.split == Split::Test { "test" } else { "train" },
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "w2c": rows,
        })
    };
    let frames: Vec<serde_json::Value> = rig.views.iter().map(frame).collect();
    format!("{:#}\n", serde_json::json!({ "background": rig.background, "frames": frames }))
}

/// Writes the film, an animated GIF of one test view, to `folder`. Each image shows the scene, the pruned model and the
/// refined model side by side. `limits` bound the number of views and frames in memory.
fn film(folder: &Path, rig: &Rig, limits: &Limits, events: &Events) -> Result<()> {
    let models = [SCENE_FILE, PRUNED_10X_FILE, COMPRESSED_10X_FILE].map(|name| Container::open(&folder.join(name)));
    let [scene, pruned, refined] = models;
    let (scene, pruned, refined) = (scene?, pruned?, refined?);
    let camera = smaller(&rig.cameras[FILM_VIEW as usize]);
    let frames = scene.info().times.len();
    let step = frames.div_ceil(FILM_FRAMES).max(1);
    let view = |frame| FrameView { frame, view: FILM_VIEW, camera: 0 };
    let views: Vec<FrameView> = (0..frames).step_by(step).map(view).collect();
    let path = folder.join(FILM_FILE);
    let size = (3 * FILM_RENDER.0 + 2 * FILM_GAP, FILM_RENDER.1);
    let mut film = FilmOutput::create((&path, &path), &FilmFormat::Gif, size, views.len() as u32, FILM_RATE)?;
    let background = rig.background.unwrap_or_default();
    let source = FilmSource { cameras: &[camera], views: &views, limits, background, gap: FILM_GAP, events };
    let models: [&dyn FrameSource; 3] = [&scene, &pruned, &refined];
    source.film(models.map(RenderedSource::all_gaussians), &mut film)?;
    film.finish()
}

/// Returns a copy of `camera` whose images have the size [`FILM_RENDER`] and the same horizontal field of view, with
/// the principal point at the image center.
fn smaller(camera: &Camera) -> Camera {
    let (width, height) = FILM_RENDER;
    let scale = f64::from(width) / f64::from(camera.width);
    Camera {
        width,
        height,
        fx: scale * camera.fx,
        fy: scale * camera.fy,
        cx: 0.5 * f64::from(width),
        cy: 0.5 * f64::from(height),
        ..camera.clone()
    }
}

impl DemoReport {
    fn new(report_data: &report::ReportData) -> DemoReport {
        let first = &report_data.result.evaluation;
        let mut models = vec![DemoModel {
            name: SCENE_FILE,
            gaussians: first.count.original,
            bytes: first.bytes.original,
            psnr: None,
            ssim: None,
        }];
        let evaluations = std::iter::once(first).chain(report_data.others.iter().map(|other| &other.evaluation));
        models.extend([COMPRESSED_10X_FILE, COMPRESSED_20X_FILE, PRUNED_10X_FILE].into_iter().zip(evaluations).map(
            |(name, of)| DemoModel {
                name,
                gaussians: of.count.compressed,
                bytes: of.bytes.compressed,
                psnr: Some(of.loss.overall.psnr),
                ssim: Some(of.loss.overall.ssim),
            },
        ));
        DemoReport {
            models,
            renders: first.cameras.pairs,
            written: vec![
                (PLAYER_FILE, "the scene and a tenth of it, moving, in a browser"),
                ("report/report.html", "the three results beside the scene"),
                (FILM_FILE, "left the scene, middle a tenth without refinement, right a tenth refined"),
                (SCENE_FILE, "the scene"),
                (CAMERAS_FILE, "its cameras"),
                (COMPRESSED_10X_FILE, "a tenth of the Gaussians, refined"),
                (COMPRESSED_20X_FILE, "a twentieth of the Gaussians, refined"),
                (PRUNED_10X_FILE, "a tenth of the Gaussians, without refinement"),
            ],
        }
    }

    /// Returns the report as text for the terminal: a table of the models, a list of the files in `folder`, and the
    /// command that opens the player page.
    pub fn text(&self, folder: &Path) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(out, "{:<24} {:>9} {:>10} {:>9} {:>7}", "", "Gaussians", "size", "PSNR", "SSIM");
        let whole = &self.models[0];
        for model in &self.models {
            let size = format!("{:.2} MB", model.bytes as f64 / 1e6);
            let psnr = model.psnr.map_or("–".to_owned(), |psnr| format!("{psnr:.1} dB"));
            let ssim = model.ssim.map_or("–".to_owned(), |ssim| format!("{ssim:.3}"));
            let _ = write!(out, "{:<24} {:>9} {size:>10} {psnr:>9} {ssim:>7}", model.name, model.gaussians);
            if model.psnr.is_some() {
                let fewer = whole.gaussians as f64 / model.gaussians.max(1) as f64;
                let smaller = whole.bytes as f64 / model.bytes.max(1) as f64;
                let _ = write!(out, "  {fewer:.1}× fewer, {smaller:.1}× smaller");
            }
            out.push('\n');
        }
        let _ = writeln!(out, "PSNR and SSIM: against the scene, means of {} test views\n", self.renders);
        let _ = writeln!(out, "Written to {}:", folder.shown());
        for (name, about) in &self.written {
            let _ = writeln!(out, "  {name:<24} {about}");
        }
        let page = folder.join(PLAYER_FILE);
        let _ = writeln!(out, "\nSee it:   {} {}", opener(), page.shown());
        out
    }
}

/// Returns the shell command of this operating system that opens a file in its default application.
fn opener() -> &'static str {
    match std::env::consts::OS {
        "macos" => "open",
        "windows" => "start",
        _ => "xdg-open",
    }
}
