#!/usr/bin/env bash
# Runs fuzz targets one after the other for SECONDS each, starting from the saved corpus and the inputs of earlier runs.
#
#     fuzz/run.sh SECONDS [TARGET...]          (default: every target)
#     fuzz/run.sh 600 container                # for example
#
# Findings are written to fuzz/artifacts; the last lines of fuzz/logs/TARGET.log have the number of executions.
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
    esac
    mkdir -p "corpus/$target"
    # The target counts allocated memory itself; the limit here is for other memory.
    "target/$host/release/$target" "corpus/$target" "$saved" -max_total_time="$seconds" -max_len=16384 -timeout=10 \
        -rss_limit_mb=2048 -artifact_prefix="artifacts/$target-" -print_final_stats=1 -verbosity=1 >>"logs/$target.log" 2>&1
    echo "$target: code $?, $(grep -a number_of_executed_units "logs/$target.log" | tail -1)"
done
