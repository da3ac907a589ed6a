//! Options of the commands that study methods and settings: `sweep` and `precision`.

use std::path::PathBuf;

use clap::Args;

use super::values::parse_ratio;
use super::{Background, CameraFile, Input, RecipeFlags, ResultFlags};
use splatsieve::diagnostics::precision::Knob;
use splatsieve::evaluation::method::Method;

/// Arguments of `sweep`.
#[derive(Debug, Args)]
pub(in crate::cli) struct Sweep {
    #[command(flatten)]
    pub(in crate::cli) input: Input,
    #[command(flatten)]
    pub(in crate::cli) cameras: CameraFile,
    /// Methods to compare. default, paper: the presets. no-refine: default without refinement. paper-prune: paper
    /// without merging. paper-merge: paper without pruning. visible, projected, opacity, scale: pruning by visible
    /// contribution, projected coverage, opacity or scale alone. random: pruning at random. With the default fractions, all
    /// methods are up to 55 runs
    #[arg(long, value_name = "METHODS", value_delimiter = ',', default_values_t = Method::ALL.map(Method::name).map(str::to_owned),
          value_parser = clap::builder::PossibleValuesParser::new(Method::ALL.map(Method::name)))]
    pub(in crate::cli) methods: Vec<String>,
    /// Fractions of the Gaussians to keep, such as 0.5,20%,10x
    #[arg(long, value_name = "FRACTIONS", value_delimiter = ',', default_value = "0.8,0.6,0.4,0.2,0.1", value_parser = parse_ratio)]
    pub(in crate::cli) fractions: Vec<f64>,
    /// Also run `default` with each of these numbers of final refinement steps, for a curve of error against run time.
    /// 0: no refinement. The number of steps before each prune step changes in proportion
    #[arg(long, value_name = "STEPS", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(..=1_000_000))]
    pub(in crate::cli) steps: Vec<u32>,
    /// Fraction of the Gaussians to keep with --steps
    #[arg(long, value_name = "FRACTION", default_value_t = 0.1, requires = "steps")]
    pub(in crate::cli) steps_at: f64,
    /// Number of runs per method and fraction; the reported time is their median
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(in crate::cli) repeat: u32,
    /// Maximum number of frames to compare, spread evenly
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..))]
    pub(in crate::cli) max_frames: u32,
    #[command(flatten)]
    pub(in crate::cli) background: Background,
    /// Output folder: sweep.html with the curves, and its data as JSON and CSV
    #[arg(short, long, value_name = "FOLDER")]
    pub(in crate::cli) output: PathBuf,
    #[command(flatten)]
    pub(in crate::cli) results: ResultFlags,
}

/// Arguments of `precision`.
#[derive(Debug, Args)]
pub(in crate::cli) struct PrecisionArgs {
    #[command(flatten)]
    pub(in crate::cli) input: Input,
    #[command(flatten)]
    pub(in crate::cli) cameras: CameraFile,
    /// Groups of settings to vary. scoring: number of views, and strides of pixels, views and frames, of the first
    /// scoring pass. rounds: number of views of a pruning round, and fraction of the Gaussians that it keeps.
    /// percentiles: resolution of the histogram from which percentiles are read. sums: f32 or f64 arithmetic. merging:
    /// radius, and number of passes. refining: number of steps and of target views. machine: threads and memory limit
    /// [default: all; for a long input all except the last three, which need complete runs]
    #[arg(long, value_name = "GROUPS", value_delimiter = ',',
          value_parser = clap::builder::PossibleValuesParser::new(Knob::ALL.map(Knob::name)))]
    pub(in crate::cli) knobs: Vec<String>,
    /// Fraction of the Gaussians that every setting keeps
    #[arg(long, value_name = "FRACTION", default_value = "0.3", value_parser = parse_ratio)]
    pub(in crate::cli) ratio: f64,
    /// Maximum number of frames for scoring and ranking, spread evenly; complete runs use all
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..))]
    pub(in crate::cli) max_frames: u32,
    /// Maximum number of runs per setting, for median and range; fewer where they take more than 10 s
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(in crate::cli) repeat: u32,
    /// Output folder: precision.html with the plots, and its data as JSON and CSV
    #[arg(short, long, value_name = "FOLDER")]
    pub(in crate::cli) output: PathBuf,
    #[command(flatten)]
    pub(in crate::cli) results: ResultFlags,
    #[command(flatten)]
    pub(in crate::cli) recipe: RecipeFlags,
}
