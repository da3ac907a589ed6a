"""Writes a frame stream (format/STREAM.md), the standard input of `splatsieve compress -`.

    with StreamWriter(sys.stdout.buffer, count, sh_degree, {"sh": features, ...}) as stream:
        for time, position, rotation in frames:
            stream.frame(time, {"position": position, "rotation": rotation})

The writer is that of the Python package (`python/splatsieve/_stream.py`), whose docstring describes the columns. Needs
numpy.
"""

import sys
from pathlib import Path

# The module of the checkout, or else of an installed package.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "python"))

from splatsieve._stream import COLUMNS, StreamWriter  # noqa: E402

__all__ = ["COLUMNS", "StreamWriter"]
