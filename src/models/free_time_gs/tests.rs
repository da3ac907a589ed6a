use std::fs;
use std::path::PathBuf;

use super::*;
use crate::compressed_model::{Cluster, CompressedModel, ReferenceFrame};
use crate::files::checkpoint::made::{PickledTensor, PythonValue, named, tensor};
use crate::limits::Limits;
use crate::limits::ReadLimit;
use crate::model::{Gaussians, opacity};
use crate::models;
use crate::models::archive::checks::check_round_trip;
use crate::models::input_model::InputModel;
use crate::outputs::kind::OutputKind;
use crate::passes::gather_all;
use crate::progress::Events;
use crate::recipe::{MergeParams, Recipe};

const COUNT: usize = 5;
const TIMES: [f64; 4] = [0.0, 0.25, 0.5, 1.0];

fn noise(n: usize, seed: f64) -> Vec<f32> {
    (0..n).map(|i| ((i as f64 * 0.754_877 + seed * 0.569_84).fract() - 0.5) as f32).collect()
}

/// Name, shape of a row, and values of each tensor of a checkpoint.
type Splats = Vec<(&'static str, Vec<usize>, Vec<f32>)>;

fn splats() -> Splats {
    let random_tensor = |name, row: &[usize], seed: f64, by: f32| {
        let values = noise(COUNT * row.iter().product::<usize>(), seed).into_iter().map(|x| x + by).collect();
        (name, row.to_vec(), values)
    };
    vec![
        random_tensor("means", &[3], 1.0, 0.0),
        random_tensor("scales", &[3], 2.0, -2.0),
        random_tensor("quats", &[4], 3.0, 0.3),
        random_tensor("opacities", &[], 4.0, 0.5),
        random_tensor("sh0", &[1, 3], 5.0, 0.0),
        random_tensor("shN", &[15, 3], 6.0, 0.0),
        random_tensor("times", &[1], 7.0, 0.5),
        // Some durations are below the minimum.
        random_tensor("durations", &[1], 8.0, -3.6),
        random_tensor("velocities", &[3], 9.0, 0.0),
    ]
}

fn file(splats: &Splats) -> Vec<u8> {
    let stored_tensor = |k: usize, row: &[usize], values: &[f32]| {
        tensor(k, &[&[values.len() / row.iter().product::<usize>().max(1)], row].concat(), values)
    };
    let own = splats
        .iter()
        .enumerate()
        .map(|(k, (name, row, values))| (*name, PythonValue::Tensor(stored_tensor(k, row, values))));
    let adam = splats.iter().enumerate().map(|(k, (name, row, values))| {
        let average = |storage| PythonValue::Tensor(PickledTensor { storage, ..stored_tensor(k, row, values) });
        let step = PythonValue::Tensor(tensor(20 + k, &[], &[7.0]));
        let state = named(vec![("step", step), ("exp_avg", average(40 + k)), ("exp_avg_sq", average(60 + k))]);
        (
            *name,
            PythonValue::Dict(named(vec![(
                "state",
                PythonValue::Dict(vec![(PythonValue::Int(0), PythonValue::Dict(state))]),
            )])),
        )
    });
    let root = named(vec![
        ("step", PythonValue::Int(59_999)),
        ("splats", PythonValue::Ordered(named(own.collect()))),
        ("optimizers", PythonValue::Dict(named(adam.collect()))),
    ]);
    PythonValue::Dict(root).file()
}

struct ResultFolder(tempfile::TempDir);

impl ResultFolder {
    fn put(splats: &Splats) -> ResultFolder {
        let folder = ResultFolder(tempfile::tempdir().unwrap());
        fs::create_dir_all(folder.0.path().join("result/ckpts")).unwrap();
        fs::write(folder.path("result/ckpts/ckpt_59999.pt"), file(splats)).unwrap();
        folder
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn written(&self, model: &dyn InputModel, compressed: &CompressedModel) -> PathBuf {
        let result = self.path("written");
        fs::create_dir(&result).unwrap();
        model.write(compressed, OutputKind::Model, &result, &Limits::NONE, &Events::IGNORED).unwrap();
        result
    }
}

fn open(path: &Path) -> Result<Box<dyn InputModel>> {
    models::open(path, &OpenOptions::default())?.into_linked()?.with_times(TIMES.to_vec())
}

fn states(model: &dyn InputModel) -> Vec<Gaussians> {
    (0..TIMES.len()).map(|frame| gather_all(model.source(), frame, Attributes::all()).unwrap()).collect()
}

fn rule() -> MergeParams {
    Recipe::preset("default").unwrap().merge
}

#[test]
fn states_follow_the_formulas() {
    let splats = splats();
    let folder = ResultFolder::put(&splats);
    let model = open(&folder.path("result")).unwrap();
    assert_eq!(model.description().kind, "FreeTimeGS checkpoint");
    let values = |k: usize, row: usize| -> Vec<f64> {
        let width = splats[k].2.len() / COUNT;
        splats[k].2[row * width..][..width].iter().map(|&x| f64::from(x)).collect()
    };
    let mut clamped = [0; 2];
    for (state, time) in states(&*model).iter().zip(TIMES) {
        for row in 0..COUNT {
            let dt = time - values(6, row)[0];
            let s = values(7, row)[0].exp().max(0.02) + 1e-8;
            clamped[usize::from(values(7, row)[0].exp() > 0.02)] += 1;
            for c in 0..3 {
                let expected = values(0, row)[c] + values(8, row)[c] * dt;
                assert!((f64::from(state.position.plane(c)[row]) - expected).abs() < 1e-7);
            }
            let expected = ((-0.5 * (dt / s).powi(2)).exp() / (1.0 + (-values(3, row)[0]).exp())).max(1e-4);
            let got = opacity(state.opacity_logit.plane(0)[row]);
            assert!((got - expected).abs() < 1e-7, "{got} {expected}");
            assert_eq!(state.rotation_f64(row).to_vec(), values(2, row));
            assert_eq!(state.log_scale.row::<3>(row).map(f64::from).to_vec(), values(1, row));
            assert_eq!(state.sh.row::<48>(row).map(f64::from).to_vec(), [values(4, row), values(5, row)].concat());
        }
    }
    assert!(clamped[0] > 0 && clamped[1] > 0, "{clamped:?}");
    // The folder of checkpoints and the checkpoint itself open as the same model as the result folder.
    for name in ["result/ckpts", "result/ckpts/ckpt_59999.pt"] {
        assert_eq!(states(&*open(&folder.path(name)).unwrap()), states(&*model));
    }
}

#[test]
fn kept_rows_stay_in_splats_and_optimizers() {
    let folder = ResultFolder::put(&splats());
    let model = open(&folder.path("result")).unwrap();
    let result = folder.written(&*model, &CompressedModel::pruned(vec![0, 3], &rule()));
    let left = open(&result).unwrap();
    states(&*left).iter().zip(states(&*model)).for_each(|(left, whole)| assert_eq!(*left, whole.pick(&[0, 3])));
    let [before, after] = [folder.path("result"), result]
        .map(|root| Checkpoint::open(&root.join("ckpts/ckpt_59999.pt"), ReadLimit::NONE).unwrap());
    let shapes: Vec<Vec<usize>> = after.tensors().map(|tensor| tensor.shape).collect();
    // There are nine tensors each of parameters, steps and two averages; only the steps have no rows.
    assert_eq!(shapes.len(), 36);
    assert_eq!(shapes.iter().filter(|shape| shape.first() == Some(&2)).count(), 27);
    assert_eq!(before.storage("20").unwrap(), after.storage("20").unwrap());
    assert_eq!(before.storage("43").unwrap()[12..16], after.storage("43").unwrap()[4..]);
}

#[test]
fn proxy_moves_as_the_mean_of_its_members() {
    let mut made = splats();
    // Long windows, and two members with nearly the same position and velocity.
    made[7].2.fill(-0.5);
    made[6].2.fill(0.5);
    // Low opacities, so that their sum does not saturate.
    made[3].2.fill(-3.0);
    for k in [0, 1, 8] {
        (0..3).for_each(|c| made[k].2[6 + c] = made[k].2[c] + 0.01 * (c as f32 + 1.0));
    }
    let folder = ResultFolder::put(&made);
    let model = open(&folder.path("result")).unwrap();
    let cluster = Cluster { output: 0, leader: 0, members: vec![(0, 0.25), (2, 0.75)] };
    let reference = ReferenceFrame { frame: 2, extent: 10.0 };
    let proxies = model.compute_proxies(std::slice::from_ref(&cluster), reference, &rule()).unwrap();
    assert!(proxies.deviation.is_some_and(|deviation| deviation < 1e-6), "{proxies:?}");
    let pruned = CompressedModel::pruned(vec![0, 1], &rule());
    let compressed = CompressedModel { clusters: vec![cluster], proxies, ..pruned };
    let left = open(&folder.written(&*model, &compressed)).unwrap();
    for (left, whole) in states(&*left).iter().zip(states(&*model)) {
        let [a, b] = [0, 2].map(|row| whole.position.row::<3>(row));
        let got = left.position.row::<3>(0);
        (0..3).for_each(|c| assert!((got[c] - 0.25 * a[c] - 0.75 * b[c]).abs() < 1e-6));
        assert_eq!(left.position.row::<3>(1), whole.position.row::<3>(1));
    }
}

#[test]
fn model_without_velocities_is_static_with_any_sh_degree() {
    let mut made = splats();
    made.truncate(6);
    made[5].1 = vec![3, 3];
    made[5].2.truncate(9 * COUNT);
    let folder = ResultFolder::put(&made);
    let model = models::open(&folder.path("result"), &OpenOptions::default()).unwrap().into_linked().unwrap();
    assert_eq!((model.description().kind, model.source().info().sh_degree), ("gsplat checkpoint", 1));
    let whole = gather_all(model.source(), 0, Attributes::all()).unwrap();
    let result = folder.written(&*model, &CompressedModel::pruned(vec![1, 2], &rule()));
    let left = models::open(&result, &OpenOptions::default()).unwrap().into_linked().unwrap();
    assert_eq!(gather_all(left.source(), 0, Attributes::all()).unwrap(), whole.pick(&[1, 2]));
}

/// Returns the bytes of a checkpoint with the tensors `splats` and no optimizers. `prefix` is put before the names of
/// the tensors.
fn bare_file(splats: &Splats, prefix: &'static str) -> Vec<u8> {
    let tensors = splats.iter().enumerate().map(|(k, (name, row, values))| {
        let name: &'static str = Box::leak(format!("{prefix}{name}").into_boxed_str());
        (name, PythonValue::Tensor(tensor(k, &[&[COUNT], &row[..]].concat(), values)))
    });
    PythonValue::Dict(named(vec![("splats", PythonValue::Ordered(named(tensors.collect())))])).file()
}

#[test]
fn checkpoints_without_optimizers_are_read_and_written() {
    let folder = ResultFolder::put(&splats());
    let expected = states(&*open(&folder.path("result")).unwrap());
    fs::write(folder.path("result/ckpts/ckpt_59999.pt"), bare_file(&splats(), "")).unwrap();
    let model = open(&folder.path("result")).unwrap();
    assert_eq!((states(&*model), model.description().notes), (expected.clone(), vec![]));
    let left = open(&folder.written(&*model, &CompressedModel::pruned(vec![1, 4], &rule()))).unwrap();
    assert_eq!(states(&*left), expected.iter().map(|state| state.pick(&[1, 4])).collect::<Vec<_>>());
}

#[test]
fn names_with_the_prefix_module_are_read_and_noted() {
    let folder = ResultFolder::put(&splats());
    let expected = states(&*open(&folder.path("result")).unwrap());
    fs::write(folder.path("result/ckpts/ckpt_59999.pt"), bare_file(&splats(), "module.")).unwrap();
    for name in ["result", "result/ckpts/ckpt_59999.pt"] {
        let model = open(&folder.path(name)).unwrap();
        assert_eq!(states(&*model), expected);
        assert!(
            model.description().notes.iter().any(|note| note.contains("\"module.\"")),
            "{:?}",
            model.description().notes
        );
    }
}

#[test]
fn defective_rows_of_a_checkpoint_are_read_and_noted() {
    let mut made = splats();
    made[0].2[4] = f32::NAN;
    (made[3].2[2], made[3].2[3]) = (f32::INFINITY, f32::NEG_INFINITY);
    let model = open(&ResultFolder::put(&made).path("result")).unwrap();
    let (found, expected) = (states(&*model), states(&*open(&ResultFolder::put(&splats()).path("result")).unwrap()));
    assert_eq!(found[1].pick(&[0, 4]), expected[1].pick(&[0, 4]));
    assert!(found[1].position.plane(1)[1].is_nan());
    assert!(found.iter().all(|state| state.opacity_logit.planes().iter().all(|logit| logit.is_finite())));
    let note = "2 of 5 rows repaired: infinite opacity logit";
    assert!(model.description().notes.iter().any(|found| found.contains(note)), "{:?}", model.description().notes);
}

#[test]
fn errors_name_the_tensor_and_the_problem() {
    let error_message = |change: &dyn Fn(&mut Splats)| {
        let mut made = splats();
        change(&mut made);
        open(&ResultFolder::put(&made).path("result")).err().expect("must be refused").to_string()
    };
    for name in ["accels", "jerks"] {
        let message = error_message(&|splats| splats.push((name, vec![3], noise(3 * COUNT, 0.0))));
        assert!(message.contains(name) && message.contains("frame stream"), "{message}");
    }
    let message = error_message(&|splats| splats[1].1 = vec![1, 3]);
    assert!(
        message.contains("splats[\"scales\"]") && message.contains("[5, 3]") && message.contains("[5, 1, 3]"),
        "{message}"
    );
    let message = error_message(&|splats| drop(splats.remove(2)));
    assert!(message.contains("splats[\"quats\"]") && message.contains("means, scales"), "{message}");
    let folder = ResultFolder::put(&splats());
    let path = folder.path("result/ckpts/ckpt_59999.pt");
    fs::write(folder.path("result/ckpts/ckpt_59999_rank1.pt"), "").unwrap();
    fs::rename(&path, folder.path("result/ckpts/ckpt_59999_rank0.pt")).unwrap();
    let message = open(&folder.path("result")).err().unwrap().to_string();
    assert!(message.contains("ranks"), "{message}");
}

#[test]
fn archives_restore_checkpoints() {
    let folder = ResultFolder::put(&splats());
    let model = open(&folder.path("result")).unwrap();
    let kept = CompressedModel::pruned(vec![0, 2, 3], &rule());
    assert_eq!(check_round_trip(&*model, &kept, &OpenOptions::default(), 1e-3), OutputKind::Model);
}
