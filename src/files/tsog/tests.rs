use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;

use serde_json::{Value, json};
use zip::write::FileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::read::{is_tsog, read_tsog};
use super::write::write_tsog;
use super::{TimedGaussians, Timeline, codes_per_frame};
use crate::files::ftgs::{ClipTimes, LOG_TIME_DEVIATION, PARAMS_PER_GAUSSIAN, TIME_CENTER, VELOCITY};
use crate::files::webp::RgbaImage;
use crate::limits::ReadLimit;
use crate::model::{AttributeValues, Gaussians, StoredParams, opacity};

const COUNT: usize = 40;

/// Returns a pseudorandom number from −0.5 to 0.5 that depends on `seed` and `i`.
fn noise(seed: usize, i: usize) -> f32 {
    ((i * 379 + seed * 1013) % 997) as f32 / 997.0 - 0.5
}

/// Returns Gaussians with the visibility `timeline` and the SH degree `sh_degree`.
fn timed(timeline: Timeline, sh_degree: usize) -> TimedGaussians {
    let mut gaussians = Gaussians::zeros(COUNT, sh_degree);
    let mut own = AttributeValues::zeros(timeline.param_count(), COUNT);
    for i in 0..COUNT {
        gaussians.position.set_row(i, [0, 1, 2].map(|c| 20.0 * noise(c, i)));
        gaussians.rotation.set_row(i, [3, 4, 5, 6].map(|c| noise(c, i)));
        gaussians.log_scale.set_row(i, [7, 8, 9].map(|c| 2.0 * noise(c, i) - 3.0));
        gaussians.opacity_logit.set_row(i, [4.0 * noise(10, i)]);
        (0..gaussians.sh.width()).for_each(|c| gaussians.sh.plane_mut(c)[i] = noise(11 + c, i));
        match timeline {
            Timeline::Still => {}
            Timeline::Frames(frames) => own.plane_mut(0)[i] = (i % frames) as f32,
            Timeline::Windows => {
                own.plane_mut(TIME_CENTER)[i] = 1.4 * noise(61, i) + 0.5;
                own.plane_mut(LOG_TIME_DEVIATION)[i] = 2.0 * noise(62, i) - 2.0;
                (0..3).for_each(|c| own.plane_mut(VELOCITY + c)[i] = 6.0 * noise(63 + c, i));
            }
        }
    }
    let clip = ClipTimes { frames: Some(25), ..ClipTimes::UNIT_INTERVAL };
    TimedGaussians { params: StoredParams { gaussians, format_specific: own }, timeline, clip }
}

fn path(folder: &tempfile::TempDir) -> std::path::PathBuf {
    folder.path().join("a.tsog")
}

/// Returns the content of `meta.json` and the names of all files in the archive at `path`.
fn meta(path: &Path) -> (Value, Vec<String>) {
    let mut archive = ZipArchive::new(File::open(path).unwrap()).unwrap();
    let names = archive.file_names().map(str::to_owned).collect();
    let text = std::io::read_to_string(archive.by_name("meta.json").unwrap()).unwrap();
    (serde_json::from_str(&text).unwrap(), names)
}

/// Decodes the image file called `name` in the archive at `path`.
fn image(path: &Path, name: &str) -> RgbaImage {
    let mut archive = ZipArchive::new(File::open(path).unwrap()).unwrap();
    let mut bytes = Vec::new();
    archive.by_name(name).unwrap().read_to_end(&mut bytes).unwrap();
    RgbaImage::from_webp(&bytes, 1 << 20).unwrap()
}

/// Rewrites the archive at `path`: changes its `meta.json` by `change`, and compresses all files in it by `method`.
fn rewrite(path: &Path, method: CompressionMethod, change: impl FnOnce(&mut Value)) {
    let (mut text, names) = meta(path);
    change(&mut text);
    let mut archive = ZipArchive::new(File::open(path).unwrap()).unwrap();
    let files: Vec<(String, Vec<u8>)> = names
        .into_iter()
        .map(|name| {
            let mut bytes = Vec::new();
            archive.by_name(&name).unwrap().read_to_end(&mut bytes).unwrap();
            if name == "meta.json" { (name, text.to_string().into_bytes()) } else { (name, bytes) }
        })
        .collect();
    let mut out = ZipWriter::new(File::create(path).unwrap());
    for (name, bytes) in files {
        out.start_file(name, FileOptions::default().compression_method(method)).unwrap();
        out.write_all(&bytes).unwrap();
    }
    out.finish().unwrap();
}

/// Returns, for each Gaussian of `written`, the index of the Gaussian of `found` with the nearest position. The order
/// differs because files are written in Morton order.
fn matched(written: &TimedGaussians, found: &TimedGaussians) -> Vec<u32> {
    let nearest = |row: usize| {
        let at = written.params.gaussians.position.row::<3>(row);
        let distance = |other: &u32| -> f32 {
            let to = found.params.gaussians.position.row::<3>(*other as usize);
            at.iter().zip(to).map(|(a, b)| (a - b).powi(2)).sum()
        };
        (0..COUNT as u32).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()
    };
    (0..COUNT).map(nearest).collect()
}

#[test]
fn windows_and_velocities_are_within_half_a_step() {
    let folder = tempfile::tempdir().unwrap();
    let written = timed(Timeline::Windows, 0);
    write_tsog(&written, &path(&folder)).unwrap();
    let found = read_tsog(&path(&folder), ReadLimit::NONE).unwrap();
    assert_eq!((found.timeline, found.clip), (Timeline::Windows, written.clip));
    let meta = meta(&path(&folder)).0;
    let range = |pointer: &str| meta.pointer(pointer).unwrap().as_f64().unwrap();
    let half_step = |member: &str, axis: usize, steps: f64| {
        0.5 * (range(&format!("{member}/maxs{axis_}", axis_ = index(member, axis)))
            - range(&format!("{member}/mins{axis_}", axis_ = index(member, axis))))
            / steps
    };
    let steps = if meta["temporal"]["means"]["files"].as_array().unwrap().len() == 1 { 255.0 } else { 65535.0 };
    let rows = matched(&written, &found);
    for (row, &other) in rows.iter().enumerate() {
        let own =
            |from: &TimedGaussians, plane: usize, row: usize| f64::from(from.params.format_specific.plane(plane)[row]);
        let pair = |plane: usize| (own(&written, plane, row), own(&found, plane, other as usize));
        let near = |a: f64, b: f64, within: f64, what: &str| {
            assert!((a - b).abs() <= 1.001 * within + 1e-6, "{what} of {row}: {a}, found {b}");
        };
        let (a, b) = pair(TIME_CENTER);
        near(a, b, half_step("/timeline", 0, 65535.0), "center");
        let (a, b) = pair(LOG_TIME_DEVIATION);
        near(a.exp(), b.exp(), half_step("/timeline", 1, 65535.0), "deviation");
        for c in 0..3 {
            let (a, b) = pair(VELOCITY + c);
            near(a, b, half_step("/temporal/means", c, steps), "velocity");
        }
        let alpha = |from: &TimedGaussians, row: usize| opacity(from.params.gaussians.opacity_logit.plane(0)[row]);
        near(alpha(&written, row), alpha(&found, other as usize), 0.5 / 255.0, "opacity");
    }
    let mut all = rows;
    all.sort_unstable();
    assert!(all.iter().copied().eq(0..COUNT as u32), "{all:?}");
}

/// Returns the last part of the JSON pointer to one value of a value range in `meta.json`: the minimum or maximum for
/// axis `axis`. `member` is the first part of the pointer. Ranges of velocities, whose pointers begin with `/temporal`,
/// are nested in one more list than other ranges.
fn index(member: &str, axis: usize) -> String {
    if member.starts_with("/temporal") { format!("/0/{axis}") } else { format!("/{axis}") }
}

#[test]
fn single_frames_are_exact_for_any_number_of_them() {
    let folder = tempfile::tempdir().unwrap();
    for frames in [1, 2, 7, 300, 65_536] {
        let mut written = timed(Timeline::Frames(frames), 0);
        written.params.format_specific.plane_mut(0)[3] = (frames - 1) as f32;
        write_tsog(&written, &path(&folder)).unwrap();
        let found = read_tsog(&path(&folder), ReadLimit::NONE).unwrap();
        assert_eq!((found.timeline, found.clip.frames), (Timeline::Frames(frames), Some(frames)));
        for (row, other) in matched(&written, &found).into_iter().enumerate() {
            assert_eq!(
                found.params.format_specific.plane(0)[other as usize],
                written.params.format_specific.plane(0)[row]
            );
        }
    }
    assert_eq!([1, 2, 3, 300, 65_536].map(codes_per_frame), [65_536, 32_768, 21_845, 218, 1]);
}

#[test]
fn frame_codes_are_in_the_middle_of_a_frame() {
    let folder = tempfile::tempdir().unwrap();
    write_tsog(&timed(Timeline::Frames(10), 0), &path(&folder)).unwrap();
    let (low, high) = (image(&path(&folder), "timeline_l.webp"), image(&path(&folder), "timeline_u.webp"));
    for (low, high) in low.pixels.iter().zip(&high.pixels).take(COUNT) {
        let code = usize::from(low[0]) + 256 * usize::from(high[0]);
        assert_eq!((code % 6553, &low[1..], &high[1..]), (3276, &[0, 0, 255][..], &[0, 0, 255][..]));
    }
}

#[test]
fn sh_coefficients_of_every_degree_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    for degree in 0..=3 {
        let written = timed(Timeline::Windows, degree);
        write_tsog(&written, &path(&folder)).unwrap();
        let found = read_tsog(&path(&folder), ReadLimit::NONE).unwrap();
        assert_eq!(found.params.gaussians.sh_degree(), degree);
        for (row, other) in matched(&written, &found).into_iter().enumerate() {
            for c in 0..found.params.gaussians.sh.width() {
                let [a, b] = [&written, &found].map(|from| from.params.gaussians.sh.plane(c));
                assert!((a[row] - b[other as usize]).abs() < 0.01, "coefficient {c} of {row}");
            }
        }
    }
}

#[test]
fn meta_has_the_members_of_the_playback_profile() {
    let folder = tempfile::tempdir().unwrap();
    let mut written = timed(Timeline::Windows, 1);
    written.clip = ClipTimes { first: 2.0, last: 3.5, frames: Some(31), frame_rate: 30.0 };
    write_tsog(&written, &path(&folder)).unwrap();
    let (meta, names) = meta(&path(&folder));
    assert_eq!((&meta["version"], &meta["count"]), (&json!(4), &json!(COUNT)));
    assert_eq!(meta["profile"], json!({ "id": "org.opsiclear.tsog-playback", "version": 1 }));
    assert_eq!((&meta["timeline"]["type"], &meta["shN"]["bands"]), (&json!(1), &json!(1)));
    assert_eq!(meta["playback"], json!({ "duration": 1.0, "fps": 30.0 }));
    assert_eq!(meta["splatsieve"]["times"], json!([2.0, 3.5]));
    assert!(meta["timeline"].get("N").is_none() && meta.get("audio").is_none());
    assert!(names.contains(&"meta.json".to_owned()) && is_tsog(&path(&folder)));
    assert_eq!(read_tsog(&path(&folder), ReadLimit::NONE).unwrap().clip, written.clip);
    written.timeline = Timeline::Still;
    write_tsog(&written, &path(&folder)).unwrap();
    assert!(self::meta(&path(&folder)).0.get("timeline").is_none());
}

#[test]
fn wide_windows_keep_their_opacity_within_the_sequence() {
    let folder = tempfile::tempdir().unwrap();
    let mut written = timed(Timeline::Windows, 0);
    for i in 0..COUNT {
        written.params.format_specific.plane_mut(TIME_CENTER)[i] = 60.0 * noise(5, i);
        written.params.format_specific.plane_mut(LOG_TIME_DEVIATION)[i] = 3.0 + noise(6, i);
    }
    write_tsog(&written, &path(&folder)).unwrap();
    let found = read_tsog(&path(&folder), ReadLimit::NONE).unwrap();
    let state = |from: &TimedGaussians, row: usize, time: f64| {
        let own = |plane: usize| f64::from(from.params.format_specific.plane(plane)[row]);
        let alpha = opacity(from.params.gaussians.opacity_logit.plane(0)[row]);
        let dt = time - own(TIME_CENTER);
        let at = from.params.gaussians.position.row::<3>(row);
        let place = [0, 1, 2].map(|c| f64::from(at[c]) + own(VELOCITY + c) * dt);
        (place, alpha * (-0.5 * (dt / own(LOG_TIME_DEVIATION).exp()).powi(2)).exp())
    };
    for row in 0..COUNT {
        let apart = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let nearest = |other: &usize| apart(state(&found, *other, 0.5).0, state(&written, row, 0.5).0);
        let other = (0..COUNT).min_by(|a, b| nearest(a).total_cmp(&nearest(b))).unwrap();
        for time in [0.0, 0.5, 1.0] {
            let (a, b) = (state(&written, row, time), state(&found, other, time));
            assert!((a.1 - b.1).abs() < 0.006 && apart(a.0, b.0) < 0.05, "{row} at {time}: {a:?}, found {b:?}");
        }
    }
}

#[test]
fn deflated_archives_and_files_without_a_profile_are_read() {
    let folder = tempfile::tempdir().unwrap();
    write_tsog(&timed(Timeline::Windows, 0), &path(&folder)).unwrap();
    let before = read_tsog(&path(&folder), ReadLimit::NONE).unwrap();
    rewrite(&path(&folder), CompressionMethod::Deflated, |meta| {
        let members = meta.as_object_mut().unwrap();
        for name in ["profile", "fps", "playback"] {
            members.remove(name);
        }
        members.insert("unknown".to_owned(), json!({ "ignored": true }));
    });
    let found = read_tsog(&path(&folder), ReadLimit::NONE).unwrap();
    assert_eq!((found.params, found.clip.frames), (before.params, Some(300)));
}

#[test]
fn contradicting_members_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |timeline: Timeline, change: &dyn Fn(&mut Value)| {
        write_tsog(&timed(timeline, 1), &path(&folder)).unwrap();
        rewrite(&path(&folder), CompressionMethod::Stored, change);
        read_tsog(&path(&folder), ReadLimit::NONE).unwrap_err().to_string()
    };
    type Change = (&'static str, Value, &'static str);
    let windows: [Change; 15] = [
        ("/version", json!(2), "version"),
        ("/count", json!(0), "count"),
        ("/count", json!(4_000_000_000_u64), "timeline_l.webp"),
        ("/timeline", json!(null), "timeline"),
        ("/timeline/type", json!(2), "type"),
        ("/timeline/mins/1", json!(0.0), "timeline, mins"),
        ("/timeline/maxs/0", json!(-9.0), "timeline"),
        ("/timeline/files/0", json!("meta.json"), "meta.json"),
        ("/timeline/files/1", json!("none.webp"), "none.webp"),
        ("/temporal/means/maxs/0/1", json!(1e300), "temporal, means"),
        ("/temporal/means/files", json!([]), "temporal, means, files"),
        ("/playback/duration", json!(-1.0), "playback, duration"),
        ("/means/maxs/0", json!(99.0), "means"),
        ("/shN/bands", json!(2), "shN_centroids.webp"),
        ("/quats/files/0", json!("sh0.webp"), "sh0.webp"),
    ];
    for (pointer, value, expected) in windows {
        let message = refused(Timeline::Windows, &|meta| *meta.pointer_mut(pointer).unwrap() = value.clone());
        assert!(
            message.contains("a.tsog") && (message.contains(expected) || pointer == "/count"),
            "{pointer}: {message}"
        );
    }
    let frames: [Change; 2] =
        [("/timeline/N", json!(0), "timeline, N"), ("/timeline/delta", json!(7), "timeline, delta")];
    for (pointer, value, expected) in frames {
        let message = refused(Timeline::Frames(9), &|meta| *meta.pointer_mut(pointer).unwrap() = value.clone());
        assert!(message.contains(expected), "{pointer}: {message}");
    }
    let message = refused(Timeline::Windows, &|meta| meta["temporal"]["rotation"] = json!(1));
    assert!(message.contains("rotation"), "{message}");
}

#[test]
fn changed_or_cut_files_never_panic() {
    let folder = tempfile::tempdir().unwrap();
    write_tsog(&timed(Timeline::Windows, 0), &path(&folder)).unwrap();
    let whole = std::fs::read(path(&folder)).unwrap();
    for at in (0..whole.len()).step_by(7) {
        let mut changed = whole.clone();
        changed[at] ^= 0x41;
        std::fs::write(path(&folder), &changed).unwrap();
        _ = read_tsog(&path(&folder), ReadLimit::NONE);
        std::fs::write(path(&folder), &whole[..at]).unwrap();
        assert!(read_tsog(&path(&folder), ReadLimit::NONE).is_err(), "cut at {at}");
    }
}

#[test]
fn memory_is_checked_before_it_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    write_tsog(&timed(Timeline::Windows, 0), &path(&folder)).unwrap();
    rewrite(&path(&folder), CompressionMethod::Stored, |meta| meta["count"] = json!(1_000_000));
    let message = read_tsog(&path(&folder), ReadLimit::new(1 << 20)).unwrap_err().to_string();
    assert!(message.contains("--memory") && message.contains("count"), "{message}");
}

#[test]
fn empty_models_and_too_many_frames_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let empty = StoredParams {
        gaussians: Gaussians::zeros(0, 0),
        format_specific: AttributeValues::zeros(PARAMS_PER_GAUSSIAN, 0),
    };
    let empty = TimedGaussians { params: empty, ..timed(Timeline::Windows, 0) };
    assert!(write_tsog(&empty, &path(&folder)).unwrap_err().to_string().contains("at least one"));
    let many = TimedGaussians { timeline: Timeline::Frames(70_000), ..timed(Timeline::Frames(9), 0) };
    assert!(write_tsog(&many, &path(&folder)).unwrap_err().to_string().contains("70000 frames"));
}
