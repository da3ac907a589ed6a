#!/usr/bin/env python3
"""Makes a picture of docs/benchmarks.md: a model, a part of it pruned alone, and as many Gaussians refined, side by side.

    python3 scripts/side_by_side.py target/release/splatsieve MODEL OUTPUT.png [--ratio 0.05] [--frame 30] [--view V]

MODEL is a 4DGaussians model folder with its cameras inside; the picture is one that no step, ranking or cut looked at.
Standard library only.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import json
import struct
import subprocess
import tempfile
import zlib
from array import array
from pathlib import Path

from models_table import run


def picture(binary, model, cameras, frame, view, path):
    """Rows of RGB bytes of one picture."""
    where = ["--cameras", cameras, "--frame", frame, "--view", view, "-o", path]
    subprocess.run([str(part) for part in [binary, "--quiet", "render", model, *where]], check=True)
    raw = path.read_bytes()
    length = struct.unpack_from("<H", raw, 8)[0]
    header = raw[10 : 10 + length].decode()
    height, width = (int(n) for n in header.split("(")[1].split(",")[:2])
    values = array("f", raw[10 + length :])
    levels = bytes(round(255 * min(max(value, 0.0), 1.0)) for value in values)
    return [levels[3 * width * y : 3 * width * (y + 1)] for y in range(height)]


def png(rows):
    """A PNG file of rows of RGB bytes."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    # Each row as differences from the one above.
    above, lines = bytes(len(rows[0])), b""
    for row in rows:
        lines += b"\2" + bytes((a - b) & 255 for a, b in zip(row, above))
        above = row
    head = struct.pack(">IIBBBBB", len(rows[0]) // 3, len(rows), 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(lines, 9)) + chunk(b"IEND", b"")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("binary", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--ratio", default="0.05")
    parser.add_argument("--frame", type=int, default=30)
    parser.add_argument("--view", type=int)
    args = parser.parse_args()
    held_out = json.loads((args.model / "transforms_test.json").read_text())["frames"][0]["file_path"]
    view = args.view if args.view is not None else int(held_out.rsplit("_v", 1)[1])
    with tempfile.TemporaryDirectory() as folder:
        shown = [args.model, Path(folder) / "pruned", Path(folder) / "refined"]
        for output, how in zip(shown[1:], (["--no-refine", "--prune-only"], [])):
            run(
                args.binary, "compress", args.model, "--cameras", args.model, "-o", output,
                "--ratio", args.ratio, "--json", *how,
            )  # fmt: skip
        file = Path(folder) / "picture.npy"
        pictures = []
        for model in shown:
            pictures.append(picture(args.binary, model, args.model, args.frame, view, file))
            file.unlink()
    gap = bytes([255] * 3 * 4)
    args.output.write_bytes(png([gap.join(rows) for rows in zip(*pictures)]))


if __name__ == "__main__":
    main()
