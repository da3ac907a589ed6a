//! Tests of archives (`.gsz`): how they are written, converted to other formats and read as input, and how damaged
//! archives are refused.

use std::fs;
use std::path::Path;

use crate::scene::{PlyRows, Workplace, bits, files, index_map, lasting_files, shared, state, tiny};
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::models::{InputModel, ModelFolder};
use splatsieve::outputs::container::write_container;

/// Arguments of a run that writes the tiny model as an archive without refinement. Renders of the archive shall have a
/// PSNR of 50 dB against the compressed model before quantization.
const TINY: &str = "{tiny} --cameras {tiny} --ratio 0.5 --no-refine --prune-only --archive-psnr 50";

/// Returns a workplace with `small.gsz`, the archive of the tiny model, and the summary of the run.
fn with_archive() -> (Workplace, serde_json::Value) {
    let workplace = Workplace::new();
    let summary = workplace.summary(&format!("{TINY} -o small.gsz"));
    (workplace, summary)
}

fn model(folder: &Path) -> ModelFolder {
    ModelFolder::open(folder, None).unwrap().with_times(vec![0.0, 0.4, 1.0]).unwrap()
}

fn point_cloud(folder: &Path) -> PlyRows {
    let found = files(folder).into_keys().find(|name| name.ends_with("point_cloud.ply")).unwrap();
    PlyRows::read(&folder.join(found))
}

#[test]
fn archive_unpacks_to_a_model_folder_at_the_asked_psnr() {
    let (workplace, summary) = with_archive();
    let archive = &summary["archive"];
    assert!(archive["psnr"].as_f64().unwrap() >= 50.0, "{archive}");
    let bytes = fs::metadata(workplace.path("small.gsz")).unwrap().len();
    let parts = ["cloud", "field", "rest"].map(|part| archive["parts"][part].as_u64().unwrap());
    assert_eq!((parts.iter().sum::<u64>(), summary["output_bytes"].as_u64()), (bytes, Some(bytes)));

    workplace.done("convert small.gsz small");
    let names =
        |folder: &Path| -> Vec<_> { files(folder).into_keys().filter(|name| name.extension().is_some()).collect() };
    let unpacked = workplace.path("small");
    let has = |name: &str| names(&unpacked).iter().any(|found| found.ends_with(name));
    assert!(has("point_cloud.ply") && has("deformation.pth"), "{:?}", names(&unpacked));
    // Archives are made to be shared: of the folders on the training machine they keep only the last path component.
    let trained = fs::read_to_string(tiny().join("cfg_args")).unwrap();
    let expected = trained.replace("model_path='output/tiny'", "model_path='tiny'");
    assert!(expected != trained);
    assert_eq!(fs::read_to_string(unpacked.join("cfg_args")).unwrap(), expected);
    let (before, after) = (point_cloud(&tiny()), point_cloud(&unpacked));
    assert_eq!(before.names, after.names);
    assert_eq!(summary["gaussians"], after.rows.len());

    // Every Gaussian is at the place that the index map gives, and properties other than attributes are kept.
    let map = index_map(&workplace.path("small.gsz.index_map.npy"));
    let extent = (0..before.rows.len()).map(|i| before.value(i, "x").abs()).fold(0.0, f32::max);
    let mut places: Vec<i64> = map.iter().copied().filter(|&place| place >= 0).collect();
    for (id, &place) in map.iter().enumerate().filter(|(_, place)| **place >= 0) {
        for name in ["x", "y", "z"] {
            let off = (before.value(id, name) - after.value(place as usize, name)).abs();
            assert!(off < 0.02 * extent, "{name} of Gaussian {id}, now {place}: off by {off} of {extent}");
        }
        assert_eq!(before.value(id, "nx").to_bits(), after.value(place as usize, "nx").to_bits());
    }
    places.sort_unstable();
    assert!(places.iter().copied().eq(0..after.rows.len() as i64));
}

#[test]
fn archive_reads_like_the_folder_it_unpacks_to() {
    let (workplace, _) = with_archive();
    workplace.done("convert small.gsz small");
    let folder = model(&workplace.path("small"));
    let archive =
        splatsieve::models::open(&workplace.path("small.gsz"), &Default::default()).unwrap().into_linked().unwrap();
    assert_eq!(archive.description().kind, "gsz archive");
    let archive = archive.with_times(vec![0.0, 0.4, 1.0]).unwrap();
    for frame in 0..3 {
        let (a, b) = (state(archive.source(), frame), state(InputModel::source(&folder), frame));
        assert!((0..a.len()).all(|i| bits(&a, i) == bits(&b, i)), "frame {frame}");
    }
    drop(archive);
    let evaluated = |path: &str| -> serde_json::Value {
        serde_json::from_str(&workplace.done(&format!("evaluate {{tiny}} {path} --cameras {{tiny}} --json"))).unwrap()
    };
    assert_eq!(evaluated("small.gsz")["psnr"], evaluated("small")["psnr"]);
    workplace.done("render small.gsz --cameras {tiny} --all -o renders");
    workplace.done("info small.gsz");
    workplace.done("compress small.gsz --cameras {tiny} --ratio 0.5 --no-refine --prune-only -o smaller");
    assert_eq!(
        point_cloud(&workplace.path("smaller")).rows.len(),
        point_cloud(&workplace.path("small")).rows.len().div_ceil(2)
    );
    // The decoded scratch folder is removed.
    let left = files(&workplace.path(""));
    assert!(left.keys().all(|name| !name.to_string_lossy().contains("scratch")), "{:?}", left.keys());
}

#[test]
fn archive_bytes_ignore_thread_count() {
    let (one, two) = (Workplace::new(), Workplace::new());
    one.done(&format!("--threads 1 compress {TINY} -o small.gsz"));
    two.done(&format!("--threads 3 compress {TINY} -o small.gsz"));
    assert!(lasting_files(&one.path("")) == lasting_files(&two.path("")));
}

#[test]
fn bytes_of_a_refined_archive_ignore_threads_memory_and_cache() {
    let how = "{tiny} --cameras {tiny} --ratio 0.5 --set refine_steps=40 --set refine_steps_per_prune=10 \
               --set refine_archive_steps=40 -o small.gsz";
    let archive = |before: &str, after: &str| {
        let workplace = Workplace::new();
        workplace.done(&format!("{before} compress {how} {after}"));
        fs::read(workplace.path("small.gsz")).unwrap()
    };
    let expected = archive("--threads 1", "");
    assert!(archive("--threads 3", "") == expected, "threads change it");
    assert!(archive("--threads 2", "--memory 256MiB --cache cache") == expected, "memory or cache change it");
}

#[test]
#[ignore = "needs time"]
fn archive_of_frames_keeps_bounds_and_the_asked_psnr() {
    let workplace = Workplace::new();
    let made = splatsieve::diagnostics::demo_scene::DemoScene::new(1500, 20);
    let raw = gseq::Compression::Raw;
    write_container(&made, &workplace.path("frames.gseq"), raw, Default::default(), |_| ()).unwrap();
    let how = "--ratio 0.5 --no-refine --prune-only";
    let exact = workplace.summary(&format!("frames.gseq {how} -o exact.gseq"));
    let summary = workplace.summary(&format!("frames.gseq {how} -o small.gsz --archive-psnr 45"));
    let [exact_bytes, bytes] = [&exact, &summary].map(|summary| summary["output_bytes"].as_u64().unwrap());
    assert!(4 * bytes < exact_bytes, "{bytes} of {exact_bytes}");
    assert_eq!(fs::metadata(workplace.path("small.gsz")).unwrap().len(), bytes);
    let archive = &summary["archive"];
    assert!(archive["psnr"].as_f64().unwrap() >= 45.0 && archive.get("parts").is_none(), "{archive}");
    // The PSNR measured before writing is that of the file.
    let run = workplace.done("evaluate exact.gseq small.gsz --json");
    let found: serde_json::Value = serde_json::from_str(&run).unwrap();
    let psnr = found["psnr"].as_f64().unwrap_or_else(|| panic!("{found}"));
    assert!((44.0..48.0).contains(&psnr), "{psnr} dB");
    // Every value is within the bound that the summary names.
    let open = |name: &str| {
        splatsieve::models::open(&workplace.path(name), &Default::default()).unwrap().into_linked().unwrap()
    };
    let [before, after] = ["exact.gseq", "small.gsz"].map(open);
    assert_eq!(after.description().kind, "gseq container");
    for frame in [0, 7, 19] {
        let [before, after] = [&before, &after].map(|input| state(input.source(), frame));
        for column in Attributes::all().iter() {
            let bound = archive["bounds"][column.name()].as_f64().unwrap();
            let off = before.attribute_values(column).planes().iter().zip(after.attribute_values(column).planes());
            let off = off.map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).fold(0.0, f64::max);
            assert!(bound > 0.0 && off <= bound, "{} is {off} off, not {bound}", column.name());
        }
    }
    // The bytes depend neither on the number of threads nor on whether frames come from a file or a stream.
    workplace.done(&format!("--threads 3 compress frames.gseq {how} -o three.gsz --archive-psnr 45"));
    let stream = workplace.piped("convert frames.gseq - --quiet", b"").stdout;
    let output = workplace.piped(&format!("compress - {how} -o piped.gsz --archive-psnr 45"), &stream);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let read = |name: &str| fs::read(workplace.path(name)).unwrap();
    assert!(read("three.gsz") == read("small.gsz") && read("piped.gsz") == read("small.gsz"));
    // A target size, and one that is too small.
    let most = bytes / 2;
    let sized = workplace.summary(&format!("frames.gseq --no-refine --prune-only -o sized.gsz --size {most}"));
    assert!((most / 2..=most).contains(&sized["output_bytes"].as_u64().unwrap()), "{sized}");
    workplace.refused(2, "compress frames.gseq -o none.gsz --size 100", &["--size", "expected at least"]);
    // Renders of infinite colors give no error bound.
    let mut broken = state(before.source(), 0);
    broken.sh.planes_mut().fill(f32::INFINITY);
    workplace.ply("broken/0.ply", &broken);
    workplace.ply("broken/1.ply", &broken);
    let refused = ["--set non_finite=drop", ".gseq"];
    workplace.refused(2, "compress broken -o broken.gsz --set non_finite=keep --no-refine --link never", &refused);
    workplace.done("convert small.gsz back");
    let plys = files(&workplace.path("back")).into_keys().filter(|name| name.extension().is_some_and(|e| e == "ply"));
    assert_eq!(plys.count(), 20);
}

#[test]
fn single_ply_returns_with_its_header_and_close_values() {
    let workplace = Workplace::new();
    let mut gaussians = Gaussians::zeros(400, 1);
    let mut seed = 1u64;
    for column in gaussians.selected_attribute_values_mut(splatsieve::model::Attributes::all()) {
        column.planes_mut().iter_mut().for_each(|value| {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            *value = (seed >> 40) as f32 / (1 << 24) as f32 - 0.5;
        });
    }
    gaussians.log_scale.planes_mut().iter_mut().for_each(|value| *value -= 3.0);
    gaussians.rotation.plane_mut(0).fill(1.0);
    let path = workplace.ply("cloud.ply", &gaussians);
    let summary = workplace.summary("cloud.ply --no-refine --prune-only --ratio 1 --archive-psnr 45 -o cloud.gsz");
    assert!(summary["archive"]["psnr"].as_f64().unwrap() >= 45.0, "{}", summary["archive"]);
    workplace.done("convert cloud.gsz back.ply");
    let (before, after) = (PlyRows::read(&path), PlyRows::read(&workplace.path("back.ply")));
    assert_eq!((&before.names, before.rows.len()), (&after.names, after.rows.len()));
    let stored = fs::metadata(workplace.path("cloud.gsz")).unwrap().len();
    assert!(4 * stored < fs::metadata(&path).unwrap().len(), "{stored} bytes");
    let map = index_map(&workplace.path("cloud.gsz.index_map.npy"));
    for (id, &place) in map.iter().enumerate() {
        for (name, most) in [("x", 0.01), ("opacity", 0.5), ("f_dc_1", 0.2)] {
            let off = (before.value(id, name) - after.value(place as usize, name)).abs();
            assert!(off < most, "{name} of Gaussian {id}: {off}");
        }
    }
}

#[test]
fn archive_of_a_splatv_unpacks_to_a_splatv() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 300 --frames 4 -o demo");
    workplace.done("convert demo/scene.gseq curves.splatv");
    let how = "curves.splatv --cameras demo/cameras.json --ratio 0.5 --no-refine --prune-only";
    workplace.done(&format!("compress {how} -o small.splatv"));
    let summary = workplace.summary(&format!("{how} --archive-psnr 45 -o small.gsz"));
    assert!(summary["archive"]["psnr"].as_f64().unwrap() >= 45.0, "{}", summary["archive"]);
    workplace.done("convert small.gsz back.splatv");
    let [stored, before, after] =
        ["small.gsz", "small.splatv", "back.splatv"].map(|name| fs::metadata(workplace.path(name)).unwrap().len());
    assert!(3 * stored < before && after.abs_diff(before) < 2000, "{stored} bytes of {before}, {after} restored");
    let psnr = |path: &str| {
        let told = workplace.done(&format!("evaluate small.splatv {path} --cameras demo/cameras.json --json"));
        serde_json::from_str::<serde_json::Value>(&told).unwrap()["psnr"].as_f64().unwrap()
    };
    let [back, archive] = ["back.splatv", "small.gsz"].map(psnr);
    assert!(back == archive && back > 43.0, "{back} dB, {archive} dB");
    // An archive is an input like any other, and has every kind of output of the model in it.
    workplace.done("info small.gsz");
    workplace.done("convert small.gsz frames --frames 3");
    workplace
        .done("compress small.gsz --cameras demo/cameras.json --ratio 0.5 --no-refine --prune-only -o less.splatv");
    workplace.done("view curves.splatv small.gsz -o page.html");
    workplace.done("convert curves.splatv all.gsz --cameras demo/cameras.json");
    workplace.done("convert all.gsz all.splatv");
    let [before, after] =
        ["curves", "all"].map(|name| fs::metadata(workplace.path(&format!("{name}.splatv"))).unwrap());
    // The header has a text with the number of Gaussians and their cameras.
    assert!(before.len().abs_diff(after.len()) < 64);
    let one = workplace.path("small.gsz");
    workplace.done(&format!("--threads 1 compress {how} --archive-psnr 45 -o one.gsz"));
    assert!(fs::read(one).unwrap() == fs::read(workplace.path("one.gsz")).unwrap());
}

#[test]
#[ignore = "needs the trained models"]
fn archives_of_all_trained_formats_restore_their_models() {
    let families = shared("families");
    for (name, cameras) in [
        ("stg_lite/model.splatv", "families/stg_lite"),
        ("stg_lite", "families/stg_lite"),
        ("stg_full", "families/stg_full"),
        ("deformable3d", "deform2"),
        ("deformable3d_6dof", "room2_dynerf"),
        ("yang4d", "families/yang4d"),
        ("d3dg", "families/d3dg"),
        ("ftgs", "deform2"),
        ("scgs", "deform2"),
        ("../captured/spinach_4_repaired.splatv", "captured"),
    ] {
        let workplace = Workplace::new();
        let cameras = match cameras {
            "captured" => shared(cameras).join("spinach_4_train.json"),
            _ => shared(cameras),
        };
        let (model, cameras) = (families.join(name), cameras.display().to_string());
        let ending = if model.is_dir() { "" } else { ".splatv" };
        let how = format!("{} --cameras {cameras} --ratio 0.1 --no-refine --prune-only", model.display());
        workplace.done(&format!("compress {how} -o small{ending}"));
        let summary = workplace.summary(&format!("{how} --archive-psnr 40 -o small.gsz"));
        workplace.done(&format!("convert small.gsz back{ending}"));
        let told = workplace.done(&format!("evaluate small{ending} back{ending} --cameras {cameras} --json"));
        let psnr = serde_json::from_str::<serde_json::Value>(&told).unwrap()["psnr"].as_f64().unwrap();
        let told = &summary["archive"]["psnr"].as_f64().unwrap();
        println!("{name}: {} bytes, {told} dB on the views of the archive, {psnr} dB", summary["output_bytes"]);
        // The views of the archive are not those of `evaluate`.
        assert!(*told >= 40.0 && psnr >= told - 2.0, "{name}: {psnr} dB, {told} dB in the summary");
    }
}

#[test]
fn damaged_and_impossible_archives_are_refused() {
    let (workplace, _) = with_archive();
    let bytes = fs::read(workplace.path("small.gsz")).unwrap();
    fs::write(workplace.path("cut.gsz"), &bytes[..bytes.len() - 100]).unwrap();
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 4;
    fs::write(workplace.path("flipped.gsz"), flipped).unwrap();
    fs::write(workplace.path("other.gsz"), b"something else").unwrap();
    workplace.refused(2, "compress {tiny} --cameras {tiny} --archive-psnr 40 -o a", &["--archive-psnr", ".gsz"]);
    workplace.refused(1, "convert cut.gsz out", &["cut.gsz", "section blobs", "bytes", "copy it again"]);
    workplace.refused(1, "convert flipped.gsz out", &["flipped.gsz", "checksum"]);
    workplace.refused(1, "info other.gsz", &["other.gsz", "archive"]);
    let mut older = bytes.clone();
    older[8] = 1;
    fs::write(workplace.path("older.gsz"), older).unwrap();
    for command in ["convert older.gsz out", "info older.gsz", "compress older.gsz --cameras {tiny} -o out"] {
        let advice = "write the archive again from its model";
        workplace.refused(1, command, &["older.gsz, byte 8: expected version 2, found version 1", advice]);
    }
    workplace.refused(
        2,
        "compress {tiny} --cameras {tiny} --size 1MB --archive-psnr 45 -o a.gsz",
        &["--size", "--archive-psnr", "one of them"],
    );
}

#[test]
fn asked_quality_includes_the_loss_of_the_archive() {
    let workplace = Workplace::new();
    let least = 30.0;
    let summary = workplace.summary(&format!(
        "{{tiny}} --cameras {{tiny}} --min-psnr {least}dB --set refine_steps=40 --set refine_steps_per_prune=10 -o small.gsz"
    ));
    let number = |name: &str| summary["goal"][name].as_f64().unwrap();
    assert_eq!(number("asked"), least);
    assert!(number("searched") >= least - 0.01, "{}", summary["goal"]);
    assert!(summary["archive"]["loss"].as_f64().unwrap() > 0.0, "{}", summary["archive"]);
}

/// An archive that only quantizes the same refined result has a lower PSNR on test views and at least as many bytes.
#[test]
fn refinement_for_quantization_gives_more_quality_in_fewer_bytes() {
    let workplace = Workplace::new();
    let how = "{tiny} --cameras {tiny} --ratio 0.3 --set refine_steps=300 --set refine_steps_per_prune=10 --overwrite \
               --cache cache -o small.gsz";
    let measured = |more: &str| {
        let summary = workplace.summary(&format!("{how} {more}"));
        let told = workplace.done("evaluate {tiny} small.gsz --cameras {tiny} --json");
        let psnr = serde_json::from_str::<serde_json::Value>(&told).unwrap()["psnr"].as_f64().unwrap();
        (fs::metadata(workplace.path("small.gsz")).unwrap().len(), psnr, summary["archive"].clone())
    };
    let (bytes, psnr, summary) = measured("");
    assert_eq!(summary["is_refined"], true, "{summary}");
    assert!(summary["loss"].as_f64().unwrap() <= 0.5, "{summary}");
    let mut tried = Vec::new();
    for least in (20..60).step_by(2) {
        let (plain_bytes, plain_psnr, summary) = measured(&format!("--archive-psnr {least}"));
        assert_eq!(summary["is_refined"], false, "{summary}");
        tried.push((plain_bytes, plain_psnr));
        if plain_bytes >= bytes {
            assert!(plain_psnr < psnr, "{bytes} bytes at {psnr} dB, only quantized: {tried:?}");
            return;
        }
    }
    panic!("{bytes} bytes at {psnr} dB, only quantized: {tried:?}");
}

#[test]
fn target_size_is_filled_by_count_and_bits_together() {
    let workplace = Workplace::new();
    let how = "{tiny} --cameras {tiny} --no-refine --overwrite -o small.gsz --size";
    let mut before = (0, 0.0);
    for most in [5_000, 8_000] {
        let summary = workplace.summary(&format!("{how} {most}"));
        let bytes = fs::metadata(workplace.path("small.gsz")).unwrap().len();
        let told = workplace.done("evaluate {tiny} small.gsz --cameras {tiny} --json");
        let psnr = serde_json::from_str::<serde_json::Value>(&told).unwrap()["psnr"].as_f64().unwrap();
        assert!((0.97 * most as f64..=most as f64).contains(&(bytes as f64)), "{most}: {bytes} bytes");
        let count = summary["gaussians"].as_u64().unwrap();
        assert!(count > before.0 && psnr > before.1 + 1.0, "{most}: {count} Gaussians at {psnr} dB, {before:?} before");
        before = (count, psnr);
    }
    workplace.refused(2, &format!("compress {how} 1000"), &["--size", "expected at least"]);
}

/// Number of frames and number of Gaussians of the model of [`write_dynamic_3d_gaussians`].
const STORED_FRAMES: [usize; 2] = [24, 80];

/// Writes a Dynamic3DGaussians model (stored states of all frames) with one camera for each frame to the folder
/// `model`. The Gaussians lie on a grid and move along circles.
fn write_dynamic_3d_gaussians(model: &Path) {
    use npyz::WriterBuilder;
    let [frames, count] = STORED_FRAMES;
    let mut npz = npyz::npz::NpzWriter::new(fs::File::create(model.join("params.npz")).unwrap());
    let position = |frame: usize, i: usize, c: usize| {
        let place = [i % 10, i / 10, i % 3].map(|place| 0.2 * place as f32 - 0.9);
        let angle = 0.3 * frame as f32 + i as f32;
        place[c] + 0.05 * [angle.cos(), angle.sin(), angle.cos()][c]
    };
    let rotation = |_: usize, i: usize, c: usize| [1.0, 0.01 * i as f32, 0.3, 0.0][c];
    let color = |_: usize, i: usize, c: usize| 0.1 + 0.8 * ((7 * i + 3 * c) % 10) as f32 / 10.0;
    type Value<'a> = &'a dyn Fn(usize, usize, usize) -> f32;
    let arrays: [(&str, &[usize], Value<'_>); 5] = [
        ("means3D", &[frames, count, 3], &position),
        ("unnorm_rotations", &[frames, count, 4], &rotation),
        ("rgb_colors", &[frames, count, 3], &color),
        ("log_scales", &[count, 3], &|_, i, c| -2.5 + 0.1 * ((i + c) % 5) as f32),
        ("logit_opacities", &[count, 1], &|_, i, _| 1.0 + 0.02 * i as f32),
    ];
    for (name, shape, value) in arrays {
        let stored: Vec<u64> = shape.iter().map(|&length| length as u64).collect();
        let options = zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Stored);
        let mut array = npz.array::<f32>(name, options).unwrap().default_dtype().shape(&stored).begin_nd().unwrap();
        let (width, outer) = (*shape.last().unwrap(), if shape.len() == 3 { frames } else { 1 });
        let values = (0..outer * count * width).map(|k| value(k / (count * width), k / width % count, k % width));
        array.extend(values).unwrap();
        array.finish().unwrap();
    }
    write_cameras(model, frames);
}

/// Writes `transforms_train.json` with one camera of 64 × 64 pixels for each of `frames` frames to `folder`.
fn write_cameras(folder: &Path, frames: usize) {
    let matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]];
    let camera = |frame: usize| {
        let time = frame as f64 / (frames - 1).max(1) as f64;
        serde_json::json!({ "file_path": format!("./train/f{frame:03}"), "time": time, "transform_matrix": matrix })
    };
    let cameras: Vec<_> = (0..frames).map(camera).collect();
    let rig = serde_json::json!({ "camera_angle_x": 0.7, "w": 64, "h": 64, "frames": cameras });
    fs::write(folder.join("transforms_train.json"), rig.to_string()).unwrap();
}

#[test]
fn first_stored_frame_is_as_good_as_the_later_ones() {
    let workplace = Workplace::new();
    fs::create_dir(workplace.path("model")).unwrap();
    write_dynamic_3d_gaussians(&workplace.path("model"));
    workplace.done("convert model all.gsz --cameras model");
    let run = workplace.done("evaluate model all.gsz --cameras model --json");
    let found: serde_json::Value = serde_json::from_str(&run).unwrap();
    let frames = found["per_frame"].as_array().unwrap();
    let by_frame: Vec<f64> = frames.iter().map(|frame| frame["psnr"].as_f64().unwrap()).collect();
    let mean = found["psnr"].as_f64().unwrap();
    assert!(by_frame.len() == STORED_FRAMES[0] && by_frame[0] > mean - 3.0, "{by_frame:?}");
}

/// Writes `NAME.ply` with 900 Gaussians on a grid, the first of them moved to (`far`, 0, 0), and a camera.
fn write_ply_with_far_gaussian(workplace: &Workplace, name: &str, far: f32) {
    let mut gaussians = Gaussians::zeros(900, 0);
    let place = |i: usize| [0.06 * (i % 30) as f32 - 0.9, 0.06 * (i / 30) as f32 - 0.9, 0.1 * (i % 7) as f32];
    (0..900).for_each(|i| gaussians.position.set_row(i, place(i)));
    gaussians.position.set_row(0, [far, 0.0, 0.0]);
    gaussians.rotation.plane_mut(0).fill(1.0);
    gaussians.log_scale.planes_mut().fill(-3.5);
    gaussians.opacity_logit.planes_mut().fill(2.0);
    gaussians.sh.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k % 11) as f32 / 5.0 - 1.0);
    workplace.ply(&format!("{name}.ply"), &gaussians);
    write_cameras(&workplace.path(""), 1);
}

#[test]
fn a_missed_quality_names_the_far_gaussian() {
    let workplace = Workplace::new();
    write_ply_with_far_gaussian(&workplace, "far", 3e4);
    let run = workplace.run("convert far.ply far.gsz --cameras transforms_train.json");
    let says = ["misses its quality: expected 50.0 dB", "Gaussian 0 at (30000, 0, 0)", "compress --drop-ids"];
    assert!(run.code == 0 && says.iter().all(|part| run.stderr.contains(part)), "{}", run.stderr);
    write_ply_with_far_gaussian(&workplace, "farther", 1e7);
    let convert = "convert farther.ply farther.gsz --cameras transforms_train.json";
    workplace.refused(2, convert, &["farther.ply: ", "expected 50.0 dB PSNR", "Gaussian 0 at (10000000, 0, 0)"]);
    let compress = "compress farther.ply -o farther.gsz --cameras transforms_train.json --archive-psnr 45 --ratio 1 \
                    --no-refine --prune-only";
    workplace.refused(2, compress, &["expected the requested 45.0 dB PSNR"]);
}

#[test]
fn a_4dgs_error_names_the_output_and_the_far_gaussian() {
    let workplace = Workplace::new();
    write_ply_with_far_gaussian(&workplace, "farther", 1e7);
    let parts = ["/farther.4dgs: a .4dgs file cannot", "Gaussian 0 at (10000000, 0, 0)", "compress --drop-ids"];
    workplace.refused(2, "convert farther.ply farther.4dgs", &parts);
}

#[test]
fn unpacking_reports_the_bytes_of_the_files() {
    let workplace = Workplace::new();
    write_ply_with_far_gaussian(&workplace, "near", 0.0);
    let info = |name: &str| -> serde_json::Value {
        serde_json::from_str(&workplace.done(&format!("info {name} --json"))).unwrap()
    };
    workplace.done("convert near.ply near.gsz --cameras transforms_train.json");
    assert_eq!(info("near.gsz")["size"]["field"], 0, "{}", info("near.gsz"));
    workplace.refused(2, "convert near.gsz back", &["back: the archive near.gsz holds one PLY", ".ply"]);
    let report: serde_json::Value = serde_json::from_str(&workplace.done("convert near.gsz back.ply --json")).unwrap();
    assert_eq!(report["bytes"], fs::metadata(workplace.path("back.ply")).unwrap().len());
    workplace.done(&format!("compress {TINY} -o small.gsz"));
    let report: serde_json::Value = serde_json::from_str(&workplace.done("convert small.gsz small --json")).unwrap();
    let written = lasting_files(&workplace.path("small")).values().map(Vec::len).sum::<usize>();
    assert_eq!(report["bytes"], written);
}
