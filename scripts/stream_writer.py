"""Writes a frame stream (format/STREAM.md): what `splatsieve compress -` reads from standard input.

    with StreamWriter(sys.stdout.buffer, count, sh_degree, {"sh": features, ...}) as stream:
        for time, position, rotation in frames:
            stream.frame(time, {"position": position, "rotation": rotation})

The writer is the Python package's (`python/splatsieve/_stream.py`), which says what columns are; needs numpy.
"""

import sys
from pathlib import Path

# Of the checkout, else of an installed package.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "python"))

from splatsieve._stream import COLUMNS, StreamWriter  # noqa: E402

__all__ = ["COLUMNS", "StreamWriter"]
