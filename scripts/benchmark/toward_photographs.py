#!/usr/bin/env python3
"""Measures refinement toward photographs (--toward photographs): docs/benchmarks/toward_photographs.csv.

    cargo build --release
    python3 scripts/benchmark/toward_photographs.py target/release/splatsieve DATA [--models A,B]

The photographs are simulated: renders of each model from all of its cameras. The "trained" model that is compressed is a
damaged copy of the model: 40% of its Gaussians, pruned without refinement, by our ranking and by the paper's method. It
is compressed to 20% of its Gaussians. PSNR is the mean over 15 frames of the test cameras against the photographs.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate, run

DAMAGES = {
    "our ranking": ["--prune-only", "--no-refine"],
    "the paper's method": ["--preset", "paper"],
}


def main():
    args = arguments(__doc__)
    columns = ["model", "damage", "trained_psnr_db", "renders_psnr_db", "photographs_psnr_db"]
    columns += ["renders_processor_s", "photographs_processor_s"]
    results = Results("toward_photographs", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        photographs, trained_path, small = (Path(scratch) / name for name in ("photographs", "trained", "small"))
        for model in chosen(args, scratch):
            if not (model.path / "cfg_args").is_file():
                continue
            render = [args.program, "render", model.path, "--cameras", model.cameras, "--all", "--split", "all"]
            run(*render, "--overwrite", "-o", photographs)
            for damage, options in DAMAGES.items():
                compress(args.program, model, trained_path, "--ratio", "40%", *options)
                trained = replace(model, path=trained_path, photographs=photographs)
                found = {}
                for toward in ("renders", "photographs"):
                    more = ["--ground-truth", photographs] if toward == "photographs" else []
                    _, cost = compress(args.program, trained, small, "--ratio", "20%", "--toward", toward, *more)
                    found[toward] = (evaluate(args.program, trained, small)["ground_truth"], cost)
                results.add(
                    model=model.name, damage=damage,
                    trained_psnr_db=found["renders"][0]["original"]["psnr"],
                    renders_psnr_db=found["renders"][0]["psnr"],
                    photographs_psnr_db=found["photographs"][0]["psnr"],
                    renders_processor_s=found["renders"][1].processor,
                    photographs_processor_s=found["photographs"][1].processor,
                )  # fmt: skip


if __name__ == "__main__":
    main()
