//! The verb `convert`: any input as any kind of result, with all of its Gaussians as they are.

use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::TOOL;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::files::atomic::{Kind, MARKER, Replace, StagedFile, StagedFolder, check_target};
use crate::limits::Limits;
use crate::memory_plan::{Plan, ResourceEstimate, Workload};
use crate::model::Columns;
use crate::outputs::kind::OutputKind;
use crate::passes::TRACKED;
use crate::pipeline::stages::write::ENCODING;
use crate::pipeline::summary::InputSummary;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, open_input};

/// Bytes that a Gaussian takes while formats are fitted to it and encoded, about: a few pieces of it.
const FITTED: u64 = 4 * 600;

/// What `convert` wrote.
#[derive(Debug, Serialize)]
pub struct Converted {
    /// Its path.
    pub path: PathBuf,
    /// Its kind.
    pub kind: OutputKind,
    /// N of the input.
    pub gaussians: usize,
    /// T of the input.
    pub frames: usize,
    /// Bytes of all files.
    pub bytes: u64,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// Writes `input` to `output`, as `asked` or as the name asks, else as the input's own kind of result.
///
/// # Errors
/// What is wrong with the input; a kind that it cannot be written as; an output that is there already.
pub fn convert(
    input: &InputOptions,
    output: &Path,
    asked: Option<OutputKind>,
    overwrite: Replace,
) -> Result<Converted> {
    if input.is_stream() {
        return Err(Error::usage("a frame stream is packed first: splatsieve pack - -o FILE.gseq"));
    }
    if asked.is_none() {
        OutputKind::check_name(output)?;
    }
    let opened = open_input(input)?;
    let (family, source) = (&*opened.input, opened.input.source());
    let kind = OutputKind::from_path(output, asked, family.own_output());
    if kind == OutputKind::Archive {
        return Err(Error::usage("an archive is what compress writes: splatsieve compress INPUT -o NAME.gsz"));
    }
    let target = if kind.is_folder() { Kind::Folder } else { Kind::File };
    check_target(output, target, &[&input.path], overwrite)?;
    let (gaussians, frames) = (source.info().count, source.info().times.len());
    kind.check_frames(frames, output)?;
    family.check_output(kind, output)?;
    let work = Workload::new(source.info(), family.residence());
    let plan = Plan::fit(work, input.memory, &input.events, |work, limits| vec![need(kind, work, limits)])?;
    plan.tell_time(input.memory.tell, &input.events);
    let all = CompressedModel::pruned((0..gaussians as u32).collect(), &Recipe::preset("default")?.merge);
    let mut notes = opened.notes;
    let mut write = |path: &Path| -> Result<u64> {
        notes.extend(family.write(&all, kind, path, &plan.limits, &input.events)?);
        Ok(family.size_written(kind, path)?.whole())
    };
    let bytes = if kind.is_folder() {
        let staged = StagedFolder::new(output, overwrite)?;
        let bytes = write(staged.path())?;
        let marker = serde_json::json!({
            "tool": TOOL,
            "input": InputSummary::new(family, &input.path, family.digest()?)?.without_folders(),
        });
        let path = staged.path().join(MARKER);
        fs::write(&path, format!("{marker:#}\n")).map_err(Error::io("write", &path))?;
        staged.commit()?;
        bytes
    } else {
        let staged = StagedFile::new(output, overwrite)?;
        let bytes = write(staged.path())?;
        staged.commit()?;
        bytes
    };
    Ok(Converted { path: output.to_owned(), kind, gaussians, frames, bytes, notes })
}

/// All states once, and what is fitted to them.
fn need(kind: OutputKind, work: &Workload, limits: &Limits) -> ResourceEstimate {
    let whole = work.state(Columns::all());
    let fits = matches!(kind, OutputKind::Splatv | OutputKind::FourDgs);
    let tracked = work.threads * TRACKED as u64 * work.frames * whole;
    let mut fixed = work.writing();
    fixed.push(("tracks", if fits { 2 * tracked } else { 0 }));
    let per_gaussian = vec![
        ("kept", 16),
        ("result", work.input.reduced + work.input.file + whole),
        ("readers", work.input.reader),
        ("held", if fits { 0 } else { work.held(limits, Columns::all()) }),
        ("fitted", if fits { FITTED } else { 0 }),
    ];
    let seconds = work.reading(work.count(), work.frames as f64) + work.count() * work.frames as f64 * ENCODING;
    ResourceEstimate { stage: "convert", reads: 1.0, seconds, per_gaussian, fixed }
}
