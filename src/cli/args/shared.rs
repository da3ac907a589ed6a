//! Options that several commands share: input, cameras, memory, cache, overwriting.

use std::path::PathBuf;

use clap::builder::{PathBufValueParser, TypedValueParser as _};
use clap::{Args, ValueEnum};

use super::choices::{LINK_MODES, ROTATION_LAYOUTS, SPLITS, ZERO_ROTATIONS, choice};
use super::values::{check_scratch_folder, parse_bytes, parse_duration, parse_size, parse_times};
use super::{CACHE, CAMERAS, MACHINE};
use splatsieve::cache::Shard;
use splatsieve::files::cameras::TimesSource;
use splatsieve::models::{LinkMode, ZeroRotation};
use splatsieve::scene::view_selection::ViewSet;

/// Input of a command.
#[derive(Debug, Args)]
pub(in crate::cli) struct Input {
    /// Trained model (folder or checkpoint of any supported trainer), folder with one file per frame, a single file (.ply,
    /// .splatv, .tsog, .ftgs.ply, .spz, .sog, .splat, .glb, .gsz or .gseq), or `-` for a frame stream on standard input.
    /// See docs/inputs.md
    pub(in crate::cli) input: PathBuf,
    /// Training iteration of a model folder [default: the largest]
    #[arg(long, value_name = "K", hide_short_help = true)]
    pub(in crate::cli) iteration: Option<u32>,
    #[command(flatten)]
    pub(in crate::cli) trained: Trained,
    /// Accept a folder of PLY frames with missing frame numbers or with entries that are no files
    #[arg(long, hide_short_help = true)]
    pub(in crate::cli) allow_gaps: bool,
    /// When to match the Gaussians of each frame with those of the next (tracking), for sequences whose frames list
    /// their Gaussians in different orders [default: auto]
    #[arg(long, hide_short_help = true, value_parser = choice(LINK_MODES))]
    pub(in crate::cli) link: Option<LinkMode>,
    /// Folder for temporary files: frames of a stream, tracked frames, and data that do not fit into --memory [default:
    /// the folder that contains the output, else the system's folder for temporary files]
    #[arg(long, value_name = "FOLDER", help_heading = MACHINE, hide_short_help = true, value_parser = PathBufValueParser::new().try_map(check_scratch_folder))]
    pub(in crate::cli) scratch_dir: Option<PathBuf>,
    #[command(flatten)]
    pub(in crate::cli) memory: Memory,
}

/// Facts about the training that a model's files do not contain.
#[derive(Debug, Args)]
pub(in crate::cli) struct Trained {
    /// Time span of a 4D Gaussian Splatting checkpoint (its setting time_duration): the length L, or the ends A,B
    /// [default: as in a YAML file beside it, else 10 if frame times exceed 1, else 1]
    #[arg(long, value_name = "L", hide_short_help = true, value_parser = parse_duration, allow_hyphen_values = true)]
    pub(in crate::cli) time_duration: Option<f64>,
    /// Layout of the 4D rotations of a 4D Gaussian Splatting checkpoint. unflipped: trained with code from before 15
    /// September 2024 [default: flipped]
    #[arg(long = "rot4d", value_name = "HOW", hide_short_help = true, value_parser = choice(ROTATION_LAYOUTS))]
    pub(in crate::cli) rot4d_unflipped: Option<bool>,
    /// Handling of Gaussians of a .splatv or .ftgs.ply whose quaternion is zero; players do not draw them [default:
    /// drop]
    #[arg(long, value_name = "HOW", hide_short_help = true, value_parser = choice(ZERO_ROTATIONS))]
    pub(in crate::cli) zero_rotation: Option<ZeroRotation>,
}

/// Cache folder of a run, for resuming it and for dividing it among several processes.
#[derive(Debug, Args)]
pub(in crate::cli) struct CacheArgs {
    /// Keep the results of finished stages in this folder. After an interruption, the same command continues from them
    #[arg(long, help_heading = CACHE, value_name = "FOLDER")]
    pub(in crate::cli) cache: Option<PathBuf>,
    /// Divide the next stage that can be divided into N shards, compute only shard I (1 to N), and store it in --cache.
    /// Once all N are stored, a run without this option joins them and continues
    #[arg(long, help_heading = CACHE, value_name = "I/N", requires = "cache", hide_short_help = true)]
    pub(in crate::cli) shard: Option<Shard>,
}

/// Options for the results of a command.
#[derive(Debug, Args)]
pub(in crate::cli) struct ResultFlags {
    /// Print JSON
    #[arg(long)]
    pub(in crate::cli) json: bool,
    /// Replace an output file that exists; in a folder, replace the files of an earlier result and keep all others
    #[arg(long)]
    pub(in crate::cli) overwrite: bool,
}

/// Memory limit.
#[derive(Debug, Args)]
pub(in crate::cli) struct Memory {
    /// Memory limit, such as 512MiB or 4GB [default: a quarter of the memory that this process may use: the smallest of
    /// the machine's memory and the limits of its control group, its Slurm or Windows job, and ulimit]
    ///
    /// The limit does not change the result, except that `compress` reduces or leaves out refinement if it needs more; the
    /// summary says so.
    #[arg(long, help_heading = MACHINE, value_name = "SIZE", value_parser = parse_bytes)]
    pub(in crate::cli) memory: Option<u64>,
    /// Print the plan before the run (stages, memory, time, reads), and the peak memory at the end
    #[arg(long, help_heading = MACHINE)]
    pub(in crate::cli) explain: bool,
}

/// Cameras of the scene.
#[derive(Debug, Args)]
pub(in crate::cli) struct CameraFile {
    /// Cameras: the data folder, or transforms*.json, cameras.json, poses_bounds.npy, a COLMAP reconstruction, or
    /// dataset.json (NeRFies, HyperNeRF). A folder gives all its splits, a file only itself [default: the data folder
    /// named in cfg_args; without it, virtual views]
    #[arg(long, help_heading = CAMERAS, value_name = "PATH")]
    pub(in crate::cli) cameras: Option<PathBuf>,
    /// Number of evenly spaced frames, for a model that is continuous in time [default: the times of the cameras]
    #[arg(long, help_heading = CAMERAS, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(in crate::cli) frames: Option<u32>,
    /// Width and height of the views in pixels, if the camera file has none. Views of COLMAP, NeRFies and LLFF are
    /// scaled to it
    #[arg(long, help_heading = CAMERAS, value_name = "WxH", value_parser = parse_size)]
    pub(in crate::cli) resolution: Option<(u32, u32)>,
    /// Times of the images, if the camera file has none (COLMAP, cameras.json). names: the number in each image name.
    /// none: every camera sees every frame. FILE: a CSV file of name,time [default: names for COLMAP images with
    /// numbers and an input in motion, else none]
    #[arg(long, help_heading = CAMERAS, hide_short_help = true, value_name = "names|none|FILE", value_parser = parse_times)]
    pub(in crate::cli) times: Option<TimesSource>,
}

/// Cameras and the split that is used.
#[derive(Debug, Args)]
pub(in crate::cli) struct Cameras {
    #[command(flatten)]
    pub(in crate::cli) file: CameraFile,
    /// Split of the data set whose views Gaussians are scored by [default: train]
    #[arg(long, help_heading = CAMERAS, value_parser = choice(SPLITS))]
    pub(in crate::cli) split: Option<ViewSet>,
}

/// What a dry run prints.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum DryRun {
    /// Plan, time and memory
    Plan,
    /// Stages that --shard divides, in order, with their units
    Stages,
}
