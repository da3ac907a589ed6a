#!/usr/bin/env python3
"""Compares the time that --explain names with the time that runs take, stage by stage.

    cargo build --release
    python3 scripts/estimate.py target/release/splatsieve INPUT[=CAMERAS] ...

An INPUT is whatever `compress` reads. Prints seconds as named and as taken of every stage, and their ratio for the
whole run. Standard library only.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

CASES = [["--preset", "default"], ["--preset", "strong"], ["--preset", "paper"], ["--target-ratio", "0.1"]]


def seconds(text):
    parts = re.fullmatch(r"(?:(\d+) h )?(?:(\d+) min)? ?(?:([\d.]+) s)?", text.strip())
    hours, minutes, rest = (float(part or 0) for part in parts.groups())
    return 3600 * hours + 60 * minutes + rest


def stages_named(line):
    inside = line[line.index("(") + 1 : line.rindex(")")]
    return {part.rsplit(" ", 1)[1]: seconds(part.rsplit(" ", 1)[0]) for part in inside.split(" + ")}


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary = sys.argv[1]
    for argument in sys.argv[2:]:
        path, _, cameras = argument.partition("=")
        for case in CASES:
            with tempfile.TemporaryDirectory() as folder:
                options = ["--cameras", cameras or path, "--explain", "--json", "-o", str(Path(folder) / "small")]
                run = subprocess.run([binary, "compress", path, *options, *case], capture_output=True, text=True)
            if run.returncode != 0:
                sys.exit(run.stderr)
            line = next(line for line in run.stderr.splitlines() if line.startswith("time: "))
            named, taken = stages_named(line), {}
            for stage in json.loads(run.stdout)["stages"]:
                if stage["name"] in named:
                    taken[stage["name"]] = taken.get(stage["name"], 0.0) + stage["seconds"]
            whole = sum(named.values()) / sum(taken.values())
            each = ", ".join(f"{name} {named[name]:.1f} {taken.get(name, 0.0):.1f}" for name in named)
            print(f"{Path(path).name} {' '.join(case)}: named / taken {whole:.2f} ({each})", flush=True)


if __name__ == "__main__":
    main()
