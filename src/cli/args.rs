//! The command line, declared.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};

use super::recipe_flags::{RecipeFlags, numbers};
use splatsieve::cache::Shard;
use splatsieve::diagnostics::demo_scene::Playground;
use splatsieve::diagnostics::precision::Turned;
use splatsieve::error::quoted;
use splatsieve::evaluation::method::Method;
use splatsieve::files::atomic::Replace;
use splatsieve::files::cameras::Times;
use splatsieve::models::Link;
use splatsieve::outputs::bounds::MaxError;

/// Headings of groups of options.
const CAMERAS: &str = "Cameras";
const HOW_SMALL: &str = "How small";
const WHAT_STAYS: &str = "What stays";
const MACHINE: &str = "Machine";
const IN_PARTS: &str = "Work that is kept and shared";

/// Shrinks trained dynamic (4D) Gaussian-splatting models after training: no retraining, the same renderers open the result
#[derive(Debug, Parser)]
#[command(name = "splatsieve", version, about, max_term_width = 110)]
pub(super) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(super) verb: Verb,
    /// Threads to work on; the result does not depend on it [default: all]
    #[arg(long, global = true, help_heading = MACHINE, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) threads: Option<u16>,
    /// Show no progress: no bars on a terminal, no lines in a log
    #[arg(long, global = true, help_heading = MACHINE)]
    pub(super) quiet: bool,
}

/// The verbs.
#[derive(Debug, Subcommand)]
pub(super) enum Verb {
    /// Write a smaller model that the same renderer opens
    Compress(Box<Compress>),
    /// Write the statistics and scores of every Gaussian as .npz or .csv
    Score(ScoreArgs),
    /// Render an input as its cameras see it, into PNG or float32 NPY files
    Render(Render),
    /// Compare the pictures of two models: PSNR, SSIM, FLIP and the error of what moves
    Evaluate(Evaluate),
    /// Trade-off curves: quality, size, time and memory of every method at every kept fraction
    Sweep(Sweep),
    /// Work-precision diagrams: what every knob of a run costs, and what error it leaves
    Precision(PrecisionArgs),
    /// Write a page that shows what compression cost: pictures, curves, failure modes
    Report(ReportArgs),
    /// Write a page that plays a scene in any browser: one model, or the original and the compressed one side by side
    View(ViewArgs),
    /// Write an input as another kind of file: for a viewer, a player, another program
    Convert(Convert),
    /// Pack any input into a .gseq container
    Pack(Pack),
    /// Say what an input holds
    Info(InfoArgs),
    /// Check every byte of a .gseq container
    Verify(Verify),
    /// Write the model in an archive; of other inputs the frames, as PLY files or a stream
    Unpack(Unpack),
    /// Save the complete frames of a .gseq container that was cut short
    Recover(Recover),
    /// Say what is in a work folder, or remove it
    Work(WorkArgs),
    /// Generate a scene with moving objects, compress it to a tenth and a twentieth, and write pages to look at
    Demo(Demo),
    /// Generate the scene that tests use, and compress it
    #[command(hide = true)]
    TestScene(TestScene),
    /// Check the numbers of this program on this machine; takes no files
    Selfcheck(Selfcheck),
    /// Print a recipe file with every parameter documented
    Recipe(RecipeVerb),
    /// Print a completion script for a shell
    Completions(Completions),
    /// Write manual pages of the program and of every verb
    Man(Man),
}

impl Verb {
    /// Whether it is to say what memory it takes. A sweep's table does, run by run.
    pub(super) fn explains(&self) -> bool {
        match self {
            Verb::Compress(args) => args.input.memory.explain,
            Verb::Score(ScoreArgs { input, .. })
            | Verb::Render(Render { input, .. })
            | Verb::View(ViewArgs { input, .. })
            | Verb::Convert(Convert { input, .. })
            | Verb::Pack(Pack { input, .. })
            | Verb::Info(InfoArgs { input, .. })
            | Verb::Unpack(Unpack { input, .. }) => input.memory.explain,
            Verb::Evaluate(Evaluate { models, .. }) | Verb::Report(ReportArgs { models, .. }) => models.memory.explain,
            Verb::Demo(Demo { memory, .. }) | Verb::TestScene(TestScene { memory, .. }) => memory.explain,
            Verb::Sweep(_)
            | Verb::Precision(_)
            | Verb::Verify(_)
            | Verb::Recover(_)
            | Verb::Work(_)
            | Verb::Selfcheck(_)
            | Verb::Recipe(_)
            | Verb::Completions(_)
            | Verb::Man(_) => false,
        }
    }
}

/// What to read.
#[derive(Debug, Args)]
pub(super) struct Input {
    /// Model folder or checkpoint of any family (README, Formats), folder of PLY frames, one .ply, .splatv, .gsz, .gseq,
    /// or - for a frame stream on standard input
    pub(super) input: PathBuf,
    /// Training iteration of a model folder [default: the largest]
    #[arg(long, value_name = "K", hide_short_help = true)]
    pub(super) iteration: Option<u32>,
    #[command(flatten)]
    pub(super) trained: Trained,
    /// Take a folder of PLY frames with a gap in its numbers, or with entries that are no files, as it is
    #[arg(long, hide_short_help = true)]
    pub(super) allow_gaps: bool,
    /// Whether to find out which Gaussian of a folder's frames is which: where they differ in number, or their order does
    /// not tell, `always` (and so of a container or stream, whose lives may be short), or `never`; `apart`: always, and
    /// neither are lives joined that seem to be one, nor is held what hardly changes along them [default: auto]
    #[arg(long, hide_short_help = true)]
    pub(super) link: Option<LinkArg>,
    /// Folder for scratch files while the run lasts: the packed frames of a stream or of linked frames, what does not fit
    /// into --memory [default: that of the output, else the system's]
    #[arg(long, value_name = "FOLDER", help_heading = MACHINE, hide_short_help = true)]
    pub(super) scratch_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(super) memory: Memory,
}

/// What a model's files do not say of how it was trained.
#[derive(Debug, Args)]
pub(super) struct Trained {
    /// Length of a 4D Gaussian Splatting checkpoint's time_duration, or both its ends A,B [default: that in a YAML
    /// beside it, else 10 where frames lie beyond 1, else 1]
    #[arg(long, value_name = "L", hide_short_help = true, value_parser = parse_duration, allow_hyphen_values = true)]
    pub(super) time_duration: Option<f64>,
    /// How its rotations of four dimensions are written: unflipped before 15 September 2024 [default: flipped]
    #[arg(long, value_name = "HOW", hide_short_help = true)]
    pub(super) rot4d: Option<Rot4d>,
    /// What becomes of Gaussians of a .splatv whose quaternion is zero, which no player draws [default: drop]
    #[arg(long, value_name = "HOW", hide_short_help = true)]
    pub(super) zero_rotation: Option<ZeroRotationArg>,
}

/// What becomes of zero quaternions of a .splatv.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum ZeroRotationArg {
    /// They are left out
    Drop,
    /// They are kept without a rotation
    Identity,
}

/// How rotations of four dimensions are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Rot4d {
    /// With the order of both axes reversed
    Flipped,
    /// As the product of both quaternions
    Unflipped,
}

/// A length, or the ends of a span.
fn parse_duration(text: &str) -> Result<f64, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    let length = match numbers.as_deref() {
        Ok(&[length]) => length,
        Ok(&[start, end]) => end - start,
        _ => return Err("expected a length such as 10, or two times such as 0,10".to_owned()),
    };
    let is_length = length.is_finite() && length > 0.0;
    is_length.then_some(length).ok_or_else(|| format!("expected a length above 0, found {length}"))
}

/// Where results of stages stay, so that a run goes on where another was cut short, and several runs share the work.
#[derive(Debug, Args)]
pub(super) struct CacheArgs {
    /// Keep what stages find in this folder: a run that was cut short goes on from there
    #[arg(long, help_heading = IN_PARTS, value_name = "FOLDER")]
    pub(super) work: Option<PathBuf>,
    /// Compute part I of N of the next stage that can be divided, in the work folder, and nothing else; a run without
    /// this joins them and does the rest
    #[arg(long, help_heading = IN_PARTS, value_name = "I/N", requires = "work", hide_short_help = true)]
    pub(super) part: Option<Shard>,
}

/// What to do with what has the output's name.
#[derive(Debug, Args)]
pub(super) struct Earlier {
    /// Replace an earlier result of splatsieve; files in its folder that are not its own stay
    #[arg(long)]
    pub(super) overwrite: bool,
    /// Replace whatever is there, a folder with everything in it
    #[arg(long)]
    pub(super) force: bool,
}

impl Earlier {
    pub(super) fn replace(&self) -> Replace {
        match (self.force, self.overwrite) {
            (true, _) => Replace::Any,
            (false, true) => Replace::Ours,
            (false, false) => Replace::Never,
        }
    }
}

/// How much memory to take.
#[derive(Debug, Args)]
pub(super) struct Memory {
    /// Most memory to take, such as 512MiB or 4GB [default: a quarter of the machine's]
    ///
    /// The result does not depend on it, but that nothing is refined where that takes more, which the summary says.
    #[arg(long, help_heading = MACHINE, value_name = "SIZE", value_parser = parse_bytes)]
    pub(super) memory: Option<u64>,
    /// Say, before any work, what will take how much memory and time
    ///
    /// And how often the frames are read; at the end, what was taken.
    #[arg(long, help_heading = MACHINE)]
    pub(super) explain: bool,
}

/// The file of the cameras.
#[derive(Debug, Args)]
pub(super) struct CameraFile {
    /// transforms*.json, cameras.json, poses_bounds.npy, a COLMAP reconstruction, dataset.json of NeRFies and HyperNeRF, or
    /// a folder with one; a file stands for itself alone, a folder for all its splits [default: beside the model's
    /// data if cfg_args names it, else a virtual rig]
    #[arg(long, help_heading = CAMERAS, value_name = "PATH")]
    pub(super) cameras: Option<PathBuf>,
    /// Number of frames of a model that is continuous in time, evenly spaced [default: the cameras' times]
    #[arg(long, help_heading = CAMERAS, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) frames: Option<u32>,
    /// Picture size where the cameras name none; pictures of COLMAP, NeRFies and LLFF are scaled to it
    #[arg(long, help_heading = CAMERAS, value_name = "WxH", value_parser = parse_size)]
    pub(super) size: Option<(u32, u32)>,
    /// When pictures of COLMAP, or of a cameras.json without times, were taken: `names`, by the numbers in their names;
    /// `none`, every picture shows every frame; or a CSV table of name,time [default: names of COLMAP where all have
    /// numbers and the input is no still scene, else none]
    #[arg(long, help_heading = CAMERAS, hide_short_help = true, value_name = "names|none|FILE", value_parser = parse_times)]
    pub(super) times: Option<Times>,
}

/// From where to look.
#[derive(Debug, Args)]
pub(super) struct Cameras {
    #[command(flatten)]
    pub(super) file: CameraFile,
    /// Which of the cameras' pictures to score with [default: train]
    #[arg(long, value_enum, help_heading = CAMERAS)]
    pub(super) split: Option<SplitArg>,
}

/// Whether frames are linked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum LinkArg {
    /// Where they differ in number, or their order does not tell which Gaussian is which
    Auto,
    /// Whatever their order tells, or a container or stream
    Always,
    /// Whatever their order tells; lives that seem to be one stay apart, and what hardly changes is not held
    Apart,
    /// The same place means the same Gaussian
    Never,
}

impl From<LinkArg> for Link {
    fn from(given: LinkArg) -> Link {
        match given {
            LinkArg::Auto => Link::Auto,
            LinkArg::Always => Link::Always,
            LinkArg::Apart => Link::Apart,
            LinkArg::Never => Link::Never,
        }
    }
}

/// A part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum SplitArg {
    /// Pictures the model was trained on
    Train,
    /// Pictures held out while it was trained (transforms_val.json)
    Val,
    /// Held-out pictures
    Test,
    /// All of them
    All,
}

/// `compress`
#[derive(Debug, Args)]
pub(super) struct Compress {
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// Where to write: a folder, NAME.gsz, .gseq, .ply, .splatv, .4dgs or .spz
    #[arg(short, long, value_name = "PATH")]
    pub(super) output: PathBuf,
    /// What to write [default: by the output's name; a folder is of the input's own kind]
    #[arg(long = "as", value_enum, value_name = "KIND")]
    pub(super) kind: Option<OutputKindArg>,
    /// How close the pictures of an archive (NAME.gsz) are to be to those of the result before its values were put on
    /// grids, or within bounds: mean PSNR, such as 45dB [default: 9 dB above the result's own, which costs half a
    /// decibel; 50dB where that is closer]
    #[arg(long, value_name = "DB", help_heading = HOW_SMALL, hide_short_help = true, value_parser = parse_decibels)]
    pub(super) archive_psnr: Option<f64>,
    #[command(flatten)]
    pub(super) size: OutputSize,
    /// Prune, do not merge
    #[arg(long, help_heading = WHAT_STAYS, hide_short_help = true, conflicts_with = "merge_only")]
    pub(super) prune_only: bool,
    /// Merge, do not prune
    #[arg(long, help_heading = WHAT_STAYS, hide_short_help = true)]
    pub(super) merge_only: bool,
    #[command(flatten)]
    pub(super) overrides: OverrideArgs,
    /// Say what would be done, what it would take and what would be written, in seconds; write nothing
    #[arg(long)]
    pub(super) dry_run: bool,
    #[command(flatten)]
    pub(super) kept: CacheArgs,
    /// List the stages that --part divides, in order, with the units that parts are made of, and do nothing else
    #[arg(long, conflicts_with = "part", help_heading = IN_PARTS, hide_short_help = true)]
    pub(super) list_stages: bool,
    /// Write a page too that plays the result beside the original in any browser, as `view` does [default: the output's name
    /// with .html behind]
    #[arg(long, value_name = "PATH", num_args = 0..=1, require_equals = true, hide_short_help = true)]
    #[arg(conflicts_with_all = ["dry_run", "part"])]
    pub(super) view: Option<Option<PathBuf>>,
    #[command(flatten)]
    pub(super) earlier: Earlier,
    /// Print the summary as JSON
    #[arg(long)]
    pub(super) json: bool,
    /// Say everything at the end: stages with their times, what was left out and why, all notes
    #[arg(short, long, conflicts_with = "json")]
    pub(super) verbose: bool,
    // Groups of options come in the order of these fields: those of the machine last but the recipe's.
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// How large the output is to be [default: what pictures can do without goes].
#[derive(Debug, Args)]
#[command(group(clap::ArgGroup::new("size_of_output")))]
pub(super) struct OutputSize {
    /// Exactly this many Gaussians in the output
    #[arg(long, help_heading = HOW_SMALL, value_name = "N", group = "size_of_output")]
    pub(super) target_count: Option<u64>,
    /// Exactly this fraction of the Gaussians in the output
    #[arg(long, help_heading = HOW_SMALL, value_name = "R", group = "size_of_output")]
    pub(super) target_ratio: Option<f64>,
    /// The smallest output whose pictures stay this close to the original's: mean PSNR, such as 35dB
    #[arg(long, help_heading = HOW_SMALL, value_name = "DB", group = "size_of_output", value_parser = parse_decibels)]
    pub(super) min_psnr: Option<f64>,
    /// The smallest output that loses at most this much PSNR against --ground-truth, such as 0.5dB
    #[arg(long, help_heading = HOW_SMALL, value_name = "DB", group = "size_of_output", value_parser = parse_decibels, requires = "ground_truth")]
    pub(super) max_loss: Option<f64>,
    /// The best output that is at most this large, such as 5MB
    ///
    /// With everything written beside it; an archive without.
    #[arg(long, help_heading = HOW_SMALL, value_name = "SIZE", group = "size_of_output", value_parser = parse_bytes)]
    pub(super) target_size: Option<u64>,
    /// Folder of photographs of the held-out cameras for --max-loss
    ///
    /// tNNN_vNN.png, or named as the cameras name them. A quarter of them is not searched on and gives the figure that is
    /// reported.
    #[arg(long, help_heading = HOW_SMALL, value_name = "FOLDER", requires = "max_loss")]
    pub(super) ground_truth: Option<PathBuf>,
}

/// What the user knows better.
#[derive(Debug, Args)]
pub(super) struct OverrideArgs {
    /// Keep every Gaussian inside this box (at the reference frame), unmerged
    #[arg(long, help_heading = WHAT_STAYS, value_name = "X0,Y0,Z0,X1,Y1,Z1", hide_short_help = true, value_parser = parse_box, allow_hyphen_values = true)]
    pub(super) keep_box: Option<[f64; 6]>,
    /// Keep these Gaussians, unmerged: a file with one id per line, or a list such as 3,10-20
    #[arg(long, help_heading = WHAT_STAYS, value_name = "FILE|IDS", hide_short_help = true)]
    pub(super) keep_ids: Option<String>,
    /// Drop these Gaussians: a file with one id per line, or a list such as 3,10-20
    #[arg(long, help_heading = WHAT_STAYS, value_name = "FILE|IDS", hide_short_help = true)]
    pub(super) drop_ids: Option<String>,
}

/// Kinds of output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum OutputKindArg {
    /// 4DGaussians model folder
    Model,
    /// Container
    Gseq,
    /// Folder with one PLY per frame
    PlySequence,
    /// One PLY: the canonical cloud of a model, or a sequence of one frame
    Ply,
    /// Archive of a model, of one PLY or of frames, the smallest: to store and to send
    Archive,
    /// Curved motion in windows of time, for splaTV and WebGS
    Splatv,
    /// Pieces of straight motion, for readers of 4dgs
    #[value(name = "4dgs")]
    FourDgs,
    /// One frame, for most web viewers
    Spz,
}

/// `score`
#[derive(Debug, Args)]
pub(super) struct ScoreArgs {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// rows.npz (arrays D kappa V life C E vis static_score dynamic_score score keep; W with visible
    /// coverage) or rows.csv
    #[arg(short, long, value_name = "FILE")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) earlier: Earlier,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// `render`
#[derive(Debug, Args)]
#[command(group(clap::ArgGroup::new("wanted").args(["frame", "all", "video"]).required(true)))]
pub(super) struct Render {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Frame of the one picture to render, from 0
    #[arg(long, value_name = "T", requires = "view")]
    pub(super) frame: Option<u32>,
    /// View of the one picture to render, or that --video follows through time
    #[arg(long, value_name = "V", conflicts_with = "all")]
    pub(super) view: Option<u32>,
    /// Render every picture of the split, into a folder of tNNN_vNN files
    #[arg(long)]
    pub(super) all: bool,
    /// Write a film, a picture for every frame: NAME.png or NAME.apng (animated PNG, every bit), NAME.gif, or with ffmpeg
    /// NAME.mp4 or NAME.webm. From --view [default: the first], or along --path. --frames of a model that is continuous
    /// in time need not be the cameras'
    #[arg(long, value_name = "FILE")]
    pub(super) video: Option<PathBuf>,
    /// Move through the cameras of these views as time goes on, such as 0,2,5 [default: of all that --all would render]
    #[arg(long, value_name = "VIEWS", num_args = 0..=1, value_delimiter = ',', conflicts_with = "view")]
    pub(super) path: Option<Vec<u32>>,
    /// Frames of --video a second [default: 25]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) fps: Option<u32>,
    /// Show another model of the same frames to the right in --video
    #[arg(long, value_name = "MODEL")]
    pub(super) beside: Option<PathBuf>,
    /// Which of the cameras' pictures [default: with --all and --path test, or all if none is held out; else all]
    #[arg(long, value_enum)]
    pub(super) split: Option<SplitArg>,
    /// Format of the files of --all [default: png]
    #[arg(long = "as", value_enum, value_name = "KIND", requires = "all")]
    pub(super) format: Option<ImageKind>,
    #[command(flatten)]
    pub(super) background: Background,
    /// NAME.png (8 bits, clamped) or NAME.npy (float32 [H, W, 3], not clamped); with --all a folder
    #[arg(short, long, value_name = "PATH", required_unless_present = "video", conflicts_with = "video")]
    pub(super) output: Option<PathBuf>,
    #[command(flatten)]
    pub(super) kept: CacheArgs,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// Kinds of picture files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum ImageKind {
    /// 8 bits per channel, clamped
    Png,
    /// float32 [H, W, 3], not clamped
    Npy,
}

/// What is behind the scene.
#[derive(Debug, Args)]
pub(super) struct Background {
    /// Colour behind the scene, each from 0 to 1 [default: the cameras' own, else the model's, else
    /// that of the model in whose folder the cameras are, else black]
    #[arg(long, value_name = "R,G,B", value_parser = parse_colour, allow_hyphen_values = true)]
    pub(super) background: Option<[f32; 3]>,
}

/// Two models, and the pictures to compare them on.
#[derive(Debug, Args)]
pub(super) struct CompareArgs {
    /// The model before compression: whatever `compress` reads
    pub(super) original: PathBuf,
    /// The model after it, of any kind
    pub(super) compressed: PathBuf,
    /// Training iteration of the original, if a model folder [default: the largest]
    #[arg(long, value_name = "K")]
    pub(super) iteration: Option<u32>,
    #[command(flatten)]
    pub(super) trained: Trained,
    /// Take folders of PLY frames with a gap in their numbers as they are
    #[arg(long)]
    pub(super) allow_gaps: bool,
    /// Whether to find out which Gaussian of a folder's frames is which, as `compress` does [default: auto]
    #[arg(long)]
    pub(super) link: Option<LinkArg>,
    #[command(flatten)]
    pub(super) memory: Memory,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Which of the cameras' pictures [default: test, or all if none is held out]
    #[arg(long, value_enum)]
    pub(super) split: Option<SplitArg>,
    /// Folder of photographs to compare both models with: tNNN_vNN.png, or named as the cameras name them
    #[arg(long, value_name = "FOLDER")]
    pub(super) ground_truth: Option<PathBuf>,
    /// Compare at most this many frames, evenly from first to last [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_frames: Option<u32>,
    #[command(flatten)]
    pub(super) background: Background,
    /// Compute FLIP too, the difference a person would see; takes some times longer
    #[arg(long)]
    pub(super) flip: bool,
}

/// `report`
#[derive(Debug, Args)]
pub(super) struct ReportArgs {
    #[command(flatten)]
    pub(super) models: CompareArgs,
    /// More models after compression, to show beside the first
    #[arg(value_name = "MORE", conflicts_with_all = ["work", "part"])]
    pub(super) more: Vec<PathBuf>,
    /// The sweep.json that `sweep` wrote, for its curves
    #[arg(long, value_name = "FILE")]
    pub(super) sweep: Option<PathBuf>,
    /// The precision.json that `precision` wrote, for its diagrams
    #[arg(long, value_name = "FILE")]
    pub(super) precision: Option<PathBuf>,
    /// Measure how long a render takes before and after; these times differ from run to run
    #[arg(long)]
    pub(super) render_time: bool,
    /// Folder to write report.html into, and all it shows as JSON and CSV
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) kept: CacheArgs,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// `evaluate`
#[derive(Debug, Args)]
pub(super) struct Evaluate {
    #[command(flatten)]
    pub(super) models: CompareArgs,
    /// Write the scores of every picture
    #[arg(long, value_name = "FILE")]
    pub(super) csv: Option<PathBuf>,
    #[command(flatten)]
    pub(super) kept: CacheArgs,
    #[command(flatten)]
    pub(super) earlier: Earlier,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// `sweep`
#[derive(Debug, Args)]
pub(super) struct Sweep {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Methods to compare: `default` and `paper`, the presets; `no-refine`, the first without refining; `paper-prune`,
    /// `paper-merge`, the paper's ablations; prunings by `visible` contribution, `projected` coverage, `opacity` or `scale` alone, and at `random`
    #[arg(long, value_name = "METHODS", value_delimiter = ',', default_values_t = Method::ALL.map(Method::name).map(str::to_owned),
          value_parser = clap::builder::PossibleValuesParser::new(Method::ALL.map(Method::name)))]
    pub(super) methods: Vec<String>,
    /// Fractions of the Gaussians to keep
    #[arg(long, value_name = "FRACTIONS", value_delimiter = ',', default_values_t = [0.8, 0.6, 0.4, 0.2, 0.1])]
    pub(super) fractions: Vec<f64>,
    /// Run `default` with these steps of refinement too, for error against run time; 0 refines nothing. Steps before
    /// cuts are as many in proportion
    #[arg(long, value_name = "STEPS", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(..=1_000_000))]
    pub(super) steps: Vec<u32>,
    /// Fraction of the Gaussians to keep with --steps
    #[arg(long, value_name = "FRACTION", default_value_t = 0.1, requires = "steps")]
    pub(super) steps_at: f64,
    /// Run every point so often and give the median time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) repeat: u32,
    /// Compare on at most this many frames, evenly from first to last
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_frames: u32,
    #[command(flatten)]
    pub(super) background: Background,
    /// Folder to write sweep.html into, a page with the curves, and what it shows as JSON and CSV
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) earlier: Earlier,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// `precision`
#[derive(Debug, Args)]
pub(super) struct PrecisionArgs {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// What to turn: pictures and strides of the first `look`; pictures and cuts of `rounds`; bits of `percentiles`; f32
    /// and f64 `sums`; radius and passes of `merging`; steps and pictures of `refining`; threads and memory of the
    /// `machine` [default: all, of long inputs without the last three, whose settings are whole runs]
    #[arg(long, value_name = "KNOBS", value_delimiter = ',',
          value_parser = clap::builder::PossibleValuesParser::new(Turned::ALL.map(Turned::name)))]
    pub(super) knobs: Vec<String>,
    /// Fraction of the Gaussians that every setting keeps
    #[arg(long, value_name = "FRACTION", default_value_t = 0.3)]
    pub(super) target_ratio: f64,
    /// Look at and rank by pictures of at most this many frames, evenly from first to last; whole runs have all
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_frames: u32,
    /// Run every setting up to so often and give median and range; fewer times where that takes 10 s
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) repeat: u32,
    /// Folder to write precision.html into, a page with the diagrams, and what it shows as JSON and CSV
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) earlier: Earlier,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// `view`
#[derive(Debug, Args)]
pub(super) struct ViewArgs {
    #[command(flatten)]
    pub(super) input: Input,
    /// The model after compression, of any kind, to show beside it
    pub(super) compressed: Option<PathBuf>,
    #[command(flatten)]
    pub(super) cameras: CameraFile,
    /// Show at most this many frames, evenly from first to last
    #[arg(long, value_name = "N", default_value_t = DEFAULT_FRAMES, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) max_frames: u32,
    /// Show at most this many of the original beside a compressed model [default: --max-frames]
    #[arg(long, value_name = "N", requires = "compressed", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) original_frames: Option<u32>,
    /// Show the original beside a compressed model with harmonics of this degree at most [default: its own]
    #[arg(long, value_name = "DEGREE", requires = "compressed", value_parser = clap::value_parser!(u8).range(0..=3))]
    pub(super) original_degree: Option<u8>,
    #[command(flatten)]
    pub(super) background: Background,
    /// Write a folder instead of one page where its frames take more than this
    #[arg(long, value_name = "SIZE", default_value = DEFAULT_PAGE, value_parser = parse_bytes)]
    pub(super) page_limit: u64,
    /// NAME.html, one page with everything in it, or a folder, whose index.html is the page; both open without a server
    #[arg(short, long, value_name = "PATH")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// Frames that a page shows at most.
pub(super) const DEFAULT_FRAMES: u32 = 60;
/// Bytes of frames that one page holds.
const DEFAULT_PAGE: &str = "64MB";

/// The limit of a page that nobody chose.
pub(super) fn default_page_limit() -> u64 {
    parse_bytes(DEFAULT_PAGE).expect("a size")
}

/// `pack`
#[derive(Debug, Args)]
pub(super) struct Pack {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// Container to write
    #[arg(short, long, value_name = "FILE.gseq")]
    pub(super) output: PathBuf,
    /// Let values of columns be so far off: `position=1e-3` in the column's unit (scene units, components of
    /// quaternions, logs of scales, logits, harmonics), or `position=0.01%` of the scene's extent; columns that are not named
    /// keep every bit. Each value is checked as it is written, and the file says its bounds
    #[arg(long, value_name = "COLUMN=BOUND", value_delimiter = ',', conflicts_with = "raw")]
    pub(super) max_error: Vec<MaxError>,
    /// Store tiles as they are, to be used in place
    #[arg(long, conflicts_with = "level")]
    pub(super) raw: bool,
    /// zstd level [default: 1, with --max-error 15]
    #[arg(long, value_name = "1-19", value_parser = clap::value_parser!(i32).range(1..=19))]
    pub(super) level: Option<i32>,
    #[command(flatten)]
    pub(super) kept: CacheArgs,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// `convert`
#[derive(Debug, Args)]
pub(super) struct Convert {
    #[command(flatten)]
    pub(super) input: Input,
    /// What to write: NAME.splatv, .4dgs, .spz, .gseq, .ply, or a folder of the input's own kind
    #[arg(value_name = "OUTPUT")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// Kind of result, whatever it is called
    #[arg(long = "as", value_name = "KIND", value_enum)]
    pub(super) kind: Option<OutputKindArg>,
    /// Print what was written as JSON
    #[arg(long)]
    pub(super) json: bool,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// `info`
#[derive(Debug, Args)]
pub(super) struct InfoArgs {
    #[command(flatten)]
    pub(super) input: Input,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// `verify`
#[derive(Debug, Args)]
pub(super) struct Verify {
    /// Container to check
    pub(super) input: PathBuf,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// `unpack`
#[derive(Debug, Args)]
pub(super) struct Unpack {
    #[command(flatten)]
    pub(super) input: Input,
    #[command(flatten)]
    pub(super) cameras: Cameras,
    /// Folder to write frame_NNNNN.ply into; of an archive (.gsz) the model folder, or the name of its PLY
    #[arg(short, long, value_name = "PATH", required_unless_present = "stream", conflicts_with = "stream")]
    pub(super) output: Option<PathBuf>,
    /// Write a frame stream to standard output instead, for another program to read (format/STREAM.md)
    #[arg(long)]
    pub(super) stream: bool,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// `work`
#[derive(Debug, Args)]
pub(super) struct WorkArgs {
    /// The folder
    pub(super) folder: PathBuf,
    /// Remove everything that stages have kept in it, and the folder if nothing else is in it
    #[arg(long, conflicts_with = "json")]
    pub(super) clean: bool,
    /// Print what is there as JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// `recover`
#[derive(Debug, Args)]
pub(super) struct Recover {
    /// Container that was cut short
    pub(super) input: PathBuf,
    /// Container to write
    #[arg(short, long, value_name = "FILE.gseq")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// `demo`
#[derive(Debug, Args)]
pub(super) struct Demo {
    /// Folder to write the scene, its compressed models, the pages and the film into
    #[arg(short, long, value_name = "FOLDER", default_value = "splatsieve-demo")]
    pub(super) output: PathBuf,
    /// Gaussians of the scene
    #[arg(long, value_name = "N", default_value_t = Playground::COUNT as u32, value_parser = clap::value_parser!(u32).range(1000..=1_000_000))]
    pub(super) gaussians: u32,
    /// Frames of the scene
    #[arg(long, value_name = "T", default_value_t = Playground::FRAMES as u32, value_parser = clap::value_parser!(u32).range(2..=10_000))]
    pub(super) frames: u32,
    /// Optimization steps of each refinement [default: enough for the usual scene]
    #[arg(long, value_name = "N")]
    pub(super) refine_steps: Option<u32>,
    #[command(flatten)]
    pub(super) memory: Memory,
    #[command(flatten)]
    pub(super) earlier: Earlier,
}

/// `test-scene`
#[derive(Debug, Args)]
pub(super) struct TestScene {
    /// Keep the scene and the result in this folder [default: a temporary one]
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: Option<PathBuf>,
    /// Gaussians of the scene
    #[arg(long, value_name = "N", default_value_t = 6000, value_parser = clap::value_parser!(u32).range(100..=10_000_000))]
    pub(super) gaussians: u32,
    /// Frames of the scene
    #[arg(long, value_name = "T", default_value_t = 48, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(super) frames: u32,
    /// Fraction of the Gaussians to keep
    #[arg(long, value_name = "R", default_value_t = 0.3)]
    pub(super) target_ratio: f64,
    #[command(flatten)]
    pub(super) memory: Memory,
    #[command(flatten)]
    pub(super) earlier: Earlier,
    #[command(flatten)]
    pub(super) recipe: RecipeFlags,
}

/// `selfcheck`
#[derive(Debug, Args)]
pub(super) struct Selfcheck {
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

/// `recipe`
#[derive(Debug, Args)]
pub(super) struct RecipeVerb {
    /// `default`, `paper` (which documents every parameter), `gentle` or `strong`
    #[arg(long, default_value = "paper")]
    pub(super) preset: String,
}

/// `completions`
#[derive(Debug, Args)]
pub(super) struct Completions {
    /// Shell to complete for
    #[arg(value_enum)]
    pub(super) shell: clap_complete::Shell,
}

/// `man`
#[derive(Debug, Args)]
pub(super) struct Man {
    /// Folder to write them into, which is made
    pub(super) folder: PathBuf,
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let expected = || format!("expected WIDTHxHEIGHT such as 800x800, found {}", quoted(text));
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    match (width.parse(), height.parse()) {
        (Ok(width @ 1..=65_535), Ok(height @ 1..=65_535)) => Ok((width, height)),
        _ => Err(expected()),
    }
}

fn parse_times(text: &str) -> Result<Times, String> {
    Ok(Times::named(text))
}

fn parse_bytes(text: &str) -> Result<u64, String> {
    match text.parse::<bytesize::ByteSize>() {
        Ok(bytes) if bytes.as_u64() > 0 => Ok(bytes.as_u64()),
        _ => Err(format!("expected a size such as 512MiB or 4GB, found {}", quoted(text))),
    }
}

fn parse_decibels(text: &str) -> Result<f64, String> {
    let number = text.trim().trim_end_matches(['b', 'B']).trim_end_matches(['d', 'D']).trim_end();
    match number.parse::<f64>() {
        Ok(decibels) if decibels > 0.0 && decibels <= 100.0 => Ok(decibels),
        _ => Err(format!("expected decibels above 0 and at most 100, such as 0.5 or 35dB, found {}", quoted(text))),
    }
}

fn parse_colour(text: &str) -> Result<[f32; 3], String> {
    let channels: Vec<f32> = numbers(text)?;
    channels.try_into().map_err(|c: Vec<f32>| format!("expected three numbers, found {}", c.len()))
}

fn parse_box(text: &str) -> Result<[f64; 6], String> {
    let corners: [f64; 6] =
        numbers(text)?.try_into().map_err(|n: Vec<f64>| format!("expected six numbers, found {}", n.len()))?;
    // A NaN is in no order.
    let in_order = |axis: usize| corners[axis].partial_cmp(&corners[axis + 3]).is_some_and(|order| order.is_le());
    match (0..3).find(|&axis| !in_order(axis)) {
        Some(axis) => Err(format!("axis {axis}: {} is not below {}", corners[axis], corners[axis + 3])),
        None => Ok(corners),
    }
}
