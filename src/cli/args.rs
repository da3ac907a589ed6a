//! Declaration of the command line: commands and their options.

mod choices;
mod shared;
mod study;
mod values;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use self::choices::{FIT_TARGETS, IMAGE_FORMATS, OUTPUT_KINDS, SPLITS, choice};
pub(super) use self::shared::{CacheArgs, CameraFile, Cameras, DryRun, Input, Memory, ResultFlags, Trained};
pub(super) use self::study::{PrecisionArgs, Sweep};
use self::values::{parse_box, parse_bytes, parse_color, parse_count, parse_decibels, parse_ratio, parse_threads};
use super::recipe_flags::RecipeFlags;
use splatsieve::diagnostics::demo_scene::Playground;
use splatsieve::files::image::write::ImageFormat;
use splatsieve::outputs::bounds::MaxError;
use splatsieve::outputs::kind::OutputKind;
use splatsieve::pipeline::FitTarget;
use splatsieve::scene::view_selection::ViewSet;

/// Heading of the options for cameras in the help.
const CAMERAS: &str = "Cameras";
/// Heading of the options for the target size or quality.
const HOW_SMALL: &str = "How small";
/// Heading of the options that keep or drop Gaussians.
const WHAT_STAYS: &str = "What is kept";
/// Heading of the options for threads, memory and progress.
const MACHINE: &str = "Machine";
/// Heading of the options for the cache folder and shards.
const CACHE: &str = "Resuming and sharing a run";

/// Makes trained dynamic (4D) Gaussian-splatting models much smaller. Needs no GPU and no training code; your renderer
/// opens the result
#[derive(Debug, Parser)]
#[command(name = "splatsieve", version, max_term_width = 110)]
pub(super) struct Cli {
    /// Command to run.
    #[command(subcommand)]
    pub(super) command: CommandArgs,
    /// Number of threads; does not change the result [default: all cores]
    #[arg(long, global = true, help_heading = MACHINE, value_name = "N", value_parser = parse_threads)]
    pub(super) threads: Option<u16>,
    /// Show no progress
    #[arg(long, global = true, help_heading = MACHINE)]
    pub(super) quiet: bool,
}

/// Commands with their arguments.
#[derive(Debug, Subcommand)]
pub(super) enum CommandArgs {
    /// Write a smaller model that your renderer opens
    Compress(Box<Compress>),
    /// Write statistics and scores of every Gaussian as .npz or .csv
    Score(ScoreArgs),
    /// Render views to PNG or NPY files, or a video
    Render(Render),
    /// Compare a compressed model with its original on test views
    Evaluate(Evaluate),
    /// Measure quality, size, time and memory of several methods at several fractions
    Sweep(Sweep),
    /// Measure error against run time for the settings of each stage
    Precision(PrecisionArgs),
    /// Write an HTML page that shows what compression lost: renders, plots, worst views
    Report(ReportArgs),
    /// Write an HTML page that plays a model in any browser, or two models side by side
    View(ViewArgs),
    /// Write an input in another format, with all its Gaussians
    Convert(Convert),
    /// Print what an input holds; check or repair a .gseq container
    Info(InfoArgs),
    /// List what a cache folder holds, or remove it
    Cache(CacheFolder),
    /// Make a scene, compress it, and write pages to look at
    Demo(Demo),
    /// Make the scene that tests use, and compress it
    #[command(hide = true)]
    TestScene(TestScene),
    /// Check the numerics of this program on this machine
    Selfcheck(Selfcheck),
    /// Print a recipe file with all parameters
    Recipe(RecipeArgs),
    /// Print a completion script for a shell
    Completions(Completions),
    /// Write manual pages
    Man(Man),
}

/// Format of an output.
#[derive(Debug, Args)]
pub(super) struct OutputFormat {
    /// Format of the output [default: by its name]
    #[arg(long = "as", value_name = "FORMAT", value_parser = choice(OUTPUT_KINDS))]
    pub(super) kind: Option<OutputKind>,
    /// Version of a .spz: 3 opens in most viewers, 4 also in the PlayCanvas engine [default: 3]
    #[arg(long, value_name = "3|4", hide_short_help = true, value_parser = clap::value_parser!(u8).range(3..=4))]
    pub(super) spz_version: Option<u8>,
}

/// Arguments of `compress`.
#[derive(Debug, Args)]
pub(super) struct Compress {
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// Output: a folder (same format as the input), NAME.gsz (archive, smallest), .gseq, .ply, .splatv, .4dgs, .spz,
    /// .sog, .glb, .tsog, .ftgs.ply or .gsd
    #[arg(short, long, value_name = "PATH")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) format: OutputFormat,
    /// PSNR of renders of an archive (NAME.gsz) against renders of the same result without quantization, such as 45dB
    /// [default: about 9 dB above the PSNR of the result against the original, so that quantization lowers the latter by
    /// at most 0.5 dB; 50 dB if the result has 50 dB or more]
    #[arg(long, value_name = "DB", help_heading = HOW_SMALL, hide_short_help = true, value_parser = parse_decibels)]
    pub(super) archive_psnr: Option<f64>,
    #[command(flatten)]
    pub(super) size: OutputSize,
    /// Prune, but do not merge
    #[arg(long, help_heading = WHAT_STAYS, hide_short_help = true, conflicts_with = "merge_only")]
    pub(super) prune_only: bool,
    /// Merge, but do not prune
    #[arg(long, help_heading = WHAT_STAYS, hide_short_help = true)]
    pub(super) merge_only: bool,
    #[command(flatten)]
    pub(super) overrides: OverrideArgs,
    /// Check everything and print the plan, time and memory; write nothing
    ///
    /// With --dry-run=stages, print only the stages that --shard divides, in order, with their units.
    #[arg(long, value_name = "stages", num_args = 0..=1, require_equals = true, default_missing_value = "plan")]
    #[arg(hide_possible_values = true)]
    pub(super) dry_run: Option<DryRun>,
    #[command(flatten)]
    pub(super) cache_args: CacheArgs,
    /// Also write a page that plays the result beside the original, as `view` does [default: OUTPUT.html]
    #[arg(long, value_name = "PATH", num_args = 0..=1, require_equals = true, hide_short_help = true)]
    #[arg(conflicts_with_all = ["dry_run", "shard"])]
    pub(super) view: Option<Option<PathBuf>>,
    #[command(flatten)]
    pub(super) results: ResultFlags,
    /// Print stages with their times, what was left out and why, and all notes
    #[arg(short, long, conflicts_with = "json")]
    pub(super) verbose: bool,
    // The help shows groups of options in the order of these fields.
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// Target of the compression [default: remove Gaussians that views hardly show].
#[derive(Debug, Args)]
#[command(group(clap::ArgGroup::new("size_of_output")))]
pub(super) struct OutputSize {
    /// Fraction of the Gaussians to keep, exactly: 0.1, 10% or 10x (all three mean a tenth)
    #[arg(long, help_heading = HOW_SMALL, value_name = "FRACTION", group = "size_of_output", value_parser = parse_ratio)]
    pub(super) ratio: Option<f64>,
    /// Number of Gaussians to keep, exactly
    #[arg(long, help_heading = HOW_SMALL, value_name = "N", group = "size_of_output", value_parser = parse_count)]
    pub(super) count: Option<u64>,
    /// Best output of at most this many bytes, such as 5MB
    ///
    /// The summary, the recipe and the index map do not count, even inside an output folder.
    #[arg(long, help_heading = HOW_SMALL, value_name = "BYTES", group = "size_of_output", value_parser = parse_bytes)]
    pub(super) size: Option<u64>,
    /// Smallest output whose renders have at least this mean PSNR against renders of the original, such as 35dB
    #[arg(long, help_heading = HOW_SMALL, value_name = "DB", group = "size_of_output", value_parser = parse_decibels)]
    pub(super) min_psnr: Option<f64>,
    /// Smallest output that loses at most this much PSNR against the photographs of --ground-truth, such as 0.5dB
    #[arg(long, help_heading = HOW_SMALL, value_name = "DB", group = "size_of_output", value_parser = parse_decibels)]
    pub(super) max_loss: Option<f64>,
    /// Folder of photographs: test views for --max-loss, training views for --toward
    ///
    /// File names: as in the camera file, else tNNN_vNN.png (frame, view). For --max-loss, the search uses three
    /// quarters of the test views. The reported loss is measured on the other quarter.
    #[arg(long, help_heading = HOW_SMALL, value_name = "FOLDER")]
    pub(super) ground_truth: Option<PathBuf>,
    /// Images to fit the Gaussians to: renders of the original, or photographs in --ground-truth [default: renders]
    ///
    /// With photographs, a fit to photographs follows the fit to renders and takes about as long. Its result is kept
    /// if it raises the PSNR against photographs of cameras that the fit does not use.
    #[arg(long, help_heading = HOW_SMALL, value_name = "IMAGES", hide_short_help = true)]
    #[arg(value_parser = choice(FIT_TARGETS))]
    pub(super) toward: Option<FitTarget>,
}

/// Gaussians that the user keeps or drops.
#[derive(Debug, Args)]
pub(super) struct OverrideArgs {
    /// Never remove, merge or move a Gaussian whose center is in this box at the frame in which most Gaussians are
    /// alive. Box: minimum corner, then maximum corner
    #[arg(long, help_heading = WHAT_STAYS, value_name = "X0,Y0,Z0,X1,Y1,Z1", hide_short_help = true, value_parser = parse_box, allow_hyphen_values = true)]
    pub(super) keep_box: Option<[f64; 6]>,
    /// Never remove, merge or move these Gaussians: a file with one id per line, or a list such as 3,10-20
    #[arg(long, help_heading = WHAT_STAYS, value_name = "FILE|IDS", hide_short_help = true)]
    pub(super) keep_ids: Option<String>,
    /// Remove these Gaussians: a file with one id per line, or a list such as 3,10-20
    #[arg(long, help_heading = WHAT_STAYS, value_name = "FILE|IDS", hide_short_help = true)]
    pub(super) drop_ids: Option<String>,
}

/// Arguments of `score`.
#[derive(Debug, Args)]
pub(super) struct ScoreArgs {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// Output, NAME.npz or NAME.csv: one row per Gaussian, with the columns D kappa V life C E vis static_score
    /// dynamic_score score keep, and W if visible contributions are measured
    #[arg(short, long, value_name = "FILE")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) results: ResultFlags,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// Arguments of `render`.
#[derive(Debug, Args)]
#[command(group(clap::ArgGroup::new("wanted").args(["frame", "all", "video"]).required(true)))]
pub(super) struct Render {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Render one view: the frame with this number, counted from 0. Needs --view and -o
    #[arg(long, value_name = "T", requires = "view")]
    pub(super) frame: Option<u32>,
    /// Number of the view (the camera) to render with --frame or --video: the number in the camera file, else counted
    /// from 0. If training and test cameras have the same numbers, also give --split
    #[arg(long, value_name = "V", conflicts_with = "all")]
    pub(super) view: Option<u32>,
    /// Render every view of the split into a folder, as tNNN_vNN files
    #[arg(long)]
    pub(super) all: bool,
    /// Write a video with one image per frame, seen from --view [default: the first view] or along --path. NAME.png or
    /// NAME.apng: animated PNG, lossless. NAME.gif: animated GIF. NAME.mp4 or NAME.webm: needs ffmpeg
    #[arg(long, value_name = "FILE")]
    pub(super) video: Option<PathBuf>,
    /// Move the camera of --video through these views, such as 0,2,5 [default: all views of the split]
    #[arg(long, value_name = "VIEWS", num_args = 0..=1, value_delimiter = ',', conflicts_with = "view")]
    pub(super) path: Option<Vec<u32>>,
    /// Frames per second of --video [default: 25]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) fps: Option<u32>,
    /// Model to show beside the input in --video, with the same frames
    #[arg(long, value_name = "MODEL")]
    pub(super) beside: Option<PathBuf>,
    /// Split of the views to render [default: with --all or --path: test, else val, else all; otherwise: all]
    #[arg(long, value_parser = choice(SPLITS))]
    pub(super) split: Option<ViewSet>,
    /// Format of the images of --all [default: png]
    #[arg(long = "as", value_name = "KIND", requires = "all", value_parser = choice(IMAGE_FORMATS))]
    pub(super) format: Option<ImageFormat>,
    #[command(flatten)]
    pub(super) background: Background,
    /// Output: NAME.png (8 bits, clamped), NAME.npy (float32 [H, W, 3], not clamped), or with --all a folder
    #[arg(short, long, value_name = "PATH", required_unless_present = "video", conflicts_with = "video")]
    pub(super) output: Option<PathBuf>,
    #[command(flatten)]
    pub(super) cache_args: CacheArgs,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Background color.
#[derive(Debug, Args)]
pub(super) struct Background {
    /// Background color, each channel from 0 to 1 [default: as in the camera file, else as in the model, else black]
    #[arg(long, value_name = "R,G,B", value_parser = parse_color, allow_hyphen_values = true)]
    pub(super) background: Option<[f32; 3]>,
}

/// Two models and the views that they are compared on.
#[derive(Debug, Args)]
pub(super) struct CompareArgs {
    #[command(flatten)]
    pub(super) input: Input,
    /// Compressed model, in any format
    pub(super) compressed: PathBuf,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Split of the data set whose views are compared [default: test, else val, else all]
    #[arg(long, value_parser = choice(SPLITS))]
    pub(super) split: Option<ViewSet>,
    /// Folder of photographs with which both models are also compared. File names: as in the camera file, else
    /// tNNN_vNN.png (frame, view)
    #[arg(long, value_name = "FOLDER")]
    pub(super) ground_truth: Option<PathBuf>,
    /// Maximum number of frames, spread evenly [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_frames: Option<u32>,
    /// Maximum number of views, spread over frames and cameras [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_views: Option<u32>,
    #[command(flatten)]
    pub(super) background: Background,
    /// Compute FLIP too, a perceptual difference; takes several times longer
    #[arg(long)]
    pub(super) flip: bool,
}

/// Arguments of `report`.
#[derive(Debug, Args)]
pub(super) struct ReportArgs {
    #[command(flatten)]
    pub(super) models: CompareArgs,
    /// More compressed models, to show beside the first
    #[arg(value_name = "MORE", conflicts_with_all = ["cache", "shard"])]
    pub(super) more: Vec<PathBuf>,
    /// sweep.json that `sweep` wrote, to include its curves
    #[arg(long, value_name = "FILE")]
    pub(super) sweep: Option<PathBuf>,
    /// precision.json that `precision` wrote, to include its plots
    #[arg(long, value_name = "FILE")]
    pub(super) precision: Option<PathBuf>,
    /// Measure the time of a render of the original and of the compressed model; times differ from run to run
    #[arg(long)]
    pub(super) render_time: bool,
    /// Output folder: report.html, and its data as JSON and CSV
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) cache_args: CacheArgs,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub(super) struct Evaluate {
    #[command(flatten)]
    pub(super) models: CompareArgs,
    /// Also write the PSNR, SSIM and other results of every view to this CSV file
    #[arg(long, value_name = "FILE")]
    pub(super) csv: Option<PathBuf>,
    #[command(flatten)]
    pub(super) cache_args: CacheArgs,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Arguments of `view`.
#[derive(Debug, Args)]
pub(super) struct ViewArgs {
    #[command(flatten)]
    pub(super) input: Input,
    /// Compressed model, in any format, to show beside the input
    pub(super) compressed: Option<PathBuf>,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Maximum number of frames, spread evenly
    #[arg(long, value_name = "N", default_value_t = DEFAULT_FRAMES, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_frames: u32,
    /// Maximum number of frames of the original beside a compressed model [default: --max-frames]
    #[arg(long, value_name = "N", requires = "compressed", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) original_frames: Option<u32>,
    /// Maximum SH degree of the original beside a compressed model [default: its own]
    #[arg(long, value_name = "DEGREE", requires = "compressed", value_parser = clap::value_parser!(u8).range(0..=3))]
    pub(super) original_degree: Option<u8>,
    #[command(flatten)]
    pub(super) background: Background,
    /// Maximum size of a page in one file; a larger page NAME.html is written as the folder NAME_page
    #[arg(long, value_name = "SIZE", default_value = DEFAULT_PAGE, value_parser = parse_bytes)]
    pub(super) page_limit: u64,
    /// Output: NAME.html, a single page, or a folder with index.html; both open without a server
    #[arg(short, long, value_name = "PATH")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Default maximum number of frames of a page.
pub(super) const DEFAULT_FRAMES: u32 = 60;
/// Default maximum size of a single page.
const DEFAULT_PAGE: &str = "64MB";

/// Returns the default of `--page-limit` in bytes.
pub(super) fn default_page_limit() -> u64 {
    parse_bytes(DEFAULT_PAGE).expect("a size")
}

/// Arguments of `convert`.
#[derive(Debug, Args)]
pub(super) struct Convert {
    #[command(flatten)]
    pub(super) input: Input,
    /// Output. NAME.gsz, .gseq, .ply, .splatv, .4dgs, .spz, .sog, .glb, .tsog, .ftgs.ply or .gsd: a file. A folder: the
    /// model of an archive, a PLY per frame, or a model in the input's format. `-`: a frame stream (format/STREAM.md)
    #[arg(value_name = "OUTPUT", required_unless_present = "output_option")]
    pub(super) output: Option<PathBuf>,
    /// Path of the output: the same as the argument OUTPUT, in the form that other commands use
    #[arg(
        id = "output_option",
        short = 'o',
        long = "output",
        value_name = "OUTPUT",
        conflicts_with = "output",
        hide = true
    )]
    pub(super) output_option: Option<PathBuf>,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Split of the data set whose views decide the quantization of an output NAME.gsz [default: train]
    #[arg(long, help_heading = CAMERAS, value_parser = choice(SPLITS))]
    pub(super) split: Option<ViewSet>,
    #[command(flatten)]
    pub(super) format: OutputFormat,
    /// Maximum error of an attribute in a .gseq, such as `position=1e-3` or `position=0.01%` of the scene's extent.
    /// Units: scene units, components of quaternions, logs of scales, opacity logits, SH coefficients. Attributes
    /// without a bound keep every bit. Every written value is checked, and the file states its bounds
    #[arg(long, value_name = "ATTRIBUTE=BOUND", value_delimiter = ',', conflicts_with = "raw")]
    pub(super) max_error: Vec<MaxError>,
    /// Store the blocks of values (tiles) of a .gseq uncompressed, so that programs can use them in place
    #[arg(long, conflicts_with = "level")]
    pub(super) raw: bool,
    /// zstd level of a .gseq [default: 1; with --max-error: 15]
    #[arg(long, value_name = "1-19", value_parser = clap::value_parser!(i32).range(1..=19))]
    pub(super) level: Option<i32>,
    #[command(flatten)]
    pub(super) cache_args: CacheArgs,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Arguments of `info`.
#[derive(Debug, Args)]
pub(super) struct InfoArgs {
    #[command(flatten)]
    pub(super) input: Input,
    /// Read every byte of a .gseq container and check it against its checksums
    #[arg(long, conflicts_with = "repair")]
    pub(super) check: bool,
    /// Write the complete frames of a damaged or truncated .gseq container to a new one
    #[arg(long, value_name = "FILE.gseq")]
    pub(super) repair: Option<PathBuf>,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Arguments of `cache`.
#[derive(Debug, Args)]
pub(super) struct CacheFolder {
    /// Folder that was given to --cache
    pub(super) folder: PathBuf,
    /// Remove all cached results in it, and the folder if nothing else is in it
    #[arg(long)]
    pub(super) clean: bool,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// Arguments of `demo`.
#[derive(Debug, Args)]
pub(super) struct Demo {
    /// Folder to write the scene, its compressed models, the pages and the film into
    #[arg(short, long, value_name = "FOLDER", default_value = "splatsieve-demo")]
    pub(super) output: PathBuf,
    /// Number of Gaussians of the generated scene
    #[arg(long, value_name = "N", default_value_t = Playground::DEFAULT_COUNT as u32, value_parser = clap::value_parser!(u32).range(1000..=1_000_000))]
    pub(super) gaussians: u32,
    /// Number of frames of the generated scene
    #[arg(long, value_name = "T", default_value_t = Playground::DEFAULT_FRAMES as u32, value_parser = clap::value_parser!(u32).range(2..=10_000))]
    pub(super) frames: u32,
    /// Optimization steps of each refinement [default: those of `--effort fast`]
    #[arg(long, value_name = "N")]
    pub(super) refine_steps: Option<u32>,
    #[command(flatten)]
    pub(super) memory: Memory,
    #[command(flatten)]
    pub(super) results: ResultFlags,
}

/// Arguments of `test-scene`.
#[derive(Debug, Args)]
pub(super) struct TestScene {
    /// Keep the scene and the result in this folder [default: a temporary one]
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: Option<PathBuf>,
    /// Number of Gaussians of the scene
    #[arg(long, value_name = "N", default_value_t = 6000, value_parser = clap::value_parser!(u32).range(100..=10_000_000))]
    pub(super) gaussians: u32,
    /// Number of frames of the scene
    #[arg(long, value_name = "T", default_value_t = 48, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(super) frames: u32,
    /// Fraction of the Gaussians to keep
    #[arg(long, value_name = "FRACTION", default_value = "0.3", value_parser = parse_ratio)]
    pub(super) ratio: f64,
    #[command(flatten)]
    pub(super) memory: Memory,
    /// Replace the files of an earlier result in the folder
    #[arg(long)]
    pub(super) overwrite: bool,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// Arguments of `selfcheck`.
#[derive(Debug, Args)]
pub(super) struct Selfcheck {
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// Arguments of `recipe`.
#[derive(Debug, Args)]
pub(super) struct RecipeArgs {
    /// Preset to print: `default`, `paper` (describes every parameter), `gentle` or `strong`
    #[arg(long, default_value = "default")]
    pub(super) preset: String,
}

/// Arguments of `completions`.
#[derive(Debug, Args)]
pub(super) struct Completions {
    /// Shell to complete for
    #[arg(value_enum)]
    pub(super) shell: clap_complete::Shell,
}

/// Arguments of `man`.
#[derive(Debug, Args)]
pub(super) struct Man {
    /// Output folder
    pub(super) folder: PathBuf,
}
