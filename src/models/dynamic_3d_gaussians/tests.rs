use std::fs::{self, File};

use npyz::WriterBuilder;
use npyz::npz::NpzWriter;
use proptest::prelude::*;
use zip::CompressionMethod;
use zip::write::FileOptions;

use super::*;
use crate::compressed_model::ParamDelta;
use crate::models;
use crate::models::OpenOptions;
use crate::models::archive::checks::check_round_trip;
use crate::passes::gather_all;
use crate::progress::Events;
use crate::recipe::Recipe;

/// Name, shape and values of each array of a model.
type Arrays = Vec<(&'static str, Vec<u64>, Vec<f32>)>;

/// Returns the arrays of a model with three frames of five Gaussians; the last two Gaussians are in the foreground.
fn arrays() -> Arrays {
    let ramp = |n: usize, from: f32, by: f32| (0..n).map(|i| from + by * (i % 17) as f32).collect::<Vec<f32>>();
    vec![
        ("means3D", vec![3, 5, 3], ramp(45, -1.0, 0.1)),
        ("rgb_colors", vec![3, 5, 3], ramp(45, -0.05, 0.07)),
        ("seg_colors", vec![5, 3], [vec![0.0; 9], vec![1.0; 6]].concat()),
        ("unnorm_rotations", vec![3, 5, 4], ramp(60, 0.5, 0.03)),
        ("logit_opacities", vec![5, 1], ramp(5, -1.0, 0.5)),
        ("log_scales", vec![5, 3], ramp(15, -4.0, 0.1)),
        ("cam_m", vec![2, 3], ramp(6, 0.0, 0.01)),
    ]
}

fn write(path: &Path, arrays: &Arrays, method: CompressionMethod) {
    let mut npz = NpzWriter::new(File::create(path).unwrap());
    for (name, shape, values) in arrays {
        let options = FileOptions::default().compression_method(method);
        let array = npz.array::<f32>(name, options).unwrap().default_dtype().shape(shape);
        let mut array = array.begin_nd().unwrap();
        array.extend(values.iter().copied()).unwrap();
        array.finish().unwrap();
    }
}

fn open(path: &Path) -> Result<Box<dyn InputModel>> {
    models::open(path, &OpenOptions { scratch: path.parent().map(Path::to_owned), ..OpenOptions::default() })
        .and_then(models::Opened::into_linked)
}

fn message(path: &Path) -> String {
    open(path).err().expect("it must be refused").to_string()
}

fn states(model: &dyn InputModel) -> Vec<Gaussians> {
    let source = model.source();
    (0..source.info().times.len()).map(|frame| gather_all(source, frame, Attributes::all()).unwrap()).collect()
}

#[test]
fn states_are_the_array_values_compressed_or_not() {
    let folder = tempfile::tempdir().unwrap();
    let [stored, small] = ["params.npz", "small.npz"].map(|name| folder.path().join(name));
    write(&stored, &arrays(), CompressionMethod::Stored);
    write(&small, &arrays(), CompressionMethod::Deflated);
    let model = open(folder.path()).unwrap();
    assert_eq!((model.description().kind, model.source().info().count), ("Dynamic3DGaussians model", 5));
    assert_eq!(model.source().info().times, [0.0, 0.5, 1.0]);
    let (found, arrays) = (states(&*model), arrays());
    for (frame, state) in found.iter().enumerate() {
        for id in 0..5 {
            let at = frame * 5 + id;
            assert_eq!(state.position.row::<3>(id), arrays[0].2[3 * at..][..3]);
            assert_eq!(state.rotation.row::<4>(id), arrays[3].2[4 * at..][..4]);
            assert_eq!(state.opacity_logit.row::<1>(id), arrays[4].2[id..][..1]);
            assert_eq!(state.log_scale.row::<3>(id), arrays[5].2[3 * id..][..3]);
            let colors = state.sh.row::<3>(id).map(color_from_sh);
            colors
                .iter()
                .zip(&arrays[1].2[3 * at..])
                .for_each(|(a, b)| assert!((a - f64::from(*b)).abs() < 1e-7, "{a} {b}"));
        }
    }
    assert_eq!(states(&*open(&small).unwrap()), found);
    assert_eq!((0..5).map(|id| model.merge_class(id)).collect::<Vec<_>>(), [0, 0, 0, 1, 1]);
}

/// Writes the test model to the `.npz` file `path`, with the array `log_scales` as f64. `kind` is the NumPy type of
/// this array with its byte order, such as `<f8`, and `order` the order of its elements (C or Fortran).
fn write_with_doubles(arrays: &Arrays, path: &Path, kind: &str, order: npyz::Order) {
    let mut npz = NpzWriter::new(File::create(path).unwrap());
    for (name, shape, values) in arrays {
        let options = FileOptions::default().compression_method(CompressionMethod::Stored);
        if *name == "log_scales" {
            let dtype = npyz::DType::Plain(kind.parse().unwrap());
            let array = npz.array::<f64>(name, options).unwrap().dtype(dtype).order(order).shape(shape);
            let mut array = array.begin_nd().unwrap();
            array.extend(values.iter().map(|&x| f64::from(x))).unwrap();
            array.finish().unwrap();
        } else {
            let mut array = npz.array::<f32>(name, options).unwrap().default_dtype().shape(shape).begin_nd().unwrap();
            array.extend(values.iter().copied()).unwrap();
            array.finish().unwrap();
        }
    }
}

#[test]
fn doubles_of_both_byte_orders_in_an_npz_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("params.npz");
    write(&path, &arrays(), CompressionMethod::Stored);
    let expected = states(&*open(&path).unwrap());
    for kind in ["<f8", ">f8"] {
        write_with_doubles(&arrays(), &path, kind, npyz::Order::C);
        assert!(states(&*open(&path).unwrap()) == expected, "{kind}");
    }
    write_with_doubles(&arrays(), &path, "<f8", npyz::Order::Fortran);
    let message = message(&path);
    assert!(message.contains("log_scales") && message.contains("ascontiguousarray"), "{message}");
}

#[test]
fn infinite_opacity_logits_of_an_npz_are_clamped() {
    let folder = tempfile::tempdir().unwrap();
    let mut odd = arrays();
    (odd[4].2[1], odd[4].2[3]) = (f32::INFINITY, f32::NEG_INFINITY);
    write(&folder.path().join("params.npz"), &odd, CompressionMethod::Stored);
    let logits = states(&*open(folder.path()).unwrap())[0].opacity_logit.plane(0).to_vec();
    assert_eq!(logits, [-1.0, 100.0, 0.0, -100.0, 1.0]);
}

#[test]
fn kept_rows_keep_their_bytes() {
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("params.npz");
        write(&path, &arrays(), method);
        let model = open(&path).unwrap();
        let rule = Recipe::preset("default").unwrap().merge;
        let result = folder.path().join("result");
        let limits = Limits::NONE;
        let written = |compressed: &CompressedModel| {
            _ = fs::remove_dir_all(&result);
            fs::create_dir(&result).unwrap();
            model.write(compressed, OutputKind::Model, &result, &limits, &Events::IGNORED).unwrap();
            fs::read(result.join(FILE)).unwrap()
        };
        let read_array = |name: &str| {
            let mut npz = npyz::npz::NpzArchive::open(result.join(FILE)).unwrap();
            let array = npz.by_name(name).unwrap().unwrap();
            (array.shape().to_vec(), array.into_vec::<f32>().unwrap())
        };
        written(&CompressedModel::pruned(vec![1, 4], &rule));
        for (name, shape, values) in arrays() {
            let (found_shape, found) = read_array(name);
            let (outer, width) =
                (if shape.len() == 3 { shape[0] as usize } else { 1 }, *shape.last().unwrap() as usize);
            let expected: Vec<f32> = match name {
                "cam_m" => values,
                _ => {
                    let row = |frame: usize, id: usize| values[(frame * 5 + id) * width..][..width].to_vec();
                    (0..outer).flat_map(|frame| [row(frame, 1), row(frame, 4)].concat()).collect()
                }
            };
            assert_eq!(found_shape.iter().product::<u64>(), expected.len() as u64, "{name}");
            let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&found), bits(&expected), "{name}");
        }
        // Writing all Gaussians keeps the values of every array and gives the same file each time.
        let all = CompressedModel::pruned((0..5).collect(), &rule);
        assert_eq!(written(&all), written(&all));
        assert_eq!(states(&*open(&result).unwrap()), states(&*model));
    }
}

#[test]
fn written_proxies_and_deltas_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("params.npz");
    write(&path, &arrays(), CompressionMethod::Stored);
    let model = open(&path).unwrap();
    let rule = Recipe::preset("default").unwrap().merge;
    let cluster = Cluster { output: 1, leader: 3, members: vec![(3, 0.75), (4, 0.25)] };
    let proxies = model.compute_proxies(std::slice::from_ref(&cluster), ReferenceFrame::default(), &rule).unwrap();
    let mut by = Gaussians::zeros(3, 0);
    by.position.set_row(0, [0.5, 0.0, -0.25]);
    by.sh.set_row(2, [0.1, 0.2, 0.0]);
    let pruned = CompressedModel::pruned(vec![0, 3, 4], &rule);
    let compressed = CompressedModel { clusters: vec![cluster], proxies, delta: ParamDelta(by), ..pruned };
    let shown = model.compressed_frames(&compressed).unwrap();
    let result = folder.path().join("result");
    fs::create_dir(&result).unwrap();
    model.write(&compressed, OutputKind::Model, &result, &Limits::NONE, &Events::IGNORED).unwrap();
    let read = open(&result).unwrap();
    for (frame, state) in states(&*read).iter().enumerate() {
        let expected = gather_all(&*shown, frame, Attributes::all()).unwrap();
        for column in Attributes::all().iter() {
            let pairs = state.attribute_values(column).planes().iter().zip(expected.attribute_values(column).planes());
            pairs.for_each(|(a, b)| assert!((a - b).abs() < 1e-6, "{} {a} {b}", column.name()));
        }
        // A proxy is at the weighted mean of its members.
        let at = |id: usize| gather_all(model.source(), frame, Attributes::all()).unwrap().position.row::<3>(id);
        let mean: [f32; 3] = std::array::from_fn(|c| 0.75 * at(3)[c] + 0.25 * at(4)[c]);
        let found = state.position.row::<3>(1);
        (0..3).for_each(|c| assert!((found[c] - mean[c]).abs() < 1e-6, "{found:?} {mean:?}"));
    }
    assert!(!shown.info().varying.intersects(Attributes::LOG_SCALE | Attributes::OPACITY));
}

#[test]
fn errors_name_the_array_and_the_problem() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("params.npz");
    let error_of = |change: &dyn Fn(&mut Arrays)| {
        let mut arrays = arrays();
        change(&mut arrays);
        write(&path, &arrays, CompressionMethod::Stored);
        message(&path)
    };
    let missing = error_of(&|arrays| drop(arrays.remove(3)));
    assert!(missing.contains("unnorm_rotations") && missing.contains("params.npz"), "{missing}");
    let fewer = error_of(&|arrays| {
        arrays[5].1 = vec![4, 3];
        arrays[5].2.truncate(12);
    });
    assert!(fewer.contains("log_scales") && fewer.contains("[5, 3]") && fewer.contains("[4, 3]"), "{fewer}");
    let flat = error_of(&|arrays| {
        arrays[0].1 = vec![15, 3];
        arrays.push(("cam_unnorm_rots", vec![1], vec![0.0]));
    });
    assert!(flat.contains("SplaTAM"), "{flat}");
    let none = error_of(&|arrays| {
        arrays[0].1 = vec![0, 5, 3];
        arrays[0].2.clear();
    });
    assert!(none.contains("T at least 1"), "{none}");
    write(&path, &arrays(), CompressionMethod::Stored);
    let times = open(&path).unwrap().with_times(vec![0.0, 1.0]).err().unwrap().to_string();
    assert!(times.contains("2 times") && times.contains("3 frames"), "{times}");
}

#[test]
fn truncated_files_and_huge_shapes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("params.npz");
    write(&path, &arrays(), CompressionMethod::Stored);
    let whole = fs::read(&path).unwrap();
    for length in (0..whole.len()).step_by(7) {
        fs::write(&path, &whole[..length]).unwrap();
        message(&path);
    }
    let at = whole.windows(8).position(|bytes| bytes == b"(3, 5, 3").unwrap();
    let mut wide = whole.clone();
    wide[at..at + 8].copy_from_slice(b"(9999999");
    fs::write(&path, &wide).unwrap();
    message(&path);
}

proptest! {
    #[test]
    fn flipped_bytes_never_panic(flips in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4)) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("params.npz");
        write(&path, &arrays(), CompressionMethod::Deflated);
        let mut bytes = fs::read(&path).unwrap();
        for (at, to) in flips {
            let at = at.index(bytes.len());
            bytes[at] = to;
        }
        fs::write(&path, bytes).unwrap();
        if let Ok(model) = open(&path) {
            states(&*model);
        }
    }
}

#[test]
fn archives_restore_model_folders() {
    let folder = tempfile::tempdir().unwrap();
    let rule = Recipe::preset("default").unwrap().merge;
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        write(&folder.path().join("params.npz"), &arrays(), method);
        let model = open(folder.path()).unwrap();
        let kept = CompressedModel::pruned(vec![0, 2, 4], &rule);
        assert_eq!(check_round_trip(&*model, &kept, &OpenOptions::default(), 1e-4), OutputKind::Model);
    }
}

#[test]
fn damaged_values_of_an_npz_are_found_by_their_checksum() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("params.npz");
    // Arrays of more bytes than are read for their headers.
    let enlarged = |(name, shape, _): (&'static str, Vec<u64>, Vec<f32>)| {
        let shape: Vec<u64> = shape.into_iter().map(|length| if length == 5 { 6000 } else { length }).collect();
        let values = (0..shape.iter().product()).map(|i: u64| 0.1 + 0.05 * (i % 17) as f32).collect();
        (name, shape, values)
    };
    let arrays: Arrays = arrays().into_iter().map(enlarged).collect();
    let assert_found = |name: &str| {
        let mut bytes = fs::read(&path).unwrap();
        let at = bytes.windows(name.len()).position(|part| part == name.as_bytes()).unwrap();
        bytes[at + 20_000] ^= 4;
        fs::write(&path, &bytes).unwrap();
        let message = message(&path);
        let expected = format!("params.npz, {name}: expected bytes with the checksum ");
        assert!(message.contains(&expected) && message.contains(", found "), "{message}");
    };
    for name in ["means3D", "log_scales"] {
        write(&path, &arrays, CompressionMethod::Stored);
        assert_found(name);
    }
    write_with_doubles(&arrays, &path, "<f8", npyz::Order::C);
    assert_found("log_scales");
}
