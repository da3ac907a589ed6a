#!/usr/bin/env python3
"""Makes a large model from a small one: every Gaussian of a 4DGaussians model folder is split into nine or more, with
views of 1352x1014.

    python3 scripts/benchmark/split_model.py MODEL FOLDER [--side 3] [--frames 30] [--views 18] [--size 1352x1014]

The children of a Gaussian form a grid of SIDE x SIDE along its two longest axes (for nine: one standard deviation
apart, √⅓ as wide along these axes), which preserves mass and variance. FOLDER gets the views of the model at every
frame, with those of transforms_test.json as test views, and some views between neighboring ones. `large_scene.py`
measures such models. Needs only the standard library.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import plainly  # noqa: E402, F401 (an error ends with a sentence)
import argparse  # noqa: E402
import json  # noqa: E402
import math  # noqa: E402
import shutil  # noqa: E402
import struct  # noqa: E402

# Distance of children in units of their width.
APART = math.sqrt(3)


def axes(w, x, y, z):
    """Returns the columns of the rotation of a quaternion of any length."""
    n = math.sqrt(w * w + x * x + y * y + z * z) or 1.0
    w, x, y, z = w / n, x / n, y / n, z / n
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def split_cloud(source, target, side):
    """Writes the PLY `target` with side x side rows for every row of `source`."""
    grid = [k - (side - 1) / 2 for k in range(side)]
    # Width of a child: a variance of 1 is the sum of that of the positions and that of the child.
    width = 1 / math.sqrt(1 + APART**2 * (side**2 - 1) / 12)
    # Sum of all alphas in the middle, divided by the alpha at the center of one.
    overlap = sum(math.exp(-(APART**2) * (i * i + j * j) / 2) for i in grid for j in grid)
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
        child_alpha = min(max(1 - (1 - alpha) ** (1 / overlap), 1e-6), 1 - 1e-6)
        for i in grid:
            for j in grid:
                child = list(values)
                for axis, name in enumerate("xyz"):
                    along = i * math.exp(scales[first]) * turned[first][axis]
                    along += j * math.exp(scales[second]) * turned[second][axis]
                    child[place[name]] += APART * width * along
                for k in (first, second):
                    child[place[f"scale_{k}"]] += math.log(width)
                child[place["opacity"]] = math.log(child_alpha / (1 - child_alpha))
                out += row.pack(*child)
                count += 1
    lines = [f"element vertex {count}" if line.startswith("element vertex") else line for line in header.decode().splitlines()]
    target.write_bytes("\n".join(lines).encode() + b"\nend_header\n" + out)
    return count


def cameras(model, folder, frames, count, size):
    """Writes transforms of `frames` frames of `count` views of `size` pixels."""
    views = {}
    for split in ("train", "test"):
        for frame in json.loads((model / f"transforms_{split}.json").read_text())["frames"]:
            views.setdefault(frame["file_path"].rsplit("_v", 1)[1], (split, frame))
    train = [frame for split, frame in views.values() if split == "train"]
    poses = [(split, frame["transform_matrix"]) for split, frame in views.values()]
    pairs = list(zip(train, train[1:]))
    for k in range(count - len(poses)):
        (before, after), part = pairs[k % len(pairs)], 1 / (2 + k // len(pairs))
        between = [list(line) for line in before["transform_matrix"]]
        for line, other in zip(between[:3], after["transform_matrix"]):
            line[3] += part * (other[3] - line[3])
        poses.append(("train", between))
    focal = train[0]["fl_x"] * size[0] / train[0]["w"]
    for split in ("train", "test"):
        shots = []
        for t in range(frames):
            for number, (_, pose) in enumerate(pose for pose in enumerate(poses) if pose[1][0] == split):
                view = number if split == "train" else len(poses) - 1 - number
                shots.append(
                    {"file_path": f"./{split}/t{t:03}_v{view:02}", "time": t / max(frames - 1, 1), "fl_x": focal, "fl_y": focal}
                    | {"cx": size[0] / 2, "cy": size[1] / 2, "w": size[0], "h": size[1], "transform_matrix": pose[1]}
                )
        (folder / f"transforms_{split}.json").write_text(json.dumps({"frames": shots}))


def make(model, folder, side, frames, views, size):
    cloud = next((model / "point_cloud").glob("iteration_*"))
    target = folder / "point_cloud" / cloud.name
    target.mkdir(parents=True)
    count = split_cloud(cloud / "point_cloud.ply", target / "point_cloud.ply", side)
    shutil.copy(cloud / "deformation.pth", target)
    shutil.copy(model / "cfg_args", folder)
    cameras(model, folder, frames, views, size)
    print(f"{folder}: {count} Gaussians, {frames} frames of {views} views of {size[0]}x{size[1]}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--side", type=int, default=3)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--views", type=int, default=18)
    parser.add_argument("--size", type=lambda text: tuple(map(int, text.split("x"))), default=(1352, 1014))
    args = parser.parse_args()
    make(args.model, args.folder, args.side, args.frames, args.views, args.size)


if __name__ == "__main__":
    main()
