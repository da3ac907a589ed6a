#!/usr/bin/env python3
"""Writes the states of a .4dgs file as PLY frames, by the package fourdgs, which did not come from this project.

    PYTHON scripts/benchmark/fourdgs_frames.py FILE.4dgs FOLDER --frames 60 [--fps 30] [--at 0]
    PYTHON scripts/benchmark/fourdgs_frames.py FRAMES FOLDER --encode FILE.4dgs --at 0.5

Frame i is the state at (i + AT) / FPS seconds. With --encode, the PLY frames in FRAMES are converted to FILE.4dgs first,
by the same package and with its default profile; its converter places every frame in the middle of a slot, so AT is 0.5.
Needs numpy and fourdgs.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import plainly  # noqa: E402, F401 (an error ends with a sentence)
import fourdgs  # noqa: E402
import numpy as np  # noqa: E402
from fourdgs.convert import convert_ply_sequence  # noqa: E402
from fourdgs.quantization import SH_QUANT_HI, SH_QUANT_LO  # noqa: E402
from fourdgs.writer import WriteOptions, write  # noqa: E402

PROPERTIES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
ROTATION = ["rot_0", "rot_1", "rot_2", "rot_3"]
SH_DEGREE_0 = 0.28209479177387814


def write_state(scene, seconds, path):
    """Writes the Gaussians that are visible at a time as a PLY, with the SH degree of the file."""
    state = scene.gaussians.state_at(seconds)
    rows = state["indices"]
    opacity = np.clip(state["opacity"], 1e-6, 1 - 1e-6)
    color = (scene.gaussians.colors[rows, :3] - 0.5) / SH_DEGREE_0
    columns = [state["centers"], color, np.log(opacity / (1 - opacity))[:, None]]
    columns += [np.log(np.maximum(scene.gaussians.scales[rows], 1e-30)), state["orientations"][:, [3, 0, 1, 2]]]
    higher = scene.gaussians.sh
    if higher is not None and scene.gaussians.sh_degree > 0:
        columns.append(SH_QUANT_LO + higher[rows].astype(float) * (SH_QUANT_HI - SH_QUANT_LO) / 255)
    values = np.concatenate(columns, axis=1).astype("<f4")
    names = PROPERTIES + ROTATION + [f"f_rest_{k}" for k in range(values.shape[1] - len(PROPERTIES + ROTATION))]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}"]
    lines += [f"property float {name}" for name in names] + ["end_header", ""]
    path.write_bytes("\n".join(lines).encode() + values.tobytes())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--fps", type=float, default=30)
    parser.add_argument("--at", type=float, default=0)
    parser.add_argument("--encode", type=Path)
    args = parser.parse_args()
    count, packed = args.frames, args.source
    if args.encode:
        count, packed = len(list(args.source.glob("*.ply"))), args.encode
        gaussians, seconds = convert_ply_sequence(str(args.source), fps=args.fps)
        write(str(packed), gaussians, seconds, options=WriteOptions(profile="default", scene_profile="capture"))
    scene = fourdgs.read(str(packed))
    args.folder.mkdir()
    for frame in range(count):
        write_state(scene, (frame + args.at) / args.fps, args.folder / f"frame_{frame:04}.ply")


if __name__ == "__main__":
    main()
