//! Tests with cameras in the formats of real data sets, and tests of the error messages for malformed camera files.

mod colmap;

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use serde_json::{Value, json};

use super::{CameraOptions, find_training_cameras, load};
use crate::model::{Camera, Rig, Split};

/// Returns the folders of three trained models, below the folder `SPLATSIEVE_DATA`, else below `../shared/data`. They
/// must exist.
fn shared_models() -> [PathBuf; 3] {
    let data = std::env::var_os("SPLATSIEVE_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    assert!(data.is_dir(), "no trained models at {} (SPLATSIEVE_DATA)", data.display());
    ["deform2", "room2_big", "room2_dynerf"].map(|name| data.join(name))
}

/// Returns a temporary folder that holds `files`, given as (name, JSON content).
fn folder(files: &[(&str, &Value)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in files {
        fs::write(folder.path().join(name), content.to_string()).unwrap();
    }
    folder
}

fn load_json(name: &str, content: &Value) -> crate::error::Result<Rig> {
    load(folder(&[(name, content)]).path(), &CameraOptions::default())
}

/// Writes `content` to a camera file called `name`, reads the cameras, and asserts that this fails. The error message
/// must contain `name` and every one of `parts`.
fn assert_refused(name: &str, content: &Value, parts: &[&str]) {
    let message = load_json(name, content).unwrap_err().to_string();
    for part in parts.iter().chain(&[name]) {
        assert!(message.contains(part), "{part:?} is not in {message:?}");
    }
}

/// Returns the camera-to-world pose, in OpenGL axes, of a camera at `eye` that looks along +y of the world, with z up.
fn along_y(eye: [f64; 3]) -> Value {
    json!([[1, 0, 0, eye[0]], [0, 0, -1, eye[1]], [0, 1, 0, eye[2]], [0, 0, 0, 1]])
}

fn transforms(times: &[f64]) -> Value {
    let frame = |(i, time): (usize, &f64)| {
        json!({"file_path": format!("./train/r_{i:03}"), "time": time,
               "transform_matrix": along_y([i as f64, -4.0, 1.0])})
    };
    let frames: Vec<Value> = times.iter().enumerate().map(frame).collect();
    json!({"camera_angle_x": 1.0, "w": 80, "h": 60, "frames": frames})
}

fn per_image(times: &[f64]) -> Value {
    let frame = |time: &f64| {
        json!({"v": 4, "time": time, "width": 80, "height": 60, "fx": 70.0, "fy": 71.0, "cx": 39.0, "cy": 31.0,
               "w2c": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]})
    };
    json!({"background": [1, 0.5, 0], "frames": times.iter().map(frame).collect::<Vec<_>>()})
}

/// Returns the bytes of a NumPy array file (format 1.0) with the values `rows`. The other arguments are texts for its
/// header: the values of `descr`, `fortran_order` and `shape`.
fn npy(dtype: &str, order: &str, shape: &str, rows: &[[f64; 17]]) -> Vec<u8> {
    let header = format!("{{'descr': '{dtype}', 'fortran_order': {order}, 'shape': {shape}, }}");
    let mut bytes = b"\x93NUMPY\x01\0\x76\0".to_vec();
    bytes.extend(format!("{header:117}\n").bytes());
    bytes.extend(rows.iter().flatten().flat_map(|x| x.to_le_bytes()));
    bytes
}

fn write_npy(path: &Path, rows: &[[f64; 17]]) {
    fs::write(path, npy("<f8", "False", &format!("({}, 17)", rows.len()), rows)).unwrap();
}

/// Returns the row of `poses_bounds.npy` for a camera at `eye` that looks along +y of the world, with z up. The image
/// height, the image width and the focal length are in pixels.
fn llff_row(eye: [f64; 3], height: f64, width: f64, focal: f64) -> [f64; 17] {
    let [x, y, z] = eye;
    // Columns: down −z, right +x, backward −y, position, (height, width, focal).
    [0.0, 1.0, 0.0, x, height, 0.0, 0.0, -1.0, y, width, -1.0, 0.0, 0.0, z, focal, 0.1, 9.0]
}

#[test]
fn negative_zero_and_zero_give_the_same_camera() {
    let frame = |zero: f64, time: f64| {
        json!({"v": 4, "time": time, "width": 80, "height": 60, "fx": 70.0, "fy": 71.0, "cx": 39.0, "cy": zero,
               "w2c": [[1, zero, zero, zero], [0, 1, zero, 0], [0, 0, 1, 3], [0, 0, 0, 1]]})
    };
    let rig = load_json("cameras.json", &json!({"frames": [frame(0.0, 0.0), frame(-0.0, 0.5), frame(1e-300, 1.0)]}));
    let cameras: Vec<u32> = rig.unwrap().views.iter().map(|rig_view| rig_view.camera).collect();
    assert_eq!(cameras, [0, 0, 1]);
}

#[test]
fn a_view_given_twice_is_refused_among_many_views() {
    let mut times: Vec<f64> = (0..200).map(f64::from).collect();
    assert_eq!(load_json("cameras.json", &per_image(&times)).unwrap().views.len(), 200);
    times.push(7.0);
    assert_refused("cameras.json", &per_image(&times), &["frame 200", "one image per view", "again, as in frame 7"]);
}

#[test]
#[ignore = "needs the trained models"]
fn transforms_and_cameras_json_give_the_same_cameras() {
    for model in shared_models() {
        let options = CameraOptions::default();
        let transforms = load(&model, &options).unwrap();
        let cameras = load(&model.join("cameras.json"), &options).unwrap();
        for rig in [&transforms, &cameras] {
            assert_eq!(rig.cameras.len(), 16, "{}", rig.origin);
            let count = |split| rig.views.iter().filter(|rig_view| rig_view.split == split).count();
            assert_eq!((count(Split::Train), count(Split::Test)), (13 * 60, 3 * 60));
            let times = rig.times();
            assert_eq!(times.len(), 60);
            let schedule = rig.schedule(&times, None).unwrap();
            assert!(schedule.iter().all(|views| views.len() == 16));
        }
        assert!(transforms.background.is_none() && cameras.background.is_some());
        for rig_view in &cameras.views {
            let same = transforms.views.iter().find(|s| s.view == rig_view.view && s.time == rig_view.time).unwrap();
            assert_eq!(same.split, rig_view.split);
            let (a, b) = (&transforms.cameras[same.camera as usize], &cameras.cameras[rig_view.camera as usize]);
            let turned = (a.rotation - b.rotation).to_cols_array().into_iter().fold(0.0, |m: f64, x| m.max(x.abs()));
            let moved = (a.center() - b.center()).length();
            assert!(turned <= 1e-9 && moved <= 1e-9, "view {}: {turned:e} {moved:e}", rig_view.view);
            assert_eq!((a.width, a.height, a.fx, a.fy), (b.width, b.height, b.fx, b.fy));
            assert_eq!((a.cx, a.cy), (b.cx, b.cy));
        }
        let there = transforms.views.iter().filter(|s| s.image.as_ref().is_some_and(|image| image.is_file())).count();
        assert_eq!(there, fs::read_dir(model.join("test")).unwrap().count(), "every image of test/ is found");
    }
}

#[test]
fn a_folder_gives_all_splits_and_a_file_one() {
    let folder = folder(&[
        ("transforms_train.json", &transforms(&[0.0, 0.5, 1.0])),
        ("transforms_test.json", &transforms(&[0.25])),
    ]);
    let options = CameraOptions::default();
    let whole = load(folder.path(), &options).unwrap();
    assert_eq!(whole.views.len(), 4);
    assert_eq!(whole.views.iter().map(|s| s.split == Split::Test).collect::<Vec<_>>(), [false, false, false, true]);
    // If the user names a file of one split, only its images are loaded, but their times are those they have among all
    // splits.
    let alone = |name: &str| load(&folder.path().join(name), &options).unwrap();
    for (name, split) in [("transforms_train.json", Split::Train), ("transforms_test.json", Split::Test)] {
        let own: Vec<_> =
            whole.views.iter().filter(|rig_view| rig_view.split == split).map(|rig_view| rig_view.time).collect();
        let found: Vec<_> = alone(name).views.iter().map(|rig_view| (rig_view.split, rig_view.time)).collect();
        assert_eq!(found, own.into_iter().map(|time| (split, time)).collect::<Vec<_>>(), "{name}");
    }
}

#[test]
fn val_is_held_out_if_there_is_no_test_split() {
    let train = transforms(&[0.0, 0.5, 1.0]);
    let val = transforms(&[0.25, 0.75]);
    let files = [("transforms_train.json", &train), ("transforms_val.json", &val)];
    let rig = load(folder(&files).path(), &CameraOptions::default()).unwrap();
    let count = |rig: &Rig, split| rig.views.iter().filter(|rig_view| rig_view.split == split).count();
    assert_eq!((count(&rig, Split::Train), count(&rig, Split::Val), count(&rig, Split::Test)), (3, 2, 0));
    assert_eq!(rig.held_out_split(), Some(Split::Val));
    let test = transforms(&[0.6]);
    let with_test = [&files[..], &[("transforms_test.json", &test)]].concat();
    let rig = load(folder(&with_test).path(), &CameraOptions::default()).unwrap();
    assert_eq!((count(&rig, Split::Val), count(&rig, Split::Test), rig.held_out_split()), (2, 1, Some(Split::Test)));
    let mut document = per_image(&[0.0]);
    document["frames"][0]["split"] = json!("val");
    assert_eq!(load_json("cameras.json", &document).unwrap().held_out_split(), Some(Split::Val));
}

#[test]
fn nerfies_cameras_match_the_4dgaussians_loader() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, value: Value| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, value.to_string()).unwrap();
    };
    let ids: Vec<String> = (0..10).map(|k| format!("{k:06}")).collect();
    let metadata = |k: usize| (ids[k].clone(), json!({"warp_id": 2 * k, "appearance_id": k, "camera_id": 0}));
    write("metadata.json", Value::Object((0..10).map(metadata).collect()));
    write("scene.json", json!({"scale": 0.1, "center": [1, 2, 3], "near": 0.1, "far": 1}));
    for (k, id) in ids.iter().enumerate() {
        write(
            &format!("camera/{id}.json"),
            json!({"orientation": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "position": [k, 5, 6], "focal_length": 100.0,
                   "principal_point": [41, 29], "image_size": [80, 60], "skew": 0.0, "pixel_aspect_ratio": 1.0,
                   "radial_distortion": [0, 0, 0], "tangential_distortion": [0, 0]}),
        );
    }
    write("dataset.json", json!({"ids": ids, "val_ids": [], "train_ids": []}));
    let rig = load(folder.path(), &CameraOptions::default()).unwrap();
    let camera = &rig.cameras[0];
    // Expected: half the image size; rotation world to camera, row by row; `scale` and `center` of the scene not
    // applied.
    assert_eq!(
        (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        (40, 30, 50.0, 50.0, 20.0, 15.0)
    );
    assert_eq!(camera.rotation * DVec3::Z, DVec3::X);
    assert!((rig.cameras[1].center() - DVec3::new(2.0, 5.0, 6.0)).length() < 1e-12, "{}", rig.cameras[1].center());
    let rig_views: Vec<_> = rig.views.iter().map(|rig_view| (rig_view.time.unwrap(), rig_view.split)).collect();
    let at = |k: usize| k as f64 / 9.0;
    // Every fourth image is for training; the image two after it is for testing, except after the last training image.
    let expected = [(0, Split::Train), (2, Split::Test), (4, Split::Train), (6, Split::Test), (8, Split::Train)];
    assert_eq!(rig_views, expected.map(|(k, split)| (at(k), split)));
    write("dataset.json", json!({"ids": ids, "val_ids": [ids[3]], "train_ids": [ids[0], ids[1]]}));
    let rig = load(&folder.path().join("dataset.json"), &CameraOptions::default()).unwrap();
    let rig_views: Vec<_> = rig.views.iter().map(|rig_view| (rig_view.time.unwrap(), rig_view.split)).collect();
    assert_eq!(rig_views, [(at(0), Split::Train), (at(1), Split::Train), (at(3), Split::Test)]);
    write("camera/000001.json", json!({"orientation": 3}));
    let message = load(folder.path(), &CameraOptions::default()).unwrap_err().to_string();
    assert!(message.contains("000001.json") && message.contains("image_size"), "{message}");
}

#[test]
fn opengl_pose_becomes_an_opencv_camera() {
    let rig = load_json("transforms.json", &transforms(&[0.0, 1.0])).unwrap();
    let focal = 40.0 / 0.5f64.tan();
    let expected = Camera {
        width: 80,
        height: 60,
        fx: focal,
        fy: focal,
        cx: 40.0,
        cy: 30.0,
        // Camera axes in the world: right is +x, down is −z, forward is +y.
        rotation: DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y).transpose(),
        translation: DVec3::new(0.0, 1.0, 4.0),
        near: Camera::NEAR,
    };
    assert_eq!(rig.cameras[0], expected);
    assert_eq!(rig.cameras[1].center(), DVec3::new(1.0, -4.0, 1.0));

    // The camera looks along +x: for this pose the order of axis flip and rotation matters.
    let mut document = transforms(&[0.0]);
    document["frames"][0]["transform_matrix"] = json!([[0, 0, -1, 7], [-1, 0, 0, 8], [0, 1, 0, 9], [0, 0, 0, 1]]);
    let camera = load_json("transforms.json", &document).unwrap().cameras[0].clone();
    assert_eq!(camera.rotation, DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X).transpose());
    assert_eq!(camera.center(), DVec3::new(7.0, 8.0, 9.0));
}

#[test]
fn keys_of_an_image_override_keys_of_the_file() {
    let mut document = transforms(&[0.0, 1.0]);
    document["fl_y"] = json!(50.0);
    document["frames"][1]["fl_x"] = json!(90.0);
    document["frames"][1]["cx"] = json!(41.5);
    let rig = load_json("transforms.json", &document).unwrap();
    assert_eq!((rig.cameras[0].fx, rig.cameras[0].fy), (40.0 / 0.5f64.tan(), 50.0));
    assert_eq!((rig.cameras[1].fx, rig.cameras[1].fy, rig.cameras[1].cx), (90.0, 90.0, 41.5));
}

#[test]
fn times_are_divided_by_the_largest_of_all_files() {
    let folder =
        folder(&[("transforms_train.json", &transforms(&[0.0, 2.0])), ("transforms_test.json", &transforms(&[4.0]))]);
    assert_eq!(load(folder.path(), &CameraOptions::default()).unwrap().times(), [0.0, 0.5, 1.0]);
    assert_eq!(load_json("transforms.json", &transforms(&[0.0])).unwrap().times(), [0.0]);
}

#[test]
fn missing_size_comes_from_the_image_then_the_option() {
    let mut document = transforms(&[0.0]);
    document.as_object_mut().unwrap().remove("h");
    assert_refused("transforms.json", &document, &["frame 0", "r_000", "--resolution"]);

    let folder = folder(&[("transforms.json", &document)]);
    let options = CameraOptions { size: Some((30, 20)), frames: None, ..CameraOptions::default() };
    let rig = load(folder.path(), &options).unwrap();
    assert_eq!((rig.cameras[0].width, rig.cameras[0].height, rig.cameras[0].cx), (30, 20, 15.0));
    assert_eq!(rig.cameras[0].fx, 15.0 / 0.5f64.tan());

    // Start of a PNG: signature, then IHDR with width and height.
    let mut png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR".to_vec();
    png.extend([0, 0, 1, 0, 0, 0, 0, 200, 8, 2, 0, 0, 0]);
    fs::create_dir(folder.path().join("train")).unwrap();
    fs::write(folder.path().join("train/r_000.png"), png).unwrap();
    let rig = load(folder.path(), &options).unwrap();
    assert_eq!((rig.cameras[0].width, rig.cameras[0].height), (256, 200));
    assert_eq!(rig.views[0].image, Some(folder.path().join("train/r_000.png")));
}

#[test]
fn views_are_numbered_by_name_or_by_pose() {
    let mut document = transforms(&[0.0, 1.0]);
    for (i, name) in ["./train/t000_v07", "./train/t001_v03.png"].into_iter().enumerate() {
        document["frames"][i]["file_path"] = json!(name);
    }
    let views = |document: &Value| -> Vec<u32> {
        load_json("transforms.json", document).unwrap().views.iter().map(|rig_view| rig_view.view).collect()
    };
    assert_eq!(views(&document), [7, 3]);
    document["frames"][1]["file_path"] = json!("./train/cat_v03");
    assert_eq!(views(&document), [0, 1]);
    document["frames"][1]["transform_matrix"] = document["frames"][0]["transform_matrix"].clone();
    assert_eq!(views(&document), [0, 0]);
}

#[test]
fn own_cameras_json_is_read_completely() {
    let rig = load_json("cameras.json", &per_image(&[0.0, 0.25])).unwrap();
    assert_eq!(rig.background, Some([1.0, 0.5, 0.0]));
    assert_eq!(rig.cameras.len(), 1);
    let Camera { fx, fy, cx, cy, translation, .. } = rig.cameras[0];
    assert_eq!((fx, fy, cx, cy, translation), (70.0, 71.0, 39.0, 31.0, DVec3::new(0.5, 0.0, 3.0)));
    assert_eq!(rig.times(), [0.0, 0.25], "times are taken as they are");
    assert!(rig.views.iter().all(|rig_view| rig_view.view == 4 && rig_view.split == Split::Train));
}

#[test]
fn distortion_in_transforms_is_ignored_and_reported_and_fisheye_is_refused() {
    let with = |key: &str, value: &Value| {
        let mut file = transforms(&[0.0, 1.0]);
        file[key] = value.clone();
        file
    };
    let undistorted = load_json("transforms.json", &transforms(&[0.0, 1.0])).unwrap();
    // Corners at (±0.55, ±0.41) are moved by k1 r³ f: 0.8 pixels for 0.035, and 1.2 pixels for 0.05.
    for (key, value, note) in [
        ("k1", json!(0.0), ""),
        ("camera_model", json!("OPENCV"), ""),
        ("is_fisheye", json!(false), ""),
        ("k1", json!(0.035), ""),
        ("k1", json!(0.05), " (lens distortion of up to 1.2 pixels ignored)"),
    ] {
        let found = load_json("transforms.json", &with(key, &value)).unwrap();
        assert_eq!(found.cameras, undistorted.cameras);
        assert_eq!(found.origin, format!("transforms.json{note}"), "{key} {value}");
    }
    for (key, value) in [("camera_model", json!("OPENCV_FISHEYE")), ("is_fisheye", json!(true))] {
        let expected = [key, "a perspective camera", "undistort the images"];
        assert_refused("transforms.json", &with(key, &value), &expected);
        let mut of_one_image = transforms(&[0.0, 1.0]);
        of_one_image["frames"][1][key] = value;
        assert_refused("transforms.json", &of_one_image, &[&expected[..], &["frame 1"]].concat());
    }
    let mut of_one_image = with("k1", &json!(0.0));
    of_one_image["frames"][1]["p1"] = json!(0.1);
    assert!(load_json("transforms.json", &of_one_image).unwrap().origin.contains("pixels ignored"));
}

#[test]
fn lists_of_images_in_transforms_state_splits() {
    let mut file = transforms(&[0.0, 0.25, 0.5, 1.0]);
    file["train_filenames"] = json!(["train/r_000", "train/r_003"]);
    file["val_filenames"] = json!(["./train/r_001", "train/r_002"]);
    file["test_filenames"] = json!(["train/r_002"]);
    let rig = load_json("transforms.json", &file).unwrap();
    let splits: Vec<Split> = rig.views.iter().map(|rig_view| rig_view.split).collect();
    assert_eq!(splits, [Split::Train, Split::Val, Split::Test, Split::Train]);
    file["test_filenames"] = json!([7]);
    assert_refused("transforms.json", &file, &["test_filenames", "element 0", "the name of an image", "7"]);
}

#[test]
fn cameras_of_a_3dgs_folder_see_every_frame() {
    let entry = |id: u32, x: f64| {
        json!({"id": id, "img_name": format!("{id:05}"), "width": 80, "height": 60, "fx": 70.0, "fy": 71.0,
               "position": [x, 0.0, -3.0], "rotation": [[0, 0, 1], [1, 0, 0], [0, 1, 0]]})
    };
    let rig = load_json("cameras.json", &json!([entry(0, 1.0), entry(1, 2.0), entry(2, 1.0)])).unwrap();
    assert_eq!((rig.cameras.len(), rig.views.len()), (2, 2), "the third repeats the first");
    assert_eq!(rig.cameras[0].center(), DVec3::new(1.0, 0.0, -3.0));
    // The camera-to-world rotation maps forward (z) to the world's x, so world x must map to forward.
    assert_eq!(rig.cameras[0].rotation * DVec3::X, DVec3::Z);
    assert_eq!(rig.schedule(&[0.0, 1.0, 2.0], None).unwrap().pair_count(), 6);
}

#[test]
fn dynerf_has_half_size_and_camera_0_as_test() {
    let folder = tempfile::tempdir().unwrap();
    write_npy(
        &folder.path().join("poses_bounds.npy"),
        &[llff_row([0.0, -4.0, 1.0], 2028.0, 2704.0, 1400.0), llff_row([0.5, -4.0, 1.0], 2028.0, 2704.0, 1400.0)],
    );
    let rig = load(folder.path(), &CameraOptions { size: None, frames: Some(4), ..CameraOptions::default() }).unwrap();
    let camera = &rig.cameras[1];
    assert_eq!((camera.width, camera.height, camera.fx, camera.fy), (1352, 1014, 700.0, 700.0));
    assert_eq!((camera.cx, camera.cy, camera.center()), (676.0, 507.0, DVec3::new(0.5, -4.0, 1.0)));
    assert_eq!(camera.rotation * DVec3::Y, DVec3::Z, "+y is forward");
    assert_eq!(camera.rotation * DVec3::Z, DVec3::NEG_Y, "+z is up");
    assert_eq!(rig.times(), [0.0, 0.25, 0.5, 0.75]);
    let held_out = rig.schedule(&rig.times(), Some(Split::Test)).unwrap();
    assert_eq!(held_out.iter().collect::<Vec<_>>(), [[(0, 0)]; 4]);
    let default =
        load(folder.path(), &CameraOptions { size: Some((676, 507)), frames: None, ..CameraOptions::default() })
            .unwrap();
    assert_eq!((default.times().len(), default.cameras[0].fx), (300, 350.0));
    assert!(default.origin.contains("300 frames"));
}

#[test]
fn malformed_pose_arrays_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("poses_bounds.npy");
    let refused = |parts: &[&str]| {
        let message = load(folder.path(), &CameraOptions::default()).unwrap_err().to_string();
        for part in parts {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    };
    let good = llff_row([0.0; 3], 20.0, 30.0, 25.0);
    for (column, value, parts) in [
        (0, f64::NAN, ["row 1", "rotation"]),
        (0, 0.5, ["row 1", "rotation"]),
        (3, f64::INFINITY, ["row 1", "position"]),
        (4, 20.5, ["row 1", "20.5"]),
        (14, 0.0, ["row 1", "focal"]),
    ] {
        let mut bad = good;
        bad[column] = value;
        write_npy(&path, &[good, bad]);
        refused(&parts);
    }
    for (dtype, order, shape, parts) in [
        ("<i8", "False", "(2, 17)", ["float64 or float32", "i8"]),
        ("<f8", "False", "(17, 2)", ["[V, 17]", "[17, 2]"]),
        ("<f8", "False", "(34,)", ["[V, 17]", "[34]"]),
        ("<f8", "False", "(0, 17)", ["V at least 1", "[0, 17]"]),
        ("<f8", "False", "(9999999999, 17)", ["9999999999 rows", "bytes"]),
        ("<f8", "False", "(9999999999, 9999999999)", ["NumPy array", "not that of an array of numbers"]),
        ("<f8", "False", "(3, 17)", ["3 rows", "data"]),
        ("<f8", "True", "(2, 17)", ["Fortran", "ascontiguousarray"]),
        ("|O", "False", "(2, 17)", ["float64 or float32", "O"]),
    ] {
        fs::write(&path, npy(dtype, order, shape, &[good, good])).unwrap();
        refused(&parts);
    }
    let whole = npy("<f8", "False", "(2, 17)", &[good, good]);
    for length in 0..whole.len() {
        fs::write(&path, &whole[..length]).unwrap();
        refused(&["poses_bounds.npy"]);
    }
}

#[test]
fn errors_name_the_image_by_its_number() {
    let mut cases: Vec<(&str, Value, Vec<&str>)> = vec![
        ("time", json!("noon"), vec!["frame 1", "\"time\"", "noon"]),
        ("time", Value::Null, vec!["frame 1", "a time for every image"]),
        ("time", json!(0.0), vec![]),
        ("fl_x", json!(0.0), vec!["frame 1", "focal", "0"]),
        ("fl_x", json!(-3), vec!["frame 1", "focal", "-3"]),
        ("fl_x", json!(1e80), vec!["frame 1", "focal", "at most 1e9 pixels", "1e80"]),
        ("w", json!(80.5), vec!["frame 1", "\"w\"", "80.5"]),
        ("w", json!(1e9), vec!["frame 1", "\"w\"", "32768"]),
        ("transform_matrix", json!([[1, 0], [0, 1]]), vec!["frame 1", "transform_matrix"]),
        ("transform_matrix", Value::Null, vec!["frame 1", "transform_matrix"]),
        ("file_path", json!(12), vec!["frame 1", "file_path", "12"]),
    ];
    let mut matrix = |r: usize, c: usize, value: f64, parts: &[&'static str]| {
        let mut pose = along_y([1.0, -4.0, 1.0]);
        pose[r][c] = json!(value);
        cases.push(("transform_matrix", pose, [&["frame 1"], parts].concat()));
    };
    matrix(0, 0, 1.01, &["a rotation", "2.010e-2"]);
    matrix(0, 0, -1.0, &["reflection"]);
    matrix(3, 0, 2.0, &["0 0 0 1", "transposed"]);
    for (key, value, parts) in cases {
        let mut document = transforms(&[0.0, 1.0]);
        document["frames"][1][key] = value;
        if parts.is_empty() {
            load_json("transforms.json", &document).expect("another view at the same time is a synchronized rig");
        } else {
            assert_refused("transforms.json", &document, &parts);
        }
    }
    assert_refused("cameras.json", &per_image(&[0.0, 0.5, 0.5]), &["frame 2", "view 4", "0.5", "frame 1"]);
    assert_refused("cameras.json", &per_image(&[0.0, -0.0]), &["frame 1", "as in frame 0"]);
    let mut document = per_image(&[0.0]);
    document["frames"][0]["split"] = json!("validation");
    assert_refused("cameras.json", &document, &["frame 0", "split", "validation"]);
}

#[test]
fn inputs_without_cameras_are_refused() {
    assert_refused("transforms.json", &json!({"frames": []}), &["non-empty list"]);
    assert_refused("cameras.json", &json!([]), &["at least one image"]);
    assert_refused("cameras.json", &json!([3]), &["frame 0", "an object"]);
    assert_refused("cameras.json", &json!("text"), &["text"]);

    let folder = tempfile::tempdir().unwrap();
    let message = |path: &Path| load(path, &CameraOptions::default()).unwrap_err().to_string();
    assert!(message(folder.path()).contains("transforms_train.json"));
    assert!(message(&folder.path().join("nowhere")).contains("cannot open"));
    let json = folder.path().join("transforms.json");
    fs::write(&json, "{\"frames\": [{\"time\": NaN}]}").unwrap();
    let text = message(folder.path());
    assert!(text.contains("line 1, column") && text.contains("NaN"), "{text}");
    fs::write(&json, [0xff, 0xfe, 0]).unwrap();
    assert!(message(&json).contains("UTF-16"));
    fs::remove_file(&json).unwrap();
    fs::create_dir_all(folder.path().join("sparse/0")).unwrap();
    assert!(message(folder.path()).contains("COLMAP"));
    assert!(message(&folder.path().join("sparse/0")).contains("COLMAP"));
}

#[test]
fn options_out_of_range_are_usage_errors() {
    for options in [
        CameraOptions { size: Some((0, 10)), frames: None, ..CameraOptions::default() },
        CameraOptions { size: Some((10, 1 << 20)), frames: None, ..CameraOptions::default() },
        CameraOptions { size: None, frames: Some(0), ..CameraOptions::default() },
    ] {
        let error = load(Path::new("anything"), &options).unwrap_err();
        assert!(matches!(error, crate::error::Error::Usage(_)), "{error}");
    }
}

#[test]
fn source_path_is_found_from_any_parent_folder() {
    let root = tempfile::tempdir().unwrap();
    let model = root.path().join("output/deep/model");
    fs::create_dir_all(&model).unwrap();
    assert_eq!(find_training_cameras("data/scene", &model), None);
    fs::create_dir_all(root.path().join("data/scene")).unwrap();
    assert_eq!(find_training_cameras("data/scene", &model), None, "a folder without cameras is not it");
    fs::write(root.path().join("data/scene/transforms.json"), "{}").unwrap();
    assert_eq!(find_training_cameras("data/scene", &model), Some(root.path().join("data/scene")));
    fs::create_dir_all(root.path().join("output/data/scene")).unwrap();
    fs::write(root.path().join("output/data/scene/cameras.json"), "{}").unwrap();
    assert_eq!(
        find_training_cameras("data/scene", &model),
        Some(root.path().join("output/data/scene")),
        "the nearest wins"
    );
    let absolute = root.path().join("data/scene");
    assert_eq!(find_training_cameras(absolute.to_str().unwrap(), &model), Some(absolute));
    assert_eq!(find_training_cameras("", &model), None);
}
