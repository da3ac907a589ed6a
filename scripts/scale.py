#!/usr/bin/env python3
"""Compresses made-up sequences of several sizes in given memory and prints a Markdown table of time and peak.

    cargo build --release
    python3 scripts/scale.py target/release/splatsieve FOLDER                   # the table of docs/benchmarks.md, and FOLDER/scale.json
    python3 scripts/scale.py target/release/splatsieve FOLDER --sizes 200000x600 --budgets 256MiB 1GiB none

Without `--sizes` the series varies one thing at a time: the frames, the Gaussians, the budget (`--memory`). Below its
table stands what must hold, and it exits 1 if something does not: the same bytes under every budget; no peak above its
budget; ten times the frames with at most 5% more peak, in at most 10.5 times the time.

generate_stream.py makes the sequences, `pack` stores each in FOLDER, and it is removed after its last run
(`--keep`: stays, and is not made again). Peaks of a run are the system's (`ru_maxrss` of the process, which is VmHWM:
mapped pages count), those of its stages the program's own. Needs numpy.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

SIZES = [(20_000, 60), (20_000, 2_000), (20_000, 20_000), (200_000, 60), (200_000, 600)]
MIB = 1 << 20


def cameras_json(views):
    """3DGS's cameras.json: `views` of 320 x 240 in the open side of the room, each at every frame."""
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


def measured(command, **options):
    """Runs a command; gives what it prints, and its seconds and peak."""
    # This process must stay small: the ru_maxrss of a child begins at what its parent had when it forked.
    start = time.monotonic()
    child = subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, **options)
    output = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        sys.exit(f"failed: {' '.join(map(str, command))}")
    return output, {"seconds": time.monotonic() - start, "peak_bytes": usage.ru_maxrss * 1024}


def digest(path):
    hashed = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(MIB):
            hashed.update(part)
    return hashed.hexdigest()


def pack(args, gaussians, frames, packed):
    generator = [sys.executable, Path(__file__).with_name("generate_stream.py"), gaussians, frames]
    generator += ["--sh-degree", args.sh_degree]
    with subprocess.Popen([str(part) for part in generator], stdout=subprocess.PIPE) as source:
        command = [args.binary, "convert", "-", packed, *["--raw"][: args.raw], *memory(args.budgets[0])]
        return measured(command, stdin=source.stdout)[1]


def memory(budget):
    return [] if budget == "none" else ["--memory", budget]


def runs(args, gaussians, frames):
    """Compresses one sequence under every budget; an entry of the table each."""
    packed = args.folder / f"{gaussians}x{frames}{'_raw' * args.raw}.gseq"
    cameras, output = args.folder / "cameras.json", args.folder / "compressed.gseq"
    cameras.write_text(cameras_json(args.views))
    packing = None if packed.exists() else pack(args, gaussians, frames, packed)
    for budget in args.budgets:
        command = [args.binary, "compress", packed, "--cameras", cameras, "-o", output, "--overwrite", "--no-refine", "--json"]
        command += ["--preset", args.preset, "--frame-stride", args.every, *memory(budget), *args.extra]
        printed, cost = measured(command)
        summary = json.loads(printed)
        yield cost | {
            "gaussians": gaussians,
            "frames": frames,
            "budget": budget,
            "input_bytes": packed.stat().st_size,
            "kept": summary["gaussians"],
            "sha256": digest(output),
            "stages": summary["stages"],
            "pack": packing,
        }
    for path in [*args.folder.glob("compressed.gseq*"), *[packed][: not args.keep]]:
        path.unlink()


def row(run):
    stages = {}
    for stage in run["stages"]:
        stages[stage["name"]] = f"{stage['name']} {stage['peak_memory_bytes'] / MIB:.0f}"
    budget = "–" if run["budget"] == "none" else run["budget"]
    # Eleven values of a Gaussian vary.
    state = 44 * run["gaussians"] * run["frames"] / 1e9
    return (
        f"| {run['gaussians']:,} | {run['frames']:,} | {state:.2f} → {run['input_bytes'] / 1e9:.2f} GB | {budget} "
        f"| {run['kept']:,} | {run['seconds']:.1f} s | {run['peak_bytes'] / MIB:.0f} MiB | {', '.join(stages.values())} |"
    )


def claims(runs):
    """What must hold, each with whether it does."""
    for run in runs:
        if run["budget"] != "none":
            name = f"{run['gaussians']} x {run['frames']} in {run['budget']}: peak {run['peak_bytes'] / MIB:.1f} MiB"
            yield name, run["peak_bytes"] <= bytes_of(run["budget"])
    for gaussians, frames in dict.fromkeys((run["gaussians"], run["frames"]) for run in runs):
        digests = {run["sha256"] for run in runs if (run["gaussians"], run["frames"]) == (gaussians, frames)}
        yield f"{gaussians} x {frames}: the same bytes under every budget", len(digests) == 1
    for few, many in ((few, many) for few in runs for many in runs if few["budget"] == many["budget"]):
        under = f"({few['gaussians']} x {few['frames']}, --memory {few['budget']})"
        more = {key: many[key] / few[key] for key in ("gaussians", "frames", "peak_bytes", "seconds")}
        if (more["gaussians"], more["frames"]) == (1, 10):
            # Less where the frames looked at of the short sequence lie so near each other that some are held.
            yield f"10 times the frames: peak x {more['peak_bytes']:.3f} {under}", more["peak_bytes"] <= 1.05
            yield f"10 times the frames: time x {more['seconds']:.2f} {under}", more["seconds"] <= 10.5
        if (more["gaussians"], more["frames"]) == (10, 1):
            each = (many["peak_bytes"] - few["peak_bytes"]) / (many["gaussians"] - few["gaussians"])
            yield f"10 times the Gaussians: {each:.0f} bytes of peak for each further one {under}", True


def bytes_of(budget):
    if not re.fullmatch(r"\d+[KMG]iB", budget):
        raise ValueError(f"expected a size such as 256MiB, found {budget}")
    return int(budget[:-3]) * 1024 ** " KMG".index(budget[-3])


def budget(text):
    if text != "none":
        bytes_of(text)
    return text


def size(text):
    gaussians, frames = text.split("x")
    return int(gaussians), int(frames)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sizes", nargs="+", type=size, default=SIZES, help="Gaussians x frames: 20000x200 20000x2000")
    parser.add_argument("--budgets", nargs="+", type=budget, default=["256MiB", "none"], help="none: no --memory")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--views", type=int, default=2, help="cameras, each at every frame")
    parser.add_argument("--every", type=int, default=10, help="frames from one that is rendered to the next")
    parser.add_argument("--sh-degree", type=int, choices=range(4), default=3)
    parser.add_argument("--raw", action="store_true", help="store tiles raw")
    parser.add_argument("--keep", action="store_true", help="leave the sequences in FOLDER, use those that are there")
    parser.add_argument("--extra", nargs=argparse.REMAINDER, default=[], help="all that follows goes to compress")
    args = parser.parse_args()

    args.folder.mkdir(parents=True, exist_ok=True)
    print("| Gaussians | frames | state → stored | --memory | kept | time | peak | peak up to each stage, MiB |")
    print("|---" * 8 + "|")
    done = []
    for gaussians, frames in args.sizes:
        for run in runs(args, gaussians, frames):
            print(row(run), flush=True)
            done.append(run)
    (args.folder / "scale.json").write_text(json.dumps(done, indent=1) + "\n")
    held = list(claims(done))
    print("", *(f"- {'holds' if holds else 'FAILED'}: {name}" for name, holds in held), sep="\n")
    sys.exit(not all(holds for _, holds in held))


if __name__ == "__main__":
    main()
