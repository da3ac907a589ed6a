#!/usr/bin/env python3
"""Makes a sequence without Gaussian ids from a PLY sequence with ids, and keeps the true ids for scoring.

    python3 scripts/cut_lives.py FRAMES OUT [--lives 4-12] [--overlap 2] [--noise 0.02] [--jitter 0.02] [--away 0] [--seed 0]
    python3 scripts/cut_lives.py --score OUT LINKED.gseq

FRAMES is a folder of PLY files with the same Gaussians in the same order, little-endian floats (`splatsieve convert`).
For every frame the script writes a file of the same name into OUT in which
- the time of a Gaussian is cut into lives of --lives frames [default: one life]; during --overlap frames [0] the old
  life fades out while the new one fades in, and both together are as opaque as the Gaussian;
- every life has its own base color and opacity, which differ by --jitter [0] (of the range of colors; of its opacity);
- every position differs by --noise [0] times the size, the root mean square of the three scales, along each axis;
- each Gaussian is absent with probability --away [0], and the rows of each frame have a different order.
OUT/truth.npz has `gaussian` and `life` for the rows of all frames, one frame after the other, both counted from 0, and
`starts`, [T + 1], the first row of each frame.

--score compares LINKED.gseq, made with `splatsieve convert OUT LINKED.gseq --link apart`, which keeps every row. A link
is a pair of rows of adjacent frames in the same track. Prints how many of the true links (two rows of the same life)
were found and how many links are wrong, both by life and by Gaussian, as fractions of the true links, and the numbers
of tracks, lives and Gaussians.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import sys
from pathlib import Path

import numpy as np

SH_C0 = 0.28209479177387814


def read(path):
    """Returns the header, the property names, and the values [N, properties] float32."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode().splitlines()
    if "format binary_little_endian 1.0" not in lines:
        raise ValueError(f"{path}: expected little-endian binary")
    properties = [line.split() for line in lines if line.startswith("property")]
    if any(words[1] not in ("float", "float32") for words in properties):
        raise ValueError(f"{path}: expected float properties only")
    names = [words[2] for words in properties]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    rows = np.frombuffer(data, "<f4", count * len(names), end).reshape(count, len(names))
    return data[:end].decode(), names, rows


def write(path, header, rows):
    lines = [f"element vertex {len(rows)}" if line.startswith("element vertex") else line for line in header.splitlines()]
    path.write_bytes(("\n".join(lines) + "\n").encode() + rows.astype("<f4").tobytes())


class Lives:
    """Current life of every Gaussian, updated frame by frame."""

    def __init__(self, count, lengths, overlap, jitter, random):
        self.lengths, self.overlap, self.jitter, self.random = lengths, overlap, jitter, random
        self.count = count
        self.life = np.arange(count)
        self.before = np.full(count, -1)
        self.begun = np.full(count, -(1 << 30))
        self.off, self.off_before = self.offsets(count), np.zeros((count, 4))
        # The first life may have begun at any time before frame 0.
        self.end = random.integers(1, lengths[1] + 1, count) if lengths else np.full(count, 1 << 30)

    def offsets(self, count):
        """Returns random offsets of red, green and blue, and of the opacity as a fraction of it."""
        return self.random.normal(0, self.jitter, (count, 4)) if self.jitter else np.zeros((count, 4))

    def enter(self, frame):
        new = np.flatnonzero(self.end == frame)
        self.before[new], self.off_before[new] = self.life[new], self.off[new]
        self.life[new] = self.count + np.arange(len(new))
        self.count += len(new)
        self.off[new] = self.offsets(len(new))
        self.begun[new] = frame
        self.end[new] = frame + self.random.integers(self.lengths[0], self.lengths[1] + 1, len(new)) if len(new) else 0

    def rows(self, frame):
        """Returns Gaussian, life, fraction of its density and offsets of every row of a frame."""
        age = frame - self.begun
        fades = (age < self.overlap) & (self.before >= 0)
        part = np.where(fades, (age + 1) / (self.overlap + 1), 1.0)
        old = np.flatnonzero(fades)
        gaussian = np.concatenate([np.arange(len(self.life)), old])
        life = np.concatenate([self.life, self.before[old]])
        return gaussian, life, np.concatenate([part, 1 - part[old]]), np.concatenate([self.off, self.off_before[old]])


def cut(args):
    frames = sorted(args.folders[0].glob("*.ply"))
    if not frames:
        raise ValueError(f"{args.folders[0]}: no PLY files")
    out = args.folders[1]
    out.mkdir()
    random = np.random.default_rng(args.seed)
    lives, truth, starts = None, [], [0]
    for number, path in enumerate(frames):
        header, names, rows = read(path)
        at = {name: place for place, name in enumerate(names)}
        lives = lives or Lives(len(rows), args.lives, args.overlap, args.jitter, random)
        lives.enter(number)
        gaussian, life, part, off = lives.rows(number)
        there = np.flatnonzero(random.random(len(gaussian)) >= args.away)
        there = random.permutation(there)
        gaussian, life, part, off = gaussian[there], life[there], part[there], off[there]
        new = rows[gaussian].astype(np.float64)
        scales = np.exp(new[:, [at[f"scale_{c}"] for c in range(3)]])
        size = np.sqrt((scales**2).mean(1))
        new[:, [at[c] for c in "xyz"]] += args.noise * size[:, None] * random.normal(0, 1, (len(new), 3))
        new[:, [at[f"f_dc_{c}"] for c in range(3)]] += off[:, :3] / SH_C0
        if args.jitter or args.overlap:
            opacity = 1 / (1 + np.exp(-new[:, at["opacity"]]))
            opacity = np.clip(opacity * (1 + off[:, 3]), 1e-6, 1 - 1e-6)
            opacity = 1 - (1 - opacity) ** part
            new[:, at["opacity"]] = np.log(opacity / (1 - opacity))
        write(out / path.name, header, new)
        truth.append((gaussian, life))
        starts.append(starts[-1] + len(gaussian))
    columns = [np.concatenate([one[k] for one in truth]) for k in range(2)]
    np.savez(out / "truth.npz", gaussian=columns[0], life=columns[1], starts=np.array(starts))
    print(f"{starts[-1]} Gaussians in {len(frames)} frames, {len(np.unique(columns[1]))} lives")


def score(folder, container):
    from read_gseq import Gseq

    truth, linked = np.load(folder / "truth.npz"), Gseq(str(container))
    starts = truth["starts"]
    paths = sorted(folder.glob("*.ply"))
    tracks = []
    for frame, path in enumerate(paths):
        _, names, rows = read(path)
        at = np.ascontiguousarray(rows[:, [names.index(c) for c in "xyz"]]).view("V12").ravel()
        there = np.flatnonzero(linked.column("opacity_logit", frame).ravel() > -40)
        found = np.ascontiguousarray(linked.column("position", frame)[there]).view("V12").ravel()
        place = {key.tobytes(): track for key, track in zip(found, there)}
        if len(place) != len(rows) or len(there) != len(rows):
            missing = f"{len(there)} of {len(rows)} Gaussians are in the container, in {len(place)} places"
            raise ValueError(f"{path}: {missing}; was it packed with --link apart?")
        tracks.append(np.array([place[key.tobytes()] for key in at]))
    for name in ("life", "gaussian"):
        true = found = wrong = 0
        for frame in range(len(paths) - 1):
            # If a Gaussian has several rows, any of them may continue.
            who = [truth[name][starts[f] : starts[f + 1]] for f in (frame, frame + 1)]
            true += len(np.intersect1d(*who))
            _, before, after = np.intersect1d(tracks[frame], tracks[frame + 1], return_indices=True)
            right = who[0][before] == who[1][after]
            found += len(np.unique(who[0][before][right]))
            wrong += np.count_nonzero(~right)
        print(f"by {name}: {true} true links, {100 * found / true:.3f}% found, {100 * wrong / true:.3f}% wrong")
    count = len(np.unique(np.concatenate(tracks)))
    print(f"{count} tracks, {len(np.unique(truth['life']))} lives, {len(np.unique(truth['gaussian']))} Gaussians")


def main():
    parser = argparse.ArgumentParser(usage=plainly.usage(__doc__).strip())
    parser.add_argument("folders", nargs=2, type=Path)
    parser.add_argument("--score", action="store_true")
    parser.add_argument("--lives", type=lambda text: tuple(map(int, text.split("-"))))
    parser.add_argument("--overlap", type=int, default=0)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--jitter", type=float, default=0.0)
    parser.add_argument("--away", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.lives and not (len(args.lives) == 2 and args.overlap < args.lives[0] <= args.lives[1]):
        parser.error("--lives: expected LEAST-MOST, both more than --overlap")
    if args.score:
        score(*args.folders)
    else:
        cut(args)


if __name__ == "__main__":
    sys.exit(main())
