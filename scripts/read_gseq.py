#!/usr/bin/env python3
"""Reads gseq containers (format/SPEC.md) in numpy.

    from read_gseq import Gseq
    scene = Gseq("scene.gseq")
    scene.times                      # [T] float64
    scene.column("position", 7)      # [N, 3] float32, at frame 7

    python3 scripts/read_gseq.py scene.gseq                    # says what it holds
    python3 scripts/read_gseq.py scene.gseq arrays.npz         # every frame of every column: times, and [T, N, width]

Tiles are found through the index in the footer; one frame block of one column is in memory at a time. Checksums are not
verified (`splatsieve info --check` does that). Needs numpy and zstandard.
"""

import plainly  # noqa: F401 (first: what fails after it ends with a sentence)
import sys
from pathlib import Path

# The module of the checkout, or else of an installed package.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "python"))

from splatsieve._gseq import Gseq, main  # noqa: E402

__all__ = ["Gseq"]

if __name__ == "__main__":
    main(__doc__)
