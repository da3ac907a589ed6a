//! Containers of frames (`.gseq`) as a model format.

use gseq::{Encoding, Reader, TileId};

use super::linked::UnlinkedFrames;
use super::size::{ModelSize, file_bytes};
use crate::error::{Error, Result, ShowPath};
use crate::files::container::Container;
use crate::models::input_model::{ColumnInfo, InputModel, MemoryProfile, ModelDescription, TimeOrigin};
use crate::models::opened::{InputFormat, Opened};
use crate::source::FrameSource;

/// Format of containers of frames (`.gseq`), which store the state of every Gaussian at every frame: recognizes and
/// opens a file.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| found.is_file_of(&gseq::MAGIC, "gseq"),
    open: |path, options| {
        let container = Container::open_within(path, options.memory)?;
        options.refuse_for(path)?;
        if options.link.links_frames_always() && container.info().times.len() > 1 {
            let frames = UnlinkedFrames::from_model(Box::new(container), "linked gseq container", options);
            return Ok(Opened::Unlinked(Box::new(frames)));
        }
        Ok(Opened::from_model(container))
    },
};

impl InputModel for Container {
    fn description(&self) -> ModelDescription {
        ModelDescription {
            kind: "gseq container",
            timing: TimeOrigin::Stamped,
            may_be_linked: true,
            has_explicit_frames: true,
            archives_as_frames: true,
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        self
    }

    fn digest(&self) -> Result<String> {
        Ok(Container::digest(self))
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(ModelSize::from_frames(file_bytes([self.path()])?))
    }

    fn memory_profile(&self) -> MemoryProfile {
        let layout = self.reader().layout();
        // The tiles of the file (blocks of Gaussians × frames) determine which Gaussians are decoded together.
        MemoryProfile {
            gaussian_block: layout.gaussian_block.into(),
            columns: layout.columns.len() as u64,
            decoded: self.decoded_bytes(),
            ..MemoryProfile::for_tiles(layout.frame_block.into())
        }
    }

    fn hold_decoded(&self) {
        Container::hold_decoded(self, self.decoded_bytes());
    }

    fn with_times(self: Box<Self>, _: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Err(Error::usage(format!(
            "{}: a container stores the times of its frames; no other times can be given",
            self.path().shown()
        )))
    }

    fn columns(&self) -> Result<Vec<ColumnInfo>> {
        columns(self.reader())
    }
}

/// Returns size and value range of every column (attribute) of the container, from its index of tiles (blocks of
/// Gaussians × frames). Fails if the index cannot be read.
fn columns(reader: &Reader) -> Result<Vec<ColumnInfo>> {
    let layout = reader.layout();
    let mut out = Vec::new();
    for (column, spec) in layout.columns.iter().enumerate() {
        let mut found = ColumnInfo {
            name: spec.name.clone(),
            width: spec.width,
            max_error: spec.max_error,
            tiles: 0,
            constant_tiles: 0,
            raw_tiles: 0,
            stored_bytes: 0,
            raw_bytes: 4 * u64::from(spec.width) * layout.gaussians * reader.frames() as u64,
            min: None,
            max: None,
        };
        for gaussian_block in 0..layout.gaussian_blocks() {
            let mut last_offset = None;
            for frame_block in 0..reader.frame_blocks() {
                let tile = reader.tile_info(TileId { column: column as u32, gaussian_block, frame_block })?;
                found.tiles += 1;
                found.constant_tiles += usize::from(tile.constant);
                found.raw_tiles += usize::from(tile.encoding == Encoding::Raw);
                if last_offset != Some(tile.offset) {
                    found.stored_bytes += tile.stored_bytes;
                }
                last_offset = Some(tile.offset);
                if tile.stats.min <= tile.stats.max {
                    found.min = Some(found.min.map_or(tile.stats.min, |min| min.min(tile.stats.min)));
                    found.max = Some(found.max.map_or(tile.stats.max, |max| max.max(tile.stats.max)));
                }
            }
        }
        out.push(found);
    }
    Ok(out)
}
