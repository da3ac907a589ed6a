#!/usr/bin/env python3
"""Measures how fast formats are written and read: docs/benchmarks/format_speed.csv.

    cargo build --release
    python3 scripts/benchmark/format_speed.py target/release/splatsieve DATA [--gaussians 500000] [--repeats 3]

`convert` writes each format of one frame from a binary PLY with SH degree 3, and makes a PLY of it again. It writes each
format of sequences from a container of FRAMES frames with a 25th of the Gaussians, and makes a container of it again.
Reading and writing the PLY or the container is counted with it. MB/s is the size of the float32 state of all frames, in
units of 1e6 bytes, divided by the processor seconds of the whole process with one thread (median of the repeats).
scripts/generate_stream.py makes the Gaussians, which needs numpy. DATA is not used.
"""

import tempfile
from pathlib import Path

from measuring import Results, arguments, middle_and_range, run
from player_formats import size
from scale import store

# Name in the table, file, options of `convert`.
STILLS = [
    (".ply", "out.ply", []),
    (".spz version 3", "out3.spz", []),
    (".spz version 4", "out4.spz", ["--spz-version", 4]),
    (".glb", "out.glb", []),
    (".sog", "out.sog", []),
]
SEQUENCES = [
    (".gseq", "out.gseq", []),
    ("PLY frames", "frames", ["--as", "ply-sequence"]),
    (".splatv", "out.splatv", []),
    (".ftgs.ply", "out.ftgs.ply", []),
    (".tsog", "out.tsog", []),
    (".4dgs", "out.4dgs", []),
    (".gsd", "out.gsd", []),
]
FRAMES = 60
# Formats that this program does not read.
WRITE_ONLY = (".4dgs", ".gsd")


def processor_seconds(program, repeats, source, output, *options):
    """Returns the median processor time of conversions with one thread."""
    command = [program, "convert", source, output, "--quiet", "--overwrite", "--threads", 1, *options]
    return middle_and_range([run(*command)[1].processor for _ in range(repeats)])[0]


def main():
    gaussians = ("--gaussians", {"type": int, "default": 500_000, "help": "number of Gaussians of a frame"})
    repeats = ("--repeats", {"type": int, "default": 3, "help": "conversions of each kind"})
    args = arguments(__doc__, gaussians, repeats)
    columns = ["format", "gaussians", "frames", "state_mb", "bytes", "write_mb_per_s", "read_mb_per_s"]
    results = Results("format_speed", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        still, sequence = folder / "still.ply", folder / "sequence.gseq"
        store(args.program, args.gaussians, 1, folder / "still.gseq")
        run(args.program, "convert", folder / "still.gseq", still, "--quiet")
        store(args.program, args.gaussians // 25, FRAMES, sequence)
        stills = [(row, args.gaussians, 1, still, folder / "back.ply") for row in STILLS]
        sequences = [(row, args.gaussians // 25, FRAMES, sequence, folder / "back.gseq") for row in SEQUENCES]
        for (name, file, options), count, frames, source, back in stills + sequences:
            output = folder / file
            # Position, scales, rotation, opacity, SH coefficients of degree 3.
            state_mb = count * frames * 4 * (3 + 3 + 4 + 1 + 3 * 16) / 1e6
            write = processor_seconds(args.program, args.repeats, source, output, *options)
            # A file that is continuous in time is read at 60 frames, the default.
            read = processor_seconds(args.program, args.repeats, output, back) if name not in WRITE_ONLY else None
            results.add(
                format=name, gaussians=count, frames=frames, state_mb=state_mb, bytes=size(output),
                write_mb_per_s=state_mb / write, read_mb_per_s=read and state_mb / read,
            )  # fmt: skip


if __name__ == "__main__":
    main()
