#!/usr/bin/env python3
"""Compares the time and memory that a run predicts with what it uses.

    cargo build --release
    python3 scripts/estimate.py target/release/splatsieve INPUT[=CAMERAS] ...

Example: python3 scripts/estimate.py target/release/splatsieve ../shared/data/deform2

INPUT is anything that `compress` reads. Prints a table with the predicted (minimum, likely, maximum) and used
core-seconds and seconds, the predicted and used memory, and the time of a dry run. Exits 1 if anything is outside the
prediction. Needs only the standard library.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CASES = [
    ["--ratio", "0.6"],
    ["--ratio", "0.3"],
    ["--ratio", "0.1"],
    ["--ratio", "0.1", "--effort", "fast"],
    ["--ratio", "0.5", "--no-refine"],
    ["--ratio", "0.1", "--no-refine"],
    ["--ratio", "0.3", "--preset", "paper"],
]


def said(values, taken):
    least, likely, most = (values[name] for name in ("least", "likely", "most"))
    inside = least <= taken <= most
    return f"{least:.1f} {likely:.1f} {most:.1f} | {taken:.1f}{'' if inside else ' OUTSIDE'}", inside


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary, sound = sys.argv[1], True
    print("| model, options | core-seconds said | taken | seconds said | taken | memory said, MiB | taken | dry run, s |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for argument in sys.argv[2:]:
        path, _, cameras = argument.partition("=")
        for case in CASES:
            with tempfile.TemporaryDirectory() as folder:
                options = ["compress", path, "--cameras", cameras or path, "--json", "-o", str(Path(folder) / "small"), *case]
                start = time.monotonic()
                dry = subprocess.run([binary, *options, "--dry-run"], capture_output=True, text=True)
                seconds = time.monotonic() - start
                run = subprocess.run([binary, *options], capture_output=True, text=True)
            for done in (dry, run):
                if done.returncode != 0:
                    sys.exit(done.stderr)
            summary = json.loads(run.stdout)
            forecast, stages = summary["forecast"], summary["stages"]
            cores, inside = said(forecast["core_seconds"], sum(stage["processor_seconds"] for stage in stages))
            wall, in_time = said(forecast["seconds"], sum(stage["seconds"] for stage in stages))
            peak = max(stage["peak_memory_bytes"] for stage in stages)
            sound &= inside and in_time and peak <= forecast["memory_bytes"]
            memory = f"{forecast['memory_bytes'] / 2**20:.0f} | {peak / 2**20:.0f}"
            print(f"| {Path(path).name} {' '.join(case)} | {cores} | {wall} | {memory} | {seconds:.1f} |", flush=True)
    sys.exit(0 if sound else 1)


if __name__ == "__main__":
    main()
