#!/usr/bin/env python3
"""Compares `default` with the best of some other settings per model: docs/benchmarks/robustness.csv.

    python3 scripts/benchmark/robustness.py target/release/splatsieve DATA

Reads docs/benchmarks/ablation.csv, written by `ablation.py`. The best setting of a model is chosen by the test views
themselves, so the difference is an upper bound of what tuning these parameters would gain.
"""

from measuring import Results, arguments, middle_and_range, read_results


def main():
    args = arguments(__doc__)
    results = Results("robustness", args.program, ["model", "default_psnr_db", "best_setting", "best_psnr_db", "default_below_best_db"])
    differences, by_model = [], {}
    for row in read_results("ablation"):
        if row["kind"] == "setting":
            by_model.setdefault(row["model"], {})[row["setting"]] = float(row["psnr_db"])
    for name, tried in by_model.items():
        best = max(tried, key=tried.get)
        differences.append(tried[best] - tried["default"])
        results.add(
            model=name, default_psnr_db=tried["default"], best_setting=best, best_psnr_db=tried[best],
            default_below_best_db=differences[-1],
        )  # fmt: skip
    middle, low, high = middle_and_range(differences)
    print(f"default below the best setting: median {middle:.2f} dB, {low:.2f} to {high:.2f} dB")


if __name__ == "__main__":
    main()
