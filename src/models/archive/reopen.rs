//! Makes the content of an archive (`.gsz`) from a compressed model, and opens the model in an archive to read its
//! frames. Used by the model formats whose files an archive stores together with a layout.

use std::path::Path;

use super::layout::Layout;
use super::pack::{FileContent, Packer};
use crate::archive::ArchiveContent;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::limits::Limits;
use crate::model::SequenceInfo;
use crate::models::input_model::{InputModel, OpenOptions};
use crate::models::opened::OpenInput;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::source::{BlockReader, Deformation, FeatureDecoder, FrameSource, Ids, ReadCounts, ReadPlan};

/// Function and options with which an input model was opened. They serve to open it again after it has been stored in
/// an archive (`.gsz`).
#[derive(Debug, Clone)]
pub(in crate::models) struct Reopener {
    open: OpenInput,
    options: OpenOptions,
}

impl Reopener {
    /// Creates a reopener for a model that was opened with the function `open` and the options `options`.
    pub(in crate::models) fn new(open: OpenInput, options: &OpenOptions) -> Reopener {
        // An archive holds one training iteration.
        let options = OpenOptions { iteration: None, events: Events::default(), ..options.clone() };
        Reopener { open, options }
    }

    /// Returns the content of an archive of `compressed`, the compressed form of `model`. First writes the compressed
    /// model to a temporary folder, as the kind of output `kind`, to a file or folder called `name`. `holds` returns
    /// the kind of content of a written file, given the path of the file relative to the model folder.
    ///
    /// # Errors
    /// Fails if the model cannot be written, or if an archive cannot hold its files.
    pub(in crate::models) fn content<'a>(
        &self,
        model: &dyn InputModel,
        compressed: &CompressedModel,
        (kind, name): (OutputKind, &str),
        holds: impl Fn(&str) -> FileContent<'a>,
    ) -> Result<ArchiveContent> {
        let scratch = ScratchFolder::new(&self.options.scratch())?;
        let path = scratch.path().join(name);
        if kind == OutputKind::Model {
            std::fs::create_dir(&path).map_err(Error::io("create", &path))?;
        }
        model.write(compressed, kind, &path, &Limits::NONE, &Events::default())?;
        let degree = model.source().info().sh_degree.min(compressed.sh_degree);
        Packer::new(compressed.len(), degree, self.options.memory).pack(&path, holds)
    }

    /// Opens the model whose archive has the content `content`, and returns its frames at `times`.
    ///
    /// # Errors
    /// Fails if `content` is not a complete model.
    pub(in crate::models) fn frames(&self, content: &ArchiveContent, times: &[f64]) -> Result<Box<dyn FrameSource>> {
        let scratch = ScratchFolder::new(&self.options.scratch())?;
        let archive = Path::new("archive");
        let layout = Layout::read(content, archive)?;
        let layout = layout.ok_or_else(|| Error::internal("an archive of another kind of model was given"))?;
        let opened = (self.open)(&layout.restore(content, archive, scratch.path())?, &self.options)?;
        let model = opened.into_linked()?;
        let model = if model.source().info().times == times { model } else { model.with_times(times.to_vec())? };
        Ok(Box::new(RestoredFrames { model, _scratch: scratch }))
    }
}

/// Frames of a model whose files are in a temporary folder.
struct RestoredFrames {
    model: Box<dyn InputModel>,
    _scratch: ScratchFolder,
}

impl FrameSource for RestoredFrames {
    fn info(&self) -> &SequenceInfo {
        self.model.source().info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        self.model.source().open(ids)
    }

    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        self.model.source().open_all(plan)
    }

    fn deformation(&self) -> Option<&dyn Deformation> {
        self.model.source().deformation()
    }

    fn decoder(&self) -> Option<&dyn FeatureDecoder> {
        self.model.source().decoder()
    }

    fn reads(&self) -> ReadCounts {
        self.model.source().reads()
    }
}
