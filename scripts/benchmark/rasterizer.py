#!/usr/bin/env python3
"""Measures the CPU rasterizer, forward and with gradients: docs/benchmarks/rasterizer.csv.

    cargo build --release
    python3 scripts/benchmark/rasterizer.py target/release/splatsieve DATA

Runs `cargo bench --bench rasterizer`, whose first comment explains the columns; the scene is synthetic, and DATA is not
used. Frames per second are those of renders.
"""

from measuring import ROOT, Results, arguments, run


COLUMNS = ["gaussians", "width", "height", "threads", "events", "events_per_pixel", "render_ms", "render_ms_min"]
COLUMNS += ["render_ms_max", "gradient_ms", "gradient_ms_min", "gradient_ms_max", "limit_ms", "scalar_ms", "million_events_per_s"]


def main():
    args = arguments(__doc__)
    results = Results("rasterizer", args.program, [*COLUMNS, "frames_per_s"])
    text, _ = run("cargo", "bench", "--manifest-path", ROOT / "Cargo.toml", "--bench", "rasterizer")
    header, *rows = [line.split(",") for line in text.splitlines() if line]
    for row in rows:
        values = dict(zip(header, row))
        results.add(**values, frames_per_s=1e3 / float(values["render_ms"]))


if __name__ == "__main__":
    main()
