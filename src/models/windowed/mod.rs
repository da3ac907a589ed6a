//! Files of players for Gaussians with linear motion in Gaussian windows of time, as model formats.
//!
//! The output has the same format with fewer Gaussians. The Gaussians have the parameters that [`crate::files::ftgs`]
//! describes. FreeTimeGS models have the same motion.

mod frame_by_frame;
mod ftgs;
mod tsog;

use std::path::{Path, PathBuf};

use super::archive::pack::FileContent;
use super::archive::reopen::Reopener;
use super::in_checkpoint::{ProxyRule, with_times, write_frames};
use super::motion_model::{MotionModelFrames, propose_proxies};
use super::size::{ModelSize, NO_FILES, bytes_below};
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result};
use crate::files::digest::digest_of_files;
use crate::limits::Limits;
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;
pub(super) use ftgs::FTGS;
pub(super) use tsog::TSOG;

/// Opened model file in a format of web players. The motion model `L` computes the states of its Gaussians.
#[derive(Debug)]
struct WindowedModel<L: ProxyRule> {
    path: PathBuf,
    description: ModelDescription,
    model: MotionModelFrames<L>,
    /// Function and options to open the `.ftgs.ply` that an archive of this file holds. `None` for Gaussians without
    /// windows of time: a `.ftgs.ply` cannot hold them, so archives of this file hold frames instead.
    reopener: Option<Reopener>,
}

impl<L: ProxyRule> WindowedModel<L> {
    /// Returns the function and options to open the `.ftgs.ply` that an archive of this file holds. Fails if archives
    /// of this file hold frames instead.
    fn reopener(&self) -> Result<&Reopener> {
        self.reopener.as_ref().ok_or_else(|| Error::internal("an archive of frames was written as a model"))
    }
}

impl<L: ProxyRule + 'static> InputModel for WindowedModel<L> {
    fn description(&self) -> ModelDescription {
        self.description.clone()
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        digest_of_files([&*self.path])
    }

    fn size(&self) -> Result<ModelSize> {
        ModelSize::from_cloud_file(&self.path, NO_FILES)
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind == self.description.default_output_kind {
            true => ModelSize::from_cloud_file(path, NO_FILES),
            false => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        self.model.memory_profile(3e-8)
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        self.model = with_times(self.model, times, self.description.timing)?;
        Ok(self)
    }

    fn check_output(&self, kind: OutputKind, _: &Path) -> Result<()> {
        match kind {
            OutputKind::Model | OutputKind::Ply => Err(Error::usage(
                "a file of a player cannot be written as a trained model\n  write its own format, a .gseq or --as \
                 ply-sequence",
            )),
            _ => Ok(()),
        }
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        propose_proxies(&self.model, clusters, reference, rule, |clusters| L::propose(&self.model, clusters, rule))
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        let written = (OutputKind::Ftgs, "model.ftgs.ply");
        self.reopener()?.content(self, compressed, written, FileContent::from_name)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.reopener()?.frames(content, &self.model.info().times)
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
        write_frames(&self.model, compressed, kind, path, limits.max_kept_frames, events)
    }
}

#[cfg(test)]
mod tests;
