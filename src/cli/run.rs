//! Execution of the commands: calls the library and prints results.

use std::path::Path;

use super::args::{
    CacheFolder, Cli, CommandArgs, Completions, Compress, Convert, Demo, DryRun, Evaluate, InfoArgs, Man,
    PrecisionArgs, Render, ReportArgs, ScoreArgs, Selfcheck, Sweep, TestScene, ViewArgs,
};
use super::help;
use super::message::show;
use super::options::{
    cache_request, compress_options, demo_options, evaluate_options, input_options, precision_options, render_options,
    replace, requested_kind, result_page_options, scored_split, storage_precision, sweep_options, test_scene_options,
    video_options, view_options,
};
use super::output::{self, print, print_as};
use super::progress::Display;
use splatsieve::cache::{self, Completion};
use splatsieve::commands::video::{left_right_legend, video};
use splatsieve::commands::{container, convert, render, score};
use splatsieve::diagnostics::{demo, precision, selfcheck, sweep, test_scene};
use splatsieve::error::{Error, Result, ShowPath};
use splatsieve::evaluation;
use splatsieve::evaluation::EvaluateOptions;
use splatsieve::files::text::json_text;
use splatsieve::pipeline::summary::SummaryDetail;
use splatsieve::pipeline::{self, compress, shardable_stages};
use splatsieve::player::view;
use splatsieve::player::view::{ViewOptions, ViewReport};
use splatsieve::progress::{Events, counted};
use splatsieve::recipe::preset_text;
use splatsieve::report::{self, ReportOptions, trade_off};

/// Runs a command and prints its result.
///
/// # Errors
/// Fails if the threads cannot be started, if the command fails, or if standard output cannot be written.
pub(super) fn run(cli: Cli) -> Result<()> {
    let needs_threads = !matches!(
        cli.command,
        CommandArgs::Cache(_) | CommandArgs::Recipe(_) | CommandArgs::Completions(_) | CommandArgs::Man(_)
    );
    if needs_threads {
        start_threads(cli.threads)?;
    }
    let events = Events::new(Display::new(cli.quiet));
    match cli.command {
        CommandArgs::Compress(args) => run_compress(*args, cli.quiet, &events),
        CommandArgs::Score(args) => run_score(args, &events),
        CommandArgs::Render(args) => run_render(args, &events),
        CommandArgs::Evaluate(args) => run_evaluate(args, &events),
        CommandArgs::Sweep(args) => run_sweep(args, &events),
        CommandArgs::Precision(args) => run_precision(args, &events),
        CommandArgs::Report(args) => run_report(args, &events),
        CommandArgs::View(args) => run_view(args, &events),
        CommandArgs::Convert(args) => run_convert(args, &events),
        CommandArgs::Info(args) => run_info(args, &events),
        CommandArgs::Cache(args) => run_cache(&args),
        CommandArgs::Demo(args) => run_demo(args, &events),
        CommandArgs::TestScene(args) => run_test_scene(args, &events),
        CommandArgs::Selfcheck(args) => run_selfcheck(&args),
        CommandArgs::Recipe(args) => print(preset_text(&args.preset)?),
        CommandArgs::Completions(args) => run_completions(&args),
        CommandArgs::Man(args) => run_man(&args),
    }
}

/// Starts the threads that all parallel work shares: `threads` of them, or one for each core.
fn start_threads(threads: Option<u16>) -> Result<()> {
    // rayon starts one thread for each core if the number is 0.
    let count = threads.map_or(0, usize::from);
    rayon::ThreadPoolBuilder::new().num_threads(count).build_global().map_err(|error| {
        Error::usage(format!(
            "cannot start the threads: {error}\n  the system limits the number of threads of this user or job; \
             --threads 1 needs the fewest"
        ))
    })
}

/// Runs the command `compress` and prints its summary. With `--dry-run`, only prints the plan of the run; with
/// `--dry-run=stages`, only the stages that can be divided into shards. `quiet`: whether progress is hidden.
fn run_compress(args: Compress, quiet: bool, events: &Events) -> Result<()> {
    let (json, dry_run) = (args.results.json, args.dry_run);
    let detail = if args.verbose { SummaryDetail::All } else { SummaryDetail::Brief };
    let page_output = args.view.clone();
    if dry_run == Some(DryRun::Stages) && args.cache_args.shard.is_some() {
        return Err(Error::usage("--dry-run=stages lists what --shard divides: expected only one of them"));
    }
    let request = compress_options(args, quiet, events)?;
    match dry_run {
        None => (),
        Some(DryRun::Stages) => {
            return print(&shardable_stages(&request)?.iter().map(|stage| format!("{stage}\n")).collect::<String>());
        }
        Some(DryRun::Plan) => {
            let foreseen = pipeline::dry_run(&request)?;
            return print_as(json, || json_text(&foreseen), || foreseen.text());
        }
    }
    let page = page_output.map(|output| result_page_options(&request, output)).transpose()?;
    let Some(summary) = completed(compress(&request)?)? else { return Ok(()) };
    let printed = print_as(json, || json_text(&summary), || summary.text(detail));
    // The page is written even if the summary cannot be printed, for example because its reader has ended.
    if let Some(page) = page {
        let written = write_page(&page);
        if written.is_err() {
            show(&format!("{} is complete; writing its page failed:", request.output.shown()));
        }
        show(&written?);
    }
    printed
}

/// Runs the command `score`, which writes a table of the statistics and scores of all Gaussians. Prints notes, and the
/// number of Gaussians that a compression with the recipe would keep before merging.
fn run_score(args: ScoreArgs, events: &Events) -> Result<()> {
    let as_json = args.results.json;
    let mut input = input_options(args.input, Some(args.cameras.file), Some(&args.output), events);
    input.split = scored_split(args.cameras.split);
    let report = score::score(&input, &args.output, &args.recipe.recipe()?, replace(args.results.overwrite))?;
    print_result(as_json, &report, &report.notes, || {
        let (output, gaussians, kept) = (report.output.shown(), report.gaussians, report.kept);
        format!("{output}: {gaussians} Gaussians, of which the recipe keeps {kept} before merging\n")
    })
}

/// Runs the command `render`, which writes images, or with `--video` a video. Prints its notes and a description of the
/// output.
fn run_render(mut args: Render, events: &Events) -> Result<()> {
    let as_json = args.results.json;
    if let Some(output) = args.video.take() {
        let options = video_options(args, output, events);
        let filmed = video(&options)?;
        let (path, (width, height), fps) = (options.output.shown(), filmed.size, options.fps);
        let value = serde_json::json!({
            "output": options.output.to_string_lossy(), "frames": filmed.frames, "width": width, "height": height,
            "fps": fps, "notes": filmed.notes,
        });
        let places =
            options.beside.as_deref().map(|right| format!("  {}\n", left_right_legend(&options.input.path, right)));
        let places = places.unwrap_or_default();
        let frames = filmed.frames;
        let text = || format!("{path}: {frames} frames of {width}x{height}, {fps} frames per second\n{places}");
        return print_result(as_json, &value, &filmed.notes, text);
    }
    let options = render_options(args, events)?;
    let Some(rendered) = completed(render::render(&options)?)? else { return Ok(()) };
    let value = serde_json::json!({
        "output": options.output.to_string_lossy(), "views": rendered.views, "notes": rendered.notes,
    });
    let text = || format!("{}: {}\n", options.output.shown(), counted(rendered.views, "view"));
    print_result(as_json, &value, &rendered.notes, text)
}

/// Runs the command `evaluate` and prints the comparison of the two models.
fn run_evaluate(args: Evaluate, events: &Events) -> Result<()> {
    let as_json = args.results.json;
    let mut options = EvaluateOptions {
        csv: args.csv,
        overwrite: replace(args.results.overwrite),
        ..evaluate_options(args.models, None, events)
    };
    options.original.work = cache_request(args.cache_args);
    let Some(found) = completed(evaluation::evaluate(&options)?)? else { return Ok(()) };
    tell_notes(&found.work_notes);
    print_as(as_json, || json_text(&found), || found.text())
}

/// Runs the command `sweep` and prints its measurements and the path of its page.
fn run_sweep(args: Sweep, events: &Events) -> Result<()> {
    let (as_json, page) = (args.results.json, args.output.join(trade_off::PAGE_FILE));
    let found = sweep::sweep(&sweep_options(args, events))?;
    print_as(as_json, || json_text(&found), || format!("{}{}\n", found.text(), page.shown()))
}

/// Runs the command `precision` and prints its measurements and the path of its page.
fn run_precision(args: PrecisionArgs, events: &Events) -> Result<()> {
    let (as_json, page) = (args.results.json, args.output.join(report::precision::PAGE_FILE));
    let found = precision::precision(&precision_options(args, events)?)?;
    print_as(as_json, || json_text(&found), || format!("{}{}\n", found.text(), page.shown()))
}

/// Runs the command `report` and prints the verdict on each compressed model, the notes, and the path of the page.
fn run_report(args: ReportArgs, events: &Events) -> Result<()> {
    let (as_json, page) = (args.results.json, args.output.join(report::PAGE_FILE));
    let mut evaluate = evaluate_options(args.models, Some(&args.output), events);
    evaluate.original.work = cache_request(args.cache_args);
    let options = ReportOptions {
        evaluate,
        further_compressed: args.more,
        sweep: args.sweep,
        precision: args.precision,
        render_time: args.render_time,
        output: args.output,
        overwrite: replace(args.results.overwrite),
    };
    let Some(found) = completed(report::report(&options)?)? else { return Ok(()) };
    let results: Vec<_> = std::iter::once(&found.result).chain(&found.others).collect();
    let notes: Vec<String> =
        results.iter().flat_map(|result| result.work_notes.iter().chain(&result.notes).cloned()).collect();
    let verdicts: Vec<_> = results
        .iter()
        .map(|result| serde_json::json!({"compressed": result.evaluation.path.compressed, "verdict": result.verdict}))
        .collect();
    let value = serde_json::json!({"page": page.to_string_lossy(), "results": verdicts, "notes": notes});
    print_result(as_json, &value, &notes, || {
        let mut text = String::new();
        for result in &results {
            if results.len() > 1 {
                text += &format!("{}: ", Path::new(&result.evaluation.path.compressed).shown());
            }
            text += &format!("{}\n", result.verdict);
        }
        format!("{text}{}\n", page.shown())
    })
}

/// Runs the command `view`, which writes a page that plays a model. Prints the path and the size of the page.
fn run_view(args: ViewArgs, events: &Events) -> Result<()> {
    let as_json = args.results.json;
    let found = view::view(&view_options(args, events))?;
    print_result(as_json, &found, &found.notes, || page_text(&found) + "\n")
}

/// Writes the HTML page that plays a model, and shows the notes about it on standard error. Returns a line of text with
/// the path and the size of the page.
fn write_page(options: &ViewOptions) -> Result<String> {
    let found = view::view(options)?;
    tell_notes(&found.notes);
    Ok(page_text(&found))
}

/// Returns a line of text with the path of a page of the player, its number of frames and its size.
fn page_text(report: &ViewReport) -> String {
    let files = if report.files == 1 { String::new() } else { format!(" in {} files", report.files) };
    format!("{}: {}, {} bytes{files}", report.page.shown(), counted(report.frames, "frame"), report.bytes)
}

/// Runs the command `convert`: writes an input in another format and prints a description of the output. A frame stream
/// on standard output is written without a description.
fn run_convert(args: Convert, events: &Events) -> Result<()> {
    let path =
        args.output.clone().or(args.output_option.clone()).ok_or_else(|| Error::internal("convert has no output"))?;
    let is_stdout = path.as_os_str() == "-";
    let is_stored_differently = args.raw || args.level.is_some() || !args.max_error.is_empty();
    let storing = storage_precision(&args);
    let output = (!is_stdout).then_some(path.as_path());
    let has_cache = args.cache_args.cache.is_some();
    let mut input = input_options(args.input, Some(args.cameras), output, events);
    input.split = scored_split(args.split);
    input.work = cache_request(args.cache_args);
    let kind = requested_kind(&args.format, &path)?;
    let is_container = !is_stdout && convert::is_container(&path, kind);
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
            return Err(Error::usage(
                "a frame stream is binary and cannot be shown on a terminal\n  redirect standard output to a program or a file",
            ));
        }
        tell_notes(&container::unpack_stream(&input, output::stdout().lock())?.notes);
        return Ok(());
    }
    let converted = if is_container {
        let Some(packed) = completed(container::pack(&input, &path, &storing, replace(args.results.overwrite))?)?
        else {
            return Ok(());
        };
        packed
    } else {
        convert::convert(&input, &path, kind, replace(args.results.overwrite))?
    };
    print_result(args.results.json, &converted, &converted.notes, || converted.text())
}

/// Runs `info`: prints the content of an input, or checks or repairs a container.
fn run_info(args: InfoArgs, events: &Events) -> Result<()> {
    let path = args.input.input.clone();
    if let Some(output) = args.repair {
        let report = container::recover(&path, &output, replace(args.results.overwrite))?;
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
        return print_as(args.results.json, || json_text(&value), || text);
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
        return print_as(args.results.json, || json_text(&value), || text);
    }
    let info = container::info(&input_options(args.input, None, None, events))?;
    print_as(args.results.json, || json_text(&info), || info.text())
}

/// Runs `cache`: lists or removes the entries of a cache folder.
fn run_cache(args: &CacheFolder) -> Result<()> {
    if args.clean {
        let (files, bytes) = cache::remove_entries(&args.folder)?;
        let value = serde_json::json!({
            "folder": args.folder.to_string_lossy(), "files_removed": files, "bytes_removed": bytes,
        });
        let text = || format!("{}: {files} files, {bytes} bytes removed\n", args.folder.shown());
        return print_as(args.json, || json_text(&value), text);
    }
    let listed = cache::list_results(&args.folder)?;
    print_as(args.json, || json_text(&listed), || cache::format_list(&listed))
}

/// Runs the command `demo` and prints its results.
fn run_demo(args: Demo, events: &Events) -> Result<()> {
    let as_json = args.results.json;
    let options = demo_options(args, events);
    let found = demo::run(&options)?;
    print_as(as_json, || json_text(&found), || found.text(&options.output))
}

/// Runs the command `test-scene` and prints its results.
fn run_test_scene(args: TestScene, events: &Events) -> Result<()> {
    let options = test_scene_options(args, events)?;
    print(&test_scene::run(&options)?.text())?;
    if let Some(folder) = options.output {
        show(&format!("kept in {}: scene.gseq, cameras.json, compressed.gseq", folder.shown()));
    }
    Ok(())
}

/// Runs `selfcheck`. Prints the table of its cases, then fails if a case failed.
fn run_selfcheck(args: &Selfcheck) -> Result<()> {
    let found = selfcheck::run();
    let printed = print_as(args.json, || json_text(&found), || found.text());
    found.check_passed()?;
    printed
}

/// Runs the command `completions`, which prints a completion script for a shell.
fn run_completions(args: &Completions) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut help::command(), "splatsieve", &mut script);
    output::write(&script)
}

/// Runs the command `man`, which writes manual pages. Prints their number.
fn run_man(args: &Man) -> Result<()> {
    let pages = help::write_pages(&args.folder)?;
    print(&format!("{}: {pages} pages\n", args.folder.shown()))
}

/// Returns the result of a complete run. If the run computed only one shard (part of a divided stage), prints a report
/// about the shard and returns `None`.
fn completed<T>(completion: Completion<T>) -> Result<Option<T>> {
    match completion {
        Completion::Whole(found) => Ok(Some(found)),
        Completion::Shard(done) => print(&format!("{done}\n")).map(|()| None),
    }
}

/// Prints the result of a command. If `as_json` is set, prints `value`, which contains the notes, as JSON. Otherwise
/// writes `notes` to standard error, then prints the text that `text` returns.
fn print_result(
    as_json: bool,
    value: &impl serde::Serialize,
    notes: &[String],
    text: impl FnOnce() -> String,
) -> Result<()> {
    if !as_json {
        tell_notes(notes);
    }
    print_as(as_json, || json_text(value), text)
}

/// Writes notes to standard error, one per line.
fn tell_notes(notes: &[String]) {
    for note in notes {
        show(&format!("note: {note}"));
    }
}
