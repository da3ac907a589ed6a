//! Check that an archive restores a model of any format. The tests of the formats call it with their synthetic models.

use std::fs;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};

use super::{read_archive, restored_output_kind, unpack};
use crate::archive::{self, ArchiveContent, EncodedArchive, FieldSteps, QuantizationSteps, TensorSteps};
use crate::compressed_model::CompressedModel;
use crate::limits::ReadLimit;
use crate::model::{Attributes, Gaussians, opacity};
use crate::models::input_model::{InputModel, OpenOptions};
use crate::outputs::kind::OutputKind;
use crate::passes::gather_all;
use crate::source::FrameSource;

/// Number k = −128 of the quantization step 2^(k/8) = 2^-16, which is used for all values.
const STEP: i32 = -8 * 16;

/// Returns the states of all Gaussians of `source`, one entry per frame.
fn states(source: &dyn FrameSource) -> Vec<Gaussians> {
    (0..source.info().times.len()).map(|frame| gather_all(source, frame, Attributes::all()).unwrap()).collect()
}

/// Returns quantization steps of 2^-16 for all values of `content`.
pub(super) fn fine_steps(content: &ArchiveContent) -> QuantizationSteps {
    let step = |name: &String| (name.clone(), TensorSteps { step: STEP, channels: Vec::new() });
    QuantizationSteps {
        cloud: [STEP; 8],
        columns: vec![STEP; content.columns.len()],
        field: FieldSteps(content.field.keys().map(step).collect()),
    }
}

/// Checks that an archive restores the compressed model `compressed`, which was made from `model`. The archive has
/// quantization steps of 2^-16. Returns the kind of output that the archive restores: a model folder, or a file format.
/// Checks that
/// - every restored Gaussian of every frame differs by at most `tolerance` from the compressed model (see [`values`]),
/// - the archive opens as an input, with the same frames as the restored model.
///
/// # Panics
/// Panics if a check fails.
pub(in crate::models) fn check_round_trip(
    model: &dyn InputModel,
    compressed: &CompressedModel,
    options: &OpenOptions,
    tolerance: f64,
) -> OutputKind {
    let content = model.archive_content(compressed).unwrap();
    let EncodedArchive { bytes, order, .. } = archive::encode(&content, &fine_steps(&content)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.gsz");
    fs::write(&file, &bytes).unwrap();
    let (decoded, _) = read_archive(&file, ReadLimit::NONE).unwrap();
    let kind = restored_output_kind(&decoded, &file).unwrap().expect("a layout");

    let times = &model.source().info().times;
    let open = |path: &Path| {
        crate::models::open(path, options).unwrap().into_linked().unwrap().with_times(times.clone()).unwrap()
    };
    let restored =
        folder.path().join(if kind == OutputKind::Model { "back".into() } else { format!("back.{}", extension(kind)) });
    if kind == OutputKind::Model {
        fs::create_dir(&restored).unwrap();
    }
    unpack(&decoded, &file, &restored).unwrap();
    let [restored, opened] = [&restored, &file].map(|path| open(path));
    assert_eq!(
        restored.description().kind,
        if kind == model.description().default_output_kind {
            model.description().kind
        } else {
            restored.description().kind
        }
    );
    assert_eq!((opened.description().kind, opened.description().default_output_kind), ("gsz archive", kind));

    let expected = states(&*model.compressed_frames(compressed).unwrap());
    let shown = states(&*model.decode_frames(&decoded).unwrap());
    let found = states(restored.source());
    assert!(found == shown && found == states(opened.source()), "a restored model has other frames than its archive");
    for (frame, (found, expected)) in found.iter().zip(&expected).enumerate() {
        let expected = expected.pick(&order);
        assert_eq!((found.len(), found.sh_degree()), (expected.len(), expected.sh_degree()));
        for i in 0..found.len() {
            let [found, expected] = [found, &expected].map(|state| values(state, i));
            let off = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off <= tolerance, "Gaussian {i} in frame {frame} is off by {off}");
        }
    }
    kind
}

/// Returns the values of Gaussian `i` on which its renders depend: position, opacity, SH coefficients, and covariance
/// divided by its largest entry. Rotation and scales are compared through the covariance, because different rotations
/// and scales may have almost the same covariance.
fn values(state: &Gaussians, i: usize) -> Vec<f64> {
    let [w, x, y, z] = state.rotation_f64(i);
    let turn = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let axes = turn * DMat3::from_diagonal(DVec3::from(state.scales_f64(i)));
    let covariance = (axes * axes.transpose()).to_cols_array();
    let largest = covariance.iter().fold(0.0, |largest: f64, entry| largest.max(entry.abs()));
    let mut values: Vec<f64> = state.position_f64(i).to_vec();
    values.push(opacity(state.opacity_logit.plane(0)[i]));
    values.extend((0..state.sh.width()).map(|c| f64::from(state.sh.plane(c)[i])));
    values.extend(covariance.map(|entry| entry / largest));
    values
}

/// Returns the file name extension of outputs of the kind `kind`, without a dot at the start.
fn extension(kind: OutputKind) -> &'static str {
    match kind {
        OutputKind::Splatv => "splatv",
        OutputKind::Ftgs => "ftgs.ply",
        _ => "ply",
    }
}
