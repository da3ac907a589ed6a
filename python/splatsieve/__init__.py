"""Shrinks trained dynamic (4D) Gaussian-splatting models after training: the program `splatsieve` from Python.

    import splatsieve

    summary = splatsieve.compress("model", "small", cameras="data", target_ratio=0.3)
    with splatsieve.stream("small.gseq", count=1000, sh_degree=0) as out: ...
    scene = splatsieve.read_gseq("small.gseq")

Numpy is needed by `stream` and `read_gseq` only, which is why they import it late.
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
    """Opens a container (`.gseq`). Its tiles are read when they are asked for; checksums are not verified.

    Raises ValueError where the file is no complete container.
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
    """Starts the program on a frame stream: a context manager to whose `frame` each frame is given.

    `count` Gaussians with spherical harmonics of `sh_degree`; none: any number in each frame, all columns with it, and
    the program finds which is which. `constant` has the columns that hold for every frame, by
    name, the others come with every frame: position [N, 3]; rotation [N, 4], wxyz; log_scale [N, 3], natural logs;
    opacity_logit [N] or [N, 1]; sh [N, (d+1)^2, 3]. Where the block ends the program goes on to the end of its work, and
    `summary` of `compress` is there; where the block raises, the program is told that the stream broke off, and writes
    nothing. `command` may be "convert". Options are those of `compress`.

    Raises Error with the program's message, also from `frame` once the program has ended.
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
