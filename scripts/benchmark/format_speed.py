#!/usr/bin/env python3
"""Measures how fast formats of one frame are written and read: docs/benchmarks/format_speed.csv.

    cargo build --release
    python3 scripts/benchmark/format_speed.py target/release/splatsieve DATA [--gaussians 500000] [--repeats 3]

`convert` writes each format from a binary PLY with SH degree 3, and makes a PLY of it again. Reading and writing that PLY
is counted with it. MB/s is the size of the float32 state, in units of 1e6 bytes, divided by the processor seconds of
the whole process with one thread (median of the repeats).
scripts/generate_stream.py makes the Gaussians, which needs numpy. DATA is not used.
"""

import tempfile
from pathlib import Path

from measuring import Results, arguments, middle_and_range, run
from scale import store

# Name in the table, file, options of `convert`.
FORMATS = [
    (".ply", "out.ply", []),
    (".gseq", "out.gseq", []),
    (".spz version 3", "out3.spz", []),
    (".spz version 4", "out4.spz", ["--spz-version", 4]),
    (".glb", "out.glb", []),
    (".sog", "out.sog", []),
]


def processor_seconds(program, repeats, source, output, *options):
    """Returns the median processor time of conversions with one thread."""
    command = [program, "convert", source, output, "--quiet", "--overwrite", "--threads", 1, *options]
    return middle_and_range([run(*command)[1].processor for _ in range(repeats)])[0]


def main():
    gaussians = ("--gaussians", {"type": int, "default": 500_000, "help": "number of Gaussians"})
    repeats = ("--repeats", {"type": int, "default": 3, "help": "conversions of each kind"})
    args = arguments(__doc__, gaussians, repeats)
    # Position, scales, rotation, opacity, SH coefficients of degree 3.
    state_mb = args.gaussians * 4 * (3 + 3 + 4 + 1 + 3 * 16) / 1e6
    results = Results("format_speed", args.program, ["format", "gaussians", "state_mb", "bytes", "write_mb_per_s", "read_mb_per_s"])
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        frame, source = folder / "frame.gseq", folder / "source.ply"
        store(args.program, args.gaussians, 1, frame)
        run(args.program, "convert", frame, source, "--quiet")
        for name, file, options in FORMATS:
            output = folder / file
            write = processor_seconds(args.program, args.repeats, source, output, *options)
            read = processor_seconds(args.program, args.repeats, output, folder / "back.ply")
            results.add(
                format=name, gaussians=args.gaussians, state_mb=state_mb, bytes=output.stat().st_size,
                write_mb_per_s=state_mb / write, read_mb_per_s=state_mb / read,
            )  # fmt: skip


if __name__ == "__main__":
    main()
