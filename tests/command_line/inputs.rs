//! Tests of inputs and requests: output names, lists, text files, cameras of other programs, and the messages about
//! them.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::scene::{Workplace, files, program, tiny};
use splatsieve::files::image::read_image;
use splatsieve::files::image::write::jpeg_bytes;

#[test]
fn recovering_no_frame_fails_and_writes_nothing() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} scene.gseq");
    let whole = fs::read(workplace.path("scene.gseq")).unwrap();
    // The header is complete, but no tile is.
    fs::write(workplace.path("cut.gseq"), &whole[..4096]).unwrap();
    workplace.refused(
        1,
        "info cut.gseq --repair saved.gseq",
        &["cut.gseq", "at least one complete frame", "nothing was written"],
    );
}

#[test]
fn result_without_gaussians_is_an_error() {
    let workplace = Workplace::new();
    for options in ["-o out", "-o out.gseq --prune-only", "-o out.gsz", "-o out --no-refine"] {
        let parts = ["at least one Gaussian that stays", "none of 300, 300 of which --drop-ids"];
        workplace.refused(1, &format!("compress {{tiny}} --drop-ids 0-299 --quiet {options}"), &parts);
    }
}

#[test]
fn a_converted_file_that_is_larger_than_its_input_says_so() {
    let workplace = Workplace::new();
    let text = workplace.done("convert {tiny} x.ftgs.ply");
    assert!(text.contains("larger than its input") && text.contains("motions fitted to them"), "{text}");
    assert!(!workplace.done("convert {tiny} x.spz --frames 1").contains("larger than its input"));
}

#[test]
fn unknown_output_extension_is_refused_with_choices() {
    let workplace = Workplace::new();
    let parts = ["x.txt", "NAME.gsz", "NAME.gseq", "NAME.ply", "a folder", "--as"];
    workplace.refused(2, "compress {tiny} -o x.txt", &parts);
    workplace.refused(2, "convert {tiny} x.txt", &["x.txt", "NAME.gseq"]);
    workplace.refused(2, "info nowhere.gseq --repair x.txt", &["x.txt", "NAME.gseq"]);
    workplace.refused(2, "convert {tiny} x.txt --as ply-sequence", &["x.txt", "a folder"]);
    workplace.refused(2, "report {tiny} {tiny} -o x.html", &["x.html", "a folder"]);
    workplace.refused(2, "render {tiny} --all -o x.zip", &["x.zip", "a folder"]);
    // The kind is given with `--as`, or the extension is not that of a file format.
    workplace.done("compress {tiny} -o small.v2 --prune-only --no-refine --quiet");
    assert!(workplace.path("small.v2/cfg_args").is_file());
    workplace.done("compress {tiny} -o x.model --as model --prune-only --no-refine --quiet");
}

#[test]
fn output_folder_may_exist_only_if_empty() {
    let workplace = Workplace::new();
    for (verb, made) in [
        ("compress {tiny} --prune-only --no-refine --quiet -o out", "cfg_args"),
        ("convert {tiny} out --as ply-sequence", "frame_00000.ply"),
        ("render {tiny} --all --quiet -o out", "t000_v00.png"),
    ] {
        fs::create_dir(workplace.path("out")).unwrap();
        workplace.done(verb);
        assert!(workplace.path("out").join(made).is_file() || verb.starts_with("render"), "{verb}");
        fs::remove_dir_all(workplace.path("out")).unwrap();
        fs::create_dir(workplace.path("out")).unwrap();
        fs::write(workplace.path("out/notes.txt"), "mine").unwrap();
        workplace.refused(2, verb, &["exists already", "--overwrite"]);
        fs::remove_dir_all(workplace.path("out")).unwrap();
    }
}

#[test]
fn lists_are_separated_by_commas() {
    let workplace = Workplace::new();
    let sweep = "sweep {tiny} -o curves --quiet --max-frames 2 --methods opacity,scale";
    let curves = workplace.done(&format!("{sweep} --fractions 0.5,0.2"));
    assert!(curves.contains("scale") && !curves.contains("random"), "{curves}");
    workplace.refused(2, &format!("{sweep} --fractions 0.5, 0.2"), &["unexpected argument", "0.2"]);
    let compress = "compress {tiny} -o out --dry-run --quiet --no-refine";
    workplace.done(&format!("{compress} --drop-ids 3,5 --keep-box -1,-1,-1,-0.9,-0.9,-0.9"));
    workplace.refused(2, &format!("{compress} --keep-box -1,-1,-1,1,1"), &["six numbers"]);
    workplace.refused(2, "compress {tiny} -o out --drop-ids 10-5", &["runs forwards, such as 5-10", "10-5"]);
}

#[test]
fn text_files_may_have_byte_order_marks_and_hints_fit() {
    let workplace = Workplace::new();
    let cameras = fs::read(tiny().join("transforms_train.json")).unwrap();
    let with_mark = [b"\xef\xbb\xbf", &cameras[..]].concat();
    let write = |name: &str, bytes: &[u8]| fs::write(workplace.path(name), bytes).unwrap();
    write("marked.json", &with_mark);
    workplace.done("compress {tiny} --cameras marked.json -o out --dry-run --prune-only --no-refine --quiet");
    let refused = |parts: &[&str], absent: &[&str]| {
        let run = workplace.run("compress {tiny} --cameras bad.json -o out");
        assert_eq!(run.code, 1, "{}", run.stderr);
        for part in parts {
            assert!(run.stderr.contains(part), "{part:?} is not in {:?}", run.stderr);
        }
        for part in absent {
            assert!(!run.stderr.contains(part), "{part:?} is in {:?}", run.stderr);
        }
    };
    write("bad.json", &cameras[..cameras.len() / 2]);
    refused(&["bad.json", "cut short"], &["NaN"]);
    write("bad.json", b"{\"frames\": [{\"file_path\": \"caf\xe9\"}]}");
    refused(&["bad.json, byte 30", "0xe9", "Latin-1"], &["NaN", "cut short"]);
    write("bad.json", b"{\"frames\": [{\"time\": NaN}]}");
    refused(&["NaN and Infinity are not JSON"], &["cut short", "Latin-1"]);
    write("bad.json", b"\xff\xfe{\0");
    refused(&["UTF-16"], &["NaN", "Latin-1"]);
    write("r.toml", b"[score]\nmu = 2.0 # caf\xe9\n");
    workplace.refused(1, "compress {tiny} --recipe r.toml -o out", &["r.toml, byte 22", "Latin-1"]);
    write("ids.txt", b"\xef\xbb\xbf3\n5 # caf\n");
    workplace.done("compress {tiny} --drop-ids ids.txt -o out --dry-run --prune-only --no-refine --quiet");
}

/// Messages are for users, so none may contain Rust debug formatting.
#[test]
fn no_message_contains_debug_formatting() {
    // Numbers, which look the same in debug formatting.
    let numbers = [
        "array.shape()",
        "{shape:?}",
        "tensor.shape",
        "{rgb:?}",
        "{low:?} to {high:?}",
        "{aabb:?}",
        "to_cols_array_2d()",
        "values[id]",
    ];
    let mut found = Vec::new();
    let mut pending = vec![
        Path::new(env!("CARGO_MANIFEST_DIR")).join("src"),
        Path::new(env!("CARGO_MANIFEST_DIR")).join("format/src"),
    ];
    while let Some(folder) = pending.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap().to_owned();
            if path.is_dir() {
                pending.push(path);
            } else if name.ends_with(".rs")
                && name != "tests.rs"
                && !path.components().any(|part| part.as_os_str() == "selfcheck")
            {
                let text = fs::read_to_string(&path).unwrap();
                let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
                let text = text.split("#[cfg(test)]\npub(crate) mod tests {").next().unwrap();
                let lines = text.lines().filter(|line| line.contains(":?}") || line.contains(":#?}"));
                let lines = lines.filter(|line| !line.contains("panic!") && !line.contains("assert"));
                found.extend(
                    lines
                        .filter(|line| !numbers.iter().any(|number| line.contains(number)))
                        .map(|line| format!("{}: {}", path.display(), line.trim())),
                );
            }
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
    // Characters that a terminal does not show appear as their code point.
    let workplace = Workplace::new();
    fs::write(workplace.path("ids.txt"), "3\u{200b}x\u{7}\n").unwrap();
    workplace.refused(2, "compress {tiny} --drop-ids ids.txt -o out", &["\"3<U+200B>x<U+0007>\""]);
}

/// Each run fills a file system of 24 KiB that only this test uses.
#[test]
#[ignore = "needs namespaces of process ids"]
fn full_disk_error_names_the_file_being_written() {
    let workplace = Workplace::new();
    fs::create_dir(workplace.path("disk")).unwrap();
    let (program, tiny) = (program(), tiny());
    let (program, tiny) = (program.display(), tiny.display());
    for (run, named) in [
        (format!("convert {tiny} disk/x.gseq"), "disk/x.gseq: No space"),
        (format!("convert {tiny} disk/x --as ply-sequence"), "disk/x/frame_0000"),
        (format!("score {tiny} -o disk/x.npz"), "disk/x.npz: No space"),
        (format!("render {tiny} --all -o disk/x"), "disk/x/t00"),
        (format!("compress {tiny} --prune-only --no-refine -o disk/x"), "disk/x/"),
        (format!("compress {tiny} -o x.gseq --scratch-dir disk"), "write a scratch file in disk: No space"),
    ] {
        let script = format!("mount -t tmpfs -o size=24k none disk && {program} --quiet {run}; ls -A disk | wc -l");
        let mut shell = crate::unshare(&["-m"]);
        let output = shell.args(["sh", "-c", &script]).current_dir(workplace.path("")).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(told.contains(named) && told.contains("free disk space"), "{run}: {told}");
        for part in ["Os {", "splatsieve-tmp", "content", "ZipWriter", "Some("] {
            assert!(!told.contains(part), "{run}: {part:?} is in {told}");
        }
        assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "0", "{run} left something");
    }
}

#[test]
fn folder_inside_a_model_is_refused_naming_the_model() {
    let workplace = Workplace::new();
    for inside in ["point_cloud", "point_cloud/iteration_7"] {
        let run = workplace.run_words(["info", tiny().join(inside).to_str().unwrap()]);
        assert_eq!(run.code, 1, "{}", run.stderr);
        let parts = ["give the folder above", "tiny_model"];
        assert!(parts.iter().all(|part| run.stderr.contains(part)), "{}", run.stderr);
    }
}

#[test]
fn frames_take_camera_times_if_the_counts_match() {
    let workplace = Workplace::new();
    let scores = |arguments: &str| {
        let text = workplace.done(&format!("evaluate {{tiny}} {{tiny}} --cameras {{tiny}} {arguments} --json"));
        let mut found: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert!(found["render_ms"]["before"].as_f64().unwrap() > 0.0);
        found["render_ms"].take();
        found
    };
    assert_eq!(scores("--frames 10"), scores(""));
}

#[test]
fn ground_truth_is_compared_and_counted_where_it_exists() {
    let workplace = Workplace::new();
    workplace.done("render {tiny} --cameras {tiny} --all -o photos --quiet");
    let line = "evaluate {tiny} {tiny} --cameras {tiny} --ground-truth photos";
    let json =
        |line: &str| -> serde_json::Value { serde_json::from_str(&workplace.done(&format!("{line} --json"))).unwrap() };
    let whole = json(line);
    let of = whole["ground_truth"]["of"].as_u64().unwrap();
    assert_eq!(whole["ground_truth"]["pairs"], of);
    let mut photos: Vec<_> = fs::read_dir(workplace.path("photos"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|end| end == "png"))
        .collect();
    photos.sort();
    for photo in photos.iter().step_by(2) {
        fs::remove_file(photo).unwrap();
    }
    let some = json(line);
    let left = photos.len() as u64 / 2;
    assert_eq!((&some["ground_truth"]["pairs"], &some["ground_truth"]["of"]), (&left.into(), &of.into()));
    assert_eq!(some["psnr"], whole["psnr"], "the models are compared on all views");
    let text = workplace.done(&format!("{line} --csv scores.csv"));
    assert!(text.contains(&format!("{left} of {of} views have a photograph in photos")), "{text}");
    let csv = fs::read_to_string(workplace.path("scores.csv")).unwrap();
    let commas: Vec<usize> = csv.lines().map(|line| line.matches(',').count()).collect();
    assert!(commas.windows(2).all(|pair| pair[0] == pair[1]), "{csv}");
    fs::remove_dir_all(workplace.path("photos")).unwrap();
    fs::create_dir(workplace.path("photos")).unwrap();
    let parts = ["photos, frame ", "no such file, and no photograph of any other view", "PNG or JPEG files"];
    workplace.refused(1, line, &parts);
}

#[test]
fn photographs_may_be_jpeg_files() {
    let workplace = Workplace::new();
    let line = "evaluate {tiny} {tiny} --cameras {tiny} --json --ground-truth photos";
    let measured = || -> serde_json::Value { serde_json::from_str(&workplace.done(line)).unwrap() };
    workplace.done("render {tiny} --cameras {tiny} --split test --all -o photos --quiet");
    let of_png = measured();
    for (name, bytes) in files(&workplace.path("photos")) {
        if name.extension().is_some_and(|ending| ending == "png") {
            let path = workplace.path("photos").join(&name);
            let size = imagesize::blob_size(&bytes).unwrap();
            let image = read_image(&path, (size.width as u32, size.height as u32), [0.0; 3]).unwrap();
            fs::write(path.with_extension("jpg"), jpeg_bytes(&image, 100).unwrap()).unwrap();
            fs::remove_file(path).unwrap();
        }
    }
    let of_jpeg = measured();
    assert_eq!(of_png["ground_truth"]["pairs"], of_jpeg["ground_truth"]["pairs"]);
    let psnr = of_jpeg["ground_truth"]["original"]["psnr"].as_f64().unwrap();
    assert!(psnr > 35.0, "{psnr} dB");
}

#[test]
fn photographs_are_found_in_one_folder_per_camera() {
    let workplace = Workplace::new();
    workplace.done("render {tiny} --cameras {tiny} --split all --all -o photos --quiet");
    // File layout of DyNeRF: numbered cameras with gaps, one image per frame.
    for (place, camera) in ["cam00", "cam01", "cam03", "cam04", "cam07", "cam10"].iter().enumerate() {
        let images = workplace.path("rig").join(camera).join("images");
        fs::create_dir_all(&images).unwrap();
        for frame in 0..10 {
            let from = workplace.path("photos").join(format!("t{frame:03}_v{place:02}.png"));
            if from.is_file() {
                fs::copy(from, images.join(format!("{frame:04}.png"))).unwrap();
            }
        }
    }
    let line = |folder: &str| {
        format!("evaluate {{tiny}} {{tiny}} --cameras {{tiny}} --split all --json --ground-truth {folder}")
    };
    let json = |folder: &str| -> serde_json::Value { serde_json::from_str(&workplace.done(&line(folder))).unwrap() };
    let (named, of_rig) = (json("photos"), json("rig"));
    assert_eq!(named["ground_truth"]["psnr"], of_rig["ground_truth"]["psnr"]);
    assert_eq!(named["ground_truth"]["pairs"], of_rig["ground_truth"]["pairs"]);
}

#[test]
fn frame_gap_is_refused_by_name_unless_allowed() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} frames --as ply-sequence");
    fs::remove_file(workplace.path("frames/summary.json")).ok();
    workplace.done("info frames");
    fs::rename(workplace.path("frames/frame_00004.ply"), workplace.path("four.ply")).unwrap();
    let refused = |parts: &[&str]| {
        workplace.refused(1, "info frames", parts);
        workplace.refused(1, "compress frames -o out", parts);
        workplace.done("info frames --allow-gaps");
    };
    refused(&["frame_00004.ply", "frame_00003.ply, then frame_00005.ply", "--allow-gaps"]);
    fs::create_dir(workplace.path("frames/frame_00004.ply")).unwrap();
    refused(&["frame_00004.ply", "a folder", "--allow-gaps"]);
    fs::remove_dir(workplace.path("frames/frame_00004.ply")).unwrap();
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("nowhere.ply", workplace.path("frames/frame_00004.ply")).unwrap();
        let run = workplace.run("info frames");
        assert!(run.code == 1 && run.stderr.contains("a link to nothing"), "{}", run.stderr);
        fs::remove_file(workplace.path("frames/frame_00004.ply")).unwrap();
    }
    // A sequence of every other frame has no gap.
    for odd in ["01", "03", "05", "07", "09"] {
        fs::remove_file(workplace.path(&format!("frames/frame_000{odd}.ply"))).unwrap();
    }
    fs::rename(workplace.path("four.ply"), workplace.path("frames/frame_00004.ply")).unwrap();
    workplace.done("info frames");
}

#[test]
fn weights_override_cfg_args_with_a_warning() {
    let workplace = Workplace::new();
    for (name, bytes) in crate::scene::files(&tiny()) {
        let path = workplace.path("model").join(&name);
        if tiny().join(&name).is_dir() {
            fs::create_dir_all(path).unwrap();
        } else {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        }
    }
    let args = workplace.path("model/cfg_args");
    let text = fs::read_to_string(&args).unwrap();
    let line = "compress model -o out --dry-run --prune-only --no-refine --quiet";
    assert!(!workplace.done(line).contains("the weights are used"));
    let at = text.find("net_width=").expect("a width") + "net_width=".len();
    let end = at + text[at..].find(|c: char| !c.is_ascii_digit()).unwrap();
    fs::write(&args, format!("{}4321{}", &text[..at], &text[end..])).unwrap();
    let said = workplace.done(line);
    assert!(said.contains("net_width = 4321") && said.contains("the weights are used"), "{said}");
}

#[test]
fn cameras_that_see_nothing_are_refused() {
    let workplace = Workplace::new();
    let mut cameras: serde_json::Value =
        serde_json::from_slice(&fs::read(tiny().join("transforms_train.json")).unwrap()).unwrap();
    let line = "compress {tiny} --cameras far.json -o out --overwrite --prune-only --no-refine --quiet";
    let write = |cameras: &serde_json::Value| fs::write(workplace.path("far.json"), cameras.to_string()).unwrap();
    write(&cameras);
    assert!(!workplace.done(line).contains("warning"));
    for frame in cameras["frames"].as_array_mut().unwrap() {
        // Positions high above the scene, where no camera looks down.
        for (axis, place) in [1e4, 2e4, 9e4].into_iter().enumerate() {
            frame["transform_matrix"][axis][3] = place.into();
        }
    }
    write(&cameras);
    workplace.refused(2, line, &["far.json", "none of the 278 living Gaussians"]);
}

#[test]
fn still_takes_any_cameras_or_a_virtual_rig() {
    let workplace = Workplace::new();
    workplace.done("compress {tiny} --cameras {tiny} -o still.ply --ratio 0.9 --no-refine --quiet");
    // Camera file of this project, with one camera per image.
    let camera = |k: u32| {
        let (sin, cos) = f64::from(k).sin_cos();
        serde_json::json!({
            "v": k, "split": if k == 3 { "test" } else { "train" }, "width": 64, "height": 48, "fx": 60.0, "fy": 60.0,
            "cx": 32.0, "cy": 24.0, "w2c": [[cos, 0.0, -sin, 0.0], [0.0, 1.0, 0.0, 0.0], [sin, 0.0, cos, 4.0], [0.0, 0.0, 0.0, 1.0]]
        })
    };
    let cameras = serde_json::json!({ "background": [0, 0, 0], "frames": (0..4).map(camera).collect::<Vec<_>>() });
    fs::write(workplace.path("orbit.json"), cameras.to_string()).unwrap();
    let line = "compress still.ply -o small.ply --overwrite --ratio 0.5 --no-refine --json";
    let summary =
        |more: &str| -> serde_json::Value { serde_json::from_str(&workplace.done(&format!("{line} {more}"))).unwrap() };
    let given = summary("--cameras orbit.json");
    assert_eq!(given["output"]["gaussians"], summary("")["output"]["gaussians"]);
    // Visible contribution decides in both cases.
    let stages = |summary: &serde_json::Value| summary["stages"].to_string();
    assert!(stages(&given).contains("visible") && stages(&summary("")).contains("visible"), "{}", stages(&given));
    assert!(summary("")["notes"].to_string().contains("24 cameras"), "{}", summary("")["notes"]);
    // Cameras in the folder of the input are named, but not used.
    fs::create_dir(workplace.path("folder")).unwrap();
    fs::rename(workplace.path("still.ply"), workplace.path("folder/still.ply")).unwrap();
    fs::rename(workplace.path("orbit.json"), workplace.path("folder/cameras.json")).unwrap();
    let said = workplace.done("compress folder -o few.ply --ratio 0.5 --no-refine --json");
    assert!(said.contains("24 cameras") && said.contains("--cameras folder"), "{said}");
}

#[test]
fn convert_writes_every_kind_and_refuses_misfits() {
    let workplace = Workplace::new();
    for output in [
        "a.splatv",
        "a.4dgs",
        "a.ftgs.ply",
        "a.tsog",
        "a.gsd",
        "a.gseq",
        "frames --as ply-sequence",
        "model",
        "cloud.ply",
    ] {
        let said = workplace.done(&format!("convert {{tiny}} {output} --cameras {{tiny}}"));
        // A .ply has no motion.
        let frames = if output == "cloud.ply" { "1 frame" } else { "10 frames" };
        assert!(said.contains(&format!("300 Gaussians x {frames}, ")), "{said}");
    }
    let evaluate = |line: &str| -> f64 {
        let found: serde_json::Value = serde_json::from_str(&workplace.done(line)).unwrap();
        found["psnr"].as_f64().unwrap()
    };
    assert!(evaluate("evaluate {tiny} a.gseq --cameras {tiny} --json") > 90.0);
    let fitted = evaluate("evaluate {tiny} a.splatv --cameras {tiny} --json");
    assert!(fitted > 25.0, "{fitted} dB");
    for name in ["a.ftgs.ply", "a.tsog"] {
        let fitted = evaluate(&format!("evaluate {{tiny}} {name} --cameras {{tiny}} --json"));
        assert!(fitted > 25.0, "{name}: {fitted} dB");
    }
    assert_eq!(&fs::read(workplace.path("a.gsd")).unwrap()[..4], b"GSD1");
    assert_eq!(&fs::read(workplace.path("a.4dgs")).unwrap()[1..5], b"4DGS");
    workplace.refused(2, "convert {tiny} a.spz --cameras {tiny}", &["a.spz", "10 frames", ".splatv"]);
    workplace.done("convert {tiny} a.gsz");
    workplace.done("convert a.gsz unpacked");
    workplace.refused(2, "convert - a.gsz", &["splatsieve", "compress - -o NAME.gsz"]);
    workplace.refused(2, "convert {tiny} a.gseq --cameras {tiny}", &["a.gseq"]);
    workplace.refused(2, "convert a.gseq b --as model", &["only a trained model"]);
    for name in ["a.spz", "b"] {
        assert!(!workplace.path(name).exists(), "{name}");
    }
    workplace.done("convert cloud.ply still.spz");
    workplace.done("compress {tiny} --cameras {tiny} -o small.4dgs --ratio 0.5 --no-refine --quiet");
    assert!(
        fs::metadata(workplace.path("small.4dgs")).unwrap().len()
            < fs::metadata(workplace.path("a.4dgs")).unwrap().len()
    );
}

#[test]
fn files_of_players_are_compressed_to_their_own_format() {
    let workplace = Workplace::new();
    for (whole, small, kind) in [("a.ftgs.ply", "b.ftgs.ply", "ftgs-player model"), ("a.tsog", "b.tsog", "TSOG model")]
    {
        workplace.done(&format!("convert {{tiny}} {whole} --cameras {{tiny}}"));
        workplace.done(&format!("compress {whole} --cameras {{tiny}} -o {small} --ratio 0.5 --no-refine --quiet"));
        let size = |name: &str| fs::metadata(workplace.path(name)).unwrap().len();
        assert!(size(small) < size(whole), "{small}: {} of {}", size(small), size(whole));
        let info = workplace.done(&format!("info {small}"));
        assert!(info.contains(kind), "{info}");
    }
}

#[test]
#[ignore = "needs Python"]
fn scripts_report_errors_without_a_traceback() {
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts");
    let workplace = Workplace::new();
    fs::write(workplace.path("bad"), b"\xff\0no container, no table, no model").unwrap();
    let mut named: Vec<_> = [scripts.clone(), scripts.join("slurm"), scripts.join("benchmark")]
        .iter()
        .flat_map(|folder| fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()))
        .filter(|path| path.extension().is_some_and(|end| end == "py"))
        // This module is only imported by others.
        .filter(|path| !path.ends_with("stream_writer.py"))
        .collect();
    named.sort();
    assert!(named.len() > 20, "{named:?}");
    for script in &named {
        for arguments in [
            &[][..],
            &["nowhere"],
            &["nowhere", "nowhere"],
            &["bad", "bad"],
            &["nowhere", "nowhere", "nowhere"],
            &["--no-such-option"],
        ] {
            let mut python = Command::new(std::env::var_os("PYTHON").unwrap_or_else(|| "python3".into()));
            let output = python.arg(script).args(arguments).current_dir(workplace.path("")).output().unwrap();
            let told = String::from_utf8_lossy(&output.stderr);
            assert!(!told.contains("Traceback"), "{} {arguments:?}: {told}", script.display());
        }
    }
    // The reader of standard output stops reading early.
    let line = format!(
        "python3 {} {1} {1} | true; python3 -c 'raise SystemExit(0)'",
        scripts.join("check_model_folder.py").display(),
        tiny().display()
    );
    let output = Command::new("sh").args(["-c", &line]).output().unwrap();
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}

/// Checks the minimum memory that a refused run names: for a run of 300 Gaussians and 10 frames it is at most 60 MiB,
/// and a run with this limit succeeds and keeps the limit.
#[test]
fn named_minimum_memory_is_small_and_kept() {
    let workplace = Workplace::new();
    for output in ["out.gseq", "out"] {
        let run = workplace.run(&format!("compress {{tiny}} -o {output} --memory 1KiB --threads 2"));
        let said = run.stderr.split("expected at least ").nth(1).and_then(|rest| rest.split("MiB").next());
        let least: u64 = said.expect(&run.stderr).parse().unwrap();
        assert!(least <= 60, "{least} MiB for {output}");
        let run = workplace.run(&format!("compress {{tiny}} -o {output} --memory {least}MiB --threads 2 --explain"));
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert!(crate::scene::taken(&run.stderr).is_none_or(|taken| taken <= least as f64), "{}", run.stderr);
    }
}

#[test]
fn json_flag_takes_no_value() {
    let workplace = Workplace::new();
    assert!(workplace.done("info {tiny} --json").starts_with('{'));
    assert!(!workplace.done("info {tiny}").starts_with('{'));
    workplace.refused(2, "info {tiny} --json no", &["unexpected argument", "no"]);
    workplace.refused(2, "info {tiny} --json=no", &["unexpected value", "--json"]);
}
