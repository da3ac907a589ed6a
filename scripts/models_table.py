#!/usr/bin/env python3
"""Compresses every 4DGaussians model below a folder with several presets and prints a Markdown table.

    cargo build --release
    python3 scripts/models_table.py target/release/splatsieve DATA [PRESET ...]

Example: python3 scripts/models_table.py target/release/splatsieve ../shared/data default strong

DATA/<name>/ is a model folder with its cameras in it and, if available, photographs of the test views in test/. All
figures are those that the program prints; quality is measured on 15 frames of every test view, times and memory are
those of this machine. Needs only the standard library.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import json
import subprocess
import sys
import tempfile
from pathlib import Path


def run(*command):
    result = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if result.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}\n{result.stderr}")
    return json.loads(result.stdout)


def evaluated(binary, model, output, cameras):
    """Returns what `evaluate` prints for `output`, with photographs if the model has some."""
    truth = ["--ground-truth", model / "test"] if (model / "test").is_dir() else []
    return run(binary, "evaluate", model, output, "--cameras", cameras, *truth, "--max-frames", 15, "--json")


def photographs(quality):
    """Returns the PSNR against photographs of the unpruned model and of the result; None without photographs."""
    truth = quality.get("ground_truth")
    return (truth["original"]["psnr"], truth["psnr"]) if truth else None


def peak(summary):
    """Returns the peak memory in MiB."""
    return max(stage["peak_memory_bytes"] or 0 for stage in summary["stages"]) / 2**20


def sizes(before, after):
    """Returns megabytes, and the remaining fraction."""
    return f"{before / 1e6:.1f} → {after / 1e6:.1f} ({100 * after / before:.0f}%)" if before else f"{after / 1e6:.1f}"


def row(binary, model, preset, output):
    summary = run(binary, "compress", model, "--cameras", model, "--preset", preset, "-o", output, "--json")
    quality = evaluated(binary, model, output, model)
    before, after = summary["input"]["gaussians"], summary["gaussians"]
    whole = sizes(summary["input"]["bytes"], summary["output_bytes"])
    parts = [
        f"{part} {sizes(summary['input']['size'][part], summary['output_size'][part])}"
        for part in ("cloud", "field", "frames")
        if summary["input"]["size"][part] or summary["output_size"][part]
    ]
    seconds = sum(stage["seconds"] for stage in summary["stages"])
    photos = photographs(quality)
    photos = f"{photos[0]:.2f} → {photos[1]:.2f}" if photos else "–"
    return (
        f"| {model.name} | {preset} | {before} → {after} ({100 * after / before:.0f}%) | {whole} | {', '.join(parts)} "
        f"| {quality['psnr']:.1f} / {quality['ssim']:.4f} | {photos} | {seconds:.1f} s | {peak(summary):.0f} MiB |"
    )


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary, data = sys.argv[1], Path(sys.argv[2])
    presets = sys.argv[3:] or ["default", "paper", "gentle", "strong"]
    print("| model | preset | Gaussians | whole model, MB | of it | PSNR dB / SSIM to the original | PSNR dB to photographs | time | peak memory |")
    print("|---|---|---|---|---|---|---|---|---|")
    for model in sorted(path.parent for path in data.glob("*/cfg_args")):
        for preset in presets:
            with tempfile.TemporaryDirectory() as folder:
                print(row(binary, model, preset, Path(folder) / "small"), flush=True)


if __name__ == "__main__":
    main()
