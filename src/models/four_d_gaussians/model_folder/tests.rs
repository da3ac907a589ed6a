use std::collections::BTreeMap;
use std::fs;

use super::*;
use crate::model::Gradients;
use crate::passes::gather;

/// Returns the path of the trained model `name` in the folder `SPLATSIEVE_DATA`, else in `../shared/data`. The folder
/// must exist.
fn shared_model(name: &str) -> PathBuf {
    let folder = std::env::var_os("SPLATSIEVE_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from)
        .join(name);
    assert!(folder.is_dir(), "no trained model at {} (SPLATSIEVE_DATA)", folder.display());
    folder
}

/// Reads a 3DGS PLY file of float properties in the canonical order with SH degree 3, which is the layout of the test
/// models.
fn read_cloud(path: &Path) -> Gaussians {
    let bytes = fs::read(path).unwrap();
    let mark = b"end_header\n";
    let body = bytes.windows(mark.len()).position(|w| w == mark).unwrap() + mark.len();
    let values: Vec<f32> = bytes[body..].as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
    let rows: Vec<&[f32]> = values.chunks_exact(62).collect();
    let mut cloud = Gaussians::zeros(rows.len(), 3);
    for (i, row) in rows.iter().enumerate() {
        cloud.position.set_row(i, [row[0], row[1], row[2]]);
        for channel in 0..3 {
            cloud.sh.plane_mut(channel)[i] = row[6 + channel];
            for k in 1..16 {
                cloud.sh.plane_mut(3 * k + channel)[i] = row[9 + channel * 15 + k - 1];
            }
        }
        cloud.opacity_logit.set_row(i, [row[54]]);
        cloud.log_scale.set_row(i, [row[55], row[56], row[57]]);
        cloud.rotation.set_row(i, [row[58], row[59], row[60], row[61]]);
    }
    cloud
}

fn load(name: &str) -> (PathBuf, ModelFolder) {
    let root = shared_model(name);
    let paths = ModelPaths::locate(&root, None).unwrap();
    let cloud = read_cloud(&paths.point_cloud);
    (root, ModelFolder::with_gaussians(paths, cloud, 3, ReadLimit::NONE).unwrap())
}

/// Reads every array of an npz as f64.
fn read_npz(path: &Path) -> BTreeMap<String, Vec<f64>> {
    let mut archive = npyz::npz::NpzArchive::open(path).unwrap();
    let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    let mut arrays = BTreeMap::new();
    for name in names {
        let file = archive.by_name(&name).unwrap().unwrap();
        let values = match file.dtype().descr().as_str() {
            "'<f4'" => file.into_vec::<f32>().unwrap().into_iter().map(f64::from).collect(),
            "'<i8'" => file.into_vec::<i64>().unwrap().into_iter().map(|v| v as f64).collect(),
            _ => file.into_vec::<f64>().unwrap(),
        };
        arrays.insert(name, values);
    }
    arrays
}

fn close(what: &str, got: f64, expected: f64, tolerance: f64) {
    assert!((got - expected).abs() <= tolerance, "{what}: got {got}, expected {expected}, tolerance {tolerance}");
}

fn states_agree(name: &str) {
    let (root, model) = load(name);
    let arrays = read_npz(&root.join("states.npz"));
    let times = arrays["times"].clone();
    let model = model.with_times(times.clone()).unwrap();
    let n = model.info().count;
    let extent = (0..3)
        .map(|c| {
            let plane = model.canonical().position.plane(c);
            f64::from(plane.iter().fold(f32::MIN, |a, &b| a.max(b)) - plane.iter().fold(f32::MAX, |a, &b| a.min(b)))
        })
        .fold(0.0, f64::max);
    let mut reader = model.open(Ids::Range(0..n)).unwrap();
    let mut state = Gaussians::zeros(0, 3);
    let mut worst = [0f64; 5];
    for (frame, t) in arrays["frames"].iter().enumerate() {
        reader.read(frame, Attributes::all(), &mut state).unwrap();
        for i in 0..n {
            let row = frame * n + i;
            let at = |what: &str| format!("{name}, {what} of Gaussian {i} at frame {t}");
            let p: [f32; 3] = state.position.row(i);
            let s: [f32; 3] = state.log_scale.row(i);
            for c in 0..3 {
                let expected = arrays["xyz"][3 * row + c];
                worst[0] = worst[0].max((f64::from(p[c]) - expected).abs() / extent);
                close(&at("position"), f64::from(p[c]), expected, 1e-5 * extent);
                let expected = arrays["scales"][3 * row + c];
                let got = f64::from(s[c]).exp();
                worst[1] = worst[1].max((got - expected).abs() / expected);
                close(&at("scale"), got, expected, 1e-5 * expected);
            }
            let q = state.rotation_f64(i);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            for c in 0..4 {
                let expected = arrays["rotation"][4 * row + c];
                worst[2] = worst[2].max((q[c] / length - expected).abs());
                close(&at("rotation"), q[c] / length, expected, 2e-5);
            }
            let [logit] = state.opacity_logit.row(i).map(f64::from);
            let expected = arrays["opacity"][row];
            let got = 1.0 / (1.0 + (-logit).exp());
            worst[3] = worst[3].max((got - expected).abs() / expected);
            close(&at("opacity"), got, expected, 1e-5 * expected);
            if let Some(sh) = arrays.get(&format!("sh_t{t}")) {
                for k in 0..48 {
                    let got = f64::from(state.sh.plane(k)[i]);
                    worst[4] = worst[4].max((got - sh[48 * i + k]).abs());
                    close(&at("SH"), got, sh[48 * i + k], 2e-5);
                }
            }
        }
    }
    eprintln!("{name}: worst position/extent, scale, rotation, opacity, SH: {worst:?}");
}

#[test]
#[ignore = "needs the trained models"]
fn states_of_deform2_agree_with_the_original_code() {
    states_agree("deform2");
}

#[test]
#[ignore = "needs the trained models"]
fn states_of_room2_dynerf_agree_with_the_original_code() {
    states_agree("room2_dynerf");
}

#[test]
#[ignore = "needs the trained models"]
fn states_of_room2_big_agree_with_the_original_code() {
    states_agree("room2_big");
}

#[test]
#[ignore = "needs the trained models"]
fn any_list_of_gaussians_reads_the_bits_of_the_whole() {
    let (_, model) = load("deform2");
    let model = model.with_times(vec![0.0, 0.5]).unwrap();
    let n = model.info().count;
    let read = |ids: Ids<'_>, frame| {
        let mut state = Gaussians::zeros(0, 3);
        model.open(ids).unwrap().read(frame, Attributes::all(), &mut state).unwrap();
        state
    };
    let whole = read(Ids::Range(0..n), 1);
    let mut reader = model.open_all(&ReadPlan::new([0, 1])).unwrap().unwrap();
    let mut state = Gaussians::zeros(0, 3);
    let before = model.reads().states;
    (0..2).for_each(|frame| reader.read(frame, Attributes::all(), &mut state).unwrap());
    assert!(state == whole, "the reader of several frames gives other values");
    assert_eq!(model.reads().states - before, 2 * n as u64);
    let list: Vec<u32> = (0..n as u32).rev().step_by(37).collect();
    let part = std::thread::scope(|scope| scope.spawn(|| read(Ids::List(&list), 1)).join().unwrap());
    for column in Attributes::all().iter() {
        for c in 0..whole.attribute_values(column).width() {
            for (at, &id) in list.iter().enumerate() {
                let (got, expected) =
                    (part.attribute_values(column).plane(c)[at], whole.attribute_values(column).plane(c)[id as usize]);
                assert_eq!(got.to_bits(), expected.to_bits(), "{} of Gaussian {id}: {got}, {expected}", column.name());
            }
        }
    }
}

#[test]
#[ignore = "needs the trained models"]
fn columns_that_do_not_vary_are_the_canonical_ones() {
    let (_, model) = load("deform2");
    let model = model.with_times(vec![0.25]).unwrap();
    assert_eq!(model.info().varying, Attributes::POSITION | Attributes::LOG_SCALE | Attributes::ROTATION);
    let mut state = Gaussians::zeros(0, 3);
    model.open(Ids::Range(0..100)).unwrap().read(0, Attributes::OPACITY | Attributes::SH, &mut state).unwrap();
    for i in 0..100 {
        assert_eq!(state.opacity_logit.row::<1>(i), model.canonical().opacity_logit.row::<1>(i));
        assert_eq!(state.sh.row::<48>(i), model.canonical().sh.row::<48>(i));
    }
}

#[test]
#[ignore = "needs the trained models"]
fn deltas_at_the_canonical_positions_lead_to_the_states() {
    let (_, model) = load("room2_dynerf");
    let deltas = model.deltas_at(&model.canonical().position, 0.3).unwrap();
    let model = model.with_times(vec![0.3]).unwrap();
    let mut state = Gaussians::zeros(0, 3);
    model.open(Ids::Range(0..model.info().count)).unwrap().read(0, Attributes::all(), &mut state).unwrap();
    let mut applied = Gaussians::zeros(0, 3);
    deltas.apply(model.canonical(), Attributes::all(), &mut applied);
    assert!(applied == state, "apply(deltas_at) differs from read");
}

#[test]
#[ignore = "needs the trained models"]
fn times_that_do_not_increase_are_refused_with_their_frames() {
    let (_, model) = load("deform2");
    for (times, says) in [
        (vec![0.0, 0.5, 0.5], "frame 1 has 0.5, frame 2 has 0.5"),
        (vec![0.5, 0.25], "frame 0 has 0.5, frame 1 has 0.25"),
        (vec![0.0, f64::NAN], "the time of frame 1 is NaN"),
    ] {
        let error = model.clone().with_times(times).expect_err("must be refused").to_string();
        assert!(error.contains(says), "{error}");
    }
    let model = model.with_times(vec![0.0]).unwrap();
    assert!(model.open(Ids::List(&[1 << 30])).is_err(), "a Gaussian beyond the last");
    let mut reader = model.open(Ids::Range(0..1)).unwrap();
    assert!(reader.read(1, Attributes::all(), &mut Gaussians::zeros(0, 3)).is_err(), "a frame beyond the last");
}

/// Creates a model folder with one subfolder for each name in `iterations`. The files are placeholders without a model.
fn folder(iterations: &[&str]) -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    fs::write(root.path().join("cfg_args"), "Namespace()").unwrap();
    for name in iterations {
        let folder = root.path().join("point_cloud").join(name);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("point_cloud.ply"), "ply").unwrap();
        fs::write(folder.join("deformation.pth"), "pth").unwrap();
    }
    root
}

#[test]
fn default_is_the_largest_iteration() {
    let root = folder(&["iteration_900", "iteration_14000", "iteration_x", "coarse_iteration_99999"]);
    assert_eq!(ModelPaths::locate(root.path(), None).unwrap().iteration, 14000);
    let paths = ModelPaths::locate(root.path(), Some(900)).unwrap();
    assert!(paths.point_cloud.ends_with("iteration_900/point_cloud.ply"));
    assert_eq!(paths.deformation_table, None);
    let error = ModelPaths::locate(root.path(), Some(7)).expect_err("must be refused").to_string();
    assert!(error.contains("iteration_7") && error.contains("iteration_900, iteration_14000"), "{error}");
}

#[test]
fn missing_file_of_the_folder_is_named() {
    let root = folder(&["iteration_1"]);
    for file in ["point_cloud/iteration_1/deformation.pth", "cfg_args"] {
        fs::remove_file(root.path().join(file)).unwrap();
        let error = ModelPaths::locate(root.path(), None).expect_err("must be refused").to_string();
        assert!(error.contains(file) && error.contains("model folder holds"), "{error}");
        fs::write(root.path().join(file), "").unwrap();
    }
    let error = ModelPaths::locate(&root.path().join("nowhere"), None).expect_err("must be refused");
    assert!(matches!(error, Error::Io { .. }), "{error}");
}

#[test]
fn digest_depends_on_all_three_files() {
    let root = folder(&["iteration_1"]);
    let paths = ModelPaths::locate(root.path(), None).unwrap();
    let mut digests = vec![paths.digest().unwrap()];
    for path in [&paths.point_cloud, &paths.deformation, &paths.cfg_args] {
        fs::write(path, "changed").unwrap();
        digests.push(paths.digest().unwrap());
    }
    assert!(digests.iter().all(|digest| digest.len() == 32), "{digests:?}");
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), 4, "{digests:?}");
}

#[test]
fn jacobian_agrees_with_differences_on_any_thread_count() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model");
    let model = ModelFolder::open(&root, None).unwrap().with_times(vec![0.0, 0.4, 1.0]).unwrap();
    let n = model.info().count;
    let mut by_state = Gradients::new(n, Attributes::all(), 3);
    for column in Attributes::all().iter() {
        // Low-discrepancy values serve as noise.
        let sums = by_state.derivatives_mut(column).planes_mut().iter_mut().enumerate();
        sums.for_each(|(k, sum)| *sum = (k as f32 * 0.618_034).fract() - 0.5);
    }
    let mut by_raw = by_state.clone();
    let jacobian = model.with_params(model.stored()).jacobian(1, Attributes::all()).unwrap();
    jacobian.pull_back(&mut by_raw);
    for threads in [1, 2, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let again = pool.install(|| model.with_params(model.stored()).jacobian(1, Attributes::all())).unwrap();
        assert!(again == jacobian, "{threads} threads");
    }
    for column in Attributes::all().difference(Attributes::POSITION).iter() {
        assert!(by_raw.derivatives(column) == by_state.derivatives(column), "{} follows the field", column.name());
    }

    let weights = by_state.derivatives(Attributes::POSITION);
    let (mut off, mut through_field) = (0, 0);
    for axis in 0..3 {
        let placed = |step: f32| {
            let mut moved = model.canonical().clone();
            moved.position.plane_mut(axis).iter_mut().for_each(|x| *x += step);
            let state = gather(
                &model.with_canonical(moved.clone()),
                &(0..n as u32).collect::<Vec<_>>(),
                1,
                Attributes::POSITION,
            );
            (moved.position, state.unwrap().position)
        };
        let ((low, at_low), (high, at_high)) = (placed(-2e-4), placed(2e-4));
        for i in 0..n {
            let apart = f64::from(high.plane(axis)[i]) - f64::from(low.plane(axis)[i]);
            let change = |c: usize| f64::from(at_high.plane(c)[i]) - f64::from(at_low.plane(c)[i]);
            let expected = (0..3).map(|c| f64::from(weights.plane(c)[i]) * change(c)).sum::<f64>() / apart;
            let got = f64::from(by_raw.derivatives(Attributes::POSITION).plane(axis)[i]);
            // States are f32: an error of about 1e-7 over 4e-4, times three.
            off += usize::from((got - expected).abs() > 3e-3 * (1.0 + expected.abs()));
            through_field += usize::from((got - f64::from(weights.plane(axis)[i])).abs() > 1e-2);
        }
    }
    // Within a step some positions cross the edge of a texel, or an input of a ReLU changes its sign; there the
    // derivative is not unique.
    assert!(off * 50 < 3 * n, "{off} of {} derivatives are off", 3 * n);
    assert!(through_field > n, "the field adds to {through_field} of {} derivatives only", 3 * n);
    assert!(model.with_params(model.stored()).jacobian(3, Attributes::all()).is_err(), "there are three frames");
}
