#!/usr/bin/env python3
"""Compresses every 4DGaussians model below a folder with several presets and prints a Markdown table.

    cargo build --release
    python3 scripts/models_table.py target/release/splatsieve DATA [PRESET ...]

DATA/<name>/ is a model folder with its cameras inside. Every figure comes from the summaries the program
writes; times and memory are those of this machine. Standard library only.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary, data = sys.argv[1], Path(sys.argv[2])
    presets = sys.argv[3:] or ["default", "paper", "gentle", "strong"]
    print("| model | preset | Gaussians | pruned to | merged to | point cloud | time | peak memory |")
    print("|---|---|---|---|---|---|---|---|")
    for model in sorted(path.parent for path in data.glob("*/cfg_args")):
        for preset in presets:
            with tempfile.TemporaryDirectory() as folder:
                output = Path(folder) / "small"
                command = [binary, "compress", model, "--cameras", model, "--preset", preset, "-o", output, "--json"]
                result = subprocess.run(command, capture_output=True, text=True, check=True)
            summary = json.loads(result.stdout)
            before, after = summary["input"]["gaussians"], summary["gaussians"]
            selected = next(stage for stage in summary["stages"] if stage["name"] == "select")["gaussians_out"]
            seconds = sum(stage["seconds"] for stage in summary["stages"])
            peak = max(stage["peak_memory_bytes"] or 0 for stage in summary["stages"])
            size = f"{summary['input']['bytes'] / 1e6:.1f} → {summary['output_bytes'] / 1e6:.1f} MB"
            share = f"{after} ({100 * after / before:.0f}%)"
            print(
                f"| {model.name} | {preset} | {before} | {selected} | {share} | {size} "
                f"| {seconds:.1f} s | {peak / 2**20:.0f} MiB |"
            )


if __name__ == "__main__":
    main()
