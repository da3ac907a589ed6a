#!/usr/bin/env python3
"""Streams a model given as arrays to standard output.

    python3 scripts/export_arrays.py model.npz | splatsieve compress - --cameras data -o small.gseq
    python3 scripts/export_arrays.py folder_of_npy/ | splatsieve convert - scene.gseq

The input is an .npz, or a folder of .npy files (memory-mapped), with these arrays for T frames and N Gaussians:

    times          [T], increasing
    position       [T, N, 3] or [N, 3]
    rotation       [T, N, 4] or [N, 4]: wxyz, any length
    log_scale      [T, N, 3] or [N, 3]: natural logs; or scale, the scales themselves
    opacity_logit  [T, N, 1] or [T, N] or [N, 1] or [N]: logits; or opacity in [0, 1]
    sh             [T, N, (d+1)^2, 3] or [N, (d+1)^2, 3], the last two as one or not; or rgb [T, N, 3] or [N, 3] in [0, 1]

An array without T holds for every frame. If T = N and shapes are ambiguous, an opacity array needs a last axis of size
1. Needs numpy.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import sys
from pathlib import Path

import numpy as np

from stream_writer import COLUMNS, StreamWriter

SH_C0 = 0.28209479177387814


def logit(opacity):
    # The logits of 0 and 1 are infinite, but those of the nearest float32 are finite.
    opacity = np.clip(np.asarray(opacity, np.float64), np.finfo(np.float32).tiny, 1 - 2**-24)
    return np.log(opacity) - np.log1p(-opacity)


# Alternative names of arrays, and the conversion of each.
INSTEAD = {
    "log_scale": ("scale", np.log),
    "opacity_logit": ("opacity", logit),
    "sh": ("rgb", lambda rgb: ((np.asarray(rgb, np.float64) - 0.5) / SH_C0)[..., None, :]),
}


def load(path):
    if path.is_dir():
        return {file.stem: np.load(file, mmap_mode="r") for file in path.glob("*.npy")}
    return dict(np.load(path))


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    arrays = load(Path(sys.argv[1]))
    columns, convert = {}, {}
    for name in COLUMNS:
        other, function = INSTEAD.get(name, (None, None))
        if name not in arrays and other not in arrays:
            sys.exit(f"{sys.argv[1]}: expected an array {name}" + (f" or {other}" if other else ""))
        columns[name] = arrays[name if name in arrays else other]
        convert[name] = (lambda array: array) if name in arrays else function
    if "sh" in arrays and columns["sh"].shape[-1] != 3:
        # One row of 3(d+1)^2 values per Gaussian, as in containers and read_gseq.py.
        columns["sh"] = columns["sh"].reshape(*columns["sh"].shape[:-1], -1, 3)
    times = np.asarray(arrays.get("times", np.arange(1)), np.float64)
    count = columns["position"].shape[-2]
    # Number of axes of an array with time, including the axis of the values of one Gaussian.
    axes = {"position": 2, "rotation": 2, "log_scale": 2, "opacity_logit": 2, "sh": 3 if "sh" in arrays else 2}

    def varies(name):
        array = columns[name]
        if name == "opacity_logit" and array.shape[-1] != 1:
            return array.ndim == 2
        return array.ndim > axes[name]

    constant = {name: convert[name](columns[name]) for name in COLUMNS if not varies(name)}
    for name in COLUMNS:
        shape = columns[name].shape
        expected = (len(times), count) if varies(name) else (count,)
        if shape[: len(expected)] != expected:
            sys.exit(f"{name}: expected {list(expected)} at the front of its shape, found {list(shape)}")
    coefficients = columns["sh"].shape[-2] if "sh" in arrays else 1
    degree = round(coefficients**0.5) - 1
    with StreamWriter(sys.stdout.buffer, count, degree, constant) as stream:
        for frame, time in enumerate(times):
            stream.frame(time, {name: convert[name](columns[name][frame]) for name in stream.varying})


if __name__ == "__main__":
    main()
