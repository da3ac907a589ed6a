//! Request structs of the library, made from the arguments of each command.

use std::path::{Path, PathBuf};

use super::args::{
    self, CacheArgs, CameraFile, CompareArgs, Compress, Convert, Demo, Input, Memory, OutputFormat, OutputSize,
    PrecisionArgs, Render, Sweep, TestScene, Trained, ViewArgs,
};
use gseq::Compression;
use splatsieve::cache::CacheRequest;
use splatsieve::commands::container::StoragePrecision;
use splatsieve::commands::render::{RenderOptions, RenderSelection};
use splatsieve::commands::video::{VideoCamera, VideoOptions};
use splatsieve::diagnostics::demo::DemoOptions;
use splatsieve::diagnostics::precision::{Knob, PrecisionOptions};
use splatsieve::diagnostics::sweep::SweepOptions;
use splatsieve::diagnostics::test_scene::TestSceneOptions;
use splatsieve::error::{Error, Result, ShowPath};
use splatsieve::evaluation::EvaluateOptions;
use splatsieve::evaluation::method::Method;
use splatsieve::files::atomic::Replace;
use splatsieve::files::cameras::TimesSource;
use splatsieve::files::image::write::ImageFormat;
use splatsieve::machine::return_freed_memory;
use splatsieve::memory_plan::{Budget, Verbosity};
use splatsieve::model::Split;
use splatsieve::models::{LinkMode, TrainingConventions};
use splatsieve::outputs::kind::OutputKind;
use splatsieve::pipeline::{FitTarget, PruneOrMerge, Request, RunOptions, Target};
use splatsieve::player::view;
use splatsieve::player::view::ViewOptions;
use splatsieve::progress::Events;
use splatsieve::scene::view_selection::ViewSet;
use splatsieve::scene::{InputOptions, scratch_beside};

/// Returns the library's request for the command `compress`. If the recipe file records the options of an earlier run,
/// options that are not on the command line are taken from this record. Unless `quiet` is set, the run will report its
/// estimated time before it starts.
///
/// # Errors
/// Fails if the recipe or the goal (a quality or a size on disk) is invalid, or if the recipe file records cameras,
/// times or photographs that do not exist.
pub(super) fn compress_options(args: Compress, quiet: bool, events: &Events) -> Result<Request> {
    let recipe = args.recipe.recipe()?;
    let kind = requested_kind(&args.format, &args.output)?;
    let record = args.recipe.record()?;
    let (has_split, has_cameras) = (args.cameras.split.is_some(), args.cameras.file.cameras.is_some());
    let is_flipped = args.input.trained.rot4d_unflipped == Some(false);
    let mut input = input_options(args.input, Some(args.cameras.file), Some(&args.output), events);
    input.split = scored_split(args.cameras.split);
    input.work = cache_request(args.cache_args);
    if input.memory.tell == Verbosity::Nothing && !quiet {
        input.memory.tell = Verbosity::Time;
    }
    // A recipe file that a run wrote beside its result also records the options of this run.
    let run = match record.run {
        Some(run) => {
            if !has_split {
                input.split = run.split;
            }
            // The recorded number of frames replaces the times of the recorded cameras, so it is used only with these
            // cameras.
            if !has_cameras {
                input.frames = input.frames.or(run.frames);
            }
            if let (None, Some(cameras)) = (&input.cameras, &run.cameras) {
                args.recipe.check_recorded_path("cameras", cameras)?;
                input.cameras = Some(cameras.clone());
            }
            input.size = input.size.or(run.size);
            if let (TimesSource::Own, Some(times)) = (&input.times, &run.times) {
                input.times = TimesSource::parse(times);
                if let TimesSource::Table(table) = &input.times {
                    args.recipe.check_recorded_path("times", table)?;
                }
            }
            input.iteration = input.iteration.or(run.iteration);
            let conventions = &mut input.conventions;
            conventions.time_duration = conventions.time_duration.or(run.time_duration);
            conventions.rot4d_unflipped |= run.rot4d_unflipped && !is_flipped;
            conventions.zero_rotation = conventions.zero_rotation.or(run.zero_rotation);
            if let (LinkMode::Auto, Some(link)) = (input.link, run.link) {
                input.link = link;
            }
            run
        }
        None => RunOptions::default(),
    };
    let OutputSize { ratio, count, size, min_psnr, max_loss, ground_truth, toward } = args.size;
    let given = RunOptions {
        target_count: count,
        target_ratio: ratio,
        min_psnr,
        max_loss,
        target_size: size,
        ..RunOptions::default()
    };
    // A target on the command line replaces the target of the recorded run.
    let is_open = given == RunOptions::default();
    let toward = toward.unwrap_or(run.toward);
    let mut chosen = RunOptions { toward, ..if is_open { run.clone() } else { given } };
    let needs_photographs = chosen.max_loss.is_some() || toward == FitTarget::Photographs;
    chosen.ground_truth = ground_truth;
    if let (true, None, Some(recorded)) = (needs_photographs, &chosen.ground_truth, &run.ground_truth) {
        args.recipe.check_recorded_path("ground-truth", recorded)?;
        chosen.ground_truth = Some(recorded.clone());
    }
    let (target, goal) = (chosen.target(), chosen.goal().map_err(Error::usage)?);
    Ok(Request {
        input,
        output: args.output,
        kind: kind.or(run.output),
        recipe,
        archive_psnr: args.archive_psnr.or(run.archive_psnr),
        made_for: record.provenance.map(|from| from.input_digest),
        only: match (args.prune_only, args.merge_only) {
            (true, _) => PruneOrMerge::Prune,
            (_, true) => PruneOrMerge::Merge,
            _ => run.mode,
        },
        target,
        goal,
        photographs: chosen.ground_truth.filter(|_| toward == FitTarget::Photographs),
        keep_ids: args.overrides.keep_ids.or(run.keep_ids),
        drop_ids: args.overrides.drop_ids.or(run.drop_ids),
        keep_box: args.overrides.keep_box.or(run.keep_box),
        overwrite: replace(args.results.overwrite),
    })
}

/// Returns the library's options for `render` without `--video`.
///
/// # Errors
/// Fails if an option that needs `--video` is given, or if `--as` and the name of the output ask for different formats.
pub(super) fn render_options(args: Render, events: &Events) -> Result<RenderOptions> {
    // The parser accepts these options without --video, because --output excludes it.
    let video_flags =
        [("--path", args.path.is_some()), ("--fps", args.fps.is_some()), ("--beside", args.beside.is_some())];
    if let Some((flag, _)) = video_flags.into_iter().find(|(_, given)| *given) {
        return Err(Error::usage(format!("{flag} needs --video FILE")));
    }
    let format = args.format.unwrap_or(ImageFormat::Png);
    let (selection, views) = match args.frame.zip(args.view) {
        Some((frame, view)) => (RenderSelection::One { frame: frame as usize, view }, ViewSet::All),
        None => (RenderSelection::All(format), ViewSet::HeldOut),
    };
    let output = args.output.unwrap_or_default();
    let named = ImageFormat::from_path(&output).filter(|named| args.format.is_some() && *named != format);
    if let (RenderSelection::One { .. }, Some(named)) = (selection, named) {
        let (asked, named, path) = (format.extension(), named.extension(), output.shown());
        return Err(Error::usage(format!(
            "{path}: --as {asked} asks for another format than the name of the output, .{named}\n  leave out --as, or \
             give a name that ends in .{asked}"
        )));
    }
    let mut input = input_options(args.input, Some(args.cameras), Some(&output), events);
    input.work = cache_request(args.cache_args);
    Ok(RenderOptions {
        input,
        selection,
        views: args.split.unwrap_or(views),
        background: args.background.background,
        output,
        overwrite: replace(args.results.overwrite),
    })
}

/// Returns the library's options for `render --video`. The video is written to `output`.
pub(super) fn video_options(args: Render, output: PathBuf, events: &Events) -> VideoOptions {
    let (path, views) = match args.path {
        Some(views) => (VideoCamera::Path(views), ViewSet::HeldOut),
        None => (VideoCamera::View(args.view), ViewSet::All),
    };
    let mut input = input_options(args.input, Some(args.cameras), Some(&output), events);
    input.work = cache_request(args.cache_args);
    VideoOptions {
        input,
        beside: args.beside,
        path,
        views: args.split.unwrap_or(views),
        fps: args.fps.unwrap_or(25),
        background: args.background.background,
        output,
        overwrite: replace(args.results.overwrite),
    }
}

/// Returns the library's options for comparing the renders of two models. The options request no CSV file of the
/// scores; the caller can add one.
pub(super) fn evaluate_options(args: CompareArgs, output: Option<&Path>, events: &Events) -> EvaluateOptions {
    let original = input_options(args.input, Some(args.cameras), output, events);
    EvaluateOptions {
        original,
        compressed: args.compressed,
        ground_truth: args.ground_truth,
        views: args.split.unwrap_or(ViewSet::HeldOut),
        max_frames: args.max_frames.map(|frames| frames as usize),
        max_views: args.max_views.map(|views| views as usize),
        background: args.background.background,
        flip: args.flip,
        csv: None,
        overwrite: Replace::Never,
    }
}

/// Returns the library's options for `view`.
pub(super) fn view_options(args: ViewArgs, events: &Events) -> ViewOptions {
    let original = input_options(args.input, Some(args.cameras), Some(&args.output), events);
    ViewOptions {
        original,
        compressed: args.compressed,
        max_frames: args.max_frames as usize,
        original_frames: args.original_frames.map(|frames| frames as usize),
        original_degree: args.original_degree.map(usize::from),
        background: args.background.background,
        page_limit: args.page_limit,
        output: args.output,
        overwrite: replace(args.results.overwrite),
    }
}

/// Returns the options of the page that shows the result of `request` beside its input (`compress --view`). `output` is
/// the path of the page; `None` chooses a path beside the result.
///
/// # Errors
/// Fails if the input is a stream, or if the page cannot be written. Both are checked before the run.
pub(super) fn result_page_options(request: &Request, output: Option<PathBuf>) -> Result<ViewOptions> {
    if request.input.is_stream() {
        return Err(Error::usage(
            "--view: a stream can be read only once, so its result cannot be shown beside it\n  leave out --view, and use \
             `splatsieve view` on the result",
        ));
    }
    let page_path = || {
        let mut name = request.output.clone().into_os_string();
        name.push(".html");
        PathBuf::from(name)
    };
    let mut original = request.input.clone();
    (original.work, original.memory.tell) = (None, Verbosity::Nothing);
    let options = ViewOptions {
        original,
        compressed: Some(request.output.clone()),
        max_frames: args::DEFAULT_FRAMES as usize,
        original_frames: None,
        original_degree: None,
        background: None,
        page_limit: args::default_page_limit(),
        output: output.unwrap_or_else(page_path),
        overwrite: request.overwrite,
    };
    view::check(&options)?;
    Ok(options)
}

/// Returns the library's options for `sweep`.
pub(super) fn sweep_options(args: Sweep, events: &Events) -> SweepOptions {
    let input = input_options(args.input, Some(args.cameras), Some(&args.output), events);
    let named = |name: &String| Method::ALL.into_iter().find(|method| method.name() == name);
    SweepOptions {
        input,
        methods: args.methods.iter().filter_map(named).collect(),
        fractions: args.fractions,
        steps: args.steps,
        steps_at: args.steps_at,
        runs: args.repeat as usize,
        max_frames: Some(args.max_frames as usize),
        background: args.background.background,
        output: args.output,
        overwrite: replace(args.results.overwrite),
    }
}

/// Returns the library's options for `precision`.
///
/// # Errors
/// Fails if the recipe is invalid.
pub(super) fn precision_options(args: PrecisionArgs, events: &Events) -> Result<PrecisionOptions> {
    let input = input_options(args.input, Some(args.cameras), Some(&args.output), events);
    let named = |name: &String| Knob::ALL.into_iter().find(|knob| knob.name() == name);
    let knobs: Vec<Knob> = args.knobs.iter().filter_map(named).collect();
    Ok(PrecisionOptions {
        input,
        recipe: args.recipe.recipe()?,
        knobs: (!knobs.is_empty()).then_some(knobs),
        target: Target::Ratio(args.ratio),
        max_frames: args.max_frames as usize,
        runs: args.repeat as usize,
        output: args.output,
        overwrite: replace(args.results.overwrite),
    })
}

/// Returns the library's options for `demo`.
pub(super) fn demo_options(args: Demo, events: &Events) -> DemoOptions {
    DemoOptions {
        gaussians: args.gaussians as usize,
        frames: args.frames as usize,
        steps: args.refine_steps,
        output: args.output,
        overwrite: replace(args.results.overwrite),
        memory: memory_budget(args.memory),
        events: events.clone(),
    }
}

/// Returns the library's options for `test-scene`.
///
/// # Errors
/// Fails if the recipe is invalid.
pub(super) fn test_scene_options(args: TestScene, events: &Events) -> Result<TestSceneOptions> {
    Ok(TestSceneOptions {
        gaussians: args.gaussians as usize,
        frames: args.frames as usize,
        kept: Target::Ratio(args.ratio),
        recipe: args.recipe.recipe()?,
        output: args.output,
        overwrite: replace(args.overwrite),
        memory: memory_budget(args.memory),
        events: events.clone(),
    })
}

/// Returns the compression and the error bounds with which `convert` stores the values of a container.
pub(super) fn storage_precision(args: &Convert) -> StoragePrecision {
    match (args.raw, args.max_error.clone()) {
        (true, _) => StoragePrecision::Exact(Compression::Raw),
        (_, bounds) if bounds.is_empty() => StoragePrecision::Exact(Compression::Zstd(args.level.unwrap_or(1))),
        (_, bounds) => StoragePrecision::Within(bounds, args.level.unwrap_or(15)),
    }
}

/// Returns the output format that `--as` and `--spz-version` name; `None` if the name of the output decides.
///
/// # Errors
/// Fails if a version of `.spz` is named for an output of another format.
pub(super) fn requested_kind(format: &OutputFormat, output: &Path) -> Result<Option<OutputKind>> {
    let kind = format.kind;
    let Some(version) = format.spz_version else { return Ok(kind) };
    if OutputKind::from_path(output, kind, OutputKind::Model) != OutputKind::Spz {
        return Err(Error::usage(format!("--spz-version: expected an output NAME.spz, found {}", output.shown())));
    }
    Ok(if version == 4 { Some(OutputKind::Spz4) } else { kind })
}

/// Returns the cache folder and the shard (part of a divided stage) that the arguments name; `None` without `--cache`.
pub(super) fn cache_request(cache_args: CacheArgs) -> Option<CacheRequest> {
    cache_args.cache.map(|folder| CacheRequest { folder, shard: cache_args.shard })
}

/// Returns the policy for an output path that already exists, from the flag `--overwrite`.
pub(super) fn replace(overwrite: bool) -> Replace {
    if overwrite { Replace::Existing } else { Replace::Never }
}

/// Returns the library's memory settings: the memory limit, and whether the memory plan is printed. If a limit is
/// given, also makes the allocator return freed memory to the system at once, on systems that support this.
fn memory_budget(memory: Memory) -> Budget {
    if memory.memory.is_some() {
        return_freed_memory();
    }
    Budget { bytes: memory.memory, tell: if memory.explain { Verbosity::Plan } else { Verbosity::Nothing } }
}

/// Returns the split whose views Gaussians are scored by, from the option `--split`; `None` for the views of all
/// splits.
pub(super) fn scored_split(split: Option<ViewSet>) -> Option<Split> {
    match split {
        None => Some(Split::Train),
        Some(ViewSet::Split(split)) => Some(split),
        Some(ViewSet::All | ViewSet::HeldOut) => None,
    }
}

/// Returns the library's options for opening an input, with cameras if the command has any. Temporary files go to the
/// folder that `--scratch-dir` names. Without this option, they go to the folder that contains `output`, or to the
/// system's folder for temporary files if `output` is `None`.
pub(super) fn input_options(
    input: Input,
    cameras: Option<CameraFile>,
    output: Option<&Path>,
    events: &Events,
) -> InputOptions {
    let events = events.clone();
    let mut options = InputOptions { path: input.input, iteration: input.iteration, events, ..InputOptions::default() };
    options.allow_gaps = input.allow_gaps;
    // Facts about the training that model files do not record.
    let Trained { time_duration, rot4d_unflipped, zero_rotation } = input.trained;
    let rot4d_unflipped = rot4d_unflipped.unwrap_or(false);
    options.conventions = TrainingConventions { time_duration, rot4d_unflipped, zero_rotation };
    options.link = input.link.unwrap_or(LinkMode::Auto);
    options.memory = memory_budget(input.memory);
    options.is_scratch_named = input.scratch_dir.is_some();
    options.scratch = input.scratch_dir.or_else(|| output.and_then(scratch_beside));
    if let Some(cameras) = cameras {
        options.cameras = cameras.cameras;
        options.size = cameras.resolution;
        options.times = cameras.times.unwrap_or_default();
        options.frames = cameras.frames.map(|frames| frames as usize);
    }
    options
}
