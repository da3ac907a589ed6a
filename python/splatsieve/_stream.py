"""Writes frame streams (format/STREAM.md) to a file or to the program.

Columns are arrays [N, ...] in stored encoding: position [N, 3]; rotation [N, 4], wxyz; log_scale [N, 3], natural logs;
opacity_logit [N] or [N, 1]; sh [N, (d+1)^2, 3] or [N, 3 (d+1)^2]. Columns that are the same in all frames are given
once, the others with every frame. If frames may have any number of Gaussians, `count` is None and every frame has all
columns. Names and shapes are checked before anything is written; ValueError says what was expected. Needs numpy.
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
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[Any]

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
        constants = constant_columns(count, sh_degree, constant)
        self.out, self.frames, self.count, self.sh_degree = out, 0, count, sh_degree
        self.varying = [name for name in COLUMNS if name not in constants]
        bits = sum(1 << COLUMNS.index(name) for name in self.varying)
        version = 2 if count is None else 1
        out.write(struct.pack("<8sIIQII", b"\x89GSTR\r\n\x1a", version, sh_degree, count or 0, bits, 0))
        out.writelines(planes(constants[name]) for name in COLUMNS if name in constants)

    def frame(self, time: float, columns: Mapping[str, ArrayLike]) -> None:
        """Writes one frame: the varying columns at `time`, which must be later than the time of the previous frame.

        Raises ValueError if a column is missing, unknown or constant, or has another shape than the header declares.
        """
        place = f"frame {self.frames}"
        given = as_arrays(columns, place)
        for name in COLUMNS:
            if name not in given and name in self.varying:
                raise ValueError(f"{place}: no {name}; each frame has {', '.join(self.varying)}")
            if name in given and name not in self.varying:
                raise ValueError(f"{place}: {name} was given as constant, so no frame may have it")
        # A stream without a number of Gaussians has all columns in each frame; the first one gives their number.
        count = self.count
        if count is None:
            check_shapes({"position": given["position"]}, None, self.sh_degree, place)
            count = len(given["position"])
        check_shapes(given, count, self.sh_degree, place)
        payload = b"".join(planes(given[name]) for name in self.varying)
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


def constant_columns(count: int | None, sh_degree: int, constant: Mapping[str, ArrayLike] | None) -> dict[str, Array]:
    """Returns the constant columns of a stream as arrays. Raises ValueError if the header cannot declare them."""
    if sh_degree not in range(4):
        raise ValueError(f"sh_degree is {sh_degree}, expected 0, 1, 2 or 3")
    if count is not None and not 0 <= count < 2**32:
        raise ValueError(f"count is {count}, expected a number of Gaussians from 0 to 2^32 - 1")
    arrays = as_arrays(constant or {}, "constant columns")
    if count is None and arrays:
        raise ValueError("frames of any number of Gaussians have no columns that hold for every frame")
    check_shapes(arrays, count, sh_degree, "constant columns")
    return arrays


def as_arrays(columns: Mapping[str, ArrayLike], place: str) -> dict[str, Array]:
    """Returns the columns as arrays. Raises ValueError for an unknown name; `place` begins the message."""
    for name in columns:
        if name not in COLUMNS:
            raise ValueError(f"{place}: no attribute is named {name!r}, expected {', '.join(COLUMNS)}")
    return {name: np.asarray(column) for name, column in columns.items()}


def check_shapes(columns: Mapping[str, Array], count: int | None, sh_degree: int, place: str) -> None:
    """Raises ValueError if a column does not hold `count` Gaussians (None: any number); `place` begins the message."""
    coefficients = (sh_degree + 1) ** 2
    shapes: dict[str, list[tuple[int, ...]]] = {
        "position": [(3,)],
        "rotation": [(4,)],
        "log_scale": [(3,)],
        "opacity_logit": [(), (1,)],
        "sh": [(coefficients, 3), (3 * coefficients,)],
    }
    for name, array in columns.items():
        rows = count if count is not None else (len(array) if array.ndim else 0)
        if array.shape not in [(rows, *shape) for shape in shapes[name]]:
            words = ["N" if count is None else str(count)]
            expected = " or ".join(f"[{', '.join(words + [str(n) for n in shape])}]" for shape in shapes[name])
            raise ValueError(f"{place}: {name} has shape {list(array.shape)}, expected {expected}")


def planes(column: Array) -> bytes:
    """Returns the values of a column as bytes of f32, component by component."""
    return np.ascontiguousarray(np.moveaxis(column, 0, -1), "<f4").tobytes()


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
        # Checked here, as `__enter__` starts the program first.
        self.shape = (count, sh_degree, constant_columns(count, sh_degree, constant))
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
        """Sends one frame: the varying columns at `time`, which must be later than the time of the previous frame.

        Raises ValueError if a column is missing, unknown or constant, or has another shape than the header declares.
        """
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
