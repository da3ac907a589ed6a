#!/usr/bin/env bash
# Builds the program and packs it into the archive that `cargo binstall` downloads from a release
# (package.metadata.binstall in Cargo.toml): splatsieve-TARGET-vVERSION.tgz.
#
#     scripts/release_archive.sh [FOLDER]          (default: the current folder)
#     scripts/release_archive.sh dist              # for example
#
# Prints the path of the archive. The same program gives the same bytes. Needs a Rust toolchain, GNU tar and strip.
set -euo pipefail
to=$(realpath "${1:-.}")
cd "$(dirname "$0")/.."
cargo build --release
target=$(rustc -vV | sed -n 's/^host: //p')
version=$(cargo pkgid | sed 's/.*[#@]//')
name=splatsieve-$target-v$version
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir "$work/$name"
cp target/release/splatsieve README.md LICENSE-* "$work/$name"
strip "$work/$name/splatsieve"
# Fixed order, times and owners.
tar -C "$work" --sort=name --mtime=@0 --owner=0 --group=0 --numeric-owner -c "$name" | gzip -9n >"$to/$name.tgz"
echo "$to/$name.tgz"
