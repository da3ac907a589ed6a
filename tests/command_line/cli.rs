//! Tests of the command line as scripts use it: exit codes, standard streams, and failures that leave no files behind.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::scene::{PlyRows, Workplace, arrays, files, program, state, tiny};
use splatsieve::files::container::Container;

const CLOUD: &str = "model/point_cloud/iteration_7/point_cloud.ply";
const FIELD: &str = "model/point_cloud/iteration_7/deformation.pth";

/// Returns a folder with a copy of the tiny model in `model`, which tests can damage.
fn with_model() -> Workplace {
    let workplace = Workplace::new();
    for (name, bytes) in files(&tiny()) {
        let path = workplace.path("model").join(&name);
        if tiny().join(&name).is_dir() {
            fs::create_dir_all(path).unwrap();
        } else {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        }
    }
    workplace
}

/// Checks that every command that reads a model refuses the folder `model`, with a message that contains all `parts`.
fn model_refused(workplace: &Workplace, parts: &[&str]) {
    for verb in
        ["compress model -o out", "compress model -o out.gseq", "score model -o rows.npz", "convert model a.gseq"]
    {
        workplace.refused(1, verb, parts);
    }
}

fn edit(path: &Path, change: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = fs::read(path).unwrap();
    change(&mut bytes);
    fs::write(path, bytes).unwrap();
}

/// Replaces the first occurrence of `from` by `to`, which has the same length.
fn replace(bytes: &mut [u8], from: &[u8], to: &[u8]) {
    assert_eq!(from.len(), to.len());
    let at = bytes.windows(from.len()).position(|window| window == from).expect("the bytes to replace");
    bytes[at..at + to.len()].copy_from_slice(to);
}

#[test]
fn help_describes_the_tool_and_shows_examples() {
    let workplace = Workplace::new();
    let help = workplace.done("--help");
    assert!(help.starts_with("Makes trained dynamic (4D) Gaussian-splatting models much smaller"), "{help}");
    assert!(help.contains("\n\nExamples:\n  splatsieve demo"), "{help}");
    for verb in crate::docs::COMMANDS {
        assert!(help.contains(verb), "{verb} is not in the help");
        workplace.done(&format!("{verb} --help"));
    }
    for verb in ["compress", "evaluate", "render", "convert"] {
        let help = workplace.done(&format!("{verb} --help"));
        assert!(help.contains("--cache <FOLDER>") && help.contains("--shard <I/N>"), "{verb}: {help}");
    }
    let [short, long] = ["-h", "--help"].map(|flag| workplace.done(&format!("compress {flag}")));
    assert!(short.lines().count() < 90 && short.len() < long.len(), "{short}");
    for group in ["\nCameras:\n", "\nHow small:\n", "\nMachine:\n", "\nRecipe:\n"] {
        assert!(short.contains(group), "{group:?}: {short}");
    }
    assert!(workplace.done("--version").starts_with("splatsieve "));
}

#[test]
fn manual_pages_cover_every_command_with_examples() {
    let workplace = Workplace::new();
    let said = workplace.done("man pages");
    let pages: Vec<_> = fs::read_dir(workplace.path("pages")).unwrap().map(|page| page.unwrap().path()).collect();
    assert!(said.contains(&format!("{} pages", pages.len())), "{said}");
    let page = |name: &str| fs::read_to_string(workplace.path(&format!("pages/{name}.1"))).unwrap();
    let compress = page("splatsieve-compress");
    for part in [".TH ", "\\-\\-ratio", "splatsieve compress model", "no\\-refine"] {
        assert!(compress.contains(part), "{part} is not in {compress}");
    }
    assert!(page("splatsieve").contains("splatsieve demo"));
    assert!(pages.iter().any(|page| page.ends_with("splatsieve-man.1")));
}

#[test]
fn final_report_has_count_size_quality_time_and_path() {
    let workplace = Workplace::new();
    let options = "compress {tiny} --cameras {tiny} --ratio 0.5";
    let most = workplace.done(&format!("{options} -o out"));
    let title = most.lines().next().unwrap_or_default();
    assert!(title.contains("tiny_model → out") && title.ends_with(" MiB peak"), "{most}");
    for row in ["Gaussians              300         150    2.0× fewer", "Size ", "Render time ", "Quality "] {
        assert!(most.lines().any(|line| line.starts_with(row)), "{row:?} is not in {most}");
    }
    assert!(most.contains("dB PSNR, 0.") && most.contains("vs. original (") && most.contains(" test views)"), "{most}");
    let see = most.lines().find(|line| line.starts_with("See it:   splatsieve view ")).expect("a command to see it");
    assert!(see.contains(" out --cameras ") && see.ends_with(" -o out.html"), "{see}");
    assert!(!most.contains("left out") && !most.contains(" -> "), "{most}");
    // Nothing here reads a `.gsd`, so its quality is not known and no command shows it.
    let unread = workplace.done(&format!("{options} -o unread --as gsd"));
    assert!(
        unread.contains(" test views, before conversion to the format of the output)") && !unread.contains("See it:"),
        "{unread}"
    );
    // A still is not shown beside the moving model.
    let still = workplace.done(&format!("{options} -o still.ply"));
    assert!(
        still.contains("before conversion") && still.contains("note: a .ply holds the Gaussians of the model without"),
        "{still}"
    );
    assert!(still.contains("\nSee it:   splatsieve view still.ply -o still.html\n"), "{still}");
    let all = workplace.done(&format!("{options} -o again --verbose"));
    assert!(
        all.contains("left out: ") && all.contains(" -> ") && all.contains("\nGaussians              300         150"),
        "{all}"
    );
}

#[test]
fn misuse_exits_with_2() {
    let workplace = Workplace::new();
    for (arguments, part) in [
        ("", "Usage"),
        ("squash {tiny}", "squash"),
        ("compress {tiny}", "--output"),
        ("compress {tiny} -o out --no-such-flag", "--no-such-flag"),
        ("compress {tiny} -o out --preset reckless", "reckless"),
        ("compress {tiny} -o out --set mu=many", "mu"),
        ("compress {tiny} -o out --set keep_fraction=1.5", "keep_fraction"),
        ("compress {tiny} -o out --keep-box 0,0,0,1,1", "six numbers"),
        ("compress {tiny} -o out --keep-ids 300", "below 300"),
        ("compress {tiny} -o out --keep-ids 3 --drop-ids 3", "Gaussian 3"),
        ("compress {tiny} -o out --set mu=many", "expected a number, found \"many\""),
        ("compress {tiny} -o out --set refine_steps=1.5", "expected a whole number, found \"1.5\""),
        ("compress {tiny} -o out --frames many", "invalid value 'many' for '--frames <N>': expected a whole number"),
        ("render {tiny} --cameras {tiny} --frame 0 --view 0 -o x.png --as npy", "x.png: --as npy asks for another"),
        ("convert {tiny} x --frames 1", "x: --frames 1 asks for one frame"),
        ("compress {tiny} -o out --threads 0", "--threads"),
        ("compress {tiny} -o out --threads a", "from 1 to 1024"),
        ("compress {tiny} -o out --count 10%", "write --ratio 10%"),
        ("compress {tiny} -o out --split none", "--split"),
        ("compress {tiny} -o missing/out", "missing"),
        ("score {tiny} -o rows.txt", ".npz or .csv"),
        ("recipe --preset reckless", "reckless"),
    ] {
        workplace.refused(2, arguments, &[part]);
    }
}

#[test]
fn a_slash_after_an_output_file_is_refused_before_any_work() {
    let workplace = Workplace::new();
    for arguments in [
        "compress {tiny} --no-refine --ratio 10% -o y.gsz/",
        "compress {tiny} --no-refine --ratio 10% -o y.ply/ --dry-run",
        "compress {tiny} --no-refine --ratio 10% -o y.gsz --view=y.html/",
        "convert {tiny} y.gseq/",
        "convert {tiny} y.ply/",
        "convert {tiny} y.gsz/",
        "view {tiny} -o y.html/",
        "score {tiny} -o y.csv/",
        "render {tiny} --cameras {tiny} --frame 0 --view 0 -o y.png/",
        "render {tiny} --cameras {tiny} --video y.png/",
        "evaluate {tiny} {tiny} --cameras {tiny} --csv y.csv/",
    ] {
        workplace.refused(2, arguments, &["found a path that ends in '/'", "follows the name: y."]);
    }
}

#[test]
fn a_dash_is_an_output_of_convert_alone() {
    let workplace = Workplace::new();
    for arguments in ["compress {tiny} --no-refine --ratio 10% -o -", "view {tiny} -o -", "man -", "sweep {tiny} -o -"]
    {
        workplace.refused(2, arguments, &["-: expected the name of a file", "convert INPUT -"]);
    }
}

#[test]
fn recipes_with_unknown_or_impossible_values_are_refused() {
    let workplace = Workplace::new();
    for (text, part) in [
        ("[score]\nnu = 1.0\n", "nu"),
        ("[scores]\nmu = 1.0\n", "scores"),
        ("[score]\nmu = \"many\"\n", "mu"),
        ("[select]\nkeep_fraction = -1.0\n", "select.keep_fraction"),
        ("[score\n", "recipe.toml"),
        ("preset = \"reckless\"\n", "reckless"),
    ] {
        fs::write(workplace.path("recipe.toml"), text).unwrap();
        workplace.refused(2, "compress {tiny} -o out --recipe recipe.toml", &[part]);
    }
    workplace.refused(1, "compress {tiny} -o out --recipe none.toml", &["none.toml"]);
}

#[test]
fn missing_input_is_a_failure_that_names_it() {
    let workplace = Workplace::new();
    fs::create_dir(workplace.path("empty")).unwrap();
    fs::write(workplace.path("notes.txt"), "no model").unwrap();
    workplace.refused(1, "compress nowhere -o out", &["nowhere"]);
    workplace.refused(1, "compress empty -o out", &["empty", ".ply"]);
    workplace.refused(1, "compress notes.txt -o out", &["notes.txt", ".gseq"]);
    workplace.refused(1, "compress {tiny} --cameras nowhere -o out", &["nowhere"]);
    workplace.refused(1, "compress {tiny} --iteration 8 -o out", &["iteration_8", "iteration_7"]);
}

#[test]
fn point_cloud_cut_short_is_refused_wherever_it_ends() {
    let workplace = with_model();
    let whole = fs::read(workplace.path(CLOUD)).unwrap();
    for length in [0, 3, 100, 1500, whole.len() / 2, whole.len() - 1] {
        fs::write(workplace.path(CLOUD), &whole[..length]).unwrap();
        model_refused(&workplace, &["point_cloud.ply", "expected", "found"]);
    }
}

#[test]
fn deformation_cut_short_or_damaged_is_refused() {
    let workplace = with_model();
    let whole = fs::read(workplace.path(FIELD)).unwrap();
    for length in [0, 10, 5000, whole.len() / 2, whole.len() - 100, whole.len() - 1] {
        fs::write(workplace.path(FIELD), &whole[..length]).unwrap();
        model_refused(&workplace, &["deformation.pth"]);
    }
    // A flipped byte inside the values of a tensor fails the checksum of the archive.
    let mut flipped = whole.clone();
    let middle = whole.len() / 2;
    flipped[middle] ^= 0x40;
    fs::write(workplace.path(FIELD), &flipped).unwrap();
    model_refused(&workplace, &["deformation.pth"]);
}

/// A state dict whose pickle calls a function other than tensor constructors must be refused; Python would run the
/// function while loading.
#[test]
fn hostile_pickle_is_refused_and_not_executed() {
    let workplace = with_model();
    let target = workplace.path("owned");
    let command = format!("touch {}", target.display());
    // Pickle program: the global `os.system`, one argument, REDUCE.
    let mut pickle = b"\x80\x02cos\nsystem\nX".to_vec();
    pickle.extend((command.len() as u32).to_le_bytes());
    pickle.extend(command.as_bytes());
    pickle.extend(b"\x85R.");
    let stored = stored_zip(&[("archive/data.pkl", &pickle), ("archive/version", b"3\n")]);
    for bytes in [stored, pickle] {
        fs::write(workplace.path(FIELD), bytes).unwrap();
        model_refused(&workplace, &["deformation.pth"]);
        assert!(!target.exists(), "the pickle was run");
    }
}

/// Returns a zip archive of uncompressed entries, given as (name, content).
fn stored_zip(entries: &[(&str, &[u8])]) -> Vec<u8> {
    use std::io::Write;
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        let options = zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Stored);
        archive.start_file(*name, options).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

#[test]
fn missing_head_and_wrong_shape_name_the_tensor() {
    let workplace = with_model();
    let config = workplace.path("model/cfg_args");
    let text = fs::read_to_string(&config).unwrap();
    // The configuration asks for a head that has another name in the state dict.
    let whole = fs::read(workplace.path(FIELD)).unwrap();
    let renamed = rewrite_pickle(&whole, b"pos_deform", b"pos_reform");
    fs::write(workplace.path(FIELD), renamed).unwrap();
    model_refused(&workplace, &["deformation.pth", "deformation_net.pos_deform.1.weight", "none"]);
    fs::write(&config, text.replace("no_dx=False", "no_dx=True")).unwrap();
    workplace.done("info model");

    // `static_mlp` asks for a head that the state dict lacks.
    fs::write(workplace.path(FIELD), &whole).unwrap();
    fs::write(&config, text.replace("static_mlp=False", "static_mlp=True")).unwrap();
    model_refused(&workplace, &["static_mlp", "does cfg_args belong"]);

    // Positional encoding frequencies triple the features that the first layer must read.
    fs::write(&config, text.replace("grid_pe=0", "grid_pe=2")).unwrap();
    model_refused(&workplace, &["deformation_net.feature_out.0.weight", "shape"]);
}

/// Returns `archive` with `from` replaced by `to` everywhere in its pickle.
fn rewrite_pickle(archive: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut read = zip::ZipArchive::new(std::io::Cursor::new(archive)).unwrap();
    let mut entries = Vec::new();
    for i in 0..read.len() {
        let mut entry = read.by_index(i).unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        if entry.name().ends_with("data.pkl") {
            while bytes.windows(from.len()).any(|window| window == from) {
                replace(&mut bytes, from, to);
            }
        }
        entries.push((entry.name().to_owned(), bytes));
    }
    stored_zip(&entries.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect::<Vec<_>>())
}

#[test]
fn malformed_configuration_names_the_place() {
    let workplace = with_model();
    let config = workplace.path("model/cfg_args");
    for (text, part) in [
        ("", "cfg_args"),
        ("Namespace(sh_degree=3", "cfg_args"),
        ("Namespace(no_dx=7)", "no_dx"),
        ("__import__('os').system('true')", "cfg_args"),
    ] {
        fs::write(&config, text).unwrap();
        model_refused(&workplace, &[part]);
    }
    fs::remove_file(&config).unwrap();
    model_refused(&workplace, &["cfg_args"]);
}

#[test]
fn nan_in_a_point_cloud_is_left_out_or_refused() {
    let workplace = with_model();
    let row = PlyRows::read(&workplace.path(CLOUD)).rows[41].clone();
    let mut odd = row.clone();
    odd[4..8].copy_from_slice(&f32::NAN.to_le_bytes());
    edit(&workplace.path(CLOUD), |bytes| replace(bytes, &row, &odd));
    for verb in ["compress model -o out", "score model -o rows.npz"] {
        let parts = ["Gaussian 41", "NaN or infinity in 1 of 300", "--set non_finite=drop"];
        workplace.refused(1, &format!("{verb} --set non_finite=error"), &parts);
        workplace.done(verb);
    }
}

#[test]
fn cameras_of_another_scene_are_refused() {
    let workplace = Workplace::new();
    let elsewhere = |file: &str, edit: &dyn Fn(&mut serde_json::Value)| {
        let text = fs::read_to_string(tiny().join("transforms_train.json")).unwrap();
        let mut document: serde_json::Value = serde_json::from_str(&text).unwrap();
        document["frames"].as_array_mut().unwrap().iter_mut().for_each(edit);
        fs::write(workplace.path(file), document.to_string()).unwrap();
    };
    // Cameras a thousand units away see nothing of the scene.
    elsewhere("away.json", &|frame| frame["transform_matrix"][2][3] = 1000.into());
    workplace.refused(
        2,
        "compress {tiny} --cameras away.json -o out",
        &["away.json", "none of the", "cameras of this scene"],
    );
    elsewhere("nan.json", &|frame| frame["transform_matrix"][0][0] = serde_json::Value::Null);
    workplace.refused(1, "compress {tiny} --cameras nan.json -o out", &["nan.json", "frame 0"]);
    fs::write(workplace.path("half.json"), "{\"frames\": [").unwrap();
    workplace.refused(1, "compress {tiny} --cameras half.json -o out", &["half.json"]);
}

#[test]
fn times_that_do_not_match_are_refused() {
    let workplace = Workplace::new();
    let model = tiny().display().to_string();
    // `--frames 4` puts frames at 0, 1/4, 1/2 and 3/4; the images were taken at multiples of 1/9.
    workplace.refused(2, "compress {tiny} --frames 4 -o out", &["no frame at this time", "--frames"]);
    workplace.done("convert {tiny} frames --as ply-sequence");
    fs::remove_file(workplace.path("frames/frame_00009.ply")).unwrap();
    workplace.refused(2, &format!("compress frames --cameras {model} -o out"), &["9 frames", "10 distinct times"]);
    workplace.refused(2, "compress frames --frames 9 -o out", &["--frames is for models"]);
}

#[test]
fn overwrite_is_needed_and_spares_foreign_outputs() {
    let workplace = with_model();
    for verb in ["compress model -o", "convert model -o", "score model -o"] {
        let name = if verb.starts_with("score") { "precious.npz" } else { "precious.gseq" };
        fs::write(workplace.path(name), "precious").unwrap();
        workplace.refused(2, &format!("{verb} {name}"), &[name, "--overwrite"]);
        assert_eq!(fs::read(workplace.path(name)).unwrap(), b"precious");
        fs::remove_file(workplace.path(name)).unwrap();
    }
    fs::create_dir(workplace.path("photos")).unwrap();
    fs::write(workplace.path("photos/one.jpg"), "precious").unwrap();
    for verb in [
        "compress model -o photos",
        "compress model -o photos --overwrite",
        "convert model photos --as ply-sequence --overwrite",
    ] {
        workplace.refused(2, verb, &["photos"]);
    }
    // Files beside a single output file are protected too.
    fs::write(workplace.path("small.ply.recipe.toml"), "precious").unwrap();
    workplace.refused(2, "compress model -o small.ply", &["small.ply.recipe.toml"]);
}

#[test]
fn outputs_onto_around_or_inside_the_input_are_refused() {
    let workplace = with_model();
    for output in ["model", "./model", "model/../model"] {
        workplace.refused(2, &format!("compress model -o {output} --overwrite"), &["the input itself"]);
    }
    workplace.refused(
        2,
        "compress model/point_cloud/iteration_7/point_cloud.ply -o model --as ply --overwrite",
        &["model"],
    );
    for output in ["model/out", "model/point_cloud/iteration_8", "model/out.gseq", "model/../model/out"] {
        workplace.refused(2, &format!("compress model -o {output}"), &["inside the input model"]);
    }
    workplace.refused(2, "score model -o model/rows.npz", &["inside the input model"]);
    workplace.done("convert model frames --as ply-sequence");
    workplace.refused(2, "compress frames -o frames/out.ply --as ply", &["out.ply"]);
    workplace.refused(2, "compress frames -o frames/out", &["inside the input frames"]);
    workplace.done("convert model scene.gseq");
    for verb in ["compress", "convert"] {
        workplace.refused(2, &format!("{verb} scene.gseq -o scene.gseq --overwrite"), &["the input itself"]);
    }
}

#[test]
fn output_kinds_that_do_not_fit_are_refused() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} scene.gseq");
    workplace.refused(2, "compress scene.gseq -o out --as model", &["only a trained model"]);
    workplace.refused(2, "compress scene.gseq -o out.ply", &["10 frames do not fit"]);
    workplace.refused(2, "compress scene.gseq -o out --iteration 3", &["--iteration"]);
}

#[test]
fn damaged_containers_are_refused_cut_ones_recovered() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} scene.gseq");
    let whole = fs::read(workplace.path("scene.gseq")).unwrap();
    let mut flipped = whole.clone();
    flipped[whole.len() / 2] ^= 1;
    fs::write(workplace.path("flipped.gseq"), flipped).unwrap();
    fs::write(workplace.path("cut.gseq"), &whole[..whole.len() - 20]).unwrap();
    workplace.refused(1, "info flipped.gseq --check", &["flipped.gseq"]);
    workplace.refused(1, "compress flipped.gseq -o out", &["flipped.gseq"]);
    for verb in [
        "info cut.gseq --check",
        "info cut.gseq",
        "compress cut.gseq -o out.gseq",
        "convert cut.gseq out --as ply-sequence",
    ] {
        workplace.refused(1, verb, &["cut.gseq"]);
    }
    let report = workplace.done("info cut.gseq --repair saved.gseq");
    assert!(report.contains("10 complete frames"), "{report}");
    workplace.done("info saved.gseq --check");
    let [saved, scene] = ["saved.gseq", "scene.gseq"].map(|name| Container::open(&workplace.path(name)).unwrap());
    assert!((0..10).all(|frame| state(&saved, frame) == state(&scene, frame)));
}

#[test]
fn results_go_to_stdout_and_quiet_silences_stderr() {
    let workplace = Workplace::new();
    for (arguments, part) in [
        ("compress {tiny} -o out", "Gaussians              300"),
        ("convert {tiny} scene.gseq", "300 Gaussians x 10 frames"),
        ("info scene.gseq", "300"),
        ("info {tiny}", "300"),
        ("info scene.gseq --check", "no damage; 10 frames"),
        ("convert scene.gseq frames --as ply-sequence", "10 frames"),
        ("score scene.gseq -o rows.csv --cameras {tiny}", "300 Gaussians"),
        ("recipe", "[merge]"),
        ("recipe --preset paper", "[merge]"),
        ("completions bash", "splatsieve"),
        ("completions zsh", "splatsieve"),
        ("test-scene --gaussians 400 --frames 4", "body"),
    ] {
        let run = workplace.run(&format!("{arguments} --quiet"));
        assert_eq!(run.code, 0, "{arguments}: {}", run.stderr);
        assert!(run.stdout.contains(part), "{arguments}: {part:?} is not in {:?}", run.stdout);
        assert_eq!(run.stderr, "", "{arguments}");
    }
    let rows = fs::read_to_string(workplace.path("rows.csv")).unwrap();
    assert_eq!(rows.lines().next().unwrap(), "id,D,kappa,V,life,C,E,vis,static_score,dynamic_score,score,keep,W");
    assert_eq!(rows.lines().count(), 301);
    // A model that is continuous in time has no number of frames of its own.
    for (arguments, frames) in [
        ("info scene.gseq --json", serde_json::json!(10)),
        ("info {tiny} --json", serde_json::Value::Null),
        ("info scene.gseq --check --json", serde_json::json!(10)),
    ] {
        let document: serde_json::Value = serde_json::from_str(&workplace.done(arguments)).unwrap();
        assert_eq!(document["frames"], frames, "{arguments}: {document}");
    }
    let names: Vec<PathBuf> = files(&workplace.path("frames")).into_keys().collect();
    assert_eq!((names.len(), names[0].as_path()), (11, Path::new("frame_00000.ply")), "{names:?}");
}

#[test]
fn demo_without_output_names_no_path() {
    let workplace = Workplace::new();
    let text = workplace.done("test-scene --gaussians 400 --frames 4 --quiet");
    assert!(!text.contains("output  "), "{text}");
    workplace.done("test-scene --gaussians 400 --frames 4 --quiet -o demo");
    let summary = fs::read_to_string(workplace.path("demo/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary.get("output"), None, "{summary}");
}

#[test]
fn printed_recipes_are_recipes() {
    let workplace = Workplace::new();
    for preset in ["paper", "default"] {
        fs::write(workplace.path("recipe.toml"), workplace.done(&format!("recipe --preset {preset}"))).unwrap();
        let [by_file, by_name] = ["--recipe recipe.toml".to_owned(), format!("--preset {preset}")].map(|recipe| {
            workplace.done(&format!("compress {{tiny}} -o out --overwrite {recipe}"));
            crate::scene::lasting_files(&workplace.path("out"))
        });
        assert!(by_file == by_name, "{preset}");
    }
}

#[test]
fn score_writes_one_array_per_column() {
    let workplace = Workplace::new();
    workplace.done("score {tiny} -o rows.npz --preset paper");
    let path = workplace.path("rows.npz");
    let mut archive = npyz::npz::NpzArchive::open(&path).unwrap();
    let mut names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    names.sort();
    let mut expected = ["D", "kappa", "V", "life", "C", "E", "vis", "static_score", "dynamic_score", "score", "keep"]
        .map(String::from);
    expected.sort();
    assert_eq!(names, expected);
    for name in names {
        let array = archive.by_name(&name).unwrap().unwrap();
        assert_eq!(array.shape(), [300], "{name}");
        let dtype = match name.as_str() {
            "life" => "'<u4'",
            "keep" => "'|b1'",
            _ => "'<f8'",
        };
        assert_eq!(array.dtype().descr(), dtype, "{name}");
    }
    let rows = arrays(&path);
    assert_eq!(rows["keep"].iter().sum::<f64>(), 240.0);
    assert!((0..300).all(|i| rows["score"][i] == rows["static_score"][i] + rows["dynamic_score"][i]));
}

#[test]
fn closed_stdout_is_no_failure() {
    for arguments in [&["recipe"][..], &["completions", "bash"], &["--help"]] {
        let mut child =
            Command::new(program()).args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        // Without a reader of standard output the first write fails.
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success() && message.is_empty(), "{arguments:?}: {message}");
    }
}

#[test]
#[ignore = "needs time"]
fn stages_print_once_and_undone_merging_is_left_out() {
    let workplace = Workplace::new();
    workplace.done("test-scene -o demo");
    let compress = |rest: &str| {
        let run = workplace.run(&format!(
            "compress demo/scene.gseq --cameras demo/cameras.json --ratio {rest} -o out.gseq --overwrite"
        ));
        assert_eq!(run.code, 0, "{}", run.stderr);
        let told: Vec<&str> = run.stderr.lines().filter_map(|line| line.strip_prefix('[')?.split(']').next()).collect();
        assert!(told.len() > 5 && told.is_sorted_by(|a, b| a < b), "{}", run.stderr);
        run.stderr.lines().any(|line| line.starts_with("merging  left out: PSNR on scored views at the same "))
    };
    let undone = ["0.2 --no-refine", "0.8 --no-refine", "0.4 --set refine_steps=20 --set refine_steps_per_prune=5"]
        .map(compress);
    assert_eq!(undone, [false, true, false]);
}
