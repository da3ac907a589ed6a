#!/usr/bin/env python3
"""Measures whole runs of `compress` to a tenth, and the result: docs/benchmarks/run_time.csv.

    cargo build --release
    python3 scripts/benchmark/run_time.py target/release/splatsieve DATA [--models A,B] [--repeats 3] [--kept 10%]

Wall time with one and with two threads (medians of the repeats, with the range), processor time and peak memory of the
whole process with one thread. Expected time with 8 and 16 threads, as a part of that with one (Amdahl's law). Of the
result: bytes and PSNR on test views, of the model and of its archive, and the time of a render before and after
(median of the test views, one thread).
"""

import tempfile
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate, middle_and_range


def size(summary):
    """Returns the bytes of the files that a renderer opens, before and after."""
    return summary["input"]["bytes"], summary["output_bytes"]


def expected_part(two_threads_part, threads):
    """Returns the expected wall time with `threads` threads, divided by that with one thread, by Amdahl's law:
    s + (1 - s) / threads. The serial part s is the one that gives the measured time with two threads. Losses that grow
    with more threads are not included."""
    serial = max(2 * two_threads_part - 1, 0)
    return serial + (1 - serial) / threads


def main():
    repeats = ("--repeats", {"type": int, "default": 3, "help": "runs with each number of threads"})
    part = ("--kept", {"default": "10%", "help": "fraction of the Gaussians to keep"})
    args = arguments(__doc__, repeats, part)
    columns = ["model", "gaussians_before", "gaussians", "runs", "wall_s", "wall_s_min", "wall_s_max", "processor_s"]
    columns += ["peak_mib", "wall_two_threads_s", "two_threads_part", "expected_part_8", "expected_part_16"]
    columns += ["psnr_db", "ssim", "bytes_before", "bytes"]
    columns += ["archive_bytes", "archive_part", "archive_psnr_db", "render_ms_before", "render_ms", "render_fps_before", "render_fps"]
    results = Results("run_time", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            output, archive = Path(scratch) / f"small{model.suffix}", Path(scratch) / "small.gsz"
            one, two = [], []
            for _ in range(args.repeats):
                summary, cost = compress(args.program, model, output, "--ratio", args.kept, "--threads", 1)
                one.append(cost)
                two.append(compress(args.program, model, output, "--ratio", args.kept, "--threads", 2)[1])
            quality = evaluate(args.program, model, output, "--threads", 1)
            compress(args.program, model, archive, "--ratio", args.kept)
            wall, low, high = middle_and_range([cost.wall for cost in one])
            wall_two = middle_and_range([cost.wall for cost in two])[0]
            before, after = size(summary)
            render = quality["render_ms"]
            results.add(
                model=model.name, gaussians_before=summary["input"]["gaussians"], gaussians=summary["gaussians"],
                runs=args.repeats, wall_s=wall, wall_s_min=low, wall_s_max=high,
                processor_s=middle_and_range([cost.processor for cost in one])[0],
                peak_mib=max(cost.peak for cost in one), wall_two_threads_s=wall_two, two_threads_part=wall_two / wall,
                expected_part_8=expected_part(wall_two / wall, 8), expected_part_16=expected_part(wall_two / wall, 16),
                psnr_db=quality["psnr"], ssim=quality["ssim"], bytes_before=before, bytes=after,
                archive_bytes=archive.stat().st_size, archive_part=archive.stat().st_size / before,
                archive_psnr_db=evaluate(args.program, model, archive)["psnr"],
                render_ms_before=render["before"], render_ms=render["after"],
                render_fps_before=1e3 / render["before"], render_fps=1e3 / render["after"],
            )  # fmt: skip


if __name__ == "__main__":
    main()
