//! Arguments, streams and exit codes. Data goes to stdout, everything else to stderr; [`Error`] has the table of exit codes.

mod args;
mod help;
mod message;
mod output;
mod progress;
mod recipe_flags;
mod signals;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::FromArgMatches;
use gseq::Compression;

use args::{
    CacheArgs, CameraFile, Cameras, Cli, CommandArgs, CompareArgs, Compress, Convert, ImageKind, InfoArgs, Input,
    Memory, OutputSize, Render, Rot4d, SplitArg, Sweep, Trained, ViewArgs, ZeroRotationArg,
};
use message::tell;
use output::{print, print_as};
use progress::Display;
use splatsieve::cache::{self, Completion};
use splatsieve::commands::container::Storing;
use splatsieve::commands::render::{RenderOptions, RenderSelection};
use splatsieve::commands::video::{FilmPath, VideoOptions, places, video};
use splatsieve::commands::{container, convert, render, score};
use splatsieve::diagnostics::demo::DemoOptions;
use splatsieve::diagnostics::precision::{Knob, PrecisionOptions};
use splatsieve::diagnostics::selfcheck;
use splatsieve::diagnostics::sweep::SweepOptions;
use splatsieve::diagnostics::test_scene::TestSceneOptions;
use splatsieve::diagnostics::{demo, precision, sweep, test_scene};
use splatsieve::error::{Error, Result, ShowPath};
use splatsieve::evaluation;
use splatsieve::evaluation::EvaluateOptions;
use splatsieve::evaluation::method::Method;
use splatsieve::files::atomic::{Replace, take_warnings, with_user_path};
use splatsieve::files::cameras::Times;
use splatsieve::files::image::write::ImageFormat;
use splatsieve::memory_plan;
use splatsieve::memory_plan::{Budget, Verbosity};
use splatsieve::model::Split;
use splatsieve::models::{Conventions, Link, ZeroRotation};
use splatsieve::outputs::kind::OutputKind;
use splatsieve::pipeline::summary::Detail;
use splatsieve::pipeline::{Only, Request, RunOptions, Target, compress, divided_stages, foresee};
use splatsieve::player::view;
use splatsieve::player::view::ViewOptions;
use splatsieve::progress::Events;
use splatsieve::recipe::preset_text;
use splatsieve::report::{self, ReportOptions, trade_off};
use splatsieve::scene::pictures::ViewSet;
use splatsieve::scene::{InputOptions, scratch_beside};

/// Runs the program on the arguments of this process.
pub(crate) fn main() -> ExitCode {
    let cli = match parse(std::env::args_os()) {
        Ok(cli) => cli,
        Err(error) => {
            // Messages quote arguments, which may be names of files: as they are shown.
            let shown = std::env::args_os().map(|word| word.shown().to_string().into());
            let error = parse(shown).err().unwrap_or(error);
            // `--help` and `--version` arrive here too, with exit code 0.
            let code = error.exit_code() as u8;
            return output::print_clap(&error).map_or_else(ended_by, |()| ExitCode::from(code));
        }
    };
    // Before anything is begun.
    signals::install();
    let explains = cli.command.explains();
    let result = run(cli);
    // Results that these warnings name are in place, so the exit code stays.
    for warning in take_warnings() {
        tell(&format!("warning: {warning}"));
    }
    match result {
        Ok(()) => {
            if let Some(taken) = memory_plan::taken().filter(|_| explains) {
                tell(&taken);
            }
            ExitCode::SUCCESS
        }
        Err(error) => ended_by(error),
    }
}

fn parse(words: impl Iterator<Item = OsString>) -> std::result::Result<Cli, clap::Error> {
    help::command().try_get_matches_from(words).and_then(|found| Cli::from_arg_matches(&found))
}

/// Tells why a run failed and returns its exit code. A reader of standard output that has seen enough is no failure.
fn ended_by(error: Error) -> ExitCode {
    if output::has_no_reader(&error) {
        return ExitCode::SUCCESS;
    }
    let error = with_user_path(error);
    tell(&format!("splatsieve: {error}"));
    ExitCode::from(error.kind().exit_code())
}

/// Returns the result of a whole run. Prints what a run of one part did, and returns `None`.
fn whole<T>(completion: Completion<T>) -> Result<Option<T>> {
    match completion {
        Completion::Whole(found) => Ok(Some(found)),
        Completion::Shard(done) => print(&format!("{done}\n")).map(|()| None),
    }
}

fn run(cli: Cli) -> Result<()> {
    if let Some(threads) = cli.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|error| Error::usage(format!("--threads {threads}: {error}")))?;
    }
    let events = Events::new(Display::new(cli.quiet));
    match cli.command {
        CommandArgs::Compress(args) => {
            let (json, list_stages, dry_run) = (args.json, args.list_stages, args.dry_run);
            let detail = if args.verbose { Detail::All } else { Detail::Most };
            let view_output = args.view.clone();
            let request = compress_options(*args, cli.quiet, &events)?;
            if list_stages {
                return print(&divided_stages(&request)?.iter().map(|stage| format!("{stage}\n")).collect::<String>());
            }
            if dry_run {
                let foreseen = foresee(&request)?;
                return print_as(json, &if json { foreseen.json() } else { foreseen.text() });
            }
            let page = view_output.map(|output| view_of_result(&request, output)).transpose()?;
            let Some(summary) = whole(compress(&request)?)? else { return Ok(()) };
            let printed = print_as(json, &if json { summary.json() } else { summary.text(detail) });
            // The page was asked for, whether or not somebody reads the summary. That is what stdout is for.
            if let Some(page) = page {
                let shown = viewed(&page);
                if shown.is_err() {
                    tell(&format!("{} is complete and in place; its page is not:", request.output.shown()));
                }
                tell(&shown?);
            }
            printed
        }
        CommandArgs::Score(args) => {
            let input = input_options(args.input, Some(args.cameras), Some(&args.output), &events);
            let report = score::score(&input, &args.output, &args.recipe.recipe()?, args.earlier.replace())?;
            notes(&report.notes);
            print(&format!(
                "{}: {} Gaussians, of which the recipe keeps {} before merging\n",
                report.output.shown(),
                report.gaussians,
                report.kept
            ))
        }
        CommandArgs::Render(mut args) => {
            if let Some(output) = args.video.take() {
                return film(args, output, &events);
            }
            let options = render_options(args, &events)?;
            let Some(rendered) = whole(render::render(&options)?)? else { return Ok(()) };
            notes(&rendered.notes);
            let plural = if rendered.pictures == 1 { "" } else { "s" };
            print(&format!("{}: {} picture{plural}\n", options.output.shown(), rendered.pictures))
        }
        CommandArgs::Evaluate(args) => {
            let as_json = args.json;
            let mut options = EvaluateOptions {
                csv: args.csv,
                overwrite: args.earlier.replace(),
                ..evaluate_options(args.models, &events)
            };
            options.original.work = work_of(args.kept);
            let Some(found) = whole(evaluation::evaluate(&options)?)? else { return Ok(()) };
            notes(&found.work_notes);
            print_as(as_json, &if as_json { json(&found) } else { found.text() })
        }
        CommandArgs::Sweep(args) => {
            let (as_json, page) = (args.json, args.output.join(trade_off::PAGE));
            let found = sweep::sweep(&sweep_options(args, &events))?;
            print_as(as_json, &if as_json { found.json() } else { format!("{}{}\n", found.text(), page.shown()) })
        }
        CommandArgs::Precision(args) => {
            let (as_json, page) = (args.json, args.output.join(report::precision::PAGE));
            let found = precision::precision(&precision_options(args, &events)?)?;
            print_as(as_json, &if as_json { found.json() } else { format!("{}{}\n", found.text(), page.shown()) })
        }
        CommandArgs::Report(args) => {
            let page = args.output.join(report::PAGE);
            let mut evaluate = evaluate_options(args.models, &events);
            evaluate.original.work = work_of(args.kept);
            let options = ReportOptions {
                evaluate,
                more: args.more,
                sweep: args.sweep,
                precision: args.precision,
                render_time: args.render_time,
                output: args.output,
                overwrite: args.earlier.replace(),
            };
            let Some(found) = whole(report::report(&options)?)? else { return Ok(()) };
            let mut verdicts = String::new();
            for result in std::iter::once(&found.result).chain(&found.others) {
                notes(&result.work_notes);
                notes(&result.notes);
                if !found.others.is_empty() {
                    verdicts += &format!("{}: ", Path::new(&result.evaluation.path.compressed).shown());
                }
                verdicts += &format!("{}\n", result.verdict);
            }
            print(&format!("{verdicts}{}\n", page.shown()))
        }
        CommandArgs::View(args) => print(&(viewed(&view_options(args, &events))? + "\n")),
        CommandArgs::Convert(args) => write_converted(args, &events),
        CommandArgs::Info(args) => write_info(args, &events),
        CommandArgs::Cache(args) => {
            if args.clean {
                let (files, bytes) = cache::clean(&args.folder)?;
                return print(&format!("{}: {files} files, {bytes} bytes removed\n", args.folder.shown()));
            }
            let listed = cache::list(&args.folder)?;
            print_as(args.json, &if args.json { json(&listed) } else { cache::text(&listed) })
        }
        CommandArgs::Demo(args) => {
            let options = DemoOptions {
                gaussians: args.gaussians as usize,
                frames: args.frames as usize,
                steps: args.refine_steps,
                output: args.output,
                overwrite: args.earlier.replace(),
                memory: budget_of(args.memory),
                events,
            };
            print(&demo::run(&options)?.text(&options.output))
        }
        CommandArgs::TestScene(args) => {
            let options = TestSceneOptions {
                gaussians: args.gaussians as usize,
                frames: args.frames as usize,
                kept: Target::Ratio(args.ratio),
                recipe: args.recipe.recipe()?,
                output: args.output,
                overwrite: args.earlier.replace(),
                memory: budget_of(args.memory),
                events,
            };
            print(&test_scene::run(&options)?.text())?;
            if let Some(folder) = options.output {
                tell(&format!("kept in {}: scene.gseq, cameras.json, compressed.gseq", folder.shown()));
            }
            Ok(())
        }
        CommandArgs::Selfcheck(args) => {
            let found = selfcheck::run();
            let printed = print_as(args.json, &if args.json { json(&found) } else { found.text() });
            found.verdict()?;
            printed
        }
        CommandArgs::Recipe(args) => print(preset_text(&args.preset)?),
        CommandArgs::Completions(args) => {
            let mut script = Vec::new();
            clap_complete::generate(args.shell, &mut help::command(), "splatsieve", &mut script);
            output::write(&script)
        }
        CommandArgs::Man(args) => {
            let pages = help::write_pages(&args.folder)?;
            print(&format!("{}: {pages} pages\n", args.folder.shown()))
        }
    }
}

/// Writes an input in another format and prints what was written.
fn write_converted(args: Convert, events: &Events) -> Result<()> {
    let path = args.output.or(args.output_option).ok_or_else(|| Error::internal("convert has no output"))?;
    let is_stdout = path.as_os_str() == "-";
    let is_stored_differently = args.raw || args.level.is_some() || !args.max_error.is_empty();
    let storing = match (args.raw, args.max_error) {
        (true, _) => Storing::Exact(Compression::StoredParams),
        (_, bounds) if bounds.is_empty() => Storing::Exact(Compression::Zstd(args.level.unwrap_or(1))),
        (_, bounds) => Storing::Within(bounds, args.level.unwrap_or(15)),
    };
    let output = (!is_stdout).then_some(path.as_path());
    let has_cache = args.kept.cache.is_some();
    let mut input = input_options(args.input, Some(args.cameras), output, events);
    input.work = work_of(args.kept);
    let asked = args.kind.map(kind_of);
    let is_container = !is_stdout && convert::is_container(&path, asked);
    let refuse =
        |options: &str| Err(Error::usage(format!("{options}: expected an output NAME.gseq, found {}", path.shown())));
    if is_stored_differently && !is_container {
        return refuse("--max-error, --raw and --level");
    }
    if has_cache && !is_container {
        return refuse("--cache");
    }
    if is_stdout {
        if output::is_terminal() {
            return Err(Error::usage("a frame stream is not for a terminal; pipe it into a program or a file"));
        }
        notes(&container::unpack_stream(&input, output::stdout().lock())?.notes);
        return Ok(());
    }
    let converted = if is_container {
        let Some(done) = whole(container::pack(&input, &path, &storing, args.earlier.replace())?)? else {
            return Ok(());
        };
        done
    } else {
        convert::convert(&input, &path, asked, args.earlier.replace())?
    };
    if args.json {
        return print_as(true, &json(&converted));
    }
    notes(&converted.notes);
    print(&converted.text())
}

/// Prints what an input holds, or checks or repairs a container.
fn write_info(args: InfoArgs, events: &Events) -> Result<()> {
    let path = args.input.input.clone();
    if let Some(output) = args.repair {
        let report = container::recover(&path, &output, args.earlier.replace())?;
        let value = serde_json::json!({
            "path": output.to_string_lossy(), "frames": report.frames, "frames_seen": report.frames_seen,
            "tiles": report.tiles_saved,
        });
        let text = format!(
            "{}: {} complete frames of {} found, {} tiles\n",
            output.shown(),
            report.frames,
            report.frames_seen,
            report.tiles_saved
        );
        return print_as(args.json, &if args.json { json(&value) } else { text });
    }
    if args.check {
        let report = container::verify(&path)?;
        let (frames, tiles) = (report.frames, report.tiles);
        let (stored, decoded) = (report.stored_bytes, report.decoded_bytes);
        let value = serde_json::json!({
            "path": path.to_string_lossy(), "frames": frames, "tiles": tiles,
            "stored_bytes": stored, "decoded_bytes": decoded,
        });
        let path = path.shown();
        let text =
            format!("{path}: no damage; {frames} frames, {tiles} tiles, {stored} bytes that decode to {decoded}\n");
        return print_as(args.json, &if args.json { json(&value) } else { text });
    }
    let info = container::info(&input_options(args.input, None, None, events))?;
    print_as(args.json, &if args.json { json(&info) } else { info.text() })
}

fn kind_of(asked: args::OutputKindArg) -> OutputKind {
    match asked {
        args::OutputKindArg::Model => OutputKind::Model,
        args::OutputKindArg::Gseq => OutputKind::Gseq,
        args::OutputKindArg::PlySequence => OutputKind::PlySequence,
        args::OutputKindArg::Ply => OutputKind::Ply,
        args::OutputKindArg::Archive => OutputKind::Archive,
        args::OutputKindArg::Splatv => OutputKind::Splatv,
        args::OutputKindArg::FourDgs => OutputKind::FourDgs,
        args::OutputKindArg::Spz => OutputKind::Spz,
    }
}

fn compress_options(args: Compress, quiet: bool, events: &Events) -> Result<Request> {
    let recipe = args.recipe.recipe()?;
    let kind = args.kind.map(kind_of);
    let record = args.recipe.record()?;
    let (has_split, has_cameras) = (args.cameras.split.is_some(), args.cameras.file.cameras.is_some());
    let is_flipped = args.input.trained.rot4d == Some(Rot4d::Flipped);
    let mut input = input_options(args.input, Some(args.cameras), Some(&args.output), events);
    input.work = work_of(args.kept);
    if input.memory.tell == Verbosity::Nothing && !quiet {
        input.memory.tell = Verbosity::Time;
    }
    // What the command line leaves open is as it was in the run that the recipe was written beside.
    let run = match record.run {
        Some(run) => {
            if !has_split {
                input.split = run.split;
            }
            // Frames go with the cameras that they replace.
            if !has_cameras {
                input.frames = input.frames.or(run.frames);
            }
            if let (None, Some(cameras)) = (&input.cameras, &run.cameras) {
                args.recipe.check_named("cameras", cameras)?;
                input.cameras = Some(cameras.clone());
            }
            input.size = input.size.or(run.size);
            if let (Times::Own, Some(times)) = (&input.times, &run.times) {
                input.times = Times::named(times);
                if let Times::Table(table) = &input.times {
                    args.recipe.check_named("times", table)?;
                }
            }
            input.iteration = input.iteration.or(run.iteration);
            let said = &mut input.conventions;
            said.time_duration = said.time_duration.or(run.time_duration);
            said.rot4d_unflipped |= run.rot4d_unflipped && !is_flipped;
            said.zero_rotation = said.zero_rotation.or(run.zero_rotation);
            if let (Link::Auto, Some(link)) = (input.link, run.link) {
                input.link = link;
            }
            run
        }
        None => RunOptions::default(),
    };
    let OutputSize { ratio, count, size, min_psnr, max_loss, ground_truth } = args.size;
    let asked = RunOptions {
        target_count: count,
        target_ratio: ratio,
        min_psnr,
        max_loss,
        target_size: size,
        ground_truth,
        ..RunOptions::default()
    };
    // One of them, of the command line if it names one.
    let of = if asked == RunOptions::default() { &run } else { &asked };
    if let (true, Some(photographs)) = (asked == RunOptions::default(), &run.ground_truth) {
        args.recipe.check_named("ground-truth", photographs)?;
    }
    let (target, goal) = (of.target(), of.goal().map_err(Error::usage)?);
    Ok(Request {
        input,
        output: args.output,
        kind: kind.or(run.output),
        recipe,
        archive_psnr: args.archive_psnr.or(run.archive_psnr),
        made_for: record.provenance.map(|from| from.input_digest),
        only: match (args.prune_only, args.merge_only) {
            (true, _) => Only::Prune,
            (_, true) => Only::Merge,
            _ => run.mode,
        },
        target,
        goal,
        keep_ids: args.overrides.keep_ids.or(run.keep_ids),
        drop_ids: args.overrides.drop_ids.or(run.drop_ids),
        keep_box: args.overrides.keep_box.or(run.keep_box),
        overwrite: args.earlier.replace(),
    })
}

fn render_options(args: Render, events: &Events) -> Result<RenderOptions> {
    // The parser lets them pass beside what --video does not go with.
    let of_films =
        [("--path", args.path.is_some()), ("--fps", args.fps.is_some()), ("--beside", args.beside.is_some())];
    if let Some((flag, _)) = of_films.into_iter().find(|(_, given)| *given) {
        return Err(Error::usage(format!("{flag} is for --video FILE")));
    }
    let format = match args.format {
        Some(ImageKind::Npy) => ImageFormat::Npy,
        Some(ImageKind::Png) | None => ImageFormat::Png,
    };
    let (wanted, part) = match args.frame.zip(args.view) {
        Some((frame, view)) => (RenderSelection::One { frame: frame as usize, view }, ViewSet::All),
        None => (RenderSelection::All(format), ViewSet::HeldOut),
    };
    let output = args.output.unwrap_or_default();
    let mut input = input_options(args.input, None, Some(&output), events);
    args.cameras.apply_to(&mut input);
    input.work = work_of(args.kept);
    Ok(RenderOptions {
        input,
        wanted,
        part: args.split.map_or(part, part_of),
        background: args.background.background,
        output,
        overwrite: args.earlier.replace(),
    })
}

/// `render --video`.
fn film(args: Render, output: PathBuf, events: &Events) -> Result<()> {
    let (way, part) = match args.path {
        Some(views) => (FilmPath::Path(views), ViewSet::HeldOut),
        None => (FilmPath::View(args.view), ViewSet::All),
    };
    let mut input = input_options(args.input, None, Some(&output), events);
    args.cameras.apply_to(&mut input);
    input.work = work_of(args.kept);
    let options = VideoOptions {
        input,
        beside: args.beside,
        way,
        part: args.split.map_or(part, part_of),
        fps: args.fps.unwrap_or(25),
        background: args.background.background,
        output,
        overwrite: args.earlier.replace(),
    };
    let filmed = video(&options)?;
    notes(&filmed.notes);
    let (path, (width, height), fps) = (options.output.shown(), filmed.size, options.fps);
    let places = options.beside.as_deref().map(|right| format!("  {}\n", places(&options.input.path, right)));
    let places = places.unwrap_or_default();
    print(&format!("{path}: {} frames of {width}x{height}, {fps} a second\n{places}", filmed.frames))
}

fn evaluate_options(args: CompareArgs, events: &Events) -> EvaluateOptions {
    let mut original = InputOptions { path: args.original, iteration: args.iteration, ..InputOptions::default() };
    original.allow_gaps = args.allow_gaps;
    original.link = args.link.map_or(Link::Auto, Link::from);
    original.conventions = conventions(&args.trained);
    args.cameras.apply_to(&mut original);
    original.memory = budget_of(args.memory);
    original.events = events.clone();
    EvaluateOptions {
        original,
        compressed: args.compressed,
        ground_truth: args.ground_truth,
        part: args.split.map_or(ViewSet::HeldOut, part_of),
        max_frames: args.max_frames.map(|frames| frames as usize),
        max_views: args.max_views.map(|views| views as usize),
        background: args.background.background,
        flip: args.flip,
        csv: None,
        overwrite: Replace::Never,
    }
}

fn view_options(args: ViewArgs, events: &Events) -> ViewOptions {
    let mut original = input_options(args.input, None, Some(&args.output), events);
    args.cameras.apply_to(&mut original);
    ViewOptions {
        original,
        compressed: args.compressed,
        max_frames: args.max_frames as usize,
        original_frames: args.original_frames.map(|frames| frames as usize),
        original_degree: args.original_degree.map(usize::from),
        background: args.background.background,
        page_limit: args.page_limit,
        output: args.output,
        overwrite: args.earlier.replace(),
    }
}

/// The page of what `request` writes beside what it reads; that it may be written is known before the run.
fn view_of_result(request: &Request, output: Option<PathBuf>) -> Result<ViewOptions> {
    if request.input.is_stream() {
        return Err(Error::usage(
            "--view: a stream is read once, and gone when its result is there; view the result alone",
        ));
    }
    let beside = || {
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
        output: output.unwrap_or_else(beside),
        overwrite: request.overwrite,
    };
    view::check(&options)?;
    Ok(options)
}

/// Writes a page and says where it is.
fn viewed(options: &ViewOptions) -> Result<String> {
    let found = view::view(options)?;
    notes(&found.notes);
    let files = if found.files == 1 { String::new() } else { format!(" in {} files", found.files) };
    Ok(format!("{}: {} frames, {} bytes{files}", found.page.shown(), found.frames, found.bytes))
}

fn sweep_options(args: Sweep, events: &Events) -> SweepOptions {
    let mut input = input_options(args.input, None, Some(&args.output), events);
    args.cameras.apply_to(&mut input);
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
        overwrite: args.earlier.replace(),
    }
}

fn precision_options(args: args::PrecisionArgs, events: &Events) -> Result<PrecisionOptions> {
    let mut input = input_options(args.input, None, Some(&args.output), events);
    args.cameras.apply_to(&mut input);
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
        overwrite: args.earlier.replace(),
    })
}

fn part_of(split: SplitArg) -> ViewSet {
    match split {
        SplitArg::Train => ViewSet::Split(Split::Train),
        SplitArg::Val => ViewSet::Split(Split::Val),
        SplitArg::Test => ViewSet::Split(Split::Test),
        SplitArg::All => ViewSet::All,
    }
}

fn work_of(kept: CacheArgs) -> Option<cache::CacheRequest> {
    kept.cache.map(|folder| cache::CacheRequest { folder, part: kept.shard })
}

fn budget_of(memory: Memory) -> Budget {
    Budget { bytes: memory.memory, tell: if memory.explain { Verbosity::Plan } else { Verbosity::Nothing } }
}

fn conventions(trained: &Trained) -> Conventions {
    let zero_rotation = trained.zero_rotation.map(|how| match how {
        ZeroRotationArg::Drop => ZeroRotation::Drop,
        ZeroRotationArg::Identity => ZeroRotation::Identity,
    });
    let rot4d_unflipped = trained.rot4d == Some(Rot4d::Unflipped);
    Conventions { time_duration: trained.time_duration, rot4d_unflipped, zero_rotation }
}

fn input_options(input: Input, cameras: Option<Cameras>, output: Option<&Path>, events: &Events) -> InputOptions {
    let events = events.clone();
    let mut options = InputOptions { path: input.input, iteration: input.iteration, events, ..InputOptions::default() };
    options.allow_gaps = input.allow_gaps;
    options.conventions = conventions(&input.trained);
    options.link = input.link.map_or(Link::Auto, Link::from);
    options.memory = budget_of(input.memory);
    options.is_scratch_named = input.scratch_dir.is_some();
    options.scratch = input.scratch_dir.or_else(|| output.and_then(scratch_beside));
    if let Some(cameras) = cameras {
        cameras.file.apply_to(&mut options);
        options.split = match cameras.split {
            Some(SplitArg::Train) | None => Some(Split::Train),
            Some(SplitArg::Val) => Some(Split::Val),
            Some(SplitArg::Test) => Some(Split::Test),
            Some(SplitArg::All) => None,
        };
    }
    options
}

impl CameraFile {
    /// Passes the arguments on to the options of an input.
    fn apply_to(self, options: &mut InputOptions) {
        options.cameras = self.cameras;
        options.size = self.resolution;
        options.times = self.times.unwrap_or_default();
        options.frames = self.frames.map(|frames| frames as usize);
    }
}

fn notes(notes: &[String]) {
    for note in notes {
        tell(&format!("note: {note}"));
    }
}

fn json(value: &impl serde::Serialize) -> String {
    let mut text = serde_json::to_string_pretty(value).expect("plain data");
    text.push('\n');
    text
}
