//! What a run writes: the smaller model and, beside it, the recipe, the index map and the summary.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use gseq::Compression;
use rayon::prelude::*;

use super::compress::CompressOptions;
use super::input::{Input, Scene};
use super::merging::Sieved;
use super::proxies::{canonical_cloud, canonical_proxies};
use super::result::{merged, result_frames};
use super::scored::{Reference, Scored};
use super::summary::{Stages, Summary};
use crate::emit::atomic::{Kind, MARKER, StagedFile, StagedFolder, check_target};
use crate::emit::container::{ContainerWriter, FRAME_BLOCK, GAUSSIAN_BLOCK, write_container};
use crate::emit::index_map::write_index_map;
use crate::emit::ply::{OutRow, write_inria, write_like};
use crate::error::{Error, Result};
use crate::ingest::ply::Ply;
use crate::ingest::ply_sequence::PlySequence;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::pass::{FrameSource, Ids, Wanted};
use crate::recipe::{Merge, Recipe};
use crate::stream::{HeldFrames, MergedSequence, Progress, Recolored, gather_all};

/// zstd level of containers that are a result: higher ones gain about 1% on trained models.
const LEVEL: i32 = 1;

/// Kinds of result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputKind {
    /// A 4DGaussians model folder.
    Model,
    /// A container.
    Gseq,
    /// A folder with one PLY per frame.
    PlySequence,
    /// One PLY: the canonical cloud of a model, or a sequence of one frame.
    Ply,
}

impl OutputKind {
    /// The kind a path asks for by its name, or the one asked for outright, checked against what the
    /// input can give. A folder is of the input's own kind.
    pub fn of(path: &Path, asked: Option<OutputKind>, input: &Input) -> Result<OutputKind> {
        if matches!(input, Input::Model(_)) {
            return Ok(Self::planned(path, asked, true));
        }
        let kind = Self::of_sequence(path, asked)?;
        let frames = input.source().info().times.len();
        if kind == OutputKind::Ply && frames != 1 {
            return Err(Error::usage(format!(
                "{}: {frames} frames do not fit one .ply\n  write a .gseq or --as ply-sequence",
                path.display()
            )));
        }
        Ok(kind)
    }

    /// [`OutputKind::of`] an input that is no model and whose frames nobody has counted yet.
    pub fn of_sequence(path: &Path, asked: Option<OutputKind>) -> Result<OutputKind> {
        match asked.or(Self::by_name(path)) {
            Some(OutputKind::Model) => Err(Error::usage(
                "only a 4DGaussians model can be written as a model folder\n  write a .gseq or --as ply-sequence",
            )),
            _ => Ok(Self::planned(path, asked, false)),
        }
    }

    /// The kind that a result will have, if the input can give it.
    pub fn planned(path: &Path, asked: Option<OutputKind>, is_model: bool) -> OutputKind {
        let own = if is_model { OutputKind::Model } else { OutputKind::PlySequence };
        asked.or(Self::by_name(path)).unwrap_or(own)
    }

    fn by_name(path: &Path) -> Option<OutputKind> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "gseq" => Some(OutputKind::Gseq),
            "ply" => Some(OutputKind::Ply),
            _ => None,
        }
    }

    /// Whether the result is a folder.
    pub fn is_folder(self) -> bool {
        matches!(self, OutputKind::Model | OutputKind::PlySequence)
    }
}

/// File beside every result: all parameters it was made with.
pub const RECIPE: &str = "recipe.toml";
/// File beside every result: where each Gaussian of the input went.
pub const INDEX_MAP: &str = "index_map.npy";

/// Path of a file beside the result: inside a folder, next to a file and named after it.
pub fn beside(result: &Path, is_folder: bool, name: &str) -> PathBuf {
    if is_folder {
        return result.join(name);
    }
    let mut file = result.file_name().unwrap_or_default().to_owned();
    file.push(".");
    file.push(name);
    result.with_file_name(file)
}

/// Confirms, before any work, that the result and what goes beside it can be written.
pub fn check_output(path: &Path, kind: OutputKind, inputs: &[&Path], overwrite: bool) -> Result<()> {
    if kind.is_folder() {
        return check_target(path, Kind::Folder, inputs, overwrite);
    }
    check_target(path, Kind::File, inputs, overwrite)?;
    for name in [RECIPE, INDEX_MAP, MARKER] {
        check_target(&beside(path, false, name), Kind::File, inputs, overwrite)?;
    }
    Ok(())
}

/// Writes the result and what goes beside it; everything appears under its name at the end, a file
/// before its companions and the summary, which says that all is there, last.
pub fn write_result(
    scene: &Scene,
    scored: &Scored,
    sieved: &Sieved,
    options: &CompressOptions,
    kind: OutputKind,
    mut summary: Summary,
    mut stages: Stages,
) -> Result<Summary> {
    let target = options.output.as_path();
    let kept = sieved.kept.len();
    // Sequences are baked from a result that holds each of its frames: one more read of the kept.
    let reads = if matches!(kind, OutputKind::Gseq | OutputKind::PlySequence) { 1.0 } else { 0.0 };
    let job = Emission {
        input: &scene.input,
        reference: scored.reference,
        sieved,
        merge: &options.recipe.merge,
        gaussians_together: scene.limits.gaussians_together,
    };
    let text = recipe_text(&options.recipe, &summary.input.digest);
    let map = sieved.index_map(summary.input.gaussians);
    if kind.is_folder() {
        let staged = StagedFolder::new(target, options.overwrite)?;
        let (notes, deviation) =
            stages.run("emit", kept, reads, || Ok::<_, Error>((job.write(kind, staged.path())?, kept)))?;
        summary.finish(stages, notes, deviation, point_bytes(staged.path())?);
        write_text(&staged.path().join(RECIPE), &text)?;
        write_index_map(&map, &staged.path().join(INDEX_MAP))?;
        write_text(&staged.path().join(MARKER), &summary.json())?;
        staged.commit()?;
    } else {
        let staged = StagedFile::new(target, options.overwrite)?;
        let companion = |name| StagedFile::new(&beside(target, false, name), options.overwrite);
        let (recipe, index_map, marker) = (companion(RECIPE)?, companion(INDEX_MAP)?, companion(MARKER)?);
        let (notes, deviation) =
            stages.run("emit", kept, reads, || Ok::<_, Error>((job.write(kind, staged.path())?, kept)))?;
        summary.finish(stages, notes, deviation, file_bytes(staged.path())?);
        write_text(recipe.path(), &text)?;
        write_index_map(&map, index_map.path())?;
        write_text(marker.path(), &summary.json())?;
        for file in [staged, recipe, index_map, marker] {
            file.commit()?;
        }
    }
    Ok(summary)
}

/// Writes the Gaussians `kept` (increasing) of an input as a result of `kind`, without anything beside it;
/// gives the bytes that grow with them.
pub fn write_kept(input: &Input, kept: Vec<u32>, merge: &Merge, kind: OutputKind, path: &Path) -> Result<u64> {
    let sieved = &Sieved::pruned(kept);
    let job = Emission { input, reference: Reference::default(), sieved, merge, gaussians_together: usize::MAX };
    if kind.is_folder() {
        fs::create_dir(path).map_err(Error::io("create", path))?;
    }
    job.write(kind, path)?;
    if kind.is_folder() { point_bytes(path) } else { file_bytes(path) }
}

fn write_text(path: &Path, text: &str) -> Result<()> {
    fs::write(path, text).map_err(Error::io("write", path))
}

fn file_bytes(path: &Path) -> Result<u64> {
    Ok(fs::metadata(path).map_err(Error::io("read", path))?.len())
}

/// Bytes of all PLY files below a folder: what grows with the Gaussians.
fn point_bytes(folder: &Path) -> Result<u64> {
    let mut sum = 0;
    for entry in fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let path = entry.map_err(Error::io("list", folder))?.path();
        sum += match path.extension() {
            _ if path.is_dir() => point_bytes(&path)?,
            Some(extension) if extension == "ply" => file_bytes(&path)?,
            _ => 0,
        };
    }
    Ok(sum)
}

/// The result, about to be written.
struct Emission<'a> {
    input: &'a Input,
    reference: Reference,
    sieved: &'a Sieved,
    merge: &'a Merge,
    gaussians_together: usize,
}

impl Emission<'_> {
    /// Writes the result alone to `path`. Gives notes for the summary and, for a model, the furthest
    /// that a proxy strays from its members.
    fn write(&self, kind: OutputKind, path: &Path) -> Result<(Vec<String>, Option<f64>)> {
        if let Input::Model(model) = self.input {
            let found = canonical_proxies(model, self.reference, self.sieved, self.merge)?;
            let mut notes = found.notes;
            match kind {
                OutputKind::Model => {
                    let paths = model.paths();
                    let folder = path.join("point_cloud").join(format!("iteration_{}", paths.iteration));
                    fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
                    copy(&paths.cfg_args, &path.join("cfg_args"))?;
                    copy(&paths.deformation, &folder.join("deformation.pth"))?;
                    self.write_like(&paths.point_cloud, &found.raw, &folder.join("point_cloud.ply"))?;
                    if paths.deformation_table.is_some() || paths.deformation_accum.is_some() {
                        notes.push(
                            "deformation_table.pth and deformation_accum.pth, which only training reads, were left out"
                                .to_owned(),
                        );
                    }
                }
                OutputKind::Ply => self.write_like(&model.paths().point_cloud, &found.raw, path)?,
                _ => {
                    let cloud = canonical_cloud(model, self.sieved, &found.raw);
                    write_sequence(&model.with_canonical(cloud), kind, path)?;
                }
            }
            return Ok((notes, found.deviation));
        }
        match self.input {
            Input::Frames(frames) if kind != OutputKind::Gseq => {
                self.write_like_frames(frames, &merged(self.input, self.sieved, self.merge), kind, path)?;
            }
            _ if kind == OutputKind::Gseq && !self.sieved.clusters.is_empty() => self.write_merged(path)?,
            _ => write_sequence(&*result_frames(self.input, self.reference, self.merge, self.sieved)?, kind, path)?,
        }
        Ok((Vec::new(), None))
    }

    /// A container with proxies, whose members lie anywhere: a frame block at a time, of as many Gaussians together
    /// as the limits allow.
    fn write_merged(&self, path: &Path) -> Result<()> {
        let merged = merged(self.input, self.sieved, self.merge);
        let SequenceInfo { count, times, sh_degree, varying } = merged.info();
        let compression = Compression::Zstd(LEVEL);
        let mut writer = ContainerWriter::create(path, *count, *sh_degree, FRAME_BLOCK, compression, BTreeMap::new())?;
        let progress = Progress::new("emit", "Gaussian frames", (count * times.len()) as u64);
        let parts = parts(&merged, self.gaussians_together);
        for start in (0..times.len()).step_by(FRAME_BLOCK) {
            let of_block = start..times.len().min(start + FRAME_BLOCK);
            writer.begin(&times[of_block.clone()])?;
            for part in &parts {
                let mut frames = merged.together(part.clone(), &Wanted::of(of_block.clone()).holding(FRAME_BLOCK))?;
                let mut constant = Gaussians::zeros(0, *sh_degree);
                if start == 0 {
                    frames.read(start, Columns::ALL.without(*varying), &mut constant)?;
                }
                let mut held = HeldFrames::new(part.len(), *sh_degree, *varying, constant);
                for frame in of_block.clone() {
                    let mut state = Gaussians::zeros(0, *sh_degree);
                    frames.read(frame, *varying, &mut state)?;
                    held.push(times[frame], state);
                }
                drop(frames);
                let change = self.sieved.recolor.get(part.clone()).unwrap_or(&[]);
                let held = Recolored::new(Box::new(held), change);
                writer.add(&held, part.start, 0..of_block.len(), |done| progress.advance(done))?;
            }
        }
        writer.finish()
    }

    fn write_like(&self, template: &Path, proxies: &Gaussians, path: &Path) -> Result<()> {
        write_like(&Ply::open(template)?, &self.rows(), proxies, path)
    }

    /// Every frame's file again with the properties, comments and names it had.
    fn write_like_frames(
        &self,
        frames: &PlySequence,
        result: &MergedSequence<'_>,
        kind: OutputKind,
        path: &Path,
    ) -> Result<()> {
        let places: Vec<u32> = self.sieved.clusters.iter().map(|cluster| cluster.output).collect();
        let rows = self.rows();
        let progress = Progress::new("emit", "frames", frames.paths().len() as u64);
        let write = |&frame: &usize| {
            let mut proxies = Gaussians::zeros(0, frames.info().sh_degree);
            result.open(Ids::List(&places))?.read(frame, Columns::ALL, &mut proxies)?;
            let template = frames.frame(frame)?;
            let target = match (kind, template.path().file_name()) {
                (OutputKind::PlySequence, Some(name)) => path.join(name),
                _ => path.to_owned(),
            };
            write_like(&template, &rows, &proxies, &target)?;
            progress.advance(1);
            Ok::<_, Error>(())
        };
        // A batch at a time: a thread that waits for proxies would begin another frame.
        let all: Vec<usize> = (0..frames.paths().len()).collect();
        all.chunks(rayon::current_num_threads()).try_for_each(|batch| batch.par_iter().try_for_each(write))
    }

    fn rows(&self) -> Vec<OutRow> {
        let row = |&source: &u32| OutRow { source, proxy: None, recolor: [0.0; 3] };
        let mut rows: Vec<OutRow> = self.sieved.kept.iter().map(row).collect();
        rows.iter_mut().zip(&self.sieved.recolor).for_each(|(row, &recolor)| row.recolor = recolor);
        for (proxy, cluster) in self.sieved.clusters.iter().enumerate() {
            rows[cluster.output as usize].proxy = Some(proxy as u32);
        }
        rows
    }
}

/// The Gaussians of `merged` in whole blocks, each part made of about `most` Gaussians of the source at most.
fn parts(merged: &MergedSequence<'_>, most: usize) -> Vec<Range<usize>> {
    let count = merged.info().count;
    let (mut parts, mut start, mut made_of) = (Vec::new(), 0, 0);
    for block in (0..count).step_by(GAUSSIAN_BLOCK) {
        let of_block = block..count.min(block + GAUSSIAN_BLOCK);
        let members: usize = of_block.map(|place| merged.members(place)).sum();
        if made_of > 0 && made_of + members > most {
            parts.push(start..block);
            (start, made_of) = (block, 0);
        }
        made_of += members;
    }
    parts.push(start..count);
    parts
}

/// Copies the bytes, not the permissions: a result of a read-only model can be replaced.
fn copy(from: &Path, to: &Path) -> Result<()> {
    let mut source = File::open(from).map_err(Error::io("open", from))?;
    let mut target = File::create(to).map_err(Error::io("create", to))?;
    io::copy(&mut source, &mut target).map_err(Error::io("copy", from))?;
    Ok(())
}

/// Writes every frame of `source`: as a container, as a folder of PLY files, or its only frame as one.
pub fn write_sequence(source: &dyn FrameSource, kind: OutputKind, path: &Path) -> Result<()> {
    let info = source.info();
    if kind == OutputKind::Gseq {
        let progress = Progress::new("emit", "Gaussian frames", info.count as u64 * info.times.len() as u64);
        return write_container(source, path, Compression::Zstd(LEVEL), BTreeMap::new(), |done| progress.advance(done));
    }
    let progress = Progress::new("emit", "frames", info.times.len() as u64);
    for frame in 0..info.times.len() {
        let state = gather_all(source, frame, Columns::ALL)?;
        let file = match kind {
            OutputKind::Ply => path.to_owned(),
            _ => path.join(format!("frame_{frame:05}.ply")),
        };
        write_inria(&state, &[], &file)?;
        progress.advance(1);
    }
    Ok(())
}

/// Text of `recipe.toml`: where it comes from, then every parameter.
pub fn recipe_text(recipe: &Recipe, input_digest: &str) -> String {
    format!(
        "# What this result was made with; give it to --recipe to repeat the run.\n\
         [provenance]\ntool = \"splatsieve {}\"\ninput_digest = \"{input_digest}\"\n\n{}",
        env!("CARGO_PKG_VERSION"),
        recipe.to_toml()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recipe_beside_a_result_repeats_the_run() {
        let recipe = Recipe::preset("paper").unwrap();
        assert_eq!(Recipe::from_toml(&recipe_text(&recipe, "00ff"), "default").unwrap(), recipe);
    }

    #[test]
    fn files_beside_results_of_other_kinds_do_not_collide() {
        assert_eq!(beside(Path::new("a/small"), true, "summary.json"), Path::new("a/small/summary.json"));
        assert_eq!(beside(Path::new("a/small.ply"), false, "summary.json"), Path::new("a/small.ply.summary.json"));
        assert_eq!(beside(Path::new("small.gseq"), false, "summary.json"), Path::new("small.gseq.summary.json"));
    }
}
