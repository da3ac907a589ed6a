#!/usr/bin/env python3
"""Measures what each stage brings, and other values of single parameters: docs/benchmarks/ablation.csv.

    cargo build --release
    python3 scripts/benchmark/ablation.py target/release/splatsieve DATA [--models A,B] [--kept 40%,20%,10%,5%]
        [--kinds stage,setting]

Rows of kind `stage` add one stage after the other, from pruning by the paper's score to `default`, then take single
parts of `default` away. Rows of kind `setting` change one parameter of `default`, and the first of them none; they are
measured at 10% only, and `robustness.py` compares `default` with the best of them for each model. With `--kinds` the
file has the named rows only; `--results` writes it into another folder. PSNR is the mean over test views. The runs of a
model share a cache of stage results, which changes no result but saves time.
"""

import shutil
import tempfile
from pathlib import Path

from error_against_time import VISIBLE
from measuring import KEPT, Results, arguments, chosen, compress, evaluate, words

PRUNE = ["--no-refine", "--prune-only"]
ROUNDS_OF_48_VIEWS = ["round_views=48", "round_groups=4"]
ARCHIVE = "default, as archive"
SETTINGS = {
    "default": [],
    "contrast_floor=0": ["contrast_floor=0"],
    "contrast_floor=0.3": ["contrast_floor=0.3"],
    "round_views=48, round_groups=4": ROUNDS_OF_48_VIEWS,
    "round_fraction=0.8": ["round_fraction=0.8"],
    "round_fraction=0.95": ["round_fraction=0.95"],
    "refine_steps_per_prune=120": ["refine_steps_per_prune=120"],
    "refine_target_views=260": ["refine_target_views=260"],
    "refine_ssim=0.5": ["refine_ssim=0.5"],
    "bands=0": ["bands=0"],
}


def sets(*settings):
    """Returns the options that set parameters."""
    return [word for setting in settings for word in ("--set", setting)]


def stages(kept):
    """Returns the name and the options of every row of kind `stage` for the fraction `kept`, a percentage."""
    fraction = float(kept.rstrip("%")) / 100
    return {
        "score of the paper, pruned": ["--preset", "paper", "--prune-only"],
        "visible contribution, pruned": [*PRUNE, *sets(*VISIBLE)],
        "removal error, one ranking": [*PRUNE, *sets(f"round_fraction={fraction}")],
        "pruning rounds": PRUNE,
        "merging": ["--no-refine"],
        "refinement at the target count": sets("refine_steps_per_prune=0"),
        "default": [],
        "default, colors refined only": sets("refine=color"),
        "default, exact field": sets("field=exact"),
        "default, every SH degree": sets("bands=all"),
        ARCHIVE: [],
        "default, rounds of 48 views": sets(*ROUNDS_OF_48_VIEWS),
        "default, no views outside the rig": sets("outside=0"),
        "default, only views of the scene's cameras": sets("refine_between=false"),
        "default, without validation": sets("refine_validate=false"),
    }


def main():
    kept = ("--kept", {"type": words, "default": KEPT, "help": "fractions of the Gaussians to keep, separated by commas"})
    kinds = ("--kinds", {"type": words, "default": ["stage", "setting"], "help": "kinds of rows to measure, separated by commas"})
    args = arguments(__doc__, kept, kinds)
    columns = ["model", "kept", "kind", "setting", "gaussians", "bytes", "psnr_db", "ssim"]
    results = Results("ablation", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            small, archive, cache = (Path(scratch) / name for name in (f"small{model.suffix}", "small.gsz", "cache"))
            for kept in args.kept:
                rows = [("stage", name, options) for name, options in stages(kept).items()]
                if kept == "10%":
                    rows += [("setting", name, sets(*settings)) for name, settings in SETTINGS.items()]
                rows = [row for row in rows if row[0] in args.kinds]
                for kind, name, options in rows:
                    output = archive if name == ARCHIVE else small
                    summary, _ = compress(args.program, model, output, "--ratio", kept, "--cache", cache, *options)
                    quality = evaluate(args.program, model, output)
                    results.add(
                        model=model.name, kept=kept, kind=kind, setting=name, gaussians=summary["gaussians"],
                        bytes=summary["output_bytes"], psnr_db=quality["psnr"], ssim=quality["ssim"],
                    )  # fmt: skip
            shutil.rmtree(cache, ignore_errors=True)


if __name__ == "__main__":
    main()
