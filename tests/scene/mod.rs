//! Shared code of the integration tests: models to read, the program to run, and simple readers of its outputs that
//! share no code with it.

#![allow(dead_code, reason = "every test crate compiles this module and uses a part of it")]

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{self, ChildStdin, Output, Stdio};
use std::thread;

use assert_cmd::Command;
use serde_json::Value;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::passes::gather;
use splatsieve::scene::{InputOptions, Scene, open_scene};
use splatsieve::source::FrameSource;
use tempfile::TempDir;

/// Returns the path of the tiny model, which is in the repository. `scripts/make_fixture.py` made it.
pub(crate) fn tiny() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model")
}

/// Returns the path of the program: the one built with this test, or another (an optimized one) that
/// `SPLATSIEVE_PROGRAM` names.
pub(crate) fn program() -> PathBuf {
    std::env::var_os("SPLATSIEVE_PROGRAM").map_or_else(|| assert_cmd::cargo::cargo_bin("splatsieve"), PathBuf::from)
}

/// Runs `command` while `write` writes to its standard input.
pub(crate) fn piped(command: &mut process::Command, write: impl FnOnce(ChildStdin) + Send + 'static) -> Output {
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let pipe = child.stdin.take().unwrap();
    let writer = thread::spawn(move || write(pipe));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    output
}

/// Runs the script `check_model_folder.py` on a compressed model folder and its original, with `python3` or with the
/// Python that `PYTHON` names. Returns whether the script accepts the folder, and its output.
pub(crate) fn check_model_folder(original: &Path, compressed: &Path) -> (bool, String) {
    let python = std::env::var_os("PYTHON").map_or_else(|| PathBuf::from("python3"), PathBuf::from);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/check_model_folder.py");
    let output = process::Command::new(&python).arg(script).args([original, compressed]).output().unwrap();
    let [complaints, text] = [&output.stderr, &output.stdout].map(|bytes| String::from_utf8_lossy(bytes));
    (output.status.success(), format!("{complaints}{text}"))
}

/// Returns the path of the point cloud in the only iteration of the model folder `model`.
pub(crate) fn point_cloud(model: &Path) -> PathBuf {
    let folders = fs::read_dir(model.join("point_cloud")).unwrap();
    folders.map(|entry| entry.unwrap().path().join("point_cloud.ply")).next().unwrap()
}

/// Returns the path of the deformation field in the only iteration of the model folder `model`.
pub(crate) fn field_file(model: &Path) -> PathBuf {
    point_cloud(model).with_file_name("deformation.pth")
}

/// Returns the reason why a run omitted the stage `what`, according to its summary; `None` if the stage ran.
pub(crate) fn reason_left_out(summary: &Value, what: &str) -> Option<String> {
    let left = summary["left_out"].as_array().unwrap();
    left.iter().find(|left| left["what"] == what).map(|left| left["why"].as_str().unwrap().to_owned())
}

/// Returns the standard error of a program as text.
pub(crate) fn stderr_text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Returns the path of a trained model in `SPLATSIEVE_DATA`, or else in `../shared/data`. Panics if it is missing.
pub(crate) fn shared(name: &str) -> PathBuf {
    let folder = std::env::var_os("SPLATSIEVE_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from)
        .join(name);
    assert!(folder.is_dir(), "no trained model at {} (SPLATSIEVE_DATA)", folder.display());
    folder
}

/// Copies the model at `from` to the new folder `to` with a configuration in which no head deforms SH colors.
pub(crate) fn without_sh_head(from: &Path, to: &Path) {
    for (name, bytes) in files(from) {
        let path = to.join(&name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        match name.to_str().unwrap() {
            "cfg_args" => {
                let text = String::from_utf8(bytes).unwrap();
                assert!(text.contains("no_dshs=False"));
                fs::write(path, text.replace("no_dshs=False", "no_dshs=True")).unwrap();
            }
            _ if from.join(&name).is_dir() => fs::create_dir_all(path).unwrap(),
            _ => fs::write(path, bytes).unwrap(),
        }
    }
}

/// Opens a model folder that contains its cameras, with all views.
pub(crate) fn scene(model: &Path) -> Scene {
    let options = InputOptions { path: model.to_owned(), cameras: Some(model.to_owned()), ..InputOptions::default() };
    open_scene(&options).unwrap()
}

/// Returns all attributes of every Gaussian at `frame`.
pub(crate) fn state(source: &dyn FrameSource, frame: usize) -> Gaussians {
    let ids: Vec<u32> = (0..source.info().count as u32).collect();
    gather(source, &ids, frame, Attributes::all()).unwrap()
}

/// Returns the bits of all values of Gaussian `i`, attribute by attribute.
pub(crate) fn bits(state: &Gaussians, i: usize) -> Vec<u32> {
    let planes = |column: Attributes| (0..state.attribute_values(column).width()).map(move |c| (column, c));
    Attributes::all()
        .iter()
        .flat_map(planes)
        .map(|(column, c)| state.attribute_values(column).plane(c)[i].to_bits())
        .collect()
}

/// Temporary folder in which a test runs the program and writes files.
pub(crate) struct Workplace(TempDir);

/// Exit code and outputs of a run.
pub(crate) struct Run {
    pub(crate) code: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Workplace {
    pub(crate) fn new() -> Self {
        Workplace(tempfile::tempdir().unwrap())
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Runs the program in this folder with arguments separated by spaces; `{tiny}` is replaced by the path of the tiny
    /// model.
    pub(crate) fn run(&self, arguments: &str) -> Run {
        self.run_words(arguments.split_whitespace().map(|word| match word {
            "{tiny}" => tiny(),
            word => PathBuf::from(word),
        }))
    }

    /// Runs the program with the arguments `words`, which may contain spaces.
    pub(crate) fn run_words(&self, words: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Run {
        let output = Command::new(program()).current_dir(self.0.path()).args(words).output().unwrap();
        Run {
            code: output.status.code().unwrap(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    /// Returns a command that runs the program in this folder with arguments separated by spaces; `{tiny}` is replaced
    /// by the path of the tiny model.
    pub(crate) fn command(&self, arguments: &str) -> process::Command {
        let mut command = process::Command::new(program());
        let tiny = tiny().display().to_string();
        command.current_dir(self.0.path()).args(arguments.split_whitespace().map(|word| word.replace("{tiny}", &tiny)));
        command
    }

    /// Runs the program in this folder with the arguments `arguments` and the bytes `stdin` on its standard input.
    pub(crate) fn piped(&self, arguments: &str, stdin: &[u8]) -> Output {
        let bytes = stdin.to_owned();
        // Writing fails if the program stops reading early; the rest is dropped.
        piped(&mut self.command(arguments), move |mut pipe| drop(pipe.write_all(&bytes)))
    }

    /// Runs the program, checks that it succeeds, and returns its standard output.
    pub(crate) fn done(&self, arguments: &str) -> String {
        let run = self.run(arguments);
        assert_eq!(run.code, 0, "{arguments}\n{}", run.stderr);
        run.stdout
    }

    /// Runs `compress --json` with the arguments `arguments` and returns the summary that it prints.
    pub(crate) fn summary(&self, arguments: &str) -> serde_json::Value {
        serde_json::from_str(&self.done(&format!("compress --json {arguments}"))).unwrap()
    }

    /// Runs the program and checks that it fails with `code`, prints every one of `parts` on standard error and nothing
    /// on standard output, and leaves this folder unchanged.
    pub(crate) fn refused(&self, code: i32, arguments: &str, parts: &[&str]) {
        let before = files(self.0.path());
        let run = self.run(arguments);
        assert_eq!(run.code, code, "{arguments}\n{}{}", run.stdout, run.stderr);
        assert_eq!(run.stdout, "", "{arguments}: data on stdout");
        for part in parts {
            assert!(run.stderr.contains(part), "{arguments}: {part:?} is not in {:?}", run.stderr);
        }
        let after = files(self.0.path());
        assert!(before == after, "{arguments}: left {:?}, found {:?}", after.keys(), before.keys());
    }

    /// Writes the Gaussians `gaussians` to the PLY file `name`, in the format of the original 3DGS code. Returns its
    /// path.
    pub(crate) fn ply(&self, name: &str, gaussians: &Gaussians) -> PathBuf {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        splatsieve::files::ply::write::write_inria(gaussians, &[], &path).unwrap();
        path
    }
}

/// Returns `memory` unchanged. Panics if it is `None` on Linux, which always reports the memory of a process.
pub(crate) fn said<T>(memory: Option<T>) -> Option<T> {
    assert!(memory.is_some() || !cfg!(target_os = "linux"), "nothing is said of memory");
    memory
}

/// Returns the memory that a run with `--explain` reports as used, in MiB; `None` if the system does not report it.
pub(crate) fn taken(stderr: &str) -> Option<f64> {
    let line = stderr.lines().find_map(|line| line.strip_prefix("memory: at most ")?.strip_suffix(" taken"));
    let words: Option<Vec<&str>> = said(line).map(|line| line.split(' ').collect());
    words.map(|words| {
        let unit = ["KiB", "MiB", "GiB"].iter().position(|unit| *unit == words[1]).unwrap();
        words[0].parse::<f64>().unwrap() * 1024f64.powi(unit as i32 - 1)
    })
}

/// Returns every file below `folder` with its bytes, by path relative to `folder`. Subfolders are listed without bytes.
pub(crate) fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut pending = vec![folder.to_owned()];
    while let Some(next) = pending.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(folder).unwrap().to_owned();
            if path.is_dir() {
                pending.push(path);
                found.insert(name, Vec::new());
            } else {
                found.insert(name, fs::read(path).unwrap());
            }
        }
    }
    found
}

/// Returns [`files`] without summaries, which are the only outputs that may differ between runs.
pub(crate) fn lasting_files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = files(folder);
    found.retain(|name, _| !name.to_str().unwrap().ends_with("summary.json"));
    found
}

/// Rows of a PLY file whose properties are all floats: names of the properties, and the bytes of every row.
pub(crate) struct PlyRows {
    pub(crate) names: Vec<String>,
    pub(crate) rows: Vec<Vec<u8>>,
}

impl PlyRows {
    pub(crate) fn read(path: &Path) -> PlyRows {
        let bytes = fs::read(path).unwrap();
        let mark = b"end_header\n";
        let body = bytes.windows(mark.len()).position(|window| window == mark).unwrap() + mark.len();
        let header = std::str::from_utf8(&bytes[..body]).unwrap();
        assert!(header.contains("format binary_little_endian 1.0"));
        let names: Vec<String> =
            header.lines().filter_map(|line| line.strip_prefix("property float ")).map(str::to_owned).collect();
        let count = header.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap();
        let rows: Vec<Vec<u8>> = bytes[body..].chunks_exact(4 * names.len()).map(<[u8]>::to_vec).collect();
        assert_eq!(rows.len().to_string(), count);
        assert_eq!(bytes.len(), body + 4 * names.len() * rows.len(), "bytes after the last row");
        PlyRows { names, rows }
    }

    /// Returns the value of property `name` in row `i`.
    pub(crate) fn value(&self, i: usize, name: &str) -> f32 {
        let at = 4 * self.names.iter().position(|found| found == name).unwrap();
        f32::from_le_bytes(self.rows[i][at..at + 4].try_into().unwrap())
    }
}

/// Reads an index map: for every Gaussian of the input its index in the output, or −1.
pub(crate) fn index_map(path: &Path) -> Vec<i64> {
    let bytes = fs::read(path).unwrap();
    npyz::NpyFile::new(&bytes[..]).unwrap().into_vec().unwrap()
}

/// Reads every array of an `.npz` file by name, converted to f64.
pub(crate) fn arrays(path: &Path) -> BTreeMap<String, Vec<f64>> {
    let mut archive = npyz::npz::NpzArchive::open(path).unwrap();
    let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    let mut read = |name: &str| -> Vec<f64> {
        let file = archive.by_name(name).unwrap().unwrap();
        let columns_first = (file.order() == npyz::Order::Fortran).then(|| file.shape().to_vec());
        let values: Vec<f64> = match file.dtype().descr().as_str() {
            "'<f4'" => file.into_vec::<f32>().unwrap().into_iter().map(f64::from).collect(),
            "'<i4'" => file.into_vec::<i32>().unwrap().into_iter().map(f64::from).collect(),
            "'<u4'" => file.into_vec::<u32>().unwrap().into_iter().map(f64::from).collect(),
            "'<i8'" => file.into_vec::<i64>().unwrap().into_iter().map(|value| value as f64).collect(),
            "'|b1'" => file.into_vec::<bool>().unwrap().into_iter().map(|value| f64::from(u8::from(value))).collect(),
            _ => file.into_vec::<f64>().unwrap(),
        };
        match columns_first.as_deref() {
            Some(&[rows, columns]) => {
                let at = |k: u64| values[((k % columns) * rows + k / columns) as usize];
                (0..rows * columns).map(at).collect()
            }
            _ => values,
        }
    };
    names.iter().map(|name| (name.clone(), read(name))).collect()
}

/// Returns a recipe made from `preset` that scores by projected coverage and uses no renders, so that formulas alone
/// decide.
pub(crate) fn by_formula(preset: &str) -> splatsieve::recipe::Recipe {
    use splatsieve::model::Attributes;
    use splatsieve::recipe::{AttributeGroups, Coverage, FieldPrecision, Recipe, ShDegreeRule, StaticScoreTerm};
    let mut recipe = Recipe::preset(preset).unwrap();
    recipe.scan.coverage = Coverage::Projected;
    recipe.score.static_term = StaticScoreTerm::Mean;
    recipe.select.choose_by_views = false;
    recipe.refine.refine = AttributeGroups(Attributes::empty());
    recipe.field.field = FieldPrecision::Exact;
    recipe.bands.bands = ShDegreeRule::All;
    recipe
}
