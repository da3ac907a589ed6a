#!/usr/bin/env python3
"""Measures error against run time of whole runs: docs/benchmarks/error_against_time.csv.

    cargo build --release
    python3 scripts/benchmark/error_against_time.py target/release/splatsieve DATA [--models A,B] [--kept 10%]

Every run keeps the same number of Gaussians. Settings: `--effort` fast, default and best; `default` with other numbers
of optimization steps (the steps before prune steps change in proportion); without refinement; pruning by visible
contribution; the preset `paper`. Processor seconds are those of the whole process, PSNR is the mean over test views.
"""

import tempfile
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate

# Pruning by the mean visible contribution alone: no pruning rounds, no comparison with merging, no other stage.
VISIBLE = [
    "scan.coverage=visible", "score.static_term=mean", "score.w_dynamic=0", "score.clip_norm=false",
    "select.round_fraction=1", "select.choose_by_views=false", "field=exact", "bands=all",
]  # fmt: skip


def settings():
    """Returns curve, setting and options of every run."""
    found = [("effort", name, ["--effort", name]) for name in ("fast", "default", "best")]
    for steps in (150, 400, 800, 3000):
        before_a_prune_step = round(steps * 260 / 1500)
        options = ["--set", f"refine_steps={steps}", "--set", f"refine_steps_per_prune={before_a_prune_step}"]
        found.append(("steps", str(steps), options))
    found.append(("point", "no-refine", ["--no-refine"]))
    visible = [word for setting in VISIBLE for word in ("--set", setting)]
    found.append(("point", "visible", ["--no-refine", "--prune-only", *visible]))
    found.append(("point", "paper", ["--preset", "paper"]))
    return found


def main():
    args = arguments(__doc__, ("--kept", {"default": "10%", "help": "fraction of the Gaussians to keep"}))
    results = Results("error_against_time", args.program, ["model", "kept", "curve", "setting", "processor_s", "psnr_db", "ssim"])
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            output = Path(scratch) / f"small{model.suffix}"
            for curve, setting, options in settings():
                _, cost = compress(args.program, model, output, "--ratio", args.kept, *options)
                quality = evaluate(args.program, model, output)
                results.add(
                    model=model.name, kept=args.kept, curve=curve, setting=setting, processor_s=cost.processor,
                    psnr_db=quality["psnr"], ssim=quality["ssim"],
                )  # fmt: skip


if __name__ == "__main__":
    main()
