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
use super::in_checkpoint::{ProxyRule, write_frames};
use super::motion_model::{MotionModelFrames, propose_proxies};
use super::size::{ModelSize, bytes_below, bytes_read_for};
use super::trajectories::state_bytes;
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result};
use crate::files::cameras::TimeConvention;
use crate::files::digest::digest_of_files;
use crate::limits::Limits;
use crate::model::{Attributes, Jacobian};
use crate::models::input_model::{InputModel, MemoryProfile, TimeOrigin};
use crate::outputs::container::GAUSSIAN_BLOCK;
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
    /// Name of the format, shown to users.
    name: &'static str,
    /// Output kind with the same format as this file.
    default_output: OutputKind,
    /// Origin of the frame times: the caller may choose any times, or the file gives the number or the times of frames.
    timing: TimeOrigin,
    /// Notes for the user: repairs and guesses made while the file was opened.
    notes: Vec<String>,
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
    fn kind(&self) -> &'static str {
        self.name
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        digest_of_files([&*self.path])
    }

    fn bytes(&self) -> Result<u64> {
        bytes_read_for([&*self.path])
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(ModelSize { cloud: self.bytes()?, ..ModelSize::default() })
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind == self.default_output {
            true => Ok(ModelSize { cloud: bytes_read_for([path])?, ..ModelSize::default() }),
            false => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        let raw = self.model.raw();
        let whole = state_bytes(raw.gaussians.sh_degree(), Attributes::all()) + 4 * raw.format_specific.width() as u64;
        MemoryProfile {
            per_gaussian: whole,
            // A copy of the parameters, without the Gaussians that were left out.
            opening: whole,
            // A copy of the stored parameters and the values prepared from them.
            reader: whole + 16 + 8,
            compressed: 2 * whole,
            jacobian: Jacobian::BYTES_PER_GAUSSIAN as u64,
            file: whole + 24,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            seconds_per_state: 3e-8,
            ..MemoryProfile::default()
        }
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    fn timing(&self) -> TimeOrigin {
        self.timing
    }

    fn time_convention(&self) -> TimeConvention {
        TimeConvention::Given
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        let found = self.model.info().times.len();
        if self.timing == TimeOrigin::Numbered && times.len() != found {
            return Err(Error::usage(format!("{} times were given for {found} frames", times.len())));
        }
        self.model = match self.model.motion_model().for_times(&times) {
            Some(motion) => MotionModelFrames::new(motion, self.model.raw().clone(), self.model.info().sh_degree),
            None => self.model,
        };
        self.model = self.model.with_times(times)?;
        Ok(self)
    }

    fn default_output_kind(&self) -> OutputKind {
        self.default_output
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

    fn archives_as_frames(&self) -> bool {
        self.reopener.is_none()
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
