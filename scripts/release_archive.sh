#!/usr/bin/env bash
# Builds the program and packs it into the archive that `cargo binstall` downloads from a release
# (package.metadata.binstall in Cargo.toml): splatsieve-TARGET-vVERSION.tgz.
#
#     scripts/release_archive.sh [FOLDER]          (default: the current folder)
#     scripts/release_archive.sh dist              # for example
#
# If `cargo zigbuild` is there (`pip install cargo-zigbuild ziglang`, and `rustup target add x86_64-unknown-linux-musl`),
# the program is linked statically with musl and runs on any Linux of this processor type. Otherwise it is linked with the
# C library of this machine. The archive also has the README, the licenses, shell completions and manual pages. Prints its
# path and the oldest C library (glibc) that can run the program. The same program gives the same bytes. Needs a Rust
# toolchain, GNU tar and binutils (strip, objdump).
set -euo pipefail
to=$(realpath "${1:-.}")
cd "$(dirname "$0")/.."
target=$(rustc -vV | sed -n 's/^host: //p')
if cargo zigbuild --help >/dev/null 2>&1; then
    target=${target%%-*}-unknown-linux-musl
    cargo zigbuild --release --target "$target"
    program=${CARGO_TARGET_DIR:-target}/$target/release/splatsieve
else
    cargo build --release
    program=${CARGO_TARGET_DIR:-target}/release/splatsieve
fi
version=$(cargo pkgid | sed 's/.*[#@]//')
name=splatsieve-$target-v$version
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir "$work/$name"
cp "$program" README.md LICENSE-* "$work/$name"
strip "$work/$name/splatsieve"
mkdir -p "$work/$name/completions" "$work/$name/man/man1"
for shell in bash elvish fish powershell zsh; do
    "$program" completions "$shell" >"$work/$name/completions/splatsieve.$shell"
done
"$program" man "$work/$name/man/man1" >/dev/null
# Fixed order, times and owners.
tar -C "$work" --sort=name --mtime=@0 --owner=0 --group=0 --numeric-owner -c "$name" | gzip -9n >"$to/$name.tgz"
echo "$to/$name.tgz"
oldest=$(objdump -T "$work/$name/splatsieve" 2>/dev/null | sed -n 's/.*(GLIBC_\([0-9.]*\)).*/\1/p' | sort -V | tail -n 1 || true)
if [[ -n $oldest ]]; then echo "needs glibc $oldest or newer"; else echo "statically linked"; fi
