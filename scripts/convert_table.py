#!/usr/bin/env python3
"""Prints what conversion to the formats of players costs.

    python3 scripts/convert_table.py target/release/splatsieve DATA [MODEL ...]

Example: python3 scripts/convert_table.py target/release/splatsieve ../shared/data deform2

DATA holds model folders with cameras; without MODEL all of them are converted. Prints what was fitted, bytes, seconds,
and for .splatv, which can be read back, the PSNR against the model on its test views.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def said(*arguments):
    return subprocess.run([str(word) for word in arguments], check=True, capture_output=True, text=True).stdout


def main():
    if len(sys.argv) < 3:
        print(__doc__)
        sys.exit(2)
    binary, data, *names = sys.argv[1:]
    models = [path.parent for path in sorted(Path(data).glob("*/cfg_args"))]
    models = [model for model in models if not names or model.name in names]
    print("| model | Gaussians | as | fitted | bytes | s | PSNR dB to the model |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for model in models:
            for kind in ("splatv", "4dgs"):
                output = Path(folder) / f"{model.name}.{kind}"
                start = time.monotonic()
                done = json.loads(said(binary, "convert", model, output, "--cameras", model, "--json", "--quiet"))
                seconds = time.monotonic() - start
                fitted = next(re.search(r"became (\d+) (\w+)", note) for note in done["notes"] if "became" in note)
                quality = "–"
                if kind == "splatv":
                    found = json.loads(said(binary, "evaluate", model, output, "--cameras", model, "--json", "--quiet"))
                    quality = f"{found['psnr']:.1f}"
                print(
                    f"| {model.name} | {done['gaussians']:,} | .{kind} | {int(fitted[1]):,} {fitted[2]} "
                    f"| {done['bytes']:,} | {seconds:.1f} | {quality} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
