//! What people bring and how they ask for it: names, lists, text files, cameras of other programs; and what is said of it.

mod scene;

use std::fs;
use std::path::Path;
use std::process::Command;

use scene::{Workplace, tiny};

#[test]
fn recovering_nothing_is_no_success_and_writes_nothing() {
    let workplace = Workplace::new();
    workplace.done("pack {tiny} -o scene.gseq");
    let whole = fs::read(workplace.path("scene.gseq")).unwrap();
    // The header is whole, and no tile is.
    fs::write(workplace.path("cut.gseq"), &whole[..4096]).unwrap();
    workplace.refused(
        1,
        "recover cut.gseq -o saved.gseq",
        &["cut.gseq", "at least one complete frame", "nothing was written"],
    );
}

#[test]
fn a_result_of_no_gaussians_is_no_success() {
    let workplace = Workplace::new();
    for options in ["-o out", "-o out.gseq --prune-only", "-o out.gsz", "-o out --no-refine --dry-run"] {
        let parts = ["at least one Gaussian that stays", "none of 300", "--drop-ids"];
        workplace.refused(1, &format!("compress {{tiny}} --drop-ids 0-299 --quiet {options}"), &parts);
    }
}

#[test]
fn a_name_that_no_output_has_is_refused_at_once_with_what_can_be_written() {
    let workplace = Workplace::new();
    let parts = ["x.txt", "NAME.gsz", "NAME.gseq", "NAME.ply", "a folder", "--as"];
    workplace.refused(2, "compress {tiny} -o x.txt", &parts);
    workplace.refused(2, "pack {tiny} -o x.txt", &["x.txt", "NAME.gseq"]);
    workplace.refused(2, "recover nowhere.gseq -o x.txt", &["x.txt", "NAME.gseq"]);
    workplace.refused(2, "unpack {tiny} -o x.txt", &["x.txt", "a folder"]);
    workplace.refused(2, "report {tiny} {tiny} -o x.html", &["x.html", "a folder"]);
    workplace.refused(2, "render {tiny} --all -o x.zip", &["x.zip", "a folder"]);
    // Said outright, or no ending of a file.
    workplace.done("compress {tiny} -o small.v2 --prune-only --no-refine --quiet");
    assert!(workplace.path("small.v2/cfg_args").is_file());
    workplace.done("compress {tiny} -o x.model --as model --prune-only --no-refine --quiet");
}

#[test]
fn an_empty_folder_is_no_obstacle_and_one_with_anything_in_it_is() {
    let workplace = Workplace::new();
    for (verb, made) in [
        ("compress {tiny} --prune-only --no-refine --quiet -o out", "cfg_args"),
        ("unpack {tiny} -o out", "frame_00000.ply"),
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
fn flags_take_a_truth_value_and_lists_take_blanks() {
    let workplace = Workplace::new();
    for value in ["false", "no", "=off"] {
        let value = if value.starts_with('=') { value.to_owned() } else { format!(" {value}") };
        workplace.done(&format!("compress {{tiny}} -o out --dry-run --no-refine --quiet --choose-by-views{value}"));
    }
    let json = workplace.done("info {tiny} --json yes");
    assert!(json.starts_with('{'), "{json}");
    let text = workplace.done("info {tiny} --json no");
    assert!(!text.starts_with('{'), "{text}");
    let tiny = tiny();
    let words = ["sweep", tiny.to_str().unwrap(), "-o", "curves", "--quiet", "--max-frames", "2"];
    let run =
        workplace.run_words(words.into_iter().chain(["--methods", "opacity, scale", "--fractions", "0.5,", "0.2"]));
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stdout.contains("scale") && !run.stdout.contains("random"), "{}", run.stdout);
    let run = workplace.run_words([
        "compress",
        tiny.to_str().unwrap(),
        "-o",
        "out",
        "--dry-run",
        "--quiet",
        "--no-refine",
        "--drop-ids",
        "3 5",
    ]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    workplace.refused(2, "compress {tiny} -o out --drop-ids 10-5", &["runs forwards, such as 5-10", "10-5"]);
}

#[test]
fn text_files_are_read_with_a_byte_order_mark_and_hints_fit_what_is_wrong() {
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
    refused(&["NaN and Infinity are no JSON"], &["cut short", "Latin-1"]);
    write("bad.json", b"\xff\xfe{\0");
    refused(&["UTF-16"], &["NaN", "Latin-1"]);
    write("r.toml", b"[score]\nmu = 2.0 # caf\xe9\n");
    workplace.refused(1, "compress {tiny} --recipe r.toml -o out", &["r.toml, byte 22", "Latin-1"]);
    write("ids.txt", b"\xef\xbb\xbf3\n5 # caf\n");
    workplace.done("compress {tiny} --drop-ids ids.txt -o out --dry-run --prune-only --no-refine --quiet");
}

/// Messages are for people: what Rust shows its programmers is in none.
#[test]
fn no_message_is_made_of_debug_text() {
    // Numbers, which read the same either way.
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
    // What no terminal shows is told by its code.
    let workplace = Workplace::new();
    fs::write(workplace.path("ids.txt"), "3\u{200b}x\u{7}\n").unwrap();
    workplace.refused(2, "compress {tiny} --drop-ids ids.txt -o out", &["\"3<U+200B>x<U+0007>\""]);
}

/// A disk of 24 KiB of its own, which each of these runs fills.
#[test]
#[ignore = "needs namespaces of process ids"]
fn a_full_disk_is_blamed_on_what_was_being_written() {
    let workplace = Workplace::new();
    fs::create_dir(workplace.path("disk")).unwrap();
    let (program, tiny) = (env!("CARGO_BIN_EXE_splatsieve"), tiny());
    let tiny = tiny.display();
    for (run, named) in [
        (format!("pack {tiny} -o disk/x.gseq"), "disk/x.gseq: No space"),
        (format!("unpack {tiny} -o disk/x"), "disk/x/frame_0000"),
        (format!("score {tiny} -o disk/x.npz"), "disk/x.npz: No space"),
        (format!("render {tiny} --all -o disk/x"), "disk/x/t000_v"),
        (format!("compress {tiny} --prune-only --no-refine -o disk/x"), "disk/x/"),
        (format!("compress {tiny} -o x.gseq --scratch-dir disk"), "write a scratch file in disk: No space"),
    ] {
        let script = format!("mount -t tmpfs -o size=24k none disk && {program} --quiet {run}; ls -A disk | wc -l");
        let shell = |arguments: &[&str]| {
            Command::new("unshare")
                .args(arguments)
                .args(["sh", "-c", &script])
                .current_dir(workplace.path(""))
                .output()
                .unwrap()
        };
        let mut output = shell(&["-m"]);
        if String::from_utf8_lossy(&output.stderr).contains("unshare") {
            output = shell(&["-U", "-r", "-m"]);
        }
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(told.contains(named) && told.contains("make room"), "{run}: {told}");
        for part in ["Os {", "splatsieve-tmp", "content", "ZipWriter", "Some("] {
            assert!(!told.contains(part), "{run}: {part:?} is in {told}");
        }
        assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "0", "{run} left something");
    }
}
