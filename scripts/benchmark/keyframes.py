#!/usr/bin/env python3
"""Measures refinement of explicit frames with and without keyframes: docs/benchmarks/keyframes.csv.

    cargo build --release
    python3 scripts/benchmark/keyframes.py target/release/splatsieve DATA [--models A,B] [--kept 20%,5%]

Every model is stored as a container of its frames first. Then the container is compressed with deltas that are constant
in time (refine_keyframes=0), and with deltas that change linearly between 5 keyframes, the default. PSNR is the mean
over test views, against renders of the unpruned model; "temporal" is the temporal error that `evaluate` states.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate, run, words


def main():
    kept = {"type": words, "default": ["20%", "5%"], "help": "fractions of the Gaussians to keep, separated by commas"}
    args = arguments(__doc__, ("--kept", kept))
    columns = ["model", "kept", "keyframes", "bytes", "processor_s", "psnr_db", "ssim", "temporal"]
    results = Results("keyframes", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            frames, output = Path(scratch) / f"{model.name}.gseq", Path(scratch) / "small.gseq"
            run(args.program, "convert", model.path, frames, "--cameras", model.cameras, *model.options, "--quiet")
            sequence = replace(model, path=frames, photographs=None, options=())
            for fraction in args.kept:
                for keyframes in (0, 5):
                    options = ["--ratio", fraction, "--set", f"refine_keyframes={keyframes}"]
                    _, cost = compress(args.program, sequence, output, *options)
                    quality = evaluate(args.program, sequence, output)
                    results.add(
                        model=model.name, kept=fraction, keyframes=keyframes, bytes=output.stat().st_size,
                        processor_s=cost.processor, psnr_db=quality["psnr"], ssim=quality["ssim"],
                        temporal=quality["temporal"],
                    )  # fmt: skip


if __name__ == "__main__":
    main()
