#!/usr/bin/env python3
"""Checks that a compressed 4DGaussians model folder opens the way the original renderer opens it.

    python3 scripts/check_model_folder.py ORIGINAL COMPRESSED

Needs numpy; what needs PyTorch or plyfile is skipped, and said so, where they are not installed.
Checked, in the terms of the original loader (`GaussianModel.load_ply`, `load_model`):
  - cfg_args is the original's, byte for byte
  - the point cloud has the original's properties: names, order, types; as many f_rest as the SH degree asks
  - every value is finite and the count is not larger than the original's
  - deformation.pth is the original's, and its state dict loads with weights_only=True
  - deformation_table.pth is absent or bool [N]; deformation_accum.pth is absent or float32 [N, 3]
Exits 1 at the first thing that does not hold.
"""

import re
import sys
from pathlib import Path

import numpy as np


def fail(message):
    print(f"FAILED: {message}")
    sys.exit(1)


def hold(condition, message):
    if not condition:
        fail(message)
    print(f"ok: {message}")


def iteration_folder(model):
    folders = [f for f in (model / "point_cloud").iterdir() if re.fullmatch(r"iteration_\d+", f.name)]
    if not folders:
        fail(f"{model}/point_cloud has no iteration_K folder")
    # `searchForMaxIteration` of the original.
    return max(folders, key=lambda f: int(f.name.split("_")[1]))


def read_ply(path):
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode("ascii").splitlines()
    if lines[1] != "format binary_little_endian 1.0":
        fail(f"{path}: {lines[1]}")
    count = int(next(line.split()[2] for line in lines if line.startswith("element vertex")))
    properties = [tuple(line.split()[1:]) for line in lines if line.startswith("property")]
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    rows = np.frombuffer(data[end:], dtype=[(name, types[kind]) for kind, name in properties])
    if len(rows) != count:
        fail(f"{path}: header says {count} vertices, the body has {len(rows)}")
    return properties, rows


def main():
    if len(sys.argv) != 3:
        print(__doc__)
        sys.exit(2)
    original, compressed = Path(sys.argv[1]), Path(sys.argv[2])
    config = (original / "cfg_args").read_text()
    hold((compressed / "cfg_args").read_text() == config, "cfg_args is unchanged")
    degree = int(re.search(r"sh_degree=(\d+)", config).group(1)) if "sh_degree=" in config else 3

    before, after = iteration_folder(original), iteration_folder(compressed)
    hold(before.name == after.name, f"{after.name} is the iteration the loader picks")
    properties, rows_before = read_ply(before / "point_cloud.ply")
    properties_after, rows = read_ply(after / "point_cloud.ply")
    hold(properties_after == properties, f"{len(properties)} properties with the original's names, order and types")
    rest = [name for _, name in properties if name.startswith("f_rest_")]
    hold(len(rest) == 3 * (degree + 1) ** 2 - 3, f"{len(rest)} f_rest for SH degree {degree}")
    hold(0 < len(rows) <= len(rows_before), f"{len(rows)} of {len(rows_before)} Gaussians")
    hold(all(np.isfinite(rows[name]).all() for name in rows.dtype.names), "every value is finite")

    weights = (after / "deformation.pth").read_bytes()
    hold(weights == (before / "deformation.pth").read_bytes(), "deformation.pth is unchanged")
    tables = [("deformation_table.pth", (len(rows),)), ("deformation_accum.pth", (len(rows), 3))]
    try:
        import torch
    except ImportError:
        print("skipped: PyTorch is not installed, so no .pth was opened")
        hold(not any((after / name).exists() for name, _ in tables), "no per-Gaussian tables to disagree with")
    else:
        state = torch.load(after / "deformation.pth", map_location="cpu", weights_only=True)
        hold(any(key.endswith("grid.aabb") for key in state), f"state dict with {len(state)} tensors loads")
        for name, shape in tables:
            if (after / name).exists():
                table = torch.load(after / name, map_location="cpu", weights_only=True)
                dtype = torch.bool if name == "deformation_table.pth" else torch.float32
                hold(tuple(table.shape) == shape and table.dtype == dtype, f"{name} is {dtype} {list(shape)}")
            else:
                print(f"ok: {name} is absent, as the loader accepts")
    try:
        from plyfile import PlyData
    except ImportError:
        print("skipped: plyfile is not installed, so the loader's own PLY reader was not tried")
    else:
        vertex = PlyData.read(str(after / "point_cloud.ply")).elements[0]
        names = [p.name for p in vertex.properties]
        hold(names == [name for _, name in properties], "plyfile reads the same properties")
    print("the original loader can open it")


if __name__ == "__main__":
    main()
