#!/usr/bin/env python3
"""Measures what the formats of players take and lose: docs/benchmarks/player_formats.csv.

    cargo build --release
    python3 scripts/benchmark/player_formats.py target/release/splatsieve DATA [--models A,B] [--kept 10%] [--fourdgs PYTHON]

Every model is compressed to a tenth first. Then `convert` writes that result in each format. `compress` also writes a
`.splatv` directly, and refines the colors of SH degree 0 for it, except if the model is a `.splatv` already. The table
has the bytes of the file or folder, processor seconds, and PSNR of the file as this program reads it, on the test views
against renders of the original model. A `.4dgs` is read by the package fourdgs of PYTHON (fourdgs_frames.py); nothing
here reads a `.gsd`. The frames are those of the cameras' times, 30 for the captured scene. Folders of `.spz` files are
made frame by frame.
"""

import shutil
import tempfile
from pathlib import Path

from measuring import Results, arguments, chosen, compress, evaluate, run

# Row of the `.splatv` that `compress` writes.
DIRECT = ".splatv of compress"
# Name of the format in the table, name of the output, options of `convert`.
FORMATS = [
    ("model", None, []),
    (".gsz", "small.gsz", []),
    (".gseq", "small.gseq", []),
    (".splatv", "out.splatv", []),
    (DIRECT, "direct.splatv", []),
    (".tsog", "out.tsog", []),
    (".ftgs.ply", "out.ftgs.ply", []),
    (".sog frames", "sog", ["--as", "sog-sequence"]),
    (".spz frames", "spz", []),
    (".4dgs", "out.4dgs", []),
    (".gsd", "out.gsd", []),
]


def size(path):
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.is_dir() else path.stat().st_size


def spz_frames(program, model, source, output, scratch):
    """Writes one .spz per frame of `source` into the folder `output`. Returns the processor seconds."""
    frames = scratch / "ply"
    _, cost = run(program, "convert", source, frames, "--as", "ply-sequence", "--cameras", model.cameras, *model.options)
    seconds = cost.processor
    output.mkdir()
    for path in sorted(frames.glob("*.ply")):
        seconds += run(program, "convert", path, output / f"{path.stem}.spz")[1].processor
    return seconds


def main():
    kept = ("--kept", {"default": "10%", "help": "fraction of the Gaussians to keep"})
    fourdgs = ("--fourdgs", {"metavar": "PYTHON", "help": "Python with the package fourdgs"})
    args = arguments(__doc__, kept, fourdgs)
    columns = ["model", "kept", "format", "bytes", "processor_s", "psnr_db", "ssim", "read_by"]
    results = Results("player_formats", args.program, columns)
    with tempfile.TemporaryDirectory() as scratch:
        for model in chosen(args, scratch):
            folder = Path(scratch) / model.name
            folder.mkdir()
            small = folder / f"small{model.suffix}"
            summary, whole = compress(args.program, model, small, "--ratio", args.kept)
            for name, file, options in FORMATS:
                output, reader, quality = small if file is None else folder / file, "splatsieve", None
                seconds = whole.processor
                if name == DIRECT and model.suffix == ".splatv":
                    continue
                if name == DIRECT:
                    seconds = compress(args.program, model, output, "--ratio", args.kept)[1].processor
                elif name == ".spz frames":
                    seconds = spz_frames(args.program, model, small, output, folder)
                elif name != "model":
                    command = [args.program, "convert", small, output, "--cameras", model.cameras, *model.options, *options]
                    seconds = run(*command)[1].processor
                if name == ".4dgs" and args.fourdgs:
                    reader, frames = "fourdgs", summary["input"]["frames"]
                    script = Path(__file__).with_name("fourdgs_frames.py")
                    run(args.fourdgs, script, output, folder / "fourdgs", "--frames", frames)
                    quality = evaluate(args.program, model, folder / "fourdgs")
                elif name not in (".4dgs", ".gsd"):
                    quality = evaluate(args.program, model, output)
                # Without the files about the run that lie in a model folder.
                count = summary["output_bytes"] if name == "model" else size(output)
                results.add(
                    model=model.name, kept=args.kept, format=name, bytes=count, processor_s=seconds,
                    psnr_db=quality and quality["psnr"], ssim=quality and quality["ssim"],
                    read_by=reader if quality else "",
                )  # fmt: skip
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
