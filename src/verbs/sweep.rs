//! Trade-off curves: every method at every kept fraction, compressed as a user would and compared with
//! the original on held-out pictures.
//!
//! Every point is a whole run, from opening the input to a result on the disk, so that its time and
//! memory are those of that run alone; the result is deleted once it is measured. Memory: that of
//! `compress`, then that of `evaluate`.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use super::baseline::{Baseline, prune_by};
use super::evaluate::{EvaluateOptions, evaluate};
use super::trade_off::{Point, TradeOff};
use crate::TOOL;
use crate::budget::{peak_memory_bytes, reset_peak_memory};
use crate::compress::{Only, Request, Target, compress};
use crate::emit::atomic::{Kind, MARKER, Replace, StagedFolder, check_target};
use crate::error::{Error, Result};
use crate::model::{Columns, Split};
use crate::recipe::{Coverage, Groups, Recipe, StaticTerm};
use crate::scene::pictures::PictureSet;
use crate::scene::{InputOptions, open_scene};
use crate::stream::Progress;

/// A way to make a model smaller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Preset `default`.
    Default,
    /// Preset `default` that leaves what stays as it was.
    NoRefine,
    /// Preset `paper`: prunes and merges.
    Paper,
    /// Preset `paper` without merging.
    PaperPrune,
    /// Preset `paper` without pruning.
    PaperMerge,
    /// Prunes by visible contribution C alone.
    Visible,
    /// Prunes by projected coverage C alone.
    Projected,
    /// Prunes by opacity alone.
    Opacity,
    /// Prunes by size alone.
    Scale,
    /// Prunes at random.
    Random,
}

impl Method {
    /// Every method, ours first.
    pub const ALL: [Method; 10] = [
        Method::Default,
        Method::NoRefine,
        Method::Paper,
        Method::PaperPrune,
        Method::PaperMerge,
        Method::Visible,
        Method::Projected,
        Method::Opacity,
        Method::Scale,
        Method::Random,
    ];

    /// As the command line and the results name it.
    pub fn name(self) -> &'static str {
        match self {
            Method::Default => "default",
            Method::NoRefine => "no-refine",
            Method::Paper => "paper",
            Method::PaperPrune => "paper-prune",
            Method::PaperMerge => "paper-merge",
            Method::Visible => "visible",
            Method::Projected => "projected",
            Method::Opacity => "opacity",
            Method::Scale => "scale",
            Method::Random => "random",
        }
    }

    /// How it compresses.
    fn means(self) -> Result<Means> {
        let unrefined = || {
            let mut recipe = Recipe::preset("default")?;
            recipe.refine.refine = Groups(Columns::empty());
            Ok::<_, Error>(recipe)
        };
        let pruning = |coverage| {
            let mut recipe = unrefined()?;
            recipe.scan.coverage = coverage;
            recipe.score.static_term = StaticTerm::Mean;
            // S = C without clipping, so that no two Gaussians tie that differ in C.
            recipe.score.w_dynamic = 0.0;
            recipe.score.clip_norm = false;
            recipe.select.round_fraction = 1.0;
            recipe.select.choose_by_views = false;
            Ok::<_, Error>(Means::Recipe(Box::new(recipe), Only::Prune))
        };
        let paper = |only| Ok(Means::Recipe(Box::new(Recipe::preset("paper")?), only));
        match self {
            Method::Default => Ok(Means::Recipe(Box::new(Recipe::preset("default")?), Only::Both)),
            Method::NoRefine => Ok(Means::Recipe(Box::new(unrefined()?), Only::Both)),
            Method::Paper => paper(Only::Both),
            Method::PaperPrune => paper(Only::Prune),
            Method::PaperMerge => paper(Only::Merge),
            Method::Visible => pruning(Coverage::Visible),
            Method::Projected => pruning(Coverage::Projected),
            Method::Opacity => Ok(Means::Baseline(Baseline::Opacity)),
            Method::Scale => Ok(Means::Baseline(Baseline::Scale)),
            Method::Random => Ok(Means::Baseline(Baseline::Random)),
        }
    }

    /// Whether it has a size of its own choice, by thresholds.
    fn chooses_size(self) -> bool {
        matches!(self, Method::Default | Method::NoRefine | Method::Paper | Method::PaperPrune | Method::PaperMerge)
    }
}

/// How a method compresses.
enum Means {
    Recipe(Box<Recipe>, Only),
    Baseline(Baseline),
}

/// What to sweep.
#[derive(Debug, Clone)]
pub struct SweepOptions {
    /// What to read, and the cameras; of its split nothing is used.
    pub input: InputOptions,
    /// Methods, in the order of the result.
    pub methods: Vec<Method>,
    /// Kept fractions, in (0, 1].
    pub fractions: Vec<f64>,
    /// Compare on at most this many frames, evenly; none: all.
    pub max_frames: Option<usize>,
    /// Red, green, blue in [0, 1]; none: as `evaluate`.
    pub background: Option<[f32; 3]>,
    /// Folder for `sweep.json`, `sweep.csv`.
    pub output: PathBuf,
    /// Replace an earlier folder.
    pub overwrite: Replace,
}

/// Runs every method at every fraction, and those that choose a size by themselves at that too. Scores by
/// the training pictures, compares by the held-out ones.
///
/// # Errors
/// Whatever is wrong with input, cameras, fractions or output. Nothing is left behind then.
pub fn sweep(options: &SweepOptions) -> Result<TradeOff> {
    if let Some(&odd) = options.fractions.iter().find(|&&fraction| !(fraction > 0.0 && fraction <= 1.0)) {
        return Err(Error::usage(format!("--fractions: expected numbers above 0 and at most 1, found {odd}")));
    }
    if options.input.is_stream() {
        return Err(Error::usage("sweep reads its input many times: pack the stream first, then sweep the .gseq"));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_target(&options.output, Kind::Folder, &inputs, options.overwrite)?;
    let staged = StagedFolder::new(&options.output, options.overwrite)?;
    let mut fractions = options.fractions.clone();
    fractions.sort_unstable_by(|a, b| b.total_cmp(a));
    fractions.dedup();

    let (mut found, name) = start(options)?;
    let scratch = staged.path().join("point");
    let points: Vec<(Method, Option<f64>)> = options
        .methods
        .iter()
        .flat_map(|&method| {
            let own = method.chooses_size().then_some(None);
            own.into_iter().chain(fractions.iter().copied().map(Some)).map(move |asked| (method, asked))
        })
        .collect();
    let progress = Progress::new("sweep", "points", points.len() as u64);
    for (method, asked) in points {
        if !beyond_merging(method, asked, &found) {
            let point = measure(options, method, asked, &scratch, name, &mut found)?;
            found.points.push(point);
        }
        progress.advance(1);
    }
    if let Some(least) = merged_alone(&found) {
        let name = Method::PaperMerge.name();
        found.notes.push(format!("{name}: merging alone leaves {least} Gaussians, so it has no smaller points"));
    }
    let write = |name: &str, text: String| {
        let path = staged.path().join(name);
        fs::write(&path, text).map_err(Error::io("write", &path))
    };
    write("sweep.csv", found.csv())?;
    write("sweep.json", found.json())?;
    // By this a later run knows the folder as one that it may replace.
    write(MARKER, format!("{:#}\n", serde_json::json!({ "tool": found.tool })))?;
    staged.commit()?;
    Ok(found)
}

/// What all points share, and the name by which a result is of the input's kind.
fn start(options: &SweepOptions) -> Result<(TradeOff, &'static str)> {
    let scene = open_scene(&train(&options.input))?;
    let name = if scene.input.columns()?.is_empty() { "result" } else { "result.gseq" };
    let found = TradeOff {
        tool: TOOL.to_owned(),
        path: scene.path.display().to_string(),
        digest: scene.input.digest()?,
        gaussians: scene.source().info().count,
        bytes: scene.input.bytes()?,
        threads: rayon::current_num_threads(),
        pictures: 0,
        cameras: scene.rig.origin.clone(),
        points: Vec::new(),
        notes: scene.notes,
    };
    Ok((found, name))
}

fn train(input: &InputOptions) -> InputOptions {
    InputOptions { split: Some(Split::Train), ..input.clone() }
}

/// Gaussians that merging leaves where nothing is pruned, once that point is measured.
fn merged_alone(found: &TradeOff) -> Option<usize> {
    let own = |point: &&Point| point.method == Method::PaperMerge.name() && point.asked.is_none();
    found.points.iter().find(own).map(|point| point.count)
}

/// Whether `method` merges only, and cannot merge that much.
fn beyond_merging(method: Method, asked: Option<f64>, found: &TradeOff) -> bool {
    let wanted = asked.filter(|_| method == Method::PaperMerge).map(|fraction| fraction * found.gaussians as f64);
    wanted.zip(merged_alone(found)).is_some_and(|(wanted, least)| wanted.round() < least as f64)
}

/// One point: compresses to `name` in the new folder `scratch`, measures, deletes both.
fn measure(
    options: &SweepOptions,
    method: Method,
    asked: Option<f64>,
    scratch: &Path,
    name: &str,
    found: &mut TradeOff,
) -> Result<Point> {
    let input = train(&options.input);
    fs::create_dir(scratch).map_err(Error::io("create", scratch))?;
    let output = scratch.join(name);
    let resets = reset_peak_memory();
    let start = Instant::now();
    let target = asked.map(Target::Ratio);
    let bytes = match method.means()? {
        Means::Recipe(recipe, only) => {
            let run = Request::new(input.clone(), output.clone(), *recipe);
            compress(&Request { only, target, ..run })?.output_bytes
        }
        Means::Baseline(baseline) => Some(prune_by(baseline, &input, target, &output)?),
    };
    let seconds = start.elapsed().as_secs_f64();
    let peak_memory_bytes = if resets { peak_memory_bytes() } else { None };
    let evaluation = evaluate(&EvaluateOptions {
        original: input,
        compressed: output,
        ground_truth: None,
        part: PictureSet::HeldOut,
        max_frames: options.max_frames,
        background: options.background,
        flip: false,
        csv: None,
        overwrite: Replace::Never,
    })?;
    fs::remove_dir_all(scratch).map_err(Error::io("remove", scratch))?;
    found.pictures = evaluation.cameras.pairs;
    let means = evaluation.loss.overall;
    Ok(Point {
        method: method.name().to_owned(),
        asked,
        count: evaluation.count.compressed,
        bytes: bytes.unwrap_or(evaluation.bytes.compressed),
        psnr: means.psnr,
        ssim: means.ssim,
        temporal: means.temporal,
        seconds,
        peak_memory_bytes,
    })
}
