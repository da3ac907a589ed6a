//! SpacetimeGaussians (lite and full) as a model format: a folder as its training writes it, the PLY file alone, or a
//! `.splatv`.
//!
//! The output has the same layout with fewer Gaussians. Rows of the PLY are kept byte for byte, except for values that
//! merging or refinement changed; other files are copied. The renderer of the full model blends nine features, and a
//! network computes the color of each pixel from them. Statistics, merging and refinement use the color that the first
//! three features have without the network.

mod cloud;
mod decoder;
mod frame_state;
mod motion;
mod proxies;
mod splatv;

use std::fs;
use std::path::{Path, PathBuf};

use super::archive::pack::FileContent;
use super::archive::reopen::Reopener;
use super::cfg_args::Arguments;
use super::files::copy;
use super::iterations::find_iteration;
use super::size::{ModelSize, NO_FILES, bytes_below};
use super::trajectories::write_sequence;
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result, quoted};
use crate::files::cameras::TimeConvention;
use crate::files::digest::digest_of_files;
use crate::files::ply::header_contains;
use crate::files::python_literal::Literal;
use crate::files::state_dict::read_state_dict;
use crate::limits::Limits;
use crate::model::{StoredParams, color_from_sh};
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, OpenOptions, TimeOrigin};
use crate::models::motion_model::{MotionModelFrames, compressed_raw, propose_proxies};
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;
use cloud::{MARKER_PROPERTY, PointCloudFile};
use decoder::{ColorActivation, ColorDecoder};
use frame_state::Spacetime;
pub(super) use splatv::SPLATV;

/// Name of the folder that holds the folders `iteration_K`.
const POINT_CLOUD_FOLDER: &str = "point_cloud";
/// Name of the point cloud file in a folder `iteration_K`.
const POINT_CLOUD_FILE: &str = "point_cloud.ply";
/// Name of the file with the decoder network of the full model.
const DECODER: &str = "point_cloud.pt";
/// Name of the file with the training arguments.
const CFG_ARGS: &str = "cfg_args";
/// Name of the camera file of the model folder, which is copied to the output if it exists.
const CAMERAS: &str = "cameras.json";

/// Model format of SpacetimeGaussians: recognizes and opens a model folder, or its PLY file.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| match found.is_folder {
        true => find_iteration(&found.path.join(POINT_CLOUD_FOLDER), None)
            .is_ok_and(|(_, folder)| has_marker_property(&folder.join(POINT_CLOUD_FILE))),
        false => found.is_file_of(b"ply", "ply") && has_marker_property(found.path),
    },
    open: |path, options| Ok(Opened::from_model(SpacetimeGaussians::open(path, options)?)),
};

/// Returns whether the header of the PLY at `path` has a property that only SpacetimeGaussians writes.
pub(super) fn has_marker_property(path: &Path) -> bool {
    header_contains(path, MARKER_PROPERTY)
}

/// Paths of the files of a SpacetimeGaussians model.
#[derive(Debug, Clone)]
struct Files {
    cloud: PathBuf,
    /// Path of the model folder and training iteration K; `None` for a PLY file alone.
    folder: Option<(PathBuf, u32)>,
    /// Path of the file with the decoder network of the full model.
    decoder: Option<PathBuf>,
}

impl Files {
    /// Finds the files of the model folder or PLY file `path`. In a folder, they belong to the training iteration of
    /// `options`, or to the largest if `options` gives none.
    fn find(path: &Path, options: &OpenOptions) -> Result<Files> {
        if !path.is_dir() {
            options.refuse_for(path)?;
            return Ok(Files { cloud: path.to_owned(), folder: None, decoder: None });
        }
        let (number, folder) = find_iteration(&path.join(POINT_CLOUD_FOLDER), options.iteration)?;
        let decoder = Some(folder.join(DECODER)).filter(|path| path.exists());
        Ok(Files { cloud: folder.join(POINT_CLOUD_FILE), folder: Some((path.to_owned(), number)), decoder })
    }

    /// Returns the path of the file `name` in the model folder if it exists.
    fn root_file(&self, name: &str) -> Option<PathBuf> {
        self.folder.as_ref().map(|(root, _)| root.join(name)).filter(|path| path.is_file())
    }

    /// Returns the paths of the files that a renderer opens in addition to the point cloud file.
    fn other_files(&self) -> Vec<PathBuf> {
        self.decoder.clone().into_iter().chain(self.root_file(CFG_ARGS)).collect()
    }
}

/// Returns the number n of training frames, the value of the key `duration`; `None` if it is missing. Frame i, counted
/// from 0, has the time i/n. Fails if the value is not a positive integer.
fn training_frames(arguments: &Arguments) -> Result<Option<usize>> {
    let duration = arguments.get("duration");
    match duration.value {
        Literal::None => Ok(None),
        Literal::Int(frames) if (1..=i64::from(u32::MAX)).contains(frames) => Ok(Some(*frames as usize)),
        _ => Err(duration.wrong("a number of frames, at least 1")),
    }
}

/// Opened SpacetimeGaussians model folder or PLY file.
#[derive(Debug)]
struct SpacetimeGaussians {
    files: Files,
    cloud: PointCloudFile,
    model: MotionModelFrames<Spacetime>,
    activation: ColorActivation,
    description: ModelDescription,
    reopener: Reopener,
}

impl SpacetimeGaussians {
    /// Opens the model folder or PLY file at `path`.
    fn open(path: &Path, options: &OpenOptions) -> Result<SpacetimeGaussians> {
        let files = Files::find(path, options)?;
        let cloud = PointCloudFile::open(&files.cloud, &options.ply())?;
        let arguments = files.root_file(CFG_ARGS).map(|path| Arguments::read(&path)).transpose()?.unwrap_or_default();
        let mut notes = Vec::new();
        let activation = match arguments.get("rgbfunction").string()?.as_deref() {
            _ if !cloud.is_full() => ColorActivation::None,
            None => {
                notes.push(
                    "cfg_args does not give rgbfunction, the last step of the model's colors: sandwich is assumed"
                        .to_owned(),
                );
                ColorActivation::Sigmoid
            }
            Some(name) => ColorActivation::from_name(name).ok_or_else(|| {
                let expected = "sandwich, sandwichnoact or sandwichnoactss, for a model with nine features";
                Error::input(&path.join(CFG_ARGS), "key rgbfunction", expected, quoted(name).to_string())
            })?,
        };
        let decoder = match (cloud.is_full(), &files.decoder) {
            (true, Some(path)) => Some(ColorDecoder::new(&read_state_dict(path, options.memory)?, activation, path)?),
            (true, None) if files.folder.is_some() => {
                let path = files.cloud.with_file_name(DECODER);
                return Err(Error::input(
                    &path,
                    "",
                    "the decoder network of a model with nine features",
                    "no such file",
                )
                .hint("training saves it beside point_cloud.ply; copy it too"));
            }
            _ => None,
        };
        if cloud.is_full() {
            let color_source = "the color that the first three of nine features give without the decoder network";
            notes.push(match decoder {
                Some(_) => format!(
                    "scores, merging, refinement and exported frames use {color_source}; render, evaluate, report, \
                     video, the choice between merging and pruning, and comparisons with photographs use all nine \
                     features and the network"
                ),
                None => format!("renders use {color_source}: the network is not beside the PLY"),
            });
        }
        let raw = cloud.raw(activation)?;
        notes.extend(negative_color_note(&raw));
        notes.extend(cloud.notes()?);
        let model = MotionModelFrames::new(Spacetime { is_full: cloud.is_full(), decoder }, raw, 0);
        let reopener = Reopener::new(ENTRY.open, options);
        let description = ModelDescription {
            kind: if cloud.is_full() { "SpacetimeGaussians full model" } else { "SpacetimeGaussians lite model" },
            notes,
            timing: TimeOrigin::Continuous,
            time_convention: TimeConvention::Given,
            data_folder: arguments.get("source_path").string()?,
            data_frames: training_frames(&arguments)?,
            // Training ignores `white_background` of `cfg_args`.
            background: Some([0.0; 3]),
            default_output_kind: if files.folder.is_some() { OutputKind::Model } else { OutputKind::Ply },
            ..ModelDescription::default()
        };
        Ok(SpacetimeGaussians { files, cloud, model, activation, description, reopener })
    }

    /// Writes the compressed model as a model folder at `path`.
    fn write_folder(&self, compressed: &CompressedModel, path: &Path) -> Result<()> {
        let number = self.files.folder.as_ref().map_or(0, |(_, number)| *number);
        let folder = path.join(POINT_CLOUD_FOLDER).join(format!("iteration_{number}"));
        fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
        self.cloud.write(compressed, &folder.join(POINT_CLOUD_FILE))?;
        if let Some(decoder) = &self.files.decoder {
            copy(decoder, &folder.join(DECODER))?;
        }
        let from_root = [CFG_ARGS, CAMERAS].into_iter().filter_map(|name| Some((self.files.root_file(name)?, name)));
        from_root.into_iter().try_for_each(|(from, name)| copy(&from, &path.join(name)))
    }
}

/// Returns a note with the number of Gaussians whose color is negative; `None` if there are none. The authors' renderer
/// adds such colors, others clamp them to 0.
fn negative_color_note(raw: &StoredParams) -> Option<String> {
    let is_negative = |row: usize| raw.gaussians.sh.row::<3>(row).iter().any(|&harmonic| color_from_sh(harmonic) < 0.0);
    let count = (0..raw.len()).filter(|&row| is_negative(row)).count();
    (count > 0).then(|| {
        format!(
            "{count} Gaussians have a color below 0: it darkens renders of the authors' renderer; other renderers \
                 and this program clamp it to 0"
        )
    })
}

impl InputModel for SpacetimeGaussians {
    fn description(&self) -> ModelDescription {
        self.description.clone()
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        let other_files = self.files.other_files();
        digest_of_files([&*self.files.cloud].into_iter().chain(other_files.iter().map(AsRef::as_ref)))
    }

    fn size(&self) -> Result<ModelSize> {
        ModelSize::from_cloud_file(&self.files.cloud, self.files.other_files())
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Model => {
                let files = Files::find(path, &OpenOptions::default())?;
                ModelSize::from_cloud_file(&files.cloud, files.other_files())
            }
            OutputKind::Ply | OutputKind::Splatv => ModelSize::from_cloud_file(path, NO_FILES),
            _ => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        self.model.memory_profile(4e-8)
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        self.model = self.model.with_times(times)?;
        Ok(self)
    }

    fn keeps_motion(&self, kind: OutputKind) -> bool {
        matches!(kind, OutputKind::Model | OutputKind::Ply | OutputKind::Splatv | OutputKind::Archive)
    }

    fn check_output(&self, kind: OutputKind, _: &Path) -> Result<()> {
        match kind {
            OutputKind::Model if self.files.folder.is_none() => {
                Err(Error::usage("a PLY alone cannot be written as a model folder\n  give the folder, or write a .ply"))
            }
            OutputKind::Splatv if self.cloud.is_full() => Err(Error::usage(
                "a .splatv stores colors, not features: it holds only lite models of SpacetimeGaussians\n  write a \
                 model folder or a .gseq",
            )),
            _ => Ok(()),
        }
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        propose_proxies(&self.model, clusters, reference, rule, |clusters| {
            proxies::propose(&self.model, clusters, rule, self.activation)
        })
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.reopener.content(
            self,
            compressed,
            (self.description.default_output_kind, "model.ply"),
            FileContent::from_name,
        )
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.reopener.frames(content, &self.model.info().times)
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(Box::new(self.model.compressed_frames(compressed)))
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        match kind {
            OutputKind::Model => self.write_folder(compressed, path)?,
            OutputKind::Ply => self.cloud.write(compressed, path)?,
            OutputKind::Splatv => {
                let raw = compressed_raw(self.model.raw(), compressed);
                // Keep the stored color where it did not change: converting it to SH and back can change its last
                // digit.
                let (own, colors) = (&self.model.raw().gaussians.sh, self.cloud.colors()?);
                let known = |i: usize| {
                    let id = compressed.kept[i] as usize;
                    let is_own = raw.gaussians.sh.row::<3>(i) == own.row::<3>(id);
                    is_own.then(|| colors.each_ref().map(|plane| plane[id]))
                };
                splatv::write(&raw, known, self.files.root_file(CAMERAS).as_deref(), path)?;
            }
            _ => {
                return write_sequence(
                    &*self.compressed_frames(compressed)?,
                    kind,
                    path,
                    limits.max_kept_frames,
                    events,
                );
            }
        }
        Ok(Vec::new())
    }
}

#[cfg(test)]
mod tests;
