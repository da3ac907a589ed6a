#!/usr/bin/env bash
# Builds the Python wheel with the program for any Linux with glibc 2.28 or newer (manylinux_2_28) and the processor type
# of this machine. `pip install` of it needs no toolchain.
#
#     scripts/release_wheel.sh [FOLDER]            (default: the current folder)
#     scripts/release_wheel.sh dist                # for example
#
# Prints its path. Needs a Rust toolchain, and `pip install "maturin>=1.9,<2" ziglang` in the Python of PYTHON (default:
# python3); zig links against the old C library.
set -euo pipefail
to=$(realpath "${1:-.}")
python=$("${PYTHON:-python3}" -c 'import sys; print(sys.executable)')
PATH="${python%/*}:$PATH"
cd "$(dirname "$0")/../python"
"$python" -m maturin build --release --strip --zig --compatibility manylinux_2_28 --out "$to"
