//! `splatsieve view`: writes a page that plays one model, or two side by side.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::TOOL;
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, StagedFile, StagedFolder, TargetKind, check_target, write_summary};
use crate::files::text::serialize_path;
use crate::limits::Limits;
use crate::memory_plan::{MemoryPlan, ResourceEstimate, Workload};
use crate::model::{Attributes, NO_SH_LIMIT};
use crate::models::InputModel;
use crate::player::page::{ChunkFiles, INDEX_FILE, PageModelInfo, PageScene, cameras, mean_up, training_rig};
use crate::player::poster::{self, render_poster};
use crate::player::quantization::{PlayerSteps, component_count};
use crate::player::track::{MAX_VALUES_PER_FRAME_GROUP, PageSequence, encode};
use crate::progress::Events;
use crate::scene::view_selection::render_background;
use crate::scene::{InputOptions, check_compressed, first_frame_box, open_compressed, open_scene};

/// Name of the stage that writes the page, for progress messages and the memory plan.
const NAME: &str = "view";

/// Options of the command `view`, which writes a page that plays one or two models.
#[derive(Debug, Clone)]
pub struct ViewOptions {
    /// Model to play, or the original of a compressed model. [`InputOptions::split`] is ignored: the views of all
    /// splits are used.
    pub original: InputOptions,
    /// Path of the compressed model to show beside the original, in any format.
    pub compressed: Option<PathBuf>,
    /// Maximum number of frames, evenly spaced from the first to the last.
    pub max_frames: usize,
    /// Maximum number of frames of the original that are shown beside a compressed model; `None`: as many as
    /// `max_frames`.
    pub original_frames: Option<usize>,
    /// Maximum SH degree with which the original is shown beside a compressed model; `None`: its own SH degree.
    pub original_degree: Option<usize>,
    /// Background color: red, green, blue in [0, 1]. If it is `None`, [`render_background`] chooses the color.
    pub background: Option<[f32; 3]>,
    /// Maximum number of bytes of encoded frames in a single HTML file. If there are more bytes, a folder is written.
    pub page_limit: u64,
    /// Path of the output: an HTML file NAME.html, or a folder.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

/// Result of the command `view`.
#[derive(Debug, Serialize)]
pub struct ViewReport {
    /// Path of the page to open in a browser.
    #[serde(serialize_with = "serialize_path")]
    pub page: PathBuf,
    /// Size of all written files in bytes.
    pub bytes: u64,
    /// Number of written files.
    pub files: usize,
    /// Number of frames that the page shows.
    pub frames: usize,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Checks, before any work, that the output of `options` may be written.
///
/// # Errors
/// Fails as [`check_target`] does, for example if the output exists and may not be replaced.
pub fn check(options: &ViewOptions) -> Result<()> {
    let kind = if is_page(&options.output) { TargetKind::File } else { TargetKind::Folder };
    check_target(&options.output, kind, &input_paths(options), options.overwrite)
}

/// Returns the paths that `options` reads, none of which may be overwritten.
fn input_paths(options: &ViewOptions) -> Vec<&Path> {
    let mut paths = vec![options.original.path.as_path()];
    paths.extend(options.original.cameras.as_deref());
    paths.extend(options.compressed.as_deref());
    paths
}

/// Returns the folder that is written instead of `page`, a single HTML file that would be too large: `small_page` for
/// `small.html`. Without the ending, it would be `small`, which often is the model that the page shows.
fn folder_of_page(page: &Path) -> PathBuf {
    let mut name = page.file_stem().unwrap_or_default().to_owned();
    name.push("_page");
    page.with_file_name(name)
}

/// Returns whether `output` names a single HTML file rather than a folder.
fn is_page(output: &Path) -> bool {
    output.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("html") || ending.eq_ignore_ascii_case("htm"))
}

/// Writes the page that plays the model, or two models side by side. Returns the path of the page, the number and size
/// of the written files, and the number of frames.
///
/// Memory: the Gaussians of one model at one frame, a group of its frames as quantized values
/// ([`MAX_VALUES_PER_FRAME_GROUP`]), and the render of the poster.
///
/// # Errors
/// Fails if the inputs, the cameras or the output are invalid. Nothing is written then.
pub fn view(options: &ViewOptions) -> Result<ViewReport> {
    check(options)?;
    options.compressed.as_deref().map_or(Ok(()), check_compressed)?;
    let mut scene = open_scene(&InputOptions { split: None, ..options.original.clone() })?;
    if scene.source().info().times.is_empty() {
        return Err(Error::input(&options.original.path, "", "at least one frame to show", "none"));
    }
    let compressed =
        options.compressed.as_deref().map(|path| open_compressed(path, &scene, &options.original)).transpose()?;
    let (compressed, note) = compressed.unzip();
    scene.notes.extend(note.flatten());
    let background = render_background(options.background, &scene)?;
    let limits = {
        let most = compressed.as_ref().map_or(0, |model| model.source().info().count as u64);
        let work = scene.workload();
        let work = Workload { gaussians: work.gaussians.max(most), ..work };
        MemoryPlan::fit_budget(work, options.original.memory, &options.original.events, |work, limits| {
            vec![estimate(work, limits)]
        })?
        .limits
    };
    scene.limits = limits;
    let bounds = first_frame_box(scene.source())?;
    let (middle, extent) = bounds.map_or(Default::default(), |found| (found.median, found.extent()));
    let steps = PlayerSteps::from_extent(if extent > 0.0 { extent } else { 1.0 });

    let all = options.max_frames.max(1);
    let (frames, degree) = match compressed {
        Some(_) => (options.original_frames.unwrap_or(all), options.original_degree.unwrap_or(NO_SH_LIMIT)),
        None => (all, NO_SH_LIMIT),
    };
    let (mut chunks, mut notes) = (ChunkFiles::new(&scene.scratch)?, std::mem::take(&mut scene.notes));
    let times = &scene.source().info().times;
    let asked = ModelView { role: "original", path: &scene.path, times, frames, degree };
    let mut models = vec![add_model(&*scene.input, 0, &asked, steps, &limits, &mut chunks, &scene.events)?];
    if let Some((path, model)) = options.compressed.as_deref().zip(compressed.as_deref()) {
        let asked = ModelView { role: "compressed", path, times, frames: all, degree: NO_SH_LIMIT };
        models.push(add_model(model, 1, &asked, steps, &limits, &mut chunks, &scene.events)?);
    }
    for model in models.iter().filter(|model| model.track.unseen > 0) {
        let (name, unseen) = (&model.name, model.track.unseen);
        notes.push(format!("{name}: {unseen} Gaussians are not finite, or too far away to be shown"));
    }
    let frames = models.iter().map(|model| model.track.times.len()).max().unwrap_or(0);
    let mut stage = PageScene {
        tool: TOOL,
        models,
        cameras: cameras(&scene.rig, scene.has_virtual_rig),
        background,
        center: middle.to_array(),
        extent: if extent > 0.0 { extent } else { 1.0 },
        up: mean_up(&scene.rig).to_array(),
        rig: if scene.has_cameras { training_rig(&scene.rig) } else { None },
        files: Vec::new(),
        poster: render_poster(scene.source(), &scene.rig, background, &limits)?,
    };
    if is_page(&options.output) && chunks.bytes() <= options.page_limit {
        let staged = StagedFile::new(&options.output, options.overwrite)?;
        let bytes = chunks.write_page(&stage, staged.path())?;
        staged.commit()?;
        return Ok(ViewReport { page: options.output.clone(), bytes, files: 1, frames, notes });
    }
    let folder = if is_page(&options.output) { folder_of_page(&options.output) } else { options.output.clone() };
    if is_page(&options.output) {
        check_target(&folder, TargetKind::Folder, &input_paths(options), options.overwrite)?;
        let (bytes, most) = (chunks.bytes(), options.page_limit);
        notes.push(format!(
            "{bytes} bytes of frames are more than the limit of one page ({most}, --page-limit); a folder was written instead"
        ));
    }
    let staged = StagedFolder::new(&folder, options.overwrite)?;
    let (names, bytes) = chunks.write_folder(&mut stage, staged.path())?;
    write_summary(staged.path(), &serde_json::json!({ "tool": TOOL, "page": INDEX_FILE, "frames": frames }))?;
    staged.commit()?;
    Ok(ViewReport { page: folder.join(INDEX_FILE), bytes, files: names.len(), frames, notes })
}

/// Settings for one model on the page: its role (`original` or `compressed`), its path, the times at which its frames
/// are shown, the maximum number of frames and the maximum SH degree.
struct ModelView<'a> {
    role: &'static str,
    path: &'a Path,
    times: &'a [f64],
    frames: usize,
    degree: usize,
}

/// Encodes the frames of `model` as model number `place` of the page, and adds the encoded chunks (groups of frames) to
/// `chunks`. Returns the description of the model for the page. `model_view`: settings for this model. `steps`:
/// quantization steps.
fn add_model(
    model: &dyn InputModel,
    place: usize,
    model_view: &ModelView<'_>,
    steps: PlayerSteps,
    limits: &Limits,
    chunks: &mut ChunkFiles,
    events: &Events,
) -> Result<PageModelInfo> {
    let source = model.source();
    let (times, sh_degree) = (model_view.times, source.info().sh_degree);
    let frames = evenly(times.len(), model_view.frames);
    let mut track = PageSequence::plan(source, &frames, model_view.degree, steps);
    track.times = frames.iter().map(|&frame| times[frame]).collect();
    let groups = track.groups.clone();
    encode(source, &frames, &mut track, limits.max_kept_frames, events, |chunk, bytes| {
        let since = chunk.checked_sub(1).map_or(0.0, |group| groups[group] as f64 / frames.len() as f64);
        chunks.add_chunk(place, chunk, since, &bytes)
    })?;
    let name = model_view.path.file_name().unwrap_or(model_view.path.as_os_str()).to_string_lossy().into_owned();
    Ok(PageModelInfo {
        role: model_view.role,
        name,
        bytes: model.size()?.total(),
        frames: times.len(),
        degree: sh_degree,
        track,
    })
}

/// Returns at most `count` of the indices from 0 to `frames` − 1, evenly spaced from first to last.
fn evenly(frames: usize, count: usize) -> Vec<usize> {
    let count = count.clamp(1, frames.max(1));
    let step = (frames.max(1) - 1) as f64 / (count - 1).max(1) as f64;
    (0..count.min(frames)).map(|i| (i as f64 * step).round_ties_even() as usize).collect()
}

/// Returns the resource estimate (memory, time, reads) of encoding the frames of one model for the page.
fn estimate(work: &Workload, limits: &Limits) -> ResourceEstimate {
    let [per_gaussian, render] = poster::poster_memory();
    let points = 4 * component_count(work.sh_degree) as u64;
    let of_all = points / 4 * work.gaussians * work.frames.max(1);
    ResourceEstimate {
        stage: NAME,
        reads: 1.0,
        seconds: work.reading_seconds(work.gaussian_count(), work.frames as f64),
        per_gaussian: vec![
            ("states", 2 * work.state_bytes(Attributes::all())),
            ("readers", work.input.reader),
            ("kept frames", work.kept_frames_bytes(limits, Attributes::all())),
            ("points", 3 * points),
            per_gaussian,
        ],
        // Part `group`: the frames of a group, eight of its components as differences and as bytes, and the compressed
        // chunk.
        fixed: vec![work.block_buffer_memory(), render, ("group", 10 * of_all.min(MAX_VALUES_PER_FRAME_GROUP as u64))],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_evenly_from_first_to_last() {
        assert_eq!(evenly(60, 4), [0, 20, 39, 59]);
        assert_eq!(evenly(3, 60), [0, 1, 2]);
        assert_eq!(evenly(5, 1), [0]);
        assert_eq!(evenly(0, 60), [0usize; 0]);
    }
}
