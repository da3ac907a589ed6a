#!/usr/bin/env python3
"""What refining survivors gains: reduces every model below a folder to some sizes, with and without it.

    cargo build --release
    python3 scripts/refine_table.py target/release/splatsieve DATA [RATIO ...]
    python3 scripts/refine_table.py target/release/splatsieve DATA --steps [STEPS ...]
    python3 scripts/refine_table.py target/release/splatsieve DATA --degrees [RATIO ...]
    python3 scripts/refine_table.py target/release/splatsieve DATA --efforts [RATIO ...]

DATA/<name>/ is a 4DGaussians model folder with its cameras inside and, if there are any, held-out photographs in test/;
DATA/static/<name>.ply is a model without cameras, for which an orbit of 12 to score by and 4 to compare by is made.
Prints a Markdown table: pruned alone (--no-refine --prune-only) → `default`, by mean PSNR of 15 frames of every held-out
view against the unpruned model's own pictures, SSIM, and PSNR against the photographs; wall seconds of the whole run and
those before refinement; the largest peak of both. With --steps error against run time instead: a tenth of every model
by as many steps (cuts take 8% of them each), against pruning alone. With --degrees as many Gaussians of every SH degree as
take the bytes of that part of the cloud, refined (models without an SH head). With --efforts what `--effort` fast, default
and best come to: 30% kept unrefined, then refined at every ratio; wall and processor seconds are those of all stages.
Standard library only.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import json
import math
import sys
import tempfile
import time
from pathlib import Path

from models_table import evaluated, peak, photographs, run
from sweep_table import positions


def orbit(ply, path, pixels=300, focal=330):
    """Cameras around the median position, 2.2 times as far as nine tenths of all lie; up is y."""
    axes = positions(ply)
    middle = [sorted(axis)[len(axis) // 2] for axis in axes]
    distances = sorted(math.dist(middle, place) for place in zip(*axes))
    radius = 2.2 * distances[len(distances) * 9 // 10]
    train = [(math.tau * i / 12, 0.25 + 0.35 * (i % 3 - 1), "train") for i in range(12)]
    test = [(math.tau * (i + 0.37) / 4, (0.1, 0.45, -0.05, 0.3)[i], "test") for i in range(4)]
    frames = []
    for view, (azimuth, elevation, split) in enumerate(train + test):
        flat, high = math.cos(elevation), math.sin(elevation)
        out = [flat * math.sin(azimuth), high, flat * math.cos(azimuth)]
        right = [math.cos(azimuth), 0, -math.sin(azimuth)]
        down = [high * math.sin(azimuth), -flat, high * math.cos(azimuth)]
        eye = [m + radius * x for m, x in zip(middle, out)]
        rows = [[*axis, -sum(a * e for a, e in zip(axis, eye))] for axis in (right, down, [-x for x in out])]
        frames.append(
            {"v": view, "split": split, "width": pixels, "height": pixels, "fx": focal, "fy": focal}
            | {"cx": pixels / 2, "cy": pixels / 2, "w2c": [*rows, [0, 0, 0, 1]]}
        )
    path.write_text(json.dumps({"background": [0, 0, 0], "frames": frames}) + "\n")
    return path


def point(binary, model, cameras, ratio, output, *options):
    start = time.monotonic()
    summary = run(
        binary, "compress", model, "--cameras", cameras, "-o", output, "--ratio", ratio, "--json", *options
    )
    wall = time.monotonic() - start
    quality = evaluated(binary, model, output, cameras)
    processor = sum(stage["processor_seconds"] or 0 for stage in summary["stages"])
    refining = sum(stage["seconds"] for stage in summary["stages"] if stage["name"] == "refine")
    return {
        "psnr": quality["psnr"],
        "ssim": quality["ssim"],
        "photos": photographs(quality),
        "wall": wall,
        "processor": processor,
        "before": wall - refining,
        "peak": peak(summary),
    }


def work_precision(binary, models, steps):
    """Error against run time, by steps."""
    print("| model | steps | s | PSNR dB to the original | SSIM | PSNR dB to photographs |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for model in models:
            cameras = model if model.is_dir() else orbit(model, Path(folder) / f"{model.stem}.json")
            for count in ["0", *steps]:
                output = Path(folder) / f"{model.stem}{count}{'' if model.is_dir() else '.ply'}"
                how = ["--set", f"refine_steps={count}", "--set", f"refine_cut_steps={max(1, int(count) * 8 // 100)}"]
                found = point(binary, model, cameras, "0.1", output, *(how if count != "0" else ["--no-refine", "--prune-only"]))
                photos = f"{found['photos'][1]:.2f}" if found["photos"] else "–"
                print(
                    f"| {model.stem} | {count} | {found['wall']:.1f} | {found['psnr']:.1f} | {found['ssim']:.3f} | {photos} |",
                    flush=True,
                )


def degrees(binary, models, ratios):
    """Every SH degree, at equal bytes of cloud."""
    print("| model | bytes of the cloud | Gaussians kept: PSNR dB to the original, of degree 3 | 2 | 1 | 0 |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for model in models:
            cameras = model if model.is_dir() else orbit(model, Path(folder) / f"{model.stem}.json")
            for ratio in ratios:
                row = []
                for degree in (3, 2, 1, 0):
                    kept = float(ratio) * 62 / (14 + 3 * (degree + 1) ** 2)
                    if kept >= 1:
                        row.append("–")
                        continue
                    output = Path(folder) / f"{model.stem}{ratio}{degree}{'' if model.is_dir() else '.ply'}"
                    found = point(binary, model, cameras, f"{kept:.4f}", output, "--set", f"bands={degree}")
                    row.append(f"{100 * kept:.1f}%: {found['psnr']:.1f}")
                print(f"| {model.stem} | {100 * float(ratio):.0f}% | {' | '.join(row)} |", flush=True)


def efforts(binary, models, ratios):
    """Every effort: quality, and seconds."""
    names = ["fast", "default", "best"]
    print(f"| model | kept | {' | '.join(f'{name}: PSNR dB | s (processor s)' for name in names)} |")
    print(f"|{'---|' * (2 + 2 * len(names))}")
    with tempfile.TemporaryDirectory() as folder:
        for model in models:
            cameras = model if model.is_dir() else orbit(model, Path(folder) / f"{model.stem}.json")
            for ratio, more in [("0.3", ["--no-refine"]), *((ratio, []) for ratio in ratios)]:
                cells = []
                for name in names:
                    output = Path(folder) / f"{model.stem}{ratio}{name}{'' if model.is_dir() else '.ply'}"
                    found = point(binary, model, cameras, ratio, output, "--effort", name, *more)
                    cells.append(f"{found['psnr']:.2f} | {found['wall']:.0f} ({found['processor']:.0f})")
                kept = f"{100 * float(ratio):.0f}%{', unrefined' if more else ''}"
                print(f"| {model.stem} | {kept} | {' | '.join(cells)} |", flush=True)


def rigs(binary, models, ratios):
    """Static models by the cameras of the orbit, and by those that the program finds where none are given."""
    print("| model | kept | PSNR dB, scored by the orbit | scored without cameras |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for model in (model for model in models if not model.is_dir()):
            cameras = orbit(model, Path(folder) / f"{model.stem}.json")
            for ratio in ratios:
                given, found = (Path(folder) / f"{model.stem}{ratio}{name}.ply" for name in ("given", "found"))
                best = point(binary, model, cameras, ratio, given)["psnr"]
                run(binary, "compress", model, "-o", found, "--ratio", ratio, "--json")
                alone = evaluated(binary, model, found, cameras)["psnr"]
                print(f"| {model.stem} | {100 * float(ratio):.0f}% | {best:.1f} | {alone:.1f} |", flush=True)


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary, data = sys.argv[1], Path(sys.argv[2])
    models = [path.parent for path in sorted(data.glob("*/cfg_args"))] + sorted(data.glob("static/*.ply"))
    if sys.argv[3:4] == ["--steps"]:
        work_precision(binary, models, sys.argv[4:] or ["100", "250", "500", "1000", "1500", "3000"])
        return
    if sys.argv[3:4] == ["--degrees"]:
        degrees(binary, models, sys.argv[4:] or ["0.2", "0.1", "0.05"])
        return
    if sys.argv[3:4] == ["--efforts"]:
        efforts(binary, models, sys.argv[4:] or ["0.2", "0.1"])
        return
    if sys.argv[3:4] == ["--rigs"]:
        rigs(binary, models, sys.argv[4:] or ["0.2", "0.1"])
        return
    ratios = sys.argv[3:] or ["0.4", "0.2", "0.1", "0.05"]
    print("| model | kept | PSNR dB to the original | SSIM | PSNR dB to photographs (unpruned) | s (before refining) | MiB |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for model in models:
            kind = "" if model.is_dir() else ".ply"
            cameras = model if model.is_dir() else orbit(model, Path(folder) / f"{model.stem}.json")
            for ratio in ratios:
                name = f"{model.stem}{ratio}"
                only = ["--no-refine", "--prune-only"]
                plain = point(binary, model, cameras, ratio, Path(folder) / f"{name}_plain{kind}", *only)
                moved = point(binary, model, cameras, ratio, Path(folder) / f"{name}{kind}")
                photos = "–"
                if plain["photos"]:
                    original, refined = moved["photos"]
                    photos = f"{plain['photos'][1]:.2f} → {refined:.2f} ({original:.2f})"
                print(
                    f"| {model.stem} | {100 * float(ratio):.0f}% | {plain['psnr']:.1f} → {moved['psnr']:.1f} "
                    f"| {plain['ssim']:.3f} → {moved['ssim']:.3f} | {photos} "
                    f"| {moved['wall']:.0f} ({moved['before']:.0f}) | {max(plain['peak'], moved['peak']):.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
