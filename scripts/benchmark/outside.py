#!/usr/bin/env python3
"""Measures quality at a camera outside the training rig: docs/benchmarks/outside.csv.

    cargo build --release
    python3 scripts/benchmark/outside.py target/release/splatsieve DATA [--models A,B] [--kept 10%]

Of each model with a `cameras.json`, the training camera farthest from the mean of all training cameras is left out
("corner camera"). The others score, rank, fit and validate. PSNR is the mean over 15 frames of the test cameras, and of
the corner camera, against renders of the unpruned model.
"""

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate

SETTINGS = {
    "unrefined": ["--no-refine"],
    "outside=0": ["--set", "outside=0"],
    "outside=0.04": ["--set", "outside=0.04"],
    "outside=0.05": ["--set", "outside=0.05"],
    "default": [],
    "outside=0.08": ["--set", "outside=0.08"],
    "outside=0.5": ["--set", "outside=0.5"],
    "outside=1": ["--set", "outside=1"],
}


def center(w2c):
    """Returns the center of a camera, -Rᵀ·t."""
    return [-sum(w2c[row][axis] * w2c[row][3] for row in range(3)) for axis in range(3)]


def without_corner(cameras, folder):
    """Writes the cameras without the corner camera, and the corner camera alone as a test view. Returns both paths."""
    data = json.loads(cameras.read_text())
    train = {frame["v"]: center(frame["w2c"]) for frame in data["frames"] if frame["split"] == "train"}
    middle = [sum(axis) / len(train) for axis in zip(*train.values())]
    corner = max(train, key=lambda view: math.dist(train[view], middle))
    inside, outside = folder / "inside.json", folder / "corner.json"
    frames = data["frames"]
    inside.write_text(json.dumps(data | {"frames": [frame for frame in frames if frame["v"] != corner]}))
    alone = [frame | {"split": "test"} for frame in frames if frame["v"] == corner]
    outside.write_text(json.dumps(data | {"frames": alone}))
    return inside, outside


def main():
    args = arguments(__doc__, ("--kept", {"default": "10%", "help": "fraction of the Gaussians to keep"}))
    results = Results("outside", args.program, ["model", "kept", "setting", "processor_s", "test_psnr_db", "corner_psnr_db"])
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            if not (model.path / "cameras.json").is_file():
                continue
            inside, outside = without_corner(model.path / "cameras.json", Path(scratch))
            rig, corner = (replace(model, cameras=path, photographs=None) for path in (inside, outside))
            output = Path(scratch) / "small"
            for setting, options in SETTINGS.items():
                _, cost = compress(args.program, rig, output, "--ratio", args.kept, *options)
                results.add(
                    model=model.name, kept=args.kept, setting=setting, processor_s=cost.processor,
                    test_psnr_db=evaluate(args.program, rig, output)["psnr"],
                    corner_psnr_db=evaluate(args.program, corner, output)["psnr"],
                )  # fmt: skip


if __name__ == "__main__":
    main()
