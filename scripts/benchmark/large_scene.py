#!/usr/bin/env python3
"""Measures time, memory and quality at real scale: docs/benchmarks/large_scene.csv.

    cargo build --release
    python3 scripts/benchmark/large_scene.py target/release/splatsieve DATA [--models room2_dynerf] [--frames 300] [--only NAME]

Each model is split in nine (split_model.py): 200,313 Gaussians and 300 frames of 18 views with 1352x1014 pixels for
room2_dynerf. Processor seconds and peak memory are those of the whole process, PSNR is the mean over test views of 15
frames, against renders of the unpruned large model. The pieces of a Gaussian are easily joined again, so the scene is a
test of time and memory, and less of quality.
"""

import sys
import tempfile
from pathlib import Path

from measuring import Model, Results, arguments, chosen, compress, evaluate, run

RUNS = {
    "30%, unrefined": ["--ratio", "30%", "--no-refine"],
    "30%, refined": ["--ratio", "30%"],
    "10%, refined": ["--ratio", "10%"],
}


def main():
    frames = ("--frames", {"type": int, "default": 300, "help": "frames of the large model"})
    limit = ("--memory", {"default": "512MiB", "help": "memory limit of the runs"})
    only = ("--only", {"action": "append", "choices": list(RUNS), "help": "runs to make [default: all]"})
    args = arguments(__doc__, frames, limit, only)
    columns = ["model", "gaussians", "frames", "views", "pixels", "run", "memory_limit", "processor_s", "wall_s", "peak_mib"]
    results = Results("large_scene", args.program, [*columns, "psnr_db", "ssim"])
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            if not model.path.is_dir():
                continue
            folder = Path(scratch) / model.name
            split = Path(__file__).with_name("split_model.py")
            run(sys.executable, split, model.path, folder, "--frames", args.frames)
            large = Model(f"{model.name} split in nine", folder, folder)
            output = Path(scratch) / "small"
            for name in args.only or RUNS:
                summary, cost = compress(args.program, large, output, *RUNS[name], "--memory", args.memory)
                quality = evaluate(args.program, large, output)
                results.add(
                    model=large.name, gaussians=summary["input"]["gaussians"], frames=args.frames, views=18,
                    pixels="1352x1014", run=name, memory_limit=args.memory, processor_s=cost.processor,
                    wall_s=cost.wall, peak_mib=cost.peak, psnr_db=quality["psnr"], ssim=quality["ssim"],
                )  # fmt: skip


if __name__ == "__main__":
    main()
