#!/usr/bin/env bash
# Builds every fuzz target like `cargo fuzz build --release --sanitizer none`, without cargo-fuzz.
#
#     fuzz/build.sh [CARGO OPTION...]
#     fuzz/build.sh --bin ply                  # for example, one target
set -euo pipefail
cd "$(dirname "$0")"
host=$(rustc -vV | sed -n 's/^host: //p')
pass=-Cllvm-args=-sanitizer-coverage
# The flags need a nightly toolchain; with RUSTC_BOOTSTRAP a stable one accepts them.
toolchain=()
if cargo +nightly --version >/dev/null 2>&1; then toolchain=(+nightly); else export RUSTC_BOOTSTRAP=1; fi
# With an explicit --target, build scripts are not instrumented.
RUSTFLAGS="-Cpasses=sancov-module $pass-level=4 $pass-inline-8bit-counters $pass-pc-table $pass-trace-compares \
--cfg fuzzing -Ccodegen-units=16" cargo "${toolchain[@]}" build --release --target "$host" "$@"
