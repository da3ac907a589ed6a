#!/usr/bin/env bash
# Runs fuzz targets one after the other, so many seconds each, from the saved corpus and what earlier runs found.
#
#     fuzz/run.sh SECONDS [TARGET...]          (default: every target)
#
# What is found lies in fuzz/artifacts; the last lines of fuzz/logs/TARGET.log have the number of executions.
set -uo pipefail
cd "$(dirname "$0")"
seconds=$1
shift
host=$(rustc -vV | sed -n 's/^host: //p')
targets=("$@")
((${#targets[@]})) || mapfile -t targets < <(ls fuzz_targets | sed 's/\.rs$//')
mkdir -p logs artifacts
for target in "${targets[@]}"; do
    saved=../tests/corpus/$target
    case $target in
        recover) saved=../tests/corpus/container ;;
        cameras_json) saved=../tests/corpus/cameras ;;
    esac
    mkdir -p "corpus/$target"
    # Memory is counted by the target itself; the limit here is for what is not allocated.
    "target/$host/release/$target" "corpus/$target" "$saved" -max_total_time="$seconds" -max_len=16384 -timeout=10 \
        -rss_limit_mb=2048 -artifact_prefix="artifacts/$target-" -print_final_stats=1 -verbosity=1 >>"logs/$target.log" 2>&1
    echo "$target: code $?, $(grep -a number_of_executed_units "logs/$target.log" | tail -1)"
done
