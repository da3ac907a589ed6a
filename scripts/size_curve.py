#!/usr/bin/env python3
"""Quality against bytes: archives at several ratios, beside pruned folders packed by a general compressor.

    python3 scripts/size_curve.py target/release/splatsieve DATA [MODEL ...] [--ratios 0.2,0.1,0.05]

Prints, for every model of DATA, the part of the Gaussians that was kept, the mean PSNR of held-out pictures against the
original's own, and bytes as a part of cfg_args + point_cloud.ply + deformation.pth of the original: of the archive
(.gsz, default preset), and of the folder that pruning alone leaves (--no-refine --prune-only --field exact), packed by
`zstd -19` if that program is there, else by xz of Python's own library, which packs about as tightly.
Needs nothing but Python.
"""

import argparse
import json
import lzma
import shutil
import subprocess
import tempfile
from pathlib import Path

MODELS = ["deform2", "room2_dynerf", "room2_big"]


def run(*words):
    return subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True).stdout


def files(model):
    """The three files that make up a model."""
    clouds = sorted(model.glob("point_cloud/iteration_*"), key=lambda path: int(path.name.split("_")[1]))
    return [model / "cfg_args", clouds[-1] / "point_cloud.ply", clouds[-1] / "deformation.pth"]


def packed(model):
    """Bytes of a folder's files, each packed."""
    if shutil.which("zstd"):
        pack = lambda path: len(subprocess.run(["zstd", "-19", "-c", "-q", path], check=True, capture_output=True).stdout)
    else:
        pack = lambda path: len(lzma.compress(path.read_bytes(), preset=6))
    return sum(pack(path) for path in files(model))


def psnr(tool, original, result):
    found = json.loads(run(tool, "--quiet", "evaluate", original, result, "--cameras", original, "--max-frames", 15, "--json"))
    return found["psnr"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tool", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="*", default=MODELS)
    parser.add_argument("--ratios", default="0.2,0.1,0.05")
    options = parser.parse_args()
    packer = "zstd -19" if shutil.which("zstd") else "xz (zstd is not here)"
    print(f"| model | kept | archive: dB | bytes | of the original | pruned alone: dB | bytes, {packer} | of the original |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.models:
        original = options.data / name
        whole = sum(path.stat().st_size for path in files(original))
        for ratio in options.ratios.split(","):
            with tempfile.TemporaryDirectory() as folder:
                archive, pruned = Path(folder) / "a.gsz", Path(folder) / "pruned"
                common = [tool_path(options.tool), "--quiet", "compress", original, "--cameras", original]
                run(*common, "--target-ratio", ratio, "-o", archive)
                run(*common, "--target-ratio", ratio, "-o", pruned, "--no-refine", "--prune-only", "--field", "exact")
                ours, theirs = archive.stat().st_size, packed(pruned)
                print(
                    f"| {name} | {float(ratio):.0%} | {psnr(options.tool, original, archive):.1f} | {ours} | {ours / whole:.1%} "
                    f"| {psnr(options.tool, original, pruned):.1f} | {theirs} | {theirs / whole:.1%} |",
                    flush=True,
                )


def tool_path(tool):
    return tool.resolve()


if __name__ == "__main__":
    main()
