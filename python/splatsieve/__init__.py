"""Compresses trained dynamic (4D) Gaussian-splatting models after training: the program `splatsieve` from Python.

    import splatsieve

    summary = splatsieve.compress("model", "small", cameras="data", ratio=0.3)
    with splatsieve.stream("small.gseq", count=1000, sh_degree=0) as out: ...
    scene = splatsieve.read_gseq("small.gseq")

Only `stream` and `read_gseq` need numpy; they import it when they are called.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ._program import Error, Log, Option, compress, evaluate, info, program, run

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ._gseq import Gseq
    from ._stream import Stream, StreamWriter

__all__ = [
    "Error",
    "Gseq",
    "Log",
    "Option",
    "Stream",
    "StreamWriter",
    "compress",
    "evaluate",
    "info",
    "program",
    "read_gseq",
    "run",
    "stream",
]


def read_gseq(path: str) -> Gseq:
    """Opens the container (`.gseq`) at `path`. Values are read when they are needed; checksums are not verified.

    Raises ValueError if the file is not a complete container.
    """
    from ._gseq import Gseq

    return Gseq(path)


def stream(
    output: str,
    count: int | None,
    sh_degree: int,
    constant: Mapping[str, ArrayLike] | None = None,
    *,
    command: str = "compress",
    log: Log | None = None,
    **options: Option,
) -> Stream:
    """Starts the program on a frame stream. Returns a context manager whose method `frame` sends one frame.

    `count` is the number of Gaussians, `sh_degree` the degree of their spherical harmonics. If `count` is None, frames
    may have any number of Gaussians, every frame has all columns, and the program links the Gaussians of consecutive
    frames. `constant` gives, by name, the columns (attributes) that are the same in all frames; the other columns come
    with every frame: position [N, 3]; rotation [N, 4], wxyz; log_scale [N, 3], natural logs; opacity_logit [N] or
    [N, 1]; sh [N, (d+1)^2, 3] or [N, 3 (d+1)^2]. At the end of the `with` block the program finishes its work, and
    `summary` holds the summary of `compress`. If the block raises an exception, the program learns that the stream is
    incomplete and writes nothing. `command` is "compress" or "convert". Options are those of
    `splatsieve compress --help`.

    Raises ValueError, also from `frame`, if a column has an unknown name or a wrong shape, and Error with the program's
    message, also from `frame` after the program has ended.
    """
    from ._stream import Stream

    return Stream(output, count, sh_degree, constant, command=command, log=log, options=options)


def __getattr__(name: str) -> Any:
    if name == "Gseq":
        from ._gseq import Gseq

        return Gseq
    if name in ("Stream", "StreamWriter"):
        from . import _stream

        return getattr(_stream, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
