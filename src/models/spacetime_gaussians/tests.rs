use super::*;
use crate::compressed_model::ParamDelta;
use crate::deform::Tensors;
use crate::files::splatv::{Splatv, SplatvGaussian};
use crate::files::state_dict::{StoredTensor, TensorValues, write_state_dict};
use crate::model::{AttributeValues, Attributes, Gaussians};
use crate::models;
use crate::models::OpenOptions;
use crate::models::archive::checks::check_round_trip;
use crate::passes::gather_all;
use crate::progress::Events;
use crate::recipe::Recipe;

const COUNT: usize = 7;

/// Returns the names of the properties of the PLY file in the order in which the training writes them: of the full
/// model if `is_full`, else of the lite model.
fn properties(is_full: bool) -> Vec<String> {
    let numbered = |name: &str, count: usize| (0..count).map(|k| format!("{name}_{k}")).collect::<Vec<_>>();
    let mut names: Vec<String> =
        ["x", "y", "z", "trbf_center", "trbf_scale", "nx", "ny", "nz"].map(str::to_owned).to_vec();
    names.extend([numbered("motion", 9), numbered("f_dc", if is_full { 6 } else { 3 })].concat());
    names.push("opacity".to_owned());
    names.extend([numbered("scale", 3), numbered("rot", 4), numbered("omega", 4)].concat());
    names.extend(numbered("f_t", if is_full { 3 } else { 0 }));
    names
}

/// Returns the value of the property `name` of Gaussian `i` in the test model.
fn value(name: &str, i: usize) -> f32 {
    let noise = |step: f32| {
        ((i as f32 + 1.0) * step + name.len() as f32 * 0.31 + name.as_bytes()[name.len() - 1] as f32 * 0.17).fract()
    };
    match name {
        "trbf_center" => 0.1 * i as f32,
        "trbf_scale" => -1.0 + 0.2 * i as f32,
        "nx" => 0.0,
        "opacity" => i as f32 - 3.0,
        // The quaternion always has a direction.
        "rot_0" => 1.5 + noise(0.2),
        _ if name.starts_with("scale") => -4.0 + noise(0.618_034),
        _ => 2.0 * noise(0.618_034) - 0.5,
    }
}

fn ply(names: &[String], count: usize, value: impl Fn(&str, usize) -> f32) -> Vec<u8> {
    let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {count}\n").into_bytes();
    names.iter().for_each(|name| bytes.extend(format!("property float {name}\n").as_bytes()));
    bytes.extend(b"end_header\n");
    for i in 0..count {
        names.iter().for_each(|name| bytes.extend(value(name, i).to_le_bytes()));
    }
    bytes
}

fn write_decoder(path: &Path, tensors: &Tensors) {
    let stored = tensors
        .iter()
        .map(|(name, of)| StoredTensor::dense(name.clone(), of.shape.clone(), TensorValues::F32(of.data.clone())));
    write_state_dict(path, &stored.collect::<Vec<_>>()).unwrap();
}

const CFG_ARGS_TEXT: &str =
    "Namespace(model='ours', duration=50, white_background=True, source_path='data/x', rgbfunction='sandwich')";

/// Writes a model folder with two training iterations: of the full model if `is_full`, else of the lite model.
fn folder(is_full: bool) -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for number in [7, 300] {
        let folder = root.path().join(format!("point_cloud/iteration_{number}"));
        fs::create_dir_all(&folder).unwrap();
        let count = if number == 300 { COUNT } else { 2 };
        fs::write(folder.join(POINT_CLOUD_FILE), ply(&properties(is_full), count, value)).unwrap();
        if is_full {
            write_decoder(&folder.join(DECODER), &decoder::tests::weights());
        }
    }
    fs::write(root.path().join(CFG_ARGS), CFG_ARGS_TEXT).unwrap();
    fs::write(root.path().join(CAMERAS), r#"[{"id": 4, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]"#).unwrap();
    root
}

fn open(path: &Path) -> Result<Box<dyn InputModel>> {
    models::open(path, &OpenOptions::default()).and_then(models::Opened::into_linked)
}

const TIMES: [f64; 4] = [0.0, 0.25, 0.5, 0.9];

fn open_with_frames(path: &Path) -> Box<dyn InputModel> {
    open(path).unwrap().with_times(TIMES.to_vec()).unwrap()
}

fn refusal(path: &Path) -> String {
    open(path).err().expect("it must be refused").to_string()
}

fn states(source: &dyn FrameSource) -> Vec<Gaussians> {
    (0..TIMES.len()).map(|frame| gather_all(source, frame, Attributes::all()).unwrap()).collect()
}

fn assert_near(found: &[Gaussians], expected: &[Gaussians], tolerance: f32) {
    for (found, expected) in found.iter().zip(expected) {
        for column in Attributes::all().iter() {
            let pairs = found.attribute_values(column).planes().iter().zip(expected.attribute_values(column).planes());
            pairs.for_each(|(a, b)| assert!((a - b).abs() <= tolerance, "{}: {a}, expected {b}", column.name()));
        }
    }
}

#[test]
fn states_follow_the_formulas_in_both_variants() {
    for is_full in [false, true] {
        let root = folder(is_full);
        let model = open_with_frames(root.path());
        assert_eq!(model.description().kind.contains("full"), is_full);
        assert_eq!(
            (model.source().info().count, model.description().time_convention, model.description().background),
            (COUNT, TimeConvention::Given, Some([0.0; 3]))
        );
        for (state, time) in states(model.source()).iter().zip(TIMES) {
            for i in 0..COUNT {
                let stored = |name: &str| f64::from(value(name, i));
                let dt = time - stored("trbf_center");
                for (c, axis) in ["x", "y", "z"].iter().enumerate() {
                    let term = |k: usize| stored(&format!("motion_{}", 3 * k + c)) * dt.powi(k as i32 + 1);
                    let expected = stored(axis) + term(0) + term(1) + term(2);
                    assert!((f64::from(state.position.plane(c)[i]) - expected).abs() < 1e-6);
                    assert_eq!(state.log_scale.plane(c)[i], value(&format!("scale_{c}"), i));
                    let feature = stored(&format!("f_dc_{c}"));
                    let expected = if is_full { 1.0 / (1.0 + (-feature).exp()) } else { feature };
                    assert!((crate::model::color_from_sh(state.sh.plane(c)[i]) - expected).abs() < 1e-6);
                }
                for c in 0..4 {
                    let expected = stored(&format!("rot_{c}")) + dt * stored(&format!("omega_{c}"));
                    assert!((f64::from(state.rotation.plane(c)[i]) - expected).abs() < 1e-6);
                }
                let alpha = (-(dt / stored("trbf_scale").exp()).powi(2)).exp() / (1.0 + (-stored("opacity")).exp());
                let expected = (alpha / (1.0 - alpha)).ln().clamp(-40.0, 40.0);
                let found = f64::from(state.opacity_logit.plane(0)[i]);
                assert!((found - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{found} for {expected}");
            }
        }
    }
}

#[test]
fn logits_stay_finite_for_extreme_windows() {
    let root = folder(false);
    let names = properties(false);
    let path = root.path().join("point_cloud/iteration_300/point_cloud.ply");
    let extreme = |name: &str, i: usize| match (name, i) {
        ("trbf_scale", 0) => -80.0,
        ("trbf_scale", 1) => 80.0,
        ("opacity", 2) => 1e6,
        ("opacity", 3) => -1e6,
        ("trbf_center", 4) => 1e9,
        _ => value(name, i),
    };
    fs::write(path, ply(&names, COUNT, extreme)).unwrap();
    for state in states(open_with_frames(root.path()).source()) {
        let logits = state.opacity_logit.plane(0);
        assert!(logits.iter().all(|logit| logit.abs() <= 40.0), "{logits:?}");
        assert_eq!((logits[3], logits[4]), (-40.0, -40.0));
    }
}

#[test]
fn opacity_jacobian_agrees_with_finite_differences() {
    let root = folder(false);
    let model = open_with_frames(root.path());
    let deformation = model.source().deformation().unwrap();
    assert_eq!(deformation.movable(), Attributes::all());
    let step = 1e-2;
    let at = |frame: usize, by: f32| {
        let mut raw = deformation.stored().clone();
        raw.gaussians.opacity_logit.planes_mut().iter_mut().for_each(|x| *x += by);
        let mut state = Gaussians::zeros(COUNT, 0);
        deformation.with_params(&raw).state(frame, Attributes::OPACITY, &mut state).unwrap();
        state.opacity_logit
    };
    for frame in 0..TIMES.len() {
        let found = deformation.with_params(deformation.stored()).jacobian(frame, Attributes::all()).unwrap();
        assert_eq!(found.derivative(Attributes::POSITION).width(), 0);
        let (more, less) = (at(frame, step), at(frame, -step));
        for i in 0..COUNT {
            let expected = (more.plane(0)[i] - less.plane(0)[i]) / (2.0 * step);
            let found = found.derivative(Attributes::OPACITY).plane(0)[i];
            assert!((found - expected).abs() < 1e-3, "{found} for {expected}");
        }
    }
    let full = folder(true);
    let full = open_with_frames(full.path());
    assert!(!full.source().deformation().unwrap().movable().contains(Attributes::SH));
}

#[test]
fn kept_rows_of_a_folder_keep_their_bytes() {
    for is_full in [false, true] {
        let root = folder(is_full);
        // A folder inside a model folder is not taken for a folder of frames.
        for inner in ["point_cloud", "point_cloud/iteration_300"] {
            let message = refusal(&root.path().join(inner));
            assert!(message.contains("give the folder above"), "{message}");
        }
        let model = open_with_frames(root.path());
        let rule = Recipe::preset("default").unwrap().merge;
        let result = tempfile::tempdir().unwrap();
        let compressed = CompressedModel::pruned(vec![1, 4, 5], &rule);
        model.write(&compressed, OutputKind::Model, result.path(), &Limits::NONE, &Events::IGNORED).unwrap();
        let kept = |name: &str, i: usize| value(name, [1, 4, 5][i]);
        let iteration = result.path().join("point_cloud/iteration_300");
        assert_eq!(fs::read(iteration.join(POINT_CLOUD_FILE)).unwrap(), ply(&properties(is_full), 3, kept));
        for name in [CFG_ARGS, CAMERAS] {
            assert_eq!(fs::read(result.path().join(name)).unwrap(), fs::read(root.path().join(name)).unwrap());
        }
        let decoder = root.path().join("point_cloud/iteration_300").join(DECODER);
        assert_eq!(fs::read(iteration.join(DECODER)).ok(), fs::read(decoder).ok());
        assert_eq!(fs::read(iteration.join(DECODER)).is_ok(), is_full);
        let expected: Vec<Gaussians> = states(model.source()).iter().map(|state| state.pick(&[1, 4, 5])).collect();
        assert_eq!(states(open_with_frames(result.path()).source()), expected);
        let size = model.size_written(OutputKind::Model, result.path()).unwrap();
        assert_eq!(size, open(result.path()).unwrap().size().unwrap());
        assert!(size.total() < model.bytes().unwrap() && size.rest > 0);
        // The PLY alone, as viewers open it.
        let alone = result.path().join("alone.ply");
        model.write(&compressed, OutputKind::Ply, &alone, &Limits::NONE, &Events::IGNORED).unwrap();
        assert_eq!(fs::read(&alone).unwrap(), fs::read(iteration.join(POINT_CLOUD_FILE)).unwrap());
        let alone = open_with_frames(&alone);
        assert_eq!(
            (alone.description().default_output_kind, alone.description().kind),
            (OutputKind::Ply, model.description().kind)
        );
        assert_eq!(alone.check_output(OutputKind::Splatv, Path::new("x.splatv")).is_err(), is_full);
        assert!(alone.check_output(OutputKind::Model, Path::new("x")).is_err());
        // Its PLY holds the motion, so no note says that it is missing.
        assert!(model.keeps_motion(OutputKind::Ply) && model.motion_note(OutputKind::Ply).is_none());
    }
}

/// Returns a compressed model of three Gaussians: one is a proxy (it replaces two merged Gaussians), and each has a
/// parameter delta (change that refinement adds to its parameters).
fn compressed(model: &dyn InputModel) -> CompressedModel {
    let rule = MergeParams { max_drift: 1e6, ..Recipe::preset("default").unwrap().merge };
    let cluster = Cluster { output: 1, leader: 3, members: vec![(2, 0.25), (3, 0.75)] };
    let reference = ReferenceFrame { frame: 0, extent: 1.0 };
    let proxies = model.compute_proxies(std::slice::from_ref(&cluster), reference, &rule).unwrap();
    let mut by = Gaussians::zeros(3, 0);
    by.position.set_row(0, [0.5, 0.0, -0.25]);
    by.opacity_logit.set_row(0, [0.5]);
    by.log_scale.set_row(1, [0.0, 0.125, 0.0]);
    by.rotation.set_row(2, [0.0, 0.0, 0.1, 0.0]);
    let changes = model.source().deformation().unwrap().movable();
    match changes.contains(Attributes::SH) {
        true => by.sh.set_row(2, [0.1, 0.2, 0.0]),
        false => by.sh = AttributeValues::default(),
    }
    CompressedModel {
        clusters: vec![cluster],
        proxies,
        delta: ParamDelta(by),
        ..CompressedModel::pruned(vec![0, 3, 6], &rule)
    }
}

#[test]
fn written_proxies_and_deltas_read_back() {
    for is_full in [false, true] {
        let root = folder(is_full);
        let model = open_with_frames(root.path());
        let compressed = compressed(&*model);
        let shown = states(&*model.compressed_frames(&compressed).unwrap());
        let result = tempfile::tempdir().unwrap();
        model.write(&compressed, OutputKind::Model, result.path(), &Limits::NONE, &Events::IGNORED).unwrap();
        let read = open_with_frames(result.path());
        assert_near(&states(read.source()), &shown, 2e-6);
        let file = fs::read(result.path().join("point_cloud/iteration_300").join(POINT_CLOUD_FILE)).unwrap();
        assert!(!String::from_utf8_lossy(&file).contains("f_rest"));
        // Values of other Gaussians did not change, and neither did other values of the changed ones.
        let row = 4 * properties(is_full).len();
        let values = |i: usize| file[file.len() - (3 - i) * row..][..row].to_vec();
        let original = ply(&properties(is_full), COUNT, value);
        let same = values(0).iter().zip(&original[original.len() - COUNT * row..]).filter(|(a, b)| a == b).count();
        assert!(same >= row - 12, "{same} of {row} bytes");
    }
}

#[test]
fn proxy_of_similar_members_is_their_mean_at_every_frame() {
    let root = folder(false);
    let path = root.path().join("point_cloud/iteration_300/point_cloud.ply");
    // Gaussians 0 and 1 differ only in position and motion; 2 and 3 are copies.
    let alike = |name: &str, i: usize| match name {
        "x" | "motion_0" | "motion_4" => value(name, i.min(2)),
        _ if i < 2 => value(name, 0),
        _ => value(name, i.clamp(3, 4)),
    };
    fs::write(path, ply(&properties(false), COUNT, alike)).unwrap();
    let model = open_with_frames(root.path());
    let rule = MergeParams { max_drift: 1e-3, ..Recipe::preset("default").unwrap().merge };
    let clusters = [
        Cluster { output: 0, leader: 0, members: vec![(0, 0.5), (1, 0.5)] },
        Cluster { output: 1, leader: 2, members: vec![(2, 0.3), (3, 0.7)] },
    ];
    let proxies = model.compute_proxies(&clusters, ReferenceFrame { frame: 0, extent: 1.0 }, &rule).unwrap();
    let compressed =
        CompressedModel { clusters: clusters.to_vec(), proxies, ..CompressedModel::pruned(vec![0, 2], &rule) };
    let found = states(&*model.compressed_frames(&compressed).unwrap());
    for (found, all) in found.iter().zip(states(model.source())) {
        for c in 0..3 {
            let plane = all.position.plane(c);
            assert!((found.position.plane(c)[0] - 0.5 * (plane[0] + plane[1])).abs() < 1e-5);
            assert!((found.position.plane(c)[1] - plane[2]).abs() < 1e-5);
            // A proxy of members that are apart is longer, so only the copies are compared.
            assert!((found.log_scale.plane(c)[1] - all.log_scale.plane(c)[2]).abs() < 1e-5);
        }
        let unit = |state: &Gaussians, i: usize| {
            let q = state.rotation_f64(i);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            q.map(|x| x / length)
        };
        let (a, b) = (unit(found, 1), unit(&all, 2));
        let dot: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
        assert!(dot.abs() > 1.0 - 1e-6, "{a:?} {b:?}");
    }
    assert!(compressed.proxies.deviation.unwrap() < 1e-5, "{:?}", compressed.proxies.deviation);
}

#[test]
fn splatv_of_a_lite_model_keeps_motion_and_stored_words() {
    let root = folder(false);
    let model = open_with_frames(root.path());
    let rule = Recipe::preset("default").unwrap().merge;
    let all = CompressedModel::pruned((0..COUNT as u32).collect(), &rule);
    let path = root.path().join("all.splatv");
    model.write(&all, OutputKind::Splatv, &path, &Limits::NONE, &Events::IGNORED).unwrap();
    let read = open_with_frames(&path);
    assert_eq!(
        (read.description().kind, read.source().info().count, read.description().default_output_kind),
        ("splaTV model", COUNT, OutputKind::Splatv)
    );
    // Colors and opacities are stored as bytes, and colors outside 0 … 1 are clamped, so they are not compared.
    for (found, expected) in states(read.source()).iter().zip(states(model.source())) {
        let pairs = |column: Attributes| {
            found
                .attribute_values(column)
                .planes()
                .iter()
                .zip(expected.attribute_values(column).planes())
                .collect::<Vec<_>>()
        };
        for column in [Attributes::POSITION, Attributes::ROTATION, Attributes::LOG_SCALE] {
            pairs(column).iter().for_each(|(a, b)| assert!((*a - *b).abs() < 5e-3, "{}: {a} {b}", column.name()));
        }
    }
    let file = Splatv::open(&path).unwrap();
    assert_eq!(file.cameras()[0]["id"], 4);
    let kept = root.path().join("kept.splatv");
    read.write(&CompressedModel::pruned(vec![2, 5], &rule), OutputKind::Splatv, &kept, &Limits::NONE, &Events::IGNORED)
        .unwrap();
    let small = Splatv::open(&kept).unwrap();
    assert_eq!((small.count(), small.words(0), small.words(1)), (2, file.words(2), file.words(5)));
    assert_eq!(small.cameras(), file.cameras());
    let mut by = Gaussians { position: AttributeValues::zeros(3, 2), ..Gaussians::default() };
    by.position.set_row(1, [1.0, 0.0, 0.0]);
    let moved = CompressedModel { delta: ParamDelta(by), ..CompressedModel::pruned(vec![2, 5], &rule) };
    read.write(&moved, OutputKind::Splatv, &kept, &Limits::NONE, &Events::IGNORED).unwrap();
    let moved = Splatv::open(&kept).unwrap();
    assert_eq!(moved.words(0), file.words(2));
    let (to, from) = (SplatvGaussian::from_words(&moved.words(1)), SplatvGaussian::from_words(&file.words(5)));
    assert_eq!(to, SplatvGaussian { position: [from.position[0] + 1.0, from.position[1], from.position[2]], ..from });
    // Without cameras of the model, the file gets one that a viewer can start at.
    fs::remove_file(root.path().join(CAMERAS)).unwrap();
    open_with_frames(root.path()).write(&all, OutputKind::Splatv, &kept, &Limits::NONE, &Events::IGNORED).unwrap();
    assert_eq!(Splatv::open(&kept).unwrap().cameras()[0]["rotation"].as_array().map(Vec::len), Some(3));
}

#[test]
fn wrong_properties_and_values_are_named() {
    let root = tempfile::tempdir().unwrap();
    let path = root.path().join("model.ply");
    let refused = |change: &dyn Fn(&mut Vec<String>)| {
        let mut names = properties(true);
        change(&mut names);
        fs::write(&path, ply(&names, 3, value)).unwrap();
        refusal(&path)
    };
    let without = |name: &'static str| refused(&move |names| names.retain(|found| found != name));
    for (name, expected) in [
        ("trbf_scale", "2 properties that begin with trbf_"),
        ("motion_8", "9 properties that begin with motion"),
        ("omega_0", "4 properties that begin with omega"),
        ("f_dc_5", "3 or 6 properties that begin with f_dc"),
        ("f_t_1", "3 properties that begin with f_t"),
        ("opacity", "property opacity"),
    ] {
        let message = without(name);
        assert!(message.contains(expected) && message.contains("model.ply"), "{name}: {message}");
    }
    let more = refused(&|names| names.push("f_rest_0".to_owned()));
    assert!(more.contains("f_rest"), "{more}");
    let renamed = refused(&|names| {
        names.iter_mut().filter(|name| *name == "motion_3").for_each(|name| *name = "motion_x".into())
    });
    assert!(renamed.contains("property motion_3"), "{renamed}");
    for (name, wrong) in
        [("motion_2", f32::NAN), ("x", f32::INFINITY), ("trbf_scale", f32::NEG_INFINITY), ("f_dc_4", f32::NAN)]
    {
        fs::write(&path, ply(&properties(true), 3, |of, i| if (of, i) == (name, 1) { wrong } else { value(of, i) }))
            .unwrap();
        let message = refusal(&path);
        assert!(message.contains(&format!("Gaussian 1, {name}")) && message.contains("finite"), "{message}");
    }
    // Without a model folder, nothing names the last function of the network, and the model opens with a note. A model
    // without Gaussians opens too.
    fs::write(&path, ply(&properties(true), 3, value)).unwrap();
    assert!(open(&path).unwrap().description().notes.iter().any(|note| note.contains("sandwich")));
    fs::write(&path, ply(&properties(false), 0, value)).unwrap();
    assert_eq!(open_with_frames(&path).source().info().count, 0);
}

#[test]
fn truncated_and_invalid_files_are_refused() {
    let root = folder(true);
    let iteration = root.path().join("point_cloud/iteration_300");
    let whole = |name: &str| fs::read(iteration.join(name)).unwrap();
    let (cloud, network) = (whole(POINT_CLOUD_FILE), whole(DECODER));
    let start = cloud.windows(10).position(|bytes| bytes == b"end_header").unwrap();
    for length in (start..cloud.len()).step_by(13) {
        fs::write(iteration.join(POINT_CLOUD_FILE), &cloud[..length]).unwrap();
        let message = refusal(root.path());
        assert!(message.contains("point_cloud.ply"), "{length}: {message}");
    }
    fs::write(iteration.join(POINT_CLOUD_FILE), &cloud).unwrap();
    for length in (0..network.len()).step_by(7) {
        fs::write(iteration.join(DECODER), &network[..length]).unwrap();
        let message = refusal(root.path());
        assert!(message.contains("point_cloud.pt"), "{length}: {message}");
    }
    fs::remove_file(iteration.join(DECODER)).unwrap();
    let missing = refusal(root.path());
    assert!(missing.contains("point_cloud.pt") && missing.contains("no such file"), "{missing}");
    fs::write(iteration.join(DECODER), &network).unwrap();
    for (arguments, expected) in [
        ("Namespace(rgbfunction='rgbv1')", "sandwichnoactss"),
        ("Namespace(rgbfunction=3)", "a string"),
        ("Namespace(duration=0)", "at least 1"),
        ("Namespace(rgbfunction='sand", "cfg_args"),
    ] {
        fs::write(root.path().join(CFG_ARGS), arguments).unwrap();
        let message = refusal(root.path());
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn archives_restore_folders_and_splatv_files() {
    let options = OpenOptions::default();
    for is_full in [false, true] {
        let root = folder(is_full);
        let model = open_with_frames(root.path());
        let kind = check_round_trip(&*model, &compressed(&*model), &options, 1e-3);
        assert_eq!(kind, OutputKind::Model);
        let alone = root.path().join("alone.ply");
        fs::copy(root.path().join("point_cloud/iteration_300").join(POINT_CLOUD_FILE), &alone).unwrap();
        if !is_full {
            let alone = open_with_frames(&alone);
            assert_eq!(check_round_trip(&*alone, &compressed(&*alone), &options, 1e-3), OutputKind::Ply);
            let path = root.path().join("a.splatv");
            let all = CompressedModel::pruned((0..COUNT as u32).collect(), &Recipe::preset("default").unwrap().merge);
            model.write(&all, OutputKind::Splatv, &path, &Limits::NONE, &Events::IGNORED).unwrap();
            // Some values of the file are halves, which the merged Gaussian of the compressed model is not.
            let kept = CompressedModel::pruned(vec![0, 3, 6], &Recipe::preset("default").unwrap().merge);
            let kind = check_round_trip(&*open_with_frames(&path), &kept, &options, 2e-3);
            assert_eq!(kind, OutputKind::Splatv);
        }
    }
}
