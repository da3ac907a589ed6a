#!/usr/bin/env bash
# Builds the program and packs it into the archive that `cargo binstall` downloads from a release
# (package.metadata.binstall in Cargo.toml): splatsieve-TARGET-vVERSION.tgz.
#
#     scripts/release_archive.sh [FOLDER]          (default: the current folder)
#     scripts/release_archive.sh dist              # for example
#
# The archive also has the README, the licenses, shell completions and manual pages. Prints its path and the oldest C
# library (glibc) that can run the program. The same program gives the same bytes. Needs a Rust toolchain, GNU tar and
# binutils (strip, objdump).
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
mkdir -p "$work/$name/completions" "$work/$name/man/man1"
for shell in bash elvish fish powershell zsh; do
    target/release/splatsieve completions "$shell" >"$work/$name/completions/splatsieve.$shell"
done
target/release/splatsieve man "$work/$name/man/man1" >/dev/null
# Fixed order, times and owners.
tar -C "$work" --sort=name --mtime=@0 --owner=0 --group=0 --numeric-owner -c "$name" | gzip -9n >"$to/$name.tgz"
echo "$to/$name.tgz"
oldest=$(objdump -T "$work/$name/splatsieve" | sed -n 's/.*(GLIBC_\([0-9.]*\)).*/\1/p' | sort -V | tail -n 1)
[[ -z $oldest ]] || echo "needs glibc $oldest or newer"
