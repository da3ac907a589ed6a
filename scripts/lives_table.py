#!/usr/bin/env python3
"""Prints what linking saves if Gaussians have short lives: the same lives compressed separately, and linked to tracks.

    cargo build --release
    python3 scripts/lives_table.py target/release/splatsieve DATA [MODEL ...] [--overlap 2] [--ratios .4,.2,.1,.05] [--with="--no-refine"]

DATA/<name>/ is a 4DGaussians model folder with its cameras in it. cut_lives.py cuts its frames into lives of 4 to 12
frames, shuffles them, and adds noise of 2% of the size to positions and of 2% to colors and opacities. `alone` is a
container in which every life is a separate track, from the truth; `linked` is the folder as it is. Both are compressed
by `default` to the same fractions of their tracks. Prints the remaining tracks and Gaussian-frames (frames in which a
Gaussian is alive, over all Gaussians), and the PSNR of test views against the uncut model; then, by interpolation, how
many times fewer tracks give the PSNR of separate lives, and how many dB more the same number of Gaussian-frames gives.
Needs numpy and zstandard.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from cut_lives import read
from read_gseq import Gseq
from stream_writer import StreamWriter

# Opacity logit below which a Gaussian is absent.
THERE = -30
NOT_THERE = -40


def run(*command):
    result = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if result.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))}\n{result.stderr}")
    return result.stdout


def states(path):
    """Returns the columns of a PLY file, [N, width] each."""
    _, names, rows = read(path)
    rest = sum(name.startswith("f_rest_") for name in names) // 3

    def columns_of(*wanted):
        return rows[:, [names.index(name) for name in wanted]]

    # The file has red of all coefficients, then green, then blue.
    higher = [columns_of(*(f"f_rest_{channel * rest + k}" for channel in range(3))) for k in range(rest)]
    return {
        "position": columns_of("x", "y", "z"),
        "rotation": columns_of(*(f"rot_{c}" for c in range(4))),
        "log_scale": columns_of(*(f"scale_{c}" for c in range(3))),
        "opacity_logit": columns_of("opacity"),
        "sh": np.concatenate([columns_of(*(f"f_dc_{c}" for c in range(3))), *higher], 1),
    }


def pack_lives(binary, cut, times, out):
    """Writes a container in which every life is a track, with constant values outside its life."""
    truth = np.load(cut / "truth.npz")
    paths, starts = sorted(cut.glob("*.ply")), truth["starts"]
    # Sorted by first frame, so that lives of the same time are neighbors.
    names, first, number = np.unique(truth["life"], return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    place = np.empty(len(names), int)
    place[order] = np.arange(len(names))
    number = place[number]
    held, seen = None, np.zeros(len(names), bool)
    for frame, path in enumerate(paths):
        found, life = states(path), number[starts[frame] : starts[frame + 1]]
        if held is None:
            held = {name: np.zeros((len(names), column.shape[1]), np.float32) for name, column in found.items()}
        new = ~seen[life]
        for name, column in found.items():
            held[name][life[new]] = column[new]
        seen[life] = True
    degree = round((held["sh"].shape[1] / 3) ** 0.5) - 1
    command = [str(part) for part in (binary, "convert", "-", out, "--quiet")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as packing:
        with StreamWriter(packing.stdin, len(names), degree, {}) as stream:
            for frame, path in enumerate(paths):
                found, life = states(path), number[starts[frame] : starts[frame + 1]]
                held["opacity_logit"][:] = NOT_THERE
                for name, column in found.items():
                    held[name][life] = column
                stream.frame(times[frame], held)
        packing.stdin.close()
    if packing.returncode != 0:
        raise SystemExit("packing the lives failed")


def gaussian_frames(container):
    scene = Gseq(str(container))
    return sum(int((scene.column("opacity_logit", frame) > THERE).sum()) for frame in range(len(scene.times)))


def curve(binary, model, source, name, ratios, extra, scratch):
    """Returns tracks, Gaussian-frames and PSNR at each ratio."""
    points = []
    for ratio in ratios:
        out = scratch / "small.gseq"
        compress = ["compress", source, "--cameras", model, "-o", out, "--ratio", ratio, "--overwrite", "--json"]
        summary = json.loads(run(binary, *compress, *extra))
        quality = json.loads(run(binary, "evaluate", model, out, "--cameras", model, "--max-frames", 15, "--json"))
        points.append((summary["gaussians"], gaussian_frames(out), quality["psnr"]))
        tracks, frames, psnr = points[-1]
        print(f"| {model.name} | {name} | {100 * ratio:.0f}% | {tracks:,} | {frames:,} | {psnr:.1f} |", flush=True)
    return np.array(sorted(points))


def within(values, by, at):
    """Interpolates log `values` where the curve, which rises with `by`, reaches `at`; None if it does not."""
    if not by.min() <= at <= by.max():
        return None
    order = np.argsort(by)
    return float(np.exp(np.interp(at, by[order], np.log(values[order]))))


def compare(alone, linked):
    fewer, better = [], []
    for tracks, frames, psnr in alone:
        as_good = within(linked[:, 0], linked[:, 2], psnr)
        if as_good:
            fewer.append(f"{psnr:.1f} dB: {tracks / as_good:.1f}")
        if linked[:, 1].min() <= frames <= linked[:, 1].max():
            order = np.argsort(linked[:, 1])
            at = np.interp(np.log(frames), np.log(linked[order, 1]), linked[order, 2])
            better.append(f"{int(frames):,}: {at - psnr:+.1f}")
    return fewer, better


def main():
    parser = argparse.ArgumentParser(usage=plainly.usage(__doc__).strip())
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="*")
    parser.add_argument("--overlap", type=int, default=0)
    parser.add_argument("--ratios", type=lambda text: [float(part) for part in text.split(",")], default=[0.4, 0.2, 0.1, 0.05])
    parser.add_argument("--with", dest="extra", type=shlex.split, default=[])
    args = parser.parse_args()
    binary = args.binary.resolve()
    models = [args.data / name for name in args.models] or sorted(path.parent for path in args.data.glob("*/cfg_args"))
    print("| model | lives | kept | tracks | Gaussian-frames | PSNR dB to the uncut model |")
    print("|---|---|---|---|---|---|")
    for model in models:
        with tempfile.TemporaryDirectory() as folder:
            scratch = Path(folder)
            exact, frames, cut, lives = (scratch / name for name in ("exact.gseq", "frames", "cut", "lives.gseq"))
            run(binary, "convert", model, exact, "--cameras", model)
            run(binary, "convert", exact, frames, "--as", "ply-sequence")
            cutting = ["--lives", "4-12", "--noise", 0.02, "--jitter", 0.02, "--overlap", args.overlap]
            run(sys.executable, Path(__file__).parent / "cut_lives.py", frames, cut, *cutting)
            pack_lives(binary, cut, Gseq(str(exact)).times, lives)
            alone = curve(binary, model, lives, "alone", args.ratios, args.extra, scratch)
            linked = curve(binary, model, cut, "linked", args.ratios, args.extra, scratch)
            fewer, better = compare(alone, linked)
            print(f"\n{model.name}: times fewer tracks at equal PSNR: {', '.join(fewer) or '–'}")
            print(f"{model.name}: dB at equal Gaussian-frames: {', '.join(better) or '–'}\n", flush=True)


if __name__ == "__main__":
    sys.exit(main())
