#!/usr/bin/env bash
# Builds every fuzz target as `cargo fuzz build --release --sanitizer none` does, without that program.
set -euo pipefail
cd "$(dirname "$0")"
host=$(rustc -vV | sed -n 's/^host: //p')
pass=-Cllvm-args=-sanitizer-coverage
# The flags are for nightly toolchains; RUSTC_BOOTSTRAP lets a stable one take them.
toolchain=()
if cargo +nightly --version >/dev/null 2>&1; then toolchain=(+nightly); else export RUSTC_BOOTSTRAP=1; fi
# With a target named, build scripts are not instrumented.
RUSTFLAGS="-Cpasses=sancov-module $pass-level=4 $pass-inline-8bit-counters $pass-pc-table $pass-trace-compares \
--cfg fuzzing -Ccodegen-units=16" cargo "${toolchain[@]}" build --release --target "$host" "$@"
