#!/usr/bin/env python3
"""Prints a table of containers with error bounds: bytes and render quality of complete sequences, compared with other
formats.

    cargo build --release
    python3 scripts/bounded_table.py target/release/splatsieve DATA [MODEL ...] [--peer "splat4d"] [--fourdgs COMMAND]

DATA/<name>/ is a 4DGaussians model folder with its cameras in it. The script packs every frame exactly and within two
sets of bounds (zstd level 15, the default). It prints the bytes of each container, the size of float32 for every frame
divided by them, and the mean PSNR of renders against the exact container.

Then it compares what the other formats can hold: frames with SH degree 0, and 8-bit colors, opacities and quaternions
for .splat4d. --peer names the program that writes .splat4d, used at its default bounds; ours uses the same bounds, and
both use zstd level 19. COMMAND writes .4dgs: it gets a folder with the frames as PLY and the file to write, and prints
the folder of PLY files to which it decodes that file. Needs only the standard library.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import json
import math
import shlex
import shutil
import subprocess
import tempfile
import time
from array import array
from pathlib import Path

C0 = 0.28209479177387814
FINE = "position=0.01%,rotation=2e-3,log_scale=5e-3,opacity_logit=1e-2,sh=5e-3"
COARSE = "position=0.05%,rotation=1e-2,log_scale=2e-2,opacity_logit=5e-2,sh=2e-2"
# Default bounds of .splat4d: 2 mm, 2 percent, 4 levels of 255; quaternions are 8 bits anyway.
BOUNDS = {"position": 2e-3, "log_scale": 0.02, "sh": 4 / 255 / C0, "opacity_logit": 4 / 255 / 0.25, "rotation": 1 / 256}
PLAIN = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def run(*command):
    result = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if result.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))}\n{result.stderr}")
    return result.stdout


def psnr(binary, original, other, cameras):
    found = json.loads(run(binary, "evaluate", original, other, "--cameras", cameras, "--json"))
    return found["psnr"]


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


def row(model, what, size, raw, quality, seconds):
    print(f"| {model} | {what} | {size:,} | {raw / size:.0f} | {quality:.1f} | {seconds:.1f} |", flush=True)


def timed(*command):
    begun = time.monotonic()
    out = run(*command)
    return time.monotonic() - begun, out


def whole(binary, model, scratch):
    """Packs all columns of the frames of a model and prints their rows. Returns the exact container."""
    exact = scratch / "exact.gseq"
    seconds, _ = timed(binary, "convert", model, exact, "--cameras", model)
    columns = json.loads(run(binary, "info", exact, "--json"))["columns"]
    raw = sum(column["raw_bytes"] for column in columns)
    row(model.name, "exact", exact.stat().st_size, raw, math.inf, seconds)
    for name, bounds in [("fine", FINE), ("coarse", COARSE)]:
        within = scratch / "within.gseq"
        seconds, _ = timed(binary, "convert", exact, within, "--max-error", bounds, "--overwrite")
        row(model.name, f"within {name} bounds", within.stat().st_size, raw, psnr(binary, exact, within, model), seconds)
    return exact


def plain(binary, model, exact, peer, fourdgs, scratch):
    """Packs frames with SH degree 0 with this program and with the others, and prints their rows."""
    frames, ply, splat = scratch / "frames", scratch / "ply", scratch / "splat"
    run(binary, "convert", exact, frames, "--as", "ply-sequence")
    ply.mkdir()
    splat.mkdir()
    for i, path in enumerate(sorted(frames.glob("*.ply"))):
        columns = read_ply(path)
        write_ply(ply / f"frame_{i:05}.ply", columns)
        write_splat(splat / f"frame_{i:05}.splat", columns)
    shutil.rmtree(frames)
    raw = sum(path.stat().st_size for path in ply.iterdir())
    within = scratch / "plain.gseq"
    for part, name in [(1, "plain, within 2 mm, 2%, 4 levels"), (2, "plain, within half of that")]:
        bounds = ",".join(f"{column}={bound / part:.4g}" for column, bound in BOUNDS.items())
        pack = ["convert", ply, within, "--cameras", model, "--max-error", bounds, "--level", "19", "--overwrite"]
        seconds, _ = timed(binary, *pack)
        row(model.name, name, within.stat().st_size, raw, psnr(binary, ply, within, model), seconds)
    if peer:
        packed, back = scratch / "peer.splat4d", scratch / "back"
        seconds, _ = timed(*peer, "encode", "-i", splat, "-o", packed, "--zstd-level", "19", "--no-verify", "--fps", "30")
        back.mkdir()
        for i in range(len(list(splat.iterdir()))):
            run(*peer, "decode", packed, "--frame", i, "-o", scratch / "one.splat")
            splat_to_ply(scratch / "one.splat", back / f"frame_{i:05}.ply")
        row(model.name, "plain, .splat4d", packed.stat().st_size, raw, psnr(binary, ply, back, model), seconds)
        shutil.rmtree(back)
    if fourdgs:
        packed = scratch / "peer.4dgs"
        seconds, out = timed(*fourdgs, ply, packed)
        row(model.name, "plain, .4dgs", packed.stat().st_size, raw, psnr(binary, ply, Path(out.strip()), model), seconds)
    shutil.rmtree(ply)
    shutil.rmtree(splat)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="*")
    parser.add_argument("--peer", type=shlex.split, default=[])
    parser.add_argument("--fourdgs", type=shlex.split, default=[])
    args = parser.parse_args()
    binary = args.binary.resolve()
    models = [args.data / name for name in args.models] or sorted(path.parent for path in args.data.glob("*/cfg_args"))
    print("| model | | bytes | times fewer than f32 of every frame | PSNR dB to the exact one | s |")
    print("|---|---|---|---|---|---|")
    for model in models:
        with tempfile.TemporaryDirectory() as scratch:
            exact = whole(binary, model, Path(scratch))
            plain(binary, model, exact, args.peer, args.fourdgs, Path(scratch))


if __name__ == "__main__":
    main()
