#!/usr/bin/env python3
"""Measures a long sequence of short lives: frames in any order, linked and compressed within a memory limit.

    cargo build --release
    python3 scripts/many_lives.py target/release/splatsieve [--frames 300] [--living 60000] [--life 9] [--memory 2GiB] [--folder DIR] [--with="--no-refine"]

Makes PLY frames with --living Gaussians each, which live --life frames on average, move, end, and begin elsewhere, in
another order in every frame; the same in every run. Prints the number of lives, the number of tracks found, the time
and the largest resident memory of the run, and whether that is within the limit. If DIR is given, the frames are kept
there and reused. Needs numpy.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import json
import shlex
import sys
import tempfile
from pathlib import Path

import numpy as np

from scaling import measured

PROPERTIES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
PROPERTIES += [f"scale_{c}" for c in range(3)] + [f"rot_{c}" for c in range(4)]


def born(count, rng):
    """Returns rows of new Gaussians on and near a sphere, and their motion per frame."""
    rows = np.zeros((count, len(PROPERTIES)), np.float32)
    towards = rng.standard_normal((count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    rows[:, :3] = towards * rng.uniform(0.7, 1, (count, 1))
    rows[:, 6:9] = rng.uniform(-1.5, 1.5, (count, 3))
    rows[:, 9] = rng.uniform(-2, 4, count)
    rows[:, 10:13] = rng.uniform(-6, -4.3, (count, 1)) + rng.uniform(-0.5, 0.5, (count, 3))
    rows[:, 13:] = rng.standard_normal((count, 4))
    return rows, rng.standard_normal((count, 3)).astype(np.float32) * 0.002


def make(folder, frames, living, life):
    """Writes the frames. Returns the number of lives."""
    rng = np.random.default_rng(2)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {living}\n"
    header += "".join(f"property float {name}\n" for name in PROPERTIES) + "end_header\n"
    rows, speed = born(living, rng)
    left = rng.integers(1, 2 * life, living)
    lives = living
    for frame in range(frames):
        (folder / f"frame_{frame:05}.ply").write_bytes(header.encode() + rows[rng.permutation(living)].tobytes())
        left -= 1
        ended = np.flatnonzero(left == 0)
        rows[:, :3] += speed
        rows[ended], speed[ended] = born(len(ended), rng)
        left[ended] = rng.integers(1, 2 * life, len(ended))
        lives += len(ended)
    return lives


def main():
    parser = argparse.ArgumentParser(usage=plainly.usage(__doc__).strip())
    parser.add_argument("binary", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--living", type=int, default=60_000)
    parser.add_argument("--life", type=int, default=9)
    parser.add_argument("--memory", default="2GiB")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--with", dest="extra", type=shlex.split, default=[])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=args.folder and args.folder.parent) as scratch:
        folder = args.folder or Path(scratch) / "frames"
        if not folder.exists():
            folder.mkdir()
            print(f"{make(folder, args.frames, args.living, args.life):,} lives", flush=True)
        out = Path(scratch) / "small"
        command = [args.binary, "compress", folder, "-o", out, "--memory", args.memory, "--json", *args.extra]
        printed, cost = measured(command)
        summary = json.loads(printed)
        print(f"{summary['input']['gaussians']:,} tracks, {summary['gaussians']:,} of them kept")
        print(f"{cost['wall']:.0f} s, {cost['processor']:.0f} s of processor")
        print(f"{cost['peak'] / (1 << 20):.0f} MiB at most, {args.memory} allowed")
        for note in summary.get("notes", []):
            print(f"note: {note}")


if __name__ == "__main__":
    sys.exit(main())
