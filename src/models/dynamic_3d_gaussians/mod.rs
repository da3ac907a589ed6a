//! Dynamic3DGaussians as a model format: explicit trajectories in a file `params.npz`.
//!
//! The output is a folder with a `params.npz` that has the same arrays in the same order and with the same types.
//! Unchanged values keep their bytes.

mod params;
mod proxies;

use std::path::{Path, PathBuf};

use super::archive::pack::FileContent;
use super::archive::reopen::Reopener;
use super::size::{ModelSize, file_bytes};
use super::trajectories::{state_bytes, write_sequence};
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::Result;
use crate::files::digest::digest_of_files;
use crate::files::npz::write::write_like;
use crate::limits::Limits;
use crate::model::{Attributes, Gaussians, SH_C0, color_from_sh};
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription};
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::{FrameSource, Ids};
use params::{COLORS, LOG_SCALES, MEANS, OPACITIES, Params, ROTATIONS};
use proxies::MergedSource;

/// Name of the file that holds the model.
const FILE: &str = "params.npz";

/// Model format of Dynamic3DGaussians: recognizes and opens a file `params.npz`, or the folder that contains it.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| {
        let named = |path: &Path| path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("npz"));
        match found.is_folder {
            true => found.path.join(FILE).is_file(),
            false => named(found.path),
        }
    },
    open: |path, options| {
        options.refuse_for(path)?;
        let file = if path.is_dir() { path.join(FILE) } else { path.to_owned() };
        Ok(Opened::from_model(Params::open(&file, &options.scratch(), Reopener::new(ENTRY.open, options))?))
    },
};

impl InputModel for Params {
    fn description(&self) -> ModelDescription {
        ModelDescription {
            kind: "Dynamic3DGaussians model",
            // The authors' training uses a black background.
            background: Some([0.0; 3]),
            default_output_kind: OutputKind::Model,
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        self
    }

    fn digest(&self) -> Result<String> {
        digest_of_files([&*self.path()])
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(ModelSize::from_frames(file_bytes([self.path()])?))
    }

    fn memory_profile(&self) -> MemoryProfile {
        MemoryProfile {
            reader: 8,
            // Scales and opacities of proxies (Gaussians that replace merged ones), and their indices.
            compressed: state_bytes(0, Attributes::all()) + 16,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            seconds_per_state: 2e-8,
            ..MemoryProfile::default()
        }
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Ok(Box::new(Params::with_times(*self, times)?))
    }

    fn merge_class(&self, id: u32) -> u8 {
        u8::from(self.is_foreground(id as usize).unwrap_or(false))
    }

    fn compute_proxies(&self, clusters: &[Cluster], _: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        proxies::compute_proxies(self, clusters, rule)
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.reopener().content(self, compressed, (OutputKind::Model, "model"), |_| FileContent::Npz(Params::archived))
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.reopener().frames(content, &self.info().times)
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(proxies::compressed_frames(self, compressed))
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
            OutputKind::Model => self.write_params(compressed, path.join(FILE)).map(|()| Vec::new()),
            _ => write_sequence(&*self.compressed_frames(compressed)?, kind, path, limits.max_kept_frames, events),
        }
    }
}

impl Params {
    /// Writes the compressed model as a `params.npz` file to `path`.
    fn write_params(&self, compressed: &CompressedModel, path: PathBuf) -> Result<()> {
        let merged = MergedSource::new(self, compressed);
        let places: Vec<u32> = compressed.clusters.iter().map(|cluster| cluster.output).collect();
        let (mut proxies, mut state) = (merged.open(Ids::List(&places))?, Gaussians::zeros(0, 0));
        let by = &compressed.delta.0;
        write_like(
            self.npz(),
            &compressed.kept,
            Params::axis,
            |name, frame, values| {
                let column = match name {
                    MEANS => Attributes::POSITION,
                    ROTATIONS => Attributes::ROTATION,
                    COLORS => Attributes::SH,
                    LOG_SCALES => Attributes::LOG_SCALE,
                    OPACITIES => Attributes::OPACITY,
                    // Proxies keep the segment color of their leader (the Gaussian that the others were merged with).
                    _ => return Ok(Vec::new()),
                };
                let (width, is_color) = (column.width(0), column == Attributes::SH);
                if !places.is_empty() {
                    proxies.read(frame, column, &mut state)?;
                }
                let mut changed = places.clone();
                for (proxy, &place) in places.iter().enumerate() {
                    for c in 0..width {
                        let value = state.attribute_values(column).plane(c)[proxy];
                        values[place as usize * width + c] = if is_color { color_from_sh(value) as f32 } else { value };
                    }
                }
                let by = by.attribute_values(column);
                for row in 0..by.len() {
                    let mut differs = false;
                    for c in 0..width.min(by.width()) {
                        let more = by.plane(c)[row];
                        if more != 0.0 {
                            differs = true;
                            values[row * width + c] += if is_color { (SH_C0 * f64::from(more)) as f32 } else { more };
                        }
                    }
                    if differs {
                        changed.push(row as u32);
                    }
                }
                Ok(changed)
            },
            &path,
        )
    }
}

#[cfg(test)]
mod tests;
