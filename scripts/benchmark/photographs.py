#!/usr/bin/env python3
"""Measures compressed models against photographs of their test views: docs/benchmarks/photographs.csv.

    cargo build --release
    python3 scripts/benchmark/photographs.py target/release/splatsieve DATA [--models A,B]

For models with photographs: PSNR and SSIM of the unpruned model, of pruning only (--no-refine --prune-only) and of
`default`. Nothing is fitted to photographs; they are only compared with.
"""

import tempfile
from pathlib import Path

from measuring import KEPT, Results, arguments, chosen, compress, evaluate


def main():
    args = arguments(__doc__)
    columns = ["model", "kept", "photographs", "unpruned_psnr_db", "unpruned_ssim"]
    columns += ["pruned_psnr_db", "pruned_ssim", "default_psnr_db", "default_ssim", "default_loss_db"]
    results = Results("photographs", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            if model.photographs is None:
                continue
            output = Path(scratch) / f"small{model.suffix}"
            for kept in KEPT:
                found = {}
                for method, options in {"pruned": ["--no-refine", "--prune-only"], "default": []}.items():
                    compress(args.program, model, output, "--ratio", kept, *options)
                    found[method] = evaluate(args.program, model, output)["ground_truth"]
                unpruned = found["default"]["original"]
                results.add(
                    model=model.name, kept=kept, photographs=found["default"]["pairs"],
                    unpruned_psnr_db=unpruned["psnr"], unpruned_ssim=unpruned["ssim"],
                    pruned_psnr_db=found["pruned"]["psnr"], pruned_ssim=found["pruned"]["ssim"],
                    default_psnr_db=found["default"]["psnr"], default_ssim=found["default"]["ssim"],
                    default_loss_db=unpruned["psnr"] - found["default"]["psnr"],
                )  # fmt: skip


if __name__ == "__main__":
    main()
