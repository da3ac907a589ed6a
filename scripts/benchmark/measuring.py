"""What the benchmark scripts share: the models, runs of the program, and the CSV files.

A benchmark script measures one subject and writes docs/benchmarks/NAME.csv, one row per setting and model. The first
lines of the file begin with `#`: program with commit, machine, date, command. The tables of README.md and
docs/benchmarks.md are made of these files by `SPLATSIEVE_WRITE_DOCS=1 cargo test --test command_line docs`, and the
same test without the variable compares them. Needs only the standard library.
"""

import argparse
import csv
import datetime
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from array import array
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "benchmarks"
sys.path.insert(0, str(ROOT / "scripts"))

import plainly  # noqa: E402, F401 (an error ends with a sentence)

# Fractions of the Gaussians that most tables keep.
KEPT = ["40%", "20%", "10%", "5%"]


@dataclass
class Model:
    """Model to measure: its name in tables, its path, the file or folder of its cameras, and the folder of photographs of
    its test views, or None."""

    name: str
    path: Path
    cameras: Path
    photographs: Path | None = None
    # Options of every command that opens the model.
    options: tuple = ()

    @property
    def suffix(self):
        """Ending of a compressed model in the same format; empty for a folder."""
        return self.path.suffix if self.path.is_file() else ""


def trained_models(data, scratch):
    """Returns the models below DATA: 4DGaussians folders with their photographs, static PLY files with an orbit of
    cameras, and the captured scene."""
    models = []
    for path in sorted(path.parent for path in data.glob("*/cfg_args")):
        test = path / "test"
        models.append(Model(path.name, path, path, test if test.is_dir() else None))
    for path in sorted(data.glob("captured/*_train.json")):
        name = path.name.removesuffix("_train.json")
        cameras = joined_cameras(path, scratch / f"{name}.json")
        models.append(Model(name, path.with_name(f"{name}.splatv"), cameras, options=("--frames", 30)))
    for path in sorted(data.glob("static/*.ply")):
        models.append(Model(path.stem, path, orbit(path, scratch / f"{path.stem}.json")))
    return models


def joined_cameras(train, path):
    """Writes one camera file of the lists NAME_train.json and NAME_test.json, which give the center and the rotation from
    camera to world of every camera, and returns its path."""
    frames = []
    for split in ("train", "test"):
        for camera in json.loads(Path(str(train).replace("_train.json", f"_{split}.json")).read_text()):
            turned = list(zip(*camera["rotation"]))
            rows = [[*row, -sum(r * x for r, x in zip(row, camera["position"]))] for row in turned]
            intrinsics = {key: camera[key] for key in ("width", "height", "fx", "fy")}
            center = {"cx": camera["width"] / 2, "cy": camera["height"] / 2}
            frames.append({"v": len(frames), "split": split, "w2c": [*rows, [0, 0, 0, 1]]} | intrinsics | center)
    path.write_text(json.dumps({"background": [0, 0, 0], "frames": frames}) + "\n")
    return path


def positions(ply):
    """Returns the columns x, y, z of a binary PLY whose properties are all float and begin with these."""
    head, body = ply.read_bytes().split(b"end_header\n", 1)
    width = head.count(b"property float")
    values = array("f")
    values.frombytes(body[: len(body) // 4 * 4])
    return [values[axis::width] for axis in range(3)]


def orbit(ply, path, pixels=300, focal=330):
    """Writes 12 training and 4 test cameras around the median position, at 2.2 times the distance within which 90% of
    the Gaussians lie; up is y. Returns the path of the file."""
    axes = positions(ply)
    middle = [sorted(axis)[len(axis) // 2] for axis in axes]
    distances = sorted(math.dist(middle, place) for place in zip(*axes))
    radius = 2.2 * distances[len(distances) * 9 // 10]
    train = [(math.tau * i / 12, 0.25 + 0.35 * (i % 3 - 1), "train") for i in range(12)]
    test = [(math.tau * (i + 0.37) / 4, (0.1, 0.45, -0.05, 0.3)[i], "test") for i in range(4)]
    frames = []
    for view, (azimuth, elevation, split) in enumerate(train + test):
        flat, high = math.cos(elevation), math.sin(elevation)
        out = [flat * math.sin(azimuth), high, flat * math.cos(azimuth)]
        right = [math.cos(azimuth), 0, -math.sin(azimuth)]
        down = [high * math.sin(azimuth), -flat, high * math.cos(azimuth)]
        eye = [m + radius * x for m, x in zip(middle, out)]
        rows = [[*axis, -sum(a * e for a, e in zip(axis, eye))] for axis in (right, down, [-x for x in out])]
        frames.append(
            {"v": view, "split": split, "width": pixels, "height": pixels, "fx": focal, "fy": focal}
            | {"cx": pixels / 2, "cy": pixels / 2, "w2c": [*rows, [0, 0, 0, 1]]}
        )
    path.write_text(json.dumps({"background": [0, 0, 0], "frames": frames}) + "\n")
    return path


@dataclass
class Cost:
    """What a process took: wall and processor seconds, and peak resident memory in MiB."""

    wall: float
    processor: float
    peak: float


def run(*command):
    """Runs a command. Returns its standard output and its cost; ends the script with its error if it fails."""
    command = [str(part) for part in command]
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        start = time.monotonic()
        process = subprocess.Popen(command, stdout=output, stderr=errors)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.monotonic() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        if process.returncode != 0:
            sys.exit(f"{' '.join(command)}\n{errors.read().decode(errors='replace')}")
        output.seek(0)
        return output.read().decode(), Cost(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def compress(program, model, output, *options):
    """Compresses a model. Returns the summary and the cost of the process."""
    text, cost = run(
        program, "compress", model.path, "--cameras", model.cameras, *model.options, "-o", output, "--json", "--quiet",
        "--overwrite", *options,
    )  # fmt: skip
    return json.loads(text), cost


def evaluate(program, model, output, *options):
    """Returns what `evaluate` says of the test views: 15 frames of every test camera, and photographs if the model has
    some."""
    truth = ["--ground-truth", model.photographs] if model.photographs else []
    command = [program, "evaluate", model.path, output, "--cameras", model.cameras, *model.options, *truth]
    return json.loads(run(*command, "--max-frames", 15, "--json", "--quiet", *options)[0])


def middle_and_range(values):
    """Returns the median of the values, the smallest and the largest."""
    return statistics.median(values), min(values), max(values)


def words(text):
    """Returns the words of a list with commas; the type of options that take such a list."""
    return text.split(",")


def arguments(description, *more):
    """Returns the parsed command line `PROGRAM DATA [--models A,B] …`; `more` are further options as pairs of a name and
    keywords of argparse."""
    parser = argparse.ArgumentParser(description=description.strip().splitlines()[0])
    parser.add_argument("program", help="the program to measure, such as target/release/splatsieve")
    parser.add_argument("data", type=Path, help="folder with the trained models")
    parser.add_argument("--results", type=Path, help="folder of the CSV file [default: docs/benchmarks]")
    parser.add_argument("--models", type=words, help="names of models, separated by commas [default: all]")
    for name, keywords in more:
        parser.add_argument(name, **keywords)
    args = parser.parse_args()
    if args.results:
        global RESULTS
        RESULTS = args.results
    return args


def chosen(args, scratch):
    """Returns the models that the command line asks for."""
    models = trained_models(args.data, Path(scratch))
    return [model for model in models if not args.models or model.name in args.models]


def commit():
    """Returns the commit of this checkout, with a mark if program files differ from it; "unknown" outside of git."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short=10", "HEAD"], capture_output=True, text=True)
    if head.returncode != 0:
        return "unknown"
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "src", "crates", "Cargo.toml"]).returncode != 0
    return head.stdout.strip() + (" with changes" if changed else "")


def machine():
    """Returns the processor, the number of cores and the memory of this machine, in a line."""
    name = "unknown processor"
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{name}, {os.cpu_count()} cores, {memory:.0f} GiB"


class Results:
    """CSV file docs/benchmarks/NAME.csv, written row by row. A row is also printed when it is added."""

    def __init__(self, name, program, columns):
        RESULTS.mkdir(exist_ok=True)
        self.path = RESULTS / f"{name}.csv"
        self.columns = columns
        version = run(program, "--version")[0].strip()
        script = f"python3 scripts/benchmark/{Path(sys.argv[0]).name}"
        # Without paths, so that the file does not describe the disk of this machine.
        options = ["PATH" if "/" in word else word for word in sys.argv[3:]]
        lines = [
            f"# program: {version}, commit {commit()}",
            f"# machine: {machine()}",
            f"# date: {datetime.date.today()}",
            f"# command: {' '.join([script, 'PROGRAM', 'DATA', *options])}",
        ]
        self.path.write_text("\n".join(lines) + "\n" + ",".join(columns) + "\n")
        print("\n".join(lines), ",".join(columns), sep="\n", flush=True)

    def add(self, **values):
        """Adds a row; a float is written with six significant digits, None as an empty cell."""
        cells = [values.pop(column) for column in self.columns]
        assert not values, f"no columns for {list(values)}"
        cells = ["" if cell is None else f"{cell:.6g}" if isinstance(cell, float) else str(cell) for cell in cells]
        with self.path.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(cells)
        print(",".join(cells), flush=True)


def read_results(name):
    """Returns the rows of docs/benchmarks/NAME.csv as dictionaries of text."""
    with (RESULTS / f"{name}.csv").open() as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))
