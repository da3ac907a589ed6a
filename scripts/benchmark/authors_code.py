#!/usr/bin/env python3
"""Puts results of the paper's published code beside ours at the same count: docs/benchmarks/authors_code.csv.

    python3 scripts/benchmark/authors_code.py target/release/splatsieve DATA

DATA/<model>/authors_algorithm.csv has what that code gave for the model (its own settings; N, PSNR on 45 renders of the
test views). Our figures are read from docs/benchmarks/equal_count.csv, written by `equal_count.py`.
"""

import csv

from measuring import Results, arguments, read_results


def main():
    args = arguments(__doc__)
    columns = ["model", "kept", "gaussians", "authors_psnr_db", "authors_photographs_db", "paper_prune_psnr_db"]
    results = Results("authors_code", args.program, [*columns, "visible_psnr_db", "default_psnr_db"])
    ours = {(row["model"], row["kept"], row["method"]): row["psnr_db"] for row in read_results("equal_count")}
    for path in sorted(args.data.glob("*/authors_algorithm.csv")):
        model = path.parent.name
        with path.open() as file:
            rows = [row for row in csv.DictReader(file) if row["variant"] == "prune_only"]
        for row in rows:
            kept = f"{float(row['keep']):.0%}"
            if (model, kept, "default") in ours:
                results.add(
                    model=model, kept=kept, gaussians=row["N"], authors_psnr_db=row["psnr_ref"],
                    authors_photographs_db=row["psnr_gt"], paper_prune_psnr_db=ours[model, kept, "paper-prune"],
                    visible_psnr_db=ours[model, kept, "visible"], default_psnr_db=ours[model, kept, "default"],
                )  # fmt: skip


if __name__ == "__main__":
    main()
