#!/usr/bin/env python3
"""Measures quality against bytes of archives and of other ways to a small file: docs/benchmarks/equal_bytes.csv.

    cargo build --release
    python3 scripts/benchmark/equal_bytes.py target/release/splatsieve DATA [--models A,B] [--kept 10%] [--splat-transform COMMAND]

Methods: the archive (.gsz) of `default`; the same without refinement for the quantization; the result of pruning only
(--no-refine --prune-only, exact field), compressed by xz of the standard library; of static models also what COMMAND, a
splat-transform of PlayCanvas, makes of as many Gaussians (.sog and .spz, decimated by that program, without cameras).
`part` is the fraction of the bytes of the files that a renderer opens. PSNR is the mean over test views, against
renders of the original.
"""

import lzma
import shlex
import tempfile
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate, run


def files(path):
    """Returns the files of a model that a renderer opens."""
    if path.is_file():
        return [path]
    clouds = sorted(path.glob("point_cloud/iteration_*"), key=lambda cloud: int(cloud.name.split("_")[1]))
    return [path / "cfg_args", clouds[-1] / "point_cloud.ply", clouds[-1] / "deformation.pth"]


def size(path):
    return sum(file.stat().st_size for file in files(path))


def ours(program, model, kept, folder):
    """Yields the method, the path to compare, and the bytes of archives and of pruning only."""
    archive, pruned = folder / "small.gsz", folder / f"pruned{model.suffix}"
    compress(program, model, archive, "--ratio", kept)
    yield "archive", archive, size(archive)
    quantized = folder / "quantized.gsz"
    compress(program, model, quantized, "--ratio", kept, "--set", "refine_archive_steps=0")
    yield "archive, only quantized", quantized, size(quantized)
    compress(program, model, pruned, "--ratio", kept, "--no-refine", "--prune-only", "--set", "field=exact")
    yield "pruned only, xz", pruned, sum(len(lzma.compress(file.read_bytes(), preset=6)) for file in files(pruned))


def peers(command, model, kept, folder):
    """Yields the same values for splat-transform."""
    program = [*shlex.split(command), "-q", "-w", "-g", "cpu"]
    fewer = folder / "decimated.ply"
    run(*program, model.path, "--decimate", kept, fewer)
    for kind in ("sog", "spz"):
        small, back = folder / f"peer.{kind}", folder / f"peer_{kind}.ply"
        run(*program, fewer, small)
        run(*program, small, back)
        yield f"splat-transform .{kind}", back, small.stat().st_size


def main():
    peer = ("--splat-transform", {"metavar": "COMMAND", "help": "command that runs splat-transform"})
    part = ("--kept", {"type": lambda text: text.split(","), "default": ["20%", "10%", "5%"], "help": "fractions of the Gaussians"})
    args = arguments(__doc__, peer, part)
    results = Results("equal_bytes", args.program, ["model", "kept", "method", "bytes", "part", "psnr_db", "ssim"])
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            for kept in args.kept:
                with tempfile.TemporaryDirectory(dir=scratch) as folder:
                    made = list(ours(args.program, model, kept, Path(folder)))
                    if args.splat_transform and model.suffix == ".ply":
                        made += peers(args.splat_transform, model, kept, Path(folder))
                    for method, output, count in made:
                        quality = evaluate(args.program, model, output)
                        results.add(
                            model=model.name, kept=kept, method=method, bytes=count, part=count / size(model.path),
                            psnr_db=quality["psnr"], ssim=quality["ssim"],
                        )  # fmt: skip


if __name__ == "__main__":
    main()
