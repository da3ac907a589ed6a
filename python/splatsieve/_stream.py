"""Writes frame streams (format/STREAM.md) to a file or to the program.

Columns are arrays [N, ...] in stored encoding: position [N, 3]; rotation [N, 4], wxyz; log_scale [N, 3], natural logs;
opacity_logit [N] or [N, 1]; sh [N, (d+1)^2, 3]. Columns that are the same in all frames are given once, the others with
every frame. If frames may have any number of Gaussians, `count` is None and every frame has all columns. Needs numpy.
"""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Mapping
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ._program import Error, Log, Option, RunningProgram, flags, parsed

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

COLUMNS = ["position", "rotation", "log_scale", "opacity_logit", "sh"]


class StreamWriter:
    """Writer of a frame stream to `out`, a binary file.

    with StreamWriter(sys.stdout.buffer, count, sh_degree, {"sh": features, ...}) as stream:
        for time, position, rotation in frames:
            stream.frame(time, {"position": position, "rotation": rotation})
    """

    def __init__(
        self, out: IO[bytes], count: int | None, sh_degree: int, constant: Mapping[str, ArrayLike] | None = None
    ) -> None:
        self.out, self.frames = out, 0
        constant = dict(constant or {})
        if count is None and constant:
            raise ValueError("frames of any number of Gaussians have no columns that hold for every frame")
        self.varying = [name for name in COLUMNS if name not in constant]
        bits = sum(1 << COLUMNS.index(name) for name in self.varying)
        version = 2 if count is None else 1
        out.write(struct.pack("<8sIIQII", b"\x89GSTR\r\n\x1a", version, sh_degree, count or 0, bits, 0))
        out.writelines(planes(constant[name]) for name in COLUMNS if name in constant)

    def frame(self, time: float, columns: Mapping[str, ArrayLike]) -> None:
        """Writes one frame: the varying columns at `time`, which must be later than the time of the previous frame."""
        payload = b"".join(planes(columns[name]) for name in self.varying)
        self.out.write(struct.pack("<4sIdQ", b"FRAM", self.frames, time, len(payload)) + payload)
        self.frames += 1

    def end(self) -> None:
        """Writes the end mark. A stream without an end mark tells the reader that the exporter failed."""
        self.out.write(struct.pack("<4sI16x", b"DONE", self.frames))

    def __enter__(self) -> StreamWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, failure: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.end()
        self.out.flush()


def planes(column: ArrayLike) -> bytes:
    """Returns the values of a column as bytes of f32, component by component."""
    return np.ascontiguousarray(np.moveaxis(np.asarray(column), 0, -1), "<f4").tobytes()


class Stream:
    """Result of `splatsieve.stream`: the running program with a frame stream as its input."""

    # Summary of `compress`; None before the `with` block has ended, and for other commands.
    summary: dict[str, Any] | None = None

    def __init__(
        self,
        output: str,
        count: int | None,
        sh_degree: int,
        constant: Mapping[str, ArrayLike] | None = None,
        *,
        command: str = "compress",
        log: Log | None = None,
        options: Mapping[str, Option] | None = None,
    ) -> None:
        options = {"output": output, **(options or {})} | ({"json": True} if command == "compress" else {})
        words = [command, *flags(options), "--", "-"]
        self.words, self.log = words, log
        self.shape = (count, sh_degree, {name: np.asarray(column) for name, column in (constant or {}).items()})
        self.reads = command == "compress"

    def __enter__(self) -> Stream:
        self.running = RunningProgram(self.words, self.log, stdin=subprocess.PIPE)
        assert self.running.process.stdin is not None
        self.pipe = self.running.process.stdin
        try:
            self.writer = StreamWriter(self.pipe, *self.shape)
        except BrokenPipeError:
            self.refused()
        return self

    def frame(self, time: float, columns: Mapping[str, ArrayLike]) -> None:
        """Sends one frame: the varying columns at `time`, which must be later than the time of the previous frame."""
        try:
            self.writer.frame(time, columns)
        except BrokenPipeError:
            self.refused()

    def refused(self) -> None:
        """Raises Error with the program's message after the program has stopped reading."""
        self.close()
        self.running.finish()
        raise Error("splatsieve ended before the stream did", 0)

    def close(self) -> None:
        try:
            self.pipe.close()
        except BrokenPipeError:
            pass

    def __exit__(
        self, kind: type[BaseException] | None, failure: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None:
            # No end mark is written: the program ends with an error that says less than the exception raised here.
            self.close()
            if not issubclass(kind, Exception):
                self.running.process.terminate()
            try:
                self.running.finish()
            except Error:
                pass
            return
        try:
            self.writer.end()
            self.pipe.close()
        except BrokenPipeError:
            self.refused()
        printed = self.running.finish()
        self.summary = parsed(printed) if self.reads else None
