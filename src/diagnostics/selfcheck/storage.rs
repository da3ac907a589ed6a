//! Self-check cases for stored data: written values are read back and compared.

use std::collections::BTreeMap;
use std::iter::repeat;
use std::path::Path;

use gseq::Compression;

use super::case::LargestError;
use super::generated::clouds::{Random, random_gaussians};
use crate::archive::{
    ATTRIBUTES, ArchiveContent, EncodedArchive, FieldSteps, QuantizationSteps, TensorRole, TensorSteps,
    attribute_values, decode, encode, round_cloud, step_size,
};
use crate::deform::Tensor;
use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::files::container::Container;
use crate::limits::ReadLimit;
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::outputs::bounds::{ErrorBounds, MaxError};
use crate::outputs::container::{Packing, write_container};
use crate::source::{BlockReader, FrameSource, Ids};

/// Writes frames to a lossless container, reads them back, and compares every bit. The values include NaN and −0, and
/// rotations that are the same in the last frame of a block of frames as in its first frame.
pub(super) fn container(worst: &mut LargestError) -> Result<()> {
    let written = MemoryFrames::new();
    for compression in [Compression::Raw, Compression::Zstd(1)] {
        compare_round_trip(&written, compression, |got, expected, _| worst.same(&got.to_bits(), &expected.to_bits()))?;
    }
    Ok(())
}

/// Writes frames to a container with error bounds, reads them back, and compares the values. The unit of the error is
/// the requested bound of the attribute.
pub(super) fn bounded_container(worst: &mut LargestError) -> Result<()> {
    let mut written = MemoryFrames::new();
    for column in written.frames.iter_mut().flat_map(|frame| frame.selected_attribute_values_mut(Attributes::all())) {
        column.planes_mut().iter_mut().filter(|x| !x.is_finite()).for_each(|x| *x = 0.0);
    }
    let requested = ["position=1e-3", "rotation=2e-3", "log_scale=0.01", "opacity_logit=0.02", "sh=0.005"];
    let requested: Vec<MaxError> =
        requested.iter().map(|text| text.parse()).collect::<std::result::Result<_, _>>().map_err(Error::usage)?;
    let bounds = ErrorBounds::from_errors(&requested, || Ok(1.0))?;
    compare_round_trip(&written, Packing::with_bounds(bounds, 3), |got, expected, column| {
        worst.near(got.into(), expected.into(), bounds.max_error(column));
    })?;
    Ok(())
}

/// Encodes a model as an archive, decodes it, and compares the decoded values with the originals. The unit of the error
/// is half a quantization step plus a rounding to f32.
pub(super) fn archive_grid(worst: &mut LargestError) -> Result<()> {
    let (content, steps) = model();
    let EncodedArchive { bytes, order, .. } = encode(&content, &steps)?;
    let (back, _) = decode(&bytes, Path::new("made up"), ReadLimit::NONE)?;
    let expected = content.cloud.pick(&order);
    let half = |k: i32, value: f32| 0.5 * step_size(k) + f64::from(value.abs()) * f64::from(f32::EPSILON);
    for (k, &step) in steps.cloud.iter().enumerate().take(used_attributes(&content)) {
        for (got, expected) in attribute_values(&back.cloud, k).zip(attribute_values(&expected, k)) {
            worst.near(got.into(), expected.into(), half(step, expected));
        }
    }
    let matrix =
        |content: &ArchiveContent| content.tensors.get("a.matrix").map_or(Vec::new(), |tensor| tensor.data.clone());
    let (got, expected) = (matrix(&back), matrix(&content));
    worst.same(&(back.cloud.len(), got.len()), &(content.cloud.len(), expected.len()));
    got.iter().zip(expected).for_each(|(&got, x)| worst.near(got.into(), x.into(), half(MATRIX_STEP, x)));
    Ok(())
}

/// Encodes a model as an archive, decodes it, and compares every bit, because the prediction and entropy coding of an
/// archive are lossless. The decoded Gaussians must equal the original Gaussians after rounding to the quantization
/// grid. The other stored data must equal the originals.
pub(super) fn archive_codes(worst: &mut LargestError) -> Result<()> {
    let (content, steps) = model();
    let EncodedArchive { bytes, order, .. } = encode(&content, &steps)?;
    let (back, _) = decode(&bytes, Path::new("made up"), ReadLimit::NONE)?;
    let mut expected = content.cloud.pick(&order);
    let attributes: Vec<usize> = (0..used_attributes(&content)).collect();
    round_cloud(&mut expected, &steps.cloud, &attributes);
    worst.same(&back.cloud, &expected);
    worst.same(&back.files, &content.files);
    worst.same(&back.tensors.get("a.exact"), &content.tensors.get("a.exact"));
    let extra_bytes: Vec<u8> = order.iter().map(|&id| content.extra_bytes[id as usize]).collect();
    worst.same(&back.extra_bytes, &extra_bytes);
    Ok(())
}

/// Quantization step of the matrix of the test model, given as its binary logarithm in eighths: the step is 2^(−60/8).
const MATRIX_STEP: i32 = -60;

/// Returns a test model and the quantization steps for it. The model has 2000 Gaussians of SH degree 2, two tensors, a
/// stored file, and one extra byte per Gaussian.
fn model() -> (ArchiveContent, QuantizationSteps) {
    let mut random = Random(12);
    let mut tensor = |shape: &[usize]| Tensor {
        shape: shape.to_vec(),
        data: (0..shape.iter().product()).map(|_| random.next_in(-1.0, 1.0)).collect(),
    };
    let mut content =
        ArchiveContent { cloud: random_gaussians(13, 2000, 2), times: [0.0, 1.0], ..ArchiveContent::default() };
    for (name, shape, role) in [("a.matrix", [20, 30], TensorRole::Weights), ("a.exact", [5, 8], TensorRole::Exact)] {
        content.tensors.insert(name.to_owned(), tensor(&shape));
        content.field.insert(name.to_owned(), role);
    }
    content.files.insert("cfg_args".to_owned(), b"Namespace()".to_vec());
    content.extra_bytes = (0..content.cloud.len()).map(|i| (i * 7) as u8).collect();
    let matrix_steps = TensorSteps { step: MATRIX_STEP, channels: Vec::new() };
    let field = FieldSteps([("a.matrix".to_owned(), matrix_steps)].into());
    (content, QuantizationSteps { cloud: [-64, -50, -40, -30, -45, -35, -25, 0], columns: Vec::new(), field })
}

/// Returns how many entries of [`ATTRIBUTES`] the Gaussians of `content` have: all entries from position to opacity,
/// and one entry for each SH degree from 0 to the SH degree of the Gaussians.
fn used_attributes(content: &ArchiveContent) -> usize {
    ATTRIBUTES.len() - 3 + content.cloud.sh_degree()
}

/// Writes `written` to a container and reads it back. Calls `compare` for each value with the value read, the original
/// value, and the attribute.
fn compare_round_trip(
    written: &MemoryFrames,
    packing: impl Into<Packing>,
    mut compare: impl FnMut(f32, f32, Attributes),
) -> Result<()> {
    let folder = ScratchFolder::new(&std::env::temp_dir())?;
    let path = folder.path().join("made.gseq");
    write_container(written, &path, packing, BTreeMap::new(), |_| ())?;
    let container = Container::open(&path)?;
    let mut reader = container.open(Ids::Range(0..written.info.count))?;
    let mut state = Gaussians::zeros(0, written.info.sh_degree);
    for (frame, expected) in written.frames.iter().enumerate() {
        reader.read(frame, Attributes::all(), &mut state)?;
        for column in Attributes::all().iter() {
            // A missing value counts as NaN.
            let got = state.attribute_values(column).planes().iter().copied().chain(repeat(f32::NAN));
            let values = got.zip(expected.attribute_values(column).planes());
            values.for_each(|(got, &expected)| compare(got, expected, column));
        }
    }
    Ok(())
}

/// Sequence of frames that are all in memory.
struct MemoryFrames {
    info: SequenceInfo,
    frames: Vec<Gaussians>,
}

impl MemoryFrames {
    /// Creates 1100 Gaussians (more than one block of Gaussians) at 70 frames (more than two blocks of frames).
    /// Positions wander and opacities jump. Rotations have the same values in the first and in the last frame of a
    /// block, and others between. Scales and colors are constant.
    fn new() -> MemoryFrames {
        let (count, times) = (1100, 70);
        let mut random = Random(14);
        let mut now = random_gaussians(15, count, 1);
        now.opacity_logit.plane_mut(0)[..4].copy_from_slice(&[f32::NAN, f32::INFINITY, -0.0, 1e-40]);
        let rotation = now.rotation.clone();
        let mut frame = |t: usize| {
            if t > 0 {
                now.position.planes_mut().iter_mut().for_each(|x| *x += random.next_in(-0.01, 0.01));
                now.opacity_logit.plane_mut(0)[4..].iter_mut().for_each(|x| *x = random.next_in(-6.0, 6.0));
            }
            now.rotation.clone_from(&rotation);
            // Blocks have 32 frames, or 64 with error bounds.
            if (1..31).contains(&(t % 32)) && t != times - 1 {
                now.rotation.planes_mut().iter_mut().for_each(|x| *x += 0.5);
            }
            now.clone()
        };
        let frames = (0..times).map(&mut frame).collect();
        let varying = Attributes::POSITION | Attributes::ROTATION | Attributes::OPACITY;
        let times = (0..times).map(|t| t as f64).collect();
        MemoryFrames { info: SequenceInfo { count, times, sh_degree: 1, varying }, frames }
    }
}

impl FrameSource for MemoryFrames {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(StoredRows { frames: &self.frames, rows: ids.iter().map(|id| id as u32).collect() }))
    }
}

struct StoredRows<'a> {
    frames: &'a [Gaussians],
    rows: Vec<u32>,
}

impl BlockReader for StoredRows<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        for column in want.iter() {
            *out.attribute_values_mut(column) = self.frames[frame].attribute_values(column).pick(&self.rows);
        }
        Ok(())
    }
}
