#!/usr/bin/env bash
# Measures every table of docs/benchmarks.md, draws its plots, and writes the tables into README.md and the page.
# Usage: scripts/benchmark/all.sh DATA. DATA is the folder with the trained models. Takes about six hours on two cores, of
# which the ablation takes four.
#
# Programs of others take part if these variables name them:
#   SPLAT_TRANSFORM  command that runs @playcanvas/splat-transform
#   SPLAT4D          command that runs splat4d
#   FOURDGS_PYTHON   Python with the package fourdgs
set -euo pipefail
cd "$(dirname "$0")/../.."
data=${1:?usage: scripts/benchmark/all.sh DATA}
cargo build --release
measure() { # SCRIPT [OPTION...]
    python3 "scripts/benchmark/$1.py" target/release/splatsieve "$data" "${@:2}"
}
measure run_time
measure error_against_time
measure rasterizer
measure equal_count
measure authors_code
measure photographs
measure toward_photographs
measure equal_bytes ${SPLAT_TRANSFORM:+--splat-transform "$SPLAT_TRANSFORM"}
measure player_formats --models spinach_4,deform2 ${FOURDGS_PYTHON:+--fourdgs "$FOURDGS_PYTHON"}
measure sequences ${SPLAT4D:+--splat4d "$SPLAT4D"} ${FOURDGS_PYTHON:+--fourdgs "$FOURDGS_PYTHON"}
measure ablation
measure robustness
measure keyframes --models deform2,room2_dynerf
measure outside
measure large_scene --models room2_dynerf
measure scale
measure format_speed
python3 scripts/benchmark/plots.py docs/benchmarks
SPLATSIEVE_WRITE_DOCS=1 cargo test --test command_line benchmark
