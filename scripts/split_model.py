#!/usr/bin/env python3
"""Makes a large model of a small one: every Gaussian of a 4DGaussians model folder split in nine, seen at 1352x1014.

    python3 scripts/split_model.py MODEL FOLDER
    python3 scripts/split_model.py MODEL FOLDER --compare target/release/splatsieve   # README's figures of refining it

The nine stand in a grid along a Gaussian's two longest axes, a standard deviation apart, √⅓ as wide along these: mass
and variance stay. FOLDER gets 18 views at 30 frames: the model's own, of which those of transforms_test.json are held out
again, and some halfway between neighbours. `--compare` refines and prunes FOLDER down to a fifth in a gibibyte, and says
how close the held-out pictures of both stay. Needs nothing but Python.
"""

import argparse
import json
import math
import shutil
import struct
import tempfile
from pathlib import Path

from models_table import evaluated, peak, run

SIZE, VIEWS, FRAMES = (1352, 1014), 18, 30
# Nine children between which a parent's centre adds up 1 + 4·e^-1.5 + 4·e^-3 times one of them.
OVERLAP = 1 + 4 * math.exp(-1.5) + 4 * math.exp(-3)


def axes(w, x, y, z):
    """Columns of the rotation of a quaternion of any length."""
    n = math.sqrt(w * w + x * x + y * y + z * z) or 1.0
    w, x, y, z = w / n, x / n, y / n, z / n
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def split_cloud(source, target):
    """Writes the PLY `target`: nine rows for every one of `source`."""
    header, body = source.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    place = {name: k for k, name in enumerate(names)}
    row = struct.Struct(f"<{len(names)}f")
    out, count = bytearray(), 0
    for values in row.iter_unpack(body):
        scales = [values[place[f"scale_{k}"]] for k in range(3)]
        turned = axes(*(values[place[f"rot_{k}"]] for k in range(4)))
        first, second = sorted(range(3), key=lambda k: -scales[k])[:2]
        alpha = 1 / (1 + math.exp(-values[place["opacity"]]))
        child_alpha = min(max(1 - (1 - alpha) ** (1 / OVERLAP), 1e-6), 1 - 1e-6)
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                child = list(values)
                for axis, name in enumerate("xyz"):
                    along = i * math.exp(scales[first]) * turned[first][axis]
                    child[place[name]] += along + j * math.exp(scales[second]) * turned[second][axis]
                for k in (first, second):
                    child[place[f"scale_{k}"]] -= 0.5 * math.log(3)
                child[place["opacity"]] = math.log(child_alpha / (1 - child_alpha))
                out += row.pack(*child)
                count += 1
    lines = [f"element vertex {count}" if line.startswith("element vertex") else line for line in header.decode().splitlines()]
    target.write_bytes("\n".join(lines).encode() + b"\nend_header\n" + out)
    return count


def cameras(model, folder):
    """Writes transforms of FRAMES frames of VIEWS views, large."""
    views = {}
    for split in ("train", "test"):
        for frame in json.loads((model / f"transforms_{split}.json").read_text())["frames"]:
            views.setdefault(frame["file_path"].rsplit("_v", 1)[1], (split, frame))
    train = [frame for split, frame in views.values() if split == "train"]
    poses = [(split, frame["transform_matrix"]) for split, frame in views.values()]
    for before, after in zip(train, train[1:]):
        if len(poses) < VIEWS:
            between = [list(line) for line in before["transform_matrix"]]
            for line, other in zip(between[:3], after["transform_matrix"]):
                line[3] = (line[3] + other[3]) / 2
            poses.append(("train", between))
    focal = train[0]["fl_x"] * SIZE[0] / train[0]["w"]
    for split in ("train", "test"):
        shots = []
        for t in range(FRAMES):
            for number, (_, pose) in enumerate(pose for pose in enumerate(poses) if pose[1][0] == split):
                view = number if split == "train" else VIEWS - 1 - number
                shots.append(
                    {"file_path": f"./{split}/t{t:03}_v{view:02}", "time": t / (FRAMES - 1), "fl_x": focal, "fl_y": focal}
                    | {"cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1], "transform_matrix": pose[1]}
                )
        (folder / f"transforms_{split}.json").write_text(json.dumps({"frames": shots}))


def make(model, folder):
    cloud = next((model / "point_cloud").glob("iteration_*"))
    target = folder / "point_cloud" / cloud.name
    target.mkdir(parents=True)
    count = split_cloud(cloud / "point_cloud.ply", target / "point_cloud.ply")
    shutil.copy(cloud / "deformation.pth", target)
    shutil.copy(model / "cfg_args", folder)
    cameras(model, folder)
    print(f"{folder}: {count} Gaussians, {FRAMES} frames of {VIEWS} views of {SIZE[0]}x{SIZE[1]}")


def compare(binary, folder):
    with tempfile.TemporaryDirectory() as results:
        found = []
        for name, options in (("pruned", ["--no-refine", "--prune-only"]), ("refined", [])):
            output = Path(results) / name
            summary = run(
                binary, "compress", folder, "--cameras", folder, "-o", output, "--target-ratio", 0.2,
                "--memory", "1GiB", "--json", *options,
            )  # fmt: skip
            seconds = sum(stage["seconds"] for stage in summary["stages"])
            found.append(evaluated(binary, folder, output, folder)["psnr"])
            print(f"{name}: {found[-1]:.1f} dB, {seconds:.0f} s, {peak(summary):.0f} MiB", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--compare", metavar="SPLATSIEVE")
    args = parser.parse_args()
    if not args.folder.exists():
        make(args.model, args.folder)
    if args.compare:
        compare(args.compare, args.folder)


if __name__ == "__main__":
    main()
