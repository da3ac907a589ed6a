#!/usr/bin/env python3
"""Measures time and memory on generated sequences of several sizes within memory limits: docs/benchmarks/scale.csv.

    cargo build --release
    python3 scripts/benchmark/scale.py target/release/splatsieve DATA [--sizes 200000x600,20000x2000] [--limits 256MiB,none]

The sizes are Gaussians x frames, the limits values of `--memory` ("none": the default, a quarter of the machine's
memory). scripts/generate_stream.py makes the sequences, in which every value except the colors (SH degree 3) differs in
every frame, and `convert` stores them. Two views of 320x240 pixels at every tenth frame score them; nothing is refined.
DATA is not used. Exits with 1 if the bytes of a result depend on the limit, if a peak is above its limit, or if ten times
the frames take more than 5% more memory. Needs numpy.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from measuring import ROOT, Results, arguments, run

SIZES = "20000x60,20000x600,20000x6000,200000x60,200000x600"


def cameras_json(views):
    """Returns a cameras.json of 3DGS: `views` of 320 x 240 pixels in the open side of the room, each in every frame."""
    cameras = []
    for view in range(views):
        x = -1.5 + 3 * (view + 0.5) / views
        length, flat = (x * x + 16 + 0.04) ** 0.5, (x * x + 16) ** 0.5
        right, ahead = [4 / flat, x / flat, 0], [-x / length, 4 / length, -0.2 / length]
        down = [0.2 * x / flat / length, -0.8 / flat / length, -flat / length]
        cameras.append(
            {"id": view, "img_name": f"view_{view}", "width": 320, "height": 240, "fx": 280, "fy": 280}
            | {"position": [x, -4, 1.2], "rotation": list(zip(right, down, ahead))}
        )
    return json.dumps(cameras)


def store(program, gaussians, frames, path):
    """Generates a sequence and stores it as a container."""
    generator = [sys.executable, ROOT / "scripts" / "generate_stream.py", gaussians, frames, "--sh-degree", 3]
    with subprocess.Popen([str(part) for part in generator], stdout=subprocess.PIPE) as source:
        subprocess.run([program, "convert", "-", path, "--quiet"], stdin=source.stdout, check=True, stdout=subprocess.DEVNULL)


def measure(args, results, gaussians, frames, folder):
    """Compresses one sequence within every limit and adds the rows. Returns what is wrong, and the peak by limit."""
    packed, cameras, output = folder / "sequence.gseq", folder / "cameras.json", folder / "small.gseq"
    cameras.write_text(cameras_json(2))
    store(args.program, gaussians, frames, packed)
    wrong, peaks, digests = [], {}, set()
    for limit in args.limits.split(","):
        memory = [] if limit == "none" else ["--memory", limit]
        command = [args.program, "compress", packed, "--cameras", cameras, "-o", output, "--overwrite", "--no-refine", "--json"]
        text, cost = run(*command, "--quiet", "--set", "frame_stride=10", *memory)
        peaks[limit] = cost.peak
        # In pieces: a large process that starts the program would count in the peak of the program.
        digest = hashlib.sha256()
        with output.open("rb") as file:
            while piece := file.read(1 << 20):
                digest.update(piece)
        digests.add(digest.hexdigest())
        if limit != "none" and cost.peak > bytes_of(limit) / 2**20:
            wrong.append(f"{gaussians} x {frames}: peak {cost.peak:.1f} MiB within {limit}")
        results.add(
            gaussians=gaussians, frames=frames, memory_limit=limit, state_bytes=44 * gaussians * frames,
            stored_bytes=packed.stat().st_size, kept=json.loads(text)["gaussians"], wall_s=cost.wall,
            processor_s=cost.processor, peak_mib=cost.peak,
        )  # fmt: skip
    if len(digests) != 1:
        wrong.append(f"{gaussians} x {frames}: the bytes depend on the limit")
    return wrong, peaks


def bytes_of(limit):
    return int(limit[:-3]) * 1024 ** " KMG".index(limit[-3])


def main():
    sizes = ("--sizes", {"default": SIZES, "help": "Gaussians x frames, separated by commas"})
    limits = ("--limits", {"default": "256MiB,none", "help": "memory limits, separated by commas"})
    args = arguments(__doc__, sizes, limits)
    columns = ["gaussians", "frames", "memory_limit", "state_bytes", "stored_bytes", "kept", "wall_s", "processor_s", "peak_mib"]
    results = Results("scale", args.program, columns)
    wrong, peaks = [], {}
    for gaussians, frames in (map(int, size.split("x")) for size in args.sizes.split(",")):
        with tempfile.TemporaryDirectory() as scratch:
            found, peaks[gaussians, frames] = measure(args, results, gaussians, frames, Path(scratch))
            wrong += found
    for (gaussians, frames), few in peaks.items():
        for limit, many in peaks.get((gaussians, 10 * frames), {}).items():
            if many > 1.05 * few[limit]:
                wrong.append(f"{gaussians}: {10 * frames} frames take {many:.1f} MiB, {frames} take {few[limit]:.1f} MiB")
    if wrong:
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
