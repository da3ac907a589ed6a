//! Tests of the Python scripts against the program: each reads what the other writes, to the bit.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::scene::{Workplace, program, state, tiny};
use splatsieve::files::container::Container;
use splatsieve::model::Attributes;
use splatsieve::source::FrameSource;

/// Returns a Python that has `modules`: `python3`, or the one that `PYTHON` names. Panics if a module is missing.
fn python(modules: &str) -> PathBuf {
    let python = std::env::var_os("PYTHON").map_or_else(|| PathBuf::from("python3"), PathBuf::from);
    let found = Command::new(&python).args(["-c", &format!("import {modules}")]).stderr(Stdio::null()).status();
    assert!(found.is_ok_and(|status| status.success()), "{} cannot import {modules}", python.display());
    python
}

fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts").join(name)
}

/// Runs `command`, a call of Python, in the workplace. Checks that it succeeds and returns its standard output.
fn run(command: &mut Command, workplace: &Workplace) -> Vec<u8> {
    let output = command.current_dir(workplace.path("")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// Runs `exporter`, a program that writes a frame stream to standard output. Converts the stream to the container
/// `name` and opens it.
fn packed(workplace: &Workplace, exporter: &mut Command, name: &str) -> Container {
    let stream = run(exporter, workplace);
    fs::write(workplace.path("stream"), stream).unwrap();
    let status = Command::new(program())
        .args(["convert", "-", name])
        .current_dir(workplace.path(""))
        .stdin(fs::File::open(workplace.path("stream")).unwrap())
        .output()
        .unwrap();
    assert!(status.status.success(), "{}", String::from_utf8_lossy(&status.stderr));
    Container::open(&workplace.path(name)).unwrap()
}

/// Writes the values of the scene at `frame` as float32 files, one per attribute: first all components of Gaussian 0,
/// then those of Gaussian 1, and so on.
fn write_columns(workplace: &Workplace, scene: &Container, frame: usize) {
    let state = state(scene, frame);
    for column in Attributes::all().iter() {
        let values = state.attribute_values(column);
        let bytes: Vec<u8> = (0..values.len())
            .flat_map(|i| (0..values.width()).flat_map(move |c| values.plane(c)[i].to_le_bytes()))
            .collect();
        fs::write(workplace.path(&format!("{}_{frame}.f32", column.name())), bytes).unwrap();
    }
}

#[test]
#[ignore = "needs numpy and zstandard"]
fn tracks_cut_by_a_script_are_linked_and_scored() {
    let python = python("numpy, zstandard");
    let workplace = Workplace::new();
    workplace.done("convert {tiny} tiny.gseq --frames 9");
    workplace.done("convert tiny.gseq frames --as ply-sequence");
    let cut = script("cut_lives.py");
    let mut command = Command::new(&python);
    let said = run(
        command.arg(&cut).args(["frames", "cut", "--lives", "3-5", "--overlap", "1", "--noise", "0.01"]),
        &workplace,
    );
    let said = String::from_utf8(said).unwrap();
    assert!(said.contains("in 9 frames"), "{said}");
    workplace.done("convert cut linked.gseq --link apart");
    let score = run(Command::new(&python).arg(&cut).args(["--score", "cut", "linked.gseq"]), &workplace);
    let score = String::from_utf8(score).unwrap();
    assert!(score.contains("by gaussian: ") && score.contains(" tracks, "), "{score}");
}

#[test]
#[ignore = "needs numpy"]
fn exported_arrays_arrive_bit_for_bit() {
    let python = python("numpy");
    let workplace = Workplace::new();
    workplace.done("convert {tiny} scene.gseq");
    let scene = Container::open(&workplace.path("scene.gseq")).unwrap();
    (0..10).for_each(|frame| write_columns(&workplace, &scene, frame));
    let times: Vec<String> = scene.info().times.iter().map(|time| format!("{time:?}")).collect();
    // Only moving attributes have one row per frame. The arrays are in an .npz or in a folder of .npy files.
    let varying = scene.info().varying;
    let make = format!(
        "import numpy as np, os\n\
         read = lambda n, t, w: np.fromfile(f'{{n}}_{{t}}.f32', '<f4').reshape((300, *w))\n\
         widths = dict(position=(3,), rotation=(4,), log_scale=(3,), opacity_logit=(1,), sh=(-1, 3))\n\
         varying = {:?}.split()\n\
         a = {{n: np.array([read(n, t, w) for t in range(10)]) if n in varying else read(n, 0, w) for n, w in widths.items()}}\n\
         a['times'] = np.array([{}])\n\
         np.savez('model.npz', **a)\n\
         os.mkdir('folder')\n\
         [np.save(f'folder/{{n}}.npy', x) for n, x in a.items()]",
        varying.iter().map(Attributes::name).collect::<Vec<_>>().join(" "),
        times.join(", ")
    );
    run(Command::new(&python).args(["-c", &make]), &workplace);
    for from in ["model.npz", "folder"] {
        let mut exporter = Command::new(&python);
        exporter.arg(script("export_arrays.py")).arg(from);
        let found = packed(&workplace, &mut exporter, &format!("{from}.gseq"));
        assert_eq!(found.info(), scene.info(), "{from}");
        assert!((0..10).all(|frame| state(&found, frame) == state(&scene, frame)), "{from}");
    }
}

#[test]
#[ignore = "needs numpy"]
fn failing_exporter_writes_no_end_mark() {
    let python = python("numpy");
    let workplace = Workplace::new();
    let code = "import sys; sys.path.insert(0, sys.argv[1])\n\
        from stream_writer import StreamWriter\n\
        with StreamWriter(sys.stdout.buffer, 1, 0, dict(rotation=[[1, 0, 0, 0]], log_scale=[[0] * 3], opacity_logit=[0], sh=[[[0] * 3]])) as s:\n    \
            s.frame(0.0, dict(position=[[1, 2, 3]]))\n    \
            raise SystemExit(1)";
    let output = Command::new(python).args(["-c", code]).arg(script("")).output().unwrap();
    fs::write(workplace.path("stream"), output.stdout).unwrap();
    let output = Command::new(program())
        .args(["convert", "-", "a.gseq"])
        .current_dir(workplace.path(""))
        .stdin(fs::File::open(workplace.path("stream")).unwrap())
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(message.contains("after 1 complete frame, without its end mark"), "{message}");
}

/// Checks that the writer names the attribute, the expected shape and the found shape before it writes anything.
#[test]
#[ignore = "needs numpy"]
fn stream_writer_refuses_wrong_shapes_and_names() {
    let code = r#"
import io, re, sys; sys.path.insert(0, sys.argv[1])
import numpy as np
from stream_writer import StreamWriter

widths = dict(position=(3,), rotation=(4,), log_scale=(3,), opacity_logit=(1,), sh=(4, 3))
good = lambda n: {name: np.zeros((n, *width)) for name, width in widths.items()}

def refused(words, count, degree, constant, frame):
    out = io.BytesIO()
    written = 0
    try:
        writer = StreamWriter(out, count, degree, constant)
        written = out.tell()
        writer.frame(0.0, frame)
    except ValueError as error:
        assert str(error) == words, error
        assert out.tell() == written
    else:
        raise AssertionError(f"accepted: {words}")

def frame(**changed):
    return good(7) | changed

refused("frame 0: position has shape [3, 7], expected [7, 3]", 7, 1, None, frame(position=np.zeros((3, 7))))
refused("frame 0: position has shape [3, 7], expected [N, 3]", None, 1, None, frame(position=np.zeros((3, 7))))
refused("frame 0: rotation has shape [6, 4], expected [7, 4]", None, 1, None, frame(rotation=np.zeros((6, 4))))
opacity = np.zeros((1, 7))
refused("frame 0: opacity_logit has shape [1, 7], expected [7] or [7, 1]", 7, 1, None, frame(opacity_logit=opacity))
refused("frame 0: sh has shape [7, 4, 3], expected [7, 9, 3] or [7, 27]", 7, 2, None, frame())
refused("frame 0: position has shape [7, 3], expected [8, 3]", 8, 1, None, frame())
refused("frame 0: log_scale has shape [], expected [7, 3]", 7, 1, None, frame(log_scale=1.0))
constant = dict(sh=np.zeros((3, 4, 7)))
refused("constant columns: sh has shape [3, 4, 7], expected [7, 4, 3] or [7, 12]", 7, 1, constant, {})
names = "position, rotation, log_scale, opacity_logit, sh"
refused(f"frame 0: no attribute is named 'color', expected {names}", 7, 1, None, frame(color=np.zeros((7, 3))))
refused(f"constant columns: no attribute is named 'scale', expected {names}", 7, 1, dict(scale=np.zeros((7, 3))), {})
missing = frame(); del missing["rotation"]
refused(f"frame 0: no rotation; each frame has {names}", 7, 1, None, missing)
refused("frame 0: sh was given as constant, so no frame may have it", 7, 1, dict(sh=good(7)["sh"]), frame())
refused("sh_degree is 4, expected 0, 1, 2 or 3", 7, 4, None, frame())
refused("count is -1, expected a number of Gaussians from 0 to 2^32 - 1", -1, 1, None, frame())

flat, full = io.BytesIO(), io.BytesIO()
sh = np.arange(7 * 12.0).reshape(7, 4, 3)
StreamWriter(full, 7, 1, None).frame(0.0, frame(sh=sh))
StreamWriter(flat, 7, 1, None).frame(0.0, frame(sh=sh.reshape(7, 12), opacity_logit=np.zeros(7)))
assert flat.getvalue() == full.getvalue()
"#;
    run(Command::new(python("numpy")).args(["-c", code]).arg(script("")), &Workplace::new());
}

#[test]
#[ignore = "needs numpy"]
fn stream_without_gaussians_is_written_and_read() {
    let python = python("numpy");
    let workplace = Workplace::new();
    let code = "import sys; sys.path.insert(0, sys.argv[1])\n\
        import numpy as np\n\
        from stream_writer import StreamWriter\n\
        none = dict(rotation=np.zeros((0, 4)), log_scale=np.zeros((0, 3)), opacity_logit=[], sh=np.zeros((0, 4, 3)))\n\
        with StreamWriter(sys.stdout.buffer, 0, 1, none) as s:\n    \
            s.frame(0.0, dict(position=np.zeros((0, 3))))\n    \
            s.frame(1.0, dict(position=np.zeros((0, 3))))";
    let mut exporter = Command::new(python);
    exporter.args(["-c", code]).arg(script(""));
    let found = packed(&workplace, &mut exporter, "none.gseq");
    assert_eq!((found.info().count, &found.info().times[..]), (0, &[0.0, 1.0][..]));
}

#[test]
#[ignore = "needs numpy and zstandard"]
fn python_container_reader_returns_every_bit() {
    let python = python("numpy, zstandard");
    let workplace = Workplace::new();
    workplace.done("convert {tiny} zstd.gseq");
    workplace.done("convert {tiny} raw.gseq --raw");
    workplace.done("test-scene --gaussians 2500 --frames 70 -o demo");
    workplace.done("convert {tiny} tiny.gseq --max-error position=1e-2,rotation=1e-2,log_scale=1e-2,sh=1e-2");
    workplace.done("convert demo/scene.gseq demo.gseq --max-error position=0.05%,rotation=1e-3,opacity_logit=0.1");
    for (path, frames) in [
        ("zstd.gseq", vec![0, 9]),
        ("raw.gseq", vec![3]),
        ("demo/scene.gseq", vec![0, 1, 33, 69]),
        ("tiny.gseq", vec![0, 5]),
        ("demo.gseq", vec![0, 1, 2, 40, 69]),
    ] {
        let scene = Container::open(&workplace.path(path)).unwrap();
        for frame in frames {
            write_columns(&workplace, &scene, frame);
            let check = format!(
                "import sys; sys.path.insert(0, sys.argv[1])\n\
                 import numpy as np\n\
                 from read_gseq import Gseq\n\
                 g = Gseq('{path}')\n\
                 assert len(g.times) == {}, g.times\n\
                 for name in 'position rotation log_scale opacity_logit sh'.split():\n    \
                     expected = np.fromfile(f'{{name}}_{frame}.f32', '<u4')\n    \
                     found = np.ascontiguousarray(g.column(name, {frame}), '<f4').view('<u4').ravel()\n    \
                     assert np.array_equal(found, expected), name",
                scene.info().times.len()
            );
            run(Command::new(&python).args(["-c", &check]).arg(script("")), &workplace);
        }
    }
}

#[test]
#[ignore = "needs numpy and zstandard"]
fn python_container_reader_refuses_frames_outside() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} tiny.gseq --frames 3");
    let check = "import sys; sys.path.insert(0, sys.argv[1])\n\
         from read_gseq import Gseq\n\
         for frame in (-1, 3):\n    \
             try: Gseq('tiny.gseq').column('position', frame)\n    \
             except IndexError as error: print(error)";
    let said = run(Command::new(python("numpy, zstandard")).args(["-c", check]).arg(script("")), &workplace);
    let expected = [-1, 3].map(|frame| format!("no frame {frame}: the container has 3 frames, counted from 0\n"));
    assert_eq!(String::from_utf8(said).unwrap(), expected.concat());
}

/// Replacements for the classes of the 4DGaussians repository, with their names, signatures and printed output, because
/// the real classes need its CUDA extensions. The deformation adds the time to positions.
const REPOSITORY: [(&str, &str); 3] = [
    (
        "arguments.py",
        "from argparse import Namespace\n\
         class ModelParams:\n    \
             def __init__(self, parser, sentinel=False):\n        \
                 parser.add_argument('--model_path', '-m')\n    \
             def extract(self, args): return Namespace(sh_degree=args.sh_degree)\n\
         class ModelHiddenParams:\n    \
             def __init__(self, parser): pass\n    \
             def extract(self, args): return Namespace()\n\
         def get_combined_args(parser):\n    \
             print('Looking for config file')\n    \
             given = {k: v for k, v in vars(parser.parse_args()).items() if v is not None}\n    \
             return Namespace(**{'sh_degree': 1, **given})\n",
    ),
    ("scene/__init__.py", ""),
    (
        "scene/gaussian_model.py",
        "import torch\n\
         class GaussianModel:\n    \
             def __init__(self, sh_degree, args): self.max_sh_degree = sh_degree\n    \
             def load_ply(self, path):\n        \
                 print('loading', path)\n        \
                 n = torch.arange(7.)[:, None]\n        \
                 self._xyz, self._scaling, self._rotation, self._opacity = n.repeat(1, 3), -n.repeat(1, 3), n.repeat(1, 4), n\n        \
                 self._features = torch.arange(7 * 4 * 3.).reshape(7, 4, 3)\n    \
             def load_model(self, path): print('loading model from exists' + path)\n    \
             @property\n    \
             def get_xyz(self): return self._xyz\n    \
             @property\n    \
             def get_features(self): return self._features\n    \
             def _deformation(self, point, scales, rotations, opacity, shs, times_sel):\n        \
                 print('deforming')\n        \
                 assert times_sel.shape == (7, 1)\n        \
                 return point + times_sel, scales, rotations, opacity, shs\n",
    ),
];

#[test]
#[ignore = "needs numpy and PyTorch"]
fn exporter_of_4dgaussians_streams_the_evaluated_states() {
    let python = python("numpy, torch");
    let workplace = Workplace::new();
    for (name, text) in REPOSITORY {
        fs::create_dir_all(workplace.path("scene")).unwrap();
        fs::write(workplace.path(name), text).unwrap();
    }
    for iteration in ["iteration_9", "iteration_30"] {
        fs::create_dir_all(workplace.path("model/point_cloud").join(iteration)).unwrap();
    }
    let transforms = tiny().join("transforms_train.json");
    let mut exporter = Command::new(python);
    exporter.arg(script("export_4dgaussians.py")).args(["-m", "model", "--device", "cpu", "--cameras"]).arg(transforms);
    let found = packed(&workplace, &mut exporter, "a.gseq");
    assert_eq!((found.info().count, found.info().times.len(), found.info().sh_degree), (7, 10, 1));
    for frame in [0, 9] {
        let state = state(&found, frame);
        for i in 0..7 {
            let x = i as f32 + found.info().times[frame] as f32;
            assert_eq!(state.position.row(i), [x; 3]);
            assert_eq!(state.log_scale.row(i), [-(i as f32); 3]);
            assert_eq!(state.rotation.row(i), [i as f32; 4]);
            assert_eq!(state.opacity_logit.row(i), [i as f32]);
            assert_eq!(state.sh.row::<12>(i), std::array::from_fn(|c| (12 * i + c) as f32));
        }
    }
}

#[test]
#[ignore = "needs numpy"]
fn generated_stream_always_moves_and_is_reproducible() {
    let python = python("numpy");
    let workplace = Workplace::new();
    let exporter = |arguments: &[&str]| {
        let mut command = Command::new(&python);
        command.arg(script("generate_stream.py")).args(arguments);
        command
    };
    let found = packed(&workplace, &mut exporter(&["500", "70"]), "a.gseq");
    let again = packed(&workplace, &mut exporter(&["500", "70"]), "b.gseq");
    let info = found.info();
    assert_eq!((info.count, info.times.len(), info.sh_degree), (500, 70, 3));
    assert_eq!(info.varying, Attributes::all().difference(Attributes::SH));
    // One period apart the curves have the same values, except for noise.
    for (frame, other) in [(0, 1), (33, 34), (5, 65)] {
        let (one, two) = (state(&found, frame), state(&found, other));
        assert!(one == state(&again, frame), "frame {frame}");
        for column in info.varying.iter() {
            let values = one.attribute_values(column).planes().iter().zip(two.attribute_values(column).planes());
            let (all, equal) = values.fold((0, 0), |(all, equal), (a, b)| (all + 1, equal + usize::from(a == b)));
            // Noise of 2e-5 gives the same float of size 4 in 1% of cases.
            assert!(equal * 50 < all, "{}: {equal} of {all} values of frames {frame} and {other}", column.name());
        }
    }
    let moved = packed(&workplace, &mut exporter(&["40", "3", "--varying", "position", "--sh-degree", "0"]), "c.gseq");
    assert_eq!((moved.info().varying, moved.info().sh_degree), (Attributes::POSITION, 0));
}

#[test]
#[ignore = "needs numpy"]
fn scale_script_reports_cost_of_every_size() {
    let python = python("numpy");
    let workplace = Workplace::new();
    let mut scale = Command::new(python);
    scale.arg(script("benchmark/scale.py")).arg(program()).arg("unused");
    scale.args(["--sizes", "300x20,3000x20", "--limits", "none", "--results", "here"]);
    run(&mut scale, &workplace);
    let written = fs::read_to_string(workplace.path("here/scale.csv")).unwrap();
    let rows: Vec<_> = written.lines().filter(|line| !line.starts_with('#')).collect();
    assert!(rows[0].starts_with("gaussians,frames,memory_limit,"), "{written}");
    assert!(rows[1].starts_with("300,20,none,") && rows[2].starts_with("3000,20,none,"), "{written}");
}

/// Checks that the bar of a sweep is drawn above the bars of its runs, and that no bar is longer than the terminal or
/// remains at the end.
#[test]
#[ignore = "needs Python"]
fn bars_fit_the_terminal_and_leave_no_line_behind() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 2000 --frames 16 -o demo --no-refine");
    let program = program();
    let mut terminal = Command::new(python("pty"));
    terminal.arg(script("terminal.py")).args(["--columns", "60,100,120"]).arg(program);
    let sweep =
        "sweep demo/scene.gseq --cameras demo/cameras.json -o curves --methods default --fractions 0.3 --overwrite";
    let said = run(terminal.args(sweep.split(' ')), &workplace);
    assert_eq!(String::from_utf8(said).unwrap().matches("all fit").count(), 3);
}

/// Checks the summary of a list of scenes, without a scheduler, and the messages about lists that cannot be run.
#[test]
#[ignore = "needs Python"]
fn many_scenes_are_summarized_with_their_quality() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 300 --frames 4 -o demo");
    let many = |arguments: &[&str]| {
        let mut command = Command::new(python("json"));
        command.arg(script("slurm/many_scenes.py")).args(arguments).current_dir(workplace.path(""));
        command.output().unwrap()
    };
    let program = program();
    let program = program.to_str().unwrap();
    let scenes = "demo/scene.gseq demo/cameras.json a.gseq --no-refine --ratio 0.5\n\
        demo/scene.gseq demo/cameras.json b.gsz --no-refine --min-psnr 30\n";
    fs::write(workplace.path("list"), scenes).unwrap();
    assert!(many(&["list", "--program", program]).status.success());
    for number in ["1", "2"] {
        let output = many(&["list.run", "--task", number]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert!(many(&["list.run", "--summary"]).status.success());
    let table = fs::read_to_string(workplace.path("list.run/summary.csv")).unwrap();
    let rows: Vec<_> = table.lines().collect();
    let summary: serde_json::Value =
        serde_json::from_slice(&fs::read(workplace.path("a.gseq.summary.json")).unwrap()).unwrap();
    let psnr = summary["quality"]["psnr"].as_f64().unwrap();
    assert!(rows[1].contains(&format!("{psnr:.2} dB PSNR, ")) && rows[1].contains(" SSIM vs. original ("), "{table}");
    assert!(rows[2].contains(" dB PSNR vs. original on the views of the search, 30 dB asked for"), "{table}");

    for (line, expected) in [
        ("--dry-run", "list2, line 1: --dry-run cannot be an option of a scene here; remove it"),
        ("--shard=1/2", "list2, line 1: --shard cannot be an option of a scene here; remove it"),
    ] {
        fs::write(workplace.path("list2"), format!("demo/scene.gseq - c.gseq {line}\n")).unwrap();
        let output = many(&["list2", "--program", program]);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(message.trim_end().ends_with(expected) && message.lines().count() == 1, "{message}");
    }
    for (arguments, expected) in [
        (vec!["none", "--program", program], "none: No such file or directory"),
        (vec!["none.run", "--summary"], "expected a folder made from a list (LIST.run), found no scenes.json in it"),
    ] {
        let message = String::from_utf8(many(&arguments).stderr).unwrap();
        assert!(message.trim_end().ends_with(expected) && message.lines().count() == 1, "{message}");
    }
}

/// Runs the tests of the installed Python package: compressing, streams, containers and refusals.
#[test]
#[ignore = "needs maturin, numpy and zstandard"]
fn installed_python_package_passes_its_tests() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/tests/installed.py");
    let output = Command::new(python("maturin, numpy, zstandard")).arg(script).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
