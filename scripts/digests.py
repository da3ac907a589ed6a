#!/usr/bin/env python3
"""Computes digests of the program's outputs: a table that proves that a refactoring changed no byte.

    cargo build --release
    python3 scripts/digests.py target/release/splatsieve DATA TABLE            writes TABLE
    python3 scripts/digests.py target/release/splatsieve DATA --against TABLE  compares, exit 1 if a digest differs

Example: python3 scripts/digests.py target/release/splatsieve ../shared/data before.txt

DATA/<name>/ is a 4DGaussians model folder with its cameras in it; DATA/static/*.ply are stills. Containers, streams,
PLY sequences and single PLYs are made from the built-in demo and from the smallest model. Every preset, --prune-only,
--merge-only, targets, ids, every output kind and the other commands run once. summary.json, which holds times, and
recipe.toml are left out. The bytes of models depend on the instructions of the processor (FMA or not), so tables are
comparable only on one machine. --only WORD runs the cases whose names contain WORD. Needs only the standard library.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import argparse
import hashlib
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SKIPPED = ("summary.json", "recipe.toml")


def digest(path):
    """Returns the SHA-256 of names and bytes of a file and the files beside it that share its name, or of a folder."""
    if path.is_dir():
        files = sorted(p for p in path.rglob("*") if p.is_file())
        named = [(str(p.relative_to(path)), p) for p in files]
    else:
        named = [(p.name, p) for p in sorted(path.parent.glob(path.name + "*"))]
    hashed = hashlib.sha256()
    for name, file in named:
        if not name.endswith(SKIPPED):
            hashed.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return hashed.hexdigest()[:24]


def run(command, stdin=None):
    result = subprocess.run([str(part) for part in command], stdin=stdin, capture_output=True)
    if result.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}\n{result.stderr.decode()}")


def cases(binary, data, scratch):
    """Yields (name, function that writes to a given path, name of the output) of every case."""
    models = sorted(path.parent for path in data.glob("*/cfg_args"))
    small = models[0]
    box = "-1,-1,-1,0,0,0"

    def compress(source, *options, cameras=None, stdin=None):
        looks = ["--cameras", cameras] if cameras else []

        def to(output):
            pipe = subprocess.Popen([str(part) for part in stdin], stdout=subprocess.PIPE) if stdin else None
            run([binary, "compress", source, *looks, "-o", output, *options], stdin=pipe.stdout if pipe else None)
            if pipe:
                pipe.stdout.close()
                pipe.wait()

        return to

    demo = scratch / "demo"
    # Versions before the command `test-scene` made this scene with `demo`.
    has_command = subprocess.run([binary, "test-scene", "--help"], capture_output=True).returncode == 0
    make_scene = "test-scene" if has_command else "demo"
    run([binary, make_scene, "--gaussians", "3000", "--frames", "64", "-o", demo])
    rig = demo / "cameras.json"
    packed, frames = scratch / "model.gseq", scratch / "frames"
    run([binary, "convert", small, packed, "--cameras", small])
    run([binary, "compress", demo / "scene.gseq", "--cameras", rig, "-o", frames, "--as", "ply-sequence",
         "--preset", "gentle", "--prune-only"])
    one = sorted(frames.glob("*.ply"))[0]
    bare = scratch / "bare"
    bare.mkdir()
    for part in ("cfg_args", "point_cloud"):
        run(["cp", "-r", small / part, bare])

    yield "demo folder", lambda out: run([binary, make_scene, "-o", out]), "demo"
    for model in models:
        for preset in ("default", "paper", "gentle", "strong"):
            yield f"{model.name} {preset}", compress(model, "--preset", preset, cameras=model), "small"
    variants = {
        "prune-only": ["--prune-only"],
        "merge-only": ["--merge-only"],
        "paper prune-only": ["--preset", "paper", "--prune-only"],
        "paper merge-only": ["--preset", "paper", "--merge-only"],
        "strong merge-only": ["--preset", "strong", "--merge-only"],
        "ratio 0.3": ["--ratio", "0.3"],
        "count 5000 strong": ["--count", "5000", "--preset", "strong"],
        "ratio 0.9 merge-only": ["--ratio", "0.97", "--merge-only", "--preset", "paper"],
        "ratio 0.5 paper": ["--ratio", "0.5", "--preset", "paper"],
        "ids": ["--keep-ids", "3,10-200", "--drop-ids", "5000-5100"],
        "box": ["--keep-box", box],
        "projected": ["--set", "coverage=projected", "--set", "choose_by_views=false"],
        "mean placement": ["--preset", "strong", "--set", "placement=mean"],
    }
    for name, options in variants.items():
        yield f"{small.name} {name}", compress(small, *options, cameras=small), "small"
    yield f"{small.name} without cameras", compress(bare, "--frames", "12"), "small"
    for kind, output in (("gseq", "small.gseq"), ("ply", "small.ply"), ("ply-sequence", "small")):
        for preset in ("paper", "strong"):
            yield (f"{small.name} {preset} as {kind}",
                   compress(small, "--preset", preset, "--as", kind, cameras=small), output)
    for preset in ("default", "paper", "gentle", "strong"):
        for kind, output in (("gseq", "small.gseq"), ("ply-sequence", "small")):
            yield (f"demo container {preset} as {kind}",
                   compress(demo / "scene.gseq", "--preset", preset, "--as", kind, cameras=rig), output)
        yield (f"demo stream {preset}",
               compress("-", "--preset", preset, cameras=rig,
                        stdin=[binary, "convert", demo / "scene.gseq", "-"]), "small.gseq")
        yield f"demo frames {preset}", compress(frames, "--preset", preset, cameras=rig), "small"
        yield f"demo frames {preset} as gseq", compress(frames, "--preset", preset, cameras=rig), "small.gseq"
        yield f"demo ply {preset}", compress(one, "--preset", preset, cameras=rig), "small.ply"
        yield f"{small.name} container {preset}", compress(packed, "--preset", preset, cameras=small), "small.gseq"
    for options in (["--prune-only"], ["--merge-only"], ["--ratio", "0.2"],
                    ["--count", "900", "--preset", "strong"], ["--merge-only", "--preset", "strong"]):
        for what, source in (("container", demo / "scene.gseq"), ("frames", frames), ("ply", one)):
            output = "small.ply" if what == "ply" else "small.gseq" if what == "container" else "small"
            yield f"demo {what} {' '.join(options)}", compress(source, *options, cameras=rig), output
    yield "demo container without cameras", compress(demo / "scene.gseq"), "small.gseq"
    for path in sorted((data / "static").glob("*.ply")):
        yield f"{path.stem} ratio 0.3", compress(path, "--ratio", "0.3"), "small.ply"
        yield f"{path.stem} strong visible", compress(path, "--preset", "strong", "--set", "coverage=visible"), "small.ply"
    yield "score npz", lambda out: run([binary, "score", small, "--cameras", small, "-o", out]), "rows.npz"
    yield "score csv paper", lambda out: run(
        [binary, "score", demo / "scene.gseq", "--cameras", rig, "--preset", "paper", "-o", out]), "rows.csv"
    yield "pack", lambda out: run([binary, "convert", small, out, "--cameras", small]), "packed.gseq"
    yield "pack raw", lambda out: run([binary, "convert", frames, out, "--raw"]), "packed.gseq"
    yield "unpack", lambda out: run([binary, "convert", demo / "scene.gseq", out, "--as", "ply-sequence"]), "frames"
    yield "render", lambda out: run(
        [binary, "render", small, "--cameras", small, "--frame", "7", "--view", "1", "-o", out]), "picture.npy"
    yield "render all", lambda out: run(
        [binary, "render", demo / "scene.gseq", "--cameras", rig, "--all", "-o", out]), "renders"
    yield "evaluate csv", lambda out: run(
        [binary, "evaluate", demo / "scene.gseq", demo / "compressed.gseq", "--cameras", rig, "--csv", out]), "e.csv"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("table", type=Path, nargs="?")
    parser.add_argument("--against", type=Path)
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    expected = {}
    if args.against:
        for line in args.against.read_text().splitlines():
            found, name = line.split("  ", 1)
            expected[name] = found
    lines, changed = [], 0
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        for number, (name, write, output) in enumerate(cases(args.binary.resolve(), args.data.resolve(), scratch)):
            if args.only not in name:
                continue
            place = scratch / f"case{number}"
            place.mkdir()
            write(place / output)
            line = f"{digest(place / output)}  {name}"
            differs = args.against and expected.get(name) != line.split("  ", 1)[0]
            changed += bool(differs)
            print(line + ("  DIFFERS" if differs else ""), flush=True)
            lines.append(line)
            shutil.rmtree(place)
    if args.table:
        args.table.write_text("\n".join(lines) + "\n")
    if args.against:
        print(f"{len(lines)} cases, {changed} differ")
    sys.exit(1 if changed else 0)


if __name__ == "__main__":
    main()
