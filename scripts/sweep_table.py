#!/usr/bin/env python3
"""Sweeps every model below a folder and prints Markdown tables of quality at equal count.

    cargo build --release
    python3 scripts/sweep_table.py target/release/splatsieve DATA CURVES

Example: python3 scripts/sweep_table.py target/release/splatsieve ../shared/data curves

DATA/<name>/ is a model folder with its cameras in it; DATA/static/<name>.ply is a model without cameras, for which the
script writes 12 training and 4 test cameras to CURVES/<name>.json. Results go to CURVES/<name>/; a model with a
CURVES/<name>/sweep.json is not swept again. Below the tables the script names the points at which `default` is more
than 0.05 dB below another method, and those at which `visible` is not above `projected`: both are expected to be
"nowhere". Needs only the standard library.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import array
import json
import math
import subprocess
import sys
from pathlib import Path

FRACTIONS = ["0.8", "0.6", "0.4", "0.2", "0.1"]


def positions(ply):
    """Returns the columns x, y, z of a binary PLY whose properties are all float and begin with these."""
    head, body = ply.read_bytes().split(b"end_header\n", 1)
    width = head.count(b"property float")
    values = array.array("f")
    values.frombytes(body[: len(body) // 4 * 4])
    return [values[axis::width] for axis in range(3)]


def cameras_around(ply, path, count=16, pixels=300, field_of_view=60):
    """Writes cameras on a Fibonacci sphere of two extents around the robust center; every fourth is a test camera."""
    axes = [sorted(axis) for axis in positions(ply)]
    ranges = [(axis[len(axis) // 100], axis[-1 - len(axis) // 100]) for axis in axes]
    middle = [(low + high) / 2 for low, high in ranges]
    radius = 2 * max(high - low for low, high in ranges)
    focal = pixels / 2 / math.tan(math.radians(field_of_view / 2))
    frames = []
    for k in range(count):
        z, turn = 1 - (2 * k + 1) / count, k * math.pi * (3 - math.sqrt(5))
        out = [math.cos(turn) * math.sqrt(1 - z * z), math.sin(turn) * math.sqrt(1 - z * z), z]
        right = [-math.sin(turn), math.cos(turn), 0]
        down = [right[1] * out[2], -right[0] * out[2], right[0] * out[1] - right[1] * out[0]]
        axes = [right, down, [-x for x in out]]
        eye = [m + radius * x for m, x in zip(middle, out)]
        rows = [[*axis, -sum(a * e for a, e in zip(axis, eye))] for axis in axes]
        frames.append(
            {"v": k, "split": "test" if k % 4 == 2 else "train", "width": pixels, "height": pixels, "fx": focal}
            | {"fy": focal, "cx": pixels / 2, "cy": pixels / 2, "w2c": [*rows, [0, 0, 0, 1]]}
        )
    path.write_text(json.dumps({"background": [0, 0, 0], "frames": frames}, indent=1) + "\n")
    return path


def sweep(binary, source, output):
    found = output / "sweep.json"
    if not found.exists():
        cameras = source if source.is_dir() else cameras_around(source, output.with_suffix(".json"))
        command = [binary, "sweep", str(source), "--cameras", str(cameras), "--fractions", ",".join(FRACTIONS)]
        command += ["-o", str(output)]
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode != 0:
            sys.exit(f"{' '.join(command)}\n{result.stderr}")
    return json.loads(found.read_text())


def table(name, found):
    by_method = {}
    for point in found["points"]:
        if point["asked"] is not None:
            by_method.setdefault(point["method"], {})[point["asked"]] = point
    print(f"| {name} | " + " | ".join(f"{float(f):.0%}" for f in FRACTIONS) + " | s at 40% | MiB |")
    print("|---" * (len(FRACTIONS) + 3) + "|")
    for method, points in by_method.items():
        cells = [f"{points[float(f)]['psnr']:.1f}" if float(f) in points else "–" for f in FRACTIONS]
        at = points.get(0.4)
        memory = [point["peak_memory_bytes"] for point in points.values() if point["peak_memory_bytes"]]
        seconds = f"{at['seconds']:.1f}" if at else "–"
        print(f"| {method} | {' | '.join(cells)} | {seconds} | {max(memory, default=0) / 2**20:.0f} |")
    print(flush=True)
    return by_method


def main():
    if len(sys.argv) != 4:
        print(__doc__)
        sys.exit(2)
    binary, data, curves = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    curves.mkdir(parents=True, exist_ok=True)
    sources = {path.parent.name: path.parent for path in sorted(data.glob("*/cfg_args"))}
    sources |= {path.stem: path for path in sorted(data.glob("static/*.ply"))}
    below, beaten = [], []
    for name, source in sources.items():
        by_method = table(name, sweep(binary, source, curves / name))
        for method, points in by_method.items():
            for fraction, point in points.items():
                ours = by_method["default"][fraction]["psnr"]
                if ours < point["psnr"] - 0.05:
                    below.append(f"{name} at {fraction}: {ours:.2f} dB, {method} {point['psnr']:.2f}")
        for fraction, point in by_method["visible"].items():
            projected = by_method["projected"][fraction]["psnr"]
            if point["psnr"] <= projected:
                beaten.append(f"{name} at {fraction}: {point['psnr']:.2f} dB, projected {projected:.2f}")
    print("`default` more than 0.05 dB below another method:", "; ".join(below) or "nowhere")
    print("`visible` not above `projected`:", "; ".join(beaten) or "nowhere")


if __name__ == "__main__":
    main()
