#!/usr/bin/env python3
"""Takes diagrams out of a page of `splatsieve precision`, as pictures of their own.

    target/release/splatsieve precision MODEL --cameras MODEL -o FOLDER
    python3 scripts/diagrams.py FOLDER/precision.html "CAPTION" PICTURE.svg ["CAPTION" PICTURE.svg ...]

Each is the first whose caption begins so. The two of docs/benchmarks.md are made from deform2:
"look: relative L2 error of C" scripts/precision_look.svg, "rounds: error added" scripts/precision_rounds.svg.
Needs nothing but Python.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import html
import re
import sys
from pathlib import Path

# As on paper: what depends on the screen goes.
STYLE = re.sub(
    r"@media[^{]*\{(?:[^{}]*\{[^{}]*\})*[^{}]*\}\n?",
    "",
    (Path(__file__).parent.parent / "src/report/chart.css").read_text(),
)


def main():
    if len(sys.argv) < 4 or len(sys.argv) % 2:
        sys.exit(__doc__)
    page = Path(sys.argv[1]).read_text()
    figures = re.findall(r"<figure><figcaption>(.*?)</figcaption>(<svg.*?</svg>)", page, re.DOTALL)
    for caption, picture in zip(sys.argv[2::2], sys.argv[3::2]):
        found = [svg for name, svg in figures if html.unescape(name).startswith(caption)]
        if not found:
            sys.exit(f"{sys.argv[1]}: no diagram begins {caption!r}; there are: {', '.join(name for name, _ in figures)}")
        inside = f'<style>{STYLE}</style><rect width="100%" height="100%" fill="#fff"/>'
        svg = re.sub(r"<svg([^>]*)>", lambda m: f'<svg xmlns="http://www.w3.org/2000/svg"{m[1]}>{inside}', found[0], count=1)
        Path(picture).write_text(svg + "\n")


if __name__ == "__main__":
    main()
