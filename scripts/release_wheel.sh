#!/usr/bin/env bash
# Builds the Python wheel with the program for any Linux with glibc 2.28 or newer (manylinux_2_28). `pip install` of it
# needs no toolchain.
#
#     scripts/release_wheel.sh [FOLDER]            (default: the current folder)
#     scripts/release_wheel.sh dist                # for example
#
# Prints its path. Needs a Rust toolchain, and maturin and ziglang from PyPI in the Python of PYTHON (default: python3);
# zig links against the old C library.
set -euo pipefail
to=$(realpath "${1:-.}")
python=${PYTHON:-python3}
export PATH="$(dirname "$("$python" -c 'import sys; print(sys.executable)')"):$PATH"
cd "$(dirname "$0")/../python"
"$python" -m maturin build --release --strip --zig --compatibility manylinux_2_28 --out "$to"
