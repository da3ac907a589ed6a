#!/usr/bin/env python3
"""Measures containers of complete sequences within error bounds, and other formats of sequences:
docs/benchmarks/sequences.csv.

    cargo build --release
    python3 scripts/benchmark/sequences.py target/release/splatsieve DATA [--models A,B] [--splat4d COMMAND] [--fourdgs PYTHON]

The 60 frames of a 4DGaussians model are packed exactly and within two sets of bounds (zstd level 15, the default).
`times_smaller` is the size of float32 for every frame divided by the bytes, PSNR that of renders against the exact
container.

Then follows what the other formats can hold: frames with SH degree 0, and 8-bit colors, opacities and quaternions for
.splat4d. That program runs at its default bounds; ours uses the same bounds, then half of them, and all use zstd level
19. fourdgs makes a .4dgs with its default profile, and reads it (fourdgs_frames.py; its time includes the reading).
"""

import json
import math
import shlex
import shutil
import tempfile
from array import array
from pathlib import Path

from measuring import Results, arguments, chosen, run

C0 = 0.28209479177387814
FINE = "position=0.01%,rotation=2e-3,log_scale=5e-3,opacity_logit=1e-2,sh=5e-3"
COARSE = "position=0.05%,rotation=1e-2,log_scale=2e-2,opacity_logit=5e-2,sh=2e-2"
# Default bounds of .splat4d: 2 mm, 2 percent, 4 levels of 255; quaternions are 8 bits anyway.
BOUNDS = {"position": 2e-3, "log_scale": 0.02, "sh": 4 / 255 / C0, "opacity_logit": 4 / 255 / 0.25, "rotation": 1 / 256}
PLAIN = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def psnr(program, original, other, cameras):
    return json.loads(run(program, "evaluate", original, other, "--cameras", cameras, "--json")[0])["psnr"]


def read_ply(path):
    """Reads the columns of a binary PLY of floats by name."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    values = array("f", body)
    return {name: values[i :: len(names)] for i, name in enumerate(names)}


def write_ply(path, columns):
    count = len(columns["x"])
    properties = "".join(f"property float {name}\n" for name in PLAIN)
    values = array("f", bytes(4 * count * len(PLAIN)))
    for i, name in enumerate(PLAIN):
        values[i :: len(PLAIN)] = columns[name]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    path.write_bytes(header.encode() + values.tobytes())


def byte(value):
    return min(255, max(0, round(value)))


def write_splat(path, columns):
    """Writes 32 bytes per row: position and scales as f32; color, opacity and quaternion as bytes."""
    count = len(columns["x"])
    rows = array("f", bytes(32 * count))
    for i, name in enumerate(["x", "y", "z"]):
        rows[i::8] = columns[name]
    for i in range(3):
        rows[3 + i :: 8] = array("f", map(math.exp, columns[f"scale_{i}"]))
    rows = bytearray(rows.tobytes())
    for i in range(3):
        rows[24 + i :: 32] = bytes(byte(255 * (0.5 + C0 * value)) for value in columns[f"f_dc_{i}"])
    rows[27::32] = bytes(byte(255 / (1 + math.exp(-value))) for value in columns["opacity"])
    turns = [columns[f"rot_{i}"] for i in range(4)]
    lengths = [math.sqrt(sum(q * q for q in turn)) or 1 for turn in zip(*turns)]
    for i in range(4):
        rows[28 + i :: 32] = bytes(byte(128 + 128 * q / length) for q, length in zip(turns[i], lengths))
    path.write_bytes(rows)


def splat_to_ply(path, to):
    data = path.read_bytes()
    floats = array("f", data)
    columns = {name: floats[i::8] for i, name in enumerate(["x", "y", "z"])}
    for i in range(3):
        columns[f"scale_{i}"] = array("f", (math.log(max(value, 1e-30)) for value in floats[3 + i :: 8]))
        columns[f"f_dc_{i}"] = array("f", ((value / 255 - 0.5) / C0 for value in data[24 + i :: 32]))
    alphas = (min(max(value / 255, 1e-4), 1 - 1e-4) for value in data[27::32])
    columns["opacity"] = array("f", (math.log(alpha / (1 - alpha)) for alpha in alphas))
    for i in range(4):
        columns[f"rot_{i}"] = array("f", ((value - 128) / 128 for value in data[28 + i :: 32]))
    write_ply(to, columns)


class Rows:
    """Rows of one model: what each file takes, and how close it is."""

    def __init__(self, program, model, results):
        self.program, self.model, self.results = program, model, results
        # Bytes of float32 for every frame, and the exact frames, of the rows to come.
        self.raw, self.exact = 0, None

    def add(self, content, path, cost, other=None):
        quality = psnr(self.program, self.exact, other or path, self.model.cameras) if path != self.exact else math.inf
        self.results.add(
            model=self.model.name, content=content, bytes=path.stat().st_size, times_smaller=self.raw / path.stat().st_size,
            psnr_db=quality, processor_s=cost.processor,
        )  # fmt: skip


def whole(rows, scratch):
    """Packs all attributes of the frames of a model and adds the rows. Returns the exact container."""
    program, exact = rows.program, scratch / "exact.gseq"
    _, cost = run(program, "convert", rows.model.path, exact, "--cameras", rows.model.cameras)
    columns = json.loads(run(program, "info", exact, "--json")[0])["columns"]
    rows.raw, rows.exact = sum(column["raw_bytes"] for column in columns), exact
    rows.add("all attributes, exact", exact, cost)
    for name, bounds in [("fine", FINE), ("coarse", COARSE)]:
        within = scratch / "within.gseq"
        _, cost = run(program, "convert", exact, within, "--max-error", bounds, "--overwrite")
        rows.add(f"all attributes, within {name} bounds", within, cost)
    return exact


def degree_zero(rows, exact, splat4d, fourdgs, scratch):
    """Packs frames of SH degree 0 with this program and with the others, and adds the rows."""
    program, cameras = rows.program, rows.model.cameras
    frames, ply, splat = scratch / "frames", scratch / "ply", scratch / "splat"
    run(program, "convert", exact, frames, "--as", "ply-sequence")
    ply.mkdir()
    splat.mkdir()
    for i, path in enumerate(sorted(frames.glob("*.ply"))):
        columns = read_ply(path)
        write_ply(ply / f"frame_{i:05}.ply", columns)
        write_splat(splat / f"frame_{i:05}.splat", columns)
    shutil.rmtree(frames)
    count = len(list(ply.iterdir()))
    rows.raw, rows.exact = sum(path.stat().st_size for path in ply.iterdir()), ply
    within = scratch / "degree_zero.gseq"
    for part, name in [(1, "within 2 mm, 2%, 4 levels"), (2, "within half of that")]:
        bounds = ",".join(f"{column}={bound / part:.4g}" for column, bound in BOUNDS.items())
        pack = ["convert", ply, within, "--cameras", cameras, "--max-error", bounds, "--level", "19", "--overwrite"]
        rows.add(f"SH degree 0, {name}", within, run(program, *pack)[1])
    if splat4d:
        packed, back = scratch / "peer.splat4d", scratch / "back"
        command = shlex.split(splat4d)
        encode = ["encode", "-i", splat, "-o", packed, "--zstd-level", "19", "--no-verify", "--fps", "30"]
        _, cost = run(*command, *encode)
        back.mkdir()
        for i in range(count):
            run(*command, "decode", packed, "--frame", i, "-o", scratch / "one.splat")
            splat_to_ply(scratch / "one.splat", back / f"frame_{i:05}.ply")
        rows.add("SH degree 0, .splat4d", packed, cost, back)
    if fourdgs:
        packed, back = scratch / "peer.4dgs", scratch / "fourdgs"
        script = Path(__file__).with_name("fourdgs_frames.py")
        _, cost = run(fourdgs, script, ply, back, "--encode", packed, "--at", 0.5)
        rows.add("SH degree 0, .4dgs of fourdgs", packed, cost, back)


def main():
    peers = [
        ("--splat4d", {"metavar": "COMMAND", "help": "command that runs splat4d"}),
        ("--fourdgs", {"metavar": "PYTHON", "help": "Python with the package fourdgs"}),
    ]
    args = arguments(__doc__, *peers)
    columns = ["model", "content", "bytes", "times_smaller", "psnr_db", "processor_s"]
    results = Results("sequences", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            if model.path.is_dir():
                with tempfile.TemporaryDirectory(dir=scratch) as folder:
                    rows = Rows(args.program, model, results)
                    degree_zero(rows, whole(rows, Path(folder)), args.splat4d, args.fourdgs, Path(folder))


if __name__ == "__main__":
    main()
