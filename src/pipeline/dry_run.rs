//! Dry run: reports what a run would do, how long it would take and what it would write. Only opens the input.

use std::fmt::Write as _;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::request::{Goal, Quality, Request};
use super::summary::CameraSummary;
use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::journal::Journal;
use crate::journal::records::Forecast;
use crate::journal::records::OmittedWork;
use crate::memory_plan::{MemoryPlan, Verbosity, Workload};
use crate::outputs::kind::OutputKind;
use crate::pipeline::plan::RunPlan;
use crate::pipeline::planning::InputMeta;
use crate::pipeline::stages::write::companion_names;
use crate::progress::counted;
use crate::scene::{InputOptions, open_scene};

/// Report of a dry run, which tells what a run would do without doing it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct DryRunReport {
    /// Name and version of the program.
    pub tool: String,
    /// Always true; distinguishes this report from the summary of a run.
    pub dry_run: bool,
    /// Path of the input as given.
    pub path: String,
    /// Kind of the input: "4DGaussians model", "PLY sequence", ...
    pub kind: String,
    /// Number of Gaussians of the input.
    pub gaussians_in: usize,
    /// Number of frames of the input.
    pub frames: usize,
    /// SH degree of the input.
    pub sh_degree: usize,
    /// Number of bytes of the input.
    pub bytes: u64,
    /// Cameras whose views would be rendered.
    pub cameras: CameraSummary,
    /// Number of Gaussians in the output; `None` if it is found only during the run.
    pub gaussians: Option<usize>,
    /// Text that states how the number of Gaussians in the output is determined.
    pub size_by: String,
    /// Text that states how many Gaussians ranking and refinement would leave.
    pub counts: String,
    /// Path of the output.
    pub output: String,
    /// Kind of the output.
    pub output_kind: OutputKind,
    /// Paths that would be written: the output, and the recipe, index map and summary in or beside it.
    pub would_write: Vec<String>,
    /// Expected time and memory of the run.
    pub forecast: Forecast,
    /// Stages that would be omitted, with reasons.
    pub left_out: Vec<OmittedWork>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Returns the report of a dry run of `request`. Only opens the input.
///
/// # Errors
/// Fails for every reason for which a run would fail before its first stage. Also fails for a stream, whose size is
/// unknown before it has arrived completely.
pub fn dry_run(request: &Request) -> Result<DryRunReport> {
    if request.input.is_stream() {
        return Err(Error::usage(
            "--dry-run: the cost of a stream is known only after it has ended\n  give a file or folder; --explain says \
             how many frames there is memory for",
        ));
    }
    let input = InputOptions { work: None, ..request.input.clone() };
    let mut scene = open_scene(&input)?;
    let outlook = InputMeta::from_scene(&scene);
    let run = RunPlan::within_memory(request, outlook, &scene.workload())?;
    run.check_target(&request.input.path, request.input.cameras.as_deref())?;
    run.check(&scene)?;
    let needs = |work: &Workload, limits: &_| run.estimates(work, limits);
    let plan = MemoryPlan::fit_budget(scene.workload(), input.memory, &input.events, needs)?;
    scene.apply_plan(&plan);
    let work = scene.workload();
    let forecast = Forecast::new(&work, &run.estimates(&work, &scene.limits), plan.peak_bytes());
    let mut journal = Journal::default();
    run.stages.record_left_out(&scene.workload(), &scene.limits, &mut journal);
    let info = scene.source().info();
    let gaussians = request.target.map(|target| target.resolve_count(outlook.gaussians)).transpose()?;
    let output = request.output.to_string_lossy().into_owned();
    let output_kind = run.output.as_ref().map_or(outlook.default_output_kind, |output| output.kind);
    Ok(DryRunReport {
        tool: TOOL.to_owned(),
        dry_run: true,
        path: scene.path.to_string_lossy().into_owned(),
        kind: scene.input.description().kind.to_owned(),
        gaussians_in: info.count,
        frames: info.times.len(),
        sh_degree: info.sh_degree,
        bytes: scene.input.bytes()?,
        cameras: CameraSummary::from_scene(&scene),
        gaussians,
        size_by: size_by(request),
        would_write: std::iter::once(output.clone()).chain(companion_names(&request.output, output_kind)).collect(),
        output,
        output_kind,
        counts: run.planned_counts_text(),
        forecast,
        left_out: journal.left_out,
        notes: scene.notes,
    })
}

/// Returns a text that states how the number of Gaussians in the output of `request` is determined.
fn size_by(request: &Request) -> String {
    match (&request.goal, &request.target) {
        (Some(Goal::Quality(Quality::Psnr(least))), _) => {
            format!("the smallest number with {least} dB PSNR against the original, found by a search")
        }
        (Some(Goal::Quality(Quality::Loss { most, .. })), _) => {
            format!("the smallest number that loses at most {most} dB PSNR against the photographs, found by a search")
        }
        (Some(Goal::Bytes(most)), _) => format!("as many as fit {most} bytes"),
        (None, Some(_)) => "as requested".to_owned(),
        (None, None) => "as many as pass the thresholds of the recipe, known only after scoring".to_owned(),
    }
}

impl DryRunReport {
    /// Returns this report of a dry run as text for display.
    pub fn text(&self) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "{}: {}, {} x {}, SH degree {}",
            Path::new(&self.path).shown(),
            self.kind,
            counted(self.gaussians_in, "Gaussian"),
            counted(self.frames, "frame"),
            self.sh_degree
        );
        let CameraSummary { origin, cameras, pairs } = &self.cameras;
        let (cameras, views) = (counted(*cameras, "camera"), counted(*pairs, "view"));
        let _ = writeln!(out, "cameras: {origin} ({cameras}, {views})");
        let _ = match self.gaussians {
            Some(count) => {
                let percent = 100.0 * count as f64 / self.gaussians_in.max(1) as f64;
                writeln!(out, "would keep {count} of {} Gaussians ({percent:.1}%), {}", self.gaussians_in, self.size_by)
            }
            None => writeln!(out, "would keep {}", self.size_by),
        };
        let _ = writeln!(out, "{}", self.counts);
        let core_seconds: f64 = self.forecast.stages.iter().map(|stage| stage.core_seconds).sum();
        for stage in &self.forecast.stages {
            let part = 100.0 * stage.core_seconds / core_seconds.max(1e-9);
            let _ = writeln!(out, "  {:<8} {part:>3.0}% of the time", stage.name);
        }
        for left in &self.left_out {
            let _ = writeln!(out, "  left out: {} ({})", left.what, left.reason());
        }
        for note in &self.notes {
            let _ = writeln!(out, "  note: {note}");
        }
        out += &self.forecast.text(Verbosity::Time);
        let would_write: Vec<String> =
            self.would_write.iter().map(|path| Path::new(path).shown().to_string()).collect();
        let _ = writeln!(out, "would write {}", would_write.join(", "));
        out.push_str("nothing was written (--dry-run)\n");
        out
    }
}
