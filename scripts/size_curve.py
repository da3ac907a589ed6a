#!/usr/bin/env python3
"""Prints quality against bytes: archives at several ratios, compared with packed results of pruning only and with other
tools.

    cargo build --release
    python3 scripts/size_curve.py target/release/splatsieve DATA [MODEL ...] [--ratios 0.2,0.1,0.05] [--peer COMMAND] [--frames]

DATA/<name>/ is a 4DGaussians model folder with its cameras in it; DATA/static/<name>.ply is a model without cameras,
for which an orbit is made as in refine_table.py. By ratio of kept Gaussians, the script prints the mean PSNR of test
views against renders of the original, and bytes as a fraction of the files that a renderer opens: of the archive (.gsz,
preset default); of the result of pruning only (--no-refine --prune-only --set field=exact), compressed by `zstd -19` if
that program is installed, and otherwise by xz of the standard library, which compresses about as well; and of stills
what COMMAND, a splat-transform of PlayCanvas, makes of as many Gaussians (.sog and .spz, decimated by that program).
--frames measures the archive of the frames of the model as PLY files, without its deformation field, as a fraction of
those files. Needs only the standard library.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import lzma
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from models_table import evaluated, run
from refine_table import orbit


def files(model):
    """Returns the files of a model that a renderer opens."""
    if model.is_file():
        return [model]
    clouds = sorted(model.glob("point_cloud/iteration_*"), key=lambda path: int(path.name.split("_")[1]))
    return [model / "cfg_args", clouds[-1] / "point_cloud.ply", clouds[-1] / "deformation.pth"]


def size(paths):
    return sum(path.stat().st_size for path in paths)


def packed(path):
    """Returns the bytes of a file after general compression."""
    if shutil.which("zstd"):
        return len(subprocess.run(["zstd", "-19", "-c", "-q", path], check=True, capture_output=True).stdout)
    return len(lzma.compress(path.read_bytes(), preset=6))


def ours(binary, model, cameras, ratio, folder):
    """Yields method, path to compare, bytes, and files of the original, for the archive and for pruning only."""
    archive, pruned = folder / "small.gsz", folder / f"pruned{model.suffix}"
    common = ["compress", model, "--cameras", cameras, "--ratio", ratio, "--json", "-o"]
    run(binary, *common, archive)
    yield "archive (.gsz)", archive, size([archive]), files(model)
    run(binary, *common, pruned, "--no-refine", "--prune-only", "--set", "field=exact")
    packer = "zstd -19" if shutil.which("zstd") else "xz"
    yield f"pruned alone, {packer}", pruned, sum(map(packed, files(pruned))), files(model)


def of_frames(binary, model, cameras, ratio, folder):
    """Yields the same values for the archive of the frames of a model, whose files are the original."""
    packed, frames, archive = folder / "all.gseq", folder / "frames", folder / "frames.gsz"
    for words in [["convert", model, packed, "--cameras", cameras], ["convert", packed, frames, "--as", "ply-sequence"]]:
        subprocess.run([binary, *words], check=True, capture_output=True)
    run(binary, "compress", frames, "--cameras", cameras, "--ratio", ratio, "--json", "-o", archive)
    yield "of PLY frames (.gsz)", archive, size([archive]), sorted(frames.glob("*.ply"))


def peers(command, model, ratio, folder):
    """Yields the same values for splat-transform."""
    for kind in ["sog", "spz"]:
        small, back = folder / f"peer.{kind}", folder / f"peer_{kind}.ply"
        decimated = [model, "--decimate", f"{100 * float(ratio):g}%", small]
        for words in [decimated, [small, back]]:
            words = [*shlex.split(command), "-q", "-w", "-g", "cpu", *words]
            subprocess.run([str(word) for word in words], check=True, capture_output=True)
        yield f"splat-transform .{kind}", back, size([small]), files(model)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("binary")
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="*")
    parser.add_argument("--ratios", default="0.2,0.1,0.05")
    parser.add_argument("--peer")
    parser.add_argument("--frames", action="store_true")
    args = parser.parse_args()
    found = [path.parent for path in sorted(args.data.glob("*/cfg_args"))] + sorted(args.data.glob("static/*.ply"))
    print("| model | kept | | PSNR dB to the original | bytes | of the original |")
    print("|---|---|---|---|---|---|")
    for model in found:
        if args.models and model.stem not in args.models:
            continue
        for ratio in args.ratios.split(","):
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                cameras = model if model.is_dir() else orbit(model, folder / "orbit.json")
                made = list((of_frames if args.frames else ours)(args.binary, model, cameras, ratio, folder))
                if args.peer and model.is_file():
                    made += peers(args.peer, model, ratio, folder)
                for method, result, count, original in made:
                    quality = evaluated(args.binary, model, result, cameras)["psnr"]
                    part = f"{100 * count / size(original):.2g}%" if args.frames else f"{100 * count / size(original):.1f}%"
                    print(f"| {model.stem} | {float(ratio):.0%} | {method} | {quality:.1f} | {count:,} | {part} |", flush=True)


if __name__ == "__main__":
    main()
