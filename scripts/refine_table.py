#!/usr/bin/env python3
"""What refining survivors gains: prunes every 4DGaussians model below a folder to some sizes, with and without it.

    cargo build --release
    python3 scripts/refine_table.py target/release/splatsieve DATA [STEPS [RATIO ...]]

DATA/<name>/ is a model folder with its cameras inside and, if there are any, held-out photographs in test/. Prints a
Markdown table: mean PSNR of 15 frames of every held-out view against the unpruned model's own pictures and against the
photographs, plain → refined, and the peak of both runs. Standard library only.
"""

import sys
import tempfile
from pathlib import Path

from models_table import run


def point(binary, model, ratio, steps, output):
    options = ["--prune-only", "--target-ratio", ratio, "--refine-steps", steps, "--json"]
    summary = run(binary, "compress", model, "--cameras", model, "-o", output, *options)
    truth = ["--ground-truth", model / "test"] if (model / "test").is_dir() else []
    quality = run(binary, "evaluate", model, output, "--cameras", model, *truth, "--max-frames", 15, "--json")
    return {
        "psnr": quality["psnr"],
        "photos": quality["ground_truth"]["psnr"] if truth else None,
        "original": quality["ground_truth"]["original"]["psnr"] if truth else None,
        "peak": max(stage["peak_memory_bytes"] or 0 for stage in summary["stages"]) / 2**20,
    }


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary, data = sys.argv[1], Path(sys.argv[2])
    steps = sys.argv[3] if len(sys.argv) > 3 else "500"
    ratios = sys.argv[4:] or ["0.4", "0.2", "0.1", "0.05"]
    print("| model | kept | PSNR dB to the original | PSNR dB to photographs (unpruned) | MiB |")
    print("|---|---|---|---|---|")
    for model in sorted(path.parent for path in data.glob("*/cfg_args")):
        for ratio in ratios:
            with tempfile.TemporaryDirectory() as folder:
                plain = point(binary, model, ratio, 0, Path(folder) / "plain")
                moved = point(binary, model, ratio, steps, Path(folder) / "refined")
            photos = "–"
            if plain["photos"] is not None:
                photos = f"{plain['photos']:.2f} → {moved['photos']:.2f} ({moved['original']:.2f})"
            print(
                f"| {model.name} | {100 * float(ratio):.0f}% | {plain['psnr']:.1f} → {moved['psnr']:.1f} | {photos} "
                f"| {plain['peak']:.0f} → {moved['peak']:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
