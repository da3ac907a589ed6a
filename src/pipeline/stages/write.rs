//! Stage `emit`: writes the compressed model and, beside it, the recipe, the index map (output index of every input
//! Gaussian) and the summary.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use super::bounds;
use super::choose;
use crate::TOOL;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::files::atomic::{
    Replace, SUMMARY_FILE, ScratchFolder, StagedFile, StagedFolder, TargetKind, check_target, check_targets, write_text,
};
use crate::files::names::name_of;
use crate::files::sog::images::morton_order;
use crate::files::text::json_text;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload, bytes_of_survivors};
use crate::model::{Attributes, inverse_permutation};
use crate::models::{InputModel, ModelSize};
use crate::outputs::bounds::ErrorBounds;
use crate::outputs::container::{FRAME_BLOCK, write_container};
use crate::outputs::index_map::write_index_map;
use crate::outputs::kind::{Fidelity, OutputKind};
use crate::passes::gather_all;
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{CompressedScene, EstimateInput, Phase, PreparedArchive, RunState, Stage, StageList};
use crate::pipeline::summary::{self, CameraSummary, Summary};
use crate::progress::{Events, Progress};
use crate::pruning::score::scored_memory;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "emit";

/// Assumed fraction of the input's Gaussians that a run writes; used for estimates of time.
const USUAL_LEFT: f64 = 0.5;
/// Processor time of encoding and writing one Gaussian at one frame, seconds (`benches/pack.rs`).
pub const ENCODE_SECONDS_PER_STATE: f64 = 3.5e-7;

/// Name of the file, beside every result, that holds all parameters of its run.
pub const RECIPE_FILE: &str = "recipe.toml";
/// Name of the file, beside every result, that holds for every input Gaussian its index in the output.
pub const INDEX_MAP_FILE: &str = "index_map.npy";

/// Returns the path of the accompanying file `name` of a result: inside the result if it is a folder, otherwise next to
/// the result file, with the name of the result as prefix.
pub fn companion_path(result: &Path, is_folder: bool, name: &str) -> PathBuf {
    if is_folder {
        return result.join(name);
    }
    let mut file = result.file_name().unwrap_or_default().to_owned();
    file.push(".");
    file.push(name);
    result.with_file_name(file)
}

/// Returns the paths of the files (recipe, index map, summary) that accompany a result of kind `kind` at the path
/// `output`.
pub fn companion_names(output: &Path, kind: OutputKind) -> impl Iterator<Item = String> {
    [RECIPE_FILE, INDEX_MAP_FILE, SUMMARY_FILE]
        .into_iter()
        .map(move |name| companion_path(output, kind.is_folder(), name).to_string_lossy().into_owned())
}

/// Stage that writes the compressed model and the files beside it.
#[derive(Debug, Clone)]
pub struct WriteStage {
    /// Kind of output, such as archive or model folder.
    pub kind: OutputKind,
    /// Whether the result may have proxies (Gaussians that replace merged clusters).
    pub merges: bool,
    output: PathBuf,
    overwrite: Replace,
}

/// Adds the stage that writes the result to `stages`.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    stages.add(Phase::Write, WriteStage::from_planning(planning));
}

impl Stage for WriteStage {
    fn estimates(
        &self,
        EstimateInput { work, limits, output_fraction, .. }: EstimateInput<'_>,
    ) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits, output_fraction)]
    }

    fn check(&self, scene: &Scene) -> Result<()> {
        self.kind.check_frames(scene.source().info().times.len(), &self.output)?;
        scene.input.check_output(self.kind, &self.output)
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        run.scene.work.end_shard_run_before("writing")?;
        let scored = run.scored()?;
        let mut map = run.result.index_map(run.scene.source().info().count);
        if let Some(PreparedArchive::Content(encoded)) = &run.archived {
            reorder(&mut map, &encoded.order);
        }
        if self.kind == OutputKind::Sog {
            let written = run.scene.input.compressed_frames(&run.result)?;
            reorder(&mut map, &morton_order(&gather_all(&*written, 0, Attributes::POSITION)?.position));
        }
        let journal = std::mem::take(&mut run.journal);
        let input =
            run.input.take().ok_or_else(|| Error::internal("the input was not described before it was written"))?;
        let (merge, goal, archive) = (run.merge.take(), run.goal.take(), run.archive.take());
        let summarize = |path: &Path, mut journal: Journal, output: ModelSize| {
            let mut measure = |stage: &dyn Stage| stage.measure_output(run, path, &mut journal).transpose();
            let quality = match run.quality {
                Some(quality) => Some(quality),
                None => run.stages.all().find_map(&mut measure).transpose()?,
            };
            Ok(Summary {
                schema: summary::SCHEMA,
                files: Vec::new(),
                tool: TOOL.to_owned(),
                cameras: CameraSummary::from_scene(run.scene),
                output: name_of(&self.output),
                given_cameras: run.request.input.cameras.clone(),
                leaves_out_motion: run.scene.input.motion_note(self.kind).is_some(),
                is_unreadable: self.kind.fidelity() == Fidelity::Unreadable,
                gaussians: run.result.len(),
                output_bytes: output.total(),
                output_size: output,
                selection: scored.selection.counts,
                terms: scored.term_summaries(),
                flags: scored.flags.clone(),
                merge,
                goal,
                field: journal.field,
                bands: journal.bands,
                refined: journal.refined,
                photographs: journal.photographs,
                quality,
                archive,
                left_out: journal.left_out,
                notes: journal.notes,
                planned_reads: run.scene.planned_reads,
                forecast: journal.forecast,
                stages: journal.stages,
                input,
            })
        };
        let archived = run.archived.as_ref();
        let mut summary = self.write(run.scene, &run.result, (&map, archived), &run.recipe, journal, summarize)?;
        // The summary file may be published, so it has only file names. The caller gets the paths as given by the user.
        summary.input.path = run.scene.path.to_string_lossy().into_owned();
        summary.output = self.output.to_string_lossy().into_owned();
        run.written = Some(CompressedScene { summary, index_map: map });
        Ok(())
    }
}

/// Adapts the index map `map` (for every input Gaussian its index in the result) to an output file in which the
/// Gaussians have another order. The Gaussian with index `i` in the file has the index `order[i]` in the result.
fn reorder(map: &mut [Option<u32>], order: &[u32]) {
    let places = inverse_permutation(order);
    map.iter_mut().flatten().for_each(|place| *place = places[*place as usize]);
}

impl WriteStage {
    /// Returns the stage that writes the output of the run that `planning` describes.
    pub(in crate::pipeline) fn from_planning(planning: &Planning<'_>) -> WriteStage {
        let Planning { request, output, merges, .. } = *planning;
        WriteStage { kind: output, merges, output: request.output.clone(), overwrite: request.overwrite }
    }

    /// Checks, before any work, that a run which reads the files `inputs` can write the result and the files beside it.
    ///
    /// # Errors
    /// Fails if an output exists already or cannot be created; see [`check_target`].
    pub fn check_target(&self, inputs: &[&Path]) -> Result<()> {
        if self.kind.is_folder() {
            return check_target(&self.output, TargetKind::Folder, inputs, self.overwrite);
        }
        check_targets(&self.output, &self.companions(), inputs, self.overwrite)
    }

    /// Returns the paths of the summary, the recipe and the index map, which lie next to the result if it is a file.
    fn companions(&self) -> [PathBuf; 3] {
        [SUMMARY_FILE, RECIPE_FILE, INDEX_MAP_FILE].map(|name| companion_path(&self.output, false, name))
    }

    /// Returns the folder in which the recipe file of the result is written.
    pub fn recipe_folder(&self) -> PathBuf {
        if self.kind.is_folder() {
            return self.output.clone();
        }
        self.output.parent().map(Path::to_owned).unwrap_or_default()
    }

    /// Returns the resource estimate of the stage. Its memory holds the result and write buffers. `output_fraction`:
    /// number of Gaussians in the result divided by that in the input.
    pub fn resource_estimate(&self, work: &Workload, limits: &Limits, output_fraction: f64) -> ResourceEstimate {
        let whole = work.state_bytes(Attributes::all());
        let is_solved = work.input.compressed > 0;
        let mut per_gaussian = [
            scored_memory(limits),
            vec![("survivors", 40), ("result", bytes_of_survivors(output_fraction, work.input.compressed))],
        ]
        .concat();
        let within = if self.kind == OutputKind::Archive { bounds::storing_memory(work) } else { Vec::new() };
        let mut fixed = if within.is_empty() { work.write_buffers() } else { within };
        match self.kind {
            OutputKind::Gseq if self.merges && !is_solved => {
                // States at the frames of one block, and one full state, of each member and of each proxy.
                let mixed = Attributes::all().difference(Attributes::SH) | work.varying;
                let waiting = work.kept_frames_bytes(&Limits::NONE, Attributes::all())
                    + FRAME_BLOCK as u64 * work.state_bytes(mixed);
                let together = (limits.gaussians_together as u64).min(work.gaussians);
                per_gaussian.push(("cluster members", choose::BYTES_PER_GAUSSIAN));
                fixed.push(("proxy states", together * (waiting + 2 * whole + work.input.reader + 24)));
            }
            OutputKind::Gseq => (),
            // Template file and output rows (one per Gaussian or proxy) for each thread; or one state and the data it
            // is computed from.
            _ => {
                // The trajectories of proxies are computed from all members of their clusters.
                let merging = if is_solved { output_fraction } else { 1.0 };
                per_gaussian.push(("readers", bytes_of_survivors(merging, work.input.reader)));
                per_gaussian.push((
                    "kept frames",
                    bytes_of_survivors(merging, work.kept_frames_bytes(limits, Attributes::all())),
                ));
                let rows = bytes_of_survivors(output_fraction, work.threads * (work.input.file + 2 * whole));
                per_gaussian.push(("files", work.input.file + rows));
                per_gaussian.push(("cluster members", choose::BYTES_PER_GAUSSIAN));
                per_gaussian.push(("encoded", bytes_of_survivors(output_fraction, self.kind.encoding_bytes(whole))));
            }
        }
        if self.kind == OutputKind::Model {
            // Tensors of the deformation field, once as read and once as stored.
            fixed.push(("field", work.input.fixed));
        }
        // Formats that store proxies as parameters read states only to write sequences. For other formats, proxies are
        // read part by part.
        let parts = match self.kind {
            OutputKind::Gseq if self.merges => work.gaussians.div_ceil(limits.gaussians_together as u64).max(1),
            _ => 1,
        };
        let reads = match is_solved && !self.kind.stores_frames() {
            true => 0.0,
            false => parts as f64 * work.scattered_whole_input_reads(work.frames, limits),
        };
        let frames = if is_solved && !self.kind.stores_frames() { 0.0 } else { work.frames as f64 };
        let left = USUAL_LEFT * work.gaussian_count();
        let seconds = work.reading_seconds(left, frames) + left * frames * ENCODE_SECONDS_PER_STATE;
        ResourceEstimate { stage: NAME, reads, seconds, per_gaussian, fixed }
    }

    /// Returns the size in bytes of the output for the model `compressed`, without the files beside it. Measures it by
    /// writing the result to a scratch folder, which is then deleted.
    ///
    /// # Errors
    /// Fails if frames cannot be read or a write fails.
    pub fn output_bytes(&self, scene: &Scene, compressed: &CompressedModel) -> Result<u64> {
        // A `.tsog` without Gaussians cannot be written. It would have only a few bytes.
        if self.kind == OutputKind::Tsog && compressed.is_empty() {
            return Ok(0);
        }
        let folder = ScratchFolder::new(&scene.scratch)?;
        let path = folder.path().join("result");
        write_without_companions(&*scene.input, compressed, self.kind, &path, &scene.limits, &scene.events)
    }

    /// Writes the result and the files beside it (recipe, index map, summary) under temporary names, and renames them
    /// at the end. A result folder is renamed in one step; a result file is renamed after the files beside it. Returns
    /// the summary.
    ///
    /// - `map`: for every input Gaussian its index in the output;
    /// - `archive`: content of the archive, if one is written;
    /// - `recipe`: text of the recipe file;
    /// - `summarize`: makes the summary from the temporary path of the result, the journal and the size of the result.
    ///
    /// # Errors
    /// Fails if frames cannot be read or a write fails; no output is left behind then.
    fn write(
        &self,
        scene: &Scene,
        compressed: &CompressedModel,
        (map, archive): (&[Option<u32>], Option<&PreparedArchive>),
        recipe: &str,
        mut journal: Journal,
        summarize: impl FnOnce(&Path, Journal, ModelSize) -> Result<Summary>,
    ) -> Result<Summary> {
        let mut write = |path: &Path| -> Result<ModelSize> {
            journal.run_stage(NAME, compressed.len(), scene.source(), |journal| {
                let count = compressed.len() as u64;
                // Outputs that hold frames report their own progress.
                let has_frames = self.kind.stores_frames() || matches!(archive, Some(PreparedArchive::Frames(_)));
                let progress = match has_frames {
                    true => Progress::IGNORED,
                    false => scene.events.task(NAME, "Gaussians", count),
                };
                let size = match archive {
                    Some(PreparedArchive::Content(encoded)) => {
                        fs::write(path, &encoded.bytes).map_err(Error::io("write", path))?;
                        encoded.parts.into()
                    }
                    Some(PreparedArchive::Frames(bounds)) => {
                        write_within(&*scene.input.compressed_frames(compressed)?, *bounds, path, &scene.events)?;
                        ModelSize::from_frames(fs::metadata(path).map_err(Error::io("read", path))?.len())
                    }
                    None => {
                        let about_file =
                            scene.input.write(compressed, self.kind, path, &scene.limits, &scene.events)?;
                        let about_motion = scene.input.motion_note(self.kind).map(str::to_owned);
                        let mut about_file = about_motion.into_iter().chain(about_file);
                        // A brief summary shows only the first notes.
                        journal.notes.splice(0..0, about_file.next());
                        journal.notes.extend(about_file);
                        scene.input.size_written(self.kind, path)?
                    }
                };
                progress.advance(count);
                journal.notes.extend(size.why_larger_than(&scene.input.size()?));
                Ok((size, compressed.len()))
            })
        };
        let target = self.output.as_path();
        if self.kind.is_folder() {
            let staged = StagedFolder::new(target, self.overwrite)?;
            let size = write(staged.path())?;
            write_text(&staged.path().join(RECIPE_FILE), recipe)?;
            write_index_map(map, &staged.path().join(INDEX_MAP_FILE))?;
            let summary = summarize(staged.path(), journal, size)?;
            write_text(&staged.path().join(SUMMARY_FILE), json_text(&summary))?;
            staged.commit()?;
            return Ok(summary);
        }
        let staged = StagedFile::with_companions(target, self.companions().to_vec(), self.overwrite)?;
        let [marker, recipe_file, index_map] = [0, 1, 2].map(|index| staged.companion_path(index));
        let size = write(staged.path())?;
        write_text(&recipe_file, recipe)?;
        write_index_map(map, &index_map)?;
        let summary = summarize(staged.path(), journal, size)?;
        write_text(&marker, json_text(&summary))?;
        staged.commit()?;
        Ok(summary)
    }
}

/// Writes `compressed` to `path` as an output of kind `kind`, without the files beside it. Returns the size of the
/// output in bytes.
///
/// # Errors
/// Fails if frames cannot be read or a write fails.
pub fn write_without_companions(
    input: &dyn InputModel,
    compressed: &CompressedModel,
    kind: OutputKind,
    path: &Path,
    limits: &Limits,
    events: &Events,
) -> Result<u64> {
    if kind.is_folder() {
        fs::create_dir(path).map_err(Error::io("create", path))?;
    }
    input.write(compressed, kind, path, limits, events)?;
    Ok(input.size_written(kind, path)?.total())
}

/// Writes the frames of `source` as a container to `path`, with values that differ from the exact ones by at
/// most `bounds`.
pub(crate) fn write_within(source: &dyn FrameSource, bounds: ErrorBounds, path: &Path, events: &Events) -> Result<()> {
    let info = source.info();
    let progress = events.task(NAME, "states", (info.count * info.times.len()) as u64);
    write_container(source, path, bounds::packing(bounds), BTreeMap::new(), |done| progress.advance(done))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn companion_paths_do_not_collide_between_output_kinds() {
        assert_eq!(companion_path(Path::new("a/small"), true, "summary.json"), Path::new("a/small/summary.json"));
        assert_eq!(
            companion_path(Path::new("a/small.ply"), false, "summary.json"),
            Path::new("a/small.ply.summary.json")
        );
        assert_eq!(
            companion_path(Path::new("small.gseq"), false, "summary.json"),
            Path::new("small.gseq.summary.json")
        );
    }
}
