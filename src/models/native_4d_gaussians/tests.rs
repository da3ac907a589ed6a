use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DVec4};

use super::*;
use crate::compressed_model::{Cluster, CompressedModel, ParamDelta, ReferenceFrame};
use crate::files::checkpoint::made::{PickledTensor, PythonValue, named, tensor};
use crate::limits::Limits;
use crate::limits::ReadLimit;
use crate::model::{Gaussians, opacity};
use crate::models;
use crate::models::OpenOptions;
use crate::models::TrainingConventions;
use crate::models::archive::checks::check_round_trip;
use crate::models::in_checkpoint::linear::covariance;
use crate::models::input_model::InputModel;
use crate::outputs::kind::OutputKind;
use crate::passes::gather_all;
use crate::progress::Events;
use crate::recipe::Recipe;

const COUNT: usize = 6;
const TIMES: [f64; 5] = [0.0, 0.3, 0.5, 1.1, 1.9];

/// Returns `n` pseudo-random values from -½ to ½.
fn noise(n: usize, seed: f64) -> Vec<f32> {
    (0..n).map(|i| ((i as f64 * 0.754_877 + seed * 0.569_84).fract() - 0.5) as f32).collect()
}

/// Returns the parameters of a test model, each with its index in the tuple that the trainer saves in a checkpoint
/// (capture tuple). `turns` states whether Gaussians have a 4D rotation.
fn parameters(turns: bool) -> Vec<(usize, PickledTensor)> {
    let add = |values: Vec<f32>, by: f32| values.into_iter().map(|x| x + by).collect::<Vec<f32>>();
    let (n, shape) = (COUNT, |row: &[usize]| [&[COUNT], row].concat());
    let right: (&[usize], usize) = if turns { (&[4], 4) } else { (&[0], 0) };
    let tensors: [(usize, &[usize], Vec<f32>); 9] = [
        (1, &[3], noise(3 * n, 1.0)),
        (2, &[1, 3], noise(3 * n, 2.0)),
        (3, &[47, 3], noise(141 * n, 3.0)),
        (4, &[3], add(noise(3 * n, 4.0), -2.0)),
        (5, &[4], add(noise(4 * n, 5.0), 0.2)),
        (6, &[1], noise(n, 6.0)),
        (13, &[1], add(noise(n, 7.0), 0.8)),
        (14, &[1], add(noise(n, 8.0), -1.0)),
        (15, right.0, noise(right.1 * n, 9.0)),
    ];
    tensors.into_iter().enumerate().map(|(k, (i, row, values))| (i, tensor(k, &shape(row), &values))).collect()
}

/// Returns the values of the tuple that the trainer saves in a checkpoint (capture tuple) of a test model. `turns`
/// states whether Gaussians have a 4D rotation.
fn capture(turns: bool) -> Vec<PythonValue> {
    let mut parts = vec![PythonValue::None; CAPTURE_LENGTH_4D];
    let mut state = Vec::new();
    for (k, (i, tensor)) in parameters(turns).into_iter().enumerate() {
        let adam = |seed: f64, storage: usize| PickledTensor {
            storage,
            ..self::tensor(0, &tensor.shape, &noise(tensor.bytes.len() / 4, seed))
        };
        let of_state = named(vec![
            ("step", PythonValue::Int(3)),
            ("exp_avg", PythonValue::Tensor(adam(11.0 + k as f64, 20 + k))),
            ("exp_avg_sq", PythonValue::Tensor(adam(31.0 + k as f64, 40 + k))),
        ]);
        state.push((PythonValue::Int(k as i64), PythonValue::Dict(of_state)));
        parts[i] = PythonValue::Parameter(tensor);
    }
    parts[0] = PythonValue::Int(3);
    parts[7] = PythonValue::Tensor(tensor(60, &[COUNT], &noise(COUNT, 50.0)));
    (8..11).for_each(|i| parts[i] = PythonValue::Tensor(tensor(60 + i, &[COUNT, 1], &noise(COUNT, i as f64))));
    let groups = named(vec![("state", PythonValue::Dict(state)), ("param_groups", PythonValue::List(vec![]))]);
    parts[11] = PythonValue::Dict(groups);
    parts[12] = PythonValue::Float(2.5);
    parts[16] = PythonValue::Bool(turns);
    parts[18] = PythonValue::Int(2);
    parts
}

struct CheckpointFolder(tempfile::TempDir);

impl CheckpointFolder {
    fn new() -> CheckpointFolder {
        CheckpointFolder(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a model folder whose checkpoint has the values `parts` in its capture tuple. Returns the path of the
    /// folder.
    fn put(&self, parts: Vec<PythonValue>) -> PathBuf {
        let root = self.path("model");
        fs::create_dir_all(&root).unwrap();
        fs::write(
            root.join("chkpnt30000.pth"),
            PythonValue::Tuple(vec![PythonValue::Tuple(parts), PythonValue::Int(30_000)]).file(),
        )
        .unwrap();
        fs::write(root.join("cfg_args"), "Namespace(white_background=True, source_path='data')").unwrap();
        root
    }

    fn written(&self, model: &dyn InputModel, compressed: &CompressedModel) -> PathBuf {
        let result = self.path("result");
        _ = fs::remove_dir_all(&result);
        fs::create_dir(&result).unwrap();
        model.write(compressed, OutputKind::Model, &result, &Limits::NONE, &Events::IGNORED).unwrap();
        result
    }
}

fn open_as(path: &Path, rot4d_unflipped: bool) -> Result<Box<dyn InputModel>> {
    let conventions =
        TrainingConventions { time_duration: Some(2.0), rot4d_unflipped, ..TrainingConventions::default() };
    models::open(path, &OpenOptions { conventions, ..OpenOptions::default() })?
        .into_linked()?
        .with_times(TIMES.to_vec())
}

fn open(path: &Path) -> Box<dyn InputModel> {
    open_as(path, false).unwrap()
}

fn states(model: &dyn InputModel) -> Vec<Gaussians> {
    (0..TIMES.len()).map(|frame| gather_all(model.source(), frame, Attributes::all()).unwrap()).collect()
}

fn floats(tensor: &PickledTensor, row: usize) -> Vec<f64> {
    let width = tensor.shape[1..].iter().product::<usize>();
    let values = tensor.bytes.as_chunks::<4>().0[row * width..][..width].iter();
    values.map(|&bytes| f64::from(f32::from_le_bytes(bytes))).collect()
}

fn rule() -> crate::recipe::MergeParams {
    Recipe::preset("default").unwrap().merge
}

/// Checks row `row` of `state`, the state at `time`, against an independent computation from `parameters`. In this
/// computation, the spatial covariance at a time is the inverse of the spatial block of the inverse of Σ₄, and the
/// rotation is found by applying the quaternions to each axis. `flipped` states that the order of rows and columns of
/// the rotation matrix is reversed.
fn check(parameters: &[(usize, PickledTensor)], flipped: bool, row: usize, time: f64, state: &Gaussians) {
    let values = |i: usize| floats(&parameters.iter().find(|part| part.0 == i).unwrap().1, row);
    let unit = |q: Vec<f64>| DVec4::from_slice(&q).normalize().to_array();
    let (l, r) = (unit(values(5)), unit(values(15)));
    let hamilton = |[a, b, c, d]: [f64; 4], [p, q, r, s]: [f64; 4]| {
        [
            a * p - b * q - c * r - d * s,
            a * q + b * p + c * s - d * r,
            a * r - b * s + c * p + d * q,
            a * s + b * r - c * q + d * p,
        ]
    };
    let back = |[a, b, c, d]: [f64; 4]| if flipped { [d, c, b, a] } else { [a, b, c, d] };
    let axis = |i: usize| {
        let mut axis = [0.0; 4];
        axis[i] = 1.0;
        DVec4::from(back(hamilton(hamilton(l, back(axis)), [r[0], -r[1], -r[2], -r[3]])))
    };
    let turn = DMat4::from_cols(axis(0), axis(1), axis(2), axis(3));
    let scales = [values(4), values(14)].concat();
    let squares = DMat4::from_diagonal(DVec4::from_slice(&scales).map(|x| (2.0 * x).exp()));
    let whole = turn * squares * turn.transpose();
    let slice = DMat3::from_mat4(whole.inverse()).inverse();
    let (dt, variance) = (time - values(13)[0], whole.col(3)[3]);
    for c in 0..3 {
        let expected = values(1)[c] + whole.col(3)[c] / variance * dt;
        let got = f64::from(state.position.plane(c)[row]);
        assert!((got - expected).abs() < 1e-6, "position {c}: {got} {expected}");
    }
    let got = covariance(state.scales_f64(row), state.rotation_f64(row));
    let expected =
        [slice.col(0)[0], slice.col(1)[0], slice.col(2)[0], slice.col(1)[1], slice.col(2)[1], slice.col(2)[2]];
    let most = expected.iter().fold(0.0f64, |most, x| most.max(x.abs()));
    got.iter().zip(expected).for_each(|(a, b)| assert!((a - b).abs() < 2e-6 * most, "{got:?} {expected:?}"));
    let m = (-0.5 * dt * dt / variance).exp();
    let expected = if m > 0.05 { m / (1.0 + (-values(6)[0]).exp()) } else { 0.0 };
    let got = opacity(state.opacity_logit.plane(0)[row]);
    assert!((got - expected).abs() < 2e-7, "opacity {got} {expected}");
    let angle = std::f64::consts::TAU * -dt / 2.0;
    let harmonics = [values(2), values(3)].concat();
    for c in 0..48 {
        let expected = harmonics[c] + angle.cos() * harmonics[48 + c] + (2.0 * angle).cos() * harmonics[96 + c];
        let got = f64::from(state.sh.plane(c)[row]);
        assert!((got - expected).abs() < 5e-7, "harmonic {c}: {got} {expected}");
    }
}

#[test]
fn states_are_4d_slices_in_both_conventions() {
    let folder = CheckpointFolder::new();
    let root = folder.put(capture(true));
    for unflipped in [false, true] {
        let model = open_as(&root, unflipped).unwrap();
        assert_eq!(
            (model.description().kind, model.description().background),
            ("4D Gaussian Splatting checkpoint", Some([1.0; 3]))
        );
        for (state, time) in states(&*model).iter().zip(TIMES) {
            (0..COUNT).for_each(|row| check(&parameters(true), !unflipped, row, time, state));
        }
    }
    // Some states have a temporal marginal below the cutoff and some do not.
    let cut = |x: &&f32| **x == -40.0;
    let all_states = states(&*open(&root));
    let cuts: usize = all_states.iter().map(|state| state.opacity_logit.planes().iter().filter(cut).count()).sum();
    assert!((1..TIMES.len() * COUNT - 1).contains(&cuts), "{cuts}");
}

#[test]
fn without_4d_rotation_space_and_time_are_independent() {
    let folder = CheckpointFolder::new();
    let parts = parameters(false);
    let model = open(&folder.put(capture(false)));
    let values = |i: usize, row: usize| floats(&parts.iter().find(|part| part.0 == i).unwrap().1, row);
    for (state, time) in states(&*model).iter().zip(TIMES) {
        for row in 0..COUNT {
            assert_eq!(state.position_f64(row).to_vec(), values(1, row));
            assert_eq!(state.log_scale.row::<3>(row).map(f64::from).to_vec(), values(4, row));
            let m = (-0.5 * (time - values(13, row)[0]).powi(2) / values(14, row)[0].exp()).exp();
            let expected = if m > 0.05 { m / (1.0 + (-values(6, row)[0]).exp()) } else { 0.0 };
            assert!((opacity(state.opacity_logit.plane(0)[row]) - expected).abs() < 2e-7);
        }
    }
}

#[test]
fn kept_rows_keep_their_bytes_in_every_tensor() {
    let folder = CheckpointFolder::new();
    let model = open(&folder.put(capture(true)));
    let whole = states(&*model);
    let result = folder.written(&*model, &CompressedModel::pruned(vec![1, 4, 5], &rule()));
    let left = states(&*open(&result));
    left.iter().zip(&whole).for_each(|(left, whole)| assert_eq!(*left, whole.pick(&[1, 4, 5])));
    assert_eq!(fs::read(result.join("cfg_args")).unwrap(), fs::read(folder.path("model/cfg_args")).unwrap());
    let checkpoints = [folder.path("model"), result]
        .map(|root| Checkpoint::open(&root.join("chkpnt30000.pth"), ReadLimit::NONE).unwrap());
    let [before, after] = checkpoints.each_ref().map(|checkpoint| checkpoint.tensors().collect::<Vec<_>>());
    // There are nine parameters with two optimizer values each, and four training statistics.
    assert_eq!((before.len(), after.len()), (31, 31));
    for (b, a) in before.iter().zip(&after) {
        assert_eq!(a.shape, [&[3], &b.shape[1..]].concat());
        let width = b.shape[1..].iter().product::<usize>();
        let [b, a] = [(b, 0), (a, 1)].map(|(tensor, k)| checkpoints[k].values(tensor, "").unwrap());
        let rows: Vec<f32> = [1, 4, 5].iter().flat_map(|row| b[row * width..][..width].to_vec()).collect();
        assert_eq!(a, rows);
    }
}

#[test]
fn written_proxies_and_deltas_read_back() {
    let folder = CheckpointFolder::new();
    // Gaussian 1 is a copy of Gaussian 0.
    let mut parts = capture(true);
    for (i, mut tensor) in parameters(true) {
        let width = tensor.bytes.len() / COUNT;
        tensor.bytes.copy_within(0..width, width);
        parts[i] = PythonValue::Parameter(tensor);
    }
    let model = open(&folder.put(parts));
    let cluster = Cluster { output: 0, leader: 0, members: vec![(0, 0.6), (1, 0.4)] };
    let reference = ReferenceFrame { frame: 2, extent: 10.0 };
    let proxies = model.compute_proxies(std::slice::from_ref(&cluster), reference, &rule()).unwrap();
    assert!(proxies.refused.is_empty(), "{proxies:?}");
    let pruned = CompressedModel::pruned(vec![0, 3, 4], &rule());
    let mut by = Gaussians::zeros(3, 0);
    by.position.set_row(2, [0.5, 0.0, -0.25]);
    by.sh.set_row(1, [0.1, 0.2, 0.0]);
    let by = Gaussians { rotation: Default::default(), log_scale: Default::default(), ..by };
    let compressed = CompressedModel { clusters: vec![cluster], proxies, delta: ParamDelta(by), ..pruned };
    let shown = model.compressed_frames(&compressed).unwrap();
    let result = folder.written(&*model, &compressed);
    let whole = states(&*model);
    for (frame, state) in states(&*open(&result)).iter().enumerate() {
        assert_eq!(*state, gather_all(&*shown, frame, Attributes::all()).unwrap());
        // A proxy of two equal Gaussians moves as they do.
        let [got, expected] = [(state, 0), (&whole[frame], 1)].map(|(state, row)| state.position.row::<3>(row));
        (0..3).for_each(|c| assert!((got[c] - expected[c]).abs() < 2e-6, "{got:?} {expected:?}"));
        let moved = state.position.row::<1>(2)[0] - whole[frame].position.row::<1>(4)[0];
        assert!((moved - 0.5).abs() < 1e-6, "{moved}");
    }
    // The optimizer state of merged Gaussians becomes zero.
    let checkpoint = Checkpoint::open(&result.join("chkpnt30000.pth"), ReadLimit::NONE).unwrap();
    let average = checkpoint.tensors().find(|tensor| tensor.storage == "20").unwrap();
    let values = checkpoint.values(&average, "").unwrap();
    assert!(values[..3] == [0.0; 3] && values[3..].iter().all(|x| *x != 0.0), "{values:?}");
}

#[test]
fn static_capture_is_read_as_static_model() {
    let folder = CheckpointFolder::new();
    let moving = capture(false);
    let order = [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12];
    let mut parts: Vec<PythonValue> = order.iter().map(|&i| moving[i].clone()).collect();
    parts[3] = PythonValue::Parameter(tensor(2, &[COUNT, 15, 3], &noise(45 * COUNT, 3.0)));
    let root = folder.put(parts);
    let model = models::open(&root, &OpenOptions::default()).unwrap().into_linked().unwrap();
    assert_eq!(model.description().kind, "3D Gaussian Splatting checkpoint");
    let state = gather_all(model.source(), 0, Attributes::all()).unwrap();
    assert_eq!(f64::from(state.sh.plane(5)[2]), floats(&tensor(0, &[COUNT, 45], &noise(45 * COUNT, 3.0)), 2)[2]);
    let result = folder.written(&*model, &CompressedModel::pruned(vec![2], &rule()));
    let left = models::open(&result, &OpenOptions::default()).unwrap().into_linked().unwrap();
    assert_eq!(gather_all(left.source(), 0, Attributes::all()).unwrap(), state.pick(&[2]));
}

#[test]
fn captures_without_an_optimizer_are_read_and_written() {
    let folder = CheckpointFolder::new();
    let expected = states(&*open(&folder.put(capture(true))));
    let mut parts = capture(true);
    parts[11] = PythonValue::None;
    let model = open(&folder.put(parts));
    assert_eq!(states(&*model), expected);
    let left = open(&folder.written(&*model, &CompressedModel::pruned(vec![1, 4], &rule())));
    assert_eq!(states(&*left), expected.iter().map(|state| state.pick(&[1, 4])).collect::<Vec<_>>());
}

/// Checks that tensors in two half-precision formats (bfloat16 and float16) are read correctly. The bfloat16 tensor has
/// an unused row after each row.
#[test]
fn half_precision_and_strides_in_captures_are_read() {
    let folder = CheckpointFolder::new();
    let mut parts = capture(true);
    let values = noise(3 * COUNT, 1.0);
    let stored = values.chunks(3).flat_map(|row| [row, &[7.0; 3]].concat());
    let bytes = stored.flat_map(|x| half::bf16::from_f32(x).to_le_bytes()).collect();
    let strided =
        PickledTensor { class: "BFloat16Storage", width: 2, bytes, stride: vec![6, 1], ..tensor(0, &[COUNT, 3], &[]) };
    parts[1] = PythonValue::Parameter(strided);
    parts[14] = PythonValue::Parameter(PickledTensor {
        class: "HalfStorage",
        width: 2,
        bytes: [0xBC00u16; COUNT].iter().flat_map(|half| half.to_le_bytes()).collect(),
        ..tensor(7, &[COUNT, 1], &[])
    });
    let model = open(&folder.put(parts));
    let mut same = capture(true);
    let rounded: Vec<f32> = values.iter().map(|&x| half::bf16::from_f32(x).to_f32()).collect();
    same[1] = PythonValue::Parameter(tensor(0, &[COUNT, 3], &rounded));
    same[14] = PythonValue::Parameter(tensor(7, &[COUNT, 1], &[-1.0; COUNT]));
    assert_eq!(states(&*model), states(&*open(&folder.put(same))));
}

#[test]
fn best_or_requested_checkpoint_is_read() {
    let folder = CheckpointFolder::new();
    let root = folder.put(capture(true));
    fs::copy(root.join("chkpnt30000.pth"), root.join("chkpnt_best.pth")).unwrap();
    let notes = models::open(&root, &OpenOptions::default()).unwrap().into_linked().unwrap().description().notes;
    assert!(notes.iter().any(|note| note.contains("chkpnt_best.pth is read")), "{notes:?}");
    assert!(notes.iter().any(|note| note.contains("--time-duration")), "{notes:?}");
    let open_iteration = |iteration| {
        models::open(&root, &OpenOptions { iteration: Some(iteration), ..OpenOptions::default() })
            .and_then(models::Opened::into_linked)
    };
    assert!(open_iteration(30_000).unwrap().description().notes.iter().all(|note| !note.contains("best")));
    let error = open_iteration(7).err().unwrap().to_string();
    assert!(error.contains("chkpnt7.pth") && error.contains("chkpnt30000.pth"), "{error}");
    // The guessed period of colors depends on the frame times.
    let at = |times: Vec<f64>| {
        models::open(&root, &OpenOptions::default())
            .unwrap()
            .into_linked()
            .unwrap()
            .with_times(times)
            .unwrap()
            .description()
            .notes
    };
    assert!(at(vec![0.0, 1.0]).iter().any(|note| note.contains("every 1 ")), "{:?}", at(vec![0.0]));
    assert!(at(vec![0.0, 1.5]).iter().any(|note| note.contains("every 10 ")));
}

#[test]
fn errors_name_the_tensor_and_the_problem() {
    let folder = CheckpointFolder::new();
    let error_message = |change: &dyn Fn(&mut Vec<PythonValue>)| {
        let mut parts = capture(true);
        change(&mut parts);
        open_as(&folder.put(parts), false).err().expect("must be refused").to_string()
    };
    type Wrong = fn(&mut Vec<PythonValue>);
    let cases: [(Wrong, &[&str]); 7] = [
        (|parts| parts[4] = PythonValue::None, &["capture[4] (scaling)", "None"]),
        (
            |parts| parts[4] = PythonValue::Parameter(tensor(3, &[5, 3], &noise(15, 0.0))),
            &["(scaling)", "[6, 3]", "[5, 3]"],
        ),
        (
            |parts| parts[13] = PythonValue::Parameter(tensor(6, &[COUNT], &noise(COUNT, 0.0))),
            &["(t)", "[6, 1]", "[6]"],
        ),
        (
            |parts| parts[3] = PythonValue::Parameter(tensor(2, &[COUNT, 7, 3], &noise(21 * COUNT, 0.0))),
            &["(features_rest)", "33"],
        ),
        (|parts| parts[16] = PythonValue::Int(1), &["(rot_4d)", "True or False", "1"]),
        (
            |parts| {
                let long = PickledTensor {
                    class: "LongStorage",
                    width: 8,
                    bytes: vec![0; 48 * COUNT],
                    ..tensor(1, &[COUNT, 1, 3], &[])
                };
                parts[2] = PythonValue::Parameter(long);
            },
            &["(features_dc)", "int64"],
        ),
        (|parts| parts.truncate(15), &["tuple of 15", "19"]),
    ];
    for (change, expected) in cases {
        let message = error_message(&change);
        assert!(expected.iter().chain(&["chkpnt30000.pth"]).all(|part| message.contains(part)), "{message}");
    }
    let whole = fs::read(folder.put(capture(true)).join("chkpnt30000.pth")).unwrap();
    for length in (0..whole.len()).step_by(997) {
        fs::write(folder.path("model/chkpnt30000.pth"), &whole[..length]).unwrap();
        let message = open_as(&folder.path("model"), false).err().unwrap().to_string();
        assert!(message.contains("chkpnt30000.pth"), "{message}");
    }
}

#[test]
fn archives_restore_checkpoints() {
    for turns in [false, true] {
        let folder = CheckpointFolder::new();
        let root = folder.put(capture(turns));
        let conventions = TrainingConventions { time_duration: Some(2.0), ..TrainingConventions::default() };
        let options = OpenOptions { conventions, ..OpenOptions::default() };
        let kept = CompressedModel::pruned(vec![0, 2, 3], &rule());
        assert_eq!(check_round_trip(&*open(&root), &kept, &options, 5e-3), OutputKind::Model);
    }
}
