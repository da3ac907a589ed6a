//! `.splatv` files as an input, and as an output of the lite SpacetimeGaussians model.
//!
//! When a compressed `.splatv` input is written as `.splatv`, Gaussians that compression did not change are copied as
//! the 32-bit words of the input file. Gaussians that no player draws are left out. If the temporal window of a
//! Gaussian has an infinite width in the file, the window is 1 at every time ([`rows`](crate::files::splatv::rows)).

use std::fs;
use std::path::Path;

use super::decoder::ColorActivation;
use super::frame_state::{CENTER, LOG_WIDTH, MOTION, OMEGA, SHARED_PARAM_COUNT, Spacetime};
use super::proxies;
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result};
use crate::files::accuracy::CodingErrors;
use crate::files::cameras::TimeConvention;
use crate::files::defects::Defects;
use crate::files::digest::digest_of_files;
use crate::files::json::read_json;
use crate::files::splatv::rows::{check_rows, has_zero_quaternion, repair_words};
use crate::files::splatv::write::{add_errors, default_cameras, encode_words, write_splatv as write_file};
use crate::files::splatv::{MAGIC, Splatv, SplatvGaussian};
use crate::limits::Limits;
use crate::model::{
    AttributeValues, Attributes, Gaussians, StoredParams, color_from_sh, logit, opacity, sh_from_color,
};
use crate::models::archive::pack::FileContent;
use crate::models::archive::reopen::Reopener;
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, OpenOptions, TimeOrigin};
use crate::models::motion_model::window::MAX_LOGIT;
use crate::models::motion_model::{MotionModelFrames, compressed_raw, propose_proxies};
use crate::models::opened::{InputFormat, Opened};
use crate::models::size::{ModelSize, NO_FILES, bytes_below};
use crate::models::trajectories::write_sequence;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Maximum bytes of a camera list that is copied to the output; enough for about seven thousand cameras.
const MAX_LISTED: u64 = 4 << 20;
/// Minimum scale of a Gaussian and minimum width of its temporal window, so that their logarithms are finite.
const MIN_LENGTH: f64 = 1e-7;
/// Natural logarithm of the width that stands for an unbounded temporal window. It is finite, so that no inf·0 arises,
/// and so wide that the window exp(−(dt/width)²) is exactly 1 in f64 for |dt| below 10⁹.
const UNBOUNDED_LOG_WIDTH: f32 = 40.0;

/// Model format of `.splatv` files, which hold a compressed SpacetimeGaussians lite model for web players: recognizes
/// and opens a file.
pub(in super::super) const SPLATV: InputFormat = InputFormat {
    recognizes: |found| found.is_file_of(&MAGIC.to_le_bytes(), "splatv"),
    open: |path, options| {
        options.refuse_for(path)?;
        Ok(Opened::from_model(SplatvModel::open(path, options)?))
    },
};

/// Opened `.splatv` file.
#[derive(Debug)]
struct SplatvModel {
    file: Splatv,
    /// For each Gaussian of the model the row of the file that holds it; `None` if no Gaussian was left out.
    rows: Option<Vec<u32>>,
    /// Gaussians of the file that were repaired or left out.
    defects: Defects,
    model: MotionModelFrames<Spacetime>,
    reopener: Reopener,
}

impl SplatvModel {
    /// Reads the file at `path` and leaves out Gaussians that no player draws.
    fn open(path: &Path, options: &OpenOptions) -> Result<SplatvModel> {
        let file = Splatv::open(path)?;
        // The parameters and the row number of each Gaussian.
        let values = (Attributes::all().width(0) + SHARED_PARAM_COUNT + 1) as u64;
        options.memory.check(path, "its texture", "the Gaussians of the file", 4 * values * file.count() as u64)?;
        let zero_rotation = options.conventions.zero_rotation.unwrap_or_default();
        let (defects, rows) = check_rows(&file, zero_rotation)?;
        let count = file.count() - defects.dropped;
        let mut raw = StoredParams {
            gaussians: Gaussians::zeros(count, 0),
            format_specific: AttributeValues::zeros(SHARED_PARAM_COUNT, count),
        };
        for i in 0..count {
            set_from_row(&mut raw, i, &SplatvGaussian::from_words(&file.words(file_row(rows.as_deref(), i))));
        }
        let model = MotionModelFrames::new(Spacetime { is_full: false, decoder: None }, raw, 0);
        Ok(SplatvModel { file, rows, defects, model, reopener: Reopener::new(SPLATV.open, options) })
    }
}

/// Returns the row of the file that holds Gaussian `i` of the model. `rows` lists this row for every Gaussian of the
/// model. If `rows` is `None`, no Gaussian of the file was left out, and the row is `i`.
fn file_row(rows: Option<&[u32]>, i: usize) -> usize {
    rows.map_or(i, |rows| rows[i] as usize)
}

/// Sets the parameters of Gaussian `i` in `raw` to the values of `row` of a `.splatv`.
fn set_from_row(raw: &mut StoredParams, i: usize, row: &SplatvGaussian) {
    let log = |length: f32| f64::from(length).max(MIN_LENGTH).ln() as f32;
    raw.gaussians.position.set_row(i, row.position);
    raw.gaussians.rotation.set_row(i, if has_zero_quaternion(row) { [1.0, 0.0, 0.0, 0.0] } else { row.rotation });
    // Players square the scales, so their sign has no effect.
    raw.gaussians.log_scale.set_row(i, row.scale.map(|scale| log(scale.abs())));
    raw.gaussians.opacity_logit.set_row(i, [logit(row.opacity).clamp(-MAX_LOGIT, MAX_LOGIT) as f32]);
    raw.gaussians.sh.set_row(i, row.rgb.map(sh_from_color));
    let mut own = |plane: usize, value: f32| raw.format_specific.plane_mut(plane)[i] = value;
    own(CENTER, row.center);
    own(LOG_WIDTH, if row.width.is_finite() { log(row.width) } else { UNBOUNDED_LOG_WIDTH });
    row.motion.into_iter().enumerate().for_each(|(k, x)| own(MOTION + k, x));
    row.omega.into_iter().enumerate().for_each(|(k, x)| own(OMEGA + k, x));
}

/// Returns Gaussian `i` of `raw` as a row of a `.splatv`.
fn to_row(raw: &StoredParams, i: usize) -> SplatvGaussian {
    let own = |plane: usize| raw.format_specific.plane(plane)[i];
    SplatvGaussian {
        position: raw.gaussians.position.row(i),
        motion: std::array::from_fn(|k| own(MOTION + k)),
        rotation: raw.gaussians.rotation.row(i),
        omega: std::array::from_fn(|k| own(OMEGA + k)),
        scale: raw.gaussians.scales_f64(i).map(|scale| scale as f32),
        rgb: raw.gaussians.sh.row::<3>(i).map(color_from_sh),
        opacity: opacity(raw.gaussians.opacity_logit.row::<1>(i)[0]),
        center: own(CENTER),
        width: f64::from(own(LOG_WIDTH)).exp() as f32,
    }
}

/// Writes the Gaussians `raw` to the `.splatv` file `path`. `known` returns the exact color of the Gaussian with the
/// given index; if it returns `None`, the color follows from `raw`. The cameras are those of the 3DGS camera list
/// `cameras`, or else one camera that sees most of the Gaussians.
///
/// # Errors
/// Fails if half precision cannot hold the values or a write fails.
pub(super) fn write(
    raw: &StoredParams,
    known: impl Fn(usize) -> Option<[f32; 3]>,
    cameras: Option<&Path>,
    path: &Path,
) -> Result<()> {
    // A list above [`MAX_LISTED`] bytes is not used: no subset of its cameras would be better than another.
    let is_small = |path: &&Path| fs::metadata(path).is_ok_and(|found| found.len() <= MAX_LISTED);
    let listed = cameras.filter(is_small).map(|path| read_json(path, MAX_LISTED)).transpose()?;
    let listed = listed.filter(|cameras| !cameras[0]["rotation"].is_null());
    let cameras = listed.unwrap_or_else(|| default_cameras(&raw.gaussians.position));
    let output_row = |i: usize| {
        let row = to_row(raw, i);
        SplatvGaussian { rgb: known(i).map_or(row.rgb, |rgb| rgb.map(f64::from)), ..row }
    };
    let mut accuracy = CodingErrors::new(&raw.gaussians.position);
    (0..raw.len()).for_each(|i| add_errors(&output_row(i), i, &mut accuracy));
    accuracy.check("a .splatv")?;
    write_file(path, raw.len(), (0..raw.len()).map(|i| encode_words(&output_row(i))), &cameras)
}

impl InputModel for SplatvModel {
    fn description(&self) -> ModelDescription {
        ModelDescription {
            kind: "splaTV model",
            notes: self.defects.notes().into_iter().chain(self.file.note()).collect(),
            timing: TimeOrigin::Continuous,
            time_convention: TimeConvention::Given,
            background: Some([0.0; 3]),
            default_output_kind: OutputKind::Splatv,
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        digest_of_files([self.file.path()])
    }

    fn size(&self) -> Result<ModelSize> {
        ModelSize::from_cloud_file(self.file.path(), NO_FILES)
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Splatv => ModelSize::from_cloud_file(path, NO_FILES),
            _ => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        let all = self.model.memory_profile(4e-8);
        let of_rows = if self.rows.is_some() { size_of::<u32>() as u64 } else { 0 };
        MemoryProfile { per_gaussian: all.per_gaussian + of_rows, ..all }
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        self.model = self.model.with_times(times)?;
        Ok(self)
    }

    fn keeps_motion(&self, kind: OutputKind) -> bool {
        matches!(kind, OutputKind::Splatv | OutputKind::Archive)
    }

    fn check_output(&self, kind: OutputKind, _: &Path) -> Result<()> {
        match kind {
            OutputKind::Model | OutputKind::Ply => Err(Error::usage(
                "a .splatv has less precision than a trained model and cannot be written as one\n  write a .splatv, a \
                 .gseq or --as ply-sequence",
            )),
            _ => Ok(()),
        }
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        propose_proxies(&self.model, clusters, reference, rule, |clusters| {
            proxies::propose(&self.model, clusters, rule, ColorActivation::None)
        })
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.reopener.content(self, compressed, (OutputKind::Splatv, "model.splatv"), FileContent::from_name)
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
        if kind != OutputKind::Splatv {
            return write_sequence(&*self.compressed_frames(compressed)?, kind, path, limits.max_kept_frames, events);
        }
        self.file.check()?;
        let raw = compressed_raw(self.model.raw(), compressed);
        let unchanged = self.model.raw().pick(&compressed.kept);
        let words_of = |i: usize| {
            let (now, before) = (to_row(&raw, i), to_row(&unchanged, i));
            if now != before {
                return encode_words(&now);
            }
            let mut stored = self.file.words(file_row(self.rows.as_deref(), compressed.kept[i] as usize));
            repair_words(&mut stored);
            stored
        };
        let mut accuracy = CodingErrors::new(&raw.gaussians.position);
        let changed = |&i: &usize| to_row(&raw, i) != to_row(&unchanged, i);
        (0..raw.len()).filter(changed).for_each(|i| add_errors(&to_row(&raw, i), i, &mut accuracy));
        accuracy.check("a .splatv")?;
        write_file(path, raw.len(), (0..raw.len()).map(words_of), self.file.cameras())?;
        Ok(Vec::new())
    }
}
