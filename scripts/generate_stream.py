#!/usr/bin/env python3
"""Streams a generated sequence of any size to standard output.

    python3 scripts/generate_stream.py 200000 600 | splatsieve convert - big.gseq      # 200,000 Gaussians, 600 frames

The scene is a room of 4 x 4 x 2.5 units: floor, walls, eight bodies that move, faint dust, and near-duplicates that
merge. Every value of position, rotation, log_scale and opacity of every Gaussian differs between frames, along a smooth
curve with noise, unless `--varying` names fewer columns; spherical harmonics are constant. The same arguments give the
same bytes.

Memory: 0.8 kB per Gaussian, for any number of frames. Needs numpy.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import sys

import numpy as np

from stream_writer import StreamWriter

# Rows of each column among the eleven that may vary.
ROWS = {"position": slice(0, 3), "rotation": slice(3, 7), "log_scale": slice(7, 10), "opacity_logit": slice(10, 11)}
# Number of frames after which the curves repeat. The motion per frame does not depend on T, so ten times the frames are
# ten times the work.
PERIOD = 60


def scene(count, degree):
    """Returns mean values [11, N], two amplitudes [11, N] of the motion, and spherical harmonics [N, (d+1)^2, 3]."""
    random = np.random.default_rng(count)

    def uniform(low, high, shape=count):
        return random.random(shape, np.float32) * np.float32(high - low) + np.float32(low)

    kind, u, v = uniform(0, 1), uniform(0, 1), uniform(0, 1)
    rest, sway, turn = (np.zeros((11, count), np.float32) for _ in range(3))
    # 60% are on surfaces, the four that the size of the room gives; 25% on bodies; the rest is dust.
    surface = np.minimum(kind / 0.6 * 4.125, 4.125)
    floor, back = surface < 1.6, (surface >= 1.6) & (surface < 2.6)
    left = (surface >= 2.6) & (surface < 3.4)
    x = np.where(floor | back, 4 * u - 2, np.where(left, -2, 2))
    y = np.where(floor | ~back, 4 * v - 2, 2)
    z = np.where(floor, 0, 2.5 * np.where(back, v, u))
    body, dust = (kind >= 0.6) & (kind < 0.85), kind >= 0.85
    which = np.minimum((kind - 0.6) * 32, 7).clip(0).astype(np.int32)
    middle = np.stack([uniform(low, high, 8) for low, high in ((-1.5, 1.5), (-1.5, 1.5), (0.4, 1.8))])
    angle, height = 2 * np.pi * u, 2 * v - 1
    ring = 0.3 * np.sqrt(1 - height**2)
    ball = np.stack([ring * np.cos(angle), ring * np.sin(angle), 0.3 * height]) + middle[:, which]
    rest[:3] = np.where(body, ball, np.where(dust, np.stack([4 * u - 2, 4 * v - 2, uniform(0, 2.5)]), np.stack([x, y, z])))
    rest[3:7] = np.array([[1], [0], [0], [0]], np.float32) + uniform(-0.5, 0.5, (4, count))
    # Surfaces are covered once or twice for any N.
    rest[7:10] = np.log(np.where(dust, 0.003, 4 / np.sqrt(count))) + uniform(-0.5, 0.3, (3, count))
    rest[10] = np.where(dust, uniform(-4, -2), uniform(1, 4))
    for amplitude in (sway, turn):
        wobble = np.repeat(np.float32([3e-4, 0.01, 0.01, 0.2]), [3, 4, 3, 1])[:, None]
        amplitude[:] = wobble * uniform(-1, 1, (11, count))
        amplitude[:3] += body * uniform(-0.4, 0.4, (3, 8))[:, which]
    # 10% are copies of others with a small offset; they merge first.
    copy = np.where(uniform(0, 1) < 0.1, random.integers(0, count, count), np.arange(count))
    rest, sway, turn = rest[:, copy], sway[:, copy], turn[:, copy]
    rest[:3] += (copy != np.arange(count)) * 0.1 * np.exp(rest[7:10]) * uniform(-1, 1, (3, count))
    sh = 0.02 * random.standard_normal((count, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] += (0.9 * np.sin(3 * rest[:3]) * uniform(0.95, 1, (1, count))).T
    return rest, sway, turn, sh[copy]


def curves(rest, sway, turn, frames):
    """Yields the values [rows, N] of one frame after the other, always in the same array."""
    shape, (rest, sway, turn) = rest.shape, (array.ravel() for array in (rest, sway, turn))
    # One pool of noise, read from another offset in every frame, takes a tenth of the time of new random numbers.
    shifts, chunk = 1 << 20, 1 << 14
    noise = np.random.default_rng(1).standard_normal(len(rest) + shifts, np.float32) * np.float32(2e-5)
    now, scratch = np.empty_like(rest), np.empty(chunk, np.float32)
    for frame in range(frames):
        at = 2 * np.pi * frame / PERIOD
        swaying, turning = np.float32([np.cos(at) + 0.3 * np.sin(3 * at), np.sin(at) + 0.3 * np.cos(2 * at)])
        shift = frame * 514229 % shifts
        # In chunks that stay in the cache from one operation to the next.
        for start in range(0, len(rest), chunk):
            here = slice(start, min(start + chunk, len(rest)))
            value, product = now[here], scratch[: here.stop - start]
            np.add(rest[here], noise[start + shift : here.stop + shift], out=value)
            np.add(value, np.multiply(sway[here], swaying, out=product), out=value)
            np.add(value, np.multiply(turn[here], turning, out=product), out=value)
        yield now.reshape(shape)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("gaussians", type=int)
    parser.add_argument("frames", type=int)
    parser.add_argument("--sh-degree", type=int, choices=range(4), default=3)
    parser.add_argument("--varying", nargs="+", choices=ROWS, default=list(ROWS))
    args = parser.parse_args()

    rest, sway, turn, sh = scene(args.gaussians, args.sh_degree)
    constant = {name: rest[rows].T for name, rows in ROWS.items() if name not in args.varying} | {"sh": sh}
    with StreamWriter(sys.stdout.buffer, args.gaussians, args.sh_degree, constant) as stream:
        for frame, now in enumerate(curves(rest, sway, turn, args.frames)):
            time = frame / max(args.frames - 1, 1)
            stream.frame(time, {name: now[ROWS[name]].T for name in stream.varying})


if __name__ == "__main__":
    main()
