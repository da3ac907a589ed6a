//! Tests of reading cameras from COLMAP reconstructions.

use std::fs;
use std::path::Path;

use glam::{DMat3, DVec3};

use crate::files::cameras::{CameraOptions, TimesSource, load};
use crate::model::Split;

/// Writes a COLMAP reconstruction with one camera and three images to `folder`, in binary files if `binary` is true,
/// else in text files. `lens` is the line of the camera in `cameras.txt` without its number: the name of the camera
/// model, the width, the height and the parameters.
fn write_colmap(folder: &Path, lens: &str, binary: bool) {
    let images: [(u32, [f64; 7], u32, &str); 3] = [
        (7, [0.5f64.sqrt(), 0.5f64.sqrt(), 0.0, 0.0, 1.0, 2.0, 3.0], 2, "cam1/frame_0003.png"),
        (2, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0], 2, "cam1/frame_0001.png"),
        (9, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 5.0], 2, "test/frame_0002.png"),
    ];
    let sparse = folder.join("sparse/0");
    fs::create_dir_all(&sparse).unwrap();
    if !binary {
        let mut text = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n".to_owned();
        for (id, pose, camera, name) in images {
            let pose = pose.map(|value| value.to_string()).join(" ");
            text += &format!("{id} {pose} {camera} {name}\n{}\n", if id == 2 { "" } else { "1.5 2.5 -1" });
        }
        fs::write(sparse.join("cameras.txt"), format!("# Camera list\n2 {lens}\n")).unwrap();
        fs::write(sparse.join("images.txt"), text).unwrap();
        return;
    }
    let words: Vec<&str> = lens.split(' ').collect();
    let model = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL"].iter().position(|name| *name == words[0]).unwrap();
    let mut bytes = [&1u64.to_le_bytes()[..], &2u32.to_le_bytes(), &(model as u32).to_le_bytes()].concat();
    for side in &words[1..3] {
        bytes.extend(side.parse::<u64>().unwrap().to_le_bytes());
    }
    for value in &words[3..] {
        bytes.extend(value.parse::<f64>().unwrap().to_le_bytes());
    }
    fs::write(sparse.join("cameras.bin"), bytes).unwrap();
    let mut bytes = 3u64.to_le_bytes().to_vec();
    for (id, pose, camera, name) in images {
        bytes.extend(id.to_le_bytes());
        bytes.extend(pose.iter().flat_map(|value| value.to_le_bytes()));
        bytes.extend(camera.to_le_bytes());
        bytes.extend([name.as_bytes(), &[0], &1u64.to_le_bytes(), &[1; 24]].concat());
    }
    fs::write(sparse.join("images.bin"), bytes).unwrap();
}

#[test]
fn colmap_text_and_binary_give_the_same_rig() {
    let [text, binary] = [false, true].map(|binary| {
        let folder = tempfile::tempdir().unwrap();
        write_colmap(folder.path(), "PINHOLE 80 60 70 71 39.5 31", binary);
        let rig = load(folder.path(), &CameraOptions::default()).unwrap();
        for file in ["sparse", "sparse/0"] {
            assert_eq!(load(&folder.path().join(file), &CameraOptions::default()).unwrap().views, rig.views, "{file}");
        }
        rig
    });
    assert_eq!(text.cameras, binary.cameras);
    assert!(text.origin.starts_with("sparse/0 (times from"), "{}", text.origin);
    let [times, splits] = [&text, &binary]
        .map(|rig| rig.views.iter().map(|rig_view| (rig_view.time, rig_view.split)).collect::<Vec<_>>());
    assert_eq!(times, splits);
    // The images are in natural order of their names, not in the order of the COLMAP file.
    assert_eq!(times, [(Some(0.0), Split::Train), (Some(1.0), Split::Train), (Some(0.5), Split::Test)]);
    let first = &text.cameras[0];
    assert_eq!((first.width, first.height, first.fx, first.fy, first.cx, first.cy), (80, 60, 70.0, 71.0, 39.5, 31.0));
    assert_eq!((first.rotation, first.translation), (DMat3::IDENTITY, DVec3::new(0.0, 0.0, 4.0)));
    // A quarter turn about x maps y to z.
    let turned = text.cameras[1].rotation * DVec3::Y;
    assert!((turned - DVec3::Z).length() < 1e-15, "{turned}");
    assert!(text.views[0].image.as_ref().unwrap().ends_with("cam1/frame_0001.png"));
}

#[test]
fn colmap_folders_per_frame_share_the_first_cameras() {
    let root = tempfile::tempdir().unwrap();
    let first = root.path().join("colmap_3");
    write_colmap(&first, "PINHOLE 80 60 70 71 39.5 31", true);
    let load =
        |path: &Path, frames: Option<usize>| load(path, &CameraOptions { frames, ..CameraOptions::default() }).unwrap();
    // A single folder has no times, and the camera numbers in image names must not be taken for times.
    assert!(load(&first, None).times().is_empty());
    for k in 4..6 {
        fs::create_dir(root.path().join(format!("colmap_{k}"))).unwrap();
    }
    let rig = load(&first, None);
    assert_eq!(load(root.path(), None).views, rig.views);
    assert_eq!(rig.times(), [0.0, 1.0 / 3.0, 2.0 / 3.0]);
    assert_eq!((rig.views.len(), rig.cameras.len()), (9, 3));
    let rig_view = &rig.views[4];
    assert!(rig_view.image.as_ref().unwrap().ends_with("colmap_4/cam1/frame_0003.png"), "{rig_view:?}");
    let splits: Vec<Split> = rig.views[3..6].iter().map(|rig_view| rig_view.split).collect();
    assert_eq!(splits, [Split::Test, Split::Train, Split::Test]);
    // The number of frames may be given, because a model may have been trained on fewer frames and its images may be
    // elsewhere.
    assert_eq!(load(&first, Some(50)).times()[49], 0.98);
}

#[test]
fn colmap_times_come_from_a_table_or_are_absent() {
    let folder = tempfile::tempdir().unwrap();
    write_colmap(folder.path(), "SIMPLE_PINHOLE 80 60 70 40 30", false);
    let with = |times: TimesSource| load(folder.path(), &CameraOptions { times, ..CameraOptions::default() });
    let table = folder.path().join("t.csv");
    fs::write(&table, "name,time\ncam1/frame_0001.png,0.25\nframe_0003.png, 0.5\nframe_0002,4\n").unwrap();
    let times: Vec<_> =
        with(TimesSource::Table(table.clone())).unwrap().views.iter().map(|rig_view| rig_view.time).collect();
    assert_eq!(times, [Some(0.25), Some(0.5), Some(4.0)]);
    assert!(with(TimesSource::None).unwrap().times().is_empty());
    for (text, parts) in [
        ("frame_0001,0\n", &["t.csv", "frame_0003.png"][..]),
        ("frame_0001 0\n", &["line 1", "a comma"]),
        ("a,0\nframe_0001,nan\n", &["line 2", "nan"]),
        ("a,0\na,1\n", &["line 2", "once"]),
    ] {
        fs::write(&table, text).unwrap();
        let message = with(TimesSource::Table(table.clone())).unwrap_err().to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{parts:?} are not in {message:?}");
    }
}

#[test]
fn malformed_colmap_reconstructions_are_refused() {
    let message = |lens: &str, binary: bool, edit: &dyn Fn(&Path)| {
        let folder = tempfile::tempdir().unwrap();
        write_colmap(folder.path(), lens, binary);
        edit(&folder.path().join("sparse/0"));
        load(folder.path(), &CameraOptions::default()).err().map(|error| error.to_string())
    };
    let refused = |lens: &str, parts: &[&str]| {
        for binary in [false, true] {
            let message = message(lens, binary, &|_| ()).expect(lens);
            assert!(parts.iter().all(|part| message.contains(part)), "{parts:?} are not in {message:?}");
        }
    };
    assert_eq!(message("SIMPLE_RADIAL 80 60 70 40 30 0", true, &|_| ()), None, "no distortion");
    refused("SIMPLE_RADIAL 80 60 70 40 30 0.1", &["without distortion", "SIMPLE_RADIAL", "image_undistorter"]);
    refused("PINHOLE 80 0 70 70 40 30", &["pixels a side", "80 × 0"]);
    // A truncated file is refused at any length and never read past its end.
    let folder = tempfile::tempdir().unwrap();
    write_colmap(folder.path(), "PINHOLE 80 60 70 71 39.5 31", true);
    for name in ["cameras.bin", "images.bin"] {
        let file = folder.path().join("sparse/0").join(name);
        let whole = fs::read(&file).unwrap();
        for len in 0..whole.len() {
            fs::write(&file, &whole[..len]).unwrap();
            let message = load(folder.path(), &CameraOptions::default()).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains("byte"), "{len}: {message}");
        }
        fs::write(&file, [&u64::MAX.to_le_bytes()[..], &whole[8..]].concat()).unwrap();
        assert!(load(folder.path(), &CameraOptions::default()).is_err());
        fs::write(&file, whole).unwrap();
    }
}
