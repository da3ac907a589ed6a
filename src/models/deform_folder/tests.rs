//! Tests of Deformable-3D-Gaussians and SC-GS with random models: states against the formulas in f64, outputs read
//! back, and refused inputs.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use tempfile::TempDir;

use crate::compressed_model::{Cluster, CompressedModel, ParamDelta, ReferenceFrame};
use crate::deform::synthetic::Noise;
use crate::deform::synthetic::deep::{ALL_VARIANTS, DeepVariant, random_tensors};
use crate::deform::{Network, PredictedMotion, Tensor, Tensors};
use crate::error::Result;
use crate::files::state_dict::{StoredTensor, TensorValues, write_state_dict};
use crate::limits::Limits;
use crate::model::{AttributeValues, Attributes, Gaussians, opacity};
use crate::models;
use crate::models::archive::checks::check_round_trip;
use crate::models::{InputModel, OpenOptions};
use crate::outputs::kind::OutputKind;
use crate::passes::gather_all;
use crate::progress::Events;
use crate::recipe::Recipe;
use crate::source::FrameSource;

const COUNT: usize = 40;
const TIMES: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];

/// Model folder that a test writes.
struct TestModel {
    folder: TempDir,
    cfg_args: String,
    tensors: Tensors,
    /// Name and values of each property of the point cloud file.
    cloud: Vec<(String, Vec<f32>)>,
}

impl TestModel {
    /// Creates a model of Deformable-3D-Gaussians whose network has random weights and the variant `kind`.
    fn deformable(kind: DeepVariant) -> TestModel {
        let stripped = |(name, tensor): (String, Tensor)| (name.replace("network.", ""), small(tensor));
        TestModel {
            folder: tempfile::tempdir().unwrap(),
            cfg_args: format!(
                "Namespace(is_6dof={}, is_blender={}, sh_degree=1, source_path='', white_background=True)",
                if kind.screws { "True" } else { "False" },
                if kind.time_network { "True" } else { "False" }
            ),
            tensors: random_tensors(kind).into_iter().map(stripped).collect(),
            cloud: cloud(0),
        }
    }

    /// Creates a model of SC-GS with 12 control nodes and a network with random weights and the variant `kind`. Each
    /// Gaussian has 2 features (`hyper_dim`), and a motion mask, which is a factor on its motion.
    fn sc_gs(kind: DeepVariant) -> TestModel {
        let mut noise = Noise(23);
        let mut add = |shape: &[usize]| Tensor {
            shape: shape.to_vec(),
            data: (0..shape.iter().product()).map(|_| noise.next()).collect(),
        };
        let mut made: Tensors = random_tensors(kind).into_iter().map(|(name, tensor)| (name, small(tensor))).collect();
        made.insert("nodes".into(), add(&[12, 5]));
        made.insert("_node_radius".into(), add(&[12]));
        made.insert("_node_weight".into(), add(&[12, 1]));
        TestModel {
            cfg_args: "Namespace(K=3, deform_type='node', gs_with_motion_mask=True, hyper_dim=2, sh_degree=1)".into(),
            tensors: made,
            cloud: cloud(3),
            ..TestModel::deformable(kind)
        }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("model")
    }

    fn file(&self, folder: &str, k: u32) -> PathBuf {
        let name = if folder == "deform" { "deform.pth" } else { "point_cloud.ply" };
        self.path().join(folder).join(format!("iteration_{k}")).join(name)
    }

    /// Writes all files of the model folder as training iteration `k`.
    fn write(&self, k: u32) {
        let [network, cloud] = ["deform", "point_cloud"].map(|folder| self.file(folder, k));
        for file in [&network, &cloud] {
            fs::create_dir_all(file.parent().unwrap()).unwrap();
        }
        fs::write(self.path().join("cfg_args"), &self.cfg_args).unwrap();
        fs::write(self.path().join("cameras.json"), "[]").unwrap();
        let stored = self.tensors.iter().map(|(name, tensor)| {
            StoredTensor::dense(name.clone(), tensor.shape.clone(), TensorValues::F32(tensor.data.clone()))
        });
        write_state_dict(&network, &stored.collect::<Vec<_>>()).unwrap();
        let mut bytes = b"ply\nformat binary_little_endian 1.0\n".to_vec();
        bytes.extend(format!("element vertex {COUNT}\n").bytes());
        bytes.extend(self.cloud.iter().flat_map(|(name, _)| format!("property float {name}\n").into_bytes()));
        bytes.extend(b"end_header\n");
        bytes.extend((0..COUNT).flat_map(|i| self.cloud.iter().flat_map(move |(_, of)| of[i].to_le_bytes())));
        fs::write(cloud, bytes).unwrap();
    }

    /// Writes the model folder, opens it and sets frame times.
    fn open(&self) -> Box<dyn InputModel> {
        self.write(7);
        open(&self.path()).unwrap()
    }

    fn message(&self) -> String {
        self.write(7);
        models::open(&self.path(), &OpenOptions::default())
            .and_then(models::Opened::into_linked)
            .err()
            .expect("it must be refused")
            .to_string()
    }

    fn row<const W: usize>(&self, prefix: &str, i: usize) -> [f64; W] {
        let found: Vec<f64> =
            self.cloud.iter().filter(|(name, _)| name.starts_with(prefix)).map(|(_, of)| f64::from(of[i])).collect();
        found[..W].try_into().unwrap()
    }
}

/// Returns `tensor`, multiplied by 0.1 if it belongs to a last layer of the network (fewer than 5 outputs). Gaussians
/// then move by some tenths of a scene unit.
fn small(mut tensor: Tensor) -> Tensor {
    // Heads are recognized by their few outputs.
    if tensor.shape[0] < 5 {
        tensor.data.iter_mut().for_each(|x| *x *= 0.1);
    }
    tensor
}

fn cloud(features: usize) -> Vec<(String, Vec<f32>)> {
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_owned).to_vec();
    names.extend((0..3).map(|k| format!("f_dc_{k}")));
    names.extend((0..9).map(|k| format!("f_rest_{k}")));
    names.push("opacity".into());
    names.extend((0..3).map(|k| format!("scale_{k}")));
    names.extend((0..4).map(|k| format!("rot_{k}")));
    names.extend((0..features).map(|k| format!("fea_{k}")));
    let mut noise = Noise(17);
    let mut values = |name: &str| -> Vec<f32> {
        let made = |_| if name.starts_with("scale") { noise.next() - 1.0 } else { noise.next() };
        (0..COUNT).map(made).collect()
    };
    names.into_iter().map(|name| (name.clone(), values(&name))).collect()
}

fn open(path: &Path) -> Result<Box<dyn InputModel>> {
    models::open(path, &OpenOptions::default())?.into_linked()?.with_times(TIMES.to_vec())
}

fn states(source: &dyn FrameSource) -> Vec<Gaussians> {
    (0..TIMES.len()).map(|frame| gather_all(source, frame, Attributes::all()).unwrap()).collect()
}

/// Returns the covariance R·S²·Rᵀ by the formula of the rasterizer, which accepts quaternions of any length.
fn covariance(scales: [f64; 3], [w, x, y, z]: [f64; 4]) -> DMat3 {
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let turn = DMat3::from_cols_array_2d(&rows).transpose();
    turn * DMat3::from_diagonal(DVec3::from(scales.map(|s| s * s))) * turn.transpose()
}

fn unit(q: [f64; 4]) -> [f64; 4] {
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    q.map(|x| x / length)
}

fn state_covariance(state: &Gaussians, i: usize) -> DMat3 {
    let scales = state.scales_f64(i);
    covariance(scales, unit(state.rotation_f64(i)))
}

fn relative_difference(a: DMat3, b: DMat3) -> f64 {
    let most = |m: DMat3| m.to_cols_array().iter().fold(0.0f64, |most, x| most.max(x.abs()));
    most(a - b) / most(b)
}

/// Returns the network's output for the canonical positions `places` at `time`. The names of the network's tensors
/// begin with `prefix`.
fn motion(tensors: &Tensors, prefix: &str, places: &[[f64; 3]], time: f64) -> PredictedMotion {
    let network = Network::new(tensors, prefix, Path::new("made")).unwrap();
    let planes = (0..3).flat_map(|c| places.iter().map(move |place| place[c] as f32)).collect();
    let mut motion = PredictedMotion::default();
    network
        .motion(&network.encode(&AttributeValues::from_planes(3, planes)), time, Attributes::all(), &mut motion)
        .unwrap();
    motion
}

fn row<const W: usize>(column: &AttributeValues, i: usize) -> [f64; W] {
    column.row::<W>(i).map(f64::from)
}

#[test]
fn states_of_deformable_3d_gaussians_follow_the_formulas() {
    for kind in &ALL_VARIANTS[..2] {
        let made = TestModel::deformable(*kind);
        let model = made.open();
        assert_eq!(model.description().kind, "Deformable-3D-Gaussians model");
        assert_eq!((model.description().background, model.description().notes), (Some([1.0; 3]), vec![]));
        let places: Vec<[f64; 3]> = (0..COUNT).map(|i| ["x", "y", "z"].map(|name| made.row::<1>(name, i)[0])).collect();
        for (state, time) in states(model.source()).iter().zip(TIMES) {
            let by = motion(&made.tensors, "", &places, time);
            for (i, place) in places.iter().enumerate() {
                let d = row::<4>(&by.rotation, i);
                let rotation = unit(made.row::<4>("rot", i));
                let scale = made.row::<3>("scale", i).map(f64::exp);
                let scale = [0, 1, 2].map(|c| scale[c] + row::<3>(&by.scaling, i)[c]);
                let expected = covariance(scale, [0, 1, 2, 3].map(|c| rotation[c] + d[c]));
                let found = relative_difference(state_covariance(state, i), expected);
                assert!(found < 1e-5, "Gaussian {i}: covariance off by {found:e}");
                if !kind.screws {
                    let to = [0, 1, 2].map(|c| (place[c] + row::<3>(&by.warp, i)[c]) as f32);
                    assert!((0..3).all(|c| (state.position.row::<3>(i)[c] - to[c]).abs() < 1e-6));
                }
                assert_eq!(state.opacity_logit.plane(0)[i], made.row::<1>("opacity", i)[0] as f32);
            }
        }
    }
}

#[test]
fn states_of_sc_gs_follow_the_formulas() {
    for kind in [ALL_VARIANTS[0], ALL_VARIANTS[2]] {
        let made = TestModel::sc_gs(kind);
        let model = made.open();
        assert_eq!((model.description().kind, model.description().notes), ("SC-GS model", vec![]));
        let [nodes, radius, weight] = ["nodes", "_node_radius", "_node_weight"].map(|name| &made.tensors[name].data);
        let places: Vec<[f64; 3]> = nodes.chunks(5).map(|node| [0, 1, 2].map(|c| f64::from(node[c]))).collect();
        for (state, time) in states(model.source()).iter().zip(TIMES) {
            let by = motion(&made.tensors, "network.", &places, time);
            for i in 0..COUNT {
                let x = ["x", "y", "z"].map(|name| made.row::<1>(name, i)[0]);
                let [f, g, mask] = made.row::<3>("fea", i);
                let at = [x[0], x[1], x[2], f, g];
                let mut near: Vec<(f64, usize)> = nodes
                    .chunks(5)
                    .map(|node| node.iter().zip(at).map(|(&a, b)| (f64::from(a) - b).powi(2)).sum::<f64>())
                    .zip(0..)
                    .collect();
                near.sort_by(|a, b| a.0.total_cmp(&b.0));
                let u = near[..3].iter().map(|&(distance, node)| {
                    let kernel = (-distance / (2.0 * f64::from(radius[node]).exp().powi(2))).exp();
                    (kernel * opacity(weight[node]) + 1e-7, node)
                });
                let u: Vec<(f64, usize)> = u.collect();
                let sum: f64 = u.iter().map(|u| u.0).sum();
                let sum = |column: &AttributeValues, c: usize| {
                    let weighted: f64 = u.iter().map(|&(u, node)| u / sum * f64::from(column.plane(c)[node])).sum();
                    weighted / (1.0 + (-mask).exp())
                };
                for (c, x) in x.iter().enumerate() {
                    let to = x + sum(&by.warp, c);
                    assert!((f64::from(state.position.plane(c)[i]) - to).abs() < 1e-6, "Gaussian {i}: {to}");
                    let scale = (made.row::<3>("scale", i)[c].exp() + sum(&by.scaling, c)).abs();
                    let found = f64::from(state.log_scale.plane(c)[i]).exp();
                    assert!((found - scale).abs() < 1e-6, "Gaussian {i}: {found} {scale}");
                }
                let rotation = made.row::<4>("rot", i);
                let rotation = unit([0, 1, 2, 3].map(|c| rotation[c] + sum(&by.rotation, c)));
                let found = unit(row::<4>(&state.rotation, i));
                assert!((0..4).all(|c| (found[c] - rotation[c]).abs() < 1e-5), "Gaussian {i}: {found:?} {rotation:?}");
                let more = if kind.all_heads { sum(&by.opacity, 0) } else { 0.0 };
                let alpha = opacity(made.row::<1>("opacity", i)[0] as f32) + more;
                assert!((opacity(state.opacity_logit.plane(0)[i]) - alpha.clamp(0.0, 1.0)).abs() < 1e-6);
                let more = if kind.all_heads { sum(&by.color, 1) } else { 0.0 };
                let color = made.row::<1>("f_dc_1", i)[0] + more;
                assert!((f64::from(state.sh.plane(1)[i]) - color).abs() < 1e-6);
            }
        }
    }
}

#[test]
fn sc_gs_without_nodes_uses_the_network_directly() {
    let made = TestModel {
        cfg_args: "Namespace(deform_type='mlp', sh_degree=1)".into(),
        ..TestModel::deformable(DeepVariant { screws: false, ..ALL_VARIANTS[0] })
    };
    let model = made.open();
    assert_eq!(model.description().kind, "SC-GS model");
    let places: Vec<[f64; 3]> = (0..COUNT).map(|i| ["x", "y", "z"].map(|name| made.row::<1>(name, i)[0])).collect();
    let (state, by) = (&states(model.source())[2], motion(&made.tensors, "", &places, 0.5));
    for i in 0..COUNT {
        let rotation = made.row::<4>("rot", i);
        let rotation = unit([0, 1, 2, 3].map(|c| rotation[c] + row::<4>(&by.rotation, i)[c]));
        let found = unit(row::<4>(&state.rotation, i));
        assert!((0..4).all(|c| (found[c] - rotation[c]).abs() < 1e-6), "{found:?} {rotation:?}");
    }
}

#[test]
fn jacobian_agrees_with_finite_differences() {
    let models = [
        TestModel::deformable(ALL_VARIANTS[0]),
        TestModel::deformable(ALL_VARIANTS[1]),
        TestModel::sc_gs(ALL_VARIANTS[0]),
        TestModel::sc_gs(ALL_VARIANTS[2]),
    ]
    .map(|made| {
        let model = made.open();
        (made, model)
    });
    for (_, model) in &models {
        let deformation = model.source().deformation().unwrap();
        let (stored, want) = (deformation.stored(), deformation.movable());
        let jacobian = deformation.with_params(stored).jacobian(3, want).unwrap();
        let state = |raw: &crate::model::StoredParams| {
            let mut out = Gaussians::zeros(0, 1);
            deformation.with_params(raw).state(3, want, &mut out).unwrap();
            out
        };
        // The step is small compared to 1/512 and large compared to the f32 error of a difference.
        let step = 3e-5f32;
        let (mut wrong, mut all) = (0, 0);
        for column in want.difference(Attributes::SH).iter() {
            for j in 0..column.width(1) {
                let by = |by: f32| {
                    let mut raw = stored.clone();
                    raw.gaussians.attribute_values_mut(column).plane_mut(j).iter_mut().for_each(|x| *x += by);
                    state(&raw)
                };
                let (above, below) = (by(step), by(-step));
                let mut change = Gaussians::default();
                *change.attribute_values_mut(column) = AttributeValues::zeros(column.width(1), COUNT);
                change.attribute_values_mut(column).plane_mut(j).fill(1.0);
                let mut found = Gaussians::zeros(COUNT, 1);
                jacobian.add_to(&change, Attributes::all(), &mut found);
                for i in 0..column.width(1) {
                    let planes =
                        above.attribute_values(column).plane(i).iter().zip(below.attribute_values(column).plane(i));
                    for ((a, b), found) in planes.zip(found.attribute_values(column).plane(i)) {
                        let expected = (a - b) / (2.0 * step);
                        all += 1;
                        wrong += usize::from((found - expected).abs() > 0.03 * (1.0 + expected.abs()));
                    }
                }
            }
        }
        // Within a step a ReLU may switch or another node may become nearest. This happens often, since the network is
        // random and some of its sines repeat 512 times. A wrong formula would be wrong nearly everywhere; the
        // network's own test is exact.
        assert!(6 * wrong < all, "{}: {wrong} of {all} derivatives are wrong", model.description().kind);
    }
}

/// Returns a compressed model with two proxies (Gaussians that replace merged ones) and parameter deltas.
fn compressed(model: &dyn InputModel) -> CompressedModel {
    let rule = Recipe::preset("default").unwrap().merge;
    let mut compressed = CompressedModel::pruned(vec![1, 4, 9, 12, 30], &rule);
    compressed.clusters = vec![
        Cluster { output: 1, leader: 4, members: vec![(3, 0.6), (4, 0.4)] },
        Cluster { output: 3, leader: 12, members: vec![(12, 0.5), (17, 0.25), (39, 0.25)] },
    ];
    // Random motion exceeds any drift limit, so the limit is lifted to test how proposed proxies are written.
    let rule = crate::recipe::MergeParams { max_drift: f64::INFINITY, ..rule };
    let reference = ReferenceFrame { frame: 0, extent: 1.0 };
    compressed.proxies = model.compute_proxies(&compressed.clusters, reference, &rule).unwrap();
    let mut by = Gaussians::zeros(5, 0);
    by.rotation = AttributeValues::default();
    by.position.set_row(2, [0.5, 0.0, -0.25]);
    by.sh.set_row(0, [0.1, 0.0, 0.2]);
    compressed.delta = ParamDelta(by);
    compressed
}

#[test]
fn kept_rows_and_network_keep_their_bytes() {
    for made in [TestModel::deformable(ALL_VARIANTS[1]), TestModel::sc_gs(ALL_VARIANTS[0])] {
        let model = made.open();
        let rule = Recipe::preset("default").unwrap().merge;
        let path = made.folder.path().join("result");
        fs::create_dir(&path).unwrap();
        let kept = vec![0u32, 2, 39];
        model
            .write(
                &CompressedModel::pruned(kept.clone(), &rule),
                OutputKind::Model,
                &path,
                &Limits::NONE,
                &Events::IGNORED,
            )
            .unwrap();
        for name in ["cfg_args", "cameras.json", "deform/iteration_7/deform.pth"] {
            assert_eq!(fs::read(made.path().join(name)).unwrap(), fs::read(path.join(name)).unwrap(), "{name}");
        }
        let [before, after] = [made.path(), path.clone()]
            .map(|root| fs::read(root.join("point_cloud/iteration_7/point_cloud.ply")).unwrap());
        let rows = |bytes: &[u8], count: usize| {
            let row = 4 * made.cloud.len();
            bytes[bytes.len() - count * row..].chunks(row).map(<[u8]>::to_vec).collect::<Vec<_>>()
        };
        let (before, after) = (rows(&before, COUNT), rows(&after, 3));
        assert_eq!(after, kept.iter().map(|&id| before[id as usize].clone()).collect::<Vec<_>>());
        let again = open(&path).unwrap();
        let all = states(model.source()).iter().map(|state| state.pick(&kept)).collect::<Vec<_>>();
        assert_eq!(states(again.source()), all);
        let size = again.size().unwrap();
        assert_eq!((size, model.size_written(OutputKind::Model, &path).unwrap()), (size, size));
    }
}

#[test]
fn written_proxies_and_deltas_read_back() {
    for made in [
        TestModel::deformable(ALL_VARIANTS[0]),
        TestModel::deformable(ALL_VARIANTS[1]),
        TestModel::sc_gs(ALL_VARIANTS[2]),
    ] {
        let model = made.open();
        let mut compressed = compressed(&*model);
        for sh_degree in [1, 0] {
            compressed.sh_degree = sh_degree;
            let path = made.folder.path().join(format!("result_{sh_degree}"));
            fs::create_dir(&path).unwrap();
            model.write(&compressed, OutputKind::Model, &path, &Limits::NONE, &Events::IGNORED).unwrap();
            let again = open(&path).unwrap();
            assert_eq!(
                states(again.source()),
                states(&*model.compressed_frames(&compressed).unwrap()),
                "{}",
                model.description().kind
            );
            let text = fs::read_to_string(path.join("cfg_args")).unwrap();
            assert!(text.contains(&format!("sh_degree={sh_degree}")), "{text}");
        }
    }
}

#[test]
fn proxy_of_equal_members_equals_them() {
    for mut made in [
        TestModel::deformable(ALL_VARIANTS[0]),
        TestModel::deformable(ALL_VARIANTS[1]),
        TestModel::sc_gs(ALL_VARIANTS[2]),
    ] {
        // Gaussian 1 equals Gaussian 0 except for its normals.
        made.cloud.iter_mut().filter(|(name, _)| !name.starts_with('n')).for_each(|(_, of)| of[1] = of[0]);
        let model = made.open();
        let rule = Recipe::preset("default").unwrap().merge;
        let clusters = [Cluster { output: 0, leader: 0, members: vec![(0, 0.5), (1, 0.5)] }];
        let proxies = model.compute_proxies(&clusters, ReferenceFrame { frame: 0, extent: 1.0 }, &rule).unwrap();
        let mut compressed = CompressedModel::pruned(vec![0], &rule);
        (compressed.clusters, compressed.proxies) = (clusters.to_vec(), proxies);
        assert!(compressed.proxies.deviation.unwrap() < 1e-6, "{:?}", compressed.proxies);
        let (shown, all) = (model.compressed_frames(&compressed).unwrap(), states(model.source()));
        for (frame, state) in states(&*shown).iter().enumerate() {
            assert!((0..3).all(|c| (state.position.plane(c)[0] - all[frame].position.plane(c)[0]).abs() < 1e-6));
            // Scales and rotations of proxies are right on average only; random quaternions have any length.
            let found = relative_difference(state_covariance(state, 0), state_covariance(&all[frame], 0));
            assert!(found < 0.5, "{} at {frame}: covariance off by {found}", model.description().kind);
        }
    }
}

#[test]
fn iterations_need_both_folders() {
    let made = TestModel::deformable(ALL_VARIANTS[0]);
    made.write(7);
    made.write(100);
    fs::remove_file(made.file("deform", 100)).unwrap();
    made.write(30);
    let opened = |iteration| {
        models::open(&made.path(), &OpenOptions { iteration, ..OpenOptions::default() })
            .and_then(models::Opened::into_linked)
    };
    assert_eq!(opened(None).unwrap().digest().unwrap(), opened(Some(30)).unwrap().digest().unwrap());
    assert!(opened(Some(7)).is_ok());
    let message = opened(Some(100)).err().unwrap().to_string();
    assert!(message.contains("point clouds of iterations 7, 30, 100, networks of iterations 7, 30"), "{message}");
}

#[test]
fn weights_take_precedence_over_cfg_args() {
    let mut made = TestModel::deformable(ALL_VARIANTS[1]);
    made.cfg_args = "Namespace(is_6dof=False, is_blender=False)".into();
    let notes = made.open().description().notes;
    assert!(
        notes.len() == 1 && notes[0].contains("is_6dof = False") && notes[0].contains("the weights are used"),
        "{notes:?}"
    );
}

#[test]
fn models_that_are_not_read_are_refused_by_name() {
    for key in
        ["skinning=True", "use_hash=True", "local_frame=True", "progressive_brand_time=True", "d_rot_as_res=False"]
    {
        let mut made = TestModel::sc_gs(ALL_VARIANTS[0]);
        made.cfg_args = made.cfg_args.replace("K=3", &format!("K=3, {key}"));
        let message = made.message();
        assert!(message.contains(key.split('=').next().unwrap()) && message.contains("cfg_args"), "{message}");
    }
    let mut made = TestModel::sc_gs(ALL_VARIANTS[0]);
    made.cfg_args = made.cfg_args.replace("K=3", "max_d_scale=1.5");
    assert!(made.message().contains("max_d_scale"));
    // A file that contains two state dicts.
    let made = TestModel::deformable(ALL_VARIANTS[0]);
    made.write(7);
    let mut archive = zip::ZipWriter::new(fs::File::create(made.file("deform", 7)).unwrap());
    let stored = zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Stored);
    archive.start_file("deform/data.pkl", stored).unwrap();
    std::io::Write::write_all(&mut archive, b"\x80\x02}q\x00}q\x01\x86q\x02.").unwrap();
    archive.finish().unwrap();
    let message = open(&made.path()).err().unwrap().to_string();
    assert!(message.contains("Grid4D") && message.contains("PLY"), "{message}");
}

#[test]
fn errors_name_the_damaged_file_and_the_problem() {
    type Damage = fn(&mut TestModel);
    let cases: [(TestModel, Damage, &[&str]); 9] = [
        (
            TestModel::deformable(ALL_VARIANTS[0]),
            |made| drop(made.tensors.remove("linear.0.weight")),
            &["deform.pth", "linear.0.weight"],
        ),
        (
            TestModel::deformable(ALL_VARIANTS[0]),
            |made| made.cloud[0].1[5] = f32::NAN,
            &["point_cloud.ply", "Gaussian 5, x y z", "NaN"],
        ),
        (TestModel::deformable(ALL_VARIANTS[0]), |made| drop(made.cloud.remove(0)), &["point_cloud.ply", "property x"]),
        (TestModel::deformable(ALL_VARIANTS[0]), |made| made.cfg_args.truncate(30), &["cfg_args"]),
        (
            TestModel::sc_gs(ALL_VARIANTS[0]),
            |made| drop(made.tensors.remove("_node_radius")),
            &["deform.pth", "_node_radius"],
        ),
        (
            TestModel::sc_gs(ALL_VARIANTS[0]),
            |made| made.tensors.get_mut("_node_weight").unwrap().shape = vec![6, 2],
            &["_node_weight", "12 nodes", "[6, 2]"],
        ),
        (
            TestModel::sc_gs(ALL_VARIANTS[0]),
            |made| made.tensors.get_mut("nodes").unwrap().data[7] = f32::INFINITY,
            &["nodes", "finite", "element 7"],
        ),
        (
            TestModel::sc_gs(ALL_VARIANTS[0]),
            |made| made.cloud.retain(|(name, _)| !name.starts_with("fea_1") && !name.starts_with("fea_2")),
            &["point_cloud.ply", "2 properties fea_*", "1"],
        ),
        (
            TestModel::sc_gs(ALL_VARIANTS[0]),
            |made| drop(made.tensors.remove("nodes")),
            &["deform.pth", "nodes", "'node'"],
        ),
    ];
    for (mut made, damage, parts) in cases {
        damage(&mut made);
        let message = made.message();
        for part in parts {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    }
}

#[test]
fn truncated_network_is_refused() {
    let made = TestModel::deformable(ALL_VARIANTS[0]);
    made.write(7);
    let path = made.file("deform", 7);
    let whole = fs::read(&path).unwrap();
    for k in 0..40 {
        fs::write(&path, &whole[..whole.len() * k / 40]).unwrap();
        let message = open(&made.path()).err().expect("it must be refused").to_string();
        assert!(message.contains("deform.pth"), "{message}");
    }
}

#[test]
fn archives_restore_model_folders() {
    let rule = Recipe::preset("default").unwrap().merge;
    let kept = CompressedModel::pruned((0..COUNT as u32).step_by(2).collect(), &rule);
    for kind in ALL_VARIANTS {
        for model in [TestModel::deformable(kind), TestModel::sc_gs(kind)] {
            let opened = model.open();
            let restored = check_round_trip(&*opened, &kept, &OpenOptions::default(), 2e-2);
            assert_eq!(restored, OutputKind::Model);
        }
    }
}
