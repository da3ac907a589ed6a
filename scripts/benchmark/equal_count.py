#!/usr/bin/env python3
"""Measures the quality of several methods at the same number of Gaussians: docs/benchmarks/equal_count.csv.

    cargo build --release
    python3 scripts/benchmark/equal_count.py target/release/splatsieve DATA [--models A,B] [--methods A,B]

PSNR and SSIM are means over the test views of 15 frames, against renders of the unpruned model. The methods are those
of `splatsieve sweep`; none but `default` changes the Gaussians that stay, apart from `paper` and `no-refine`, which
merge similar ones.
"""

import json
import tempfile
from pathlib import Path

from measuring import KEPT, Results, arguments, chosen, run

METHODS = "default,no-refine,paper,paper-prune,visible,projected,opacity,scale,random"


def main():
    args = arguments(__doc__, ("--methods", {"default": METHODS, "help": "methods of `sweep`, separated by commas"}))
    columns = ["model", "gaussians_before", "method", "kept", "gaussians", "psnr_db", "ssim", "temporal"]
    results = Results("equal_count", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            output = Path(scratch) / f"{model.name}_sweep"
            run(
                args.program, "sweep", model.path, "--cameras", model.cameras, *model.options, "--methods", args.methods,
                "--fractions", ",".join(KEPT), "--max-frames", 15, "-o", output, "--quiet",
            )  # fmt: skip
            found = json.loads((output / "sweep.json").read_text())
            for point in found["points"]:
                if point["asked"] is not None:
                    results.add(
                        model=model.name, gaussians_before=found["gaussians"], method=point["method"],
                        kept=f"{point['asked']:.0%}", gaussians=point["count"], psnr_db=point["psnr"],
                        ssim=point["ssim"], temporal=point["temporal"],
                    )  # fmt: skip


if __name__ == "__main__":
    main()
